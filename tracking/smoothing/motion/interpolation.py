"""Strength of the jerk between frames, below that of the best prediction of the next frame.

Between frames a motion without jerk at high frequencies, as of all heavy bodies, is smoother than white jerk. How much
is found by predicting each frame from all others. Source: ours; the leave-one-out predictive likelihood: Geisser & Eddy
(1979), "A predictive approach to model selection", JASA 74.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geometry.arrays import Array, Bools
from tracking.smoothing.motion.fixed_interval import RunInformation, leave_one_out_log_likelihood, smoothed
from tracking.smoothing.motion.run_detections import Reference

MOST_OWN = 0.9  # share of what is known of a pose that its own spots may have for these to be left out
OFFSETS = (-2.0, -4.0, -6.0)  # of log q: tried for the interpolation between frames
BLOCK = 20  # frames that share an offset, or have none


@dataclass(frozen=True, slots=True)
class Interpolation:
    """T frames whose motion between them may be smoother than white jerk."""

    ref: Reference
    info: RunInformation
    log_density: Array  # (T, 6) of the white jerk
    interior: Bools  # (T,) frames that may have a lower one
    pose_P: Array  # (T, 6, 6) with the white jerk

    def best_offset(self, delayed: bool) -> float:
        """Offset of log q with the largest leave-one-out likelihood: each frame predicted by all others.

        delayed: some spots were not exposed at the instants of their frames.
        """
        if not self.interior.any():
            return 0.0
        by_others = None
        if delayed:
            # Where the spots of a frame are also what the velocities are known by, they would count twice.
            by_others = (self.interior & self._known_by_others())[:, None, None]
            if 2 * by_others.sum() < self.interior.sum():
                return 0.0
        best, value = 0.0, self._leave_one_out(0.0, by_others)
        for offset in OFFSETS:
            likelihood = self._leave_one_out(offset, by_others)
            if likelihood < value:
                break
            best, value = offset, likelihood
        for offset in (best - 1.0, best + 1.0):
            if offset < 0:
                likelihood = self._leave_one_out(offset, by_others)
                if likelihood > value:
                    best, value = offset, likelihood
        return best

    def frames_better_with(self, offset: float) -> Bools:
        """(T,): frames that the others predict better with this offset, which is that of the whole run.

        A vehicle that rests and then swings rests most of the time.
        """
        better = np.zeros(len(self.interior), dtype=bool)
        L, g = of_poses(self.info.information) * self._known_by_others()[:, None, None], of_poses(self.info.vector)
        both = [smoothed(self.ref, self.info, self._density(o), tested=False) for o in (0.0, offset)]
        for first in range(0, len(better), BLOCK):
            block = slice(first, first + BLOCK)
            some = self.info._replace(information=L[block], vector=g[block], dt=self.info.dt[block])
            white, less = (leave_one_out_log_likelihood(out.x[block], out.pose_P[block], some) for out in both)
            better[block] = less > white
        return better

    def _known_by_others(self) -> Bools:
        """(T,): frames of whose pose the other frames know a part."""
        own = np.linalg.eigvals(self.pose_P @ of_poses(self.info.information)).real.max(axis=1)
        return np.asarray(own < MOST_OWN)

    def _density(self, offset: float) -> Array:
        return np.exp(self.log_density + offset * self.interior[:, None])

    def _leave_one_out(self, offset: float, by_others: Bools | None) -> float:
        out = smoothed(self.ref, self.info, self._density(offset), tested=False)
        # Of spots that were not exposed at the instant of their frame, what they say about the pose.
        left_out = of_poses(self.info.information)
        if by_others is not None:
            left_out = left_out * by_others
        about_poses = self.info._replace(information=left_out, vector=of_poses(self.info.vector))
        value = float(leave_one_out_log_likelihood(out.x, out.pose_P, about_poses))
        return value if np.isfinite(value) else -np.inf


def of_poses(a: Array) -> Array:
    """The part (..., 6) or (..., 6, 6) about the poses of vectors (T, s) or matrices (T, s, s)."""
    if a.shape[1] == 6:
        return a
    return np.ascontiguousarray(a[:, :6] if a.ndim == 2 else a[:, :6, :6])
