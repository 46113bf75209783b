"""Processes one stereo run: a run folder in, a result folder out.

The verdict on a stereo run: findings with reason and remedy. A FAIL sets the exit status 4.
"""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from geometry.arrays import evenly_spread
from geometry.pose import Pose
from lab.errors import InputError
from lab.files.rig.camera_file import require_valid_calibration
from lab.files.run.fingerprints import fingerprints_of
from lab.files.run.truth import TruePoses, read_true_poses
from lab.findings.finding import Finding, Level, Outcome, Verdict, finding, level_above, passed, worst_first
from lab.number_format import decimals_of, format_length, format_number
from lab.pictures.picture_file import MissingPicture
from lab.progress import Progress
from lab.runs.processed import Processed, write_processed
from lab.runs.verdict.quality import GOOD_MEASURED, GOOD_PICTURES, LEAST_MEASURED
from lab.targets.stereo.frames import StereoFrame, stereo_frames
from lab.targets.stereo.page import write_stereo_page
from lab.targets.stereo.run import (
    GOOD_NOISE_SCALE,
    LARGEST_NOISE_SCALE,
    StereoRecord,
    StereoResults,
    StereoRun,
    load_stereo_run,
    truth_errors,
)
from lab.targets.stereo.tables import write_tables
from tracking.binocular.calibration_check import (
    FEWEST_CLOCK_FRAMES,
    FEWEST_FRAMES,
    MOST_ALONE,
    MOST_FRAMES,
    CalibrationCheck,
    FittedFrame,
    LabelledFrame,
    check_calibration,
    clock_offset,
    labelled_by_each,
)
from tracking.binocular.marker_model import MarkerImages
from tracking.binocular.pose_tracker import AMBIGUOUS, BinocularTracker
from tracking.binocular.segmentation import is_grey, marker_candidates, prepared

_ENOUGH, _FEWEST_SEEN = 4, 2  # markers of a picture that determine a pose, and frames with as many in both
LARGEST_NEES = 20.0  # per number, of poses with an error of the calibration: above, the sigmas are of no use
_MOST_NAMED = 4  # errors of the calibration in a message


def findings_of(results: StereoResults) -> tuple[Finding, ...]:
    """All findings, the most severe first."""
    found = [
        *_calibration(results),
        *_measured(results),
        *_cameras(results),
        *_together(results),
        *_clock(results),
        *_noise(results),
        *_ambiguous(results),
    ]
    return worst_first(found)


def _measured(results: StereoResults) -> Iterator[Finding]:
    total, measured = len(results.records), len(results.measured)
    share = measured / max(total, 1)
    reasons = Counter(r.tracked.reason for r in results.records if not r.measured)
    most = "; ".join(f"{reason}: {n}" for reason, n in reasons.most_common(3))
    what = f"{measured} of {total} frames have a measured pose" + (f" ({most})" if most else "")
    if not measured:
        yield finding("BP-W01", Level.FAIL, what)
    elif share < GOOD_MEASURED:
        yield finding("BP-W02", Level.FAIL if share < LEAST_MEASURED else Level.WARN, what)
    else:
        yield passed(what)


def _cameras(results: StereoResults) -> Iterator[Finding]:
    total = max(len(results.records), 1)
    for c, camera in enumerate(results.run.pair.cameras):
        missing = [r.missing[c] for r in results.records if r.missing[c]]
        if len(missing) > (1 - GOOD_PICTURES) * total:
            reason, count = Counter(missing).most_common(1)[0]
            what = f"camera {camera.name}: {len(missing)} of {total} frames have no picture ({reason}: {count})"
            yield finding("BP-W03", Level.WARN, what)
        with_picture = [r.candidates[c] for r in results.records if r.candidates[c] is not None]
        empty = sum(1 for found in with_picture if found is not None and len(found) < 3)
        if with_picture and empty > 0.5 * len(with_picture):
            what = f"camera {camera.name}: fewer than three markers in {empty} of {len(with_picture)} pictures"
            yield finding("BP-W04", Level.WARN, what)


def _together(results: StereoResults) -> Iterator[Finding]:
    """Whether the two cameras see the same moments: poses of one camera alone do not show it."""
    if not results.measured:
        return
    sees = [[r for r in results.records if _has_markers(r.candidates[c])] for c in range(2)]
    seen = [r for r in sees[0] if _has_markers(r.candidates[1])]
    if not seen and all(sees):
        names = [camera.name for camera in results.run.pair.cameras]
        spans = "; ".join(f"{n}: {own[0].frame} to {own[-1].frame}" for n, own in zip(names, sees, strict=True))
        yield finding("BP-W09", Level.FAIL, f"no frame has markers in both cameras ({spans})")
        return
    joint = sum(1 for r in seen if r.measured)
    if len(seen) >= _FEWEST_SEEN and joint < LEAST_MEASURED * len(seen):
        what = (
            f"{joint} of {len(seen)} frames with markers in both pictures have a measured pose; the others are those of"
            " a single camera"
        )
        yield finding("BP-W09", Level.FAIL, what)


