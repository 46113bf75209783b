"""The main job: a run folder in, a result folder out."""

from __future__ import annotations

import contextlib
import dataclasses
import datetime
import json
import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from geometry.forward_model import SpotModel
from lab.files.rig.calibration_state import require_usable, state_mapping
from lab.files.run.fingerprints import fingerprints
from lab.files.run.parameter_overrides import overridden
from lab.files.run.run_file import Run, load_run
from lab.files.run.truth import load_run_truth
from lab.files.text.atomic_write import atomic_folder
from lab.files.text.json_text import write_json
from lab.runs.frames.pipeline import FrameRecord, Pipeline
from lab.runs.model_check.frame_sampler import FrameSampler, claimed_covariances, widths
from lab.runs.smoothing_pass import Progress, TwoPasses
from lab.runs.tables import TableWriter
from lab.runs.verdict import quality
from lab.runs.verdict.frame_checks import FrameChecks
from lab.runs.verdict.run_facts import CameraFacts, RunFacts
from lab.versions import versions

if TYPE_CHECKING:
    from lab.runs.model_check.check import ModelCheck

SUMMARY_SCHEMA = "beampose/summary/1"
MOST_EVENTS = 500  # listed one by one; of the rest the number
# Events that say no more in the next frame: listed once, with their length.
LASTING = ("undecided", "changed", "contradiction", "not_a_covariance")


@dataclass(frozen=True, slots=True)
class RunOutcome:
    """What became of one run."""

    name: str
    out: Path
    verdict: quality.Verdict
    frames: int
    measured: int
    seconds: float
    errors: Mapping[str, Any] | None  # against truth, where there is one

    @property
    def exit_status(self) -> int:
        """0, or 4 where a quality gate failed."""
        return self.verdict.exit_status

    def line(self) -> str:
        """One line for the command line; where a gate failed, with what to do about the first reason."""
        remedy = f" {self.verdict.remedy}" if self.verdict.remedy else ""
        return (
            f"{self.name}: {self.verdict.status.upper()}: {self.measured} of {self.frames} frames measured"
            f" ({'; '.join(self.verdict.reasons)}){remedy} -> {self.out}"
        )


@dataclass(slots=True)
class _Tally:
    """Counts of spots and events over a run; its size does not grow with the number of frames."""

    cameras: tuple[str, ...]
    views: tuple[str, ...]
    spot_status: list[Counter[str]] = field(default_factory=list)
    detections: Counter[str] = field(default_factory=Counter)
    reasons: dict[str, Counter[str]] = field(default_factory=dict)
    events: list[dict[str, Any]] = field(default_factory=list)
    event_kinds: Counter[str] = field(default_factory=Counter)
    lasting: dict[tuple[str, int | None], dict[str, Any]] = field(default_factory=dict)  # the latest of each kind
    unlisted: int = 0
    left_open: int = 0  # rows of spots.csv with a detection whose label was too uncertain to be given

    def add(self, record: FrameRecord) -> None:
        if not self.spot_status:
            self.spot_status = [Counter() for _ in self.views]
        for counter, status in zip(self.spot_status, record.tracked.status, strict=True):
            counter[status.value] += 1
        for camera, found, reason in zip(self.cameras, record.detections, record.missing, strict=True):
            if found is None:
                self.reasons.setdefault(camera, Counter())[reason] += 1
            else:
                self.detections[camera] += len(found)
        if record.tracked.label_probability is not None:
            given = np.array([s.measured for s in record.tracked.status])
            self.left_open += int(np.count_nonzero(~given & ~np.isnan(record.tracked.label_probability)))
        for event in record.tracked.events:
            self.event_kinds[event.kind] += 1
            same = self.lasting.get((event.kind, event.view))
            if event.kind in LASTING and same is not None and same["last_frame"] == record.frame - 1:
                same["last_frame"] = record.frame
            elif len(self.events) < MOST_EVENTS:
                camera, spot = ("", "") if event.view is None else self.views[event.view].split("/", 1)
                self.events.append(
                    {
                        "frame": record.frame,
                        "last_frame": record.frame,
                        "kind": event.kind,
                        "camera": camera or None,
                        "spot": spot or None,
                        "text": event.text,
                    }
                )
                self.lasting[event.kind, event.view] = self.events[-1]
            else:
                self.unlisted += 1


