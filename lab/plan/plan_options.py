"""Options of a plan: the grid of poses, the noise of a spot, the goals and the expected calibration errors."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from itertools import product
from typing import Any, TypeAlias

import numpy as np

from calibration.budget.expected_errors import ExpectedErrors
from calibration.budget.pose_grid import GridPlan
from geometry.arrays import Array
from lab.errors import InputError
from lab.files.text.dataclass_fields import dataclass_from_yaml
from lab.files.text.error_text import suggest_name
from lab.files.text.range_checks import MAX_COORDINATE_M

MAX_POSES = 100_000  # some 300 MB of memory and a table of 70 MB
MAX_ANGLE_DEG = 360.0
SIZE_RANGE = (1e-12, 1e6)  # of sigmas and goals that are not 0


@dataclass(frozen=True, slots=True)
class Range:
    """Evenly spaced values of one coordinate, both ends included; a single value is the middle."""

    first: float
    last: float
    count: int

    def values(self) -> Array:
        """The values (count,)."""
        return np.linspace(self.first, self.last, self.count) if self.count > 1 else np.array([self.middle])

    @property
    def middle(self) -> float:
        """The middle of the range."""
        return (self.first + self.last) / 2


@dataclass(frozen=True, slots=True)
class PlanOptions:
    """Options of a plan."""

    x_m: Range = Range(-0.3, 0.3, 5)  # position of the body's origin in world
    y_m: Range = Range(-0.3, 0.3, 5)
    z_m: Range = Range(-0.3, 0.3, 3)
    yaw_deg: Range = Range(-20.0, 20.0, 7)
    pitch_deg: Range = Range(-20.0, 20.0, 7)
    roll_deg: Range = Range(-20.0, 20.0, 3)
    sigma_px: float = 0.1  # of a spot's coordinates: 0.05 px for clean spots, 0.1 px with speckle
    edge_px: float = 4.0  # minimum distance to the picture's edge: nearer, a spot of the usual 1 px sigma is truncated
    goal_deg: float | None = None  # required attitude sigma along the worst direction ...
    goal_m: float | None = None  # ... and position sigma
    # Calibration errors where the rig file states no covariance.
    expected: ExpectedErrors = field(default_factory=ExpectedErrors)

    def __post_init__(self) -> None:
        for name, r in self.ranges.items():
            _check_range(name, r)
        for name in ("sigma_px", "edge_px", "goal_deg", "goal_m"):
            _check_size(name, getattr(self, name))
        for f in fields(self.expected):
            _check_size(f"expected.{f.name}", getattr(self.expected, f.name))
        if self.sigma_px <= 0:
            raise InputError(f"sigma_px: expected a number above 0, got {self.sigma_px}")
        if self.count > MAX_POSES:
            raise InputError(f"expected at most {MAX_POSES} poses, got {self.count}: reduce some counts")

    @property
    def ranges(self) -> dict[str, Range]:
        """The ranges by name, in the order x, y, z, yaw, pitch, roll."""
        return {f.name: getattr(self, f.name) for f in fields(self) if isinstance(getattr(self, f.name), Range)}

    @property
    def count(self) -> int:
        """Number of poses of the grid."""
        return math.prod(r.count for r in self.ranges.values())

    def coordinates(self) -> Array:
        """The grid (count, 6): x, y, z (m), yaw, pitch, roll (deg), the last varying fastest."""
        return np.array(list(product(*(r.values() for r in self.ranges.values()))))


Plan: TypeAlias = GridPlan[PlanOptions]


def _check_size(name: str, value: float | None) -> None:
    """Raise InputError for a number that is negative or not finite."""
    if value is not None and not (np.isfinite(value) and value >= 0):
        raise InputError(f"{name}: expected a number of 0 or more, got {value}")
    if value is not None and value != 0 and not SIZE_RANGE[0] <= value <= SIZE_RANGE[1]:
        raise InputError(f"{name}: expected a number from {SIZE_RANGE[0]:g} to {SIZE_RANGE[1]:g}, got {value:g}")


def _check_range(name: str, r: Range) -> None:
    if not (np.isfinite(r.first) and np.isfinite(r.last)):
        raise InputError(f"{name}: expected finite ends, got {r.first} and {r.last}")
    farthest, unit = (MAX_ANGLE_DEG, "deg") if name.endswith("_deg") else (MAX_COORDINATE_M, "m")
    if max(abs(r.first), abs(r.last)) > farthest:
        raise InputError(f"{name}: expected ends within {farthest:g} {unit}, got {r.first:g} and {r.last:g}")
    if r.count < 1 or r.count != int(r.count):
        raise InputError(f"{name}: expected a count of 1 or more, got {r.count}")
    if r.last < r.first or (r.last == r.first and r.count > 1):
        raise InputError(f"{name}: expected the first end below the last, got {r.first:g} and {r.last:g}")


def options_of(
    ranges: Mapping[str, tuple[float, float, int]],
    *,
    sigma_px: float | None = None,
    goal_deg: float | None = None,
    goal_m: float | None = None,
    expected: Mapping[str, Any] | None = None,
) -> PlanOptions:
    """Options from the values of the command line: ranges (first, last, count) by name; None keeps a default.

    Raises:
        InputError: for an unknown name or an invalid number.
    """
    default = PlanOptions()
    for name in ranges:
        if name not in default.ranges:
            raise InputError(f"--range: expected a coordinate, got {name!r}{suggest_name(name, default.ranges)}")
    chosen: dict[str, Any] = {**default.ranges, **{name: Range(*r) for name, r in ranges.items()}}
    return PlanOptions(
        **chosen,
        sigma_px=default.sigma_px if sigma_px is None else sigma_px,
        goal_deg=goal_deg,
        goal_m=goal_m,
        expected=dataclass_from_yaml(ExpectedErrors, dict(expected or {}), "--expect"),
    )
