"""Screens and cameras from what was measured of them: starts, frames, flatness, then the one adjustment of all."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from calibration.least_squares.parameter_blocks import Poses, Vectors
from calibration.least_squares.priors import Prior
from calibration.screens.flatness import Flatness, Surface, judge_flatness
from calibration.screens.network import Network, NetworkFit, adjust
from calibration.screens.network_start import CameraOnDots, boards_seen, camera_on_dots, chain, start_of
from calibration.screens.places import Place
from calibration.screens.screen_frame import frame_of_dots, frame_of_extent
from geometry.arrays import Array, Bools, Ints
from geometry.pose import Pose

WITHIN_PX = 8.0  # how far off its place a right dot's pixel may lie in a start: lenses are known, dots not mixed up
GAUGE = 1e-6  # m and rad: to which the axes of a screen are held within its plane, as in FrameTerm
_NEARER_TO_THE_LINE = 3.0  # the second pose of a plane is no rival where its misfit is so many times as large


@dataclass(frozen=True, slots=True)
class Scan:
    """A screen's surface from a scanned cloud of points, in world."""

    world_from_screen: Pose
    flatness: Flatness
    covariance: Array  # (9, 9): of the error of world_from_screen and of the bow; bow rows 0 where it is flat
    xyz: Array  # (m, 3), m: the points of the flatness map, in the frame of world_from_screen
    size_m: tuple[float, float]  # extent of what lies on the plane
    words: str = ""  # how many points, how many of them on the plane


@dataclass(frozen=True, slots=True)
class ScreenSetup:
    """How one screen is to be described."""

    frame_dots: tuple[int, int, int] | None = None  # dots: origin, towards x, on y's side
    origin_at: tuple[float, float] = (0.0, 0.0)  # m: where the first of them lies in the screen's frame
    bow: str = "auto"  # auto, always or never
    scatter_m: float | None = None  # of the surface, where known
    scan: Scan | None = None


@dataclass(frozen=True, slots=True)
class Near:
    """Where a camera stands by tape measure."""

    position_m: Array  # (3,), world
    within_m: float


@dataclass(frozen=True, slots=True)
class ScreenResult:
    """What is known of one screen's surface, apart from its pose."""

    flatness: Flatness | None  # None: from a fixed board alone
    xyz: Array  # (m, 3), m: the points that it was judged by, in the screen's final frame; m = 0 without
    used: Bools  # (m,)
    dots: tuple[int, ...]  # which dots these are; empty for a scan


@dataclass(frozen=True, slots=True)
class ScreensResult:
    """All of it."""

    network: Network
    fit: NetworkFit
    screens: tuple[ScreenResult, ...]
    on_dots: Mapping[int, CameraOnDots] = field(default_factory=dict)
    rivals: Mapping[int, Place] = field(default_factory=dict)  # camera -> a second pose that fits nearly as well


def calibrate(
    network: Network,
    setups: Sequence[ScreenSetup],
    near: Mapping[int, Near] | None = None,
    held_screen: int | None = None,
    held_camera: int | None = None,
) -> ScreensResult:
    """Poses of all cameras and screens, their bows where needed, and the joint covariance.

    setups: one per screen. near: camera -> where it stands roughly, which chooses between two poses. Where there is no
    survey, the world is the frame that held_screen gets from the board fixed to it, or held_camera's. Raises
    NotConnectedError, AdjustmentError, or ValueError where dots cannot tell a screen's plane.
    """
    near = {} if near is None else near
    on_dots = {c: camera_on_dots(network, c, WITHIN_PX) for c in range(len(network.rig.cameras))}
    chosen = {c: _choose(found, near.get(c)) for c, found in on_dots.items() if found.places}
    boards = boards_seen(network, WITHIN_PX)
    surveyed = bool(chosen) or (bool(np.any(network.dots.screen_of >= 0)) and not boards)
    problems = {c: found.problem for c, found in on_dots.items()}
    placed = {c: p.camera_from_world for c, p in chosen.items()}
    chained = chain(network, placed, boards, held_screen, held_camera, problems)
    observed = [c.screen for c in network.rig.cameras.values()]
    frames: dict[int, Pose] = {}
    results: list[ScreenResult] = []
    bows = np.zeros((len(setups), 3))
    scatter: dict[int, float] = {}
    off = np.zeros(len(network.dots), dtype=bool)
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
        dots = np.flatnonzero(network.dots.screen_of == k)
        if not len(dots):
            results.append(ScreenResult(None, np.empty((0, 3)), np.empty(0, dtype=bool), ()))
            continue
        pose, flatness = screen_of_dots(network, dots, setup, seen_from, name)
        frames[k], bows[k] = pose, flatness.chosen.coefficients[3:]
        scatter[k] = flatness.chosen.scatter_m
        off[dots[~flatness.chosen.used]] = True
        if flatness.chosen.bent:
            bent.add(k)
        results.append(ScreenResult(flatness, np.empty((0, 3)), flatness.chosen.used, tuple(dots.tolist())))
    complete = replace(
        network,
        surface_scatter_m=scatter,
        off_surface=off,
        bent=frozenset(bent),
        screen_priors=(*network.screen_priors, *priors),
    )
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
    rivals = {
        c: r for c, found in on_dots.items() for r in [_rival(found, chosen.get(c), near.get(c))] if r is not None
    }
    return ScreensResult(complete, fit, tuple(results), on_dots, rivals)


