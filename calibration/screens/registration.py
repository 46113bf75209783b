"""Registration of a scan in the world by targets that scan and survey have in common."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from calibration.screens.survey_diagnosis import wrong_unit
from geometry.arrays import Array, skew
from geometry.pose import Pose

OUTLIER_SIGMAS = 6.0  # of a target against the others: with three coordinates and many targets, 5 is exceeded at times


@dataclass(frozen=True, slots=True)
class Registration:
    """world_from_cloud and its uncertainty."""

    world_from_cloud: Pose
    covariance: Array  # (6, 6) of its error
    residuals_m: Array  # (n, 3), world: transformed targets of the scan minus surveyed targets
    factor: float  # residuals over their sigmas, at least 1; the covariance is multiplied by its square


def register(names: Sequence[str], cloud: Array, world: Array, covariances: Array, sigma_m: float) -> Registration:
    """The rigid transform from targets (n, 3), m, of a scan to the survey's (n, 3).

    covariances (n, 3, 3), m^2, of the survey; sigma_m: of each coordinate of a target in the scan. Kabsch's rotation,
    then least squares.

    Raises:
        ValueError: too few targets, collinear targets, another size (a wrong unit), a mirror image, or an outlier.
    """
    if len(names) < 3:
        raise ValueError(f"{len(names)} targets are in both the scan and the survey, expected 3 or more")
    spread_c, spread_w = _spread(cloud), _spread(world)
    if spread_c[1] < 0.02 * spread_c[0] or spread_w[1] < 0.02 * spread_w[0]:
        raise ValueError("the targets lie on one line; the rotation about it is undetermined")
    ratio = float(np.linalg.norm(spread_w) / np.linalg.norm(spread_c))
    if not 0.95 < ratio < 1.05:
        unit = wrong_unit(1.0, ratio)
        hint = f"; is the scan in another unit ({unit})?" if unit else ""
        raise ValueError(f"distances between targets are {ratio:.4g} times larger in the survey than in the scan{hint}")
    pose = _kabsch(cloud, world)
    mirrored = _kabsch(cloud * [1, 1, -1], world)
    rms = np.sqrt(np.mean((pose.apply(cloud) - world) ** 2))
    rms_mirrored = np.sqrt(np.mean((mirrored.apply(cloud * [1, 1, -1]) - world) ** 2))
    C = covariances + sigma_m**2 * np.eye(3)
    typical = float(np.sqrt(np.mean(np.trace(C, axis1=1, axis2=2)) / 3))
    if rms > 10 * typical and rms_mirrored < 0.2 * rms:
        raise ValueError("scan and survey are mirror images of each other: one of them has two axes exchanged")
    for _ in range(5):
        J = _derivatives(pose, cloud)
        W = np.linalg.inv(C)
        N = np.einsum("nij,nik,nkl->jl", J, W, J)
        r = world - pose.apply(cloud)
        pose = pose.plus(np.linalg.solve(N, np.einsum("nij,nik,nk->j", J, W, r)))
    residuals = pose.apply(cloud) - world
    chi2 = float(np.einsum("ni,nij,nj->", residuals, np.linalg.inv(C), residuals))
    dof = 3 * len(names) - 6
    _check_outliers(names, cloud, world, C)
    factor = max(1.0, float(np.sqrt(chi2 / dof)))
    return Registration(pose, np.linalg.inv(N) * factor**2, residuals, factor)


def _check_outliers(names: Sequence[str], cloud: Array, world: Array, C: Array) -> None:
    """Raises ValueError for a target that is an outlier with respect to the others."""
    if len(names) < 5:
        return  # without one of four, the remaining three fit almost any survey
    normalised, distances = [], []
    for i in range(len(names)):
        rest = np.arange(len(names)) != i
        pose = _kabsch(cloud[rest], world[rest])
        left = pose.apply(cloud[rest]) - world[rest]
        sigma = np.sqrt(np.trace(C[rest], axis1=1, axis2=2) / 3)
        scale = max(float(np.sqrt(np.mean((left / sigma[:, None]) ** 2))), 1.0)
        # Including the uncertainty of the transform from the others, which is large if they are nearly collinear.
        J = _derivatives(pose, cloud)
        N = np.einsum("nij,nik,nkl->jl", J[rest], np.linalg.inv(C[rest]), J[rest])
        expected = C[i] + J[i] @ np.linalg.inv(N) @ J[i].T
        residual = pose.apply(cloud[i]) - world[i]
        normalised.append(float(np.sqrt(residual @ np.linalg.solve(expected, residual))) / scale)
        distances.append(float(np.linalg.norm(residual)))
    worst = int(np.argmax(normalised))
    if normalised[worst] > OUTLIER_SIGMAS:
        raise ValueError(
            f"target {names[worst]!r} does not fit the others ({1e3 * distances[worst]:.0f} mm off): its name or its"
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
