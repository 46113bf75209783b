"""The passes over a run: causal tracking frame by frame, then smoothing over the whole run.

Between the passes all but the first IN_MEMORY frames are stored on disk; memory then holds only what the smoother needs
(about 1 kB per frame).

Before them, offsets and row times that run.yaml leaves to be estimated: causal passes until they are known. The first
one starts with the priors: the spots of a camera whose clock is not known are found in wide regions and hardly weigh
along their motion. The model check's residuals of its frames give the clocks (calibration/model_check/clocks.py), and
the next pass uses every picture at its corrected instant. The smoothing pass estimates them once more. Source: ours.
"""

from __future__ import annotations

import pickle
import tempfile
import time
from collections.abc import Generator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from calibration.model_check.clocks import ClockFit, ClockNumber, fit_clocks
from calibration.model_check.linearised_frames import ModelCheckRecording
from geometry.arrays import Array, Bools
from lab.files.run.clocks import CameraClock
from lab.files.run.run_file import DetectionsTable, Run
from lab.findings.finding import Finding, Level, finding
from lab.number_format import format_number, format_with_sigma
from lab.progress import Progress
from lab.runs.frames.frames import ClockedFrames, FoundPoints
from lab.runs.frames.moments import Moment
from lab.runs.frames.pipeline import FrameRecord, Pipeline
from lab.runs.model_check.frame_sampler import FrameSampler
from tracking.smoothing.recording import EstimatedClocks, FoundClocks, TrackedRecording
from tracking.smoothing.smoothed import Smoothed
from tracking.smoothing.smoother import smooth

MOST_PASSES = 4  # causal ones
SETTLED = 0.1  # of the prior's sigma: a smaller correction does not need another causal pass
NONLINEAR = 0.1  # share of a correction that counts as its error in the next pass
CODE = "BP-M09"


@dataclass(frozen=True, slots=True)
class ClockEstimate:
    """p numbers of a run's clocks."""

    numbers: tuple[ClockNumber, ...]
    value_s: Array  # (p,)
    covariance: Array  # (p, p)
    prior_s: Array  # (p,)
    prior_sigma_s: Array  # (p,)
    wide: Bools  # (p,) whether the prior is
    reference: str = ""  # the camera that is held, where all offsets are to be estimated
    reference_prior: tuple[float, float] = (0.0, 0.0)  # s, and its sigma

    @staticmethod
    def of(run: Run) -> ClockEstimate | None:
        """What a run leaves to be estimated, before its first pass; None: nothing.

        Where no camera's offset is known, the first camera is the reference.
        """
        clocks = {name: run.clocks.get(name, CameraClock()) for name in run.cameras}
        if not any(c.offset_prior_s or c.row_time_prior_s for c in clocks.values()):
            return None
        reference = next(iter(clocks)) if all(c.offset_prior_s for c in clocks.values()) else ""
        numbers, priors, wide = [], [], []
        for name, clock in clocks.items():
            here = clock.wide(run.frame_rate_hz, run.rig.cameras[name].image_size_px[1])
            offset, row_time = (clock.offset_s, clock.offset_prior_s), (clock.row_time_s, clock.row_time_prior_s)
            for prior, is_row_time in ((offset, False), (row_time, True)):
                if prior[1] and (is_row_time or name != reference):
                    numbers.append(ClockNumber(name, is_row_time))
                    priors.append(prior)
                    wide.append(here)
        mean, sigma = np.array(priors).reshape(-1, 2).T
        held = clocks[reference] if reference else CameraClock()
        return ClockEstimate(
            tuple(numbers), mean, np.diag(sigma**2), mean, sigma, np.array(wide, dtype=bool),
            reference, (held.offset_s, held.offset_prior_s),
        )  # fmt: skip

    @property
    def sigma_s(self) -> Array:
        """(p,)"""
        return np.sqrt(np.diagonal(self.covariance))

    def fitted(self, run: Run, recording: ModelCheckRecording | None) -> tuple[ClockEstimate, Array]:
        """The estimate after a pass whose clocks were the present ones, and the corrections (p,), s, that it found."""
        mean, sigma = self.prior_s - self.value_s, self.prior_sigma_s
        if recording is None:
            fit = ClockFit(mean, np.diag(sigma**2))
        else:
            fit = fit_clocks(run.rig, recording, run.covariance, self.numbers, (mean, sigma))
        return replace(self, value_s=self.value_s + fit.correction_s, covariance=fit.covariance), fit.correction_s

    def of_recording(self, run: Run) -> EstimatedClocks:
        """The numbers as the smoothing pass corrects them."""
        cameras = list(run.rig.cameras)
        numbers = tuple((cameras.index(n.camera), n.is_row_time) for n in self.numbers)
        return EstimatedClocks(numbers, self.prior_s - self.value_s, self.prior_sigma_s)

    def corrected(self, found: FoundClocks) -> ClockEstimate:
        """The estimate after the smoothing pass."""
        return replace(self, value_s=self.value_s + found.correction_s, covariance=found.covariance)

    def of_run(self, run: Run, error_s: Array | None = None) -> Run:
        """The run with these clocks. error_s (p,): 1 sigma of a further error of each number."""
        clocks = dict(run.clocks)
        more = np.zeros(len(self.numbers)) if error_s is None else error_s
        if self.reference:
            clocks[self.reference] = replace(clocks[self.reference], offset_sigma_s=0.0)
        for number, value, sigma in zip(
            self.numbers, self.value_s.tolist(), np.hypot(self.sigma_s, more).tolist(), strict=True
        ):
            changes = (
                {"row_time_s": value, "row_time_sigma_s": sigma}
                if number.is_row_time
                else {"offset_s": value, "offset_sigma_s": sigma}
            )
            clocks[number.camera] = replace(clocks[number.camera], **changes)
        return replace(run, clocks=clocks)

    def by_camera(self, values_s: Array) -> Mapping[str, tuple[float, float]]:
        """Of values (p,): those of the offset and of the row time of each camera; 0 where there is none."""
        out: dict[str, tuple[float, float]] = {}
        for number, value in zip(self.numbers, values_s.tolist(), strict=True):
            offset, row_time = out.get(number.camera, (0.0, 0.0))
            out[number.camera] = (offset, value) if number.is_row_time else (value, row_time)
        return out


