"""What a plan says of a rig in words: findings, the error budget, and what to improve first."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from calibration.budget.pose_budget import (
    BEAM_DIRECTIONS,
    BEAM_POINTS,
    CAMERA_POSES,
    INTRINSICS,
    SCREEN_POSES,
    SCREEN_SHAPES,
)
from calibration.budget.pose_grid import NOISE
from calibration.findings import Finding, Level
from geometry.arrays import Array, Bools
from lab.number_format import angle, length, percent
from lab.plan.plan_options import Plan

FEWEST_MEASURED = 0.5  # share of the grid below which the rig is not fit for it
FEWEST_IN_VIEW = 0.8  # share of the grid in which a spot should be in its picture
CLOSE_PX = 10.0  # two spots of some 8 px across begin to merge
JOINED = "what joins them"  # covariance between groups: below zero where errors cancel
TOGETHER = "calibration, all together"
# Share of the variance that joins the groups beyond which their single shares say nothing: after a joint solve they
# come out near 100 % each and cancel.
MOST_JOINED = 0.05

_UNITS = {"x_m": "m", "y_m": "m", "z_m": "m", "yaw_deg": "°", "pitch_deg": "°", "roll_deg": "°"}
_REMEDIES = {
    NOISE: "A longer lens or more pixels on the screen, brighter or rounder spots (longer exposure, less speckle),"
    " beams wider apart; and a mean over frames, which lessens noise alone.",
    INTRINSICS: "Calibrate the lenses with more photographs, with the board in the corners of the picture and tilted;"
    " lock focus and aperture.",
    CAMERA_POSES: "Survey more dots on the screens, or survey them better, and mount the cameras stiffly.",
    SCREEN_POSES: "Survey the screens' planes with more points, or stiffen the screens.",
    SCREEN_SHAPES: "Measure the screens' bow with more points, or flatten them.",
    BEAM_DIRECTIONS: "Calibrate the beams at more stand attitudes over a wider range; let the lasers warm up, and mount"
    " them so that they do not drift.",
    BEAM_POINTS: "Calibrate the beams at more stand poses, with shifts as well as turns.",
    TOGETHER: "The report of the joint calibration tells which of its measurements contributes most.",
}


@dataclass(frozen=True, slots=True)
class BudgetLine:
    """A contributor's part of the sigma along the worst direction.

    Shares are means over the poses that can be solved, each counting alike: the few worst do not drown the rest. Sigmas
    are such shares of the median one.
    """

    name: str
    source: str  # where its size is from
    sigma_deg: float
    share_deg: float  # of the attitude's variance; below 0 where it cancels others
    halved_deg: float  # the attitude's sigma if this one were halved
    sigma_m: float
    share_m: float
    halved_m: float


def budget_lines(plan: Plan) -> list[BudgetLine]:
    """The error budget, the largest part of the attitude first; empty where no pose can be solved.

    Where the rig file's covariance joins the groups of errors firmly, they make one line together.
    """
    solved = plan.observable
    if not solved.any():
        return []
    m, deg = median_sigma(plan)
    shares = (plan.worst_parts[solved] / plan.worst[solved][:, None] ** 2).mean(axis=0)  # (c, 2)
    rows = [(name, _source(plan, name), *shares[i].tolist()) for i, name in enumerate(plan.contributors)]
    rest = (1 - shares.sum(axis=0)).tolist()
    if max(map(abs, rest)) > MOST_JOINED:
        noise = next(row for row in rows if row[0] == NOISE)
        rows = [noise, (TOGETHER, "rig file", 1 - noise[2], 1 - noise[3])]
    elif max(map(abs, rest)) > 1e-3:
        rows.append((JOINED, "rig file", *rest))
    lines = [
        BudgetLine(
            name=name,
            source=source,
            sigma_deg=deg * float(np.sign(share_deg) * np.sqrt(abs(share_deg))),
            share_deg=share_deg,
            halved_deg=deg * float(np.sqrt(1 - 0.75 * min(max(share_deg, 0.0), 1.0))),
            sigma_m=m * float(np.sign(share_m) * np.sqrt(abs(share_m))),
            share_m=share_m,
            halved_m=m * float(np.sqrt(1 - 0.75 * min(max(share_m, 0.0), 1.0))),
        )
        for name, source, share_m, share_deg in rows
    ]
    return sorted(lines, key=lambda line: -line.share_deg)


def _source(plan: Plan, name: str) -> str:
    return f"{plan.options.sigma_px:g} px a spot" if name == NOISE else plan.sources[name]


def median_sigma(plan: Plan) -> tuple[float, float]:
    """Position (m) and attitude (deg) sigma along the worst direction, median over the poses that can be solved."""
    if not plan.observable.any():
        return float("nan"), float("nan")
    m, deg = np.median(plan.worst[plan.observable], axis=0).tolist()
    return m, deg


def advice(plan: Plan) -> list[str]:
    """What to improve first, a paragraph each, the attitude's largest contributor first."""
    lines = budget_lines(plan)
    if not lines:
        return []
    m, deg = median_sigma(plan)
    first = lines[0]
    out = []
    if not plan.measured.all():
        out.append(
            f"Sight before all: {percent(1 - float(plan.measured.mean()))} of the poses cannot be measured, however"
            " small the errors. What follows is of those that can be solved."
        )
    out += [
        f"Attitude: {first.name} makes {percent(first.share_deg)} of the variance along the worst direction. Halved,"
        f" the sigma would fall from {angle(deg)} to {angle(first.halved_deg)}. {_REMEDIES.get(first.name, '')}"
    ]
    largest = max(lines, key=lambda line: line.share_m)
    start = f"Position: {largest.name} makes {percent(largest.share_m)} of the variance"
    fall = f"Halved, the sigma would fall from {length(m)} to {length(largest.halved_m)}."
    remedy = "The same remedy helps." if largest.name == first.name else _REMEDIES.get(largest.name, "")
    out.append(f"{start}. {fall} {remedy}")
    noise = next(line for line in lines if line.name == NOISE)
    rest_deg, rest_m = np.sqrt(max(1 - noise.share_deg, 0.0)) * deg, np.sqrt(max(1 - noise.share_m, 0.0)) * m
    out.append(
        f"What no mean over frames lessens: {angle(rest_deg)} and {length(rest_m)}, the calibration's part. It is the"
        " same in all frames at a pose, and most of it cancels in differences between near poses."
    )
    return out


