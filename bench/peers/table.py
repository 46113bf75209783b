"""Results as a Markdown table: one line per tracker, over all its scenes and seeds."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from bench.peers.results import Result
from bench.peers.scenes import SCENES
from bench.peers.trackers import ENTRIES

MISSING = "not installed: make peers"
NOTHING = "-"
SPEED_SCENES = ("standard", "dense")


def markdown(results: Sequence[Result], names: Sequence[str]) -> str:
    """The table of the trackers `names` in this order; one without results has the reason instead."""
    columns = [
        "tracker",
        "seeds",
        *(f"identity: {SCENES[0]}", *SCENES[1:]),
        "IDF1",
        "switches per scene",
        "wrong rows",
        "gaps kept",
        "re-entries kept",
        "out of view, RMS / max px",
        *(f"frames/s: {SPEED_SCENES[0]}", *SPEED_SCENES[1:]),
        *(f"time / rigid's: {SPEED_SCENES[0]}", *SPEED_SCENES[1:]),
    ]
    lines = [columns, ["---"] * len(columns)]
    for name in names:
        mine = [r for r in results if r.tracker == name]
        entry = ENTRIES[name]
        if mine:
            lines.append(_cells(name, mine, len(columns)))
        else:
            reason = NOTHING if entry.installed else MISSING
            lines.append([name, reason, *[NOTHING] * (len(columns) - 2)])
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _cells(name: str, mine: Sequence[Result], width: int) -> list[str]:
    """One tracker's line."""

    def mean(what: Callable[[Result], float], scene: str, form: str) -> str:
        return _form([what(r) for r in mine if r.scene == scene], form)

    seeds = sorted({r.seed for r in mine})
    whole = seeds == list(range(seeds[0], seeds[-1] + 1)) and len(seeds) > 2
    outside = [r for r in mine if not np.isnan(r.outside_rms_px)]
    rms = np.sqrt(np.mean([r.outside_rms_px**2 for r in outside])) if outside else np.nan
    cells = [
        name,
        f"{seeds[0]} to {seeds[-1]}" if whole else ", ".join(map(str, seeds)),
        *(mean(lambda r: r.identity, scene, ".4f") for scene in SCENES),
        _form([r.idf1 for r in mine], ".3f"),
        _form([r.switches for r in mine], ".1f"),
        f"{sum(r.wrong for r in mine)}/{sum(r.labelled for r in mine)}",
        f"{sum(r.gaps_kept for r in mine)}/{sum(r.gaps for r in mine)}",
        f"{sum(r.reentries_kept for r in mine)}/{sum(r.reentries for r in mine)}",
        f"{rms:.2f} / {max(r.outside_max_px for r in outside):.1f}" if outside else NOTHING,
        *(mean(lambda r: r.frames_per_s, scene, ".0f") for scene in SPEED_SCENES),
        *(mean(lambda r: r.of_rigid, scene, ".2f") for scene in SPEED_SCENES),
    ]
    if len(cells) != width:
        raise AssertionError(f"{len(cells)} cells for {width} columns")
    return cells


def _form(values: Sequence[float], form: str) -> str:
    """The mean of the known values."""
    known = [v for v in values if not np.isnan(v)]
    return format(float(np.mean(known)), form) if known else NOTHING
