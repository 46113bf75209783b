"""Bundle adjustment of cameras and screens with surveyed control points, boards and the screens' surfaces.

Source: Triggs et al. (2000), "Bundle adjustment: a modern synthesis"; the factor on the sigmas, if the residuals are
larger than stated, is geodesy's a-posteriori variance factor (Foerstner and Wrobel 2016, Photogrammetric Computer
Vision, eq. 4.91). Excluded observations of control points get their probable cause.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.special import chdtrc

from calibration.least_squares.adjustment import (
    Adjusted,
    At,
    Cauchy,
    Poses,
    Prior,
    Stack,
    Term,
    Values,
    Vectors,
    independent,
    solve,
)
from calibration.screens.flatness import smallest_scatter
from calibration.terms.corners import CornerTerm
from calibration.terms.rig_blocks import named_covariance, rig_of, stacks_of
from calibration.terms.surveyed import (
    BoardOnScreenTerm,
    FrameTerm,
    PointTerm,
    SurfaceTerm,
    SurveyTerm,
    array_of,
    picked,
    whitening,
)
from geometry.arrays import Array, Bools, Ints, symmetric
from geometry.camera import FISHEYE, Camera
from geometry.planes import intersect_plane
from geometry.pose import Pose
from geometry.rig import Rig, Screen
from geometry.uncertainty.rig_uncertainty import RigCovariance

# The kinds of what is stated, named as in reports.
LENSES, SURVEY, SURFACES = "lens calibrations", "survey", "screen surfaces"
FIXED, SCANS, FLAT_BOARDS, FRAMES = "boards on screens", "scans", "flatness of boards", "screen axes"
OUTLIER_SIGMAS = 5.0  # in two dimensions one correct point of 270 000 exceeds it
WARP_SIGMA_M = 1e-3  # sigma of a board's bend at its edge
SIGNIFICANT = 0.001  # p-value of chi-square below which the sigmas are increased


@dataclass(frozen=True, slots=True)
class ControlPoints:
    """Surveyed control points: p of them."""

    names: tuple[str, ...]
    xyz: Array  # (p, 3), m, world
    covariance: Array  # (p, 3, 3), m^2
    screen_of: Ints  # (p,): index of the screen on which a point lies; -1: none

    def __len__(self) -> int:
        return len(self.names)


@dataclass(frozen=True, slots=True)
class PointObservations:
    """Observations of control points in pictures: n of them."""

    camera_of: Ints  # (n,)
    point_of: Ints  # (n,)
    pixels: Array  # (n, 2)
    sigma_px: Array  # (n,), of each coordinate

    def __len__(self) -> int:
        return len(self.pixels)


@dataclass(frozen=True, slots=True)
class Network:
    """All measurements. The rig gives cameras with their lenses, and screens; its poses are not used."""

    rig: Rig
    control_points: ControlPoints
    point_observations: PointObservations
    corners: CornerTerm | None = None  # of boards that were carried about, and of boards fixed to screens
    placements: tuple[str, ...] = ()  # names of the boards' positions, in the numbering of the corners
    fixed: BoardOnScreenTerm | None = None
    surface_scatter_m: Mapping[int, float] = field(default_factory=dict)  # screen -> its scatter, if it has dots
    off_surface: Bools | None = None  # (p,): control points assigned to a screen that do not lie on it
    bent: frozenset[int] = frozenset()  # screens with a free bow
    screen_priors: tuple[Prior, ...] = ()  # of screens from scans
    lens_priors: tuple[Prior, ...] = ()
    warp_sigma_m: float = WARP_SIGMA_M  # sigma of a board's bend at its edge; 0: flat
    lens_free: Bools | None = None  # (cameras, 18): free lens parameters; None: none


@dataclass(frozen=True, slots=True)
class Start:
    """Start values of the adjustment, and the elements that fix its frame."""

    camera_from_world: Pose  # batch, one per camera
    world_from_screen: Pose  # batch, one per screen: the axes within the plane keep these directions
    world_from_board: Pose  # batch, one per placement
    bow: Array  # (screens, 3), 1/m
    held_board: int | None = None  # fixed to a screen: its pose is held if no survey defines the world


@dataclass(frozen=True, slots=True)
class NetworkFit:
    """Adjusted cameras and screens, with the joint covariance of their errors."""

    rig: Rig
    values: Values
    covariance: RigCovariance  # multiplied by the variance factor
    variance_factor: float  # 1 if the residuals are consistent with the sigmas
    dof: int
    observation_residuals_px: Array  # (n, 2): measured minus predicted
    normalised_residuals: Array  # (n,): their length in sigmas
    used: Bools  # (n,) observations that are inliers
    control_point_shifts_m: Array  # (p, 3): adjusted minus surveyed
    corners: CornerTerm | None  # the inliers, with the sigma of their residuals
    corner_errors_px: Array  # (corners, 2): measured minus predicted
    adjusted: Adjusted


def adjust(network: Network, start: Start) -> NetworkFit:
    """The adjustment of all measurements.

    Observations and corners more than 5 sigmas from the prediction are excluded; corners are weighted by the scatter of
    their residuals. Raises AdjustmentError: the start is too far from the solution, or a parameter is not determined.
    """
    values, free, at = _unknowns(network, start)
    corners = None if network.corners is None else _weighted_corners(network, start, values, free)
    rest = _other_terms(network, start, corners)
    used = np.ones(len(network.point_observations), dtype=bool)
    robust = solve(values, [point_term(network, used, Cauchy()), *rest], free)
    used = _inliers(network, robust.values, used)
    found = solve(robust.values, [point_term(network, used), *rest], free)
    for _ in range(5):
        now = _inliers(network, found.values, used)
        if np.array_equal(now, used):
            break
        used = now
        found = solve(found.values, [point_term(network, used), *rest], free)
    return _fit(network, found, at, used, corners)


def _unknowns(network: Network, start: Start) -> tuple[Values, dict[str, bool | Bools], list[At]]:
    rig = network.rig
    values: dict[str, Stack] = dict(stacks_of(rig))
    values["cameras"], values["screens"] = Poses(start.camera_from_world), Poses(start.world_from_screen)
    values["bow"] = Vectors(start.bow)
    values["points"] = Vectors(network.control_points.xyz)
    values["boards"] = Poses(start.world_from_board)
    count = 0 if network.corners is None else int(network.corners.board.max(initial=-1)) + 1
    values["warp"] = Vectors(np.zeros((count, 3)))
    if network.corners is not None and network.corners.areas_px2 is not None:
        values["radius"] = Vectors(network.corners.radii_by_areas(values)[:, None])
    n_cameras, n_screens = len(rig.cameras), len(rig.screens)
    bow = np.zeros((n_screens, 3), dtype=bool)
    bow[sorted(network.bent)] = True
    boards = np.ones((len(start.world_from_board.translation), 6), dtype=bool)
    if start.held_board is not None:
        boards[start.held_board] = False
    lens = np.zeros((n_cameras, 18), dtype=bool) if network.lens_free is None else network.lens_free
    free: dict[str, bool | Bools] = {
        "cameras": True,
        "screens": True,
        "bow": bow,
        "points": True,
        "boards": boards,
        "warp": network.warp_sigma_m > 0,
        "intrinsics": lens,
    }
    at: list[At] = [(s, i) for i in range(n_cameras) for s in ("intrinsics", "cameras")]
    at = [a for a in at if a[0] == "cameras" or lens[a[1]].any()]
    at += [(s, i) for i in range(n_screens) for s in ("screens", "bow") if s == "screens" or i in network.bent]
    return values, free, at


def _other_terms(network: Network, start: Start, corners: CornerTerm | None) -> list[Term]:
    terms = stated_terms(network, start.world_from_screen, corners)
    first = [terms.pop(kind, ()) for kind in (LENSES, SCANS, SURVEY, SURFACES, FRAMES)]
    of_corners = () if corners is None else (corners,)
    return [t for some in (*first, of_corners, *terms.values()) for t in some]


def stated_terms(network: Network, world_from_screen: Pose, corners: CornerTerm | None) -> dict[str, tuple[Term, ...]]:
    """The terms that hold what is stated of the network, by kind; outliers are not searched in them.

    world_from_screen: the screens' axes keep these directions within their planes.
    """
    control_points = network.control_points
    every = np.arange(len(control_points))
    out: dict[str, tuple[Term, ...]] = {}
    if len(control_points):
        out[SURVEY] = (SurveyTerm(every, control_points.xyz, whitening(control_points.covariance)),)
        on = control_points.screen_of >= 0
        if network.off_surface is not None:
            on &= ~network.off_surface
        scatter = np.array(
            [smallest_scatter(network.surface_scatter_m.get(int(s), 0.0)) for s in control_points.screen_of]
        )
        if on.any():
            out[SURFACES] = (SurfaceTerm(control_points.screen_of[on], every[on], scatter[on]),)
    if corners is not None:
        out[FLAT_BOARDS] = tuple(_flat_boards(corners, network.warp_sigma_m))
    if network.fixed is not None:
        out[FIXED] = (network.fixed,)
    if network.screen_priors:
        out[SCANS] = network.screen_priors
    if network.lens_priors:
        out[LENSES] = network.lens_priors
    if len(world_from_screen.translation):
        out[FRAMES] = (FrameTerm(np.arange(len(world_from_screen.translation)), world_from_screen),)
    return out


def _flat_boards(corners: CornerTerm, sigma_m: float) -> Sequence[Prior]:
    """The prior that boards are flat to about `sigma_m` at their edges; their bend is estimated."""
    if sigma_m == 0:
        return []
    count = int(corners.board.max(initial=-1)) + 1
    half = np.array([np.max(np.abs(corners.from_middle[corners.board == b]), initial=1e-2) for b in range(count)])
    sigmas = np.repeat((sigma_m / half**2)[:, None], 3, axis=1)
    return independent("warp", Vectors(np.zeros((count, 3))), sigmas)


def point_term(network: Network, used: Bools | slice = slice(None), loss: Cauchy | None = None) -> PointTerm:
    """The observations of the control points, or some of them."""
    s = network.point_observations
    whiten = np.eye(2) / s.sigma_px[used, None, None]
    return PointTerm(s.camera_of[used], s.point_of[used], s.pixels[used], whiten, fisheye(network.rig), loss)


def fisheye(rig: Rig) -> Bools:
    """Which cameras have a fisheye lens."""
    return np.array([c.lens == FISHEYE for c in rig.cameras.values()], dtype=bool)


def observation_residuals(network: Network, values: Values) -> Array:
    """Measured minus predicted pixel (n, 2) of all observations, with control points at their SURVEYED positions.

    Not at the adjusted ones: a point seen by one camera only follows a wrong pixel as far as its survey sigma allows,
    which would conceal the error. inf where there is no projection.
    """
    s = network.point_observations
    cameras = list(rig_of(network.rig, values).cameras.values())
    out = np.full((len(s), 2), np.inf)
    for k, camera in enumerate(cameras):
        mine = np.flatnonzero(s.camera_of == k)
        errors = s.pixels[mine] - camera.project(network.control_points.xyz[s.point_of[mine]])
        out[mine] = np.where(np.isfinite(errors), errors, np.inf)
    return out


def normalised_residuals(network: Network, values: Values) -> Array:
    """Length of each observation's error in sigmas (n,), of pixel and survey combined."""
    s = network.point_observations
    errors = observation_residuals(network, values)
    term = point_term(network)
    at_survey = {**values, "points": Vectors(network.control_points.xyz)}
    line = term.linearise(at_survey)
    J = next(p for p in line.parts if p.stack == "points").jacobian * s.sigma_px[:, None, None]
    C = (
        J @ network.control_points.covariance[s.point_of] @ np.swapaxes(J, -1, -2)
        + np.eye(2) * s.sigma_px[:, None, None] ** 2
    )
    safe = np.isfinite(errors).all(axis=1) & np.isfinite(C).all(axis=(1, 2))
    out = np.full(len(s), np.inf)
    out[safe] = np.linalg.norm((whitening(C[safe]) @ errors[safe, :, None])[..., 0], axis=1)
    return out


