"""Search of one frame for the whole vehicle: where it may be, and the labellings that explain the frame's points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from geometry.arrays import Array
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.pose_prior import PosePrior
from geometry.pose_solver.visibility import symmetries
from geometry.rig import Rig
from geometry.uncertainty.rig_uncertainty import RigUncertainty
from tracking.detections import Detections
from tracking.labelling.first_labels import NO_POINT, Labelling, candidate_labellings, find_labels
from tracking.parameters import TrackerParameters
from tracking.rigid_body.association.frame_detections import FrameDetections
from tracking.tracked_frame import Event

# Sigmas of the motion of a vehicle that has just been found.
FIRST_SPEED, FIRST_RATE = 4.0, 6.0  # m/s, rad/s
FIRST_ACCELERATION, FIRST_ANGULAR_ACCELERATION = 30.0, 100.0  # m/s^2, rad/s^2
# Sigmas of the motion between the pictures of one frame in a search by geometry alone: usual motions, since with the
# fastest ones no pose could be distinguished from another. px/s where the prior's centre shows no spot.
SEARCH_SPEED, SEARCH_RATE, SEARCH_PX_S = 1.0, 1.0, 1500.0  # m/s, rad/s
# Limits of the search around the last pose; beyond the second one a fan of beams looks like itself, turned.
MAX_DISTANCE_M, MAX_TURN_RAD = 1.5, np.deg2rad(60.0)
# Spots of two poses nearer than this are the same. A vehicle that is symmetric up to more than this can be measured.
SAME_SPOT_PX = 0.1
MAX_CANDIDATES = 4  # labellings of one search
STATIC_LOG_DENSITY = -4.0  # 1/px^2: points where static ones are denser are left out of most searches


class Acquisition:
    """Searches frames by geometry alone (tracking/labelling)."""

    def __init__(
        self,
        rig: Rig,
        model: SpotModel,
        parameters: TrackerParameters,
        prior: PosePrior,
        calibration: RigUncertainty | None,
    ) -> None:
        """prior: where the vehicle is in the first frame."""
        self._rig, self._model, self._parameters = rig, model, parameters
        self._prior, self._calibration = prior, calibration
        self._tie_reported = False

    def vehicle_found(self) -> None:
        """The vehicle has been measured; the next tie is reported again."""
        self._tie_reported = False

    def search_prior(
        self, last: Pose | None, age_s: float, fastest: Array, just_found: bool, doubted: bool = False
    ) -> PosePrior:
        """Region to search: around the last measured pose, as far as the vehicle may have moved since.

        Before there is one: the run's prior, widened likewise. age_s: time since the last measured pose, or since the
        first frame. fastest (2,): largest measured speeds, m/s and rad/s. just_found: these are hardly known yet.
        doubted: the last measured pose may be wrong.
        """
        p = self._parameters
        if last is not None and doubted:
            return PosePrior(last, max(MAX_DISTANCE_M, self._prior.within_m), max(MAX_TURN_RAD, self._prior.within_rad))
        if last is None:
            if age_s == 0.0 or self._prior.within_rad >= np.pi:
                return self._prior
            within_m = self._prior.within_m + min((FIRST_SPEED + p.reacquire_m_s) * age_s, MAX_DISTANCE_M)
            turned = self._prior.within_rad + (FIRST_RATE + np.deg2rad(p.reacquire_deg_s)) * age_s
            within_rad = min(turned, max(MAX_TURN_RAD, self._prior.within_rad))
            return PosePrior(self._prior.centre, within_m, within_rad)
        speed, rate = fastest + np.array([p.reacquire_m_s, np.deg2rad(p.reacquire_deg_s)])
        if just_found:
            speed, rate = max(speed, 3 * FIRST_SPEED), max(rate, 3 * FIRST_RATE)
        return PosePrior(
            last,
            min(0.05 + speed * age_s, max(MAX_DISTANCE_M, self._prior.within_m)),
            min(np.deg2rad(3.0) + rate * age_s, max(MAX_TURN_RAD, self._prior.within_rad)),
        )

    def is_ambiguous(self, pose: Pose, age_s: float) -> bool:
        """Whether the prior allows another pose of a symmetric vehicle, which shows the same spots.

        No observation decides between the two. The tracker's weights of the two may drift apart nevertheless, since it
        enumerates assignments and motions of each only in part. age_s: time since the first frame.
        """
        prior = self.search_prior(None, age_s, np.zeros(2), False)
        here = self._model.project(pose)[0]
        twins = [twin for turn in self._symmetries if prior.contains(twin := pose @ turn)]
        return any(self._same_spots(here, self._model.project(twin)[0]) for twin in twins)

    @cached_property
    def _symmetries(self) -> list[Pose]:
        return symmetries(self._model)

    def _same_spots(self, here: Array, there: Array) -> bool:
        """Whether each spot of one pose, (n, 2) px, has a spot of the other one at its place in the same picture."""
        camera = self._model.camera_of
        gap = np.linalg.norm(here[:, None] - there, axis=-1)
        nearest = np.where(camera[:, None] == camera, gap, np.inf)[np.isfinite(here).all(axis=1)].min(axis=1)
        return bool(nearest.max() < SAME_SPOT_PX)

    def labellings(
        self,
        frame: FrameDetections,
        found: Sequence[Detections | None],
        prior: PosePrior,
        first: bool,
        static_too: bool,
        events: list[Event],
    ) -> list[Labelling]:
        """Labellings of the frame that agree with a prior, best first; a tie is added to the events.

        first: the vehicle has not been measured before. static_too: use static points as well.
        """
        p, by_camera, rows = self._parameters, {}, []
        for c, (name, points) in enumerate(zip(self._model.camera_names, found, strict=True)):
            rows.append(np.zeros(0, dtype=np.int64))
            if points is None:
                continue
            static = frame.log_static[frame.first[c] : frame.first[c + 1]] > STATIC_LOG_DENSITY
            rows[c] = np.arange(len(points)) if static_too else np.flatnonzero(~static)
            some_points = points if len(rows[c]) == len(points) else points[rows[c]]
            by_camera[name] = self._widened(some_points, prior, c)
        if sum(len(points) for points in by_camera.values()) < p.labels.min_spots:
            return []
        some: list[Labelling] = []
        if first and not self._tie_reported:
            result = find_labels(self._rig, self._model, by_camera, prior, p.labels, self._calibration)
            if result.tie:
                events.append(Event("tie", result.in_words(self._model)))
                self._tie_reported = True
            some = [result.chosen] if result.chosen is not None else list(result.candidates)
        if not some:
            some = candidate_labellings(
                self._rig, self._model, by_camera, prior, p.labels, self._calibration, most=MAX_CANDIDATES
            )
        out: list[Labelling] = []
        for one in some:
            point = one.point_of.copy()
            for v in np.flatnonzero(point != NO_POINT):
                point[v] = rows[self._model.camera_of[v]][point[v]]
            out.append(replace(one, point_of=point))
        return out

    def _widened(self, points: Detections, prior: PosePrior, camera: int) -> Detections:
        """The points of a picture with covariances for the unknown motion of the vehicle until it was taken."""
        if points.clock is None or not len(points):
            return points
        J = self._model.project(prior.centre)[1][self._model.camera_of == camera]  # 0 without a projection
        sigmas = np.repeat([SEARCH_SPEED, SEARCH_RATE], 3)
        speed2 = 0.5 * np.sum((J * sigmas) ** 2, axis=(1, 2))
        px_s2 = float(np.median(speed2[speed2 > 0])) if np.any(speed2 > 0) else SEARCH_PX_S**2
        variance = points.clock.after_s(points.uv_px[:, 1]) ** 2 * px_s2
        return replace(points, cov_px2=points.cov_px2 + variance[:, None, None] * np.eye(2))
