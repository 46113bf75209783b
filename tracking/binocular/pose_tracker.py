"""The pose of a target over a stereo recording, its prediction, and whether both cameras expose together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from geometry.arrays import Array, Bools, Ints, symmetric
from geometry.camera import in_picture
from geometry.pose import Pose
from geometry.uncertainty.chi_square import chi2_tail
from tracking import kalman
from tracking.binocular.acquisition import acquire, distinct, mirrored
from tracking.binocular.joint_fit import JointFit, MarkerObservations
from tracking.binocular.labelling import Images, LabelledPose, labelled_pose, observations
from tracking.binocular.marker_model import MarkerImages, MarkerModel, StereoPair, project, project_markers
from tracking.binocular.parameters import MatchParameters
from tracking.statuses import LOST_SIGMA_M, LOST_SIGMA_RAD, PoseStatus

# Constant-velocity prediction of the target's pose: for matching, and for frames without a measurement. Ours.

FIRST_SPEED_M_S, FIRST_RATE_RAD_S = 5.0, 2.0  # 1 sigma of the unknown velocity after the first pose


@dataclass(frozen=True, slots=True)
class Motion:
    """A pose with its velocity: error [dt (m, world), dtheta (rad, body), dv (m/s), domega (rad/s, body)]."""

    t_s: float
    pose: Pose
    velocity: Array  # (6,): m/s in world, rad/s in body
    covariance: Array  # (12, 12)

    @staticmethod
    def at_rest(t_s: float, pose: Pose, covariance: Array) -> Motion:
        """The first measured pose, covariance (6, 6), of unknown velocity."""
        P = np.zeros((12, 12))
        P[:6, :6] = covariance
        P[6:, 6:] = np.diag([FIRST_SPEED_M_S**2] * 3 + [FIRST_RATE_RAD_S**2] * 3)
        return Motion(t_s, pose, np.zeros(6), P)

    def predicted(self, t_s: float, acceleration: float, turn: float) -> Motion:
        """At a later time, with accelerations of these sigmas, m/s^2 and rad/s^2, constant between two times."""
        dt = t_s - self.t_s
        Q = kalman.process_noise(np.repeat([acceleration, turn], 3), dt)
        pose = self.pose.plus(dt * self.velocity)
        _, P = kalman.propagate(np.zeros(12), self.covariance, kalman.transition(dt, 6), Q)
        return Motion(t_s, pose, self.velocity, P)

    def updated(self, pose: Pose, covariance: Array) -> Motion:
        """With a measured pose of covariance (6, 6)."""
        change, P = kalman.update(np.zeros(12), self.covariance, pose.minus(self.pose), covariance)
        return Motion(self.t_s, self.pose.plus(change[:6]), self.velocity + change[6:], P)

    @property
    def pose_covariance(self) -> Array:
        """(6, 6)."""
        return self.covariance[:6, :6]


# Whether the two cameras expose at the same time, from residuals that grow with the velocity in the picture.
#
# If the right picture is taken a time d after the left one, each of its images is shifted by d times its velocity.
# Part of the shift is absorbed by the pose; the rest (across the epipolar lines, and in the size of the target) is a
# residual. All frames together give d by least squares, beside a rotation of the right camera, which shifts all frames
# equally. Source: ours.


_FEWEST_FRAMES = 8
_UNKNOWNS = 4  # the time and three rotations of the right camera


@dataclass(frozen=True, slots=True)
class FittedFrame:
    """One frame with a fitted pose."""

    t_s: float
    fit: JointFit
    observed: MarkerObservations


@dataclass(frozen=True, slots=True)
class ClockOffset:
    """The result for a recording."""

    offset_s: float  # right after left
    sigma_s: float
    rotation_rad: Array  # (3,) of the right camera about its axes, beside the calibration
    rotation_sigma_rad: Array  # (3,)
    jitter_s: float  # scatter of the offsets of single frames beyond their sigmas
    jitter_significance: float  # chi-square of the offsets of single frames over its degrees of freedom, in its sigmas
    shift_px: float  # RMS shift of the right images by the offset (or by the jitter, whichever is larger)
    frames: int

    @property
    def significant(self) -> bool:
        """Whether the offset is certain (5 sigma) and shifts the images by more than 0.05 px."""
        certain = abs(self.offset_s) > 5 * self.sigma_s or self.jitter_significance > 8
        return certain and self.shift_px > 0.05


def clock_offset(pair: StereoPair, model: MarkerModel, frames: Sequence[FittedFrame]) -> ClockOffset | None:
    """The offset of the right camera's clock; None with fewer than eight moving frames that determine it."""
    N, b = np.zeros((_UNKNOWNS, _UNKNOWNS)), np.zeros(_UNKNOWNS)
    left, dof, used = 0.0, 0, []
    for before, frame, after in zip(frames, frames[1:], frames[2:], strict=False):
        rate = after.fit.pose.minus(before.fit.pose) / (after.t_s - before.t_s)
        part = _reduced(pair, model, frame, rate)
        if part is None:
            continue
        A, r, free, moved2 = part
        N, b, left, dof = N + A.T @ A, b + A.T @ r, left + float(r @ r), dof + free
        used.append((A, r, moved2))
    if len(used) < _FEWEST_FRAMES:
        return None
    scale = np.sqrt(np.maximum(np.diagonal(N), 1e-300))
    values, vectors = np.linalg.eigh(N / np.outer(scale, scale))
    if values[0] < 1e-10:
        return None
    covariance = (vectors / values) @ vectors.T / np.outer(scale, scale)
    x = covariance @ b
    factor = max(1.0, (left - float(b @ x)) / max(dof - _UNKNOWNS, 1))
    sigma = np.sqrt(np.diagonal(covariance) * factor)
    moved = float(np.sqrt(np.mean([m for _, _, m in used])))
    jitter, significance = _jitter(x, used, factor)
    shift = moved * max(abs(float(x[0])), jitter if significance > 8 else 0.0)
    return ClockOffset(float(x[0]), float(sigma[0]), x[1:], sigma[1:], jitter, significance, shift, len(used))


