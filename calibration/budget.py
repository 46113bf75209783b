"""Error budget of a pose measured with a rig, over a grid of poses, and expected errors of a rig not yet built."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

import numpy as np

from geometry.arrays import Array, Bools, Ints, skew, symmetric
from geometry.camera import Camera, in_picture, pinhole_numbers, project_points_full
from geometry.forward_model import SpotModel
from geometry.planes import intersect_plane
from geometry.pose import Pose
from geometry.pose_solver.gauss_newton import RANK_TOLERANCE, SolveLimits
from geometry.rig import Rig, Screen
from geometry.rotations import ypr_jacobian
from geometry.uncertainty.rig_uncertainty import (
    BOW,
    DIRECTION,
    PINHOLE,
    POINT,
    POSE,
    RigCovariance,
    Sensitivity,
    distortion_names,
    rig_names,
    split_name,
)

# Error budget of a pose measured with a rig: noise, and each group of calibration errors.
#
# For the design of a rig. The pose is estimated as in geometry/pose_solver/gauss_newton.py, by least squares with the
# spots' noise and the calibration's errors weighted together: with J = d(pixels)/d(pose), S = d(pixels)/d(rig) and the
# rig's covariance C, the pixels have the covariance V = sigma^2 I + S C S^T, the estimator is
# G = (J^T V^-1 J)^-1 J^T V^-1, and the pose error is G times the error of the pixels. Source: ours; generalised least
# squares, first-order error propagation.

INTRINSICS, CAMERA_POSES, SCREEN_POSES = "camera intrinsics", "camera poses", "screen poses"
SCREEN_SHAPES, BEAM_DIRECTIONS, BEAM_POINTS = "screen shapes", "beam directions", "beam points"
GROUPS = (INTRINSICS, CAMERA_POSES, SCREEN_POSES, SCREEN_SHAPES, BEAM_DIRECTIONS, BEAM_POINTS)


def group_of(name: str) -> str:
    """The group of `GROUPS` that a rig's parameter belongs to."""
    kind, _, parameter = split_name(name)
    if kind == "cameras":
        return CAMERA_POSES if parameter in POSE else INTRINSICS
    if kind == "screens":
        return SCREEN_SHAPES if parameter in BOW else SCREEN_POSES
    return BEAM_DIRECTIONS if parameter in DIRECTION else BEAM_POINTS


@dataclass(frozen=True, slots=True)
class RigErrors:
    """Uncertainty of the p parameters of a rig, by source."""

    names: tuple[str, ...]  # (p,) as in geometry/uncertainty/rig_uncertainty.py
    covariance: Array  # (p, p)
    groups: Mapping[str, Array]  # by group (p, p): its part of the covariance; cross-covariance is not included
    moves: Array  # (p, q) joint change of the parameters by one sigma of each of q errors
    move_names: tuple[str, ...]  # (q,)
    move_sigmas: Array  # (q,) in the units of the names
    things: Sequence[tuple[str, str, Array]]  # `cameras.left`, its group, (p, p): the groups' parts by device


@dataclass(frozen=True, slots=True)
class Budget:
    """Error budgets of k poses. Covariances are of [dt (m, world), dtheta (rad, body)]; nan if not observable."""

    pixels: Array  # (k, n, 2) of the n views; nan where there is no projection
    seen: Bools  # (k, n) in the picture, not at its edge
    observable: Bools  # (k,)
    condition: Array  # (k,) condition number of J with columns of length 1; inf where not observable
    total: Array  # (k, 6, 6)
    noise: Array  # (k, 6, 6) from the spots' noise
    groups: Array  # (k, g, 6, 6) from each group alone; cross-covariance of groups is in the total only
    effects: Array  # (k, 6, q) effect of one sigma of each error alone
    things: Array  # (k, t, 6, 6) from each device's errors of one group alone


