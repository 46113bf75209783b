"""Calibration of screens and cameras: start values, frames, flatness, then the joint adjustment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from calibration.least_squares.parameter_blocks import Poses, Vectors
from calibration.least_squares.priors import Prior
from calibration.screens.flatness import Flatness, Surface, assess_flatness
from calibration.screens.network import Network, NetworkFit, adjust
from calibration.screens.network_start import CameraOnDots, ChainedPoses, boards_seen, camera_on_dots, chain, start_of
from calibration.screens.resection import ResectedPose
from calibration.screens.screen_frame import frame_of_dots, frame_of_extent
from geometry.arrays import Array, Bools, Ints
from geometry.pose import Pose

WITHIN_PX = 8.0  # largest reprojection error of an inlier in the start: lenses are calibrated
GAUGE = 1e-6  # m and rad: sigma of the gauge constraint of a screen's axes within its plane, as in FrameTerm
_RULED_OUT = 3.0  # ratio of misfits from which the second pose of coplanar points is ruled out


@dataclass(frozen=True, slots=True)
class Scan:
    """A screen's surface from a scanned point cloud, in world."""

    world_from_screen: Pose
    flatness: Flatness
    covariance: Array  # (9, 9): of the error of world_from_screen and of the bow; bow rows 0 for a plane
    xyz: Array  # (m, 3), m: the points of the flatness map, in the frame of world_from_screen
    size_m: tuple[float, float]  # extent of the points on the plane
    words: str = ""  # numbers of points and of points on the plane, in words


@dataclass(frozen=True, slots=True)
class ScreenSetup:
    """Options of one screen."""

    frame_points: tuple[int, int, int] | None = None  # dots: origin, on the x axis, on the side of positive y
    origin_at: tuple[float, float] = (0.0, 0.0)  # m: coordinates of the first of them in the screen's frame
    bow: str = "auto"  # auto, always or never
    scatter_m: float | None = None  # of the surface, if known
    scan: Scan | None = None


@dataclass(frozen=True, slots=True)
class ApproximatePosition:
    """Approximate position of a camera, measured by tape."""

    position_m: Array  # (3,), world
    within_m: float


@dataclass(frozen=True, slots=True)
class ScreenResult:
    """Surface of one screen, apart from its pose."""

    flatness: Flatness | None  # None: the screen has only a fixed board
    xyz: Array  # (m, 3), m: the points of the surface fit, in the screen's final frame; m = 0 without
    used: Bools  # (m,)
    control_points: tuple[int, ...]  # indices of the dots; empty for a scan


@dataclass(frozen=True, slots=True)
class ScreensResult:
    """Result of the calibration of screens and cameras."""

    network: Network
    fit: NetworkFit
    screens: tuple[ScreenResult, ...]
    poses_by_camera: Mapping[int, CameraOnDots] = field(default_factory=dict)
    # camera -> a second pose that fits nearly as well
    second_poses: Mapping[int, ResectedPose] = field(default_factory=dict)


def calibrate(
    network: Network,
    setups: Sequence[ScreenSetup],
    near: Mapping[int, ApproximatePosition] | None = None,
    held_screen: int | None = None,
    held_camera: int | None = None,
) -> ScreensResult:
    """Poses of all cameras and screens, their bows where significant, and the joint covariance.

    setups: one per screen. near: camera -> approximate position, which decides between two poses. Without a survey, the
    world is the frame that held_screen gets from the board fixed to it, or that of held_camera.

    Raises:
        NotConnectedError: some cameras or screens are not connected with the others.
        AdjustmentError: the adjustment fails.
        ValueError: the dots do not determine a screen's plane.
    """
    near = {} if near is None else near
    poses_by_camera = {c: camera_on_dots(network, c, WITHIN_PX) for c in range(len(network.rig.cameras))}
    chosen = {c: _choose(found, near.get(c)) for c, found in poses_by_camera.items() if found.poses}
    boards = boards_seen(network, WITHIN_PX)
    surveyed = bool(chosen) or (bool(np.any(network.control_points.screen_of >= 0)) and not boards)
    problems = {c: found.problem for c, found in poses_by_camera.items()}
    placed = {c: p.camera_from_world for c, p in chosen.items()}
    chained = chain(network, placed, boards, held_screen, held_camera, problems)
    complete, frames, bows, results = _screen_starts(network, setups, chained)
    start = start_of(
        complete,
        chained,
        frames,
        bows,
        None if surveyed or held_screen is not None else held_camera,
        None if surveyed else _board_on(network, held_screen),
    )
    fit = adjust(complete, start)
    results = [_in_final_frame(r, complete, fit, k) for k, r in enumerate(results)]
    second_poses = {
        c: r
        for c, found in poses_by_camera.items()
        for r in [_second_pose(found, chosen.get(c), near.get(c))]
        if r is not None
    }
    return ScreensResult(complete, fit, tuple(results), poses_by_camera, second_poses)


