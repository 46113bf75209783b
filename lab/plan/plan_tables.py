"""Tables of a plan: plan.csv, a row for each pose, and effects.csv, a row for each error of the calibration.

plan.csv: pose; x_m ... roll_deg, the grid; status (measured; vague: observable, but too uncertain for a run; not
observable); spots_in_view; least_margin_px, smallest distance of a spot in view to its picture's edge;
closest_spots_px; condition (no unit: ratio of the largest to the smallest singular value of the whitened Jacobian with
columns of length 1); sigma_x_m ... sigma_roll_deg, from all errors; worst_position_m, worst_attitude_deg and their axes
(in world; in body); for each contribution the same six sigmas from it alone (noise_x_m, camera_intrinsics_x_m, ...);
margin_CAMERA_SPOT_px, the distance to the picture's edge, negative outside, empty without projection.

effects.csv: parameter; group; sigma and its unit; median_x_m ... median_roll_deg, effect of this error alone on the
pose, median over the observable poses; largest_x_m ..., the maximum. First a row for each camera, screen and beam
(`cameras.left`) with all its errors of one group combined, without a sigma; then a row for each parameter, named as in
the covariance blocks of rig.yaml. If a camera's pose comes from a resection, the errors of its lens include their
effect on this pose. The errors of one camera's pose are correlated: each alone has a larger effect than all combined.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from calibration.budget.pose_budget import group_of
from calibration.budget.pose_grid import AXES, STATUS
from lab.files.text.csv_text import write_table
from lab.plan.plan_options import Plan

_DIRECTIONS = tuple(f"worst_{what}_axis_{a}" for what in ("position", "attitude") for a in "xyz")


def plan_columns(plan: Plan) -> tuple[str, ...]:
    """The columns of plan.csv."""
    return (
        "pose",
        *plan.options.ranges,
        "status",
        "spots_in_view",
        "least_margin_px",
        "closest_spots_px",
        "condition",
        *(f"sigma_{a}" for a in AXES),
        "worst_position_m",
        "worst_attitude_deg",
        *_DIRECTIONS,
        *(f"{c.replace(' ', '_')}_{a}" for c in plan.contributors for a in AXES),
        *(f"margin_{camera}_{spot}_px" for camera, spot in plan.views),
    )


def effect_columns() -> tuple[str, ...]:
    """The columns of effects.csv."""
    return ("parameter", "group", "sigma", "unit", *(f"{kind}_{a}" for kind in ("median", "largest") for a in AXES))


def write_plan(plan: Plan, path: Path) -> None:
    """Write plan.csv, complete or not at all. Numbers that do not exist are empty."""
    write_table(path, plan_columns(plan), _plan_rows(plan))


def write_effects(plan: Plan, path: Path) -> None:
    """Write effects.csv, complete or not at all; errors that are not there (sigma 0) have no row."""
    write_table(path, effect_columns(), _effect_rows(plan))


def _plan_rows(plan: Plan) -> Iterator[list[str]]:
    least = np.where(plan.seen, plan.margin_px, np.inf).min(axis=1)
    columns = [least[:, None], plan.closest_px[:, None], plan.condition[:, None], plan.sigma, plan.worst]
    columns += [plan.worst_axis.reshape(len(least), 6), plan.parts.reshape(len(least), -1), plan.margin_px]
    results = np.concatenate(columns, axis=1).tolist()
    spots = plan.seen.sum(axis=1).tolist()
    for i, (coordinates, numbers) in enumerate(zip(plan.coordinates.tolist(), results, strict=True)):
        yield [str(i), *map(_shown, coordinates), STATUS[plan.status[i]], str(spots[i]), *map(_shown, numbers)]


def _effect_rows(plan: Plan) -> Iterator[list[str]]:
    for (thing, group, _), median, largest in zip(
        plan.errors.things, plan.thing_median, plan.thing_largest, strict=True
    ):
        yield [thing, group, "", "", *map(_shown, [*median.tolist(), *largest.tolist()])]
    for name, sigma, median, largest in zip(
        plan.errors.move_names, plan.errors.move_sigmas, plan.effect_median, plan.effect_largest, strict=True
    ):
        if sigma > 0:
            numbers = [*median.tolist(), *largest.tolist()]
            yield [name, group_of(name), _shown(float(sigma)), unit_of(name), *map(_shown, numbers)]


def unit_of(name: str) -> str:
    """Unit of a rig parameter; 1 if it has none."""
    parameter = name.rsplit(".", 1)[1]
    if parameter.endswith("_per_m"):
        return "1/m"
    if parameter.endswith(("_m", "_rad")):
        return parameter.rsplit("_", 1)[1]
    return "px" if parameter in ("fx", "fy", "cx", "cy") else "rad" if parameter.startswith("tau") else "1"


def _shown(value: float) -> str:
    """A number with six digits, which exceeds the precision of a planned sigma; empty if not finite."""
    return f"{value:.6g}" if np.isfinite(value) else ""
