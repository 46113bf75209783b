"""What a calibration of beams tells about them: angles between them, and whether two opposed ones are one line."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.special import chdtrc

from calibration.least_squares.parameter_blocks import Lines
from geometry.arrays import Array, normalised

_OPPOSED = np.deg2rad(5.0)  # of lasers that were meant to be one line: no more is left after mounting by eye


@dataclass(frozen=True, slots=True)
class Between:
    """The angle of two beams' directions."""

    first: str
    second: str
    angle: float  # rad, 0 to pi
    sigma: float  # rad


@dataclass(frozen=True, slots=True)
class OneLine:
    """How far two opposed beams are from one straight line."""

    first: str
    second: str
    turn: float  # rad, between the first's direction and the second's, turned round
    turn_sigma: float  # rad, of that number
    gap: float  # m, across, between the points of either nearest to the body's origin
    gap_sigma: float  # m
    p: float  # of true opposed beams on one line to differ that much


def angles_between(names: Sequence[str], lines: Lines, covariance: Array) -> list[Between]:
    """The angles of all pairs, with sigmas from the joint covariance (4 k, 4 k) of the lines' errors.

    A pair that is parallel or opposed to within its sigma has an angle at the edge of its range, whose sigma is then
    that of one of the two small turns that make it up.
    """
    out = []
    for i, j in combinations(range(len(names)), 2):
        a, b = lines.directions[i], lines.directions[j]
        # d(angle) = -b'.d(a) - a'.d(b), with a', b' the directions across each towards the other.
        normal = np.cross(a, b)
        if np.linalg.norm(normal) < 1e-12:
            normal = lines.basis[i, :, 0]
        normal = normalised(normal)
        angle = float(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))
        g = np.zeros(len(covariance))
        g[4 * i : 4 * i + 2] = -np.cross(normal, a) @ lines.basis[i]
        g[4 * j : 4 * j + 2] = np.cross(normal, b) @ lines.basis[j]
        out.append(Between(names[i], names[j], angle, float(np.sqrt(g @ covariance @ g))))
    return out


def opposed_pairs(names: Sequence[str], lines: Lines, covariance: Array) -> list[OneLine]:
    """Of each pair of beams that point against each other to within 5 deg: whether they are one line.

    covariance (4 k, 4 k) of the lines' errors. The four numbers by which the second, turned round, differs from the
    first are tested together (chi-square). Points should be those nearest to the body's origin.
    """
    out = []
    for i, j in combinations(range(len(names)), 2):
        if lines.directions[i] @ lines.directions[j] > -np.cos(_OPPOSED):
            continue
        B, C = lines.basis[i], lines.basis[j]
        away = np.concatenate([-lines.directions[j] @ B, (lines.points[j] - lines.points[i]) @ B])
        J = np.zeros((4, len(covariance)))
        J[:2, 4 * i : 4 * i + 2] = J[2:, 4 * i + 2 : 4 * i + 4] = -np.eye(2)
        J[:2, 4 * j : 4 * j + 2], J[2:, 4 * j + 2 : 4 * j + 4] = -B.T @ C, B.T @ C
        S = J @ covariance @ J.T
        p = float(chdtrc(4, away @ np.linalg.solve(S, away)))
        turn, turn_sigma = _size(away[:2], S[:2, :2])
        gap, gap_sigma = _size(away[2:], S[2:, 2:])
        out.append(OneLine(names[i], names[j], turn, turn_sigma, gap, gap_sigma, p))
    return out


def _size(vector: Array, covariance: Array) -> tuple[float, float]:
    """Length and its sigma; that of the larger axis where the length is none."""
    size = float(np.linalg.norm(vector))
    if size < 1e-15:
        return 0.0, float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))
    u = vector / size
    return size, float(np.sqrt(u @ covariance @ u))