def _inliers(network: Network, values: Values, used: Bools) -> Bools:
    """Observations that are inliers, relative to their own scatter if it exceeds their sigmas."""
    if not len(network.point_observations):
        return used
    off = normalised_residuals(network, values)
    # The median of a two-dimensional Gaussian's length is 1.177 sigmas.
    finite = off[np.isfinite(off)]
    scale = max(1.0, float(np.median(finite)) / 1.177) if finite.size else 1.0
    return off < OUTLIER_SIGMAS * scale


def _weighted_corners(network: Network, start: Start, values: Values, free: Mapping[str, bool | Bools]) -> CornerTerm:
    """The inlier corners, with the sigma of their residuals."""
    term = replace(network.corners, loss=Cauchy()) if network.corners is not None else None
    assert term is not None
    everything = [
        point_term(network, loss=Cauchy()),
        *_other_terms(network, start, term),
    ]
    found = solve(values, everything, free)
    residuals = found.residuals[next(i for i, t in enumerate(everything) if t is term)]
    length = np.linalg.norm(residuals, axis=1)
    # The median of a two-dimensional Gaussian's length is 1.177 sigmas.
    good = length < OUTLIER_SIGMAS * float(np.median(length)) / 1.177
    # Six parameters per placement of a board, and six per further camera.
    spent = 6 * (len(network.placements) + len(network.rig.cameras) - 1)
    dof = max(2 * int(good.sum()) - spent, int(good.sum()) // 2)
    factor = max(float(np.sqrt(np.sum(residuals[good] ** 2) / dof)), 0.1)
    kept = picked(term, good)
    assert isinstance(kept, CornerTerm)
    return replace(kept, sigma_px=kept.sigma_px * factor)


def _fit(
    network: Network,
    found: Adjusted,
    at: Sequence[At],
    used: Bools,
    corners: CornerTerm | None,
) -> NetworkFit:
    rig = rig_of(network.rig, found.values)
    chi2, dof = found.chi2, found.dof
    p_fits = float(chdtrc(dof, chi2)) if dof > 0 else 1.0
    factor = chi2 / dof if dof > 0 and p_fits < SIGNIFICANT else 1.0
    named = named_covariance(rig, found.values, at, found.covariance(list(at)))  # without fixed lens parameters
    corner_errors = np.empty((0, 2)) if corners is None else corners.pixels - corners.project(found.values)
    return NetworkFit(
        rig=rig,
        values=found.values,
        covariance=RigCovariance(named.names, symmetric(named.matrix * factor)),
        variance_factor=factor,
        dof=dof,
        observation_residuals_px=observation_residuals(network, found.values),
        normalised_residuals=normalised_residuals(network, found.values)
        if len(network.point_observations)
        else np.empty(0),
        used=used,
        control_point_shifts_m=array_of(found.values, "points") - network.control_points.xyz,
        corner_errors_px=corner_errors,
        corners=corners,
        adjusted=found,
    )


_SAME_POSITION = 0.15  # tolerance of another dot's position, as a share of the distance of neighbouring dots


@dataclass(frozen=True, slots=True)
class Outlier:
    """An outlier among the observations, with its probable cause."""

    camera: str
    dot: str
    error_px: float
    error_m: Array  # (2,), on the dot's screen along its x, y; nan if the dot is not on a screen
    at_place_of: str  # the dot at this position; empty: none
    swapped: bool  # whether that dot's pixel is at this dot's position


def classify_outliers(network: Network, fit: NetworkFit) -> tuple[Outlier, ...]:
    """The observations that the adjustment excluded, with their probable cause."""
    s, control_points = network.point_observations, network.control_points
    cameras, screens = list(fit.rig.cameras.values()), list(fit.rig.screens.values())
    out: list[Outlier] = []
    for i in np.flatnonzero(~fit.used):
        camera, dot = cameras[s.camera_of[i]], int(s.point_of[i])
        everywhere = camera.project(control_points.xyz)
        distances = np.linalg.norm(everywhere - s.pixels[i], axis=1)
        distances[~np.isfinite(distances)] = np.inf
        distances[dot] = np.inf
        nearest = int(np.argmin(distances))
        spacing = np.linalg.norm(everywhere - everywhere[nearest], axis=1)
        spacing[nearest] = np.inf
        limit = max(_SAME_POSITION * float(np.nanmin(spacing)), 5 * float(s.sigma_px[i]))
        at_place_of = control_points.names[nearest] if distances[nearest] < limit else ""
        back = np.flatnonzero((s.camera_of == s.camera_of[i]) & (s.point_of == nearest) & ~fit.used)
        swapped = bool(at_place_of) and any(
            np.linalg.norm(everywhere[dot] - s.pixels[b]) < limit for b in back.tolist()
        )
        error_m = np.full(2, np.nan)
        if control_points.screen_of[dot] >= 0:
            error_m = _on_screen(camera, screens[control_points.screen_of[dot]], s.pixels[i], control_points.xyz[dot])
        error_px = float(np.linalg.norm(fit.observation_residuals_px[i]))
        out.append(Outlier(camera.name, control_points.names[dot], error_px, error_m, at_place_of, swapped))
    return tuple(out)


def _on_screen(camera: Camera, screen: Screen, pixel: Array, dot: Array) -> Array:
    origin, ray = camera.rays(pixel)
    return intersect_plane(origin, ray, screen.world_from_screen) - screen.world_from_screen.inverse().apply(dot)[:2]
