"""A tracked run as the smoother's input: detections and causal labels of all frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.forward_model import SpotModel
from geometry.rig import Rig
from geometry.uncertainty.rig_parameters import RigCovariance
from geometry.uncertainty.rig_uncertainty import RigUncertainty
from tracking.detections import UNMATCHED, Detections
from tracking.parameters import TrackerParameters
from tracking.rigid_body.association.frame_detections import BLENDED
from tracking.smoothing.motion.run_detections import RunDetections
from tracking.statuses import PoseStatus, SpotStatus
from tracking.tracked_frame import TrackedFrame


def assigned_in_one_list(tracked: TrackedFrame, start: Ints) -> Ints:
    """A frame's labels as an assignment (n,): rows in the list of all cameras' detections, plus BLENDED; -1 without.

    start (n,): where the rows of each view's camera begin.
    """
    assigned = np.where(tracked.point == UNMATCHED, -1, tracked.point + start)
    if tracked.used_in_pose is not None:
        assigned += np.where((assigned >= 0) & ~tracked.used_in_pose, BLENDED, 0)
    return assigned


class TrackedRecording:
    """Collects each frame and the causal tracker's answer; keeps about 1 kB per frame."""

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
        self._dt: list[float] = []
        self._uv: list[Array] = []
        self._cov: list[Array] = []
        self._size: list[Array] = []
        self._place: list[Array] = []
        self._first: list[Ints] = []
        self._has_image: list[Bools] = []
        self._assigned: list[Ints] = []
        self._jumped: list[bool] = []
        self._measured: list[bool] = []
        self._pose: list[Array] = []

    def __len__(self) -> int:
        return len(self._dt)

    def append(self, dt_s: float, found: Sequence[Detections | None], tracked: TrackedFrame) -> None:
        """Add a frame; dt_s: time since the one before (0 for the first)."""
        counts = [0 if f is None else len(f) for f in found]
        first = np.zeros(len(found) + 1, dtype=np.int64)
        np.cumsum(counts, out=first[1:])
        some = [f for f in found if f is not None and len(f)]
        none2, none4 = np.zeros((0, 2)), np.zeros((0, 2, 2))
        self._dt.append(dt_s)
        self._uv.append(np.concatenate([f.uv_px for f in some]) if some else none2)
        self._cov.append(np.concatenate([f.cov_px2 for f in some]) if some else none4)
        self._size.append(np.concatenate([f.major_px for f in some]) if some else np.zeros(0))
        places = [np.zeros(len(f)) if f.place_px2 is None else f.place_px2 for f in some]
        self._place.append(np.concatenate(places) if places else np.zeros(0))
        self._first.append(first)
        self._has_image.append(np.array([f is not None for f in found]))
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
        return np.array(self._dt)

    @property
    def poses(self) -> Array:
        """(T, 4, 3): rotation and, below it, translation of the causal poses; nan where lost."""
        return np.array(self._pose).reshape(-1, 4, 3)

    @property
    def measured(self) -> Bools:
        """(T,): frames whose pose was measured."""
        return np.array(self._measured, dtype=bool)

    @property
    def jumped(self) -> Bools:
        """(T,): frames in which the tracker found that the velocities had jumped in the step before."""
        return np.array(self._jumped, dtype=bool)

    @property
    def assigned(self) -> Ints:
        """(T, n): row in the list of all cameras' detections of the frame, plus BLENDED; -1 without."""
        return np.array(self._assigned, dtype=np.int64).reshape(len(self), len(self.model))

    def found(self, k: int) -> list[Detections | None]:
        """Frame k's detections by camera as a tracker's input, None without a picture; without brightness."""
        uv, cov, size, first, has_image = self.detections(k)
        out: list[Detections | None] = []
        for c, there in enumerate(has_image):
            rows = slice(int(first[c]), int(first[c + 1]))
            points = Detections.at(uv[rows], cov[rows])
            out.append(replace(points, major_px=size[rows], minor_px=size[rows]) if there else None)
        return out

    def detections(self, k: int) -> tuple[Array, Array, Array, Ints, Bools]:
        """Frame k's m detections, sorted by camera.

        Pixels (m, 2), covariances (m, 2, 2), larger half axes (m,), px, nan where not known; where the rows of each
        camera begin (cameras + 1,); which cameras have a picture (cameras,).
        """
        return self._uv[k], self._cov[k], self._size[k], self._first[k], self._has_image[k]

    def place_px2(self) -> Array:
        """(m,): of the variance of a coordinate of each detection of the run, the part that belongs to its place."""
        return np.concatenate([np.zeros(0), *self._place])

    def run_detections(self) -> RunDetections:
        """All detections of the run."""
        frames = [self.detections(k) for k in range(len(self))]
        counts = [len(f[0]) for f in frames]
        cameras = len(self.model.camera_names)
        size = np.concatenate([np.zeros(0), *[f[2] for f in frames]])
        return RunDetections(
            uv=np.concatenate([np.zeros((0, 2)), *[f[0] for f in frames]]),
            cov=np.concatenate([np.zeros((0, 2, 2)), *[f[1] for f in frames]]),
            blend_px=np.where(np.isnan(size), 0.0, self.parameters.blend_px),
            begin=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
            first=np.array([f[3] for f in frames], dtype=np.int64).reshape(-1, cameras + 1),
            has_image=np.array([f[4] for f in frames], dtype=bool).reshape(-1, cameras),
            log_static=np.full(len(size), -np.inf),
            size_px=size,
            usual_size_px=np.full(len(self.model), np.nan),
        )