class PoseBudget:
    """Computes the budgets of poses for one rig and its errors."""

    def __init__(
        self, model: SpotModel, sensitivity: Sensitivity, errors: RigErrors, sigma_px: float, edge_px: float
    ) -> None:
        """sigma_px: of a spot's coordinates. edge_px: distance from the edge below which a spot is not visible.

        sensitivity: of the errors' names, in their order.
        """
        self._model, self._sensitivity, self._errors = model, sensitivity, errors
        self._sigma_px, self._edge_px = sigma_px, edge_px

    def of(self, poses: Pose) -> Budget:
        """The budgets of a batch (k,) of poses."""
        derivatives = self._model.derivatives(poses)
        pixels = derivatives.pixels
        seen: Bools = in_picture(pixels, self._model.image_size_px, -self._edge_px)
        k, n = seen.shape
        # A view without a visible spot does not contribute: its rows are 0, and its noise is 1.
        J = np.where(seen[..., None, None], derivatives.pose, 0.0).reshape(k, 2 * n, 6) / self._sigma_px
        S = np.where(seen[..., None, None], self._sensitivity.of(derivatives), 0.0).reshape(k, 2 * n, -1)
        S = S / self._sigma_px
        observable, condition = _rank(J)
        V = np.eye(2 * n) + S @ self._errors.covariance @ np.swapaxes(S, -1, -2)
        weighted = np.linalg.solve(V, J)  # V^-1 J
        H = symmetric(np.swapaxes(J, -1, -2) @ weighted)
        H = np.where(observable[:, None, None], H, np.eye(6))
        total: Array = np.asarray(np.linalg.inv(H), dtype=np.float64)
        G: Array = total @ np.swapaxes(weighted, -1, -2)  # (k, 6, 2n), of pixels in units of sigma_px
        K = G @ S  # (k, 6, p)
        parts = _carried(K, list(self._errors.groups.values()))
        things = _carried(K, [C for _, _, C in self._errors.things])
        blank = np.where(observable, 1.0, np.nan)[:, None, None]
        return Budget(
            pixels=pixels,
            seen=seen,
            observable=observable,
            condition=condition,
            total=symmetric(total) * blank,
            noise=G @ np.swapaxes(G, -1, -2) * blank,
            groups=parts * blank[:, None],
            effects=K @ self._errors.moves * blank,
            things=things * blank[:, None],
        )


def _carried(K: Array, covariances: Sequence[Array]) -> Array:
    """K C K^T (k, c, 6, 6) of Jacobians (k, 6, p) and covariances (p, p), which are mostly empty."""
    out = np.zeros((len(K), len(covariances), 6, 6))
    for i, C in enumerate(covariances):
        used = np.flatnonzero(C.any(axis=0))
        part = K[..., used]
        out[:, i] = part @ C[np.ix_(used, used)] @ np.swapaxes(part, -1, -2)
    return out


def _rank(J: Array) -> tuple[Bools, Array]:
    """Whether Jacobians (k, 2n, 6) have full rank, with the solver's tolerance; and their scaled condition (k,)."""
    H = np.swapaxes(J, -1, -2) @ J
    eigenvalues = np.linalg.eigvalsh(symmetric(H))
    observable: Bools = eigenvalues[:, 0] > RANK_TOLERANCE**2 * eigenvalues[:, -1]
    size = np.sqrt(np.maximum(np.diagonal(H, axis1=-2, axis2=-1), 1e-300))
    scaled = np.linalg.eigvalsh(symmetric(H / (size[:, :, None] * size[:, None, :])))
    with np.errstate(divide="ignore", invalid="ignore"):
        condition = np.sqrt(scaled[:, -1] / np.maximum(scaled[:, 0], 0.0))
    return observable, np.where(observable, condition, np.inf)