def _board_on(network: Network, screen: int | None) -> int | None:
    """The place of the first board that is fixed to a screen; its frame, laid on the screen, is then the world's."""
    if screen is None or network.fixed is None:
        return None
    mine = np.flatnonzero(network.fixed.screen_of == screen)
    return int(network.fixed.placement_of[mine[0]]) if mine.size else None


def screen_of_dots(
    network: Network, dots: Ints, setup: ScreenSetup, seen_from: Array | None, name: str
) -> tuple[Pose, Flatness]:
    """A screen's frame and flatness from its surveyed dots alone. ValueError where they cannot tell its plane."""
    xyz, C = network.dots.xyz[dots], network.dots.covariance[dots]
    if len(dots) < 3:
        raise ValueError(f"screen {name!r}: {len(dots)} surveyed dots, expected 3 or more; 8 show whether it is flat")
    s = np.linalg.svd(xyz - xyz.mean(axis=0), compute_uv=False)
    if s[1] < 0.02 * s[0]:
        raise ValueError(
            f"screen {name!r}: its {len(dots)} dots lie on one line, within {1e3 * s[1] / np.sqrt(len(dots)):.3g} mm;"
            " a plane needs dots off that line"
        )
    if setup.frame_dots is None:
        frame = frame_of_extent(xyz, seen_from)
    else:
        o, x, y = (network.dots.xyz[i] for i in setup.frame_dots)
        frame = frame_of_dots(xyz, o, x, y, np.array(setup.origin_at))
    # Twice, so that the frame lies in the surface that was chosen and dots off the screen no longer tilt it.
    flatness = judge_flatness(*_heights(frame, xyz, C), setup.bow, setup.scatter_m)
    frame = laid_on(frame, flatness.chosen)
    return frame, judge_flatness(*_heights(frame, xyz, C), setup.bow, setup.scatter_m)


def facing(scan: Scan, seen_from: Array | None) -> Scan:
    """The scan with its z axis towards a point (3,), world: turned by half a turn about its y axis where need be."""
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


def laid_on(frame: Pose, surface: Surface) -> Pose:
    """The frame moved along its normal and tilted so that it lies in the surface at its origin."""
    h, p, q = surface.coefficients[:3]
    return frame.plus(np.concatenate([frame.rotation[:, 2] * h, [q, -p, 0.0]]))


def pose_covariance(frame: Pose, surface: Surface) -> Array:
    """(9, 9): of the error of a frame that lies in a surface, and of the surface's bow; 0 rows for no bow.

    Within the plane the frame is held by definition, to `GAUGE`.
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


def _choose(found: CameraOnDots, near: Near | None) -> Place:
    """The place that fits best, among those near enough where something is known."""
    if near is None:
        return found.places[0]
    return min(found.places, key=lambda p: (distance_from(p, near) > near.within_m, -int(p.fits.sum()), p.rms_px))


def distance_from(place: Place, near: Near) -> float:
    """How far a place is from where the camera stands, m."""
    return float(np.linalg.norm(place.camera_from_world.inverse().translation - near.position_m))


def _rival(found: CameraOnDots, chosen: Place | None, near: Near | None) -> Place | None:
    if chosen is None or len(found.places) < 2:
        return None
    other = found.places[1] if found.places[0] is chosen else found.places[0]
    if near is not None and distance_from(other, near) > near.within_m >= distance_from(chosen, near):
        return None
    return other if other.rms_px < _NEARER_TO_THE_LINE * max(chosen.rms_px, 0.05) else None


def _in_final_frame(result: ScreenResult, network: Network, fit: NetworkFit, screen: int) -> ScreenResult:
    if not result.dots:
        return result
    world_from_screen = list(fit.rig.screens.values())[screen].world_from_screen
    xyz = world_from_screen.inverse().apply(network.dots.xyz[list(result.dots)])
    return replace(result, xyz=xyz)
