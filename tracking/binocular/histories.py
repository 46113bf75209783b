"""What successive pictures say for a pose that explains too few lights in one of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from geometry.uncertainty.chi_square import chi2_limit
from tracking.binocular.acquisition import Images, LabelledPose, observations
from tracking.binocular.joint_fit import MarkerObservations
from tracking.kalman import RigidMotion

# The right pose explains its lights again when they have moved relative to each other; one that explains them by chance
# does not. By chance, a light is anywhere within the relative motion, so that the prior probability of a fit falls with
# the square of this motion over the noise, per surplus light. Motion in the plane of the picture, turns about the line
# of sight and changes of size leave a wrong pose as good as it was: they do not count. Lights at rest give no evidence
# beyond that of one picture. The test is one of likelihoods, with the noise of the residuals themselves where these are
# larger than stated. Source: ours; following hypotheses until one is likely enough is the multiple hypothesis tracking
# of Reid (1979), "An algorithm for tracking multiple targets", IEEE Trans. Automatic Control 24(6).

FIRST_SPEED_M_S, FIRST_RATE_RAD_S = 5.0, 2.0  # 1 sigma of the unknown velocity after the first pose
_UNEXPLAINED = 0.25  # share of the squared relative motion of another rigid body's lights that a wrong pose leaves
_CONTINUED_P = 1e-4  # of the distance from the prediction
_MOST = 8  # poses that are followed: those with the most evidence; three lights fit many poses, four few


@dataclass(frozen=True, slots=True)
class _History:
    """A pose that has explained its lights in one picture or several."""

    motion: RigidMotion  # at the last of them ...
    t_s: float  # ... its time
    first: MarkerObservations
    last: MarkerObservations
    evidence: float  # nats, of the first picture
    chi2: float  # of all pictures
    dof: int

    def in_all(self, found: LabelledPose) -> float:
        """The evidence of all pictures, nats, for the pose found in the last one."""
        noise = max(self.chi2 / self.dof, 1.0)  # variance of the residuals over the stated one
        moved = _UNEXPLAINED * max(_relative_motion(self.first, self.last) - 1.0, 0.0) / noise
        return self.evidence + found.fit.dof * float(0.5 * np.log1p(moved) - np.log(noise))


class Histories:
    """The poses of a target that is not acquired yet, from picture to picture.

    predicted: a motion after a time, s; None where it is too uncertain by then.
    """

    def __init__(self, predicted: Callable[[RigidMotion, float], RigidMotion | None]) -> None:
        self._predicted, self._kept = predicted, list[_History]()

    def clear(self) -> None:
        """Forget all."""
        self._kept.clear()

    def added_to(self, t_s: float, images: Images, found: list[LabelledPose]) -> list[LabelledPose]:
        """The poses found in a picture at time t_s, with the evidence of the pictures before it."""
        ahead = [(h, motion) for h in self._kept if (motion := self._predicted(h.motion, t_s - h.t_s)) is not None]
        out, kept = [], []
        for one in found:
            if one.fit.dof > 0 and one.evidence > 0:
                history = _continued(ahead, t_s, images, one)
                one = replace(one, evidence=max(one.evidence, history.in_all(one)))
                kept.append((one.evidence, history))
            out.append(one)
        continued = {id(h.first) for _, h in kept}
        kept += [(h.evidence, h) for h, _ in ahead if id(h.first) not in continued]
        self._kept = [h for _, h in sorted(kept, key=lambda of: -of[0])[:_MOST]]
        return out


def _continued(ahead: list[tuple[_History, RigidMotion]], t_s: float, images: Images, found: LabelledPose) -> _History:
    """The history that predicts a pose best and has its lights, with this pose; where there is none, a new one."""
    pose, covariance, fit = found.fit.world_from_body, found.fit.covariance, found.fit
    seen = observations(images, found.index)
    best, least = None, chi2_limit(_CONTINUED_P, 6)  # numbers of a pose
    for h, motion in ahead:
        updated, y, S = motion.updated_with_pose(pose, covariance)
        if (d2 := float(y @ np.linalg.solve(S, y))) < least and _has_its_lights(h.last, seen, images):
            best, least = _History(updated, t_s, h.first, seen, h.evidence, h.chi2 + fit.chi2, h.dof + fit.dof), d2
    first = RigidMotion.at_rest(pose, covariance, FIRST_SPEED_M_S, FIRST_RATE_RAD_S)
    return best or _History(first, t_s, seen, seen, found.evidence, fit.chi2, fit.dof)


def _has_its_lights(before: MarkerObservations, seen: MarkerObservations, images: Images) -> bool:
    """Whether the images of a pose are the lights that are nearest to those before, apart from their common shift.

    Among many lights some pose always explains four, others in each picture.
    """
    if not np.array_equal(before.seen, seen.seen):
        return False
    for c, found in enumerate(images):
        if not (both := seen.seen[c]).any():
            continue
        shift = (seen.uv_px[c, both] - before.uv_px[c, both]).mean(axis=0)
        apart = np.linalg.norm(before.uv_px[c, both, None] + shift - found.uv_px, axis=-1)
        if np.any(apart.min(axis=1) < np.linalg.norm(before.uv_px[c, both] + shift - seen.uv_px[c, both], axis=1)):
            return False
    return True


def _relative_motion(one: MarkerObservations, other: MarkerObservations) -> float:
    """Mean square, in variances of the noise, by which images moved beyond shift, turn and scale, per coordinate."""
    total, coordinates = 0.0, 0
    for c in range(2):
        both = one.seen[c] & other.seen[c]
        if (n := 2 * int(both.sum()) - 4) <= 0:  # a similarity has four numbers
            continue
        z, w = ((seen.uv_px[c, both] - seen.uv_px[c, both].mean(axis=0)) @ [1, 1j] for seen in (one, other))
        left = w - z * (np.vdot(z, w) / np.vdot(z, z))
        # A pose follows its best lights, whatever they do: what it leaves is in the others.
        noise = max(float(np.trace(seen.cov_px2[c, both], axis1=-2, axis2=-1).max()) / 2 for seen in (one, other))
        total, coordinates = total + float(np.sum(np.abs(left) ** 2 / noise)), coordinates + n
    return total / max(coordinates, 1)
