"""The output of the program for a scene, by the code of `beampose run`: in memory, or through files."""

from __future__ import annotations

import contextlib
import tempfile
import time
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bench.random_scenes.scene import Scene
from geometry.arrays import Array, Bools
from geometry.pose import Pose
from lab.files.run.clocks import Times
from lab.files.run.results import read_poses, read_spots
from lab.files.run.run_file import Run
from lab.pictures.picture_file import DROPPED, MissingPicture
from lab.runs import process
from lab.runs.frames.frames import FrameSet
from lab.runs.frames.pipeline import FrameRecord, Pipeline, Tracker, tracker_of
from lab.runs.smoothing_pass import TrackingAndSmoothing
from tracking.detections import UNMATCHED, Detections
from tracking.parameters import TrackerParameters
from tracking.statuses import PoseStatus, TrackedFrame

LOST, PREDICTED, MEASURED = range(3)
_STATUS = {PoseStatus.LOST: LOST, PoseStatus.PREDICTED: PREDICTED, PoseStatus.MEASURED: MEASURED}


@dataclass(frozen=True, slots=True)
class Pass:
    """The output of the causal or of the smoothing pass: T frames, n views."""

    labelled: Bools  # (T, n)
    uv_px: Array  # (T, n, 2) of the labelled points; nan without a label
    status: Array  # (T,) LOST, PREDICTED or MEASURED
    poses: Pose  # (T,), nan where lost
    covariance: Array  # (T, 6, 6), nan where lost


@dataclass(frozen=True, slots=True)
class Answers:
    """The output of a run, and its process time."""

    smoothed: Pass
    causal: Pass | None  # None through files, which do not contain the labels
    exit_status: int
    reasons: tuple[str, ...]  # of the verdict
    warnings: tuple[str, ...]  # numeric warnings, each text once
    warnings_count: int
    ms_per_frame: float  # process time, tracking and smoothing
    ms_causal: float  # of the causal pass, median over frames ...
    ms_slowest: float  # ... and of its slowest frame
    rounds: int  # of smoothing


class TimedTracker:
    """A tracker whose steps are timed."""

    def __init__(self, tracker: Tracker) -> None:
        self._tracker = tracker
        self.ms: list[float] = []

    @property
    def noise_scale(self) -> float:
        """Of the tracker."""
        return self._tracker.noise_scale

    def step(self, dt_s: float, found: Sequence[Detections | None]) -> TrackedFrame:
        """Track one frame."""
        start = time.process_time()
        tracked = self._tracker.step(dt_s, found)
        self.ms.append((time.process_time() - start) * 1e3)
        return tracked

    def __getattr__(self, name: str) -> object:
        return getattr(self._tracker, name)