def _screen_starts(
    network: Network, setups: Sequence[ScreenSetup], chained: ChainedPoses
) -> tuple[Network, dict[int, Pose], Array, list[ScreenResult]]:
    """Frame, bow (screens, 3) and flatness of each screen with a scan or dots; and the network with their priors."""
    observed = [c.screen for c in network.rig.cameras.values()]
    frames: dict[int, Pose] = {}
    results: list[ScreenResult] = []
    bows = np.zeros((len(setups), 3))
    scatter: dict[int, float] = {}
    off = np.zeros(len(network.control_points), dtype=bool)
    bent: set[int] = set()
    priors: list[Prior] = []
    for k, (name, setup) in enumerate(zip(network.rig.screens, setups, strict=True)):
        eyes = [chained.camera_from_world[c].inverse().translation for c, s in enumerate(observed) if s == name]
        seen_from = np.mean(eyes, axis=0) if eyes else None
        if setup.scan is not None:
            scan = facing(setup.scan, seen_from)
            frames[k] = scan.world_from_screen
            bows[k] = scan.flatness.chosen.coefficients[3:]
            if scan.flatness.chosen.bent:
                bent.add(k)
            priors.append(_scan_prior(k, scan))
            results.append(ScreenResult(scan.flatness, scan.xyz, scan.flatness.chosen.used, ()))
            continue
        control_points = np.flatnonzero(network.control_points.screen_of == k)
        if not len(control_points):
            results.append(ScreenResult(None, np.empty((0, 3)), np.empty(0, dtype=bool), ()))
            continue
        pose, flatness = screen_of_dots(network, control_points, setup, seen_from, name)
        frames[k], bows[k] = pose, flatness.chosen.coefficients[3:]
        scatter[k] = flatness.chosen.scatter_m
        off[control_points[~flatness.chosen.used]] = True
        if flatness.chosen.bent:
            bent.add(k)
        results.append(ScreenResult(flatness, np.empty((0, 3)), flatness.chosen.used, tuple(control_points.tolist())))
    complete = replace(
        network,
        surface_scatter_m=scatter,
        off_surface=off,
        bent=frozenset(bent),
        screen_priors=(*network.screen_priors, *priors),
    )
    return complete, frames, bows, results


def _board_on(network: Network, screen: int | None) -> int | None:
    """The placement of the first board fixed to a screen, which then defines the world."""
    if screen is None or network.fixed is None:
        return None
    mine = np.flatnonzero(network.fixed.screen_of == screen)
    return int(network.fixed.placement_of[mine[0]]) if mine.size else None


def screen_of_dots(
    network: Network, control_points: Ints, setup: ScreenSetup, seen_from: Array | None, name: str
) -> tuple[Pose, Flatness]:
    """A screen's frame and flatness from its surveyed dots alone.

    Raises:
        ValueError: the dots do not determine its plane.
    """
    xyz, C = network.control_points.xyz[control_points], network.control_points.covariance[control_points]
    count = len(control_points)
    if count < 3:
        raise ValueError(f"screen {name!r}: {count} surveyed dots, expected 3 or more; 8 show whether it is flat")
    s = np.linalg.svd(xyz - xyz.mean(axis=0), compute_uv=False)
    if s[1] < 0.02 * s[0]:
        raise ValueError(
            f"screen {name!r}: its {count} dots are collinear within {1e3 * s[1] / np.sqrt(count):.3g} mm;"
            " a plane requires dots off that line"
        )
    if setup.frame_points is None:
        frame = frame_of_extent(xyz, seen_from)
    else:
        o, x, y = (network.control_points.xyz[i] for i in setup.frame_points)
        frame = frame_of_dots(xyz, o, x, y, np.array(setup.origin_at))
    # Repeated in the frame of the chosen surface, whose tilt is not affected by dots off the screen.
    flatness = assess_flatness(*_heights(frame, xyz, C), setup.bow, setup.scatter_m)
    frame = moved_to_surface(frame, flatness.chosen)
    return frame, assess_flatness(*_heights(frame, xyz, C), setup.bow, setup.scatter_m)


