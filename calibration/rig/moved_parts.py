"""Parts of a rig that have changed by more than is stated, found by the recordings of a refinement.

Two questions are asked. What do the stated sigmas of all parts together not explain, and which parts do
(`search_faults`)? And: does one part alone explain everything, while all others are where they are stated to be? Errors
of several parts within their sigmas often add up to what one part does that has moved by ten: a camera that is 5 mm off
hides a screen that is 20 mm off. No test of size can see this. But that errors of several parts imitate one moved part
to a hundredth of their sigmas, in each of ten directions that recordings determine, is a coincidence that they do not
produce. Source: ours; the comparison of explanations by evidence: MacKay (1992), "Bayesian interpolation", Neural
Computation 4.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibration.changes import USUAL_SIZES, ChangeCandidate, ExcessResidual
from calibration.least_squares.adjustment import AdjustmentError, At, Prior, Values, solve
from calibration.model_check.fault_identification import (
    FittedFault,
    SuspectedFault,
    most_probable,
    search_faults,
)
from calibration.model_check.faults import BEAM, CAMERA, LASER_MOVED, MOVED, SCREEN, TILTED, ZOOMED, PossibleFault
from calibration.rig.knowledge import Knowledge
from calibration.rig.recordings import RecordingTerm, Reduced
from calibration.terms.rig_blocks import BEAMS, CAMERAS, INTRINSICS, SCREENS
from geometry.arrays import Array, Bools, Ints, skew
from geometry.forward_model import SpotModel
from geometry.rig import Rig

_LARGER = 10.0  # prior size of a change that the stated sigmas do not explain, in those sigmas
# Errors of all other parts, in their stated sigmas. A grid, since neither "as stated" nor "none" is known before.
_OTHERS = (1.0, 0.3, 0.1, 0.03, 0.01, 0.003)
# Probability that correct recordings, with all errors as stated or smaller by a factor of the grid, name a part. The
# odds of an explanation exceed 1/p with probability p at most (Markov's inequality: their mean is 1).
_P_ALONE = 1e-3
_ZOOM = 0.01  # prior size of a wrong focal length, relative: that of another lens of the same make
_TRIED = 4  # most probable parts for which the adjustment is solved again: large turns are not linear


@dataclass(frozen=True, slots=True)
class MovedParts:
    """The search for parts that have moved: the adjustment, and what it starts from."""

    rig: Rig
    prior: Prior
    terms: Sequence[RecordingTerm]
    free: Mapping[str, Bools]
    values: Values  # of the refined rig
    known: Knowledge  # of their errors before the recordings

    def found(self) -> tuple[tuple[SuspectedFault, ...], dict[str, float]]:
        """The parts that have moved, and wrong lenses; none where the stated sigmas explain the recordings.

        Also the relative sigma with which the recordings, and that of another lens of the same make, show the focal
        length of each camera of which nothing is stated.
        """
        known, data, faults = self._wider(self.known), self._data(self.values), self._faults()
        excess, X, as_stated = known.excess(data)
        several = search_faults(excess, X, faults)[0]
        lenses = self._lenses(excess, X, faults)
        sigmas = {fit.fault.name: float(np.sqrt(fit.change.covariance[0, 0])) for fit in lenses}
        return self._moved(known, data, faults, several, as_stated) or _wrong_lens(lenses), sigmas

    def _moved(
        self,
        known: Knowledge,
        data: Sequence[Reduced],
        faults: Sequence[PossibleFault],
        several: tuple[SuspectedFault, ...],
        as_stated: float,
    ) -> tuple[SuspectedFault, ...]:
        """The parts that have moved, given those of the stated sigmas and ln p(data) with these."""
        alone = self._alone(known, data, faults)
        if alone is None:
            return several
        together = np.concatenate([known.root, *(_scaled(m.best.fault) for m in several)], axis=1)
        odds = 2 * (replace(known, root=together).log_density(data) - as_stated)
        return several if len(several) > 1 and odds > alone.best.log_odds else (alone,)

    def _faults(self) -> list[PossibleFault]:
        """Each part as the one that has moved, and each lens as the wrong one."""
        wider = self._selection()
        moves = possible_moves(self.rig, self.values, self.prior, self.known)
        model, at = SpotModel.of(self.rig), _places(self._at, self.values)
        out = [replace(fault, directions=wider @ fault.directions) for fault in moves]
        for i, (name, camera) in enumerate(self.rig.cameras.items()):
            if not (views := model.camera_of == i).any():
                continue
            of = np.zeros((len(wider), 1))
            of[at[INTRINSICS, i][:2], 0] = np.diagonal(camera.matrix)[:2]
            out.append(PossibleFault(CAMERA, name, ZOOMED, of, np.array([_ZOOM]), views))
        return out

    @property
    def _at(self) -> tuple[At, ...]:
        """The unknowns with all lenses."""
        return tuple(dict.fromkeys([*self.prior.at, *((INTRINSICS, i) for i in range(len(self.rig.cameras)))]))

    def _selection(self) -> Array:
        """(p, q): where the q numbers of the prior are among all."""
        wider, stated = (sum(self.values[stack].dof for stack, _ in at) for at in (self._at, self.prior.at))
        return np.eye(wider, stated)

    def _wider(self, known: Knowledge) -> Knowledge:
        wider = self._selection()
        return Knowledge(wider @ known.mean, wider @ known.root)

    def _data(self, values: Values) -> list[Reduced]:
        """The recordings at some values of the rig, with the derivatives by all focal lengths."""
        lenses = self.free.get(INTRINSICS, np.zeros((len(self.rig.cameras), values[INTRINSICS].dof), dtype=bool)).copy()
        lenses[:, :2] = True
        terms = [replace(t, free={**self.free, INTRINSICS: lenses}) for t in self.terms]
        places = _places(terms[0].at, values)
        order = np.concatenate([places[a] for a in self._at])
        return [replace(d, X=d.X[:, order]) for d in (t.reduced(values) for t in terms)]

    def _alone(
        self, known: Knowledge, data: Sequence[Reduced], faults: Sequence[PossibleFault]
    ) -> SuspectedFault | None:
        """The part that explains everything alone, with those that do it as well; None where none does."""
        nothing = max(replace(known, root=known.root * others).log_density(data) for others in _OTHERS)
        fits = [_fitted(fault, known, data, nothing, len(faults)) for fault in faults]
        fits.sort(key=lambda fit: -fit.log_odds)
        limit = -2 * float(np.log(_P_ALONE))
        again = [self._solved(fit, nothing, len(faults)) for fit in fits[:_TRIED] if fit.log_odds > limit]
        return most_probable([fit for fit in again if fit.log_odds > limit])

    def _solved(self, fit: FittedFault, nothing: float, count: int) -> FittedFault:
        """The fit at the values of the rig that are the most probable ones if this part alone has moved."""
        if fit.fault.kind == ZOOMED:
            return fit
        root = np.concatenate([self.known.root * _OTHERS[-2], self._selection().T @ _scaled(fit.fault)], axis=1)
        prior = replace(self.prior, covariance=root @ root.T)
        try:
            values = solve(self.values, [prior, *self.terms], self.free).values
        except AdjustmentError:
            return fit
        known = self._wider(replace(self.known, mean=difference(self.prior, values)))
        return _fitted(fit.fault, known, self._data(values), nothing, count)

    def _lenses(self, excess: ExcessResidual, X: Array, faults: Sequence[PossibleFault]) -> list[FittedFault]:
        """The change of each focal length of which nothing is stated: it would not be refined."""
        stated = {list(self.rig.cameras)[i] for stack, i in self.prior.at if stack == INTRINSICS}
        return [
            FittedFault(f, change, change.evidence)
            for f in faults
            if f.kind == ZOOMED and f.name not in stated
            for change in [excess.fit(f.kind, f.name, ChangeCandidate(X @ f.directions, f.prior_sigma))]
        ]


def _wrong_lens(fits: Sequence[FittedFault]) -> tuple[SuspectedFault, ...]:
    """A focal length that the recordings contradict."""
    found = most_probable([fit for fit in fits if fit.change.p_value < _P_ALONE / len(fits)])
    return () if found is None else (found,)


def _fitted(fault: PossibleFault, known: Knowledge, data: Sequence[Reduced], nothing: float, count: int) -> FittedFault:
    """A part that has moved while the others are off by the share of their sigmas that makes this most probable.

    known, data: at any values of the rig. nothing: ln p(data) where no part has moved.
    """
    fits = []
    for others in _OTHERS:
        excess, X, log_density = replace(known, root=known.root * others).excess(data)
        change = excess.fit(fault.kind, fault.name, ChangeCandidate(X @ fault.directions, fault.prior_sigma))
        odds = 2 * (log_density - nothing) + change.evidence - 2 * float(np.log(count))
        fits.append(FittedFault(fault, change, odds))
    return max(fits, key=lambda fit: fit.log_odds)


def _scaled(fault: PossibleFault) -> Array:
    """(p, k): changes of one prior sigma each."""
    return np.asarray(fault.directions * fault.prior_sigma)


def difference(prior: Prior, values: Values) -> Array:
    """The prior values minus the given ones (p,)."""
    return np.concatenate(
        [known.minus(values[s].pick(np.array([i])))[0] for (s, i), known in zip(prior.at, prior.values, strict=True)]
    )


def possible_moves(rig: Rig, values: Values, prior: Prior, known: Knowledge) -> list[PossibleFault]:
    """Every camera, screen and beam as the one that has changed by more than its stated sigma."""
    model, place = SpotModel.of(rig), _places(prior.at, values)
    sigmas = np.sqrt(np.diagonal(known.covariance))
    screen_of = [rig.spots[s].screen for _, s in model.views]
    out = []
    for (stack, i), rows in place.items():
        if stack not in (CAMERAS, SCREENS, BEAMS):
            continue
        turn, move = _LARGER * np.median(sigmas[rows[3:]]), _LARGER * np.median(sigmas[rows[:3]])
        of = np.zeros((len(sigmas), 6 if stack == CAMERAS else 3 if stack == SCREENS else 4))
        if stack == CAMERAS:
            pose = list(rig.cameras.values())[i].camera_from_world
            # A turn about the camera's centre, as in model_check/faults.py; the shift is that of the centre.
            of[rows, :3] = np.concatenate([-skew(pose.translation), pose.rotation.T])
            of[rows[:3], 3:] = np.eye(3)
            centre = np.linalg.lstsq(of[rows], np.eye(6), rcond=None)[0]
            own = centre @ known.covariance[np.ix_(rows, rows)] @ centre.T
            turn, move = (_LARGER * np.sqrt(np.trace(own[k, k]) / 3) for k in (np.s_[:3], np.s_[3:]))
            sizes = np.repeat([max(turn, USUAL_SIZES.turn_rad), max(move, USUAL_SIZES.move_m)], 3)
            component, kind, name, views = CAMERA, MOVED, list(rig.cameras)[i], model.camera_of == i
        elif stack == SCREENS:
            of[rows[:3], 0] = list(rig.screens.values())[i].world_from_screen.rotation[:, 2]
            of[rows[3:5], 1:] = np.eye(2)
            sizes = np.repeat([max(move, USUAL_SIZES.move_m), max(turn, USUAL_SIZES.turn_rad)], (1, 2))
            component, kind, name = SCREEN, TILTED, list(rig.screens)[i]
            views = np.array([s == name for s in screen_of])
        else:
            of[rows] = np.eye(4)
            turn, move = (_LARGER * np.max(sigmas[rows[k]]) for k in (np.s_[:2], np.s_[2:]))
            sizes = np.repeat([max(turn, USUAL_SIZES.laser_rad), max(move, USUAL_SIZES.laser_m)], 2)
            component, kind, name, views = BEAM, LASER_MOVED, list(rig.beams)[i], model.beam_of == i
        if views.any():
            out.append(PossibleFault(component, name, kind, of, sizes, views))
    return out


def _places(at: Sequence[At], values: Values) -> dict[At, Ints]:
    """The positions of the numbers of each unknown in the vector of all."""
    out, start = {}, 0
    for a in at:
        out[a] = start + np.arange(values[a[0]].dof)
        start += values[a[0]].dof
    return out