def worst_direction(covariance: Array) -> tuple[Array, Array]:
    """The largest sigma (k,) of covariances (k, 3, 3), and its direction (k, 3), a unit vector; nan for nan.

    The direction's largest coordinate is positive.
    """
    bad = np.asarray(np.isnan(covariance).any(axis=(-2, -1)))
    values, vectors = np.linalg.eigh(np.where(bad[:, None, None], np.eye(3), symmetric(covariance)))
    direction = vectors[..., -1]
    largest = np.take_along_axis(direction, np.argmax(np.abs(direction), axis=-1)[:, None], axis=-1)
    direction = direction * np.where(largest < 0, -1.0, 1.0)
    sigma = np.sqrt(np.maximum(values[:, -1], 0.0))
    return np.where(bad, np.nan, sigma), np.where(bad[:, None], np.nan, direction)


def along(covariances: Array, directions: Array) -> Array:
    """Variances (k, ...) of covariances (k, ..., 3, 3) along directions (k, 3)."""
    return np.einsum("ki,k...ij,kj->k...", directions, covariances, directions)


NOISE = "noise"
MEASURED, VAGUE, NOT_OBSERVABLE = "measured", "vague", "not observable"
_POSES_AT_ONCE = 1000  # limits the memory: 6 MB for 6 views and 60 parameters, 200 MB for 40 and 300
AXES = ("x_m", "y_m", "z_m", "yaw_deg", "pitch_deg", "roll_deg")


class GridOptions(Protocol):
    """The grid of poses and the noise of a spot."""

    @property
    def sigma_px(self) -> float:
        """Sigma of a spot's coordinates."""

    @property
    def edge_px(self) -> float:
        """Distance from the edge of the picture below which a spot is not visible."""

    def coordinates(self) -> Array:
        """The grid (k, 6): x, y, z (m), yaw, pitch, roll (deg)."""


Options = TypeVar("Options", bound=GridOptions)


@dataclass(frozen=True, slots=True)
class GridPlan(Generic[Options]):
    """k poses of a grid, n views, c contributors (noise, then groups of calibration errors), q errors of the rig.

    Sigmas are along `AXES`: m, deg. nan where a pose is not observable.
    """

    rig: Rig
    options: Options
    errors: RigErrors
    sources: Mapping[str, str]  # of each group: `rig file` or `assumed`
    views: tuple[tuple[str, str], ...]  # (n,) camera, spot
    contributors: tuple[str, ...]  # (c,)
    coordinates: Array  # (k, 6) x, y, z (m), yaw, pitch, roll (deg)
    status: Ints  # (k,) index into STATUS
    seen: Bools  # (k, n)
    margin_px: Array  # (k, n) distance to the edge of the picture, negative outside; nan without projection
    closest_px: Array  # (k,) smallest distance of two visible spots of one camera; inf if no camera sees two
    condition: Array  # (k,)
    sigma: Array  # (k, 6) total
    parts: Array  # (k, c, 6) from each contributor alone
    worst: Array  # (k, 2) largest sigma of any direction: position (m), attitude (deg)
    worst_axis: Array  # (k, 2, 3) its direction: in world, and in body
    worst_parts: Array  # (k, c, 2) variances along it, m^2 and deg^2; covariance between groups is not in their sum
    effect_median: Array  # (q, 6) of one sigma of each error, over the observable poses
    effect_largest: Array  # (q, 6)
    thing_median: Array  # (t, 6) of all errors of one camera, screen or beam in one group, over observable poses
    thing_largest: Array  # (t, 6)

    @property
    def observable(self) -> Bools:
        """(k,) whether the pose is observable."""
        return np.asarray(self.status != STATUS.index(NOT_OBSERVABLE))

    @property
    def measured(self) -> Bools:
        """(k,) whether a run would report the pose as measured."""
        return np.asarray(self.status == STATUS.index(MEASURED))


STATUS = (MEASURED, VAGUE, NOT_OBSERVABLE)