def facing(scan: Scan, seen_from: Array | None) -> Scan:
    """The scan with its z axis towards a point (3,), world: rotated by 180 deg about its y axis if necessary."""
    pose = scan.world_from_screen
    if seen_from is None or pose.rotation[:, 2] @ (seen_from - pose.translation) >= 0:
        return scan
    half = np.array([-1.0, 1.0, -1.0])
    # z' = -z and x' = -x: h, p, q, a, b, c become -h, p, -q, -a, b, -c.
    signs = np.array([-1.0, 1.0, -1.0, -1.0, 1.0, -1.0])
    of_errors = np.concatenate([np.ones(3), half, half])

    def turned(surface: Surface) -> Surface:
        C = surface.covariance * np.outer(signs, signs)
        return replace(surface, coefficients=signs * surface.coefficients, covariance=C, heights_m=-surface.heights_m)

    f = scan.flatness
    return replace(
        scan,
        world_from_screen=Pose(pose.rotation * half, pose.translation),
        flatness=replace(
            f, flat=turned(f.flat), bent=None if f.bent is None else turned(f.bent), chosen=turned(f.chosen)
        ),
        covariance=scan.covariance * np.outer(of_errors, of_errors),
        xyz=scan.xyz * half,
    )


def moved_to_surface(frame: Pose, surface: Surface) -> Pose:
    """The frame shifted along its normal and tilted so that it is tangent to the surface at its origin."""
    h, p, q = surface.coefficients[:3]
    return frame.plus(np.concatenate([frame.rotation[:, 2] * h, [q, -p, 0.0]]))


def pose_covariance(frame: Pose, surface: Surface) -> Array:
    """(9, 9): covariance of the errors of a frame in a surface, and of the surface's bow; 0 rows for a plane.

    Within the plane the frame is fixed by definition, with the sigma `GAUGE`.
    """
    J = np.zeros((9, 6))
    J[:3, 0] = frame.rotation[:, 2]
    J[3, 2], J[4, 1] = 1.0, -1.0
    J[6:, 3:] = np.eye(3)
    C = J @ surface.covariance @ J.T
    held = np.zeros((9, 3))
    held[:3, :2] = frame.rotation[:, :2]
    held[5, 2] = 1.0
    return C + GAUGE**2 * held @ held.T


def _heights(frame: Pose, xyz: Array, C: Array) -> tuple[Array, Array]:
    """Points in a frame, and the sigmas of their heights."""
    n = frame.rotation[:, 2]
    return frame.inverse().apply(xyz), np.sqrt(np.einsum("i,nij,j->n", n, C, n))


def _scan_prior(screen: int, scan: Scan) -> Prior:
    bow = scan.flatness.chosen.coefficients[3:]
    poses = Poses.of([scan.world_from_screen])
    if not scan.flatness.chosen.bent:
        return Prior((("screens", screen),), (poses,), scan.covariance[:6, :6])
    return Prior((("screens", screen), ("bow", screen)), (poses, Vectors(bow[None])), scan.covariance)


def _choose(found: CameraOnDots, near: ApproximatePosition | None) -> ResectedPose:
    """The best pose, of those near the approximate position if there is one."""
    if near is None:
        return found.poses[0]
    return min(found.poses, key=lambda p: (distance_from(p, near) > near.within_m, -int(p.inliers.sum()), p.rms_px))


def distance_from(place: ResectedPose, near: ApproximatePosition) -> float:
    """Distance, m, of a pose's camera centre from the approximate position."""
    return float(np.linalg.norm(place.camera_from_world.inverse().translation - near.position_m))


def _second_pose(
    found: CameraOnDots, chosen: ResectedPose | None, near: ApproximatePosition | None
) -> ResectedPose | None:
    if chosen is None or len(found.poses) < 2:
        return None
    other = found.poses[1] if found.poses[0] is chosen else found.poses[0]
    if near is not None and distance_from(other, near) > near.within_m >= distance_from(chosen, near):
        return None
    return other if other.rms_px < _RULED_OUT * max(chosen.rms_px, 0.05) else None


def _in_final_frame(result: ScreenResult, network: Network, fit: NetworkFit, screen: int) -> ScreenResult:
    if not result.control_points:
        return result
    world_from_screen = list(fit.rig.screens.values())[screen].world_from_screen
    xyz = world_from_screen.inverse().apply(network.control_points.xyz[list(result.control_points)])
    return replace(result, xyz=xyz)
