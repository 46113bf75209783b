"""`beampose check`: reads a rig file or a run folder as a run does, and reports what it finds as plain lines.

Its subjects are the pictures, times and truth of a run, what the rig can see over a range of poses, the mistakes that
the files or the recording show, and those that no recording would show.
"""

from __future__ import annotations

import datetime
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path

import numpy as np

from geometry import rotations
from geometry.arrays import Ints, evenly_spaced
from geometry.forward_model import SpotModel
from geometry.pose_prior import PosePrior
from geometry.pose_solver import visibility
from geometry.pose_solver.gauss_newton import SolveLimits
from geometry.pose_solver.visibility import symmetries
from geometry.rig import Rig
from geometry.uncertainty.rig_uncertainty import RigCovariance
from lab.errors import CalibrationError, InputError
from lab.files.rig.camera_file import CalibrationState, require_valid_calibration
from lab.files.rig.rig_file import joint_covariance, load_rig_file
from lab.files.run.run_file import DetectionsTable, Run, load_run
from lab.files.run.truth import largest_disagreement_px, load_run_truth
from lab.files.text.error_text import FileError
from lab.findings.finding import Done, Level, sentence
from lab.number_format import format_number, format_percent, format_some
from lab.pictures.picture_file import DROPPED, UNREADABLE, MissingPicture
from lab.pictures.source import PictureFiles
from lab.progress import Progress
from lab.runs.frames.frames import FrameReader, open_frames, pictures_at
from lab.runs.setup_check import SampledFrames, mistakes_by_themselves, points_in, rates_of_videos, recorded_mistakes
from tracking.detections import Detections
from tracking.parameters import LabelParameters
from tracking.setup_mistakes.evidence import ENOUGH, NAMES, Invisible, invisible_mistakes
from tracking.setup_mistakes.possible import HERE, SHOWN_BY, Block, possible_mistakes


