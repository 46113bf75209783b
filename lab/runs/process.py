"""Processes one run: a run folder in, a result folder out; its summary.json."""

from __future__ import annotations

import contextlib
import dataclasses
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from geometry.forward_model import SpotModel
from lab.files.rig.camera_file import require_valid_calibration
from lab.files.run.fingerprints import fingerprints
from lab.files.run.results import SUMMARY_SCHEMA, ResultFolder, are_results
from lab.files.run.run_file import LiveDevice, Run, load_run
from lab.files.run.truth import load_run_truth
from lab.files.text.atomic_write import atomic_folder
from lab.files.text.dataclass_fields import with_overrides
from lab.findings.finding import Level, Outcome, Verdict, worst_first
from lab.findings.finding import verdict as verdict_of
from lab.packages import versions
from lab.progress import Progress
from lab.runs.frames.pipeline import FrameRecord, Pair, Pipeline, row_records
from lab.runs.model_check.frame_sampler import FrameSampler
from lab.runs.processed import Processed
from lab.runs.run_log import listening
from lab.runs.setup_check import SampledFrames, mistakes_of_run
from lab.runs.smoothing_pass import SmoothingSummary, TrackingAndSmoothing, clock_findings
from lab.runs.tables import TableWriter
from lab.runs.verdict import quality
from lab.runs.verdict.moved_camera import MovedCamera, moved_camera
from lab.runs.verdict.run_statistics import MOST_EVENTS, CameraStatistics, FrameChecks, RunStatistics

if TYPE_CHECKING:
    from lab.runs.model_check.check import ModelCheck


def processed_run(
    pipeline: Pipeline,
    statistics: RunStatistics,
    model_check: ModelCheck,
    verdict: Verdict,
    smoothing: SmoothingSummary | None,
    errors: Mapping[str, Any] | None,
    page: Callable[[Path, Mapping[str, Any]], object],
    full_hash: bool = False,
) -> Processed[RunStatistics]:
    """A run whose tables are written. smoothing: None: causal only. errors: against truth; None without truth."""
    run, timings = pipeline.run, pipeline.timings
    return Processed(
        schema=SUMMARY_SCHEMA,
        name=run.name,
        result=statistics,
        verdict=verdict,
        frames=statistics.frames,
        measured=statistics.measured,
        frame_rate_hz=run.frame_rate_hz,
        parameters={
            "tracker": dataclasses.asdict(run.tracker),
            "noise": {name: noise.as_mapping() for name, noise in pipeline.noise.items()},
            "prior": _prior_numbers(run),
            **({"clocks": _clock_numbers(run)} if run.clocks else {}),
        },
        inputs=fingerprints(run, full_hash),
        notes=_notes(pipeline, statistics),
        blocks={
            "run_folder": str(run.folder.resolve()),
            "rig": str(run.rig_path.resolve()),
            "calibration": None if run.calibration is None else run.calibration.as_mapping(),
            "notes_of_run": run.notes,
            "attitude": "causal" if smoothing is None else "smoothed",
            "smoother": None if smoothing is None else dataclasses.asdict(smoothing),
            "counts": _counts(statistics),
            "rates": {"noise_scale": pipeline.tracker.noise_scale},
            "model_check": model_check.as_mapping(),
            "errors": errors,
            "timings": {
                "waiting_for_pictures_s": timings.waiting,
                "detection_s": timings.detection,
                "tracking_s": timings.tracking,
                "smoothing_s": timings.smoothing,
            },
            "events": [dataclasses.asdict(event) for event in statistics.events.listed],
        },
        page=page,
    )


def _counts(statistics: RunStatistics) -> dict[str, Any]:
    frames, cameras = max(statistics.frames, 1), statistics.cameras
    return {
        "spot_status": {"/".join(view): dict(c) for view, c in statistics.spot_status.items()},
        "pose_status": dict(statistics.pose),
        "detections_per_frame": {name: c.points / frames for name, c in cameras.items()},
        "no_image": {name: c.missing.ranges for name, c in cameras.items() if len(c.missing)},
        "no_image_reasons": {name: dict(c.missing_reasons) for name, c in cameras.items() if len(c.missing)},
        "events": dict(statistics.events.kinds),
        "labels_left_open": statistics.labels_left_open,
        "causal_measured": statistics.causal_measured,
        "not_measured": {cause.value: count for cause, count in statistics.causes.items()},
        "found_again": statistics.found_again,
        "contradictions": {"own_spots": len(statistics.own_spots), "causal": len(statistics.causal)},
        "invalid_covariances": len(statistics.invalid),
        "cameras": {name: c.as_mapping() for name, c in cameras.items()},
    }


def _notes(pipeline: Pipeline, statistics: RunStatistics) -> list[str]:
    notes = pipeline.notes
    if pipeline.run.left_out:
        notes.append(f"cameras of the rig without data in this run: {', '.join(pipeline.run.left_out)}")
    if unlisted := statistics.events.unlisted:
        notes.append(f"events: the first {MOST_EVENTS} of {MOST_EVENTS + unlisted} are listed")
    if outside := pipeline.run.paths_outside:
        notes.append(f"read from outside the run folder: {', '.join(map(str, outside))}")
    return notes


