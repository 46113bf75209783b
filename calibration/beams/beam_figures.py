"""Angles between calibrated beams, and tests whether opposed beams are collinear."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.special import chdtrc

from calibration.least_squares.parameter_blocks import Lines
from geometry.arrays import Array, normalised

_OPPOSED = np.deg2rad(5.0)  # largest deviation of beams meant to be collinear: mounting by eye is better than this


@dataclass(frozen=True, slots=True)
class BeamAngle:
    """Angle between the directions of two beams."""

    first: str
    second: str
    angle: float  # rad, 0 to pi
    sigma: float  # rad


@dataclass(frozen=True, slots=True)
class CollinearityTest:
    """Test whether two opposed beams are collinear."""

    first: str
    second: str
    turn: float  # rad, between the first's direction and the second's reversed
    turn_sigma: float  # rad
    gap: float  # m, across the first beam, between the points of either nearest to the body's origin
    gap_sigma: float  # m
    p: float  # p-value of the difference, if the beams are collinear


def angles_between(names: Sequence[str], lines: Lines, covariance: Array) -> list[BeamAngle]:
    """The angles of all pairs, with sigmas from the joint covariance (4 k, 4 k) of the lines' errors.

    The angle of a pair that is parallel or opposed to within its sigma is at the edge of its range; its sigma is then
    that of one of the two components of the rotation.
    """
    out = []
    for i, j in combinations(range(len(names)), 2):
        a, b = lines.directions[i], lines.directions[j]
        # d(angle) = -b'.d(a) - a'.d(b); a' and b' are unit vectors across each direction, towards the other one.
        normal = np.cross(a, b)
        if np.linalg.norm(normal) < 1e-12:
            normal = lines.basis[i, :, 0]
        normal = normalised(normal)
        angle = float(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))
        g = np.zeros(len(covariance))
        g[4 * i : 4 * i + 2] = -np.cross(normal, a) @ lines.basis[i]
        g[4 * j : 4 * j + 2] = np.cross(normal, b) @ lines.basis[j]
        out.append(BeamAngle(names[i], names[j], angle, float(np.sqrt(g @ covariance @ g))))
    return out


def opposed_pairs(names: Sequence[str], lines: Lines, covariance: Array) -> list[CollinearityTest]:
    """Collinearity tests of all pairs of beams that are opposed to within 5 deg.

    covariance (4 k, 4 k) of the lines' errors. The four differences between the first line and the second one reversed
    are tested together (chi-square). Points should be those nearest to the body's origin.
    """
    out = []
    for i, j in combinations(range(len(names)), 2):
        if lines.directions[i] @ lines.directions[j] > -np.cos(_OPPOSED):
            continue
        B, C = lines.basis[i], lines.basis[j]
        difference = np.concatenate([-lines.directions[j] @ B, (lines.points[j] - lines.points[i]) @ B])
        J = np.zeros((4, len(covariance)))
        J[:2, 4 * i : 4 * i + 2] = J[2:, 4 * i + 2 : 4 * i + 4] = -np.eye(2)
        J[:2, 4 * j : 4 * j + 2], J[2:, 4 * j + 2 : 4 * j + 4] = -B.T @ C, B.T @ C
        S = J @ covariance @ J.T
        p = float(chdtrc(4, difference @ np.linalg.solve(S, difference)))
        turn, turn_sigma = _size(difference[:2], S[:2, :2])
        gap, gap_sigma = _size(difference[2:], S[2:, 2:])
        out.append(CollinearityTest(names[i], names[j], turn, turn_sigma, gap, gap_sigma, p))
    return out


def _size(vector: Array, covariance: Array) -> tuple[float, float]:
    """Length and its sigma; for a zero length, the sigma along the major axis."""
    size = float(np.linalg.norm(vector))
    if size < 1e-15:
        return 0.0, float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))
    u = vector / size
    return size, float(np.sqrt(u @ covariance @ u))
