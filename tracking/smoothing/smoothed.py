"""The motion and labels of a run given all of its frames, and the answer for each frame from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.compiled_projection import project_with_covariances
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from tracking.detections import UNMATCHED, Detections
from tracking.parameters import TrackerParameters
from tracking.rigid_body.association.frame_detections import BLENDED
from tracking.smoothing.error_scale import ErrorScale
from tracking.smoothing.motion.run_detections import RunDetections
from tracking.smoothing.recording import FoundClocks
from tracking.statuses import Event, MotionEstimate, PoseStatus, SpotStatus, TrackedFrame, view_statuses

_BLOCK = 4096  # frames whose measured spots are in memory twice


@dataclass(frozen=True, slots=True)
class ReportedSpots:
    """All views' spots in T frames: measured where they have a label, elsewhere as the pose gives them."""

    uv_px: Array  # (T, n, 2) at mid-exposure of the picture; nan where the pose does not project the spot
    cov_px2: Array  # (T, n, 2, 2)
    exists: Bools  # (T, n): the pose projects the spot
    inside: Bools  # (T, n): the spot is in the picture

    @staticmethod
    def of(
        model: SpotModel, parameters: TrackerParameters, poses: Pose, covariance: Array, calibration_cov: Array,
        measured: tuple[RunDetections, Array], labels: tuple[Ints, ErrorScale], exposure: tuple[Array, Array],
        shift_px: Array | None = None,
    ) -> ReportedSpots:  # fmt: skip
        """The spots of T frames from their poses, with covariances (T, 6, 6), and the labelled detections.

        calibration_cov (n, 2, 2), px^2: covariance of the expected pixels due to calibration errors. measured: the
        detections as stated, and the part (m,), px^2, of their variances that belongs to the place. labels: (T, n), as
        `Smoothed.assigned`, and the corrections of the stated covariances. exposure: mean pixel (T, n, 2) of a spot
        over the exposure less that at its middle, and the sigma (T, 6), m and rad, of the unknown part of the pose's.
        shift_px: as `Smoothed.shift_px`.
        """
        (detections, place_px2), (assigned, errors), (exposure_px, exposure_sigma) = measured, labels, exposure
        R, t, views = poses.rotation, poses.translation, model.numbers
        uv_px, cov_px2 = project_with_covariances(views, R, t, covariance)
        cov_px2 += calibration_cov
        if shift_px is not None:
            uv_px += shift_px
        exists = ~np.isnan(uv_px[..., 0])
        of_exposure = np.zeros((0, *cov_px2.shape[1:]))
        if exposure_sigma.any():
            _, of_exposure = project_with_covariances(views, R, t, exposure_sigma[:, :, None] ** 2 * np.eye(6))
        for start in range(0, len(assigned), _BLOCK):
            k, view = np.nonzero(assigned[start : start + _BLOCK] >= 0)
            k += start
            chosen = assigned[k, view]
            rows = detections.begin[k] + chosen % BLENDED
            uv_px[k, view] = detections.uv[rows] - exposure_px[k, view]
            blended = np.where(chosen >= BLENDED, parameters.blend_px / 2, 0.0)
            more = blended**2 + parameters.sigma_model_px**2
            cov_px2[k, view] = more[:, None, None] * np.eye(2) + errors.covariance(
                detections.cov[rows], detections.size_px[rows], place_px2[rows], model.camera_of[view]
            )
            if len(of_exposure):
                cov_px2[k, view] += of_exposure[k, view]
        return ReportedSpots(uv_px, cov_px2, exists, model.in_picture(uv_px))