def _prior_numbers(run: Run) -> dict[str, Any] | None:
    if run.prior is None:
        return None
    return {
        "position_m": run.prior.centre.translation.tolist(),
        "yaw_pitch_roll_deg": np.rad2deg(run.prior.centre.ypr).tolist(),
        "within_m": run.prior.within_m,
        "within_deg": float(np.rad2deg(run.prior.within_rad)),
    }


def _clock_numbers(run: Run) -> dict[str, Any]:
    """By camera: the clocks that run.yaml states, and those that were estimated, with their sigmas."""
    out: dict[str, Any] = {}
    for name, clock in run.clocks.items():
        out[name] = {
            "time_offset_s": clock.offset_s,
            "row_time_s": clock.row_time_s,
            "timestamps": None if clock.times_path is None else str(clock.times_path),
        }
        if clock.offset_prior_s:
            out[name] |= {
                "time_offset_sigma_s": clock.offset_sigma_s,
                "time_offset_prior_sigma_s": clock.offset_prior_s,
            }
        if clock.row_time_prior_s:
            out[name] |= {"row_time_sigma_s": clock.row_time_sigma_s, "row_time_prior_sigma_s": clock.row_time_prior_s}
    return out


def process_run(
    run_folder: Path | Run,
    out: Path,
    *,
    overrides: Mapping[str, Any] | None = None,
    causal: bool = False,
    progress: Progress | None = None,
    more: Mapping[str, Any] | None = None,
    rig_path: Path | None = None,
    full_hash: bool = False,
) -> Outcome[RunStatistics]:
    """Process one run folder, or a run of `ready_run`, into the folder `out`: tables, summary.json and report.html.

    overrides: tracker parameters that replace those of run.yaml. causal: the tables hold the causal estimates and
    nothing is smoothed; otherwise they hold the smoothed estimates, and attitude_causal.csv the causal ones. more:
    additional content of summary.json. rig_path: a rig.yaml in place of the run's. full_hash: the fingerprints of the
    inputs cover every byte of large files, too. Raises BeamposeError: the run cannot be processed (CalibrationError:
    its rig's calibration must not be used); `out` is then unchanged.
    """
    started = time.perf_counter()
    run = run_folder if isinstance(run_folder, Run) else ready_run(run_folder, overrides, rig_path)
    with atomic_folder(out, may_replace=are_results) as work:
        return write_results(
            Pipeline.of(run), work, Path(out), started, causal=causal, progress=progress, more=lambda: more or {},
            full_hash=full_hash,
        )  # fmt: skip


def ready_run(
    run_folder: Path,
    overrides: Mapping[str, Any] | None = None,
    rig_path: Path | None = None,
    recording: bool = False,
) -> Run:
    """A run that may be processed, with some tracker parameters replaced. rig_path, recording: as of `load_run`.

    Raises InputError: the run folder or an override is invalid; CalibrationError: its rig's calibration must not be
    used.
    """
    run = load_run(run_folder, rig_path, recording)
    if overrides:
        run = dataclasses.replace(run, tracker=with_overrides(run.tracker, overrides))
    require_valid_calibration(run.calibration, run.rig_path, run.recorded)
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
    full_hash: bool = False,
) -> Outcome[RunStatistics]:
    """Process a pipeline's frames into the folder `work`, which will become `out`.

    started: time.perf_counter() at the start of the command. more: additional content of summary.json, called last.
    full_hash: as of `process_run`.
    """
    run = pipeline.run
    with listening() as log:
        log.start(run, versions())
        passes = TrackingAndSmoothing.of(pipeline, work, log.progress(progress))
        statistics, model_check, verdict = write_tables(passes, work, causal=causal)
        pipeline = passes.pipeline
        from lab.runs.verdict.score import against_truth, read_tables

        tables, added = against_truth(read_tables(ResultFolder(work)), run.folder), more()
        errors, verdict = tables.errors, quality.against_truth(verdict, tables.errors)

        def page(folder: Path, content: Mapping[str, Any]) -> None:
            from lab.report.run.page import write_report  # imports the template engine, which only the report needs

            log.info("stage: report")
            write_report(folder, run.folder, run, tables)
            log.conclude(verdict, content, time.perf_counter() - started)
            log.write(folder)

        done = processed_run(pipeline, statistics, model_check, verdict, passes.smoothing, errors, page, full_hash)
        return done.write(work, out, started, added)


