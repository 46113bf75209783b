"""Which labels of a frame are confirmed: by the motion, by the frame's other spots, or by their probability."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.compiled_projection import project_all
from geometry.forward_model import SpotModel
from tracking.parameters import TrackerParameters
from tracking.rigid_body.acquisition import predicted_hypothesis
from tracking.rigid_body.association.frame_detections import (
    BLENDED,
    FrameDetections,
    Observation,
    chosen_points,
    distinct_spots,
)
from tracking.rigid_body.hypotheses.hypothesis_set import (
    MAX_CHECKING_SIGMA_PX,
    MAX_THREE_SPOT_SIGMA_PX,
    MIN_CONFIRMING_SPOTS,
    MIN_REDUNDANT_SPOTS,
    SURE_PROBABILITY,
    Children,
    Dynamics,
    Hypotheses,
    largest_spot_sigma,
    unchecked_by_prediction,
    unweighted_spread,
)
from tracking.rigid_body.models.information import well_controlled

MANY_SPOTS = 6  # with so many, an uncontrolled spot concerns only its own label
# Of a first acquisition against "all points are false"; false points reach it with exp(-7) = 1e-3 per frame.
MIN_EVIDENCE_NATS = 7.0
RESTING_FRAMES = 10  # points at rest have one chance in so many frames, others one in each
MAX_EVIDENCE, MIN_EVIDENCE = 50.0, -5.0  # nats; a first hypothesis with less evidence is dropped
MOVED_SIGMAS = 5.0  # of a point, from where it was counted: less is a point at rest, as false points are
WIDE_SIGMA = 10.0  # m, rad: of a prior that does not matter


class FirstEvidence:
    """Evidence for a vehicle against "all points are false", until a pose is measured; over frames it adds up.

    False points at rest are in the same places in each frame: one frame of them says as much as many. So do the spots
    of a vehicle at rest. While most points rest, one that moves is another false point with the label. Source: ours.
    """

    def __init__(self, views: int) -> None:
        self.nats = 0.0
        self._rested = 0  # frames in which the points were where they are
        self._counted = np.full((views, 2), np.nan)  # px, where the points were whose evidence counted last

    def add(self, frame: FrameDetections, assigned: Ints, nats: float, continued: bool) -> bool:
        """Add a frame's best assignment (n,); False if the evidence is too small. continued: not found just now."""
        seen = assigned >= 0
        rows = assigned[seen] % BLENDED
        away2 = np.sum((frame.uv[rows] - self._counted[seen]) ** 2, axis=1)  # nan: not counted yet
        largest2 = MOVED_SIGMAS**2 * np.trace(frame.cov[rows], axis1=1, axis2=2)
        rests = bool(np.count_nonzero(away2 < largest2) >= np.count_nonzero(away2 >= largest2))
        self._rested = self._rested + 1 if continued and rests else 0
        new = np.isnan(self._counted[:, 0]) if self._rested else seen
        self._counted[new & seen] = frame.uv[assigned[new & seen] % BLENDED]
        if continued:
            nats = self.nats + (min(nats, 0.0) if rests else nats)
        self.nats = min(nats, MAX_EVIDENCE)
        if self.nats < MIN_EVIDENCE:
            self.nats = 0.0
            return False
        return True

    @property
    def is_enough(self) -> bool:
        """Whether false points reach this evidence at most as often as MIN_EVIDENCE_NATS in each frame."""
        return self.nats + float(np.log1p(min(self._rested, RESTING_FRAMES - 1))) >= MIN_EVIDENCE_NATS


@dataclass(frozen=True, slots=True)
class FrameHypotheses:
    """The hypotheses of one frame after pruning, n views."""

    dt_s: float
    before: Hypotheses | None  # of the frame before
    now: Hypotheses  # best first
    children: Children
    kept: Ints  # (h,) indices of `now` among the children
    probability: Array  # (n,) of the best hypothesis' choice for each view
    spread: Array  # (6, 6) of the other hypotheses' poses about the best
    searched: Mapping[int, str]  # children that only a search proposed, with the names of their spots
    first: bool  # no pose has been measured yet
    is_vehicle: bool  # enough evidence for the best hypothesis against "all points are false", until a pose is measured

    @property
    def best(self) -> int:
        """Index of the best child."""
        return int(self.kept[0])

    @property
    def assigned(self) -> Ints:
        """(n,): its assignment."""
        return self.children.assigned[self.best]

    @property
    def parent(self) -> int:
        """Index among `before` of the hypothesis that it continues; -1: none."""
        return int(self.children.parent[self.best])

    @property
    def manoeuvre(self) -> bool:
        """Whether its velocities have jumped."""
        return bool(self.children.manoeuvre[self.best])


@dataclass(frozen=True, slots=True)
class Confirmation:
    """Result of the checks of one frame."""

    min_probability: float  # labels need at least this probability
    confirmed: bool  # else labels and pose wait for the next frame
    spread: Array  # (6, 6) to be added to the pose's covariance