class PointReader:
    """The frames of a scene in the form of lab/runs/frames/frames.py."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self.cameras = tuple(scene.rig.cameras)
        self.expected_frames = len(scene)
        self.moments = None  # no camera has a clock of its own
        self.sources: dict[str, object] = {}
        self.notes: list[str] = []

    def __iter__(self) -> Iterator[FrameSet]:
        for k in range(len(self._scene)):
            pictures = [MissingPicture(DROPPED) if d is None else d for d in self._scene.found(k)]
            yield FrameSet(k, dict(zip(self.cameras, pictures, strict=True)))


def answers_in_memory(scene: Scene, parameters: TrackerParameters | None = None) -> Answers:
    """Track, smooth, write the tables and give a verdict as lab/runs/process.py, without input files and report."""
    run = Run(
        folder=Path(),
        name=f"seed {scene.seed}",
        rig=scene.known_rig,
        rig_path=Path("rig.yaml"),
        frame_rate_hz=scene.frame_rate_hz,
        exposure_s=None,
        times=Times(scene.frame_rate_hz),
        times_path=None,
        cameras={},
        left_out=(),
        prior=scene.prior,
        tracker=TrackerParameters() if parameters is None else parameters,
        notes="",
        covariance=scene.covariance,
    )
    smoothed: list[FrameRecord] = []
    causal: list[FrameRecord] = []
    with recorded_warnings() as caught, tempfile.TemporaryDirectory() as name:
        work = Path(name)
        tracker = TimedTracker(tracker_of(run))
        # PointReader and TimedTracker have only the members of a reader and a tracker that Pipeline uses.
        pipeline = Pipeline(run, PointReader(scene), tracker, {})
        seconds = 0.0
        start = time.process_time()

        def on_frame(record: FrameRecord, then: FrameRecord | None) -> None:
            nonlocal seconds
            assert then is not None, "expected the output of both passes, got the causal one"
            if smoothed and record.frame <= smoothed[-1].frame:  # written again, without a camera that was moved
                smoothed.clear()
                causal.clear()
            smoothed.append(record)
            causal.append(then)
            seconds = time.process_time() - start

        passes = TrackingAndSmoothing(pipeline, work)
        _, _, verdict = process.write_tables(passes, work, on_frame=on_frame)
    return Answers(
        _pass(scene, smoothed),
        _pass(scene, causal),
        verdict.exit_status,
        verdict.texts,
        tuple(dict.fromkeys(caught)),
        len(caught),
        seconds / len(scene) * 1e3,
        float(np.median(tracker.ms)),
        float(np.max(tracker.ms)),
        passes.smoothing.iterations if passes.smoothing is not None else 0,
    )


def answers_through_files(scene: Scene, run_folder: Path) -> Answers:
    """The results of `beampose run` for a written run folder (write_folder.py), read from its tables."""
    with recorded_warnings() as caught, tempfile.TemporaryDirectory() as name:
        out = Path(name) / "out"
        start = time.process_time()
        outcome = process.process_run(run_folder, out)
        seconds = time.process_time() - start
        smoothed = pass_of_files(scene, out, causal=False)
    return Answers(
        smoothed, None, outcome.exit_status, outcome.verdict.texts, tuple(dict.fromkeys(caught)), len(caught),
        seconds / len(scene) * 1e3, float("nan"), float("nan"), 0,
    )  # fmt: skip


@contextlib.contextmanager
def recorded_warnings() -> Iterator[list[str]]:
    """The texts of all warnings raised in the context."""
    texts: list[str] = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        yield texts
        texts += [f"{w.category.__name__}: {w.message} ({Path(w.filename).name})" for w in caught]


def _pass(scene: Scene, records: list[FrameRecord]) -> Pass:
    frames, views = len(scene), len(scene.camera_of)
    labelled, uv = np.zeros((frames, views), dtype=bool), np.full((frames, views, 2), np.nan)
    status, rotation = np.full(frames, LOST), np.full((frames, 3, 3), np.nan)
    translation, covariance = np.full((frames, 3), np.nan), np.full((frames, 6, 6), np.nan)
    for k, record in enumerate(records):
        tracked = record.tracked
        labelled[k] = tracked.point != UNMATCHED
        for v in np.flatnonzero(labelled[k]):
            points = record.detections[int(scene.camera_of[v])]
            if points is not None:
                uv[k, v] = points.uv_px[tracked.point[v]]
        status[k] = _STATUS[tracked.pose_status]
        if tracked.pose is not None and tracked.pose_covariance is not None:
            rotation[k], translation[k] = tracked.pose.rotation, tracked.pose.translation
            covariance[k] = tracked.pose_covariance
    return Pass(labelled, uv, status, Pose(rotation, translation), covariance)


def pass_of_files(scene: Scene, results: Path, causal: bool) -> Pass:
    """The output in the tables of a results folder."""
    spots, poses = read_spots(results), read_poses(results, causal=causal)
    frames, views = len(scene), scene.rig.views()
    labelled, uv = np.zeros((frames, len(views)), dtype=bool), np.full((frames, len(views), 2), np.nan)
    for j, view in enumerate(views):
        if view in spots.views:
            i = list(spots.views).index(view)
            labelled[spots.frames, j] = spots.measured[:, i]
            uv[spots.frames, j] = np.where(spots.measured[:, i, None], spots.uv_px[:, i], np.nan)
    status = np.full(frames, LOST)
    rotation, translation = np.full((frames, 3, 3), np.nan), np.full((frames, 3), np.nan)
    covariance = np.full((frames, 6, 6), np.nan)
    status[poses.frames[poses.has(PoseStatus.PREDICTED)]] = PREDICTED
    status[poses.frames[poses.has(PoseStatus.MEASURED)]] = MEASURED
    rotation[poses.frames], translation[poses.frames] = (
        poses.world_from_body.rotation,
        poses.world_from_body.translation,
    )
    covariance[poses.frames] = poses.covariance
    return Pass(labelled, uv, status, Pose(rotation, translation), covariance)
