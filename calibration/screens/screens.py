"""Calibration of screens and cameras: start values, frames, flatness, then the joint adjustment and its diagnosis."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from calibration.least_squares.adjustment import AdjustmentError, Poses, Prior, Vectors
from calibration.screens.flatness import Flatness, Surface, assess_flatness, frame_of_dots, frame_of_extent
from calibration.screens.network import Network, NetworkFit, adjust
from calibration.screens.network_start import (
    CameraOnDots,
    ChainedPoses,
    NotConnectedError,
    ResectedPose,
    boards_seen,
    camera_on_dots,
    chain,
    start_of,
)
from geometry.arrays import Array, Bools, Ints, skew
from geometry.camera import Camera
from geometry.pose import Pose
from geometry.uncertainty.rig_uncertainty import BOW, POSE

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
class FittedSurface:
    """Surface of one screen, apart from its pose."""

    flatness: Flatness | None  # None: the screen has only a fixed board
    xyz: Array  # (m, 3), m: the points of the surface fit, in the screen's final frame; m = 0 without
    used: Bools  # (m,)
    control_points: tuple[int, ...]  # indices of the dots; empty for a scan


@dataclass(frozen=True, slots=True)
class FittedScreens:
    """Result of the calibration of screens and cameras."""

    network: Network
    fit: NetworkFit
    screens: tuple[FittedSurface, ...]
    # camera -> a second pose that fits nearly as well
    second_poses: Mapping[int, ResectedPose] = field(default_factory=dict)


def calibrate(
    network: Network,
    setups: Sequence[ScreenSetup],
    near: Mapping[int, ApproximatePosition] | None = None,
    held_screen: int | None = None,
) -> FittedScreens:
    """Poses of all cameras and screens, their bows where significant, and the joint covariance.

    setups: one per screen. near: camera -> approximate position, which decides between two poses. Without a survey, the
    world is the frame that held_screen gets from the board fixed to it. Raises NotConnectedError: some cameras or
    screens are not connected with the others; AdjustmentError: the adjustment fails; ValueError: the dots do not
    determine a screen's plane.
    """
    near = {} if near is None else near
    poses_by_camera = {c: camera_on_dots(network, c, WITHIN_PX) for c in range(len(network.rig.cameras))}
    chosen = {c: _choose(found, near.get(c)) for c, found in poses_by_camera.items() if found.poses}
    boards = boards_seen(network, WITHIN_PX)
    surveyed = bool(chosen) or (bool(np.any(network.control_points.screen_of >= 0)) and not boards)
    problems = {c: found.problem for c, found in poses_by_camera.items()}
    placed = {c: p.camera_from_world for c, p in chosen.items()}
    chained = chain(network, placed, boards, held_screen, problems)
    complete, frames, bows, results = _screen_starts(network, setups, chained)
    start = start_of(complete, chained, frames, bows, None if surveyed else _board_on(network, held_screen))
    fit = adjust(complete, start)
    results = [_in_final_frame(r, complete, fit, k) for k, r in enumerate(results)]
    second_poses = {
        c: r
        for c, found in poses_by_camera.items()
        for r in [_second_pose(found, chosen.get(c), near.get(c))]
        if r is not None
    }
    return FittedScreens(complete, fit, tuple(results), second_poses)


def _screen_starts(
    network: Network, setups: Sequence[ScreenSetup], chained: ChainedPoses
) -> tuple[Network, dict[int, Pose], Array, list[FittedSurface]]:
    """Frame, bow (screens, 3) and flatness of each screen with a scan or dots; and the network with their priors."""
    observed = [c.screen for c in network.rig.cameras.values()]
    frames: dict[int, Pose] = {}
    results: list[FittedSurface] = []
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
            results.append(FittedSurface(scan.flatness, scan.xyz, scan.flatness.chosen.used, ()))
            continue
        control_points = np.flatnonzero(network.control_points.screen_of == k)
        if not len(control_points):
            results.append(FittedSurface(None, np.empty((0, 3)), np.empty(0, dtype=bool), ()))
            continue
        pose, flatness = screen_of_dots(network, control_points, setup, seen_from, name)
        frames[k], bows[k] = pose, flatness.chosen.coefficients[3:]
        scatter[k] = flatness.chosen.scatter_m
        off[control_points[~flatness.chosen.used]] = True
        if flatness.chosen.bent:
            bent.add(k)
        results.append(FittedSurface(flatness, np.empty((0, 3)), flatness.chosen.used, tuple(control_points.tolist())))
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

    Raises ValueError: the dots do not determine its plane.
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


def _in_final_frame(result: FittedSurface, network: Network, fit: NetworkFit, screen: int) -> FittedSurface:
    if not result.control_points:
        return result
    world_from_screen = list(fit.rig.screens.values())[screen].world_from_screen
    xyz = world_from_screen.inverse().apply(network.control_points.xyz[list(result.control_points)])
    return replace(result, xyz=xyz)


def spot_sigmas(result: FittedScreens, screen: int) -> Array:
    """Sigma, m, of the screen's surface along its normal at its points (m,)."""
    name = list(result.network.rig.screens)[screen]
    C, names = result.fit.covariance.matrix, result.fit.covariance.names
    xyz = result.screens[screen].xyz
    if not len(xyz):
        size = result.network.rig.screens[name].size_m or (1.0, 1.0)
        xyz = np.array([[sx * size[0] / 2, sy * size[1] / 2, 0.0] for sx in (-1, 0, 1) for sy in (-1, 0, 1)])
    R = result.fit.rig.screens[name].world_from_screen.rotation
    x, y = xyz[:, 0], xyz[:, 1]
    J = np.zeros((len(xyz), len(names)))
    for k, p in enumerate(("x_m", "y_m", "z_m")):
        J[:, names.index(f"screens.{name}.{p}")] = R[k, 2]
    J[:, names.index(f"screens.{name}.rot_x_rad")] = y
    J[:, names.index(f"screens.{name}.rot_y_rad")] = -x
    for p, shape in zip(BOW, (x * x, x * y, y * y), strict=True):
        if f"screens.{name}.{p}" in names:
            J[:, names.index(f"screens.{name}.{p}")] = shape
    return np.sqrt(np.maximum(np.einsum("ni,ij,nj->n", J, C, J), 0.0))


