"""Registration of a scan: in the world by targets that the survey has too, or to another scan of the same place."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from calibration.open3d_loader import open3d
from calibration.screens.screens import wrong_unit
from geometry.arrays import Array, Bools, skew
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


_NEIGHBOURS = 20
_SIGMAS = 4.0  # of the mean distance from the neighbours, over all points
_MOST_POINTS = 60_000  # of each scan in the alignment
_STEPS = (0.06, 0.02, 0.006)  # pairing distances of the three steps, in shares of the scene's extent
_SPACINGS = 6.0  # least pairing distance, in distances between neighbours: sparse scans have partners too
_LEAST_OVERLAP = 0.3  # share of points with a partner
_LEAST_STIFFNESS = 1e-3  # weakest over strongest direction of the normal equations: below, a shift is undetermined
_DIGITS = 1e-9  # m and rad: sums of several threads differ in the last bits


@dataclass(frozen=True, slots=True)
class Alignment:
    """The place of one scan in the frame of another."""

    fixed_from_moving: Pose
    sigma_m: float  # of the distances of paired points along the normals, from their median
    overlap: float  # share of the moving scan's points with a partner


def on_surfaces(points: Array) -> Bools:
    """Which points (n, 3) have neighbours as near as most points: not dust, mixed pixels at edges, or reflections.

    Raises:
        MissingOpen3DError: Open3D cannot be loaded.
    """
    o3d = open3d()
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.ascontiguousarray(points)))
    _, kept = cloud.remove_statistical_outlier(_NEIGHBOURS, _SIGMAS)
    out = np.zeros(len(points), dtype=bool)
    out[np.asarray(kept, dtype=np.int64)] = True
    return out


def align(moving: Array, fixed: Array) -> Alignment:
    """The rigid transform of a scan (n, 3), m, to another (k, 3) of the same place, by point-to-plane ICP.

    The scans must agree to about a twentieth of their extent before, as scanner programs align them.

    Raises:
        ValueError: the scans do not overlap, or what they share does not determine all of the transform (one plane).
        MissingOpen3DError: Open3D cannot be loaded.
    """
    o3d = open3d()
    centre = fixed.mean(axis=0)
    extent = float(np.linalg.norm(np.ptp(fixed, axis=0)))
    target, source = (_thinned(p) - centre for p in (fixed, moving))
    clouds = [o3d.geometry.PointCloud(o3d.utility.Vector3dVector(p)) for p in (target, source)]
    clouds[0].estimate_normals(o3d.geometry.KDTreeSearchParamKNN(_NEIGHBOURS))
    kind = o3d.pipelines.registration
    transform = np.eye(4)
    spacing = float(np.median(np.asarray(clouds[0].compute_nearest_neighbor_distance())))
    for share in _STEPS:
        within = max(share * extent, _SPACINGS * spacing)
        found = kind.registration_icp(
            clouds[1], clouds[0], within, transform, kind.TransformationEstimationPointToPlane(),
            kind.ICPConvergenceCriteria(1e-9, 1e-9, 60),
        )  # fmt: skip
        transform = np.asarray(found.transformation)
    pairs = np.asarray(found.correspondence_set)
    overlap = len(pairs) / len(source)
    if overlap < _LEAST_OVERLAP:
        raise ValueError(
            f"{100 * overlap:.0f} % of its points are near the first scan, expected {100 * _LEAST_OVERLAP:.0f} % or"
            " more; align the scans roughly first, or use targets"
        )
    normals = np.asarray(clouds[0].normals)[pairs[:, 1]]
    placed = source[pairs[:, 0]] @ transform[:3, :3].T + transform[:3, 3]
    if _stiffness(placed, normals) < _LEAST_STIFFNESS:
        raise ValueError(
            "what it shares with the first scan does not determine the alignment (a single plane can be shifted along"
            " itself); scan also what stands around the screen, or use targets"
        )
    off = np.einsum("ni,ni->n", placed - target[pairs[:, 1]], normals)
    turn = Rotation.from_matrix(transform[:3, :3]).as_rotvec()
    rotation = Rotation.from_rotvec(np.round(turn / _DIGITS) * _DIGITS).as_matrix()
    shift = np.round((transform[:3, 3] + centre - rotation @ centre) / _DIGITS) * _DIGITS
    return Alignment(Pose(rotation, shift), 1.4826 * float(np.median(np.abs(off))), overlap)


def _thinned(points: Array) -> Array:
    """At most _MOST_POINTS of the points, the same ones each time."""
    if len(points) <= _MOST_POINTS:
        return points
    return points[np.random.default_rng(0).choice(len(points), _MOST_POINTS, replace=False)]


def _stiffness(points: Array, normals: Array) -> float:
    """Smallest over largest eigenvalue of the normal equations of point-to-plane distances, lengths in their spread."""
    arm = points - points.mean(axis=0)
    J = np.concatenate([normals, np.cross(arm / np.sqrt(np.mean(np.sum(arm**2, axis=1))), normals)], axis=1)
    values = np.linalg.eigvalsh(J.T @ J)
    return float(values[0] / values[-1])