def process_run(
    run_folder: Path,
    out: Path,
    *,
    overrides: Mapping[str, Any] | None = None,
    causal: bool = False,
    progress: Progress | None = None,
) -> RunOutcome:
    """Process one run folder into the folder `out`: the tables, summary.json and report.html.

    overrides: tracker parameters that replace those of run.yaml. causal: the tables say what was known at each instant,
    and nothing is smoothed; otherwise they say what the whole run tells, and attitude_causal.csv the former.

    Raises a BeamposeError where the run cannot be processed (CalibrationError where its rig's calibration must not be
    used); `out` is then as it was before.
    """
    started = time.perf_counter()
    run = ready_run(run_folder, overrides)
    with atomic_folder(out, may_replace=are_results) as work:
        return write_results(Pipeline.of(run), work, Path(out), started, causal=causal, progress=progress)


def ready_run(run_folder: Path, overrides: Mapping[str, Any] | None = None) -> Run:
    """A run that may be processed, with some tracker parameters replaced.

    Raises InputError; CalibrationError where its rig's calibration must not be used.
    """
    run = load_run(run_folder)
    if overrides:
        run = dataclasses.replace(run, tracker=overridden(run.tracker, overrides))
    recorded = datetime.date.today() if run.recorded is None else run.recorded
    require_usable(run.calibration, run.rig_path, recorded, "today" if run.recorded is None else "the recording's day")
    load_run_truth(run)  # a mistake in it stops the run before the processing, not after it
    return run


def write_results(
    pipeline: Pipeline,
    work: Path,
    out: Path,
    started: float,
    *,
    causal: bool = False,
    progress: Progress | None = None,
    more: Callable[[], Mapping[str, Any]] = dict,
) -> RunOutcome:
    """Process what a pipeline gives into the folder `work`, which will be `out`.

    started: time.perf_counter() at the beginning. more: what else summary.json shall hold, asked for at the end.
    """
    run = pipeline.run
    tally = _Tally(tuple(run.rig.cameras), tuple(f"{c}/{s}" for c, s in SpotModel.of(run.rig).views))
    passes = TwoPasses(pipeline, work, progress)
    facts, model_check, verdict = write_tables(
        pipeline, passes, work, causal=causal, on_frame=lambda record, _: tally.add(record)
    )
    errors, added = _errors(work, run), more()
    seconds = {
        "waiting_for_pictures_s": pipeline.timings.waiting,
        "detection_s": pipeline.timings.detection,
        "tracking_s": pipeline.timings.tracking,
        "smoothing_s": pipeline.timings.smoothing,
    }
    content = _summary(
        run, pipeline, passes, tally, facts, verdict, model_check, errors, seconds, time.perf_counter() - started
    )
    write_json({**content, **added}, work / "summary.json")
    from lab.report.run.page import write_report  # the template engine: only for those who write a report

    write_report(work, run.folder)
    return RunOutcome(run.name, out, verdict, facts.frames, facts.measured, time.perf_counter() - started, errors)


def write_tables(
    pipeline: Pipeline,
    passes: TwoPasses,
    work: Path,
    *,
    causal: bool = False,
    on_frame: Callable[[FrameRecord, FrameRecord | None], None],
) -> tuple[RunFacts, ModelCheck, quality.Verdict]:
    """Track a run, write its tables into `work`, and judge it. on_frame: called with each frame as it was written."""
    run = pipeline.run
    model = SpotModel.of(run.rig)
    checks = FrameChecks(run.rig, run.covariance)
    facts = RunFacts(
        {name: CameraFacts() for name in run.rig.cameras},
        tuple(model.camera_of.tolist()),
        run.tracker.labels.min_spots,
        own_spots=checks.own_spots,
        causal=checks.causal,
        invalid=checks.invalid,
    )
    keeper = FrameSampler()
    with (
        TableWriter(work, run.rig, run.covariance is not None, with_causal=not causal) as tables,
        contextlib.closing(passes.causal_only() if causal else passes.records()) as records,
    ):
        for record, known_then in checks.passed(records):
            tables.write(record, known_then)
            claimed = claimed_covariances(record.tracked, record.detections, model.camera_of, run.tracker)
            width = widths(record.tracked, record.detections, model.camera_of)
            keeper.add_tracked(record.t_s, record.tracked, record.tracked.predicted_cov_px2, claimed, width)
            facts.add(record, known_then)
            on_frame(record, known_then)
    from lab.runs.model_check.check import check_kept  # the words of its report: only for those who need them

    model_check = check_kept(run.rig, keeper, run.covariance)
    # Where the model check has tested the residuals, it has separated noise from faults.
    misfit = None if model_check.inquest is not None else pipeline.tracker.noise_scale
    return facts, model_check, quality.judge(facts, model_check.findings, misfit)