def _jitter(x: Array, used: Sequence[tuple[Array, Array, float]], factor: float) -> tuple[float, float]:
    """Scatter, s, of the offsets of single frames around the common one, and its significance."""
    single, weight = [], []
    for A, r, _ in used:
        information = float(A[:, 0] @ A[:, 0])
        if information > 0:
            single.append(float(A[:, 0] @ (r - A @ x)) / information)
            weight.append(information)
    d, w = np.array(single), np.array(weight)
    if not len(d):
        return 0.0, 0.0
    chi2 = float(np.sum(d * d * w)) / min(factor, 2.0)
    excess = (chi2 - len(d)) / float(np.sum(w))
    return float(np.sqrt(max(excess, 0.0))), (chi2 - len(d)) / float(np.sqrt(2 * len(d)))


def _reduced(
    pair: StereoPair, model: MarkerModel, frame: FittedFrame, rate: Array
) -> tuple[Array, Array, int, float] | None:
    """Design (m, 4), residuals (m,), degrees of freedom and mean squared velocity (px/s)^2 of one frame.

    Whitened, and without the directions that a change of the pose explains.
    """
    seen: Bools = frame.observed.seen & np.isfinite(frame.fit.residuals_px[..., 0])
    if seen[0].sum() < 2 or seen[1].sum() < 2:
        return None
    J = project_markers(pair, model, frame.fit.pose)[1]
    velocity = J[1] @ rate
    camera = pair.cameras[1].camera_from_world
    world = frame.fit.pose.apply(model.positions)
    by_point = project(pair, world)[1][1]
    by_turn = np.cross(camera.apply(world)[:, None, :], by_point @ camera.rotation.T)  # Exp(theta) x in the camera
    A = np.zeros((2, len(model), 2, _UNKNOWNS))
    A[1, :, :, 0], A[1, :, :, 1:] = velocity, by_turn
    W = np.linalg.inv(np.linalg.cholesky(frame.observed.cov_px2[seen]))
    J_w = (W @ J[seen]).reshape(-1, 6)
    A_w = (W @ A[seen]).reshape(-1, _UNKNOWNS)
    r_w = (W @ frame.fit.residuals_px[seen][..., None]).reshape(-1)
    Q = np.linalg.qr(J_w)[0]
    free = len(r_w) - 6
    if free < 1:
        return None
    moved2 = float(np.mean(np.sum(velocity[seen[1]] ** 2, axis=-1)))
    return A_w - Q @ (Q.T @ A_w), r_w - Q @ (Q.T @ r_w), free, moved2


# The pose of the target in each frame of a sequence; the previous frames help to label, not to measure.
#
# A measured pose rests on the images of its own frame alone: poses of different frames have independent noise. The
# motion gives the search regions, excludes one of two attitudes of a distant flat target, and bridges frames without a
# measurement. Source: ours.


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
    fit: JointFit | None  # of the images of this frame, also where it is no measurement
    observed: MarkerObservations | None  # the images of that fit
    index: Ints  # (2, K) candidates of the markers, -1: none
    predicted_px: Array  # (2, K, 2), before the pictures were used; nan without a prediction
    predicted_cov_px2: Array  # (2, K, 2, 2)

    @property
    def markers(self) -> int:
        """Number of different markers that the pose rests on."""
        return int((self.index >= 0).any(axis=0).sum())