def clock_findings(estimate: ClockEstimate) -> tuple[Finding, ...]:
    """What a run has found of its clocks."""
    out = []
    e = estimate
    values = zip(e.numbers, e.value_s, e.sigma_s, e.prior_s, e.prior_sigma_s, e.wide, strict=True)
    for number, value, sigma, mean, prior, wide in values:
        factor, unit = (1e6, "us") if number.is_row_time else (1e3, "ms")
        figure = f"{format_with_sigma(factor * value, factor * sigma)} {unit}"
        if sigma < prior:
            out.append(finding(CODE, Level.PASS, f"{number.name}: estimated as {figure}"))
            continue
        text = f"{number.name}: this recording hardly determines it, and"
        stays = format_with_sigma(factor * mean, factor * prior) if mean else f"0 ± {format_number(factor * prior, 2)}"
        out.append(finding(CODE, Level.WARN if wide else Level.PASS, f"{text} the prior stays (prior: {stays} {unit})"))
    if estimate.reference:
        held, prior = (1e3 * value for value in e.reference_prior)
        at = f"{format_number(held)} ms" if held else "0"
        text = f"the offset of camera `{e.reference}` is held at {at} as the reference of the others"
        others = any(not number.is_row_time for number in estimate.numbers)
        if not others:
            text = f"{ClockNumber(e.reference, False).name}: there is no other camera to compare with, {at} is kept"
            text += f" (prior: {at} ± {format_number(prior, 2)} ms)"
        out.append(finding(CODE, Level.PASS if others else Level.WARN, text))
    return tuple(out)


def with_estimated_clocks(
    pipeline: Pipeline, folder: Path, progress: Progress | None = None
) -> tuple[Pipeline, ClockEstimate | None]:
    """The pipeline of a run with its clocks as far as causal passes show them, and these clocks.

    None, and the pipeline itself, where all clocks are known. folder: of temporary files. Priors that are not wide need
    no causal pass.
    """
    estimate = ClockEstimate.of(pipeline.run)
    if estimate is None:
        return pipeline, None
    if not estimate.wide.any():
        pipeline.run = estimate.of_run(pipeline.run)
        return pipeline, estimate
    run, reader = pipeline.run, pipeline.reader
    assert isinstance(reader, ClockedFrames)
    pictures = [name for name, source in run.cameras.items() if not isinstance(source, DetectionsTable)]
    found = FoundPoints(folder, pictures)
    here = pipeline.again(estimate.of_run(run), reader, keep=found)
    for number in range(MOST_PASSES):
        sampler, total = FrameSampler(), here.reader.expected_frames
        for done, record in enumerate(here.records(), start=1):
            sampler.add_record(record, here.model.camera_of, run.tracker)
            if progress is not None:
                progress(done, total, f"clocks, pass {number + 1}")
        estimate, correction_s = estimate.fitted(run, sampler.recording())
        known = estimate.of_run(run, NONLINEAR * correction_s)
        here = here.again(known, reader.again(known, found))
        if np.all(np.abs(correction_s) < SETTLED * estimate.prior_sigma_s):
            break
    return here, estimate


IN_MEMORY = 1000  # frames, of 11 kB each; writing and reading one takes 0.12 ms
_PROTOCOL = 4  # of pickle: reads arrays in half the time of protocol 5
TRACKING, SMOOTHING, WRITING = "tracking", "smoothing", "writing"  # the stages


