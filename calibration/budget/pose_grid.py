"""Visibility of spots and error budget of a rig over a grid of poses."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

import numpy as np

from calibration.budget.pose_budget import Budget, PoseBudget, RigErrors, along, worst_direction
from geometry.arrays import Array, Bools, Ints
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.pose_solver.gauss_newton import SolveLimits
from geometry.rig import Rig
from geometry.rotations import ypr_jacobian
from geometry.uncertainty.rig_uncertainty import Sensitivity

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
    chunks = [_of_chunk(model, budget.of(poses_of(part)), part) for part in _chunks(coordinates)]
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


def _chunks(coordinates: Array) -> Iterator[Array]:
    for start in range(0, len(coordinates), _POSES_AT_ONCE):
        yield coordinates[start : start + _POSES_AT_ONCE]


def _of_chunk(model: SpotModel, b: Budget, coordinates: Array) -> dict[str, Array]:
    """The columns of a plan for some of its poses, with effects (k, 6, q) and things (k, t, 6) in single precision."""
    # From [dt, dtheta] to x, y, z (m), yaw, pitch, roll (deg), and for directions to m and deg.
    turn = np.rad2deg(ypr_jacobian(poses_of(coordinates).rotation))
    to_axes = np.zeros((len(coordinates), 6, 6))
    to_axes[:, :3, :3] = np.eye(3)
    to_axes[:, 3:, 3:] = turn
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
        "margin_px": _margins(b.pixels, model.image_size_px),
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


def _margins(pixels: Array, sizes_px: Array) -> Array:
    """Distance (k, n), px, of pixels (k, n, 2) to the nearest edge of their pictures (n, 2), negative outside."""
    inside = np.minimum(pixels + 0.5, sizes_px - 0.5 - pixels)
    return np.min(inside, axis=-1)


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
