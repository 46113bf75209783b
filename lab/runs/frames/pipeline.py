"""The pipeline from a run's pictures to one record per frame: detection, tracking, pose. It is a generator."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias

import numpy as np

from geometry.arrays import Array, Ints
from geometry.forward_model import SpotModel
from geometry.light_centroid import CentroidOffsets
from geometry.pose_prior import PosePrior
from geometry.uncertainty.rig_uncertainty import with_variances
from lab.files.run.run_file import DetectionsTable, Run
from lab.pictures.picture_file import GreyPicture, MissingPicture
from lab.runs.frames.frames import FoundPoints, FrameSet, open_frames
from lab.runs.frames.moments import Moment
from tracking.detections import Detections, PictureClock, on_beam_axes
from tracking.rigid_body.rigid_tracker import RigidTracker
from tracking.statuses import TrackedFrame

if TYPE_CHECKING:
    from lab.runs.frames.sensor_noise import CameraNoise


class Tracker(Protocol):
    """A tracker of any method: it processes the detections frame by frame."""

    @property
    def noise_scale(self) -> float:
        """Ratio of the spots' errors to their stated sigmas."""

    def step(self, dt_s: float, found: Sequence[Detections | None]) -> TrackedFrame:
        """Process one frame.

        dt_s: time since the previous frame (0 for the first). found: per camera, None without a picture.
        """


class Frames(Protocol):
    """The pictures of all cameras, frame by frame: recorded (lab.runs.frames.frames) or live (lab.runs.watch)."""

    @property
    def notes(self) -> list[str]:
        """Notes for the user of the results; complete once the iteration has ended."""

    @property
    def expected_frames(self) -> int | None:
        """Number of frames; None where unknown."""

    @property
    def moments(self) -> Sequence[Moment] | None:
        """What is processed, complete once the iteration has ended; None: one moment for each frame."""

    def __iter__(self) -> Iterator[FrameSet]: ...


@dataclass(frozen=True, slots=True)
class ShownPicture:
    """The points in one picture of a camera with a clock of its own."""

    number: int
    t_s: float  # mid-exposure of its middle row
    camera: int
    detections: Detections


@dataclass(frozen=True, slots=True)
class FrameRecord:
    """Detections and tracking result of one frame."""

    frame: int
    t_s: float
    dt_s: float  # since the previous record; 0 for the first
    detections: tuple[Detections | None, ...]  # per camera of the run; None without a usable picture
    missing: tuple[str, ...]  # per camera: the reason why there is no picture; "" where there is one
    tracked: TrackedFrame
    moment: Moment | None = None  # of a run whose cameras have clocks of their own ...
    pictures: tuple[ShownPicture, ...] | None = None  # ... and the pictures since the row before; None: one per camera


Pair: TypeAlias = tuple[FrameRecord, FrameRecord | None]  # a frame, and the same in the causal pass


def tracker_of(run: Run) -> Tracker:
    """A new tracker of the run's method; without a prior it starts from all poses that show the spots."""
    prior = PosePrior.everywhere(run.rig) if run.prior is None else run.prior
    if run.tracker.method == "spots":
        from tracking.curve_switching.spot_tracker import SpotTracker  # few runs need it

        return SpotTracker(run.rig, run.tracker, prior, run.covariance)
    return RigidTracker(run.rig, run.tracker, prior, run.covariance)


@dataclass(slots=True)
class Timings:
    """Wall-clock time spent in the processing thread, s."""

    waiting: float = 0.0  # for pictures
    detection: float = 0.0
    tracking: float = 0.0
    smoothing: float = 0.0


LEFT_OUT = "left out: the camera has moved"  # reason for a picture that is not used
NEGLIGIBLE_S = 1e-9  # between a picture and its moment: rounding of times


