"""Tracks one target through a recording: its table, summary.json, report.html and findings that all targets share.

The overlay video is the pictures with the target's outline, its centre, its path and the status.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from geometry.arrays import Array
from lab.files.run.fingerprints import fingerprints_of
from lab.files.text.csv_text import write_table
from lab.findings.finding import Finding, Level, Outcome, Verdict, entries, finding, worst_first
from lab.number_format import format_some
from lab.pictures.picture_file import MissingPicture
from lab.pictures.source import open_inputs
from lab.progress import Progress
from lab.report.frames.canvas import Canvas, Pixels, write_overlay_video
from lab.report.plot.svg import grey_limits, stretched
from lab.runs.processed import Processed, write_processed
from lab.runs.verdict.quality import GOOD_MEASURED
from lab.targets.page import write_target_page
from lab.targets.recording import DEFAULT_RATE_HZ, every_frame
from lab.targets.target import F, Target, Track
from tracking.statuses import Cause, PoseStatus

_LARGEST_SIDE = 1920  # px of the video
_RATE_RANGE_HZ = (1.0, 240.0)  # of the video: players do not show others well
_PATH_FRAMES = 100  # frames of the path that are drawn
_COLOURS = {PoseStatus.MEASURED: (60, 220, 60), PoseStatus.PREDICTED: (30, 160, 255), PoseStatus.LOST: (60, 60, 230)}


def write_overlay(target: Target[F], track: Track[F], folder: Path) -> None:
    """Write the video, a picture per frame number; black where there is none.

    Raises RunError: OpenCV cannot write it.
    """
    rate = float(np.clip(track.recording.rate_hz or DEFAULT_RATE_HZ, *_RATE_RANGE_HZ))
    write_overlay_video(folder, _images(target, track), rate)


def _images(target: Target[F], track: Track[F]) -> Iterator[NDArray[np.uint8]]:
    recording = track.recording
    assert recording.size_px is not None  # of pictures
    scale = min(1.0, _LARGEST_SIDE / max(recording.size_px))
    width, height = (2 * max(round(side * scale / 2), 1) for side in recording.size_px)
    limits: tuple[float, float] | None = None
    for k, (_, picture) in enumerate(every_frame(open_inputs([recording.path]), target.options.limit)):
        grey: NDArray[np.uint8] = np.zeros((height, width), np.uint8)
        if not isinstance(picture, MissingPicture):
            limits = limits or grey_limits(picture)
            shown = cv2.resize(stretched(picture, *limits), (width, height), interpolation=cv2.INTER_AREA)
            grey = np.asarray(shown, np.uint8)
        yield drawn(grey, target, track, k, np.array([width, height]) / recording.size_px)


def drawn(grey: NDArray[np.uint8], target: Target[F], track: Track[F], k: int, scale: Array) -> NDArray[np.uint8]:
    """A picture (h, w) of frame k (from 0) as (h, w, 3), BGR, with the track up to it.

    scale: (2,) of the picture, against that of the recording. The outline is a circle of the target's size; of a target
    without a size, of 3 sigma.
    """
    line = max(1, round(min(grey.shape) / 500))
    image: Pixels = np.asarray(cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR), np.uint8)
    canvas = Canvas(image, np.array([-0.5, -0.5]), scale, line)
    path = track.frames[max(0, k - _PATH_FRAMES) : k + 1]
    for before, after in itertools.pairwise(path):
        canvas.line(np.array([before.place[:2], after.place[:2]]), _COLOURS[after.status], 1 / line)
    now = track.frames[k]
    colour = _COLOURS[now.status]
    if np.isfinite(now.place[:2]).all():
        size = now.place[2] / target.size_radii
        size = size if np.isfinite(size) else max(3 * float(now.sigmas[:2].max()), 4 / scale[0])
        canvas.ring(now.place[:2], float(np.clip(size, 0, 1e5)) * float(scale.mean()) / line, colour)
        canvas.cross(now.place[:2], 4.5, colour)
    label = f"{track.recording.numbers[k]}  {now.status.value}" + (f" ({now.cause})" if now.cause.value else "")
    canvas.words((6, 8 + 14 * line), label, 11.7 * line, colour)
    return canvas.image


def findings_of(target: Target[F], track: Track[F]) -> tuple[Finding, ...]:
    """All findings, failures first."""
    found = [
        _measured(target, track),
        *_ambiguous(target, track),
        *_far_away(target, track),
        *target.findings(track),
        *_missing(target, track),
        *_delivered(track),
    ]
    return worst_first(found)


def _measured(target: Target[F], track: Track[F]) -> Finding:
    measured, n, causes = int(track.measured.sum()), len(track.frames), track.causes()
    share, least = measured / n, target.least_measured
    cause = next(iter(causes)).value if causes else ""
    of_others = ", ".join(f"{count} {cause}" for cause, count in list(causes.items())[:3])
    if not measured:
        what = f"no {target.subject} was found in {n} frames ({of_others})"
        remedy = entries()[target.codes.few].variant(cause).remedy
        return finding(target.codes.none, Level.FAIL, what, remedy=remedy)
    what = f"{measured} of {n} frames ({share:.1%}) have a measured {target.subject}"
    level = Level.FAIL if share < least else Level.WARN if share < GOOD_MEASURED else Level.PASS
    if level > Level.PASS:
        gate = f"gate: {100 * least:.3g}%; usual: {GOOD_MEASURED:.0%} and more"
        what += f" ({gate})" + (f"; of the others {of_others}" if of_others else "")
    return finding(target.codes.few, level, what, variant=cause)


def _ambiguous(target: Target[F], track: Track[F]) -> list[Finding]:
    numbered = zip(track.recording.numbers.tolist(), track.frames, strict=True)
    frames = [(number, f.found) for number, f in numbered if f.cause is Cause.AMBIGUOUS]
    if not frames:
        return []
    most = max(found for _, found in frames)
    what = f"{len(frames)} frames show {target.several} (first: frame {frames[0][0]}; up to {most})"
    return [finding(target.codes.ambiguous, Level.WARN, what)]


def _far_away(target: Target[F], track: Track[F]) -> list[Finding]:
    """Reacquisitions far from the last known place: it may be another object."""
    known, far = np.full(3, np.nan), []
    for number, frame, now in zip(track.recording.numbers.tolist(), track.frames, track.places, strict=True):
        if frame.event == "reacquired" and np.hypot(*(now[:2] - known[:2])) > target.far_sizes * known[2]:
            far.append(number)
        if np.isfinite(now).all():
            known = now
    if not far:
        return []
    what = (
        f"{len(far)} reacquisition{' lies' if len(far) == 1 else 's lie'} more than {target.far_words} from the last"
        f" known place (frame {format_some(far)})"
    )
    return [finding(target.codes.far, Level.WARN, what)]


def _missing(target: Target[F], track: Track[F]) -> list[Finding]:
    missing, n = track.recording.missing, len(track.frames)
    if sum(missing.values()) <= target.usual_missing * n:
        return []
    reason = max(missing, key=lambda r: missing[r])
    what = f"{sum(missing.values())} of {n} frames have no usable picture (most frequent: {reason})"
    return [finding(target.codes.missing, Level.WARN, what)]


def _delivered(track: Track[F]) -> list[Finding]:
    """Pictures that do not show one instant each."""
    out, share = [], track.recording.delivery.averaged_share
    if share:
        late = f"what moves is shown {share / (1 - share):.2g} frames late or more"
        what = f"at least {share:.0%} of each picture is the picture before: {late}"
        out.append(finding("BP-U01", Level.WARN, what))
    if track.recording.delivery.interlaced:
        what = "even and odd rows show what moves at two places: the pictures are interlaced"
        out.append(finding("BP-U02", Level.WARN, what))
    return out


MOST_EVENTS = 500  # listed in summary.json; of the others the number is reported


def track_target(
    target: Target[F], given: Path, out: Path, progress: Progress | None = None, more: Mapping[str, Any] | None = None
) -> Outcome[Track[F]]:
    """Track one target, and write the results into the folder `out`.

    more: additional content of summary.json. Raises InputError: the input or an option cannot be used, or no picture
    can be read; `out` is then unchanged. Raises RunError: OpenCV cannot write the video.
    """
    return write_processed(out, target.schema, lambda folder: _tracked(target, given, folder, progress), more)


def _tracked(target: Target[F], given: Path, folder: Path, progress: Progress | None) -> Processed[Track[F]]:
    """The track through a recording, whose table and video are written into a folder."""
    track = target.read(given, progress)
    recording, events, findings = track.recording, track.events(), findings_of(target, track)
    write_table(folder / target.table, target.columns, (target.row(track, k) for k in range(len(track.frames))))
    for name, (columns, rows) in target.more_tables(track).items():
        write_table(folder / name, columns, rows)
    if target.options.overlay:
        write_overlay(target, track, folder)
    blocks: dict[str, Any] = {
        "source": str(recording.path.resolve()),
        "counts": {
            "pictures": recording.pictures,
            "status": track.statuses(),
            "not_measured": {cause.value: count for cause, count in track.causes().items()},
            "no_image_reasons": recording.missing,
            "events": len(events),
        },
        "timings": {"tracking_process_s": track.tracking_s},
        "events": [
            {"frame": number, "kind": f.event, f"{target.subject}s": f.found} for number, f in events[:MOST_EVENTS]
        ],
    }
    for name, value in target.figures(track).items():
        blocks[name] = {**blocks.get(name, {}), **value} if isinstance(value, Mapping) else value
    return Processed(
        schema=target.schema,
        name=recording.name,
        result=track,
        verdict=Verdict(findings),
        frames=len(track.frames),
        measured=int(track.measured.sum()),
        frame_rate_hz=recording.rate_hz,
        parameters=target.parameters(),
        inputs=fingerprints_of((), (recording.path,)),
        notes=recording.notes,
        blocks=blocks,
        page=lambda work, _: write_target_page(target, track, findings, work),
    )
