"""What all results of a recording share: of a run, of a stereo run, of a target in one camera.

One runner checks the folder, processes, and writes summary.json and the page, all or nothing.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np

from geometry.arrays import Array
from lab.files.text.atomic_write import atomic_folder, earlier_results
from lab.files.text.json_text import write_json
from lab.findings.finding import Outcome, Verdict
from lab.packages import versions

R = TypeVar("R")


@dataclass(frozen=True, slots=True, kw_only=True)
class Processed(Generic[R]):
    """A processed recording whose tables are written."""

    schema: str  # of summary.json
    name: str
    result: R
    verdict: Verdict
    frames: int
    measured: int
    frame_rate_hz: float | None  # None: unknown
    parameters: Mapping[str, Any]
    inputs: Sequence[Mapping[str, Any]]  # fingerprints
    notes: Sequence[str]
    blocks: Mapping[str, Any]  # further content of summary.json; mappings are added to those of the same name
    page: Callable[
        [Path, Mapping[str, Any]], object
    ]  # writes the report into a folder, from the content of summary.json
    errors: tuple[str, ...] = field(default=())  # against truth, in words

    def summary(self, wall_s: float) -> dict[str, Any]:
        """The content of summary.json. wall_s: duration of the processing."""
        content: dict[str, Any] = {
            "schema": self.schema,
            "name": self.name,
            "verdict": self.verdict.as_mapping(),
            "counts": {"frames": self.frames},
            "rates": {
                "measured_share": self.measured / max(self.frames, 1),
                "frame_rate_hz": self.frame_rate_hz,
                "processed_frames_per_s": self.frames / wall_s if wall_s > 0 else None,
            },
            "timings": {"wall_s": wall_s},
            "versions": versions(),
            "parameters": self.parameters,
            "inputs": self.inputs,
            "notes": self.notes,
        }
        for name, value in self.blocks.items():
            content[name] = {**content.get(name, {}), **value} if isinstance(value, Mapping) else value
        return content

    def write(self, work: Path, out: Path, started: float, more: Mapping[str, Any]) -> Outcome[R]:
        """Write summary.json and the page into the folder `work`, which becomes `out`.

        started: time.perf_counter() at the start of the command. more: additional content of summary.json.
        """
        content = {**self.summary(time.perf_counter() - started), **more}
        write_json(content, work / "summary.json")
        self.page(work, content)
        said = self.verdict.of_frames(self.measured, self.frames, self.errors)
        return Outcome(self.name, Path(out), self.verdict, self.result, said, content)


def write_processed(
    out: Path, schema: str, process: Callable[[Path], Processed[R]], more: Mapping[str, Any] | None = None
) -> Outcome[R]:
    """Process a recording into the folder `out`; earlier results with the same schema are replaced.

    process: writes the tables into a folder. more: additional content of summary.json. Raises BeamposeError: as
    `process` does, or the folder cannot be written; `out` is then unchanged.
    """
    started = time.perf_counter()
    with atomic_folder(out, earlier_results(schema)) as work:
        return process(work).write(work, out, started, more or {})


def quantiles(values: Array) -> dict[str, float] | None:
    """5 %, median and 95 % of the finite values; None without one."""
    values = values[np.isfinite(values)]
    if not len(values):
        return None
    return dict(zip(("p5", "median", "p95"), np.percentile(values, [5, 50, 95]).tolist(), strict=True))