def camera_covariance(result: FittedScreens, camera: str) -> Array:
    """The covariance (6, 6) of a camera's camera_from_world."""
    names = result.fit.covariance.names
    at = [names.index(f"cameras.{camera}.{p}") for p in POSE]
    return result.fit.covariance.matrix[np.ix_(at, at)]


def camera_sigmas(camera: Camera, covariance: Array) -> tuple[float, float]:
    """Sigmas of a camera's place in the world (m) and of its attitude (rad), RMS per axis.

    covariance (6, 6): of its camera_from_world. The place c is -R^T t: errors of t act through R^T, and R Exp(theta)
    gives c - theta x c.
    """
    centre = camera.camera_from_world.inverse().translation
    J = np.concatenate([-camera.camera_from_world.rotation.T, skew(centre)], axis=1)
    variances = np.diagonal(J @ covariance @ J.T), np.diagonal(covariance)[3:]
    place, attitude = (float(np.sqrt(np.mean(np.maximum(v, 0.0)))) for v in variances)
    return place, attitude


def pointing_sigmas_m(result: FittedScreens) -> dict[str, float]:
    """Displacement, m (1 sigma, RMS of both directions), of the centre of each camera's screen by the pose's error."""
    out = {}
    for name, camera in result.fit.rig.cameras.items():
        screen = result.fit.rig.screens[camera.screen]
        X = screen.world_from_screen.translation
        x_c = camera.camera_from_world.apply(X)
        R = camera.camera_from_world.rotation
        J = np.concatenate([np.eye(3), -R @ skew(X)], axis=1)
        across = np.eye(3) - np.outer(x_c, x_c) / (x_c @ x_c)
        moved = across @ J @ camera_covariance(result, name) @ J.T @ across.T
        out[name] = float(np.sqrt(max(np.trace(moved) / 2, 0.0)))
    return out


# Diagnosis of surveys with exchanged axes or a wrong unit, by trying changes to the survey.
#
# Pixels alone do not determine everything. Coplanar dots look like their mirror image from the other side; the scale of
# a survey is determined only by boards, a screen's size or a camera's approximate position. All mirrored surveys differ
# by a rotation only: which axes were exchanged is determined only if the world is known otherwise.