@dataclass(slots=True)
class Findings:
    """Collects the findings of the single checks."""

    subject: str
    problems: list[str] = field(default_factory=list)  # a run would stop, or be wrong
    remarks: list[str] = field(default_factory=list)  # a run continues
    facts: list[str] = field(default_factory=list)
    unusable: list[str] = field(default_factory=list)  # reasons why the calibration stops a run

    def add_error(self, error: InputError) -> None:
        """Add the lines of an input error to the problems."""
        self.problems += error.lines if isinstance(error, FileError) else str(error).splitlines()

    def result(self) -> Done[None]:
        """The findings as lines. Exit status 2: something must be corrected first; 3: that is the calibration alone."""
        counts = [
            f"{len(lines)} {word}{'s' if len(lines) > 1 else ''}"
            for word, lines in (("problem", self.problems + self.unusable), ("remark", self.remarks))
            if lines
        ]
        lines = [f"{self.subject}: {', '.join(counts) or 'fine'}"]
        if self.problems or self.unusable:
            lines += ["", "Problems, to be corrected first:", *(f"  {p}" for p in self.problems + self.unusable)]
        if self.remarks:
            lines += ["", "Remarks; a run continues with these:", *(f"  {r}" for r in self.remarks)]
        if self.facts:
            lines += ["", *self.facts]
        status = InputError.exit_status if self.problems else CalibrationError.exit_status if self.unusable else 0
        return Done(None, tuple(lines), exit_status=status)


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Aligned columns: texts to the left, numbers to the right."""
    widths = [max(len(r[i]) for r in (header, *rows)) for i in range(len(header))]
    numeric = [
        bool(rows) and all(r[i][:1].isdigit() and r[i][-1:] in "0123456789%" for r in rows) for i in range(len(header))
    ]
    return [
        "  " + "  ".join(c.rjust(w) if n else c.ljust(w) for c, w, n in zip(row, widths, numeric, strict=True)).rstrip()
        for row in (header, *rows)
    ]


FEW_POSES = 100  # with which possible mistakes are tried
MOST_NAMED = 3
SELDOM = 0.5  # a camera that sees no spot in more than this share of the poses is remarked


def check_visibility(findings: Findings, rig: Rig, prior: PosePrior | None, limits: SolveLimits, rig_path: str) -> None:
    """Report how often each spot is in view, over the prior's range or an assumed one.

    A spot, a camera or a pose that is never visible is a problem with a prior, and a remark without one.
    """
    span = visibility.assumed_range(rig) if prior is None else prior
    seen = visibility.visibility_of(rig, span, limits)
    severe = findings.remarks if prior is None else findings.problems
    centre = ", ".join(f"{v + 0.0:.4g}" for v in span.centre.translation)
    turned = ", ".join(f"{v + 0.0:.4g}" for v in np.rad2deg(span.centre.ypr))
    findings.facts += [
        "",
        f"Seen from {visibility.POSES} poses, "
        + ("the prior's range: " if prior is not None else "an assumed range, since there is no prior: ")
        + f"within {span.within_m:g} m of ({centre}), within {np.rad2deg(span.within_rad):.4g} deg of yaw, pitch,"
        + f" roll ({turned})",
    ]
    rows = [
        (camera, spot, *(format_percent(share[i]) for share in (seen.in_picture, seen.outside, seen.off_screen)))
        for i, (camera, spot) in enumerate(seen.views)
    ]
    findings.facts += table(("camera", "spot", "in picture", "outside", "off screen"), rows)
    few = np.percentile(seen.spots_in_view, [0, 50, 100]).astype(int) if seen.views else (0, 0, 0)
    findings.facts.append(f"spots in view of all cameras: {few[0]} to {few[2]}, median {few[1]}")
    line = f"pose observable from one frame: {format_percent(seen.observable)} of the poses"
    if seen.observable > 0:
        good = (seen.sigma_m <= limits.max_sigma_m) & (seen.sigma_rad <= limits.max_sigma_rad)
        line += (
            f"; worst axis with {visibility.NOISE_PX:g} px of noise, median:"
            f" {np.median(seen.sigma_m[good]) * 1e3:.3g} mm,"
            f" {np.rad2deg(np.median(seen.sigma_rad[good])):.3g} deg"
        )
    else:
        severe.append(f"{rig_path}: the pose is observable in none of {visibility.POSES} poses of the range")
    findings.facts.append(line)

    never = [
        f"{rig_path}: target.spots.{spot}: never hits its screen {rig.spots[spot].screen!r}"
        for spot, share in seen.on_screen.items()
        if share == 0
    ]
    never += [f"{rig_path}: cameras.{camera}: never sees a spot" for camera, share in seen.blind.items() if share == 1]
    if never:
        severe += never
        severe.append(f"{rig_path}: {_without_mistake(rig, span, limits)}")
    findings.remarks += [
        f"{rig_path}: cameras.{camera}: sees no spot in {format_percent(share)} of the poses"
        for camera, share in seen.blind.items()
        if SELDOM < share < 1
    ]


def _without_mistake(rig: Rig, span: PosePrior, limits: SolveLimits) -> str:
    """The mistakes without which every spot hits its screen and every camera sees spots, as a question."""
    found = []
    for mistake in possible_mistakes(rig):
        if mistake.rig is rig:
            continue
        seen = visibility.visibility_of(mistake.rig, span, limits, FEW_POSES)
        if min(seen.on_screen.values()) > 0 and max(seen.blind.values()) < SELDOM:
            found.append(mistake)
    if not found:
        return "compare camera_from_world, camera_matrix and world_from_screen with the lab"
    return f"it would be otherwise if {', or if '.join(m.what for m in found[:MOST_NAMED])}"


def check_rig(
    findings: Findings, rig: Rig, prior: PosePrior | None, parameters: LabelParameters, with_truth: bool = False
) -> None:
    """Numbers that no lab has, and mistakes that the symmetry of the rig hides unless there are true poses."""
    impossible = mistakes_by_themselves(rig, prior)
    findings.problems += [f"{f.what}. {sentence(f.why)} {f.remedy} ({f.code})" for f in impossible]
    if impossible:
        return
    kinds: dict[str, list[Invisible]] = {}
    names: list[str] = []
    harmless: list[str] = []
    for one in invisible_mistakes(rig, prior, parameters):
        if one.is_harmless and one.mistake.kind == NAMES:
            names.append(one.mistake.what.removesuffix(" are exchanged"))
        elif one.is_harmless:
            harmless.append(one.mistake.what)
        else:
            kinds.setdefault(one.mistake.kind, []).append(one)
    if len(rig.spots) > len(rig.screens):
        names.append("two spots of a screen")
    if names:
        findings.facts.append(
            f"Exchanged names of {', or of '.join(names)}: no recording shows them; the poses are the same"
        )
    if harmless:
        findings.facts.append(f"No recording shows whether {', or whether '.join(harmless)}; the poses are the same")
    if with_truth:
        return
    for kind, those in kinds.items():
        what = "; or ".join(
            f"{one.mistake.what} (poses wrong by {format_number(one.off_m)} m, {format_number(one.off_deg)} deg)"
            for one in those
        )
        findings.remarks.append(
            f"no recording with this rig would show, because it is symmetric, that {what}. To exclude it,"
            f" {SHOWN_BY[kind]}; or give the pose of a frame, measured otherwise, in truth/pose.csv"
        )


def check_recording(findings: Findings, run: Run, sampler: SampledFrames) -> None:
    """Mistakes that a sample of the recording shows."""
    for f in (*recorded_mistakes(run, _blocks(run, sampler)), *rates_of_videos(run)):
        text = f"{f.what}. {sentence(f.why)} {f.remedy} ({f.code})"
        (findings.problems if f.level is Level.FAIL else findings.remarks).append(text)


def _blocks(run: Run, sampler: SampledFrames) -> list[Block]:
    """The points of sampled frames; those of pictures are detected."""
    blocks = sampler.frames
    filmed = [name for name, source in run.cameras.items() if not isinstance(source, DetectionsTable)]
    if filmed and blocks:
        blocks = [blocks[i] for i in evenly_spaced(np.arange(len(blocks)), ENOUGH)]
    numbers = [frame.frame for block in blocks for frame in block if frame.frame >= blocks[0][HERE].frame]
    found = _detected(run, filmed, numbers) if filmed else {}
    return [[points_in(frame) | found.get(frame.frame, {}) for frame in block] for block in blocks]


def _detected(run: Run, cameras: list[str], frames: list[int]) -> dict[int, dict[str, Detections]]:
    """The points in some pictures, by frame and camera."""
    from lab.runs.frames.pipeline import Pipeline  # with the tracker and the detection: only for pictures

    pipeline = Pipeline.of(run)
    out: dict[int, dict[str, Detections]] = {}
    for camera in cameras:
        for frame, picture in pictures_at(run, camera, frames).items():
            if isinstance(picture, np.ndarray):
                out.setdefault(frame, {})[camera] = pipeline.spots_in(camera, picture)
    return out


AGREES_PX = 0.01  # px: truth written with two decimals agrees with the rig to this
RAGGED_TIMES = 3.0  # a step between timestamps larger or smaller than nominal by this factor is remarked


@dataclass(slots=True)
class _Seen:
    """What the pictures of one camera contain."""

    frames: list[int] = field(default_factory=list)  # frames with a usable picture
    shown: list[int] = field(default_factory=list)  # of these, those that are no empty lists of points
    kinds: set[str] = field(default_factory=set)
    points: int = 0
    ends: set[int] = field(default_factory=set)  # least and largest value of the first pictures, DN, until these differ
    dropped: int = 0
    unreadable: int = 0
    wrong_size: int = 0
    size: str = ""  # why the last of them is wrong


def check_pictures(findings: Findings, run: Run, reader: FrameReader, progress: Progress | None) -> SampledFrames:
    """Decode all pictures of a run, and check them with its times and its truth; returns a sample without pixels."""
    seen = {name: _Seen() for name in reader.cameras}
    sampler = SampledFrames()
    done = 0
    for frame_set in reader:
        sampler.add(frame_set.frame, frame_set.images)
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
            what = f"{len(source.ignored)} files of {name!r} are no frames: {format_some(source.ignored, 3)}"
            findings.remarks.append(f"{run.cameras[name].path}: {what}")
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
        if len(s.ends) == 1 and "points" not in s.kinds:
            bright = f"have the value {max(s.ends)} in every pixel; is the camera overexposed"
            what = bright if any(s.ends) else "are black; is the lens covered"
            findings.remarks.append(f"{run.cameras[name].path}: all pictures {what}?")
        if "points" in s.kinds and s.points == 0:
            findings.remarks.append(f"{run.cameras[name].path}: no points of camera {name!r}")
    findings.facts += table(("camera", "usable", "frames", "dropped", "unreadable", "wrong size", "kind"), rows)


def _why_size(reason: str) -> str:
    """The usual mistake behind a picture's size. reason: of the missing picture, with both sizes."""
    width, height, right_width, right_height = (int(n) for n in re.findall(r"\d+", reason)[:4])
    if (width, height) == (right_height, right_width):
        return "turned by 90 deg, or transposed (rows and columns exchanged)?"
    if abs(width * right_height - height * right_width) <= max(right_width, right_height):  # halves are rounded
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
    if not isinstance(picture, Detections) or len(picture):
        seen.shown.append(frame)
    if isinstance(picture, Detections):
        seen.kinds.add("points")
        seen.points += len(picture)
    elif isinstance(picture, np.ndarray):
        seen.kinds.add(f"{8 * picture.dtype.itemsize}-bit")
        if len(seen.ends) < 2:
            seen.ends |= {int(picture.min()), int(picture.max())}


