"""A tracked run as the smoother's input, and the tracker run backward in time through its uncertain frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from geometry.arrays import Array, Bools, Ints, true_ranges
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.pose_prior import PosePrior
from geometry.rig import Rig
from geometry.uncertainty.rig_uncertainty import RigCovariance, RigUncertainty
from tracking.detections import AT_THE_FRAME, UNMATCHED, Detections, PictureClock
from tracking.parameters import TrackerParameters
from tracking.rigid_body.acquisition import FIRST_ACCELERATION, FIRST_ANGULAR_ACCELERATION
from tracking.rigid_body.association.frame_detections import BLENDED, distinct_spots
from tracking.rigid_body.hypotheses.hypothesis_set import MIN_REDUNDANT_SPOTS
from tracking.rigid_body.models.motion import STATE
from tracking.rigid_body.rigid_tracker import RigidTracker
from tracking.smoothing.motion.run_detections import Delays, RunDetections, SmoothedMotion, UnknownClocks
from tracking.statuses import PoseStatus, SpotStatus, TrackedFrame

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


@dataclass(frozen=True, slots=True)
class EstimatedClocks:
    """p numbers of the cameras' clocks that are estimated with the motion, as corrections of those used so far."""

    numbers: tuple[tuple[int, bool], ...]  # camera, and whether it is its row time, else its offset
    mean_s: Array  # (p,) of the prior
    sigma_s: Array  # (p,)

    def largest_offset_s(self, sigma_s: Array) -> float:
        """The largest of the sigmas (p,) that are of offsets; 0 without."""
        own = zip(sigma_s.tolist(), self.numbers, strict=True)
        return max((sigma for sigma, (_, is_row_time) in own if not is_row_time), default=0.0)

    def offset_sigma_s(self, covariance: Array) -> float:
        """Of the sum of all offsets with this covariance (p, p) of the numbers."""
        return float(np.sqrt(sum(covariance[i, i] for i, (_, row_time) in enumerate(self.numbers) if not row_time)))


@dataclass(frozen=True, slots=True)
class FoundClocks:
    """Corrections of p numbers of the cameras' clocks."""

    correction_s: Array  # (p,)
    covariance: Array  # (p, p)


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
        self.clocks: EstimatedClocks | None = None  # None: all are known
        cameras = len(self.model.camera_names)
        self._dt, self._jumped, self._measured = _Column(), _Column(dtype=bool), _Column(dtype=bool)
        self._pose, self._assigned = _Column((4, 3)), _Column((len(self.model),), np.int64)
        self._uv, self._cov, self._size, self._place = _Column((2,)), _Column((2, 2)), _Column(), _Column()
        self._first, self._has_image = _Column((cameras + 1,), np.int64), _Column((cameras,), bool)
        self._clock = _Column((cameras, 3))  # of the pictures, as PictureClock.numbers
        self._stamp = _Column((cameras,))  # and as PictureClock.stamp_sigma_s
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
        self._stamp.append([0.0 if f is None or f.clock is None else f.clock.stamp_sigma_s for f in found])
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
            delay_s, row_time_s, middle_row = self._clock.values[k, c]
            clock = PictureClock(delay_s, row_time_s, middle_row, stamp_sigma_s=float(self._stamp.values[k, c]))
            timed = None if clock.numbers == AT_THE_FRAME and not clock.stamp_sigma_s else clock.reversed()
            out.append(replace(points, major_px=size, minor_px=size, clock=timed) if there else None)
        return out

    def first(self, k: int) -> Ints:
        """(cameras + 1,): where the rows of each camera begin in the list of all cameras' detections of frame k."""
        return np.asarray(self._first.values[k])

    def place_px2(self) -> Array:
        """(m,): of the variance of a coordinate of each detection of the run, the part that belongs to its place."""
        return self._place.values

    def unknown_clocks(self, corrections_s: Array, unsettled: bool, far_s: float) -> UnknownClocks | None:
        """The clocks that are estimated with the motion, after these corrections (p,). unsettled: all keep priors.

        far_s: a sigma of the present offsets.
        """
        clocks, model = self.clocks, self.model
        if clocks is None:
            return None
        camera, is_row_time = zip(*clocks.numbers, strict=True)
        return UnknownClocks(
            np.array(camera, dtype=np.int64), np.array(is_row_time, dtype=bool), clocks.mean_s - corrections_s,
            clocks.sigma_s, model.camera_of, (model.image_size_px[:, 1] - 1) / 2, unsettled, far_s, self.calibration,
        )  # fmt: skip

    def delays(self, corrections_s: Array | None = None) -> Delays | None:
        """When the detections of the run were exposed; None: all at the instants of their frames.

        corrections_s (p,): of the estimated clocks.
        """
        clocks = self._clock.values
        if self.clocks is None and not clocks[..., :2].any() and not self._stamp.values.any():
            return None
        if self.clocks is not None and corrections_s is not None:
            more = np.zeros((clocks.shape[1], 2))
            for (camera, is_row_time), correction in zip(self.clocks.numbers, corrections_s, strict=True):
                more[camera, int(is_row_time)] = correction
            clocks = clocks.copy()
            clocks[..., :2] += np.where(self._has_image.values[..., None], more, 0.0)
        per_picture = np.diff(self._first.values, axis=1).ravel()  # (T cameras,) detections
        delay, row_time, middle = (np.repeat(clocks[..., i].ravel(), per_picture) for i in range(3))
        after_s, sigma_s = delay + (self._uv.values[:, 1] - middle) * row_time, self._stamp.values.ravel()
        return Delays(after_s, row_time, np.repeat(sigma_s, per_picture), np.ascontiguousarray(clocks))

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
            size_px=size,
            usual_size_px=np.full(len(self.model), np.nan),
        )


