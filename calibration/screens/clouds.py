"""Detection of a screen in a scanned point cloud: planes by Open3D's RANSAC, then our surface fit to patches.

Errors of neighbouring scan points are correlated, so that the accuracy of a patch of the screen does not grow with the
number of its points. The surface is therefore fitted to patches, not to points.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from calibration.open3d_loader import open3d
from calibration.screens.flatness import assess_flatness, frame_of_extent
from calibration.screens.screens import Scan, moved_to_surface, pose_covariance, wrong_unit
from geometry.arrays import Array, Bools, skew
from geometry.pose import Pose

FEWEST = 200  # points on a screen
_RANSAC_POINTS = 100_000  # largest random subset: more points give the same planes
_PATCHES = 20  # along the screen's longer side
_FEWEST_IN_PATCH = 5
_PLANES = 4  # planes searched for, the largest first
# Shares of a point's scatter (ours, conservative) that are common to all points of a patch, and to all of the scan.
_SHARED_IN_PATCH = 1 / 3
_SHARED_BY_ALL = 1 / 2


@dataclass(frozen=True, slots=True)
class PlaneCandidate:
    """One plane of a cloud."""

    points: Array  # (n, 3): the largest connected component
    extent_m: Array  # (2,), the longer one first


def scan_of(
    points: Array,
    size_m: tuple[float, float] | None = None,
    point_sigma_m: float | None = None,
    bow: str = "auto",
    seen_from: Array | None = None,
    world_from_cloud: Pose | None = None,
    registration: Array | None = None,
) -> Scan:
    """The screen in a cloud of points (n, 3), m.

    size_m selects the plane of the screen if the cloud has several; without it the largest one is used. point_sigma_m:
    of one point along the normal; None: from the scatter within patches. seen_from (3,), world: the side to which z
    points. world_from_cloud (None: the cloud is in world) has an error with the covariance registration (6, 6).

    Raises:
        ValueError: there is no such plane.
        MissingOpen3DError: Open3D cannot be loaded.
    """
    if len(points) < FEWEST:
        raise ValueError(f"{len(points)} points, expected {FEWEST} or more")
    to_world = Pose.identity() if world_from_cloud is None else world_from_cloud
    found = planes(points)
    if not found:
        raise ValueError("no plane was found in the cloud; crop it to the screen and its frame")
    chosen = _plane_of_size(found, size_m)
    on_plane = to_world.apply(chosen.points)
    frame = frame_of_extent(on_plane, seen_from)
    xyz, sigma, scatter = patches(frame, on_plane, point_sigma_m)
    flatness = assess_flatness(xyz, sigma, bow)
    frame = moved_to_surface(frame, flatness.chosen)
    xyz, sigma, scatter = patches(frame, on_plane, point_sigma_m)
    flatness = assess_flatness(xyz, sigma, bow)
    C = pose_covariance(frame, flatness.chosen)
    n = frame.rotation[:, 2]
    C[:3, :3] += (_SHARED_BY_ALL * scatter) ** 2 * np.outer(n, n)
    if registration is not None:
        C[:6, :6] += _registration_covariance(to_world, frame, registration)
    flat = frame.inverse().apply(on_plane)
    size = np.ptp(flat[:, :2], axis=0)
    words = (
        f"{len(points)} points, {len(chosen.points)} of them on a plane of {size[0]:.2f} m x {size[1]:.2f} m; one point"
        f" scatters by {1e3 * scatter:.2g} mm"
    )
    return Scan(frame, flatness, C, xyz, (float(size[0]), float(size[1])), words)


def planes(points: Array) -> list[PlaneCandidate]:
    """The largest planes of a cloud (n, 3), m: of each the largest connected component."""
    o3d = open3d()
    rest = points
    out: list[PlaneCandidate] = []
    extent = float(np.linalg.norm(np.ptp(points, axis=0)))
    # For a screen and its surroundings; a much larger cloud is in another unit, which the sizes of its planes reveal.
    within = 0.003 * extent if extent > 100 else float(np.clip(0.003 * extent, 0.002, 0.02))
    rng = np.random.default_rng(0)
    o3d.utility.random.seed(0)
    for _ in range(_PLANES):
        if len(rest) < max(FEWEST, 0.02 * len(points)):
            break
        some = rest if len(rest) <= _RANSAC_POINTS else rest[rng.choice(len(rest), _RANSAC_POINTS, replace=False)]
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.ascontiguousarray(some)))
        (a, b, c, d), _ = cloud.segment_plane(distance_threshold=within, ransac_n=3, num_iterations=1000)
        normal = np.array([a, b, c])
        near = np.abs(rest @ normal + d) < 2 * within  # wider than in the search, because a screen may be bent
        if near.sum() >= FEWEST:
            piece = rest[near][_largest_component(rest[near], normal)]
            if len(piece) >= FEWEST:
                sides = np.sort(np.ptp(frame_of_extent(piece).inverse().apply(piece)[:, :2], axis=0))[::-1]
                out.append(PlaneCandidate(piece, sides))
        rest = rest[~near]
    return out


def patches(frame: Pose, points: Array, point_sigma_m: float | None) -> tuple[Array, Array, float]:
    """Patches (m, 3), m, of points near a frame's plane, in the frame; sigmas of their heights (m,); one point's sigma.

    The height of a patch is the median of its points.
    """
    flat = frame.inverse().apply(points)
    lo, extent = flat[:, :2].min(axis=0), np.ptp(flat[:, :2], axis=0)
    side = float(extent.max()) / _PATCHES
    column, row = np.minimum((flat[:, :2] - lo) // side, np.ceil(extent / side) - 1).astype(np.int64).T
    key = row * (_PATCHES + 1) + column
    order = np.argsort(key, kind="stable")
    _, first, count = np.unique(key[order], return_index=True, return_counts=True)
    xyz, inner, used = [], [], []
    for start, n in zip(first[count >= _FEWEST_IN_PATCH], count[count >= _FEWEST_IN_PATCH], strict=True):
        mine = flat[order[start : start + n]]
        # Relative to the patch's own slope, so that a tilt does not count as scatter.
        left = mine[:, 2] - _plane_heights(mine)
        inner.append(1.4826 * float(np.median(np.abs(left - np.median(left)))))
        xyz.append([mine[:, 0].mean(), mine[:, 1].mean(), float(np.median(left)) + _plane_heights(mine).mean()])
        used.append(n)
    if len(xyz) < 12:
        raise ValueError(f"the plane has {len(xyz)} patches with {_FEWEST_IN_PATCH} points or more, expected 12")
    scatter = float(np.median(inner)) if point_sigma_m is None else point_sigma_m
    scatter = max(scatter, 1e-6)
    # The median of n points is sqrt(pi / 2n) of one point's sigma.
    sigma = scatter * np.sqrt(np.pi / 2 / np.array(used) + _SHARED_IN_PATCH**2)
    return np.array(xyz), sigma, scatter


def _plane_heights(points: Array) -> Array:
    """Heights of the best-fitting plane at points (n, 3)."""
    A = np.column_stack([np.ones(len(points)), points[:, :2] - points[:, :2].mean(axis=0)])
    return np.asarray(A @ np.linalg.lstsq(A, points[:, 2], rcond=None)[0])


def _plane_of_size(found: list[PlaneCandidate], size_m: tuple[float, float] | None) -> PlaneCandidate:
    """The plane whose size is nearest to the screen's, or the one with most points."""
    if size_m is None:
        return max(found, key=lambda c: len(c.points))
    wanted = np.sort(np.array(size_m))[::-1]
    best = min(found, key=lambda c: float(np.max(np.abs(np.log(c.extent_m / wanted)))))
    if np.max(np.abs(np.log(best.extent_m / wanted))) > np.log(1.3):
        seen = "; ".join(f"{c.extent_m[0]:.2f} m x {c.extent_m[1]:.2f} m" for c in found)
        units = [wrong_unit(float(np.linalg.norm(c.extent_m)), float(np.linalg.norm(wanted))) for c in found]
        unit = next((u for u in units if u), "")
        hint = f"; is the scan in another unit ({unit})?" if unit else ""
        raise ValueError(f"no plane of {wanted[0]:g} m x {wanted[1]:g} m was found; those in the cloud: {seen}{hint}")
    return best


