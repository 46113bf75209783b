"""`beampose check`: whether a rig file or a run folder can be processed, and what the rig can see. Plain lines."""

from __future__ import annotations

import datetime
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from geometry import rotations
from geometry.arrays import Ints
from geometry.forward_model import SpotModel
from geometry.pose_prior import PosePrior
from geometry.pose_solver import visibility
from geometry.pose_solver.gauss_newton import SolveLimits
from geometry.pose_solver.symmetry import symmetries
from geometry.rig import Rig
from geometry.uncertainty.rig_parameters import RigCovariance
from lab.errors import CalibrationError, InputError
from lab.files.rig.calibration_state import CalibrationState, require_usable
from lab.files.rig.rig_covariance import joint_covariance
from lab.files.rig.rig_file import load_rig_file
from lab.files.run.run_file import Run, load_run
from lab.files.run.truth import largest_disagreement_px, load_run_truth
from lab.files.text.error_text import FileError
from lab.pictures.picture_file import DROPPED, UNREADABLE, Missing
from lab.runs.frames.frames import FrameReader, open_frames
from tracking.detections import Detections

Progress = Callable[[int, int | None], None]  # frames done, of how many
AGREES_PX = 0.01  # px: truth written with two decimals lies this near to what the rig makes of the true pose
SELDOM = 0.5  # a camera that sees nothing in more of the poses than this is worth a remark
RAGGED_TIMES = 3.0  # a step between timestamps that is so many times the nominal one is worth a remark


@dataclass(frozen=True, slots=True)
class CheckResult:
    """What `beampose check` says."""

    lines: tuple[str, ...]
    exit_status: int  # 0: can be processed; 2: something must be put right first; 3: that is the calibration alone


@dataclass(slots=True)
class _Findings:
    """What the single checks add to."""

    subject: str
    problems: list[str] = field(default_factory=list)  # a run would stop, or be wrong
    remarks: list[str] = field(default_factory=list)  # a run goes on
    facts: list[str] = field(default_factory=list)
    unusable: list[str] = field(default_factory=list)  # what stops a run is the calibration

    def result(self) -> CheckResult:
        counts = [
            f"{len(lines)} {word}{'s' if len(lines) > 1 else ''}"
            for word, lines in (("problem", self.problems + self.unusable), ("remark", self.remarks))
            if lines
        ]
        lines = [f"{self.subject}: {', '.join(counts) or 'fine'}"]
        if self.problems or self.unusable:
            lines += ["", "Problems, to be put right first:", *(f"  {p}" for p in self.problems + self.unusable)]
        if self.remarks:
            lines += ["", "Remarks, with which a run goes on:", *(f"  {r}" for r in self.remarks)]
        if self.facts:
            lines += ["", *self.facts]
        status = InputError.exit_status if self.problems else CalibrationError.exit_status if self.unusable else 0
        return CheckResult(tuple(lines), status)


def check(path: Path, progress: Progress | None = None) -> CheckResult:
    """Check a rig.yaml, or a run folder with all its pictures, which are decoded one by one. Raises nothing."""
    path = Path(path)
    if path.is_dir() or path.name == "run.yaml":
        return _check_run(path, progress)
    findings = _Findings(str(path))
    try:
        file = load_rig_file(path)
        rig, covariance = file.rig, joint_covariance(file.rig, file.covariances, path)
    except InputError as error:
        findings.problems += _lines_of(error)
    else:
        _describe_rig(findings, rig)
        _describe_calibration(findings, file.calibration, covariance, path, None)
        _look(findings, rig, None, SolveLimits(), str(path))
    return findings.result()


def _lines_of(error: InputError) -> Sequence[str]:
    return error.lines if isinstance(error, FileError) else str(error).splitlines()


def _check_run(folder: Path, progress: Progress | None) -> CheckResult:
    findings = _Findings(str(folder))
    try:
        run = load_run(folder)
    except InputError as error:
        findings.problems += _lines_of(error)
        return findings.result()
    findings.subject = f"{folder} ({run.name})"
    _describe_rig(findings, run.rig)
    _describe_calibration(findings, run.calibration, run.covariance, run.rig_path, run.recorded)
    for name in run.left_out:
        findings.remarks.append(f"{run.path}: cameras: camera {name!r} of the rig is left out; the run does without it")
    if run.prior is None:
        _describe_search(findings, run)
    try:
        reader = open_frames(run)
    except InputError as error:
        findings.problems += _lines_of(error)
    else:
        _check_pictures(findings, run, reader, progress)
    limits = SolveLimits(run.tracker.max_sigma_m, float(np.deg2rad(run.tracker.max_sigma_deg)))
    _look(findings, run.rig, run.prior, limits, str(run.rig_path))
    return findings.result()


