"""What a comparison found, as plain sentences and table rows."""

from __future__ import annotations

import numpy as np

from geometry import rotations
from geometry.arrays import Array
from lab.compare.compare import Comparison
from lab.number_format import format_number, format_percent, format_with_sigma
from tracking.comparison.estimation import Estimate
from tracking.comparison.frame_alignment import BODY, LEVER, TRANSLATION, WORLD

_BAD_FIT = 25.0  # variance factor: five times the stated sigmas
_LOST_SHARE = 0.1  # of an undetermined direction in a component that counts as undetermined
UNDETERMINED = "not determined"


def alignment_rows(comparison: Comparison) -> list[tuple[str, str, str]]:
    """Quantity, value with sigma, unit of what was estimated."""
    e = comparison.estimate
    if e is None:
        return []
    a, s = e.alignment, e.sigmas
    lost = e.determined.undetermined
    rows = []
    if e.free[0]:
        offset = UNDETERMINED if "offset_s" in lost else format_with_sigma(a.offset_s, float(s[0]))
        rows.append(("time offset, reference minus result", offset, "s"))
    if e.free[1]:
        rate = UNDETERMINED if "rate" in lost else format_with_sigma(1e6 * a.rate, float(1e6 * s[1]))
        rows.append(("clock rate, reference against result", rate, "ppm"))
    none = np.zeros((0, 3))
    turns, lengths = e.determined.world_axes, e.determined.lever_axes
    for part, name, values, unit, axes in (
        (WORLD, "world rotation", np.rad2deg(rotations.log(a.world)), "deg", turns),
        (BODY, "body rotation", np.rad2deg(rotations.log(a.body)), "deg", none),
        (LEVER, "lever arm", 1e3 * a.lever_m, "mm", lengths),
        (TRANSLATION, "translation", 1e3 * a.translation_m, "mm", none),
    ):
        if e.free[part].all():
            sigmas = (np.rad2deg(s[part]) if unit == "deg" else 1e3 * s[part]).tolist()
            lost_share = np.linalg.norm(axes, axis=0).tolist()
            for axis, value, sigma, share in zip("xyz", values.tolist(), sigmas, lost_share, strict=True):
                known = share < _LOST_SHARE
                rows.append((f"{name} {axis}", format_with_sigma(value, sigma) if known else UNDETERMINED, unit))
    return rows


def undetermined_lines(e: Estimate | None) -> list[str]:
    """What the motion does not determine, one sentence each."""
    if e is None:
        return []
    lines = []
    if e.scale > _BAD_FIT:
        lines.append(
            f"The recordings do not fit: the differences are {format_number(float(np.sqrt(e.scale)))} times the stated"
            " sigmas. The alignment may be wrong: are both of the same motion, and are the units and the order of the"
            " columns right?"
        )
    if "offset_s" in e.determined.undetermined:
        lines.append(
            "The time offset is not determined: the recordings show no common motion that a shift in time would"
            f" change. The differences use {format_number(e.alignment.offset_s)} s."
        )
    elif "rate" in e.determined.undetermined:
        lines.append("The clock rate is not determined: the motion is too short or too slow. It counts as 0.")
    if e.other_offsets:
        others = ", ".join(f"{o:.3f} s" for o in e.other_offsets)
        lines.append(
            f"The time offset is ambiguous: {others} explain their common frames equally well. The differences use"
            f" {e.alignment.offset_s:.3f} s, which explains the most frames; give the right one with --offset."
        )
    if len(e.determined.world_axes) and e.free[BODY].all():
        lines.append(
            f"The world rotation and the body rotation are not distinguished about {_axes(e.determined.world_axes)} of"
            " the reference's world: only their combined effect is known. The body rotation holds for a world"
            " rotation without that part."
        )
    elif len(e.determined.world_axes):
        lines.append(f"The world rotation is not determined about {_axes(e.determined.world_axes)}.")
    if len(e.determined.lever_axes):
        lines.append(
            f"The lever arm is not determined along {_axes(e.determined.lever_axes)} of the body: the attitude changes"
            " too little. Its part there counts as translation."
        )
    return lines


def _axes(axes: Array) -> str:
    if len(axes) == 3:
        return "any axis"
    words = [f"({', '.join(f'{v:.2f}' for v in np.round(axis, 2) + 0.0)})" for axis in axes]
    return "the axis " + words[0] if len(words) == 1 else "the axes " + " and ".join(words)


def lines_of(comparison: Comparison) -> list[str]:
    """What the command prints."""
    found = comparison.differences
    lines = [
        f"{int(found.known.sum())} of {len(comparison.frames)} measured frames compared,"
        f" {int((found.known & ~comparison.used).sum())} of them excluded as outliers"
    ]
    lines += [
        f"{name}: {value}{'' if value == UNDETERMINED else ' ' + unit}"
        for name, value, unit in alignment_rows(comparison)[:2]
    ]
    for axis in comparison.axes:
        if not axis.name.startswith("rotation"):
            f = axis.figures
            lines.append(
                f"{axis.name}: RMS {format_with_sigma(f.rms, f.rms_sigma)} {axis.unit},"
                f" largest {format_number(f.largest)} {axis.unit}"
            )
    if comparison.is_reference:
        c = comparison.noise
        lines.append(
            f"chi-square per degree of freedom: {format_with_sigma(c.factor, c.sigma)}"
            f" ({format_percent(c.within)} of the frames within the 95 % limit)"
        )
    return [*lines, *undetermined_lines(comparison.estimate), *comparison.notes]
