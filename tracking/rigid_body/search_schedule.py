"""When the rigid tracker searches a frame for the whole vehicle, besides following its hypotheses."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from geometry.arrays import Ints
from geometry.compiled_projection import project_all
from geometry.forward_model import SpotModel
from tracking.detections import Detections
from tracking.rigid_body.association.frame_detections import distinct_spots
from tracking.rigid_body.frame_result import is_lost
from tracking.rigid_body.hypotheses.hypothesis_set import Dynamics, Hypotheses
from tracking.rigid_body.hypotheses.prediction_checks import (
    MAX_TRACKING_SIGMA_PX,
    MIN_CONFIRMING_SPOTS,
    MIN_REDUNDANT_SPOTS,
)
from tracking.rigid_body.models.occlusion import MISSED
from tracking.rigid_body.pose_candidates import predicted_hypothesis

LONG_UNMEASURED = 10  # frames without a measured pose, after which two missing spots are enough to contradict
SEARCH_AT = (2, 4, 8, 14)  # frames in a row that contradict the best hypothesis, at which a search is made
ASTRAY = 15  # frames without a measured pose, after which a contradicted vehicle is searched anywhere
MISSING_TO_DOUBT = 2  # spots of one camera; an answer must explain so many more than the doubted track
CONTRADICTED_INTERVAL = 20  # frames: and after that at each multiple of it
FEW_SPOTS_INTERVAL = 50  # frames in a row with few, uncontradicted labels between two searches
JUST_FOUND = 5  # frames after a successful search: until then the velocities may be almost unknown
# Searches in a row without success, from which on only every so many frames are searched. A failing search of twelve
# spots costs 0.4 s, and an occluded screen may stay so for minutes. More points than before are searched at once.
INTERVALS = ((0, 1), (20, 2), (100, 5), (300, 10), (1000, 20))


def is_vague(model: SpotModel, h: Hypotheses | None, dt_s: float, dynamics: Dynamics) -> bool:
    """Whether the best hypothesis predicts some spot worse than MAX_TRACKING_SIGMA_PX, or no spot at all."""
    if h is None:
        return True
    R, t, _, P = predicted_hypothesis(h, 0, dt_s, dynamics, manoeuvre=False)
    _, J = project_all(model.numbers, R[None], t[None])
    cov = J[0] @ P[:6, :6] @ np.swapaxes(J[0], -1, -2)
    projected = J[0].any(axis=(1, 2))  # project_all gives 0 where there is no projection
    if is_lost(P) or not projected.any():
        return True
    return bool(np.sqrt(np.max(cov[projected][:, [0, 1], [0, 1]])) > MAX_TRACKING_SIGMA_PX)


def _due(frames: int) -> bool:
    """Whether to search after so many frames in a row that give a reason for it."""
    return frames in SEARCH_AT or frames % CONTRADICTED_INTERVAL == 0


class SearchSchedule:
    """Counters over the frames that decide about searches."""

    def __init__(self, model: SpotModel, min_spots: int) -> None:
        """min_spots: points that a frame needs for a search."""
        self._model, self._min_spots = model, min_spots
        self.searches = 0  # in a row without success
        self._since_found = 0  # frames since a search found the vehicle
        self._unmeasured = 0  # frames in a row without a measured pose
        self._contradicted = 0  # frames in a row that contradict the best hypothesis
        self._doubted = 0  # frames in a row whose labels explain the pose, but few of a camera's points
        self._few_spots = 0  # frames in a row that label fewer than MIN_REDUNDANT_SPOTS
        self._points_before = 0  # of all cameras, in the frame before

    @property
    def just_found(self) -> bool:
        """Whether a search has found the vehicle a few frames ago."""
        return self._since_found <= JUST_FOUND

    @property
    def doubted(self) -> bool:
        """Whether the last measured pose may be wrong."""
        return self._doubted > 0

    @property
    def astray(self) -> bool:
        """Whether the vehicle is probably not near the place where it is followed: it moved faster than ever before."""
        return self._contradicted > 0 and self._unmeasured >= ASTRAY

    def next_frame(self) -> None:
        """Count a frame."""
        self._since_found += 1

    def found(self) -> None:
        """A search has given this frame's best hypothesis; the next frame is searched too, to confirm or refute it."""
        self.searches = self._since_found = 0

    def measured(self, whether: bool, spots: int) -> None:
        """Whether this frame's pose is measured, and from how many spots."""
        self._unmeasured = 0 if whether else self._unmeasured + 1
        if whether and spots >= MIN_REDUNDANT_SPOTS:
            self.searches = 0

    def due(
        self, best: Ints | None, found: Sequence[Detections | None], prediction_is_vague: Callable[[], bool]
    ) -> bool:
        """Whether to search this frame: there are enough points, and no hypothesis explains them with certainty.

        best (n,): assignment of the likeliest child; None without one. prediction_is_vague: whether the best hypothesis
        predicts some spot too badly to track it.
        """
        points, before = sum(len(f) for f in found if f is not None), self._points_before
        self._points_before = points
        doubted, self._doubted = self._doubted, 0
        if points < self._min_spots:
            return False
        if best is not None:
            explained = distinct_spots(best >= 0, self._model.spot_of) >= MIN_REDUNDANT_SPOTS
            vague = (self.just_found or not explained) and prediction_is_vague()
            if explained and not vague:
                self._few_spots = 0
                self._doubted = doubted + 1 if self._doubtful(best, found) else 0
                return self._doubted > 0 and _due(self._doubted)
            if not vague:
                self._few_spots += 1
                if self._contradicts(best, found):
                    return _due(self._contradicted)
                # Few spots of a well predicted vehicle mean that the others are occluded; rarely that they are false.
                return self._few_spots % FEW_SPOTS_INTERVAL == 0
        # At once when spots reappear, then less and less often: a search that keeps failing will fail again.
        self.searches += 1
        more = points > before + 1
        interval = next(frames for least, frames in reversed(INTERVALS) if self.searches > least)
        return more or self.searches % interval == 0

    def _doubtful(self, best: Ints, found: Sequence[Detections | None]) -> bool:
        """Whether most spots of a camera are missing although it has as many other points.

        A reflection may pass for the only spot of a screen: with the spots of another one, it determines a wrong pose.
        """
        for c, f in enumerate(found):
            mine = best[self._model.camera_of == c]
            missing, labelled = int(np.count_nonzero(mine == MISSED)), int(np.count_nonzero(mine >= 0))
            if f is not None and missing >= max(MISSING_TO_DOUBT, labelled + 1) and len(f) >= missing + labelled:
                return True
        return False

    def _contradicts(self, best: Ints, found: Sequence[Detections | None]) -> bool:
        """Whether a camera has enough points, but none where several spots are expected; counts such frames.

        After some frames without a measured pose the spots of all cameras count together: one or two labels agree with
        almost any pose.
        """
        missed, labelled = best == MISSED, best >= 0
        long = self._unmeasured >= LONG_UNMEASURED
        least, elsewhere = 2 if long else MIN_CONFIRMING_SPOTS, 0
        contradicts = False
        for c, f in enumerate(found):
            if f is None:
                continue
            mine = self._model.camera_of == c
            missing = int(np.count_nonzero(missed & mine))
            spare = len(f) - int(np.count_nonzero(labelled & mine))
            contradicts |= missing >= least and len(f) >= missing
            elsewhere += min(missing, max(spare, 0))
        contradicts |= long and elsewhere >= MISSING_TO_DOUBT
        self._contradicted = self._contradicted + 1 if contradicts else 0
        return contradicts