def _describe_calibration(
    findings: _Findings,
    state: CalibrationState | None,
    covariance: RigCovariance | None,
    path: Path,
    recorded: datetime.date | None,
) -> None:
    """What is known of the calibration, and whether it may still be used on the day of the recording (or today)."""
    try:
        day = datetime.date.today() if recorded is None else recorded
        require_usable(state, path, day, "today" if recorded is None else "the recording's day")
    except CalibrationError as error:
        findings.unusable += str(error).splitlines()
    words = "the rig file does not say when it was calibrated"
    if state is not None:
        until = "" if state.valid_until is None else f", valid until {state.valid_until.isoformat()}"
        words = f"calibrated {state.date.isoformat()}: {state.verdict}{until}"
    known = "no covariance: sigmas will hold the noise alone"
    if covariance is not None:
        known = f"covariance of {len(covariance.names)} numbers: sigmas will hold the calibration's errors too"
    findings.facts += ["", "Calibration", f"  {words}", f"  {known}"]


def _describe_search(findings: _Findings, run: Run) -> None:
    """What it means that a run has no prior: what is searched, and whether the rig leaves a tie."""
    space = PosePrior.everywhere(run.rig)
    centre = ", ".join(f"{v + 0.0:.3g}" for v in space.centre.translation)
    findings.facts += [
        "",
        "Prior: none given; the first pose is searched for among all that show enough spots,"
        f" within {space.within_m:.3g} m of ({centre}), in any attitude",
    ]
    for turn in symmetries(SpotModel.of(run.rig)):
        findings.remarks.append(
            f"{run.path}: prior: none given, and the beams lie on each other after a turn of"
            f" {np.rad2deg(rotations.angle(turn.rotation)):.4g} deg: the first labels stay a tie between these poses."
            " Add prior: {position_m: [x, y, z], yaw_pitch_roll_deg: [yaw, pitch, roll], within_m: 0.5, within_deg: 30}"
            " with about the first pose"
        )


def _describe_rig(findings: _Findings, rig: Rig) -> None:
    watched = {camera.screen for camera in rig.cameras.values()}
    findings.facts.append("Rig")
    rows = []
    for c in rig.cameras.values():
        spots = [s.name for s in rig.spots.values() if s.screen == c.screen]
        size = f"{c.image_size_px[0]}x{c.image_size_px[1]} px"
        rows.append((c.name, size, f"screen {c.screen}", f"spots {', '.join(spots)}" if spots else "no spots"))
        if not spots:
            findings.remarks.append(f"cameras.{c.name}: no spot falls on the screen {c.screen!r} that it observes")
    findings.facts += _table(("camera", "picture", "observes", ""), rows)
    for s in rig.spots.values():
        if s.screen not in watched:
            findings.remarks.append(f"target.spots.{s.name}: no camera observes its screen {s.screen!r}")


# Pictures -------------------------------------------------------------------------------------------------------


@dataclass(slots=True)
class _Seen:
    """What the pictures of one camera turned out to be."""

    frames: list[int] = field(default_factory=list)  # with a usable picture
    kinds: set[str] = field(default_factory=set)
    points: int = 0
    brightest: int = 0  # DN
    dropped: int = 0
    unreadable: int = 0
    wrong_size: int = 0