@dataclass(frozen=True, slots=True)
class Smoothed:
    """A run's motion and labels given all of its frames: T frames, n views."""

    model: SpotModel
    parameters: TrackerParameters
    poses: Pose  # (T,) at mid-exposure
    spots: ReportedSpots
    velocities: Array  # (T, 6): m/s in world, rad/s in body
    covariance: Array  # (T, 6, 6) of the poses, from noise and from errors that belong to places
    place_share: float  # share of the spots' error variance that belongs to places (place_errors.py)
    rest_parts: Array  # (T, 28) as TrackedFrame.rest_parts
    systematic: Array  # (T or 1, 6, 6) the calibration's share, to be added
    motion_covariance: Array  # (T, 6, 6) of the velocities
    known: Bools  # (T,): the pose is not lost
    measured: Bools  # (T,): the pose is observable from this frame's spots alone
    assigned: Ints  # (T, n): row in the list of all cameras' detections of the frame, plus BLENDED; -1 without
    probability: Array  # (T, n) of the best label, given or left open; nan without one
    first: Ints  # (T, cameras + 1): where the rows of each camera begin
    rms_px: Array  # (T,) residuals of the frame's spots, per axis
    jerk: Array  # (2,) m/s^3 and rad/s^3 per sqrt(Hz), of translation and rotation
    iterations: int  # rounds of motion and labels
    relabelled: int  # labels that differ from the causal ones
    errors: ErrorScale  # corrections of the spots' stated covariances
    shift_px: Array | None = None  # (T, n, 2) as TrackedFrame.shift_px
    clocks: FoundClocks | None = None  # None: all clocks were known

    @property
    def frames(self) -> int:
        """Number of frames T."""
        return len(self.known)

    def frame(self, k: int, causal: TrackedFrame, found: Sequence[Detections | None]) -> TrackedFrame:
        """The causal tracker's answer for frame k with the smoothed labels, pose and motion.

        `predicted_px` and `gain` stay: they concern what was known before the frame. Events of the search stay; those
        about labels left open are replaced.
        """
        model = self.model
        known = bool(self.known[k])
        assigned = self.assigned[k]
        labelled = assigned >= 0
        pose = self.poses[k]
        systematic = self.systematic[min(k, len(self.systematic) - 1)]
        covariance = self.covariance[k] + systematic
        uv_px, cov_px2 = self.spots.uv_px[k].copy(), self.spots.cov_px2[k].copy()
        point = np.where(labelled, assigned % BLENDED - self.first[k][model.camera_of], UNMATCHED)
        turned = np.array([s is SpotStatus.TURNED for s in causal.status]) & (point == causal.point)
        has_image = np.array([f is not None for f in found])[model.camera_of]
        status = view_statuses(labelled, turned, self.spots.exists[k], self.spots.inside[k], has_image, known)
        nowhere = [s in (SpotStatus.LOST, SpotStatus.OFF_SCREEN) for s in status]
        uv_px[nowhere], cov_px2[nowhere] = np.nan, np.nan
        measured = bool(self.measured[k])
        if not known:
            pose_status = PoseStatus.LOST
        else:
            pose_status = PoseStatus.MEASURED if measured else PoseStatus.PREDICTED
        return replace(
            causal,
            uv_px=uv_px,
            cov_px2=cov_px2,
            status=status,
            point=point,
            pose_status=pose_status,
            pose=pose if known else None,
            pose_covariance=covariance if known else None,
            spots_used=int(np.count_nonzero(labelled & (assigned < BLENDED))) if measured else 0,
            rms_px=float(self.rms_px[k]) if measured else float("nan"),
            events=self._events(k, causal, point, known),
            label_probability=self._label_probability(k, causal, known),
            used_in_pose=labelled & (assigned < BLENDED) & known,
            motion=MotionEstimate(self.velocities[k, :3], self.velocities[k, 3:], self.motion_covariance[k])
            if known
            else None,
            pose_systematic=systematic if known else None,
            rest_parts=self.rest_parts[k] if known else None,
            shift_px=None if self.shift_px is None else self.shift_px[k],
        )

    def _label_probability(self, k: int, causal: TrackedFrame, known: bool) -> Array | None:
        """Probability (n,) of each label; nan without a label.

        The labels of `method: spots` stay as that tracker gave them, and so do its probabilities (None: it has none).
        """
        if self.parameters.method != "rigid":
            return causal.label_probability
        return self.probability[k] if known else np.where(self.assigned[k] >= 0, self.probability[k], np.nan)

    def _events(self, k: int, causal: TrackedFrame, point: Ints, known: bool) -> tuple[Event, ...]:
        events = [e for e in causal.events if e.kind != "undecided"]
        if known and self.parameters.method == "rigid":
            p = self.probability[k]
            events += [
                Event("undecided", f"label left open: its probability is {p[v]:.2f}", int(v))
                for v in np.flatnonzero((p < self.parameters.min_label_probability) & (point == UNMATCHED))
            ]
            events += [
                Event("changed", "later frames show that it was another point of light", int(v))
                for v in np.flatnonzero((point != causal.point) & (causal.point != UNMATCHED))
            ]
        return tuple(events)
