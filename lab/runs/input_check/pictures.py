"""`beampose check`: the pictures, times and truth of a run."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np

from geometry.arrays import Ints
from lab.errors import InputError
from lab.files.run.run_file import Run
from lab.files.run.truth import largest_disagreement_px, load_run_truth
from lab.pictures.picture_file import DROPPED, UNREADABLE, MissingPicture
from lab.pictures.source import PictureFiles
from lab.progress import Progress
from lab.runs.frames.even_sampler import EvenSampler
from lab.runs.frames.frames import FrameReader, FrameSet
from lab.runs.input_check.findings import Findings, table
from lab.runs.setup_check.check import MOST_KEPT
from tracking.detections import Detections

AGREES_PX = 0.01  # px: truth written with two decimals agrees with the rig to this
RAGGED_TIMES = 3.0  # a step between timestamps larger or smaller than nominal by this factor is remarked


@dataclass(slots=True)
class _Seen:
    """What the pictures of one camera contain."""

    frames: list[int] = field(default_factory=list)  # frames with a usable picture
    kinds: set[str] = field(default_factory=set)
    points: int = 0
    brightest: int = 0  # DN
    dropped: int = 0
    unreadable: int = 0
    wrong_size: int = 0
    size: str = ""  # why the last of them is wrong


def check_pictures(
    findings: Findings, run: Run, reader: FrameReader, progress: Progress | None
) -> EvenSampler[FrameSet]:
    """Decode all pictures of a run, and check them with its times and its truth; returns a sample without pixels."""
    seen = {name: _Seen() for name in reader.cameras}
    sampler: EvenSampler[FrameSet] = EvenSampler(MOST_KEPT)
    done = 0
    for frame_set in reader:
        points = {name: found for name, found in frame_set.images.items() if isinstance(found, Detections)}
        sampler.add(FrameSet(frame_set.frame, points))
        for name, picture in frame_set.images.items():
            _count(seen[name], frame_set.frame, picture)
        done += 1
        if progress is not None:
            progress(done, reader.expected_frames)
    rate = run.frame_rate_hz
    first, last = reader.first, reader.first + done - 1
    findings.facts += ["", f"Pictures: frames {first} to {last}, {done} in all, {done / rate:.3f} s at {rate:g} Hz"]
    _describe_pictures(findings, run, seen)
    findings.remarks += reader.notes
    for name, source in reader.sources.items():
        if isinstance(source, PictureFiles) and source.ignored:
            some = ", ".join(source.ignored[:3]) + (", ..." if len(source.ignored) > 3 else "")
            findings.remarks.append(
                f"{run.cameras[name].path}: {len(source.ignored)} files of {name!r} are no frames: {some}"
            )
    _compare_cameras(findings, seen)
    frames = np.unique(np.concatenate([np.array(s.frames, dtype=np.int64) for s in seen.values()]))
    _check_times(findings, run, frames)
    _check_truth(findings, run, frames)
    return sampler


def _describe_pictures(findings: Findings, run: Run, seen: dict[str, _Seen]) -> None:
    rows = []
    for name, s in seen.items():
        span = f"{min(s.frames)} to {max(s.frames)}" if s.frames else "none"
        kind = ", ".join(sorted(s.kinds)) + (f" ({s.points})" if "points" in s.kinds else "")
        rows.append((name, str(len(s.frames)), span, str(s.dropped), str(s.unreadable), str(s.wrong_size), kind))
        if not s.frames:
            why = f"all are of the {s.size}: {_why_size(s.size)}" if s.wrong_size else "none can be read"
            findings.problems.append(f"{run.cameras[name].path}: camera {name!r} has no usable picture: {why}")
        if len(s.kinds) > 1:
            findings.remarks.append(f"{run.cameras[name].path}: pictures of different kinds: {', '.join(s.kinds)}")
        if s.brightest == 0 and s.frames and "points" not in s.kinds:
            findings.remarks.append(f"{run.cameras[name].path}: all pictures are black; is the lens covered?")
        if "points" in s.kinds and s.points == 0:
            findings.remarks.append(f"{run.cameras[name].path}: no points of camera {name!r}")
    findings.facts += table(("camera", "usable", "frames", "dropped", "unreadable", "wrong size", "kind"), rows)


def _why_size(reason: str) -> str:
    """The usual mistake behind a picture's size. reason: of the missing picture, with both sizes."""
    width, height, right_width, right_height = (int(n) for n in re.findall(r"\d+", reason)[:4])
    if (width, height) == (right_height, right_width):
        return "turned by 90 deg, or transposed (rows and columns exchanged)?"
    if width * right_height == height * right_width:
        return f"recorded with {width / right_width:.3g} times the resolution of the calibration?"
    if width <= right_width and height <= right_height:
        return "cropped?"
    return "pictures of another camera?"


