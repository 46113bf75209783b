"""A tracked run as the smoother's input: detections and causal labels of all frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.forward_model import SpotModel
from geometry.rig import Rig
from geometry.uncertainty.rig_uncertainty import RigCovariance, RigUncertainty
from tracking.detections import AT_THE_FRAME, UNMATCHED, Detections, PictureClock
from tracking.parameters import TrackerParameters
from tracking.rigid_body.association.frame_detections import BLENDED
from tracking.smoothing.motion.run_detections import Delays, RunDetections
from tracking.statuses import PoseStatus, SpotStatus
from tracking.tracked_frame import TrackedFrame

_FIRST_VALUES = 1024  # that a column has room for at the start


def assigned_in_one_list(tracked: TrackedFrame, start: Ints) -> Ints:
    """A frame's labels as an assignment (n,): rows in the list of all cameras' detections, plus BLENDED; -1 without.

    start (n,): where the rows of each view's camera begin.
    """
    assigned = np.where(tracked.point == UNMATCHED, -1, tracked.point + start)
    if tracked.used_in_pose is not None:
        assigned += np.where((assigned >= 0) & ~tracked.used_in_pose, BLENDED, 0)
    return assigned


class _Column:
    """Values that are appended; the storage doubles when it is full."""

    def __init__(self, shape: tuple[int, ...] = (), dtype: type = float) -> None:
        """shape: of one value."""
        self._storage: np.ndarray = np.empty((_FIRST_VALUES, *shape), dtype)
        self._count = 0

    def append(self, value: object) -> None:
        """Add one value."""
        self._more(1)[0] = value

    def extend(self, values: np.ndarray) -> None:
        """Add the values (m, ...)."""
        self._more(len(values))[:] = values

    def _more(self, count: int) -> np.ndarray:
        begin, self._count = self._count, self._count + count
        if self._count > len(self._storage):
            larger = np.empty((2 * self._count, *self._storage.shape[1:]), self._storage.dtype)
            larger[:begin] = self._storage[:begin]
            self._storage = larger
        return self._storage[begin : self._count]

    @property
    def values(self) -> np.ndarray:
        """(m, ...): all values so far; not a copy."""
        return self._storage[: self._count]


class TrackedRecording:
    """Collects each frame and the causal tracker's answer; keeps about 1 kB per frame. T frames, n views."""

    def __init__(
        self,
        rig: Rig,
        parameters: TrackerParameters,
        covariance: RigCovariance | None = None,
        exposure_s: float = 0.0,
    ) -> None:
        """covariance: of the rig's calibration, if known. exposure_s: of each picture; 0: an instant."""
        self.rig = rig
        self.model = SpotModel.of(rig)
        self.parameters = parameters
        self.calibration = None if covariance is None else RigUncertainty(rig, self.model, covariance)
        self.exposure_s = exposure_s
        cameras = len(self.model.camera_names)
        self._dt, self._jumped, self._measured = _Column(), _Column(dtype=bool), _Column(dtype=bool)
        self._pose, self._assigned = _Column((4, 3)), _Column((len(self.model),), np.int64)
        self._uv, self._cov, self._size, self._place = _Column((2,)), _Column((2, 2)), _Column(), _Column()
        self._first, self._has_image = _Column((cameras + 1,), np.int64), _Column((cameras,), bool)
        self._clock = _Column((cameras, 3))  # of the pictures, as PictureClock.numbers
        self._begin = _Column(dtype=np.int64)  # (T + 1,) where the detections of each frame begin
        self._begin.append(0)

    def __len__(self) -> int:
        return len(self.dt_s)

    def append(self, dt_s: float, found: Sequence[Detections | None], tracked: TrackedFrame) -> None:
        """Add a frame; dt_s: time since the one before (0 for the first)."""
        first = np.zeros(len(found) + 1, dtype=np.int64)
        np.cumsum([0 if f is None else len(f) for f in found], out=first[1:])
        for f in found:
            if f is not None and len(f):
                self._uv.extend(f.uv_px)
                self._cov.extend(f.cov_px2)
                self._size.extend(f.major_px)
                self._place.extend(np.zeros(len(f)) if f.place_px2 is None else f.place_px2)
        self._begin.append(self._begin.values[-1] + first[-1])
        self._first.append(first)
        self._has_image.append([f is not None for f in found])
        self._clock.append([AT_THE_FRAME if f is None or f.clock is None else f.clock.numbers for f in found])
        self._dt.append(dt_s)
        self._assigned.append(assigned_in_one_list(tracked, first[self.model.camera_of]))
        self._jumped.append(SpotStatus.TURNED in tracked.status)
        self._measured.append(tracked.pose_status is PoseStatus.MEASURED)
        pose = np.full((4, 3), np.nan)
        if tracked.pose is not None:
            pose[:3], pose[3] = tracked.pose.rotation, tracked.pose.translation
        self._pose.append(pose)

    @property
    def dt_s(self) -> Array:
        """(T,) time since the frame before."""
        return self._dt.values

    @property
    def poses(self) -> Array:
        """(T, 4, 3): rotation and, below it, translation of the causal poses; nan where lost."""
        return self._pose.values

    @property
    def measured(self) -> Bools:
        """(T,): frames whose pose was measured."""
        return self._measured.values

    @property
    def jumped(self) -> Bools:
        """(T,): frames in which the tracker found that the velocities had jumped in the step before."""
        return self._jumped.values

    @property
    def assigned(self) -> Ints:
        """(T, n): row in the list of all cameras' detections of the frame, plus BLENDED; -1 without."""
        return self._assigned.values

    def found_backward(self, k: int) -> list[Detections | None]:
        """Frame k's detections by camera as the input of a tracker that runs backward in time; without brightness.

        None without a picture.
        """
        begin, first = int(self._begin.values[k]), self.first(k)
        out: list[Detections | None] = []
        for c, there in enumerate(self._has_image.values[k]):
            rows = slice(begin + int(first[c]), begin + int(first[c + 1]))
            points = Detections.at(self._uv.values[rows], self._cov.values[rows])
            size = self._size.values[rows]
            clock = PictureClock(*self._clock.values[k, c])
            timed = None if clock.numbers == AT_THE_FRAME else clock.reversed()
            out.append(replace(points, major_px=size, minor_px=size, clock=timed) if there else None)
        return out

    def first(self, k: int) -> Ints:
        """(cameras + 1,): where the rows of each camera begin in the list of all cameras' detections of frame k."""
        return np.asarray(self._first.values[k])

    def place_px2(self) -> Array:
        """(m,): of the variance of a coordinate of each detection of the run, the part that belongs to its place."""
        return self._place.values

    def delays(self) -> Delays | None:
        """When the detections of the run were exposed; None: all at the instants of their frames."""
        clocks = self._clock.values
        if not clocks[..., :2].any():
            return None
        per_picture = np.diff(self._first.values, axis=1)  # (T, cameras) detections
        delay, row_time, middle = (np.repeat(clocks[..., i].ravel(), per_picture.ravel()) for i in range(3))
        return Delays(delay + (self._uv.values[:, 1] - middle) * row_time, row_time, np.ascontiguousarray(clocks))

    def run_detections(self) -> RunDetections:
        """All detections of the run; their arrays are the recording's own."""
        size = self._size.values
        return RunDetections(
            uv=self._uv.values,
            cov=self._cov.values,
            blend_px=np.where(np.isnan(size), 0.0, self.parameters.blend_px),
            begin=self._begin.values,
            first=self._first.values,
            has_image=self._has_image.values,
            log_static=np.full(len(size), -np.inf),
            size_px=size,
            usual_size_px=np.full(len(self.model), np.nan),
        )