UNITS: Mapping[float, str] = {
    1e-3: "metres were expected and millimetres written",
    1e-2: "metres were expected and centimetres written",
    0.0254: "metres were expected and inches written",
    0.3048: "metres were expected and feet written",
    1e3: "the numbers were divided by 1000 too often (kilometres, or metres taken for millimetres)",
}
_UNIT_MATCH = 0.2  # tolerance of the logarithm of a ratio of sizes


def wrong_unit(extent_m: float, expected_m: float) -> str:
    """The wrong unit that explains an extent other than the expected one; empty if there is none."""
    ratio = expected_m / extent_m
    for factor, words in UNITS.items():
        if abs(np.log(ratio / factor)) < _UNIT_MATCH:
            return words
    return ""


@dataclass(frozen=True, slots=True)
class SurveyError:
    """A change to the survey that makes the measurements consistent."""

    words: str  # the correction of the survey
    factor: float  # residuals over their sigmas after the correction


def diagnose_survey(
    network: Network,
    setups: Sequence[ScreenSetup],
    near: Mapping[int, ApproximatePosition],
    held_screen: int | None,
    current: float,
    progress: Callable[[int, int], None] | None = None,
) -> list[SurveyError]:
    """Changes with which the measurements fit much better than with the survey as it is, the best first.

    current: present misfit (inf if there is no solution). progress: called with the changes tried and their number.
    """
    out = []
    changes = _changes(network)
    for done, (words, change) in enumerate(changes):
        if progress is not None:
            progress(done, len(changes))
        trial = replace(network, control_points=replace(network.control_points, xyz=change(network.control_points.xyz)))
        misfit_now = misfit(trial, setups, near, held_screen)
        if misfit_now < 0.3 * current:
            out.append(SurveyError(words, misfit_now))
    return sorted(out, key=lambda s: s.factor)


def misfit(
    network: Network, setups: Sequence[ScreenSetup], near: Mapping[int, ApproximatePosition], held_screen: int | None
) -> float:
    """Misfit of a network: residuals over sigmas, outliers and distances from approximate positions; inf on failure."""
    try:
        result = calibrate(network, setups, near, held_screen)
    except (AdjustmentError, NotConnectedError, ValueError):
        return float("inf")
    return misfit_of(result, near)


def misfit_of(result: FittedScreens, near: Mapping[int, ApproximatePosition]) -> float:
    """Misfit of a result, as in `misfit`."""
    out = float(np.sqrt(result.fit.variance_factor))
    if len(result.fit.used):
        out += 20.0 * float(np.mean(~result.fit.used))
    for c, n in near.items():
        centre = list(result.fit.rig.cameras.values())[c].camera_from_world.inverse().translation
        out += 10.0 * max(float(np.linalg.norm(centre - n.position_m)) / n.within_m - 1.0, 0.0)
    return out


def _changes(network: Network) -> list[tuple[str, Callable[[Array], Array]]]:
    """Common mistakes in a survey's columns, for the whole survey and for the dots of one screen."""
    axes = "xyz"
    out: list[tuple[str, Callable[[Array], Array]]] = []
    screens = list(network.rig.screens)
    wholes: list[tuple[str, Bools]] = [("the survey", np.ones(len(network.control_points), dtype=bool))]
    if len(screens) > 1:
        wholes += [(f"the dots of screen {n!r}", network.control_points.screen_of == k) for k, n in enumerate(screens)]
    for whose, some in wholes:
        if not some.any():
            continue
        for order in itertools.permutations(range(3)):
            if order == (0, 1, 2):
                continue
            words = f"{whose} with its columns in the order {', '.join(axes[o] for o in order)}"
            if sum(a == b for a, b in enumerate(order)) == 1:
                i, j = (k for k, o in enumerate(order) if k != o)
                words = f"{whose} with its columns {axes[i]} and {axes[j]} exchanged"
            out.append((words, _changed(some, np.eye(3)[list(order)])))
        for k in range(3):
            turned = np.diag(np.where(np.arange(3) == k, -1.0, 1.0))
            out.append((f"{whose} with the sign of {axes[k]} reversed", _changed(some, turned)))
        for factor, unit in UNITS.items():
            out.append((f"{whose} times {factor:g} ({unit})", _changed(some, factor * np.eye(3))))
    return out


def _changed(some: Bools, matrix: Array) -> Callable[[Array], Array]:
    return lambda xyz: np.where(some[:, None], xyz @ matrix.T, xyz)