def plan_grid(rig: Rig, errors: RigErrors, sources: Mapping[str, str], options: Options) -> GridPlan[Options]:
    """Visibility and error budget at every pose of the grid."""
    model = SpotModel.of(rig)
    budget = PoseBudget(model, Sensitivity(rig, model, errors.names), errors, options.sigma_px, options.edge_px)
    coordinates = options.coordinates()
    starts = range(0, len(coordinates), _POSES_AT_ONCE)
    parts = [coordinates[start : start + _POSES_AT_ONCE] for start in starts]
    chunks = [_of_chunk(model, budget.of(poses_of(part)), part) for part in parts]
    columns = {name: np.concatenate([c[name] for c in chunks]) for name in chunks[0]}
    effects, things = columns.pop("effects"), columns.pop("things")
    solved = columns["status"] != STATUS.index(NOT_OBSERVABLE)
    return GridPlan(
        rig=rig,
        options=options,
        errors=errors,
        sources=dict(sources),
        views=model.views,
        contributors=(NOISE, *errors.groups),
        coordinates=coordinates,
        effect_median=_over_poses(np.median, effects[solved]).T,
        effect_largest=_over_poses(np.max, effects[solved]).T,
        thing_median=_over_poses(np.median, things[solved]),
        thing_largest=_over_poses(np.max, things[solved]),
        **columns,
    )


def poses_of(coordinates: Array) -> Pose:
    """world_from_body (k,) of coordinates (k, 6): x, y, z (m), yaw, pitch, roll (deg)."""
    return Pose.from_ypr(np.deg2rad(coordinates[:, 3:]), coordinates[:, :3])


def axes_jacobian(rotation: Array) -> Array:
    """d(`AXES`)/d[dt, dtheta] (..., 6, 6), m and deg, at rotations (..., 3, 3) world from body."""
    out = np.zeros((*rotation.shape[:-2], 6, 6))
    out[..., :3, :3] = np.eye(3)
    out[..., 3:, 3:] = np.rad2deg(ypr_jacobian(rotation))
    return out


def _of_chunk(model: SpotModel, b: Budget, coordinates: Array) -> dict[str, Array]:
    """The columns of a plan for some of its poses, with effects (k, 6, q) and things (k, t, 6) in single precision."""
    to_axes = axes_jacobian(poses_of(coordinates).rotation)
    parts = np.concatenate([b.noise[:, None], b.groups], axis=1)
    axes_of_parts = to_axes[:, None] @ parts @ np.swapaxes(to_axes, -1, -2)[:, None]
    axes_of_total = to_axes @ b.total @ np.swapaxes(to_axes, -1, -2)
    worst_m, axis_m = worst_direction(b.total[:, :3, :3])
    worst_rad, axis_rad = worst_direction(b.total[:, 3:, 3:])
    effects = np.abs(to_axes @ b.effects)
    things = _root_of_diagonal(to_axes[:, None] @ b.things @ np.swapaxes(to_axes, -1, -2)[:, None])  # (k, t, 6)
    limits = SolveLimits()
    vague = (worst_m > limits.max_sigma_m) | (worst_rad > limits.max_sigma_rad)
    return {
        "status": np.where(b.observable, np.where(vague, 1, 0), 2),
        "seen": b.seen,
        "margin_px": np.min(np.minimum(b.pixels + 0.5, model.image_size_px - 0.5 - b.pixels), axis=-1),
        "closest_px": _closest(b.pixels, b.seen, model.camera_of),
        "condition": b.condition,
        "sigma": _root_of_diagonal(axes_of_total),
        "parts": _root_of_diagonal(axes_of_parts),
        "worst": np.stack([worst_m, np.rad2deg(worst_rad)], axis=-1),
        "worst_axis": np.stack([axis_m, axis_rad], axis=1),
        "worst_parts": np.stack(
            [along(parts[..., :3, :3], axis_m), np.rad2deg(np.rad2deg(along(parts[..., 3:, 3:], axis_rad)))], axis=-1
        ),
        "effects": effects.astype(np.float32),
        "things": things.astype(np.float32),
    }


def _over_poses(of: Callable[..., Array], values: Array) -> Array:
    """The median or the maximum over the first axis; nan if there is no pose."""
    if not len(values):
        return np.full(values.shape[1:], np.nan)
    return of(values, axis=0).astype(float)