class LabelConfirmation:
    """Checks of the labels, with what they need from the frame before."""

    def __init__(self, model: SpotModel, parameters: TrackerParameters) -> None:
        self._model, self._parameters = model, parameters
        self._found_before = np.zeros(len(model), dtype=bool)  # spots of the best hypothesis in the frame before
        self._unconfirmed = False  # labels have been left open, and no frame with enough spots has followed

    def check(self, obs: Observation, h: FrameHypotheses, dynamics: Dynamics) -> Confirmation:
        """Check the best hypothesis of the next frame."""
        p, model, assigned = self._parameters, self._model, h.assigned
        # A pose from a search alone must lead as in first_labels.py: odds of 5 to 1 are still a tie.
        from_search = h.first or h.best in h.searched
        least = max(p.min_label_probability, 1 / (1 + np.exp(-p.labels.lead_nats)) if from_search else 0.0)
        doubtful = (assigned >= 0) & (h.probability < SURE_PROBABILITY)
        sure = int(distinct_spots((assigned >= 0) & ~doubtful, model.spot_of))
        if sure < MIN_REDUNDANT_SPOTS:
            least = max(least, SURE_PROBABILITY)  # the others do not check a label
        out = Confirmation(least, not h.first or h.is_vehicle, h.spread)
        spots = int(distinct_spots(assigned >= 0, model.spot_of))
        if spots and h.before is not None and h.dt_s > 0 and h.parent >= 0:
            out = self._check_by_motion(obs, h, dynamics, out, spots, sure, doubtful)
        elif h.best in h.searched:
            use, _, cov = chosen_points(obs.frame.uv, obs.frame.cov, 0, assigned, obs.calibration_cov)
            controlled = well_controlled(model.numbers, h.now.R[0], h.now.t[0], use, cov)
            few = not h.first and distinct_spots(controlled, model.spot_of) < MIN_REDUNDANT_SPOTS
            if few or decisive(model, h.now.R[0], h.now.t[0], use, cov).any():
                # If the others leave a direction of the pose open, some false point fits: the next frame must agree.
                out = self._postpone(h, out.min_probability)
        self._found_before = assigned >= 0
        return out

    def _postpone(self, h: FrameHypotheses, min_probability: float) -> Confirmation:
        """Labels that wait for the next frame; until then the covariance covers all hypotheses."""
        self._unconfirmed = True
        return Confirmation(min_probability, False, unweighted_spread(h.children, h.kept))

    def _check_by_motion(
        self,
        obs: Observation,
        h: FrameHypotheses,
        dynamics: Dynamics,
        before: Confirmation,
        spots: int,
        sure: int,
        doubtful: Bools,
    ) -> Confirmation:
        """Checks of a hypothesis that continues one of the frame before: the prediction checks the labels.

        spots, sure: number of labelled spots, and of those with a sure label; doubtful (n,): labels that are not sure.
        """
        model, assigned = self._model, h.assigned
        assert h.before is not None
        R, t, _, P = predicted_hypothesis(h.before, h.parent, h.dt_s, dynamics, h.manoeuvre)
        used = np.where(assigned < BLENDED, assigned, -1)
        unchecked = unchecked_by_prediction(model.numbers, R, t, P, used)
        again = (assigned >= 0) & self._found_before & ~unchecked
        if self._unconfirmed and (h.parent > 0 or distinct_spots(again, model.spot_of) < MIN_CONFIRMING_SPOTS):
            # Labels that nothing has checked do not check later ones, until enough spots are found again.
            unchecked |= used >= 0
        self._unconfirmed = False
        if not unchecked.any():
            return before
        # The motion does not check some label: the frame's other spots must, or it must be beyond doubt.
        least = max(before.min_probability, SURE_PROBABILITY)
        use, _, cov = chosen_points(obs.frame.uv, obs.frame.cov, 0, assigned, obs.calibration_cov)
        uncontrolled = use & ~well_controlled(model.numbers, h.now.R[0], h.now.t[0], use, cov)
        # A spot that the frame before showed as well confirms itself. A single spot that reappears where it may be
        # anywhere waits for the next frame, as does one that alone determines a direction of the pose.
        new = unchecked & ~self._found_before
        single = np.count_nonzero(new) == 1 and (uncontrolled if spots >= MANY_SPOTS else uncontrolled.any()) & new
        single = single | (decisive(model, h.now.R[0], h.now.t[0], use, cov) & new)
        far = largest_spot_sigma(model.numbers, R, t, P, used) > MAX_THREE_SPOT_SIGMA_PX
        too_few = sure < MIN_REDUNDANT_SPOTS and (uncontrolled.any() or far or doubtful.any())
        if too_few or np.any(single):
            return self._postpone(h, least)
        return Confirmation(least, before.confirmed, before.spread)


def decisive(model: SpotModel, R: Array, t: Array, use: Bools, cov: Array) -> Bools:
    """(n,): the used views (n,) of the one spot that alone determines a direction of the pose (R (3, 3), t (3,)).

    Such a spot may be a false point: one somewhere on its path fits the others as well, such as on the second screen
    beside any number of spots that lie on one line of the first. cov (n, 2, 2), px^2. The other spots must predict it
    to MAX_CHECKING_SIGMA_PX. Where that is so of several spots, as of all in a frame of four, they need each other, and
    none is named. Source: ours.
    """
    _, J = project_all(model.numbers, R[None], t[None])
    J = J[0]
    information = np.zeros((len(model), 6, 6))
    information[use] = np.swapaxes(J[use], 1, 2) @ np.linalg.solve(cov[use], J[use])
    total = information.sum(axis=0) + np.eye(6) / WIDE_SIGMA**2
    out = np.zeros(len(model), dtype=bool)
    for view in np.flatnonzero(use):
        others = total - information[model.spot_of == model.spot_of[view]].sum(axis=0)
        predicted = J[view] @ np.linalg.solve(others, J[view].T)
        out[view] = np.linalg.eigvalsh(predicted)[-1] > MAX_CHECKING_SIGMA_PX**2
    return out & (distinct_spots(out, model.spot_of) == 1)