# Findings ---------------------------------------------------------------------------------------------------------


def findings(plan: Plan) -> list[Finding]:
    """What was tested, worst news told with its remedy."""
    return [*_observability(plan), *_redundancy(plan), *_views(plan), *_gaps(plan), *_goals(plan)]


def _observability(plan: Plan) -> Iterator[Finding]:
    count, measured = len(plan.status), int(plan.measured.sum())
    if measured == count:
        yield Finding(Level.PASS, f"All {count} poses can be measured.")
        return
    blind, vague = int((~plan.observable).sum()), int((plan.observable & ~plan.measured).sum())
    said = f"{count - measured} of {count} poses ({percent(1 - measured / count)}) cannot be measured:"
    said += f" {blind} are not observable" + (f", {vague} too vague to count as measured" if vague else "")
    where = _where(plan, ~plan.measured)
    if measured == 0:
        yield Finding(
            Level.FAIL,
            said + ".",
            "No pose of the grid puts enough spots into the pictures.",
            "Check that the ranges are about where the vehicle will be (they are in world coordinates), then the"
            " cameras' and screens' poses with `beampose check`.",
        )
        return
    yield Finding(
        Level.FAIL if measured < FEWEST_MEASURED * count else Level.WARN,
        said + (f"; the share is largest at {where}." if where else "."),
        "There a run gives no measured pose.",
        "See below which spots leave their pictures; move or turn those cameras, take wider lenses, or add a beam that"
        " stays in view.",
    )


def _where(plan: Plan, bad: Bools) -> str:
    """The value of one coordinate at which the bad poses gather, in words; empty where they do not."""
    best, words = 0.0, ""
    for i, (name, r) in enumerate(plan.options.ranges.items()):
        if r.count < 2:
            continue
        shares = [float(bad[plan.coordinates[:, i] == value].mean()) for value in r.values()]
        excess = max(shares) - float(bad.mean())
        if excess > max(best, 0.02):
            value = float(r.values()[int(np.argmax(shares))])
            best, words = excess, f"{name.split('_')[0]} {value:g} {_UNITS[name]} ({percent(max(shares))})"
    return words.replace(" °", "°").replace("-", "−")