def _check_pictures(findings: _Findings, run: Run, reader: FrameReader, progress: Progress | None) -> None:
    seen = {name: _Seen() for name in reader.cameras}
    done = 0
    for frame_set in reader:
        for name, picture in frame_set.images.items():
            _take_in(seen[name], frame_set.frame, picture)
        done += 1
        if progress is not None:
            progress(done, reader.expected_frames)
    rate = run.frame_rate_hz
    first, last = reader.first, reader.first + done - 1
    findings.facts += ["", f"Pictures: frames {first} to {last}, {done} in all, {done / rate:.3f} s at {rate:g} Hz"]
    rows = []
    for name, s in seen.items():
        span = f"{min(s.frames)} to {max(s.frames)}" if s.frames else "none"
        kind = ", ".join(sorted(s.kinds)) + (f" ({s.points})" if "points" in s.kinds else "")
        rows.append((name, str(len(s.frames)), span, str(s.dropped), str(s.unreadable), str(s.wrong_size), kind))
        if not s.frames:
            why = "all are of the wrong size" if s.wrong_size else "none can be read"
            findings.problems.append(f"{run.cameras[name].path}: camera {name!r} has no usable picture: {why}")
        if len(s.kinds) > 1:
            findings.remarks.append(f"{run.cameras[name].path}: pictures of different kinds: {', '.join(s.kinds)}")
        if s.brightest == 0 and s.frames and "points" not in s.kinds:
            findings.remarks.append(f"{run.cameras[name].path}: all pictures are black; is the lens covered?")
        if "points" in s.kinds and s.points == 0:
            findings.remarks.append(f"{run.cameras[name].path}: not one point of camera {name!r}")
    findings.facts += _table(("camera", "usable", "frames", "dropped", "unreadable", "wrong size", "kind"), rows)
    findings.remarks += reader.notes
    for name, listing in reader.listings.items():
        if listing.ignored:
            some = ", ".join(listing.ignored[:3]) + (", ..." if len(listing.ignored) > 3 else "")
            findings.remarks.append(f"{listing.folder}: {len(listing.ignored)} files of {name!r} are no frames: {some}")
    _compare_cameras(findings, seen)
    frames = np.unique(np.concatenate([np.array(s.frames, dtype=np.int64) for s in seen.values()]))
    _check_times(findings, run, frames)
    _check_truth(findings, run, frames)


def _take_in(seen: _Seen, frame: int, picture: object) -> None:
    if isinstance(picture, Missing):
        seen.dropped += picture.reason == DROPPED
        seen.unreadable += picture.reason.startswith(UNREADABLE)
        seen.wrong_size += picture.reason.startswith("wrong size")
        return
    seen.frames.append(frame)
    if isinstance(picture, Detections):
        seen.kinds.add("points")
        seen.points += len(picture)
    elif isinstance(picture, np.ndarray):
        seen.kinds.add(f"{8 * picture.dtype.itemsize}-bit")
        if seen.brightest == 0:  # one bright picture is enough to know
            seen.brightest = int(picture.max())


def _compare_cameras(findings: _Findings, seen: dict[str, _Seen]) -> None:
    """Frames that some cameras have and others lack."""
    if len(seen) < 2:
        return
    in_all = set.intersection(*(set(s.frames) for s in seen.values()))
    in_any = set.union(*(set(s.frames) for s in seen.values()))
    if in_any and not in_all:
        findings.problems.append(
            "cameras: no frame number is common to all; the same number must be the same instant in every camera"
        )
    elif len(in_any) > len(in_all):
        findings.remarks.append(
            f"cameras: {len(in_any) - len(in_all)} of {len(in_any)} frames are not there in every camera"
        )


def _check_times(findings: _Findings, run: Run, frames: Ints) -> None:
    if run.times.frames is None or len(frames) < 2:
        return
    steps = np.diff(run.times.t_s(frames)) / np.diff(frames) * run.frame_rate_hz
    worst = int(np.argmax(np.abs(np.log(steps))))
    if not 1 / RAGGED_TIMES <= steps[worst] <= RAGGED_TIMES:
        findings.remarks.append(
            f"{run.path}: timestamps: after frame {frames[worst]} a frame lasts {steps[worst]:.3g} times what"
            f" frame_rate_hz ({run.frame_rate_hz:g}) says"
        )