@dataclass(slots=True)
class Pipeline:
    """Processes one run. Iterate over `records()` once; `notes`, `noise` and `timings` are complete afterwards."""

    run: Run
    reader: Frames
    tracker: Tracker
    noise: dict[str, CameraNoise]  # of cameras with pictures
    on_record: Callable[[FrameRecord], None] | None = None  # called with each record at once
    timings: Timings = field(default_factory=Timings)
    found: FoundPoints | None = None  # where the points of pictures are kept for a further pass
    moved: tuple[str, int] | None = None  # a camera and the frame from which on its pictures are left out
    _offsets: dict[str, CentroidOffsets] = field(default_factory=dict)

    @staticmethod
    def of(run: Run) -> Pipeline:
        """Open a run. Raises InputError: its pictures cannot be found."""
        reader = open_frames(run)
        noise: dict[str, CameraNoise] = {}
        if not all(isinstance(source, DetectionsTable) for source in run.cameras.values()):
            from lab.runs.frames.sensor_noise import camera_noises  # with the detection and OpenCV, 50 ms

            noise = camera_noises(run, reader)
            moving = {name: own.motion.mean_variance_px2 for name, own in noise.items() if own.motion is not None}
            if moving:  # the rig is that of cameras in their mean attitudes
                more = {f"cameras.{name}.{at}": variance for name, variance in moving.items() for at in ("cx", "cy")}
                run = replace(run, covariance=with_variances(run.covariance, more))
        return Pipeline(run, reader, tracker_of(run), noise)

    @property
    def model(self) -> SpotModel:
        """The views of the run."""
        return SpotModel.of(self.run.rig)

    def again(self, run: Run, reader: Frames, keep: FoundPoints | None = None) -> Pipeline:
        """A further pass over the same recording, with a new tracker and the clocks of `run`."""
        return replace(self, run=run, reader=reader, tracker=tracker_of(run), found=keep)

    @property
    def notes(self) -> list[str]:
        """Notes on the pictures for the user of the results; complete once the iteration has ended."""
        return self.reader.notes + [note for noise in self.noise.values() for note in noise.notes]

    def records(self) -> Iterator[FrameRecord]:
        """One record per frame number, from the first to the last."""
        previous_s: float | None = None
        clock = time.perf_counter()
        for frames in self.reader:
            clock = self._spent("waiting", clock)
            t_s = float(self.run.times.t_s(frames.frame)) if frames.moment is None else frames.moment.t_s
            found, missing = self._detect(frames)
            clock = self._spent("detection", clock)
            dt_s = 0.0 if previous_s is None else t_s - previous_s
            tracked = self.tracker.step(dt_s, found)
            previous_s = t_s
            self._spent("tracking", clock)
            record = FrameRecord(frames.frame, t_s, dt_s, found, missing, tracked, frames.moment)
            if self.on_record is not None:
                self.on_record(record)
            yield record
            clock = time.perf_counter()

    def detections(self) -> Iterator[tuple[int, tuple[Detections | None, ...]]]:
        """Frame numbers and the points found in each, without tracking. Not to be used together with `records`."""
        for frames in self.reader:
            yield frames.frame, self._detect(frames)[0]

    def spots_in(self, camera: str, picture: GreyPicture) -> Detections:
        """The points in one picture of a camera. Not thread-safe for the same camera."""
        noise = self.noise[camera]
        points = noise.detect(picture, self.run.tracker.detect)
        top = noise.saturation_dn(picture, self.run.tracker.detect)
        return on_beam_axes(points, self._offsets_of(camera), noise.model, top)

    def _offsets_of(self, camera: str) -> CentroidOffsets:
        if camera not in self._offsets:
            seen_by = self.run.rig.cameras[camera]
            self._offsets[camera] = CentroidOffsets(seen_by, self.run.rig.screens[seen_by.screen])
        return self._offsets[camera]

    def _spent(self, on: str, since: float) -> float:
        now = time.perf_counter()
        setattr(self.timings, on, getattr(self.timings, on) + now - since)
        return now

    def _detect(self, frames: FrameSet) -> tuple[tuple[Detections | None, ...], tuple[str, ...]]:
        found: list[Detections | None] = []
        missing: list[str] = []
        for name in self.run.rig.cameras:
            picture = frames.images[name]
            if self.moved is not None and name == self.moved[0] and frames.frame >= self.moved[1]:
                picture = MissingPicture(LEFT_OUT)
            if isinstance(picture, np.ndarray):
                picture = self.spots_in(name, picture)
            if self.found is not None and frames.moment is not None and name in frames.moment.pictures:
                self.found.add(name, frames.moment.pictures[name].number, picture)
            if isinstance(picture, MissingPicture):
                found.append(None)
                missing.append(picture.reason)
                continue
            found.append(picture if frames.moment is None else self._timed(name, picture, frames.moment))
            missing.append("")
        return tuple(found), tuple(missing)

    def _timed(self, camera: str, points: Detections, moment: Moment) -> Detections:
        """The points of a camera's picture with the time between the moment and their exposure."""
        delay_s = moment.pictures[camera].t_s - moment.t_s
        clock = self.run.clocks.get(camera)
        row_time_s, sigmas = 0.0, (0.0, 0.0, 0.0)
        if clock is not None:
            stamp_s = clock.stamp_sigma_s(moment.pictures[camera].number)
            if stamp_s:
                stamp_s *= float(np.sqrt(sum(name == camera for name, _ in self.model.views)))
            row_time_s, sigmas = clock.row_time_s, (clock.offset_sigma_s, clock.row_time_sigma_s, stamp_s)
        if abs(delay_s) < NEGLIGIBLE_S and row_time_s == 0.0 and not any(sigmas):
            return points
        middle = (self.run.rig.cameras[camera].image_size_px[1] - 1) / 2
        return replace(points, clock=PictureClock(delay_s, row_time_s, middle, *sigmas))