def _redundancy(plan: Plan) -> Iterator[Finding]:
    spots = plan.seen.sum(axis=1)
    three = plan.measured & (spots <= 3)
    share = float(three.sum() / max(int(plan.measured.sum()), 1))
    if share > 0.05:
        yield Finding(
            Level.WARN,
            f"{percent(share)} of the measurable poses rest on three spots.",
            "Three spots fit any labels: a wrong one is not noticed.",
            "Keep a fourth spot in view: a wider lens, or one more beam.",
        )
    elif plan.measured.any():
        yield Finding(
            Level.PASS,
            f"{percent(1 - share)} of the measurable poses see four spots or more: a wrong spot is noticed.",
        )


def _views(plan: Plan) -> Iterator[Finding]:
    shares = plan.seen.mean(axis=0)
    poor = [i for i in np.argsort(shares).tolist() if shares[i] < FEWEST_IN_VIEW]
    if not poor:
        yield Finding(
            Level.PASS, f"Every spot is in its picture in {percent(float(shares.min()))} of the poses or more."
        )
        return
    camera, spot = plan.views[poor[0]]
    more = f", and {len(poor) - 1} more views in fewer than {percent(FEWEST_IN_VIEW)}" if len(poor) > 1 else ""
    where = _where(plan, ~plan.seen[:, poor[0]])
    yield Finding(
        Level.WARN,
        f"Spot {spot} is in the picture of {camera} in only {percent(float(shares[poor[0]]))} of the poses{more}."
        + (f" It is lost most often at {where}." if where else ""),
        "The pose then rests on the others.",
        f"Turn or move {camera}, or take a wider lens; see the table of views for how far it lies outside.",
    )


def _gaps(plan: Plan) -> Iterator[Finding]:
    close = plan.closest_px < CLOSE_PX
    if close.any():
        yield Finding(
            Level.WARN,
            f"Two spots of one picture come within {CLOSE_PX:g} px of each other in {percent(float(close.mean()))} of"
            f" the poses (least: {plan.closest_px.min():.1f} px).",
            "Spots that touch are found as one, and their labels may swap.",
            "Spread the beams, or turn one of them out of the others' plane.",
        )
    elif np.isfinite(plan.closest_px).any():
        yield Finding(Level.PASS, f"Spots of one picture stay {plan.closest_px.min():.0f} px apart or more.")


def _goals(plan: Plan) -> Iterator[Finding]:
    options, shown = plan.options, (length, angle)
    for k, (what, goal) in enumerate((("Position", options.goal_m), ("Attitude", options.goal_deg))):
        if goal is None:
            continue
        sigma = plan.worst[:, k]
        good = int(np.sum(np.nan_to_num(sigma, nan=np.inf) <= goal))
        words = f"{what} sigma is within {shown[k](goal)} in {percent(good / len(sigma))} of the poses"
        if good == len(sigma):
            yield Finding(Level.PASS, words + ".")
        else:
            yield Finding(
                Level.FAIL if good < FEWEST_MEASURED * len(sigma) else Level.WARN,
                words + ".",
                "The rest of the range would miss the goal.",
                "See the error budget for what to improve first, or narrow the range.",
            )


def worst_first(plan: Plan, count: int) -> list[int]:
    """The poses to show: some that cannot be solved, then those of the largest attitude sigma."""
    blind = np.flatnonzero(~plan.observable)
    fewest = blind[np.argsort(plan.seen[blind].sum(axis=1), kind="stable")][: count // 3]
    solved = np.flatnonzero(plan.observable)
    rest = solved[np.argsort(-plan.worst[solved, 1], kind="stable")][: count - len(fewest)]
    return [*fewest.tolist(), *rest.tolist()]


def axis_words(direction: Array, names: Sequence[str] = ("x", "y", "z")) -> str:
    """A direction (3,) in words: `y`, or `0.8 x − 0.6 z`; a dash for none."""
    if not np.isfinite(direction).all():
        return "–"
    if np.max(np.abs(direction)) > 0.95:
        return names[int(np.argmax(np.abs(direction)))]
    terms = [(f"{abs(v):.1f} {n}", v < 0) for v, n in zip(direction.tolist(), names, strict=True) if abs(v) >= 0.25]
    text = ("−" if terms[0][1] else "") + terms[0][0]
    return text + "".join(f" {'−' if negative else '+'} {term}" for term, negative in terms[1:])
