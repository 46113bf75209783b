"""Scanned point clouds: registration, alignment, and detection of a screen by Open3D's RANSAC and our surface fit.

A scan is registered in the world by targets that the survey has too, or aligned to another scan of the same place.
Errors of neighbouring scan points are correlated, so that the accuracy of a patch of the screen does not grow with the
number of its points. The surface is therefore fitted to patches, not to points.
"""

from __future__ import annotations

import ctypes
import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import ndimage
from scipy.spatial.transform import Rotation

from calibration.screens.flatness import assess_flatness, frame_of_extent
from calibration.screens.screens import Scan, moved_to_surface, pose_covariance, wrong_unit
from geometry.arrays import Array, Bools, robust_sigma, skew
from geometry.pose import Pose

INSTALL = (
    "this needs Open3D, which is not installed: `pip install open3d-cpu libusb-package` on Linux with x86-64,"
    " `pip install open3d` elsewhere"
)
_PACKAGES_OF_DEBIAN = {
    "libEGL.so": "libegl1",
    "libGL.so": "libgl1",
    "libX11.so": "libx11-6",
    "libgomp.so": "libgomp1",
    "libidn2.so": "libidn2-0",
    "libudev.so": "libudev1",
    "libusb-1.0.so": "libusb-1.0-0",
}


class MissingOpen3DError(RuntimeError):
    """Open3D is not installed, or a system library that it needs is missing. The message says what to install."""


def open3d() -> Any:
    """The module. Raises MissingOpen3DError: it cannot be loaded."""
    _load_libusb()
    try:
        import open3d as module
    except (ImportError, OSError) as error:  # OSError: a system library that it needs is missing
        raise MissingOpen3DError(_explained(error)) from None
    return module


def _load_libusb() -> None:
    """Load the packaged libusb for all that is loaded later; without the package, the system's is used, if any."""
    if not sys.platform.startswith("linux") or "open3d" in sys.modules:
        return
    try:
        import libusb_package

        path = libusb_package.get_library_path()
        if path is not None:
            ctypes.CDLL(str(path), mode=ctypes.RTLD_GLOBAL)
    except (ImportError, OSError):
        return  # `import open3d` then says whether anything is missing


def _explained(error: Exception) -> str:
    """What to install, for an error of `import open3d`."""
    library = re.match(r"(lib[\w.+-]+?\.so)[.\d]*: cannot open shared object file", str(error))
    if library is None:
        return f"{INSTALL} ({error})"
    package = _PACKAGES_OF_DEBIAN.get(library[1])
    hint = f"`apt-get install {package}`" if package else "the system package that has it"
    return f"this needs Open3D, whose system library {library[1]} is missing; on Debian or Ubuntu install {hint}"


OUTLIER_SIGMAS = 6.0  # of a target against the others: with three coordinates and many targets, 5 is exceeded at times


@dataclass(frozen=True, slots=True)
class Registration:
    """world_from_cloud and its uncertainty."""

    world_from_cloud: Pose
    covariance: Array  # (6, 6) of its error; widened where the residuals are larger than their sigmas
    residuals_m: Array  # (n, 3), world: transformed targets of the scan minus surveyed targets


def register(names: Sequence[str], cloud: Array, world: Array, covariances: Array, sigma_m: float) -> Registration:
    """The rigid transform from targets (n, 3), m, of a scan to the survey's (n, 3).

    covariances (n, 3, 3), m^2, of the survey; sigma_m: of each coordinate of a target in the scan. Kabsch's rotation,
    then least squares. Raises ValueError: too few targets, collinear targets, another size (a wrong unit), a mirror
    image, or an outlier.
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
    return Registration(pose, np.linalg.inv(N) * factor**2, residuals)


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

    Raises MissingOpen3DError: Open3D cannot be loaded.
    """
    o3d = open3d()
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.ascontiguousarray(points)))
    _, kept = cloud.remove_statistical_outlier(_NEIGHBOURS, _SIGMAS)
    out = np.zeros(len(points), dtype=bool)
    out[np.asarray(kept, dtype=np.int64)] = True
    return out


def align(moving: Array, fixed: Array) -> Alignment:
    """The rigid transform of a scan (n, 3), m, to another (k, 3) of the same place, by point-to-plane ICP.

    The scans must agree to about a twentieth of their extent before, as scanner programs align them. Raises ValueError:
    the scans do not overlap, or what they share does not determine all of the transform (one plane);
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
    return Alignment(Pose(rotation, shift), float(robust_sigma(off)), overlap)


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
    world_from_cloud: Pose | None = None,
    registration: Array | None = None,
) -> Scan:
    """The screen in a cloud of points (n, 3), m.

    size_m selects the plane of the screen if the cloud has several; without it the largest one is used. point_sigma_m:
    of one point along the normal; None: from the scatter within patches. world_from_cloud (None: the cloud is in
    world) has an error with the covariance registration (6, 6). Raises ValueError: there is no such plane;
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
    frame = frame_of_extent(on_plane)
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
        inner.append(float(robust_sigma(left - np.median(left))))
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
