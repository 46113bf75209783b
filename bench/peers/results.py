"""The figures of one tracker on one scene, and the file with all of them."""

from __future__ import annotations

import csv
import dataclasses
import io
import math
import platform
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from bench.peers.identity import score_identity
from bench.peers.rows import Tracked
from bench.peers.scenes import HIDDEN, OUTSIDE, SCENES, Scene
from bench.peers.trackers import ENTRIES, Entry
from bench.peers.unseen import score_unseen
from lab.files.text.atomic_write import atomic_write_text

SHARED = ("numpy", "scipy", "numba")
NAN = math.nan


@dataclass(frozen=True, slots=True)
class Result:
    """A line of results.csv. nan (empty in the file): unknown or not applicable."""

    tracker: str
    scene: str
    seed: int
    frames: int
    frames_per_s: float  # in process time of the tracking loop; a frame is both cameras
    of_rigid: float  # time relative to `rigid` on the same points in the same run
    identity: float  # share of detected spot-frames with the first label
    idf1: float
    switches: float
    mota: float
    labelled: int  # rows with a first label and a detection
    wrong: int  # these rows that are not at their spot
    gaps_kept: int
    gaps: int
    reentries_kept: int
    reentries: int
    hidden_rms_px: float
    hidden_max_px: float
    outside_covered: float  # share of spot-frames out of view with a position
    outside_rms_px: float
    outside_p95_px: float
    outside_max_px: float
    library: str
    beside: str  # versions of Python and of the common libraries
    measured: str  # start of the run of the bench

    @property
    def key(self) -> tuple[str, str, int, int]:
        """The key by which a new measurement replaces an old one."""
        return self.tracker, self.scene, self.seed, self.frames


def judged(entry: Entry, scene: Scene, rows: Tracked, rigid_s: float, measured: str) -> Result:
    """All figures. rigid_s: process time of `rigid` on this scene; nan if it was not run."""
    identity = score_identity(scene, rows)
    hidden, outside = score_unseen(scene, rows, HIDDEN), score_unseen(scene, rows, OUTSIDE)
    idf1 = switches = mota = NAN
    if find_spec("motmetrics") is not None:
        from bench.peers.multi_object import score_multi_object

        pooled = score_multi_object(scene, rows)
        idf1, switches, mota = pooled.idf1, float(pooled.switches), pooled.mota
    return Result(
        tracker=entry.name,
        scene=scene.name,
        seed=scene.seed,
        frames=len(scene),
        frames_per_s=len(scene) / rows.spent_s,
        of_rigid=rows.spent_s / rigid_s,
        identity=identity.share,
        idf1=idf1,
        switches=switches,
        mota=mota,
        labelled=identity.labelled,
        wrong=identity.wrong,
        gaps_kept=identity.gaps_kept,
        gaps=identity.gaps,
        reentries_kept=identity.reentries_kept,
        reentries=identity.reentries,
        hidden_rms_px=hidden.rms_px,
        hidden_max_px=hidden.max_px,
        outside_covered=outside.covered,
        outside_rms_px=outside.rms_px,
        outside_p95_px=outside.p95_px,
        outside_max_px=outside.max_px,
        library=entry.library_version,
        beside=", ".join([f"python {platform.python_version()}", *(f"{name} {version(name)}" for name in SHARED)]),
        measured=measured,
    )


def read_results(path: Path) -> list[Result]:
    """The content of the file; empty without a file.

    Raises:
        ValueError: the file has other columns.
    """
    if not path.exists():
        return []
    readers: dict[str, Callable[[str], Any]] = {"str": str, "int": int, "float": _number}
    kinds = {f.name: readers[str(f.type)] for f in dataclasses.fields(Result)}
    with path.open(encoding="utf-8", newline="") as file:
        reader = csv.DictReader(file)
        if reader.fieldnames != list(kinds):
            raise ValueError(
                f"{path}: the columns are not those of this bench; choose another --out or remove the file"
            )
        return [Result(**{name: kinds[name](text) for name, text in row.items()}) for row in reader]


def merged(old: Iterable[Result], new: Iterable[Result]) -> list[Result]:
    """All results; a new one replaces the old one of the same tracker, scene, seed and length."""
    by_key = {result.key: result for result in (*old, *new)}
    place = {name: i for i, name in enumerate((*ENTRIES, *SCENES))}

    def order(result: Result) -> tuple[int, ...]:
        return place.get(result.tracker, len(place)), result.frames, place.get(result.scene, len(place)), result.seed

    return sorted(by_key.values(), key=order)


def write_results(results: Iterable[Result], path: Path) -> None:
    """Write the whole file atomically."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(f.name for f in dataclasses.fields(Result))
    for result in results:
        writer.writerow(_text(getattr(result, f.name)) for f in dataclasses.fields(Result))
    atomic_write_text(out.getvalue(), path)


def _number(text: str) -> float:
    return float(text) if text else NAN


def _text(value: str | float) -> str:
    if isinstance(value, float):
        return "" if math.isnan(value) else f"{value:.6g}"
    return str(value)