def _has_markers(found: MarkerImages | None) -> bool:
    return found is not None and len(found) >= _ENOUGH


def _clock(results: StereoResults) -> Iterator[Finding]:
    clock = results.clock
    if clock is None:
        if results.measured:
            what = (
                f"{len(results.measured)} measured frames do not show whether both cameras expose at the same time;"
                f" needed are {FEWEST_CLOCK_FRAMES} with a measured pose before and after each"
            )
            yield finding("BP-W11", Level.WARN, what)
        return
    offset = f"{1000 * clock.offset_s:.2f} ± {1000 * clock.sigma_s:.2f} ms"
    if clock.significant and not _is_clock(results):
        return
    if not clock.significant:
        yield passed(f"the right pictures are taken {offset} after the left ones: synchronised")
        return
    scattered = abs(clock.offset_s) <= 5 * clock.sigma_s
    what = (
        f"the offset between the two exposures scatters by {1000 * clock.jitter_s:.2f} ms"
        if scattered
        else f"the right pictures are taken {offset} after the left ones"
    )
    what += f": the residuals grow with the velocity in the picture ({clock.shift_px:.2f} px RMS)"
    yield finding("BP-W05", Level.FAIL, what)


def _calibration(results: StereoResults) -> Iterator[Finding]:
    """Errors of the pair's calibration; with a pair that states no covariance, the poses have no complete sigmas."""
    check = results.calibration
    if check is None and results.measured:
        what = f"the recording does not show whether {results.run.pair_path.name} is right"
        what += f"; needed are {FEWEST_FRAMES} frames with four markers in each picture"
        yield finding("BP-W11", Level.WARN, what)
    if check is not None and check.significant and not _is_clock(results):
        yield finding("BP-W06", *contradiction(check, results.run.pair_path.name))
    if check is not None and not check.certain:
        yield passed(f"the markers show no error of {results.run.pair_path.name}; {_not_shown(results)}")
    if results.run.pair.covariance is None:
        yield finding("BP-W10", Level.WARN, f"{results.run.pair_path.name} states no covariance of the calibration")


def contradiction(check: CalibrationCheck, file_name: str) -> tuple[Level, str]:
    """The errors of a calibration that explain the residuals of the markers, with their corrections, and how bad."""
    several = " or ".join(
        f"{s.name} by {s.value:+.{decimals_of(s.sigma)}f} ± {s.sigma:.{decimals_of(s.sigma)}f} {s.unit}"
        for s in check.suspects[:_MOST_NAMED]
    )
    apart = "; this recording does not separate them" if len(check.suspects) > 1 else ""
    other = "; it does not explain all: there are more errors, or pictures of different times"
    other = "" if check.left < GOOD_NOISE_SCALE**2 else other
    what = (
        f"the markers contradict {file_name}: to be corrected: {several}{apart}{other}; poses move by"
        f" {format_length(check.change_m)} RMS"
    )
    return Level.FAIL if check.change_sigmas**2 > LARGEST_NEES else Level.WARN, what


def _not_shown(results: StereoResults) -> str:
    """The error of the pair that this recording leaves to its calibration, in words; empty without a test."""
    check = results.calibration
    if check is None:
        return ""
    return (
        f"a common error of both focal lengths below {check.hidden_focal_percent:.2g} % would not show and changes all"
        f" distances alike, they rest on {results.run.pair_path.name}"
    )


def _is_clock(results: StereoResults) -> bool:
    """Whether an offset of the clocks explains the residuals, and an error of the calibration does not."""
    clock, check = results.clock, results.calibration
    if clock is None or not clock.significant:
        return False
    return check is None or not check.certain or check.left > GOOD_NOISE_SCALE**2


def _noise(results: StereoResults) -> Iterator[Finding]:
    scale = results.noise_scale
    if not np.isfinite(scale):
        return
    what = f"residuals are {format_number(scale)} times as large as the stated sigmas of the markers"
    yield finding("BP-W07", level_above(scale, GOOD_NOISE_SCALE, LARGEST_NOISE_SCALE), what)


