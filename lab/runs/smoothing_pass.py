"""A run looked at twice: once frame by frame as it comes, and once knowing all of it.

Between the two the frames wait on disk, so that memory holds only what the smoother needs of them (about 1 kB each).
"""

from __future__ import annotations

import pickle
import tempfile
import time
from collections.abc import Callable, Generator
from dataclasses import dataclass, field, replace
from pathlib import Path

from lab.runs.frames.pipeline import FrameRecord, Pipeline
from tracking.smoothing.recording import TrackedRecording
from tracking.smoothing.smoothed import Smoothed
from tracking.smoothing.smoother import smooth

Progress = Callable[[int, int | None, str], None]  # frames done, frames in all where known, what is being done
TRACKING, SMOOTHING, WRITING = "tracking", "smoothing", "writing"  # its stages


@dataclass(frozen=True, slots=True)
class Smoothing:
    """What the smoother says of itself, as in summary.json."""

    jerk_m_s3: float  # strength of the steady motion's jerk, m/s^3 per sqrt(Hz) ...
    jerk_rad_s3: float  # ... and of the rotation's, rad/s^3 per sqrt(Hz)
    iterations: int
    relabelled: int  # labels that the second look changed
    place_share: float  # of the spots' error variance that averaging over a vehicle at rest does not lessen
    seconds: float


@dataclass(slots=True)
class TwoPasses:
    """One run in work. Iterate once over `records()` or `causal_only()`; `smoothing` is complete afterwards.

    folder: where the frames wait between the passes, in a file without a name that goes with the process.
    """

    pipeline: Pipeline
    folder: Path
    progress: Progress | None = None
    smoothing: Smoothing | None = field(default=None, init=False)  # None: not smoothed

    def causal_only(self) -> Generator[tuple[FrameRecord, None], None, None]:
        """One pass: each frame as it was known at its instant."""
        total = self.pipeline.reader.expected_frames
        for done, record in enumerate(self.pipeline.records(), start=1):
            yield record, None
            self._tell(done, total, TRACKING)

    def records(self) -> Generator[tuple[FrameRecord, FrameRecord], None, None]:
        """Both passes: each frame as the whole run tells it, and as it was known at its instant."""
        run, total = self.pipeline.run, self.pipeline.reader.expected_frames
        recording = TrackedRecording(run.rig, run.tracker, run.covariance, run.exposure_s or 0.0)
        with tempfile.TemporaryFile(dir=self.folder, prefix=".frames-") as waiting:
            for done, record in enumerate(self.pipeline.records(), start=1):
                pickle.dump(record, waiting, pickle.HIGHEST_PROTOCOL)
                recording.append(record.dt_s, record.detections, record.tracked)
                self._tell(done, total, TRACKING)
            smoothed = self._smooth(recording)
            waiting.seek(0)
            for k in range(smoothed.frames):
                causal: FrameRecord = pickle.load(waiting)  # written above, in a file that nobody else has
                clock = time.perf_counter()
                tracked = smoothed.frame(k, causal.tracked, causal.detections)
                self.pipeline.timings.smoothing += time.perf_counter() - clock
                yield replace(causal, tracked=tracked), causal
                self._tell(k + 1, smoothed.frames, WRITING)

    def _smooth(self, recording: TrackedRecording) -> Smoothed:
        self._tell(0, None, SMOOTHING)
        clock = time.perf_counter()
        smoothed = smooth(recording)
        seconds = time.perf_counter() - clock
        self.pipeline.timings.smoothing += seconds
        self.smoothing = Smoothing(
            float(smoothed.jerk[0]), float(smoothed.jerk[1]), smoothed.iterations, smoothed.relabelled,
            smoothed.place_share, seconds,
        )  # fmt: skip
        return smoothed

    def _tell(self, done: int, total: int | None, stage: str) -> None:
        if self.progress is not None:
            self.progress(done, total, stage)
