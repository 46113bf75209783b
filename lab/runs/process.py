"""Processes one run: a run folder in, a result folder out."""

from __future__ import annotations

import contextlib
import dataclasses
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from geometry.forward_model import SpotModel
from lab.files.rig.calibration_state import require_valid_calibration
from lab.files.run.results import ResultFolder, are_results
from lab.files.run.run_file import Run, load_run
from lab.files.run.truth import load_run_truth
from lab.files.text.atomic_write import atomic_folder
from lab.files.text.dataclass_fields import with_overrides
from lab.findings.finding import Level, worst_first
from lab.findings.finding import verdict as verdict_of
from lab.findings.outcome import Outcome, Verdict
from lab.packages import versions
from lab.progress import Progress
from lab.runs.clock_estimate import clock_findings
from lab.runs.frames.pipeline import FrameRecord, Pair, Pipeline
from lab.runs.frames.row_records import row_records
from lab.runs.model_check.frame_sampler import FrameSampler
from lab.runs.run_log import RunLog, listening
from lab.runs.setup_check import SampledFrames, mistakes_of_run
from lab.runs.smoothing_pass import TrackingAndSmoothing
from lab.runs.summary import processed_run
from lab.runs.tables import TableWriter
from lab.runs.verdict import quality
from lab.runs.verdict.frame_checks import FrameChecks
from lab.runs.verdict.run_statistics import CameraStatistics, RunStatistics

if TYPE_CHECKING:
    from lab.runs.model_check.check import ModelCheck


def process_run(
    run_folder: Path,
    out: Path,
    *,
    overrides: Mapping[str, Any] | None = None,
    causal: bool = False,
    progress: Progress | None = None,
    more: Callable[[Run], Mapping[str, Any]] | None = None,
    rig_path: Path | None = None,
    full_hash: bool = False,
) -> Outcome[RunStatistics]:
    """Process one run folder into the folder `out`: the tables, summary.json and report.html.

    overrides: tracker parameters that replace those of run.yaml. causal: the tables hold the causal estimates and
    nothing is smoothed; otherwise they hold the smoothed estimates, and attitude_causal.csv the causal ones. more:
    additional content of summary.json; called with the run before its processing. rig_path: a rig.yaml in place of the
    run's. full_hash: the fingerprints of the inputs cover every byte of large files, too. Raises BeamposeError: the run
    cannot be processed (CalibrationError: its rig's calibration must not be used); `out` is then unchanged.
    """
    started = time.perf_counter()
    run = ready_run(run_folder, overrides, rig_path)
    added = {} if more is None else more(run)
    with atomic_folder(out, may_replace=are_results) as work:
        return write_results(
            Pipeline.of(run), work, Path(out), started, causal=causal, progress=progress, more=lambda: added,
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
    with listening() as log:
        return _write_results(pipeline, work, out, started, log, causal, progress, more, full_hash)


def _write_results(
    pipeline: Pipeline,
    work: Path,
    out: Path,
    started: float,
    log: RunLog,
    causal: bool,
    progress: Progress | None,
    more: Callable[[], Mapping[str, Any]],
    full_hash: bool,
) -> Outcome[RunStatistics]:
    run = pipeline.run
    log.start(run, versions())
    passes = TrackingAndSmoothing.of(pipeline, work, log.progress(progress))
    pipeline = passes.pipeline
    statistics, model_check, verdict = write_tables(pipeline, passes, work, causal=causal)
    from lab.runs.verdict.score import against_truth, read_tables

    tables, added = against_truth(read_tables(ResultFolder(work)), run.folder), more()
    verdict = quality.against_truth(verdict, tables.errors)

    def page(folder: Path, content: Mapping[str, Any]) -> None:
        from lab.report.run.page import write_report  # imports the template engine, which only the report needs

        log.info("stage: report")
        write_report(folder, run.folder, run, tables)
        log.conclude(verdict, content, time.perf_counter() - started)
        log.write(folder)

    done = processed_run(pipeline, statistics, model_check, verdict, passes.smoothing, tables.errors, page, full_hash)
    return done.write(work, out, started, added)


def write_tables(
    pipeline: Pipeline,
    passes: TrackingAndSmoothing,
    work: Path,
    *,
    causal: bool = False,
    on_frame: Callable[[FrameRecord, FrameRecord | None], None] | None = None,
) -> tuple[RunStatistics, ModelCheck, Verdict]:
    """Track a run, write its tables into `work`, and compute the verdict.

    on_frame: called with each frame as it is written and, unless `causal`, the same frame of the causal pass.
    """
    run = pipeline.run
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

        for record, in_causal_pass in rows_of(pipeline, sampled(checks.passed(records))):
            tables.write(record, in_causal_pass)
            statistics.add(record, in_causal_pass)
            pictures.add(record.frame, dict(zip(run.rig.cameras, record.detections, strict=True)))
            if on_frame is not None:
                on_frame(record, in_causal_pass)
    from lab.runs.model_check.check import check_sampled_frames  # deferred: only needed at the end of a run

    model_check = check_sampled_frames(run.rig, sampler, run.covariance)
    if passes.clocks is not None:
        findings = (*clock_findings(passes.clocks), *model_check.findings)
        model_check = dataclasses.replace(model_check, findings=worst_first(findings))
    # Where the model check has tested the residuals, it has separated noise from faults.
    diagnosis = model_check.result.diagnosis
    noise_scale = None if diagnosis is not None else pipeline.tracker.noise_scale
    mosaics = {name: noise.mosaic for name, noise in pipeline.noise.items() if noise.mosaic}
    verdict = quality.judge(statistics, model_check.findings, noise_scale, mosaics)
    explained = diagnosis is not None and diagnosis.is_random
    mistakes = mistakes_of_run(run, statistics, pictures, passes=verdict.status == "pass", explained=explained)
    if mistakes:
        # The deviations of a rig with such a mistake are its consequences.
        others = () if verdict_of(mistakes) is Level.FAIL else model_check.findings
        verdict = quality.judge(statistics, (*mistakes, *others), noise_scale, mosaics)
    return statistics, model_check, verdict


def rows_of(pipeline: Pipeline, processed: Iterable[Pair]) -> Iterable[Pair]:
    """The rows of the tables; where no camera has a clock of its own, each processed frame is one."""
    moments, run = pipeline.reader.moments, pipeline.run
    if moments is None:
        return processed
    own = [name in run.clocks and run.clocks[name].times is not None for name in run.cameras]
    return row_records(processed, moments, tuple(run.cameras), own, SpotModel.of(run.rig).camera_of)
