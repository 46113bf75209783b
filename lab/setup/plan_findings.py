"""Options of a plan, and the findings on what it predicts."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from itertools import product
from types import MappingProxyType
from typing import Any, TypeAlias

import numpy as np

from calibration.budget import (
    BEAM_DIRECTIONS,
    BEAM_POINTS,
    CAMERA_POSES,
    INTRINSICS,
    NOISE,
    SCREEN_POSES,
    SCREEN_SHAPES,
    ExpectedErrors,
    GridPlan,
)
from geometry.arrays import Array, Bools
from geometry.pose import Pose
from lab.errors import InputError
from lab.files.text.csv_text import MAX_COORDINATE_M
from lab.files.text.dataclass_fields import dataclass_from_yaml
from lab.files.text.error_text import suggest_name
from lab.findings.finding import Finding, Level, finding, passed
from lab.number_format import format_angle, format_length, format_percent

# Options of a plan: the grid of poses, the noise of a spot, the goals and the expected calibration errors.

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


USUAL: Mapping[str, Range] = MappingProxyType(
    {
        "x_m": Range(-0.3, 0.3, 5),
        "y_m": Range(-0.3, 0.3, 5),
        "z_m": Range(-0.3, 0.3, 3),
        "yaw_deg": Range(-20.0, 20.0, 7),
        "pitch_deg": Range(-20.0, 20.0, 7),
        "roll_deg": Range(-20.0, 20.0, 3),
    }
)


@dataclass(frozen=True, slots=True)
class PlanOptions:
    """Options of a plan."""

    # Of the position of the body's origin in world, and of its attitude; others: USUAL about where the rig sees it.
    stated: Mapping[str, Range] = field(default_factory=dict)
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
        return {**USUAL, **self.stated}

    def about(self, middle: Pose) -> PlanOptions:
        """The options with the ranges that are not stated moved to a pose."""
        place = (*middle.translation.tolist(), *np.rad2deg(middle.ypr).tolist())
        moved = {
            name: Range(usual.first + by, usual.last + by, usual.count)
            for (name, usual), by in zip(USUAL.items(), place, strict=True)
        }
        return replace(self, stated={**moved, **self.stated})

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
    ranges: Mapping[str, tuple[float, float, int]], expected: Mapping[str, Any] | None = None, **numbers: float | None
) -> PlanOptions:
    """Options from the values of the command line: ranges (first, last, count) by name; None keeps a default.

    Raises InputError: for an unknown name or an invalid number.
    """
    for name in ranges:
        if name not in USUAL:
            raise InputError(f"--range: expected a coordinate, got {name!r}{suggest_name(name, USUAL)}")
    return PlanOptions(
        stated={name: Range(*r) for name, r in ranges.items()},
        expected=dataclass_from_yaml(ExpectedErrors, dict(expected or {}), "--expect"),
        **{name: number for name, number in numbers.items() if number is not None},
    )


# Evaluation of a plan: error budget, recommendations and findings.


MIN_MEASURED = 0.5  # share of the grid below which the rig does not suit it
MIN_IN_VIEW = 0.8  # share of the grid in which a spot should be in its picture
MERGING_PX = 10.0  # distance at which two spots of some 8 px across begin to merge
CORRELATION = "correlation of groups"  # variance from the covariance between groups; negative where errors cancel
TOTAL_CALIBRATION = "calibration, total"
# Largest share of CORRELATION for which the shares of the groups are shown: after a joint calibration each of them is
# near 100 % and they cancel, so that single shares have no meaning.
MAX_CORRELATION = 0.05

_UNITS = {"x_m": "m", "y_m": "m", "z_m": "m", "yaw_deg": "°", "pitch_deg": "°", "roll_deg": "°"}
_REMEDIES = {
    NOISE: "Use a longer lens or more pixels on the screen, brighter or rounder spots (longer exposure, less speckle),"
    " or beams wider apart; averaging over frames reduces the noise only.",
    INTRINSICS: "Calibrate the lenses with more photographs, with the board in the corners of the picture and tilted;"
    " lock focus and aperture.",
    CAMERA_POSES: "Survey more dots on the screens, or survey them better, and mount the cameras stiffly.",
    SCREEN_POSES: "Survey the screens' planes with more points, or stiffen the screens.",
    SCREEN_SHAPES: "Measure the screens' bow with more points, or flatten them.",
    BEAM_DIRECTIONS: "Calibrate the beams at more stand attitudes over a wider range; let the lasers warm up, and mount"
    " them so that they do not drift.",
    BEAM_POINTS: "Calibrate the beams at more stand poses, with shifts as well as turns.",
    TOTAL_CALIBRATION: "The report of the joint calibration shows which of its measurements contributes most.",
}


@dataclass(frozen=True, slots=True)
class BudgetLine:
    """Contribution of one error source to the sigma along the worst direction.

    Shares are means over the observable poses with equal weights, so that a few bad poses do not dominate. Sigmas are
    these shares of the median sigma.
    """

    name: str
    source: str  # origin of the assumed size
    sigma_deg: float
    share_deg: float  # of the attitude's variance; negative where it cancels others
    halved_deg: float  # sigma of the attitude if this contribution were halved
    sigma_m: float
    share_m: float
    halved_m: float


def budget_lines(plan: Plan) -> list[BudgetLine]:
    """The error budget, the largest contribution to the attitude first; empty if no pose is observable.

    If the groups of errors are strongly correlated in the rig file's covariance, they are combined into one line.
    """
    solved = plan.observable
    if not solved.any():
        return []
    m, deg = median_sigma(plan)
    shares = (plan.worst_parts[solved] / plan.worst[solved][:, None] ** 2).mean(axis=0)  # (c, 2)
    rows = [(name, _source(plan, name), *shares[i].tolist()) for i, name in enumerate(plan.contributors)]
    rest = (1 - shares.sum(axis=0)).tolist()
    if max(map(abs, rest)) > MAX_CORRELATION:
        noise = next(row for row in rows if row[0] == NOISE)
        rows = [noise, (TOTAL_CALIBRATION, "rig file", 1 - noise[2], 1 - noise[3])]
    elif max(map(abs, rest)) > 1e-3:
        rows.append((CORRELATION, "rig file", *rest))
    lines = [
        BudgetLine(name, source, *_part(deg, share_deg), *_part(m, share_m))
        for name, source, share_m, share_deg in rows
    ]
    return sorted(lines, key=lambda line: -line.share_deg)


def _part(sigma: float, share: float) -> tuple[float, float, float]:
    """Of a contribution with a share of the variance: its sigma, the share, and the total sigma if it were halved."""
    halved = float(np.sqrt(1 - 0.75 * min(max(share, 0.0), 1.0)))
    return sigma * float(np.sign(share) * np.sqrt(abs(share))), share, sigma * halved


def _source(plan: Plan, name: str) -> str:
    return f"{plan.options.sigma_px:g} px per spot" if name == NOISE else plan.sources[name]


def median_sigma(plan: Plan) -> tuple[float, float]:
    """Position (m) and attitude (deg) sigma along the worst direction, median over the observable poses."""
    if not plan.observable.any():
        return float("nan"), float("nan")
    m, deg = np.median(plan.worst[plan.observable], axis=0).tolist()
    return m, deg


def advice(plan: Plan) -> list[str]:
    """Recommendations, a paragraph each, the largest contribution to the attitude first."""
    lines = budget_lines(plan)
    if not lines:
        return []
    m, deg = median_sigma(plan)
    first = lines[0]
    out = []
    if not plan.measured.all():
        out.append(
            f"Visibility: {format_percent(1 - float(plan.measured.mean()))} of the poses cannot be measured,"
            " however small the"
            " errors are. The following applies to the observable poses."
        )
    out += [
        f"Attitude: {first.name} contributes {format_percent(first.share_deg)} of the variance along the worst"
        " direction."
        f" Halving it would reduce the sigma from {format_angle(deg)} to {format_angle(first.halved_deg)}."
        f" {_REMEDIES.get(first.name, '')}"
    ]
    largest = max(lines, key=lambda line: line.share_m)
    contribution = f"Position: {largest.name} contributes {format_percent(largest.share_m)} of the variance."
    halved = f"Halving it would reduce the sigma from {format_length(m)} to {format_length(largest.halved_m)}."
    remedy = "The remedy is the same." if largest.name == first.name else _REMEDIES.get(largest.name, "")
    out.append(f"{contribution} {halved} {remedy}")
    noise = next(line for line in lines if line.name == NOISE)
    rest_deg, rest_m = np.sqrt(max(1 - noise.share_deg, 0.0)) * deg, np.sqrt(max(1 - noise.share_m, 0.0)) * m
    out.append(
        f"Averaging over frames does not reduce the contribution of the calibration, {format_angle(rest_deg)} and"
        f" {format_length(rest_m)}. It is the same in all frames at a pose and mostly cancels in the difference of two"
        " similar"
        " poses."
    )
    return out


# Findings ---------------------------------------------------------------------------------------------------------


def findings(plan: Plan) -> list[Finding]:
    """All findings of a plan, with remedies for warnings and failures."""
    return [*_observability(plan), *_redundancy(plan), *_views(plan), *_distances(plan), *_goals(plan)]


def _observability(plan: Plan) -> Iterator[Finding]:
    count, measured = len(plan.status), int(plan.measured.sum())
    if measured == count:
        yield passed(f"All {count} poses can be measured.")
        return
    unobservable, vague = int((~plan.observable).sum()), int((plan.observable & ~plan.measured).sum())
    what = f"{count - measured} of {count} poses ({format_percent(1 - measured / count)}) cannot be measured:"
    what += f" {unobservable} are not observable"
    what += f", {vague} are too uncertain to count as measured" if vague else ""
    where = _where(plan, ~plan.measured)
    if measured == 0:
        yield finding("BP-P01", Level.FAIL, what + ".")
        return
    yield finding(
        "BP-P02",
        Level.FAIL if measured < MIN_MEASURED * count else Level.WARN,
        what + (f"; the share is largest at {where}." if where else "."),
    )


def _where(plan: Plan, bad: Bools) -> str:
    """The value of one coordinate at which bad poses are most frequent, in words; empty if there is none."""
    best, words = 0.0, ""
    for i, (name, r) in enumerate(plan.options.ranges.items()):
        if r.count < 2:
            continue
        shares = [float(bad[plan.coordinates[:, i] == value].mean()) for value in r.values()]
        excess = max(shares) - float(bad.mean())
        if excess > max(best, 0.02):
            value = float(r.values()[int(np.argmax(shares))])
            best, words = excess, f"{name.split('_')[0]} {value:g} {_UNITS[name]} ({format_percent(max(shares))})"
    return words.replace(" °", "°").replace("-", "−")


def _redundancy(plan: Plan) -> Iterator[Finding]:
    spots = plan.seen.sum(axis=1)
    three = plan.measured & (spots <= 3)
    share = float(three.sum() / max(int(plan.measured.sum()), 1))
    if share > 0.05:
        yield finding("BP-P03", Level.WARN, f"{format_percent(share)} of the measurable poses have only three spots.")
    elif plan.measured.any():
        yield passed(
            f"{format_percent(1 - share)} of the measurable poses have four spots or more: a wrong spot is detected.",
        )


def _views(plan: Plan) -> Iterator[Finding]:
    shares = plan.seen.mean(axis=0)
    poor = [i for i in np.argsort(shares).tolist() if shares[i] < MIN_IN_VIEW]
    if not poor:
        yield passed(f"Every spot is in its picture in at least {format_percent(float(shares.min()))} of the poses.")
        return
    camera, spot = plan.views[poor[0]]
    others = f", and {len(poor) - 1} more of the spots' views in fewer than {format_percent(MIN_IN_VIEW)}"
    more = others if len(poor) > 1 else ""
    where = _where(plan, ~plan.seen[:, poor[0]])
    what = (
        f"Spot {spot} is in the picture of {camera} in only {format_percent(float(shares[poor[0]]))} of the"
        f" poses{more}." + (f" It is missing most often at {where}." if where else "")
    )
    yield finding("BP-P04", Level.WARN, what)


def _distances(plan: Plan) -> Iterator[Finding]:
    close = plan.closest_px < MERGING_PX
    if close.any():
        what = (
            f"Two spots of one picture are within {MERGING_PX:g} px of each other in"
            f" {format_percent(float(close.mean()))} of the poses (minimum: {plan.closest_px.min():.1f} px)."
        )
        yield finding("BP-P05", Level.WARN, what)
    elif np.isfinite(plan.closest_px).any():
        yield passed(f"Spots of one picture are at least {plan.closest_px.min():.0f} px apart.")


def _goals(plan: Plan) -> Iterator[Finding]:
    options, shown = plan.options, (format_length, format_angle)
    for k, (what, goal) in enumerate((("position", options.goal_m), ("attitude", options.goal_deg))):
        if goal is None:
            continue
        sigma = plan.worst[:, k]
        good = int(np.sum(np.nan_to_num(sigma, nan=np.inf) <= goal))
        words = f"The {what} sigma is within {shown[k](goal)} in {format_percent(good / len(sigma))} of the poses"
        if good == len(sigma):
            yield passed(words + ".")
        else:
            yield finding("BP-P06", Level.FAIL if good < MIN_MEASURED * len(sigma) else Level.WARN, words + ".")


def worst_first(plan: Plan, count: int) -> list[int]:
    """Indices of the worst poses: some that are not observable, then those with the largest attitude sigma."""
    unobservable = np.flatnonzero(~plan.observable)
    fewest = unobservable[np.argsort(plan.seen[unobservable].sum(axis=1), kind="stable")][: count // 3]
    solved = np.flatnonzero(plan.observable)
    rest = solved[np.argsort(-plan.worst[solved, 1], kind="stable")][: count - len(fewest)]
    return [*fewest.tolist(), *rest.tolist()]


def axis_words(direction: Array) -> str:
    """A direction (3,) in words: `y`, or `0.8 x − 0.6 z`; a dash for none."""
    if not np.isfinite(direction).all():
        return "–"
    if np.max(np.abs(direction)) > 0.95:
        return "xyz"[int(np.argmax(np.abs(direction)))]
    terms = [(f"{abs(v):.1f} {n}", v < 0) for v, n in zip(direction.tolist(), "xyz", strict=True) if abs(v) >= 0.25]
    text = ("−" if terms[0][1] else "") + terms[0][0]
    return text + "".join(f" {'−' if negative else '+'} {term}" for term, negative in terms[1:])