def _largest_component(points: Array, normal: Array) -> Bools:
    """Which points (n, 3) of a plane are in its largest connected component, e.g. not on a wall behind the screen."""
    least = np.eye(3)[int(np.argmin(np.abs(normal)))]
    x = np.cross(normal, least)
    x /= np.linalg.norm(x)
    flat = points @ np.stack([x, np.cross(normal, x)], axis=1)
    extent = np.ptp(flat, axis=0)
    # Cells with about ten points each, so that a gap of two or three rows of points separates two components.
    cell = max(float(np.sqrt(np.prod(extent) / len(points) * 10)), float(extent.max()) / 400)
    at = ((flat - flat.min(axis=0)) // cell).astype(np.int64)
    grid = np.zeros(at.max(axis=0) + 1, dtype=np.int64)
    np.add.at(grid, (at[:, 0], at[:, 1]), 1)
    labels, _ = ndimage.label(grid > 0, structure=np.ones((3, 3)))
    mine = labels[at[:, 0], at[:, 1]]
    return np.asarray(mine == np.argmax(np.bincount(mine)))


def _registration_covariance(world_from_cloud: Pose, frame: Pose, C: Array) -> Array:
    """Covariance (6, 6) of a plane's frame due to the error of world_from_cloud; 0 within the plane, by definition."""
    cloud_from_screen = world_from_cloud.inverse() @ frame
    J = np.zeros((6, 6))
    J[:3, :3] = np.eye(3)
    J[:3, 3:] = -world_from_cloud.rotation @ skew(cloud_from_screen.translation)
    J[3:, 3:] = cloud_from_screen.rotation.T
    n = frame.rotation[:, 2]
    keep = np.zeros((6, 6))
    keep[:3, :3] = np.outer(n, n)
    keep[3, 3] = keep[4, 4] = 1.0
    T = keep @ J
    return T @ C @ T.T