def _root_of_diagonal(covariances: Array) -> Array:
    return np.sqrt(np.maximum(np.diagonal(covariances, axis1=-2, axis2=-1), 0.0))


def _closest(pixels: Array, seen: Bools, camera_of: Ints) -> Array:
    """Smallest distance (k,), px, of two visible spots in the picture of a camera."""
    out = np.full(len(pixels), np.inf)
    for camera in np.unique(camera_of):
        views = np.flatnonzero(camera_of == camera)
        for a, first in enumerate(views):
            for second in views[a + 1 :]:
                gap = np.linalg.norm(pixels[:, first] - pixels[:, second], axis=-1)
                out = np.where(seen[:, first] & seen[:, second], np.fmin(out, gap), out)
    return out


# Expected calibration errors of a rig that has not been built yet.
#
# The usual procedure is assumed: the lens of each camera is calibrated with a board, then the camera's pose by
# resection on surveyed dots of its own screen, with the calibrated lens. The error of a lens is therefore correlated
# with that of the pose, which compensates for most of it: of the effect of a wrong principal point on the attitude, a
# fortieth remains. Screens, beams and lenses of different cameras have independent errors. Source: ours; first-order
# propagation.

_FEWEST_DOTS = 4  # required for a resection: three dots allow four poses


@dataclass(frozen=True, slots=True)
class ExpectedErrors:
    """Standard deviations reached by a careful calibration."""

    focal_relative: float = 2e-4  # of fx and of fy: 25 tilted boards with corners to 0.1 px
    centre_px: float = 0.3  # of cx and of cy: the same boards
    distortion_px: float = 0.2  # all distortion coefficients together, at the picture's corners: the same boards
    dots: int = 20  # on a screen, evenly spread over the camera's picture, for the camera's pose
    dot_px: float = 0.1  # of a dot's centre in the picture
    dot_survey_m: float = 0.0002  # of a dot's position, per axis: total station
    camera_position_m: float = 0.002  # per axis, only for a camera without dots on its screen: by measuring tape
    camera_rotation_deg: float = 0.05  # likewise: by a board
    screen_position_m: float = 0.0001  # per axis: a plane through 20 surveyed dots of 0.2 mm, with some flatness error
    screen_rotation_deg: float = 0.004  # per axis: the same dots over 3 m
    beam_direction_arcsec: float = 15.0  # per axis across the beam: 40 stand poses, spots to 0.2 mm
    beam_point_m: float = 0.0001  # per axis across the beam: the same


def expected_errors(
    rig: Rig, expected: ExpectedErrors, stated: RigCovariance | None = None, whole: bool = False
) -> tuple[RigErrors, dict[str, str]]:
    """The errors of a rig's parameters, and the source of each group: `rig file` or `assumed`.

    stated: covariance in the rig file. A group with any parameter in it is taken from there; the others are assumed,
    unless the stated covariance is complete (whole).
    """
    names = rig_names(rig)
    if stated is not None:
        names += tuple(n for n in stated.names if n not in names)
    at = {name: i for i, name in enumerate(names)}
    p = len(names)
    stated_groups = {group_of(n) for n in stated.names} if stated else set()
    groups = {g: np.zeros((p, p)) for g in GROUPS}
    if stated is not None:
        for group in stated_groups:
            own = [i for i, n in enumerate(stated.names) if group_of(n) == group]
            place = [at[stated.names[i]] for i in own]
            groups[group][np.ix_(place, place)] = stated.matrix[np.ix_(own, own)]
    if not whole:
        for members, C in _alone(rig, expected):
            if group_of(members[0]) not in stated_groups:
                place = [at[n] for n in members]
                groups[group_of(members[0])][np.ix_(place, place)] = C
    joint = _joint(stated, at, p) if stated else np.zeros((p, p))
    # Joint effect of one parameter's error: the parameter itself and, for a lens, the pose of its camera.
    follow = np.eye(p)
    if not whole and CAMERA_POSES not in stated_groups:
        for name, camera in rig.cameras.items():
            lens_at = [at[f"cameras.{name}.{n}"] for n in (*PINHOLE, *distortion_names(camera))]
            pose_at = [at[f"cameras.{name}.{n}"] for n in POSE]
            found = _resection(camera, rig.screens[camera.screen], expected)
            if found is not None:
                noise, by_lens = found
                follow[np.ix_(pose_at, lens_at)] = by_lens
                groups[CAMERA_POSES][np.ix_(pose_at, pose_at)] = noise
    sigmas = np.sqrt(np.maximum(np.diagonal(sum(groups.values(), np.zeros((p, p)))), 0.0))
    things = _things(names, groups, follow)
    groups[INTRINSICS] = symmetric(follow @ groups[INTRINSICS] @ follow.T)
    kept = {g: C for g, C in groups.items() if C.any()}
    errors = RigErrors(
        names=names,
        covariance=sum(kept.values(), np.zeros((p, p))) + joint,
        groups=kept,
        moves=follow * sigmas,
        move_names=names,
        move_sigmas=sigmas,
        things=things,
    )
    return errors, {g: "rig file" if g in stated_groups else "assumed" for g in kept}