def _count(seen: _Seen, frame: int, picture: object) -> None:
    if isinstance(picture, MissingPicture):
        seen.dropped += picture.reason == DROPPED
        seen.unreadable += picture.reason.startswith(UNREADABLE)
        if picture.reason.startswith("wrong size"):
            seen.wrong_size += 1
            seen.size = picture.reason
        return
    seen.frames.append(frame)
    if isinstance(picture, Detections):
        seen.kinds.add("points")
        seen.points += len(picture)
    elif isinstance(picture, np.ndarray):
        seen.kinds.add(f"{8 * picture.dtype.itemsize}-bit")
        if seen.brightest == 0:  # one bright picture is enough
            seen.brightest = int(picture.max())


def _compare_cameras(findings: Findings, seen: dict[str, _Seen]) -> None:
    """Reports frames that some cameras have and others lack."""
    if len(seen) < 2:
        return
    ranges = {name: (min(s.frames), max(s.frames), len(s.frames)) for name, s in seen.items() if s.frames}
    for (a, one), (b, other) in combinations(ranges.items(), 2):
        if one[2] == other[2] and one[0] != other[0] and one[1] - one[0] == other[1] - other[0]:
            findings.remarks.append(
                f"cameras: {a!r} and {b!r} have {one[2]} pictures each, numbered from {one[0]} and from {other[0]}: the"
                " same number must be the same instant. Film one flash with both: it must have the same number"
            )
    in_all = set.intersection(*(set(s.frames) for s in seen.values()))
    in_any = set.union(*(set(s.frames) for s in seen.values()))
    if in_any and not in_all:
        findings.problems.append(
            "cameras: no frame number is common to all cameras; the same number must mean the same instant in each"
        )
    elif len(in_any) > len(in_all):
        findings.remarks.append(
            f"cameras: {len(in_any) - len(in_all)} of {len(in_any)} frames are missing in at least one camera"
        )


def _check_times(findings: Findings, run: Run, frames: Ints) -> None:
    if run.times.frames is None or len(frames) < 2:
        return
    steps = np.diff(run.times.t_s(frames)) / np.diff(frames) * run.frame_rate_hz
    worst = int(np.argmax(np.abs(np.log(steps))))
    if not 1 / RAGGED_TIMES <= steps[worst] <= RAGGED_TIMES:
        findings.remarks.append(
            f"{run.path}: timestamps: after frame {frames[worst]} the frame interval is {steps[worst]:.3g} times the"
            f" nominal one (frame_rate_hz: {run.frame_rate_hz:g})"
        )


def _check_truth(findings: Findings, run: Run, frames: Ints) -> None:
    try:
        truth = load_run_truth(run)
    except InputError as error:
        findings.add_error(error)
        return
    if truth is None:
        return
    facts = []
    for name, rows in (("pose.csv", truth.pose), ("spots.csv", truth.spots)):
        if rows is None:
            continue
        known = np.unique(rows.frame)
        if not len(known):
            findings.remarks.append(f"{run.folder / 'truth' / name}: no rows")
            continue
        facts.append(f"{name} frames {known[0]} to {known[-1]}")
        without = np.setdiff1d(frames, known)
        if without.size:
            findings.remarks.append(
                f"{run.folder / 'truth' / name}: has no rows for {without.size} of {len(frames)} frames"
                f" (the first is {without[0]})"
            )
    if truth.pose is not None and len(truth.pose.frame):
        off = np.abs(truth.pose.t_s - run.times.t_s(truth.pose.frame))
        if off.max() > 0.5 / run.frame_rate_hz:
            findings.remarks.append(
                f"{run.folder / 'truth' / 'pose.csv'}: t_s: differs by up to {off.max():.4g} s from the run's own times"
            )
    worst = largest_disagreement_px(truth, run.rig)
    if worst is not None:
        facts.append(f"poses and spots agree through the rig to {worst[0]:.2g} px")
        if worst[0] > AGREES_PX:
            findings.remarks.append(
                f"{run.folder / 'truth'}: spots.csv differs by {worst[0]:.3g} px from the projection of pose.csv"
                f" through the rig (frame {worst[1]}); does the truth belong to another rig?"
            )
    findings.facts += ["", f"Truth: {'; '.join(facts)}"]
