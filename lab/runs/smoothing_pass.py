"""The two passes over a run: causal tracking frame by frame, then smoothing over the whole run.

Between the passes all but the first IN_MEMORY frames are stored on disk; memory then holds only what the smoother needs
(about 1 kB per frame).
"""

from __future__ import annotations

import pickle
import tempfile
import time
from collections.abc import Generator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from lab.progress import Progress
from lab.runs.clock_estimate import ClockEstimate, with_estimated_clocks
from lab.runs.frames.moments import Moment
from lab.runs.frames.pipeline import FrameRecord, Pipeline
from tracking.smoothing.recording import TrackedRecording
from tracking.smoothing.smoother import Smoothed, smooth

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
    """Processes one run. Iterate once over `records()` or `causal_only()`; `smoothing` is complete afterwards.

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