def _ambiguous(results: StereoResults) -> Iterator[Finding]:
    count = sum(1 for r in results.records if r.tracked.reason == AMBIGUOUS)
    if count > 0.05 * len(results.records):
        yield finding("BP-W08", Level.WARN, f"{count} frames have two attitudes that explain the markers")


SUMMARY_SCHEMA = "beampose/stereo-summary/1"
_GREY_CHECKED = 5  # pictures in which a target of saturated colours must have some colour


def process_stereo_run(run_folder: Path, out: Path, progress: Progress | None = None) -> Outcome[StereoResults]:
    """Process one stereo run folder into the folder `out`: tables, summary.json, pictures and report.html.

    Raises BeamposeError: the run cannot be processed (CalibrationError: its pair's calibration must not be used); `out`
    is then unchanged.
    """
    return write_processed(out, SUMMARY_SCHEMA, lambda work: _processed(run_folder, work, progress))


def _processed(run_folder: Path, work: Path, progress: Progress | None) -> Processed[StereoResults]:
    """The run, whose tables are written into the folder `work`."""
    run = load_stereo_run(run_folder)
    require_valid_calibration(run.calibration, run.pair_path, run.recorded)
    truth_path = run.folder / "truth" / "pose.csv"
    truth = read_true_poses(truth_path) if truth_path.is_file() else None
    results = measure(run, progress)
    add_truth(results, truth)
    findings = findings_of(results)
    write_tables(results, work)
    errors = None if results.errors is None else results.errors.as_mapping()
    words = () if errors is None else (f"position error {format_length(errors['position_rms_m'])} RMS",)
    files = [run.path, run.pair_path, *(p for p in (run.target_path, run.times_path) if p is not None)]
    files += [p for p in (run.folder / "truth" / name for name in ("pose.csv", "spots.csv")) if p.is_file()]
    return Processed(
        schema=SUMMARY_SCHEMA,
        name=run.name,
        result=results,
        verdict=Verdict(findings, _not_shown(results)),
        frames=len(results.records),
        measured=len(results.measured),
        frame_rate_hz=run.frame_rate_hz,
        parameters=dataclasses.asdict(run.parameters),
        inputs=fingerprints_of(files, [s.path for s in run.cameras.values()]),
        notes=results.notes,
        blocks={
            "run_folder": str(run.folder.resolve()),
            "pair": str(run.pair_path.resolve()),
            "calibration": None if run.calibration is None else run.calibration.as_mapping(),
            "notes_of_run": run.notes,
            "counts": _counts(results),
            "rates": {"noise_scale": results.noise_scale},
            "pair_check": _pair_check(results),
            "errors": errors,
        },
        page=lambda folder, _: write_stereo_page(results, findings, folder),
        errors=words,
    )


def measure(run: StereoRun, progress: Progress | None = None) -> StereoResults:
    """The records of all frames, and the offset between the cameras' clocks.

    Raises InputError: the pictures cannot be read, or are grey while the markers are coloured.
    """
    results = StereoResults(run)
    tracker = BinocularTracker(run.pair, run.target.model, run.parameters.match)
    colour = _ColourCheck(run)
    for frame in stereo_frames(run):
        colour.look(frame)
        candidates = candidates_of(run, frame)
        t_s = float(run.times.t_s(frame.frame))
        missing = [c.reason if isinstance(c, MissingPicture) else "" for c in frame.content]
        tracked = tracker.step(t_s, candidates)
        results.records.append(StereoRecord(frame.frame, t_s, candidates, (missing[0], missing[1]), tracked))
        if progress is not None:
            progress(len(results.records), None)
    _require_pictures(results)
    fitted = [
        FittedFrame(r.t_s, r.tracked.fit, r.tracked.observed)
        for r in results.records
        if r.tracked.fit is not None and r.tracked.observed is not None
    ]
    results.clock = clock_offset(run.pair, run.target.model, fitted)
    results.calibration = check_calibration(run.pair, run.target.model, _labelled(results))
    return results


def _labelled(results: StereoResults) -> list[LabelledFrame]:
    """Some frames with markers in both pictures, evenly spaced: their images, labelled.

    The labels of a measured pose are used where it explains all candidates. Otherwise each picture of a few frames is
    labelled alone, which takes long: an error of the calibration makes a pose refuse images.
    """
    run, model = results.run, results.run.target.model
    both = [r for r in results.records if all(f is not None and len(f) >= _ENOUGH for f in r.candidates)]
    some, alone = (evenly_spread(np.arange(len(both)), most).tolist() for most in (MOST_FRAMES, MOST_ALONE))
    out = []
    for k in sorted({*some, *alone}):
        record = both[k]
        t, (left, right) = record.tracked, record.candidates
        assert left is not None
        assert right is not None
        expected = min(len(left), len(model)) + min(len(right), len(model))
        if record.measured and t.pose is not None and t.observed is not None and (t.index >= 0).sum() >= expected:
            out.append(LabelledFrame(t.observed, t.pose))
            continue
        if k not in alone:
            continue
        start = t.pose if record.measured else None
        found = labelled_by_each(run.pair, model, (left, right), start, run.parameters.match)
        if found is not None:
            out.append(found)
    return out


