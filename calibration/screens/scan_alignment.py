"""Points of scans that are not on any surface, and the alignment of two scans of one place, by Open3D."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from calibration.open3d_loader import open3d
from geometry.arrays import Array, Bools
from geometry.pose import Pose

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