@dataclass(frozen=True, slots=True)
class SmoothingSummary:
    """Figures of the smoothing pass, as in summary.json."""

    jerk_m_s3: float  # spectral density of the translational jerk in steady motion, m/s^3 per sqrt(Hz)
    jerk_rad_s3: float  # spectral density of the rotational jerk, rad/s^3 per sqrt(Hz)
    iterations: int
    relabelled: int  # labels that the smoothing pass changed
    place_share: float  # share of the spots' error variance that averaging over a vehicle at rest does not reduce
    seconds: float


@dataclass(slots=True)
class TrackingAndSmoothing:
    """Processes one run. Iterate over `records()` or `causal_only()`, again only after `leave_out`; `smoothing` is
    complete afterwards.

    folder: where frames are stored between the passes, in an unnamed temporary file.
    """

    pipeline: Pipeline
    folder: Path
    progress: Progress | None = None
    clocks: ClockEstimate | None = None  # of a run whose clocks are estimated: by the passes before, then by this one
    smoothing: SmoothingSummary | None = field(default=None, init=False)  # None: not smoothed
    _planned: Mapping[str, tuple[float, float]] = field(default_factory=dict, init=False)  # clocks of the moments

    @classmethod
    def of(cls, pipeline: Pipeline, folder: Path, progress: Progress | None = None) -> TrackingAndSmoothing:
        """The passes of a run, after those that estimate its clocks, where it leaves that to them."""
        with_clocks, clocks = with_estimated_clocks(pipeline, folder, progress)
        return cls(with_clocks, folder, progress, clocks)

    def causal_only(self) -> Generator[tuple[FrameRecord, None], None, None]:
        """The causal pass alone: each frame estimated from the frames up to it."""
        total = self.pipeline.reader.expected_frames
        for done, record in enumerate(self.pipeline.records(), start=1):
            yield record, None
            self._report(done, total, TRACKING)

    def records(self) -> Generator[tuple[FrameRecord, FrameRecord], None, None]:
        """Both passes: each frame as smoothed over the whole run, and as in the causal pass."""
        run, total = self.pipeline.run, self.pipeline.reader.expected_frames
        recording = TrackedRecording(run.rig, run.tracker, run.covariance, run.exposure_s or 0.0)
        if self.clocks is not None and self.clocks.numbers:
            recording.clocks = self.clocks.of_recording(run)
            self._planned = self.clocks.by_camera(self.clocks.value_s)
        first: list[FrameRecord] = []
        with tempfile.TemporaryFile(dir=self.folder, prefix=".frames-") as waiting:
            for done, record in enumerate(self.pipeline.records(), start=1):
                if done <= IN_MEMORY:
                    first.append(record)
                else:
                    pickle.dump(record, waiting, _PROTOCOL)
                recording.append(record.dt_s, record.detections, record.tracked)
                self._report(done, total, TRACKING)
            smoothed = self._smooth(recording)
            if self.clocks is not None and smoothed.clocks is not None:
                self.clocks = self.clocks.corrected(smoothed.clocks)
                self.pipeline.run = self.clocks.of_run(run)
            waiting.seek(0)
            for k in range(smoothed.frames):
                # Written above, in a file that no other process can open.
                causal: FrameRecord = first[k] if k < len(first) else pickle.load(waiting)
                clock = time.perf_counter()
                tracked = smoothed.frame(k, causal.tracked, causal.detections)
                self.pipeline.timings.smoothing += time.perf_counter() - clock
                yield replace(causal, tracked=tracked, moment=self._at_instants(causal.moment)), causal
                self._report(k + 1, smoothed.frames, WRITING)

    def leave_out(self, camera: str, frame: int) -> None:
        """Go through the recording again without the pictures of a camera from a frame on."""
        self.pipeline = replace(self.pipeline.again(self.pipeline.run, self.pipeline.reader), moved=(camera, frame))

    def _at_instants(self, moment: Moment | None) -> Moment | None:
        """A moment whose pictures have their estimated instants."""
        if self.clocks is None or moment is None:
            return moment
        planned, now = self._planned, self.clocks.by_camera(self.clocks.value_s)
        pictures = {
            name: replace(p, t_s=p.t_s + now[name][0] - planned[name][0]) if name in now else p
            for name, p in moment.pictures.items()
        }
        return replace(moment, pictures=pictures)

    def _smooth(self, recording: TrackedRecording) -> Smoothed:
        self._report(0, None, SMOOTHING)
        clock = time.perf_counter()
        smoothed = smooth(recording)
        seconds = time.perf_counter() - clock
        self.pipeline.timings.smoothing += seconds
        self.smoothing = SmoothingSummary(
            float(smoothed.jerk[0]), float(smoothed.jerk[1]), smoothed.iterations, smoothed.relabelled,
            smoothed.place_share, seconds,
        )  # fmt: skip
        return smoothed

    def _report(self, done: int, total: int | None, stage: str) -> None:
        if self.progress is not None:
            self.progress(done, total, stage)