def write_tables(
    passes: TrackingAndSmoothing,
    work: Path,
    *,
    causal: bool = False,
    on_frame: Callable[[FrameRecord, FrameRecord | None], None] | None = None,
) -> tuple[RunStatistics, ModelCheck, Verdict]:
    """Track a run, write its tables into `work`, and compute the verdict.

    Where a camera was moved during a recording, its pictures from then on are left out, and the tables are written
    again. on_frame: called with each frame as it is written and, unless `causal`, the same frame of the causal pass
    (the benches compare both with the truth).
    """
    run = passes.pipeline.run
    written = _written(passes, work, causal, on_frame)
    moved = _movement(run, written[0], written[1])
    if moved is not None and moved.camera and not any(isinstance(s, LiveDevice) for s in run.cameras.values()):
        passes.leave_out(moved.camera, moved.frame)
        written = _written(passes, work, causal, on_frame)
        moved = dataclasses.replace(moved, left_out=True)
    written[0].moved = moved
    return written[0], *_judged(passes, *written)


def _written(
    passes: TrackingAndSmoothing,
    work: Path,
    causal: bool,
    on_frame: Callable[[FrameRecord, FrameRecord | None], None] | None,
) -> tuple[RunStatistics, ModelCheck, FrameSampler, SampledFrames]:
    """The tables of a run, and what the verdict needs of its frames. Arguments as of `write_tables`."""
    from lab.runs.model_check.check import check_sampled_frames  # deferred: only needed at the end of a run

    run = passes.pipeline.run
    model = SpotModel.of(run.rig)
    checks = FrameChecks(run.rig, run.covariance)
    statistics = RunStatistics(
        {name: CameraStatistics() for name in run.rig.cameras},
        model.views,
        run.tracker.labels.min_spots,
        own_spots=checks.own_spots,
        causal=checks.causal,
        invalid=checks.invalid,
    )
    sampler, pictures = FrameSampler(), SampledFrames()
    with (
        TableWriter(
            work, run.rig, run.covariance is not None, with_causal=not causal, with_picture_times=bool(run.clocks)
        ) as tables,
        contextlib.closing(passes.causal_only() if causal else passes.records()) as records,
    ):

        def sampled(pairs: Iterable[Pair]) -> Iterator[Pair]:
            for record, before in pairs:
                sampler.add_record(record, model.camera_of, run.tracker)
                yield record, before

        for record, in_causal_pass in rows_of(passes.pipeline, sampled(checks.passed(records))):
            tables.write(record, in_causal_pass)
            statistics.add(record, in_causal_pass)
            pictures.add(record.frame, dict(zip(run.rig.cameras, record.detections, strict=True)))
            if on_frame is not None:
                on_frame(record, in_causal_pass)
    return statistics, check_sampled_frames(run.rig, sampler, run.covariance), sampler, pictures


def _movement(run: Run, statistics: RunStatistics, model_check: ModelCheck) -> MovedCamera | None:
    """The movement of a camera during the run that its frames or its model check show."""
    at_s, step = model_check.result.moved_at_s, None
    if at_s is not None:
        frames = np.arange(statistics.first_frame, statistics.last_frame + 1)
        step = int(frames[np.argmin(np.abs(run.times.t_s(frames) - at_s))])
    return moved_camera({name: c.spots for name, c in statistics.cameras.items()}, step)


def _judged(
    passes: TrackingAndSmoothing,
    statistics: RunStatistics,
    model_check: ModelCheck,
    sampler: FrameSampler,
    pictures: SampledFrames,
) -> tuple[ModelCheck, Verdict]:
    """The verdict on a run, and its model check with the findings on the clocks."""
    pipeline, run = passes.pipeline, passes.pipeline.run
    model = SpotModel.of(run.rig)
    if passes.clocks is not None:
        findings = (*clock_findings(passes.clocks), *model_check.findings)
        model_check = dataclasses.replace(model_check, findings=worst_first(findings))
    # Where the model check has tested the residuals, it has separated noise from faults.
    diagnosis = model_check.result.diagnosis
    noise_scale = None if diagnosis is not None else pipeline.tracker.noise_scale
    names = list(run.rig.cameras)
    stretch = {names[camera]: found for camera, found in sampler.stretch_of_cameras(model.camera_of).items()}
    verdict = quality.judge(statistics, model_check.findings, noise_scale, pipeline.noise, stretch)
    explained = diagnosis is not None and diagnosis.is_random
    # Where a light is too wide a spot is missing, and no mistake explains that better.
    named = any(f.code == quality.TOO_WIDE for f in verdict.findings)
    passes_all = verdict.status == "pass"
    samples = (pictures, sampler)
    mistakes = () if named else mistakes_of_run(run, statistics, *samples, passes=passes_all, explained=explained)
    if mistakes:
        # The deviations of a rig with such a mistake are its consequences.
        others = () if verdict_of(mistakes) is Level.FAIL else model_check.findings
        verdict = quality.judge(statistics, (*mistakes, *others), noise_scale, pipeline.noise, stretch)
    return model_check, verdict


def rows_of(pipeline: Pipeline, processed: Iterable[Pair]) -> Iterable[Pair]:
    """The rows of the tables; where no camera has a clock of its own, each processed frame is one."""
    moments, run = pipeline.reader.moments, pipeline.run
    if moments is None:
        return processed
    own = [name in run.clocks and run.clocks[name].times is not None for name in run.cameras]
    return row_records(processed, moments, tuple(run.cameras), own, SpotModel.of(run.rig).camera_of)