def _compare_cameras(findings: Findings, seen: dict[str, _Seen]) -> None:
    """Reports frames that some cameras have and others lack."""
    if len(seen) < 2:
        return
    ranges = {name: (min(s.shown), max(s.shown), len(s.frames)) for name, s in seen.items() if s.shown}
    for (a, one), (b, other) in combinations(ranges.items(), 2):
        if one[2] == other[2] and one[0] != other[0] and one[1] - one[0] == other[1] - other[0]:
            findings.remarks.append(
                f"cameras: {a!r} and {b!r} have {one[1] - one[0] + 1} frames each, numbered from {one[0]} and from"
                f" {other[0]}: the same number must be the same instant. Film one flash with both: it must have the"
                " same number"
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


def check(path: Path, progress: Progress | None = None) -> Done[None]:
    """Check a rig.yaml, or a run folder with all its pictures, which are decoded one by one.

    Errors of the input become lines of the result.
    """
    path = Path(path)
    if path.is_dir() or path.name == "run.yaml":
        return _check_run(path, progress)
    findings = Findings(str(path))
    try:
        file = load_rig_file(path)
        rig, covariance = file.rig, joint_covariance(file.rig, file.covariances, path)
    except InputError as error:
        findings.add_error(error)
    else:
        _describe_rig(findings, rig)
        check_rig(findings, rig, None, LabelParameters())
        _describe_calibration(findings, file.calibration, covariance, path, None)
        check_visibility(findings, rig, None, SolveLimits(), str(path))
    return findings.result()


def _check_run(folder: Path, progress: Progress | None) -> Done[None]:
    findings = Findings(str(folder))
    try:
        run = load_run(folder)
    except InputError as error:
        findings.add_error(error)
        return findings.result()
    findings.subject = f"{folder} ({run.name})"
    _describe_rig(findings, run.rig)
    with_truth = (run.folder / "truth" / "pose.csv").exists()
    check_rig(findings, run.rig, run.prior, run.tracker.labels, with_truth)
    _describe_calibration(findings, run.calibration, run.covariance, run.rig_path, run.recorded)
    for name in run.left_out:
        findings.remarks.append(
            f"{run.path}: cameras: camera {name!r} of the rig is left out; the run works without it"
        )
    for outside in run.paths_outside:
        findings.facts += ["", f"Read from outside the run folder: {outside}"]
    if run.prior is None:
        _describe_search(findings, run)
    try:
        reader = open_frames(run)
    except InputError as error:
        findings.add_error(error)
    else:
        check_recording(findings, run, check_pictures(findings, run, reader, progress))
    limits = SolveLimits(run.tracker.max_sigma_m, float(np.deg2rad(run.tracker.max_sigma_deg)))
    check_visibility(findings, run.rig, run.prior, limits, str(run.rig_path))
    return findings.result()


def _describe_calibration(
    findings: Findings,
    state: CalibrationState | None,
    covariance: RigCovariance | None,
    path: Path,
    recorded: datetime.date | None,
) -> None:
    """Date and verdict of the calibration, and whether it may be used on the day of the recording (or today)."""
    try:
        require_valid_calibration(state, path, recorded)
    except CalibrationError as error:
        findings.unusable += str(error).splitlines()
    text = "the rig file does not state when it was calibrated"
    today = datetime.date.today()
    if state is not None:
        if state.date > today:
            findings.remarks.append(
                f"{path}: calibration.date: {state.date.isoformat()} is after {today.isoformat()} (today): correct it,"
                " or the clock of this computer"
            )
        until = "" if state.valid_until is None else f", {state.validity}"
        text = f"calibrated {state.date.isoformat()}: {state.verdict}{until}"
    known = "no covariance: sigmas will include the noise only"
    if covariance is not None:
        known = f"covariance of {len(covariance.names)} numbers: sigmas will include the calibration's errors too"
    findings.facts += ["", "Calibration", f"  {text}", f"  {known}"]


def _describe_search(findings: Findings, run: Run) -> None:
    """For a run without a prior: the range that is searched, and whether the rig is symmetric."""
    space = PosePrior.everywhere(run.rig)
    centre = ", ".join(f"{v + 0.0:.3g}" for v in space.centre.translation)
    findings.facts += [
        "",
        "Prior: none given; the first pose is searched for among all that show enough spots,"
        f" within {space.within_m:.3g} m of ({centre}), in any attitude",
    ]
    for turn in symmetries(SpotModel.of(run.rig)):
        findings.remarks.append(
            f"{run.path}: prior: none given, and a rotation by"
            f" {np.rad2deg(rotations.angle(turn.rotation)):.4g} deg maps the beams onto each other: the first labels"
            " remain ambiguous between these poses. Add"
            " prior: {position_m: [x, y, z], yaw_pitch_roll_deg: [yaw, pitch, roll], within_m: 0.5, within_deg: 30}"
            " with the approximate first pose"
        )


def _describe_rig(findings: Findings, rig: Rig) -> None:
    watched = {camera.screen for camera in rig.cameras.values()}
    findings.facts.append("Rig")
    rows = []
    for c in rig.cameras.values():
        spots = [s.name for s in rig.spots.values() if s.screen == c.screen]
        size = f"{c.image_size_px[0]}x{c.image_size_px[1]} px"
        rows.append((c.name, size, f"screen {c.screen}", f"spots {', '.join(spots)}" if spots else "no spots"))
        if not spots:
            findings.remarks.append(f"cameras.{c.name}: no spot falls on the screen {c.screen!r} that it observes")
    findings.facts += table(("camera", "picture", "observes", ""), rows)
    for s in rig.spots.values():
        if s.screen not in watched:
            findings.remarks.append(f"target.spots.{s.name}: no camera observes its screen {s.screen!r}")