def _check_truth(findings: _Findings, run: Run, frames: Ints) -> None:
    try:
        truth = load_run_truth(run)
    except InputError as error:
        findings.problems += _lines_of(error)
        return
    if truth is None:
        return
    told = []
    for name, table in (("pose.csv", truth.pose), ("spots.csv", truth.spots)):
        if table is None:
            continue
        known = np.unique(table.frame)
        if not len(known):
            findings.remarks.append(f"{run.folder / 'truth' / name}: no rows")
            continue
        told.append(f"{name} frames {known[0]} to {known[-1]}")
        without = np.setdiff1d(frames, known)
        if without.size:
            findings.remarks.append(
                f"{run.folder / 'truth' / name}: says nothing of {without.size} of {len(frames)} frames"
                f" (the first is {without[0]})"
            )
    if truth.pose is not None and len(truth.pose.frame):
        off = np.abs(truth.pose.t_s - run.times.t_s(truth.pose.frame))
        if off.max() > 0.5 / run.frame_rate_hz:
            findings.remarks.append(
                f"{run.folder / 'truth' / 'pose.csv'}: t_s: up to {off.max():.4g} s from the run's own times"
            )
    worst = largest_disagreement_px(truth, run.rig)
    if worst is not None:
        told.append(f"poses and spots agree through the rig to {worst[0]:.2g} px")
        if worst[0] > AGREES_PX:
            findings.remarks.append(
                f"{run.folder / 'truth'}: spots.csv lies {worst[0]:.3g} px from what the rig makes of pose.csv"
                f" (frame {worst[1]}); was the truth made with another rig?"
            )
    findings.facts += ["", f"Truth: {'; '.join(told)}"]


# What the rig can see -------------------------------------------------------------------------------------------


def _look(findings: _Findings, rig: Rig, prior: PosePrior | None, limits: SolveLimits, rig_path: str) -> None:
    """Adds how often which spot is in view. What cannot work is a problem with a prior, else only a remark: the range
    of poses is then a guess."""
    span = visibility.DEFAULT_RANGE if prior is None else prior
    seen = visibility.visibility_of(rig, span, limits)
    severe = findings.remarks if prior is None else findings.problems
    centre = ", ".join(f"{v + 0.0:.4g}" for v in span.centre.translation)
    turned = ", ".join(f"{v + 0.0:.4g}" for v in np.rad2deg(span.centre.ypr))
    findings.facts += [
        "",
        f"Seen from {visibility.POSES} poses, "
        + ("the prior's range: " if prior is not None else "a range assumed for want of a prior: ")
        + f"within {span.within_m:g} m of ({centre}), within {np.rad2deg(span.within_rad):.4g} deg of yaw, pitch,"
        + f" roll ({turned})",
    ]
    rows = [
        (camera, spot, _percent(seen.in_picture[i]), _percent(seen.outside[i]), _percent(seen.off_screen[i]))
        for i, (camera, spot) in enumerate(seen.views)
    ]
    findings.facts += _table(("camera", "spot", "in picture", "outside", "off screen"), rows)
    few = np.percentile(seen.spots_in_view, [0, 50, 100]).astype(int) if seen.views else (0, 0, 0)
    findings.facts.append(f"spots in view of all cameras: {few[0]} to {few[2]}, median {few[1]}")
    line = f"pose observable from one frame: {_percent(seen.observable)} of the poses"
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

    for spot, share in seen.on_screen.items():
        if share == 0:
            other = visibility.visibility_of(visibility.with_other_end(rig, spot), span, limits).on_screen[spot]
            hint = f"; from the other end of beam {rig.spots[spot].beam!r} it would: is `end` right?" if other else ""
            severe.append(f"{rig_path}: target.spots.{spot}: never meets its screen {rig.spots[spot].screen!r}{hint}")
    for camera, share in seen.blind.items():
        if share == 1:
            turned_rig = visibility.with_inverted_camera(rig, camera)
            other = 1 - visibility.visibility_of(turned_rig, span, limits).blind[camera]
            hint = (
                f"; with the inverse of camera_from_world it would in {_percent(other)}: is it world_from_camera?"
                if other
                else "; compare camera_from_world, camera_matrix and the screen's pose with the lab"
            )
            severe.append(f"{rig_path}: cameras.{camera}: never sees a spot{hint}")
        elif share > SELDOM:
            findings.remarks.append(f"{rig_path}: cameras.{camera}: sees no spot in {_percent(share)} of the poses")


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %"


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Aligned columns: words to the left, numbers to the right."""
    widths = [max(len(r[i]) for r in (header, *rows)) for i in range(len(header))]
    numeric = [
        bool(rows) and all(r[i][:1].isdigit() and r[i][-1:] in "0123456789%" for r in rows) for i in range(len(header))
    ]
    return [
        "  " + "  ".join(c.rjust(w) if n else c.ljust(w) for c, w, n in zip(row, widths, numeric, strict=True)).rstrip()
        for row in (header, *rows)
    ]
