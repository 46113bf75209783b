"""What a plan of a rig assumes: the poses, the noise of a spot, and what calibrations usually reach."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from itertools import product
from typing import Any

import numpy as np

from calibration.budget.expected_errors import ExpectedErrors
from geometry.arrays import Array
from geometry.pose import Pose
from lab.errors import InputError
from lab.files.text.dataclass_fields import dataclass_from_yaml
from lab.files.text.error_text import did_you_mean

MOST_POSES = 100_000  # some 300 MB of memory and a table of 70 MB


@dataclass(frozen=True, slots=True)
class Range:
    """Evenly spaced values of one coordinate, both ends included; one value is the middle."""

    first: float
    last: float
    count: int

    def values(self) -> Array:
        """(count,)"""
        return np.linspace(self.first, self.last, self.count) if self.count > 1 else np.array([self.middle])

    @property
    def middle(self) -> float:
        """The middle of the range."""
        return (self.first + self.last) / 2


@dataclass(frozen=True, slots=True)
class PlanOptions:
    """A plan's poses, the noise of a spot, what the rig is meant for, and the calibration errors to expect."""

    x_m: Range = Range(-0.3, 0.3, 5)  # of the body's origin in world
    y_m: Range = Range(-0.3, 0.3, 5)
    z_m: Range = Range(-0.3, 0.3, 3)
    yaw_deg: Range = Range(-20.0, 20.0, 7)
    pitch_deg: Range = Range(-20.0, 20.0, 7)
    roll_deg: Range = Range(-20.0, 20.0, 3)
    sigma_px: float = 0.1  # of a spot's coordinates: clean spots are found to 0.05 px, speckled ones to 0.1
    edge_px: float = 4.0  # nearer to the edge a spot of the usual 1 px sigma is cut: not counted as seen
    goal_deg: float | None = None  # attitude sigma, worst direction, that the rig is meant to reach ...
    goal_m: float | None = None  # ... and position sigma
    expected: ExpectedErrors = field(
        default_factory=ExpectedErrors
    )  # of the calibrations, where the rig file states no covariance

    def __post_init__(self) -> None:
        for name, r in self.ranges.items():
            _check_range(name, r)
        for name in ("sigma_px", "edge_px", "goal_deg", "goal_m"):
            _check_size(name, getattr(self, name))
        for f in fields(self.expected):
            _check_size(f"expected.{f.name}", getattr(self.expected, f.name))
        if self.sigma_px <= 0:
            raise InputError(f"sigma_px: expected a number above 0, got {self.sigma_px}")
        if self.count > MOST_POSES:
            raise InputError(f"expected at most {MOST_POSES} poses, got {self.count}: lower some counts")

    @property
    def ranges(self) -> dict[str, Range]:
        """The ranges by name, in the order x, y, z, yaw, pitch, roll."""
        return {f.name: getattr(self, f.name) for f in fields(self) if isinstance(getattr(self, f.name), Range)}

    @property
    def count(self) -> int:
        """How many poses the grid has."""
        return int(np.prod([r.count for r in self.ranges.values()]))

    def coordinates(self) -> Array:
        """The grid (count, 6): x, y, z (m), yaw, pitch, roll (deg), the last running fastest."""
        return np.array(list(product(*(r.values() for r in self.ranges.values()))))


def _check_size(name: str, value: float | None) -> None:
    """Raises InputError for a number below 0, or none at all."""
    if value is not None and not (np.isfinite(value) and value >= 0):
        raise InputError(f"{name}: expected a number of 0 or more, got {value}")


def _check_range(name: str, r: Range) -> None:
    if not (np.isfinite(r.first) and np.isfinite(r.last)):
        raise InputError(f"{name}: expected finite ends, got {r.first} and {r.last}")
    if r.count < 1 or r.count != int(r.count):
        raise InputError(f"{name}: expected a count of 1 or more, got {r.count}")
    if r.last < r.first or (r.last == r.first and r.count > 1):
        raise InputError(f"{name}: expected the first end below the last, got {r.first:g} and {r.last:g}")


def poses_of(coordinates: Array) -> Pose:
    """world_from_body (k,) of coordinates (k, 6): x, y, z (m), yaw, pitch, roll (deg)."""
    return Pose.from_ypr(np.deg2rad(coordinates[:, 3:]), coordinates[:, :3])


def options_of(
    ranges: Mapping[str, tuple[float, float, int]],
    *,
    sigma_px: float | None = None,
    goal_deg: float | None = None,
    goal_m: float | None = None,
    expected: Mapping[str, Any] | None = None,
) -> PlanOptions:
    """Options from what a command gives: ranges (first, last, count) by name, the rest where it is not None.

    Raises InputError for a name or a number that does not fit.
    """
    usual = PlanOptions()
    for name in ranges:
        if name not in usual.ranges:
            raise InputError(f"--range: expected a coordinate, got {name!r}{did_you_mean(name, usual.ranges)}")
    chosen: dict[str, Any] = {**usual.ranges, **{name: Range(*r) for name, r in ranges.items()}}
    return PlanOptions(
        **chosen,
        sigma_px=usual.sigma_px if sigma_px is None else sigma_px,
        goal_deg=goal_deg,
        goal_m=goal_m,
        expected=dataclass_from_yaml(ExpectedErrors, dict(expected or {}), "--expect"),
    )