def are_results(folder: Path) -> bool:
    """Whether a folder holds a run's results, which a new run may replace."""
    try:
        return bool(json.loads((folder / "summary.json").read_text("utf-8")).get("schema") == SUMMARY_SCHEMA)
    except (OSError, ValueError, AttributeError):
        return False


def _errors(results: Path, run: Run) -> dict[str, Any] | None:
    from lab.runs.score.score import score

    return score(results, run.folder)


def _summary(
    run: Run,
    pipeline: Pipeline,
    passes: TwoPasses,
    tally: _Tally,
    facts: RunFacts,
    verdict: quality.Verdict,
    model_check: ModelCheck,
    errors: Mapping[str, Any] | None,
    seconds: Mapping[str, float],
    wall_s: float,
) -> dict[str, Any]:
    frames = max(facts.frames, 1)
    notes = pipeline.notes
    if run.left_out:
        notes.append(f"cameras of the rig that this run has nothing of: {', '.join(run.left_out)}")
    if tally.unlisted:
        notes.append(f"events: the first {MOST_EVENTS} of {MOST_EVENTS + tally.unlisted} are listed")
    return {
        "schema": SUMMARY_SCHEMA,
        "name": run.name,
        "run_folder": str(run.folder.resolve()),
        "rig": str(run.rig_path.resolve()),
        "calibration": None if run.calibration is None else state_mapping(run.calibration),
        "notes_of_run": run.notes,
        "attitude": "causal" if passes.smoothing is None else "smoothed",
        "smoother": None if passes.smoothing is None else dataclasses.asdict(passes.smoothing),
        "verdict": {
            "status": verdict.status,
            "reasons": list(verdict.reasons),
            "exit_status": verdict.exit_status,
            "evidence": [e.as_mapping() for e in verdict.evidence],
        },
        "counts": {
            "frames": facts.frames,
            "spot_status": {v: dict(c) for v, c in zip(tally.views, tally.spot_status, strict=False)},
            "pose_status": dict(facts.pose),
            "detections_per_frame": {c: tally.detections[c] / frames for c in tally.cameras},
            "no_image": {c: f.missing.ranges for c, f in facts.cameras.items() if len(f.missing)},
            "no_image_reasons": {c: dict(r) for c, r in tally.reasons.items()},
            "events": dict(tally.event_kinds),
            "labels_left_open": tally.left_open,
            "causal_measured": facts.causal_measured,
            "not_measured": {cause.value: count for cause, count in facts.causes.items()},
            "found_again": facts.found_again,
            "contradictions": {"own_spots": len(facts.own_spots), "causal": len(facts.causal)},
            "invalid_covariances": len(facts.invalid),
            "cameras": {c: f.as_mapping() for c, f in facts.cameras.items()},
        },
        "rates": {
            "measured_share": facts.measured / frames,
            "frame_rate_hz": run.frame_rate_hz,
            "processed_frames_per_s": facts.frames / wall_s if wall_s > 0 else None,
            "misfit": pipeline.tracker.noise_scale,
        },
        "model_check": model_check.as_mapping(),
        "errors": errors,
        "timings": {**seconds, "wall_s": wall_s},
        "versions": versions(),
        "parameters": {
            "tracker": dataclasses.asdict(run.tracker),
            "noise": {name: noise.as_mapping() for name, noise in pipeline.noise.items()},
            "prior": _prior_numbers(run),
        },
        "inputs": fingerprints(run),
        "notes": notes,
        "events": tally.events,
    }


def _prior_numbers(run: Run) -> dict[str, Any] | None:
    if run.prior is None:
        return None
    return {
        "position_m": run.prior.centre.translation.tolist(),
        "yaw_pitch_roll_deg": np.rad2deg(run.prior.centre.ypr).tolist(),
        "within_m": run.prior.within_m,
        "within_deg": float(np.rad2deg(run.prior.within_rad)),
    }