# The rigid tracker run backward in time through frames that the causal tracker did not measure with certainty.
#
# After an occlusion the causal tracker may need some frames to find the vehicle again; backward in time these frames
# are ordinary tracking. Where a few spots allow two poses, the two directions agree only on the right one. Source:
# ours; forward and backward tracks as in two-filter smoothing.

MIN_FRAMES = 2  # a shorter stretch after the first frame is left to the smoother, which bounds it from both sides
DISAGREEMENT_CHI2 = 36.0  # of 6 degrees of freedom: poses of the two directions farther apart are different answers


class BackwardLabels:
    """Answers of the backward tracker for T frames with n views."""

    def __init__(self, frames: int, views: int) -> None:
        self.assigned = np.full((frames, views), -1, dtype=np.int64)  # as in TrackedRecording
        self.measured = np.zeros(frames, dtype=bool)
        self.R, self.t = np.full((frames, 3, 3), np.nan), np.full((frames, 3), np.nan)  # where measured
        self.disagrees = np.zeros(frames, dtype=bool)  # it has measured another pose than the forward tracker


def track_backward(rec: TrackedRecording, motion: SmoothedMotion, weak: Bools, sure: Bools) -> BackwardLabels:
    """Track each stretch of weak (T,) frames backward from the sure (T,) frame after it.

    motion: the present estimate, from which the tracks start.
    """
    out = BackwardLabels(len(rec), len(rec.model))
    for first, end in true_ranges(weak):
        if (end - first >= MIN_FRAMES or first == 0) and end < len(rec) and sure[end]:
            _track_stretch(rec, motion, first, end - 1, out)
    return out


def _track_stretch(rec: TrackedRecording, motion: SmoothedMotion, first: int, last: int, out: BackwardLabels) -> None:
    ref, start = motion.ref, last + 1
    pose = Pose(ref.R[start], ref.t[start])
    tracker = RigidTracker(rec.rig, rec.parameters, PosePrior(pose, 1.0, 0.5), None)
    P = np.diag(np.repeat([0.0, 0.0, 0.0, 0.0, FIRST_ACCELERATION, FIRST_ANGULAR_ACCELERATION], STATE // 6) ** 2)
    P[:6, :6], P[6:12, 6:12] = motion.pose_P[start], motion.motion_P[start]
    m = np.concatenate([-ref.m[start, :6], ref.m[start, 6:]])  # time reversed: velocities change sign
    tracker.begin_at(pose, m, P)
    dt = rec.dt_s
    poses, causal = rec.poses, rec.measured
    for k in range(last, first - 1, -1):
        tracked = tracker.step(float(dt[k + 1]), rec.found_backward(k))
        out.assigned[k] = assigned_in_one_list(tracked, rec.first(k)[rec.model.camera_of])
        out.measured[k] = tracked.pose_status is PoseStatus.MEASURED
        if out.measured[k] and tracked.pose is not None:
            out.R[k], out.t[k] = tracked.pose.rotation, tracked.pose.translation
        if causal[k] and tracked.pose is not None and tracked.pose_covariance is not None:
            d = tracked.pose.minus(Pose(poses[k, :3], poses[k, 3]))
            spread = tracked.pose_covariance + np.eye(6) * 1e-12
            out.disagrees[k] = bool(out.measured[k] and d @ np.linalg.solve(2 * spread, d) > DISAGREEMENT_CHI2)


def merged(causal: Ints, backward: BackwardLabels, weak: Bools, spot_of: Ints) -> Ints:
    """Labels (T, n): the backward tracker's for weak frames in which it measured the pose, else the causal ones.

    A single label more than the causal tracker gave may be a false point near an occluded spot, and so may one of
    three: these are not taken.
    """
    out = causal.copy()
    causal_count, count = (distinct_spots(labels >= 0, spot_of) for labels in (causal, backward.assigned))
    take = (
        weak & backward.measured & (count >= MIN_REDUNDANT_SPOTS) & ((count >= causal_count + 2) | (causal_count == 0))
    )
    out[take] = backward.assigned[take]
    return out
