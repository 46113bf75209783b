"""Spots of a folder of pictures, a picture or a video: table, contact sheet, noise, sizes and signal to noise."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from lab.detect.contact_sheet import ContactSheet
from lab.detect.inputs import PictureFiles, Video, open_inputs
from lab.detect.work import Work
from lab.errors import InputError
from lab.files.run.parameter_overrides import overridden
from lab.files.text import columns
from lab.files.text.atomic_write import atomic_folder
from lab.files.text.csv_text import csv_word
from lab.files.text.json_text import write_json
from lab.pictures.picture_file import Missing
from lab.runs.tables import detection_rows
from lab.versions import versions
from tracking.parameters import DetectParameters, TrackerParameters

SCHEMA = "beampose/detect/1"
SHEET = "contact-sheet.png"
_NAMED = 5  # frames of one trouble that are named

Progress = Callable[[int, int | None], None]  # pictures done, pictures in all where known


@dataclass(frozen=True, slots=True)
class DetectOptions:
    """What to look at, and how."""

    camera: str | None = None  # name in the table; None: the folder's or file's
    every: int = 1  # one picture of so many
    limit: int | None = None  # at most so many pictures
    overrides: Mapping[str, Any] = field(default_factory=dict)  # of TrackerParameters, such as detect.threshold_sigma

    def parameters(self) -> DetectParameters:
        """Raises InputError for a parameter that is none of detection."""
        others = [name for name in self.overrides if not name.startswith("detect.")]
        if others:
            raise InputError(
                f"--set: {others[0]}: expected a parameter of detection, such as detect.threshold_sigma; this command"
                " does not track"
            )
        return overridden(TrackerParameters(), self.overrides).detect


@dataclass(frozen=True, slots=True)
class DetectOutcome:
    """What was found."""

    camera: str
    out: Path
    pictures: int
    unreadable: int
    spots: int
    exit_status: int = 0

    def line(self) -> str:
        """One line for the command line."""
        bad = f" ({self.unreadable} more cannot be read)" if self.unreadable else ""
        each = self.spots / max(self.pictures, 1)
        return f"{self.camera}: {self.spots} spots in {_counted(self.pictures)}{bad}, {each:.3g} each -> {self.out}"


def detect_pictures(
    given: list[Path], out: Path, options: DetectOptions = DetectOptions(), progress: Progress | None = None
) -> DetectOutcome:
    """Search pictures for spots, and write detections.csv, a contact sheet, report.html and summary.json into `out`.

    Positions are those of the light's centre: without a rig nothing is known of beams. Raises InputError where the
    pictures or an option cannot be used, or none of the pictures can be read; `out` is then as it was before.
    """
    started = time.perf_counter()
    parameters = options.parameters()
    inputs = open_inputs(given, options.camera)
    source = str(inputs.path if isinstance(inputs, Video) else given[0] if len(given) == 1 else f"{len(given)} files")
    work = Work(inputs.camera, source, parameters, notes=list(inputs.notes))
    with atomic_folder(out, may_replace=are_detections) as folder:
        work.learn([p for p in inputs.to_learn_from() if not isinstance(p, Missing)])
        sheet = ContactSheet(_total(inputs, options))
        _search_all(inputs, work, sheet, folder / "detections.csv", options, progress)
        _conclude(work)
        sheet.write(folder / SHEET)
        from lab.detect.detect_page import write_detect_page  # the template engine: only when there is a result

        write_json(_summary(work, options, time.perf_counter() - started), folder / "summary.json")
        write_detect_page(work, sheet, folder)
    bad = sum(map(len, work.unreadable.values()))
    return DetectOutcome(work.camera, Path(out), work.pictures, bad, work.spots.total)


def are_detections(folder: Path) -> bool:
    """Whether a folder holds what an earlier call wrote."""
    try:
        return bool(json.loads((folder / "summary.json").read_text("utf-8")).get("schema") == SCHEMA)
    except (OSError, ValueError, AttributeError):
        return False


def _search_all(
    inputs: PictureFiles | Video,
    work: Work,
    sheet: ContactSheet,
    table: Path,
    options: DetectOptions,
    progress: Progress | None,
) -> None:
    total, camera = _total(inputs, options), csv_word(work.camera)
    with table.open("w", encoding="utf-8", newline="") as file:
        file.write(",".join(columns.DETECTIONS) + "\n")
        pictures = islice(inputs.pictures(options.every), options.limit)
        for done, (frame, picture) in enumerate(pictures, start=1):
            if isinstance(picture, Missing):
                work.unreadable.setdefault(picture.reason, []).append(frame)
            else:
                found = work.search(frame, picture)
                file.writelines(detection_rows(frame, camera, found))
                sheet.offer(done - 1, frame, picture, found)
            if progress is not None:
                progress(done, total)


def _total(inputs: PictureFiles | Video, options: DetectOptions) -> int | None:
    count = inputs.count(options.every)
    return count if count is None or options.limit is None else min(count, options.limit)


def _conclude(work: Work) -> None:
    """Say what is unusual. Raises InputError where there is no picture at all."""
    if not work.pictures:
        commonest = max(work.unreadable, key=lambda r: len(work.unreadable[r]), default="")
        why = f": {commonest}" if commonest else ""
        raise InputError(f"{work.source}: expected pictures, got none that can be read{why}")
    for reason, frames in work.unreadable.items():
        some = ", ".join(map(str, frames[:_NAMED])) + (", ..." if len(frames) > _NAMED else "")
        work.notes.append(f"{_counted(len(frames))} {reason} (frame {some})")
    if len(work.groups) > 1:
        most = sorted(work.groups.values(), key=lambda g: -g.pictures)
        kinds = "; ".join(f"{_counted(g.pictures)} of {g.words()}" for g in most[:6])
        more = f"; and {len(most) - 6} further kinds" if len(most) > 6 else ""
        work.notes.append(f"pictures of different sizes or depths, each kind with its own noise model: {kinds}{more}")
    work.notes += list(dict.fromkeys(note for g in work.groups.values() for note in g.noise.notes))


def _summary(work: Work, options: DetectOptions, wall_s: float) -> dict[str, Any]:
    table = work.spots.table()
    counts = np.array([n for _, n in work.spots.per_frame])

    def quantiles(values: np.ndarray) -> dict[str, float] | None:
        if not len(values):
            return None
        return dict(zip(("p5", "median", "p95"), np.percentile(values, [5, 50, 95]).tolist(), strict=True))

    return {
        "schema": SCHEMA,
        "camera": work.camera,
        "source": work.source,
        "counts": {
            "pictures": work.pictures,
            "unreadable": {reason: len(frames) for reason, frames in work.unreadable.items()},
            "spots": work.spots.total,
            "spots_per_picture": quantiles(counts),
            "pictures_without_spots": int(np.count_nonzero(counts == 0)),
        },
        "sizes_px": {"major": quantiles(table[:, 3]), "minor": quantiles(table[:, 4])},
        "snr": quantiles(table[:, 5]),
        "noise": [
            {"size_px": g.size_px, "bits": g.bits, "pictures": g.pictures, **g.noise.as_mapping()}
            for g in work.groups.values()
        ],
        "parameters": {"detect": asdict(work.parameters), "every": options.every, "limit": options.limit},
        "timings": {"wall_s": wall_s},
        "versions": versions(),
        "notes": work.notes,
    }


def _counted(pictures: int) -> str:
    return f"{pictures} picture{'' if pictures == 1 else 's'}"
