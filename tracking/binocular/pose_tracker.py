"""The pose of a target over a stereo recording, and its prediction."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geometry.arrays import Array, Ints, symmetric
from geometry.camera import in_picture
from geometry.pose import Pose
from geometry.pose_solver.gauss_newton import PoseFit, SolveLimits
from geometry.uncertainty.chi_square import chi2_tail
from tracking.binocular.acquisition import (
    Images,
    LabelledPose,
    acquire,
    distinct,
    explains_a_picture,
    labelled_pose,
    mirrored,
    observations,
)
from tracking.binocular.histories import FIRST_RATE_RAD_S, FIRST_SPEED_M_S, Histories
from tracking.binocular.joint_fit import MarkerObservations
from tracking.binocular.marker_model import MarkerImages, MarkerModel, MatchParameters, StereoPair, project_markers
from tracking.kalman import RigidMotion
from tracking.statuses import LOST_SIGMA_M, LOST_SIGMA_RAD, PoseStatus

# The pose of the target in each frame of a sequence; the previous frames help to label, not to measure.
#
# A measured pose rests on the images of its own frame alone: poses of different frames have independent noise. The
# motion gives the search regions, excludes one of two attitudes of a distant flat target, and bridges frames without a
# measurement. Source: ours.


_KNOWN = SolveLimits(LOST_SIGMA_M, LOST_SIGMA_RAD)  # poses that are not lost
_MOST_PRIOR_NATS = 20.0  # a target that jumps is found: the motion never outweighs two images
_TRUSTED_P, _TRUSTED_SHARE = 1e-3, 0.75  # misfit and share of explained images without a search from scratch

# A camera with this many candidates must confirm this share of the markers that the pose puts into its picture.
_ENOUGH_CANDIDATES, _LEAST_CONFIRMED = 3, 0.3

NO_PICTURES = "no picture of either camera"
TOO_FEW = "fewer than three markers found"
NO_POSE = "no pose explains the candidates"
AMBIGUOUS = "several poses explain the markers"
MISFIT = "the markers do not fit together: calibration, synchronisation or marker model"
CONTRADICTED = "the two pictures contradict each other: calibration, exchanged cameras or synchronisation"
WEAK = "the markers found do not determine the pose"


@dataclass(frozen=True, slots=True)
class BinocularFrame:
    """The result of one frame."""

    status: PoseStatus
    reason: str  # why it is not measured; empty if it is
    pose: Pose | None  # world_from_body
    covariance: Array | None  # (6, 6)
    fit: PoseFit | None  # of the images of this frame, also where it is no measurement
    observed: MarkerObservations | None  # the images of that fit
    index: Ints  # (2, K) candidates of the markers, -1: none
    predicted_px: Array  # (2, K, 2), before the pictures were used; nan without a prediction

    @property
    def markers(self) -> int:
        """Number of different markers that the pose rests on."""
        return int((self.index >= 0).any(axis=0).sum())


class BinocularTracker:
    """Labels and poses, frame by frame."""

    def __init__(self, pair: StereoPair, model: MarkerModel, parameters: MatchParameters) -> None:
        self._pair, self._model, self._p = pair, model, parameters
        self._motion: RigidMotion | None = None  # at the last measured pose, at time ...
        self._t_s = 0.0
        self._images: Images = (MarkerImages.none(), MarkerImages.none())  # of the current frame
        self._last_measured: int = -1
        self._histories = Histories(self._predicted)
        self._count = -1

    def step(self, t_s: float, pictures: tuple[MarkerImages | None, MarkerImages | None]) -> BinocularFrame:
        """The next frame; None for a camera without a picture."""
        self._count += 1
        ahead = self._prediction(t_s)
        images = (pictures[0] or MarkerImages.none(), pictures[1] or MarkerImages.none())
        if pictures[0] is None and pictures[1] is None:
            return self._unmeasured(NO_PICTURES, ahead)
        if max(len(found) for found in images) < self._p.min_markers:
            return self._unmeasured(TOO_FEW, ahead)
        self._images = images
        candidates = self._candidates(images, ahead)
        if ahead is None:
            candidates = self._histories.added_to(t_s, images, candidates)
        if not candidates:
            return self._unmeasured(NO_POSE, ahead)
        scores = [c.score + self._prior_nats(c, ahead) for c in candidates]
        order = np.argsort(scores)[::-1]
        best = candidates[order[0]]
        rivals = [candidates[i] for i in order[1:] if scores[i] > scores[order[0]] - self._p.lead_nats]
        reason = self._doubt(best, rivals)
        if reason == AMBIGUOUS:
            weights = np.exp(np.array([scores[i] for i in order[: 1 + len(rivals)]]) - scores[order[0]])
            return self._both(best, rivals, weights, ahead)
        if reason:
            return self._unmeasured(reason, ahead, best)
        self._last_measured = self._count
        self._histories.clear()
        pose, covariance = best.fit.world_from_body, best.fit.covariance
        first = RigidMotion.at_rest(pose, covariance, FIRST_SPEED_M_S, FIRST_RATE_RAD_S)
        self._motion = first if ahead is None else ahead.updated_with_pose(pose, covariance)[0]
        self._t_s = t_s
        return self._result(PoseStatus.MEASURED, "", pose, covariance, best, ahead)

    def _prediction(self, t_s: float) -> RigidMotion | None:
        if self._motion is None or self._count - self._last_measured > self._p.max_predicted_frames:
            return None
        return self._predicted(self._motion, t_s - self._t_s)

    def _predicted(self, motion: RigidMotion, dt_s: float) -> RigidMotion | None:
        """The motion after a time; None where it is too uncertain."""
        ahead = motion.predicted(dt_s, self._p.acceleration_m_s2, self._p.turn_rad_s2)
        return ahead if _KNOWN.hold(ahead.covariance) else None

    def _candidates(self, images: Images, ahead: RigidMotion | None) -> list[LabelledPose]:
        """Poses that explain the images: near the prediction, and from scratch where that is not convincing."""
        found: list[LabelledPose] = []
        if ahead is not None:
            near = labelled_pose(self._pair, self._model, images, ahead.world_from_body, ahead.covariance, self._p)
            found = [] if near is None else [near]
        if not found or not self._convincing(found[0], images):
            found += acquire(self._pair, self._model, images, self._p)
        for candidate in found[:2]:
            start = mirrored(self._pair, self._model, candidate.fit.world_from_body)
            other = labelled_pose(self._pair, self._model, images, start, candidate.fit.covariance, self._p)
            found = found if other is None else [*found, other]
        return distinct(found)

    def _convincing(self, found: LabelledPose, images: Images) -> bool:
        explained = int((found.index >= 0).sum())
        expected = sum(min(len(self._model), len(own)) for own in images)
        return chi2_tail(found.fit.chi2, max(found.fit.dof, 1)) > _TRUSTED_P and explained >= _TRUSTED_SHARE * expected

    def _prior_nats(self, candidate: LabelledPose, ahead: RigidMotion | None) -> float:
        """Log density of a candidate under the prediction, up to a constant and limited."""
        if ahead is None:
            return 0.0
        apart = candidate.fit.world_from_body.minus(ahead.world_from_body)
        d2 = float(apart @ np.linalg.solve(ahead.covariance + candidate.fit.covariance, apart))
        return -min(0.5 * d2, _MOST_PRIOR_NATS)

    def _doubt(self, best: LabelledPose, rivals: list[LabelledPose]) -> str:
        """Why the best pose is not a measurement; empty if it is one."""
        if best.markers < self._p.min_markers:
            return TOO_FEW
        if best.fit.dof < 2:
            return WEAK
        if chi2_tail(best.fit.chi2, best.fit.dof) < self._p.max_pose_chi2_p:
            return MISFIT
        if best.evidence < self._p.lead_nats:
            return NO_POSE
        if self._contradicted(best) or self._shows_another(best):
            return CONTRADICTED
        if not _KNOWN.hold(best.fit.covariance):
            return WEAK
        return AMBIGUOUS if rivals else ""

    def _contradicted(self, best: LabelledPose) -> bool:
        """Whether a camera sees candidates, but hardly one where the pose puts markers: cameras exchanged, or moved."""
        pixels = project_markers(self._pair, self._model, best.fit.world_from_body)[0]
        for c, (camera, found) in enumerate(zip(self._pair.cameras, self._images, strict=True)):
            expected = int(in_picture(pixels[c], np.array(camera.image_size_px)).sum())
            confirmed = int((best.index[c] >= 0).sum())
            if len(found) >= _ENOUGH_CANDIDATES and confirmed < min(_LEAST_CONFIRMED * expected, expected - 1):
                return True
        return False

    def _shows_another(self, best: LabelledPose) -> bool:
        """Whether a picture by itself shows nearly all its candidates as one target, and the best pose explains fewer.

        Where the calibration is wrong the right pose misfits, and some triple of the markers fits another one.
        """
        if self._convincing(best, self._images):
            return False
        for c in (0, 1):
            own = (self._images[0], MarkerImages.none()) if c == 0 else (MarkerImages.none(), self._images[1])
            for found in acquire(self._pair, self._model, own, self._p)[:1]:
                more = (found.index[c] >= 0).sum() > (best.index[c] >= 0).sum()
                if more and explains_a_picture(found, self._model, own):
                    return True
        return False

    def _both(
        self, best: LabelledPose, rivals: list[LabelledPose], weights: Array, ahead: RigidMotion | None
    ) -> BinocularFrame:
        """The best of several poses with a covariance that covers all of them."""
        w = weights / weights.sum()
        pose = best.fit.world_from_body
        covariance = np.zeros((6, 6))
        for weight, one in zip(w, [best, *rivals], strict=True):
            apart = one.fit.world_from_body.minus(pose)
            covariance += weight * (one.fit.covariance + np.outer(apart, apart))
        if np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1]) > LOST_SIGMA_M:
            return self._unmeasured(AMBIGUOUS, ahead, best)
        return self._result(PoseStatus.PREDICTED, AMBIGUOUS, pose, symmetric(covariance), best, ahead)

    def _unmeasured(self, reason: str, ahead: RigidMotion | None, found: LabelledPose | None = None) -> BinocularFrame:
        if ahead is None:
            return self._result(PoseStatus.LOST, reason, None, None, found, ahead)
        return self._result(PoseStatus.PREDICTED, reason, ahead.world_from_body, ahead.covariance, found, ahead)

    def _result(
        self,
        status: PoseStatus,
        reason: str,
        pose: Pose | None,
        covariance: Array | None,
        found: LabelledPose | None,
        ahead: RigidMotion | None,
    ) -> BinocularFrame:
        count = len(self._model)
        pixels = np.full((2, count, 2), np.nan)
        if ahead is not None:
            pixels, _ = project_markers(self._pair, self._model, ahead.world_from_body)
        used = found is not None and (status is PoseStatus.MEASURED or reason == AMBIGUOUS)
        index = found.index if found is not None and used else np.full((2, count), -1, dtype=np.int64)
        fit = None if found is None else found.fit
        observed = None if found is None else observations(self._images, found.index)
        return BinocularFrame(status, reason, pose, covariance, fit, observed, index, pixels)
