"""A scan's frame in the world, from targets that scan and survey share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from calibration.screens.survey_suspects import wrong_unit
from geometry.arrays import Array, skew
from geometry.pose import Pose

OUTLIER_SIGMAS = 6.0  # of a target against the others; three numbers each, so 5 is passed now and then by many targets


@dataclass(frozen=True, slots=True)
class Registration:
    """world_from_cloud and how well it is known."""

    world_from_cloud: Pose
    covariance: Array  # (6, 6) of its error
    misses_m: Array  # (n, 3), world: targets in the scan, taken to the world, less the survey
    factor: float  # times that the misses are larger than their sigmas say; at least 1, and the covariance has it


def register(names: Sequence[str], cloud: Array, world: Array, covariances: Array, sigma_m: float) -> Registration:
    """The rigid transform that takes targets (n, 3), m, of a scan to where the survey (n, 3) has them.

    covariances (n, 3, 3), m^2, of the survey; sigma_m: of each coordinate of a target in the scan. Kabsch's rotation,
    then least squares. Raises ValueError: too few targets, on one line, of another size (a wrong unit), mirrored, or
    one that does not fit.
    """
    if len(names) < 3:
        raise ValueError(f"{len(names)} targets are in both the scan and the survey, expected 3 or more")
    spread_c, spread_w = _spread(cloud), _spread(world)
    if spread_c[1] < 0.02 * spread_c[0] or spread_w[1] < 0.02 * spread_w[0]:
        raise ValueError("the targets lie on one line; a turn about it stays unknown")
    ratio = float(np.linalg.norm(spread_w) / np.linalg.norm(spread_c))
    if not 0.95 < ratio < 1.05:
        unit = wrong_unit(1.0, ratio)
        hint = f"; is the scan's unit another one ({unit})?" if unit else ""
        raise ValueError(f"the targets are {ratio:.4g} times as far apart in the survey as in the scan{hint}")
    pose = _kabsch(cloud, world)
    mirrored = _kabsch(cloud * [1, 1, -1], world)
    rms = np.sqrt(np.mean((pose.apply(cloud) - world) ** 2))
    rms_mirrored = np.sqrt(np.mean((mirrored.apply(cloud * [1, 1, -1]) - world) ** 2))
    C = covariances + sigma_m**2 * np.eye(3)
    typical = float(np.sqrt(np.mean(np.trace(C, axis1=1, axis2=2)) / 3))
    if rms > 10 * typical and rms_mirrored < 0.2 * rms:
        raise ValueError("scan and survey are mirror images of each other: one of them has two axes swapped")
    for _ in range(5):
        J = _derivatives(pose, cloud)
        W = np.linalg.inv(C)
        N = np.einsum("nij,nik,nkl->jl", J, W, J)
        r = world - pose.apply(cloud)
        pose = pose.plus(np.linalg.solve(N, np.einsum("nij,nik,nk->j", J, W, r)))
    misses = pose.apply(cloud) - world
    chi2 = float(np.einsum("ni,nij,nj->", misses, np.linalg.inv(C), misses))
    dof = 3 * len(names) - 6
    _refuse_outlier(names, cloud, world, C)
    factor = max(1.0, float(np.sqrt(chi2 / dof)))
    return Registration(pose, np.linalg.inv(N) * factor**2, misses, factor)


def _refuse_outlier(names: Sequence[str], cloud: Array, world: Array, C: Array) -> None:
    """Raises ValueError for a target without which the others fit and from which it is far off."""
    if len(names) < 5:
        return  # without one of four, three fit nearly anything
    off, away = [], []
    for i in range(len(names)):
        rest = np.arange(len(names)) != i
        pose = _kabsch(cloud[rest], world[rest])
        left = pose.apply(cloud[rest]) - world[rest]
        sigma = np.sqrt(np.trace(C[rest], axis1=1, axis2=2) / 3)
        scale = max(float(np.sqrt(np.mean((left / sigma[:, None]) ** 2))), 1.0)
        # The others leave the transform uncertain, most so where they lie nearly on a line.
        J = _derivatives(pose, cloud)
        N = np.einsum("nij,nik,nkl->jl", J[rest], np.linalg.inv(C[rest]), J[rest])
        expected = C[i] + J[i] @ np.linalg.inv(N) @ J[i].T
        miss = pose.apply(cloud[i]) - world[i]
        off.append(float(np.sqrt(miss @ np.linalg.solve(expected, miss))) / scale)
        away.append(float(np.linalg.norm(miss)))
    worst = int(np.argmax(off))
    if off[worst] > OUTLIER_SIGMAS:
        raise ValueError(
            f"target {names[worst]!r} does not fit the others ({1e3 * away[worst]:.0f} mm off): its name or its"
            " coordinates are wrong in the scan or in the survey"
        )


def _derivatives(pose: Pose, cloud: Array) -> Array:
    """d(world point)/d(error of the pose) (n, 3, 6)."""
    return np.concatenate([np.broadcast_to(np.eye(3), (len(cloud), 3, 3)), -pose.rotation @ skew(cloud)], axis=2)


def _spread(points: Array) -> Array:
    return np.linalg.svd(points - points.mean(axis=0), compute_uv=False)


def _kabsch(source: Array, destination: Array) -> Pose:
    a, b = source.mean(axis=0), destination.mean(axis=0)
    R = Rotation.align_vectors(destination - b, source - a)[0].as_matrix()
    return Pose(R, b - R @ a)