# From processed moments to the rows of the tables, for runs whose cameras have clocks of their own.
#
# A row has the pose of its frame's instant. Its spots are those of the row's pictures, each at its own instant: of a
# camera without times of its own, picture n belongs to row n, however late it is; of the others, the picture nearest to
# the row's instant.


def row_records(
    pairs: Iterable[Pair], moments: Sequence[Moment], cameras: Sequence[str], own_times: Sequence[bool], camera_of: Ints
) -> Iterator[Pair]:
    """The rows of processed moments, in order.

    moments: complete when the first pair comes. cameras: names; own_times: whether each has times of its own;
    camera_of (n,): the camera of each view.
    """
    sources: list[list[int]] = []
    rows: list[int] = []
    kept: dict[int, Pair] = {}
    shown: list[ShownPicture] = []
    waiting: Pair | None = None
    following = 0
    for i, pair in enumerate(pairs):
        if not rows:
            sources = _sources(moments, cameras, own_times)
            rows = [k for k, moment in enumerate(moments) if moment.is_row]
        kept[i] = pair
        shown += _shown(pair[0], cameras)
        while following < len(rows) and max(rows[following], *sources[following]) <= i:
            if waiting is not None:
                yield waiting
            waiting = _row(kept, rows[following], sources[following], camera_of, tuple(shown))
            shown = []
            following += 1
            least = min((min(rows[r], *sources[r]) for r in range(following, len(rows))), default=i + 1)
            kept = {k: value for k, value in kept.items() if k >= least}
    if waiting is not None:
        record, causal = waiting
        yield replace(record, pictures=(*(record.pictures or ()), *shown)), causal


def _sources(moments: Sequence[Moment], cameras: Sequence[str], own_times: Sequence[bool]) -> list[list[int]]:
    """For each row: the moment of each camera's picture; the row's own where it has none."""
    place = [{m.pictures[name].number: i for i, m in enumerate(moments) if name in m.pictures} for name in cameras]
    out = []
    for i, moment in enumerate(moments):
        if moment.is_row:
            of_row = zip(place, own_times, strict=True)
            out.append([i if own else numbers.get(moment.frame, i) for numbers, own in of_row])
    return out


def _shown(record: FrameRecord, cameras: Sequence[str]) -> list[ShownPicture]:
    """The pictures of a moment with detections."""
    assert record.moment is not None
    pictures = record.moment.pictures
    return [
        ShownPicture(pictures[name].number, pictures[name].t_s, camera, found)
        for camera, (name, found) in enumerate(zip(cameras, record.detections, strict=True))
        if name in pictures and found is not None
    ]


def _row(
    kept: dict[int, Pair], at: int, sources: Sequence[int], camera_of: Ints, shown: tuple[ShownPicture, ...]
) -> Pair:
    record = _combined(kept[at][0], [kept[i][0] for i in sources], camera_of)
    before = kept[at][1]
    causal = None
    if before is not None:
        causal = _combined(before, [c for i in sources if (c := kept[i][1]) is not None], camera_of)
    return replace(record, pictures=shown), causal


def _combined(own: FrameRecord, of_cameras: Sequence[FrameRecord], camera_of: Ints) -> FrameRecord:
    """A row's record: the pose of its own moment, and each camera's spots of the moment of its picture."""
    if all(other is own for other in of_cameras):
        return own
    cameras = range(len(of_cameras))
    tracked = [of_cameras[c].tracked for c in camera_of]

    def by_view(name: str) -> Array:
        return np.stack([getattr(t, name)[v] for v, t in enumerate(tracked)])

    def by_view_where_known(name: str) -> Array | None:
        return None if any(getattr(t, name) is None for t in tracked) else by_view(name)

    changes: dict[str, Any] = {name: by_view(name) for name in ("uv_px", "cov_px2", "predicted_px", "gain", "point")}
    changes |= {name: by_view_where_known(name) for name in ("label_probability", "used_in_pose", "predicted_cov_px2")}
    joined: TrackedFrame = replace(
        own.tracked,
        status=tuple(t.status[v] for v, t in enumerate(tracked)),
        events=tuple(
            [e for e in own.tracked.events if e.view is None]
            + [e for v, t in enumerate(tracked) for e in t.events if e.view == v]
        ),
        **changes,
    )
    return replace(
        own,
        detections=tuple(of_cameras[c].detections[c] for c in cameras),
        missing=tuple(of_cameras[c].missing[c] for c in cameras),
        tracked=joined,
    )