class BinocularTracker:
    """Labels and poses, frame by frame."""

    def __init__(self, pair: StereoPair, model: MarkerModel, parameters: MatchParameters) -> None:
        self._pair, self._model, self._p = pair, model, parameters
        self._motion: Motion | None = None
        self._images: Images = (MarkerImages.none(), MarkerImages.none())  # of the current frame
        self._last_measured: int = -1
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
        pose, covariance = best.fit.pose, best.fit.covariance
        self._motion = Motion.at_rest(t_s, pose, covariance) if ahead is None else ahead.updated(pose, covariance)
        return self._result(PoseStatus.MEASURED, "", pose, covariance, best, ahead)

    def _prediction(self, t_s: float) -> Motion | None:
        if self._motion is None or self._count - self._last_measured > self._p.max_predicted_frames:
            return None
        ahead = self._motion.predicted(t_s, self._p.acceleration_m_s2, self._p.turn_rad_s2)
        worst = np.sqrt([np.linalg.eigvalsh(ahead.pose_covariance[s, s])[-1] for s in (slice(0, 3), slice(3, 6))])
        return ahead if worst[0] <= LOST_SIGMA_M and worst[1] <= LOST_SIGMA_RAD else None

    def _candidates(self, images: Images, ahead: Motion | None) -> list[LabelledPose]:
        """Poses that explain the images: near the prediction, and from scratch where that is not convincing."""
        found: list[LabelledPose] = []
        if ahead is not None:
            near = labelled_pose(self._pair, self._model, images, ahead.pose, ahead.pose_covariance, self._p)
            found = [] if near is None else [near]
        if not found or not self._convincing(found[0], images):
            found += acquire(self._pair, self._model, images, self._p)
        for candidate in found[:2]:
            start = mirrored(self._pair, self._model, candidate.fit.pose)
            other = labelled_pose(self._pair, self._model, images, start, candidate.fit.covariance, self._p)
            found = found if other is None else [*found, other]
        return distinct(found)

    def _convincing(self, found: LabelledPose, images: Images) -> bool:
        explained = int((found.index >= 0).sum())
        expected = min(2 * len(self._model), len(images[0]) + len(images[1]))
        return chi2_tail(found.fit.chi2, max(found.fit.dof, 1)) > _TRUSTED_P and explained >= _TRUSTED_SHARE * expected

    def _prior_nats(self, candidate: LabelledPose, ahead: Motion | None) -> float:
        """Log density of a candidate under the prediction, up to a constant and limited."""
        if ahead is None:
            return 0.0
        apart = candidate.fit.pose.minus(ahead.pose)
        d2 = float(apart @ np.linalg.solve(ahead.pose_covariance + candidate.fit.covariance, apart))
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
        if self._contradicted(best):
            return CONTRADICTED
        worst = np.sqrt([np.linalg.eigvalsh(best.fit.covariance[s, s])[-1] for s in (slice(0, 3), slice(3, 6))])
        if worst[0] > LOST_SIGMA_M or worst[1] > LOST_SIGMA_RAD:
            return WEAK
        return AMBIGUOUS if rivals else ""

    def _contradicted(self, best: LabelledPose) -> bool:
        """Whether a camera sees candidates, but hardly one where the pose puts markers: cameras exchanged, or moved."""
        pixels = project_markers(self._pair, self._model, best.fit.pose)[0]
        for c, (camera, found) in enumerate(zip(self._pair.cameras, self._images, strict=True)):
            expected = int(in_picture(pixels[c], np.array(camera.image_size_px)).sum())
            confirmed = int((best.index[c] >= 0).sum())
            if len(found) >= _ENOUGH_CANDIDATES and confirmed < min(_LEAST_CONFIRMED * expected, expected - 1):
                return True
        return False

    def _both(
        self, best: LabelledPose, rivals: list[LabelledPose], weights: Array, ahead: Motion | None
    ) -> BinocularFrame:
        """The best of several poses with a covariance that covers all of them."""
        w = weights / weights.sum()
        pose = best.fit.pose
        covariance = np.zeros((6, 6))
        for weight, one in zip(w, [best, *rivals], strict=True):
            apart = one.fit.pose.minus(pose)
            covariance += weight * (one.fit.covariance + np.outer(apart, apart))
        if np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1]) > LOST_SIGMA_M:
            return self._unmeasured(AMBIGUOUS, ahead, best)
        return self._result(PoseStatus.PREDICTED, AMBIGUOUS, pose, symmetric(covariance), best, ahead)

    def _unmeasured(self, reason: str, ahead: Motion | None, found: LabelledPose | None = None) -> BinocularFrame:
        if ahead is None:
            return self._result(PoseStatus.LOST, reason, None, None, found, ahead)
        return self._result(PoseStatus.PREDICTED, reason, ahead.pose, ahead.pose_covariance, found, ahead)

    def _result(
        self,
        status: PoseStatus,
        reason: str,
        pose: Pose | None,
        covariance: Array | None,
        found: LabelledPose | None,
        ahead: Motion | None,
    ) -> BinocularFrame:
        count = len(self._model)
        pixels, cov = np.full((2, count, 2), np.nan), np.full((2, count, 2, 2), np.nan)
        if ahead is not None:
            pixels, J = project_markers(self._pair, self._model, ahead.pose)
            cov = J @ ahead.pose_covariance @ np.swapaxes(J, -1, -2)
        used = found is not None and (status is PoseStatus.MEASURED or reason == AMBIGUOUS)
        index = found.index if found is not None and used else np.full((2, count), -1, dtype=np.int64)
        fit = None if found is None else found.fit
        observed = None if found is None else observations(self._images, found.index)
        return BinocularFrame(status, reason, pose, covariance, fit, observed, index, pixels, cov)