def _things(names: Sequence[str], groups: dict[str, Array], follow: Array) -> list[tuple[str, str, Array]]:
    """The groups' covariances split by camera, screen and beam; those of lenses include their effect on the pose."""
    owner = np.array([".".join(split_name(n)[:2]) for n in names])
    out = []
    for group, C in groups.items():
        for thing in dict.fromkeys(owner.tolist()):
            own = owner == thing
            part = np.where(own[:, None] & own[None, :], C, 0.0)
            if part.any():
                out.append((thing, group, follow @ part @ follow.T if group == INTRINSICS else part))
    return out


def _joint(stated: RigCovariance, at: dict[str, int], p: int) -> Array:
    """Covariance between parameters of different groups (p, p)."""
    group = np.array([group_of(n) for n in stated.names])
    place = [at[n] for n in stated.names]
    out = np.zeros((p, p))
    out[np.ix_(place, place)] = np.where(group[:, None] == group[None, :], 0.0, stated.matrix)
    return out


def _alone(rig: Rig, expected: ExpectedErrors) -> list[tuple[list[str], Array]]:
    """Names and covariances of independent parameters, with camera poses as without dots."""
    parts: list[tuple[list[str], Array]] = []
    placed = [expected.camera_position_m] * 3 + [float(np.deg2rad(expected.camera_rotation_deg))] * 3
    for name, camera in rig.cameras.items():
        f = pinhole_numbers(camera)[:2]
        sigmas = [*(expected.focal_relative * f), expected.centre_px, expected.centre_px]
        sigmas += _distortion_sigmas(camera, expected.distortion_px).tolist()
        lens_names = (*PINHOLE, *distortion_names(camera))
        parts.append(([f"cameras.{name}.{n}" for n in lens_names], np.diag(np.square(sigmas))))
        parts.append(([f"cameras.{name}.{n}" for n in POSE], np.diag(np.square(placed))))
    placed = [expected.screen_position_m] * 3 + [float(np.deg2rad(expected.screen_rotation_deg))] * 3
    parts += [([f"screens.{name}.{n}" for n in POSE], np.diag(np.square(placed))) for name in rig.screens]
    direction = np.deg2rad(expected.beam_direction_arcsec / 3600)
    for name, beam in rig.beams.items():
        # Errors along the beam have no effect: the covariances are singular in this direction.
        across = np.eye(3) - np.outer(beam.direction, beam.direction)
        parts.append(([f"beams.{name}.{n}" for n in DIRECTION], direction**2 * across))
        parts.append(([f"beams.{name}.{n}" for n in POINT], expected.beam_point_m**2 * across))
    return parts