def candidates_of(run: StereoRun, frame: StereoFrame) -> tuple[MarkerImages | None, MarkerImages | None]:
    """The marker candidates of both pictures of a frame; None where there is no picture."""
    p = run.parameters.segmentation
    pictures = [c if isinstance(c, np.ndarray) else None for c in frame.content]
    as_seen = prepared(pictures[0], pictures[1], p)
    out: list[MarkerImages | None] = []
    for content, picture, seen in zip(frame.content, pictures, as_seen, strict=True):
        if picture is not None and seen is not None:
            out.append(marker_candidates(picture, seen, run.target.colours, p))
        else:
            out.append(content if isinstance(content, MarkerImages) else None)
    return out[0], out[1]


def add_truth(results: StereoResults, truth: TruePoses | None) -> None:
    """Compare the measured poses with the true ones, where there are any."""
    if truth is not None:
        poses = Pose.from_quaternion(truth.quaternion_wxyz, truth.position_m)
        results.errors = truth_errors(results.records, results.run, truth.frame.astype(float), poses)


class _ColourCheck:
    """Whether the first pictures of each camera have colour. Black ones, which show no marker, say nothing about it."""

    def __init__(self, run: StereoRun) -> None:
        self._run = run
        self._looked = [0, 0]  # pictures of each camera
        self._grey = [0, 0]
        self._least_light = 255 * min(colour.value[0] for colour in run.target.colours)
        self._needed = all(colour.saturation[0] > 0 for colour in run.target.colours)

    def look(self, frame: StereoFrame) -> None:
        """Raises InputError where a camera's pictures are grey, and no colour range can match a grey pixel."""
        for c, content in enumerate(frame.content):
            if not self._needed or not isinstance(content, np.ndarray) or self._looked[c] == _GREY_CHECKED:
                continue
            if content.max() <= self._least_light:
                continue
            self._looked[c] += 1
            self._grey[c] += int(is_grey(content))
            if self._grey[c] == _GREY_CHECKED:
                raise InputError(
                    f"{self._run.path}: cameras: expected colour pictures, got grey ones; for bright lamps in grey"
                    " pictures set saturation: [0, 1] and a high value in target.colours"
                )


def _require_pictures(results: StereoResults) -> None:
    """Raises InputError where a camera has no usable picture at all: one camera is no pair."""
    for c, (name, source) in enumerate(results.run.cameras.items()):
        reasons = Counter(r.missing[c] for r in results.records if r.missing[c])
        if not results.records or sum(reasons.values()) == len(results.records):
            why = f" ({reasons.most_common(1)[0][0]})" if reasons else ""
            raise InputError(
                f"{source.path}: camera {name}: expected pictures, got none that can be used{why}; a single camera is"
                " no stereo pair"
            )


def _counts(results: StereoResults) -> dict[str, Any]:
    records = results.records
    return {
        "pose_status": dict(Counter(r.tracked.status.value for r in records)),
        "not_measured": dict(Counter(r.tracked.reason for r in records if not r.measured)),
        "no_image": {name: sum(1 for r in records if r.missing[c]) for c, name in enumerate(results.run.cameras)},
        "candidates_per_frame": {
            name: float(np.mean([0 if f is None else len(f) for f in (r.candidates[c] for r in records)]))
            for c, name in enumerate(results.run.cameras)
        },
    }


def _pair_check(results: StereoResults) -> dict[str, Any]:
    clock = results.clock
    return {
        "baseline_m": results.run.pair.baseline_m,
        "clock": None
        if clock is None
        else {
            "offset_s": clock.offset_s,
            "sigma_s": clock.sigma_s,
            "jitter_s": clock.jitter_s,
            "shift_px": clock.shift_px,
            "significant": clock.significant,
            "rotation_of_right_rad": clock.rotation_rad.tolist(),
            "rotation_sigma_rad": clock.rotation_sigma_rad.tolist(),
        },
        "calibration": None if results.calibration is None else dataclasses.asdict(results.calibration),
    }