def _distortion_sigmas(camera: Camera, at_corner_px: float) -> Array:
    """A sigma for each distortion coefficient (d,), which together displace the picture's corners by this many px.

    Each has the same share: an independent sigma of, for instance, k3 would have no practical meaning.
    """
    count = len(camera.distortion)
    if count == 0:
        return np.zeros(0)
    corners = _picture_grid(camera, 2, 2, inset=0.0)
    _, rays = camera.rays(corners)
    good = np.isfinite(rays).all(axis=-1)
    # If the lens model is not valid at the corners, its effect is evaluated half-way to them.
    half_way = np.append(0.25 * np.array(camera.image_size_px) / pinhole_numbers(camera)[:2], 1.0)[None]
    points = rays[good] @ camera.camera_from_world.rotation.T if good.any() else half_way
    projected = project_points_full(points, *camera.lens_numbers)
    moves = np.linalg.norm(projected.d_distortion[..., :count], axis=-2).max(axis=0)  # px per unit
    return at_corner_px / np.sqrt(count) / np.maximum(moves, 1e-12)


def _resection(camera: Camera, screen: Screen, expected: ExpectedErrors) -> tuple[Array, Array] | None:
    """The covariance (6, 6) of a camera's pose from dots of its screen, and d(pose)/d(lens) (6, 4 + d).

    None if the camera sees too little of the screen.
    """
    points = dots_on_screen(camera, screen, expected)
    if len(points) < _FEWEST_DOTS:
        return None
    in_camera = camera.camera_from_world.apply(points)
    projected = project_points_full(in_camera, *camera.lens_numbers)
    d_pose = np.concatenate(
        [np.broadcast_to(np.eye(3), (len(points), 3, 3)), -(camera.camera_from_world.rotation @ skew(points))], axis=-1
    )
    A = projected.d_point @ d_pose  # (m, 2, 6)
    count = len(camera.distortion)
    B = np.concatenate([projected.d_pinhole, projected.d_distortion[..., :count]], axis=-1)  # (m, 2, 4 + d)
    survey = projected.d_point @ np.swapaxes(projected.d_point, -1, -2) * expected.dot_survey_m**2
    W = np.linalg.inv(survey + expected.dot_px**2 * np.eye(2) + 1e-12 * np.eye(2))
    H = np.einsum("mia,mij,mjb->ab", A, W, A)
    size = np.sqrt(np.diagonal(H))
    if np.linalg.cond(H / np.outer(size, size)) > 1e12:
        return None
    noise = np.linalg.inv(H)
    return symmetric(noise), -noise @ np.einsum("mia,mij,mjb->ab", A, W, B)


def dots_on_screen(camera: Camera, screen: Screen, expected: ExpectedErrors) -> Array:
    """Points (m, 3) of the screen, in world, spread over the camera's picture."""
    columns = max(round(float(np.sqrt(1.25 * expected.dots))), 1)
    rows = max(round(expected.dots / columns), 1)
    origin, rays = camera.rays(_picture_grid(camera, columns, rows, inset=0.05))
    xy = intersect_plane(origin, np.nan_to_num(rays), screen.world_from_screen)
    good = np.isfinite(xy).all(axis=-1) & np.isfinite(rays).all(axis=-1)
    if screen.size_m is not None:
        good &= np.all(np.abs(np.nan_to_num(xy)) <= np.array(screen.size_m) / 2, axis=-1)
    xy = xy[good]
    return screen.world_from_screen.apply(np.concatenate([xy, np.zeros((len(xy), 1))], axis=1))


def _picture_grid(camera: Camera, columns: int, rows: int, inset: float) -> Array:
    """Pixels (columns * rows, 2) on a regular grid, from `inset` of the picture's size inside the edges."""
    width, height = camera.image_size_px
    u = np.linspace(inset * width, (1 - inset) * width, columns) - 0.5
    v = np.linspace(inset * height, (1 - inset) * height, rows) - 0.5
    return np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
