"""Refinement of a rig by recordings: its prior covariance and the spots of all frames, whose poses are free.

The recordings determine some directions of the rig's parameters well and others not at all: a motion of the whole rig,
or of all beams in the body, leaves no residual. What the rig file states decides those. All tests use the recordings
without their poses (calibration/rig/recordings.py): y = X delta + noise of sigma 1, with the prior delta ~ N(m, C).
Source: ours; priors in a bundle adjustment: Triggs et al. (2000), "Bundle adjustment: a modern synthesis", section 6.

Parts that have changed by more than is stated. Two questions are asked. What do the stated sigmas of all parts together
not explain, and which parts do (`search_faults`)? And: does one part alone explain everything, while all others are
where they are stated to be? Errors of several parts within their sigmas often add up to what one part does that has
moved by ten: a camera that is 5 mm off hides a screen that is 20 mm off. No test of size can see this. But that errors
of several parts imitate one moved part to a hundredth of their sigmas, in each of ten directions that recordings
determine, is a coincidence that they do not produce. Source: ours; the comparison of explanations by evidence: MacKay
(1992), "Bayesian interpolation", Neural Computation 4.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibration.changes import USUAL_SIZES, ChangeCandidate, ExcessResidual
from calibration.least_squares.adjustment import AdjustmentError, At, Limits, Prior, Values, places, solve
from calibration.model_check.fault_identification import (
    FittedFault,
    SuspectedFault,
    most_probable,
    search_faults,
)
from calibration.model_check.faults import (
    BEAM,
    CAMERA,
    LASER_MOVED,
    MOVED,
    SCREEN,
    TILTED,
    ZOOMED,
    PossibleFault,
    pixel_velocities,
)
from calibration.model_check.linearised_frames import (
    ModelCheckRecording,
    correlation_time,
    linearise,
)
from calibration.rig.recordings import STACKS, Knowledge, RecordingTerm, Reduced, normal_equations
from calibration.terms.rig_blocks import (
    BEAMS,
    CAMERAS,
    INTRINSICS,
    SCREENS,
    named_covariance,
    named_errors,
    names_at,
    prior_of,
    rig_of,
    stacks_of,
)
from geometry.arrays import Array, Bools, finite, skew
from geometry.forward_model import SpotModel
from geometry.rig import Rig
from geometry.uncertainty.chi_square import chi2_limit
from geometry.uncertainty.rig_uncertainty import RigCovariance, covariance_root, unlimited

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
        model, at = SpotModel.of(self.rig), places(self._at, self.values)
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
        own = places(terms[0].at, values)
        order = np.concatenate([own[a] for a in self._at])
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
    model = SpotModel.of(rig)
    sigmas = np.sqrt(np.diagonal(known.covariance))
    out = []
    for (stack, i), rows in places(prior.at, values).items():
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
            views = model.screen_of == i
        else:
            of[rows] = np.eye(4)
            turn, move = (_LARGER * np.max(sigmas[rows[k]]) for k in (np.s_[:2], np.s_[2:]))
            sizes = np.repeat([max(turn, USUAL_SIZES.laser_rad), max(move, USUAL_SIZES.laser_m)], 2)
            component, kind, name, views = BEAM, LASER_MOVED, list(rig.beams)[i], model.beam_of == i
        if views.any():
            out.append(PossibleFault(component, name, kind, of, sizes, views))
    return out


FEWEST_FRAMES = 30  # of a recording: a shorter one is not used
_FEWEST_AT_FIRST = 10  # of a first solution, which is for labels
FEWEST_SPOTS = 4  # of a frame: three spots leave nothing that the pose does not absorb
FOLDS = 5  # blocks of time of a single recording
_P_OUTLIER = 1e-5  # probability that a correct spot is excluded
_CURVED_FRAMES = 30  # of all recordings, which stand for all frames in errors of second order
_ROUNDS = 5  # of outliers and noise scales
# Where values are near the solution. With the usual 1e-4 each step reaches directions that are ten times weaker than
# those of the step before: seven steps in place of two. The prior keeps the normal matrix regular.
_NEAR = Limits(damping=1e-10)
_CONVERGED = 0.02  # relative change of a noise scale in one round below which it has converged


@dataclass(frozen=True, slots=True)
class HeldOut:
    """One recording, or block of time, against the rig as given and as refined from the others."""

    chi2: tuple[float, float]  # of the residuals
    dof: int
    p: float  # p-value of the data with the refined rig and its covariance
    log_density: tuple[float, float]  # of the data, with both rigs and their covariances


@dataclass(frozen=True, slots=True)
class Refinement:
    """A refined rig. Errors of its parameters (p,) are in the order of the unknowns `at`."""

    given: Rig
    rig: Rig
    covariance: RigCovariance
    at: tuple[At, ...]
    values: Values
    before: Knowledge  # of the errors of this result
    after: Knowledge
    recordings: tuple[ModelCheckRecording, ...]  # with the stated covariances, without outliers
    data: tuple[Reduced, ...]  # of each recording, or block of time, with increased covariances
    given_data: tuple[Reduced, ...]  # the same with the given rig
    excluded: int  # spots
    noise: Mapping[str, float]  # ratio of errors to stated sigmas, by camera; at least 1
    correlation_frames: float  # number of frames that count as one
    gain: Array  # (r,) information of the data over that of the prior, in principal directions; ascending
    directions: Array  # (p, r) these directions, as errors of one prior sigma
    p_change: float  # of the changes if the stated sigmas are right
    moved: tuple[SuspectedFault, ...]  # parts that have changed by more than that
    lens_sigmas: Mapping[str, float]  # of focal lengths of which nothing is stated, relative; by camera
    held_out: tuple[HeldOut, ...]
    held: tuple[str, ...]  # stacks of unknowns that were not to be changed

    @property
    def parts(self) -> tuple[str, ...]:
        """(p,): the part to which each unknown belongs, such as `cameras.left`."""
        return tuple(
            names_at(self.given, a)[0].rsplit(".", 1)[0] for a in self.at for _ in range(self.values[a[0]].dof)
        )

    @property
    def shares(self) -> Array:
        """(p, r): the share of each unknown in the squared length of each direction, in prior sigmas."""
        sigma = np.sqrt(np.maximum(np.diagonal(self.before.covariance), 1e-300))
        squares = (self.directions / sigma[:, None]) ** 2
        return np.asarray(squares / squares.sum(axis=0))

    @property
    def conventions(self) -> int:
        """Directions that no recording determines: the frames of world and body, where all their parts are free."""
        world = all((s, i) in self.at for s in (CAMERAS, SCREENS) for i in range(len(self.values[s])))
        body = all((BEAMS, i) in self.at for i in range(len(self.values[BEAMS])))
        return 6 * world + 6 * body

    def named_changes(self) -> dict[str, float]:
        """The change of each number of the rig, by its name."""
        old, new = stacks_of(self.given), stacks_of(self.rig)
        steps = [new[s].minus(old[s])[i] for s, i in self.at]
        names, T = named_errors(self.given, old, self.at)
        return dict(zip(names, (T @ np.concatenate(steps)).tolist(), strict=True))

    def of_data(self, i: int) -> ModelCheckRecording:
        """The spots of `data[i]`."""
        return self.recordings[i] if len(self.recordings) > 1 else _blocks(self.recordings[0])[i]


def refine(
    rig: Rig,
    covariance: RigCovariance,
    recordings: Sequence[ModelCheckRecording],
    start: Refinement | None = None,
    stacks: Collection[str] = STACKS,
    for_labels: bool = False,
) -> Refinement:
    """Refine a rig.

    covariance: of the rig's parameters; all others are held. recordings: with the views of this rig. start: an earlier
    result, of other labels of the same recordings; only then are parts that have moved searched for. stacks: those that
    are changed; the others keep their values and their uncertainty. for_labels: the rig is only used to label the
    recordings again; errors of second order, which spots do not show beside the tracker's own limits, are left out.
    Raises AdjustmentError: the recordings have too few frames, or the adjustment does not converge.
    """
    prior, free = prior_of(rig, covariance)
    if prior is None:
        raise AdjustmentError("no parameter of the rig has a covariance")
    values: Values = stacks_of(rig) if start is None else start.values
    model = unlimited(SpotModel.of(rig_of(rig, values)))
    fewest = FEWEST_FRAMES if start is not None else _FEWEST_AT_FIRST
    stated = [r for r in (_usable(model, r) for r in recordings) if len(r.seen) >= fewest]
    if not stated:
        raise AdjustmentError(
            f"no recording has {fewest} frames with {FEWEST_SPOTS} and more spots that determine a pose; with more"
            " spots in the pictures, smaller sigmas of the rig or a narrower first pose more points can get a label"
        )
    noise, excluded = np.ones(len(rig.cameras)), 0
    limits = Limits() if start is None else _NEAR
    for _ in range(_ROUNDS):
        wider = noise[model.camera_of][:, None, None] ** 2
        terms = [RecordingTerm(rig, replace(r, cov_px2=r.cov_px2 * wider), free) for r in stated]
        values, limits = solve(values, [prior, *terms], free, limits).values, _NEAR
        reduced = [t.reduced(values) for t in terms]
        wrong = [_outliers(d) for d in reduced]
        count = sum(int(w.sum()) for w in wrong)
        excluded += count
        stated = [replace(r, seen=r.seen & ~w) for r, w in zip(stated, wrong, strict=True)]
        before, noise = noise, np.maximum(noise * _noise_of_cameras(model, reduced), 1.0)
        if not count and np.all(np.abs(noise / before - 1) < _CONVERGED):
            break
    left = (np.where(d.lin.used[..., None], d.left, np.nan).reshape(len(d.left), -1) for d in reduced)
    frames = max(map(correlation_time, left))  # that count as one, the largest number of any recording
    blocks = stated if len(stated) > 1 else _blocks(stated[0])
    wider = frames * noise[model.camera_of][:, None, None] ** 2
    terms = [RecordingTerm(rig, replace(r, cov_px2=r.cov_px2 * wider), free) for r in blocks]
    values = solve(values, [prior, *terms], free, limits).values
    data = [t.reduced(values) for t in terms]
    if not any(d.dof > 0 for d in data):
        raise AdjustmentError("so many spots are outliers that the others only determine the poses")
    known = Knowledge(difference(prior, values), covariance_root(prior.covariance))
    changed = np.concatenate([np.full(values[s].dof, s in stacks) for s, _ in prior.at])
    after = known.with_data(data, changed)
    given_data = [] if for_labels else [t.reduced(stacks_of(rig)) for t in terms]
    S, _ = normal_equations(data)
    gain, vectors = np.linalg.eigh(known.root.T @ S @ known.root)
    directions = known.root @ vectors
    if not for_labels:
        after = _with_curvature(after, known, terms, values, changed)
    moved, lenses = ((), {}) if start is None else MovedParts(rig, prior, terms, free, values, known).found()
    return Refinement(
        given=rig,
        rig=rig_of(rig, {s: v for s, v in values.items() if s in stacks}),
        covariance=named_covariance(rig, values, prior.at, after.covariance),
        at=prior.at,
        values=values,
        before=known,
        after=after,
        recordings=tuple(stated),
        data=tuple(data),
        given_data=tuple(given_data),
        excluded=excluded,
        noise=dict(zip(rig.cameras, noise.tolist(), strict=True)),
        correlation_frames=frames,
        gain=np.maximum(gain, 0.0),
        directions=directions,
        p_change=known.excess(data)[0].p_value,
        moved=moved,
        lens_sigmas=lenses,
        held_out=() if for_labels else _held_out(known, data, given_data, changed),
        held=tuple(dict.fromkeys(s for s, _ in prior.at if s not in stacks)),
    )


# Motions about the middle of a recording that would show more: along the axes of world, and about those of the body.
MOTIONS = ("x", "y", "z", "roll", "pitch", "yaw")
_SHIFT_M, _TURN_RAD = 0.2, float(np.deg2rad(10.0))  # to both sides, or half, a quarter ... of it while spots are lost
_MOTION_FRAMES, _HALVINGS = 41, 4


def further_motions(r: Refinement, free: Mapping[str, Bools]) -> dict[str, tuple[float, Array]]:
    """What as many frames again would determine, by one of MOTIONS: its size, m or rad, and the sigmas (r,) afterwards.

    The sigmas are those of the directions, in prior sigmas. free: as of `prior_of`. Empty where no spots would be left.
    """
    model, poses, used = SpotModel.of(r.rig), r.data[0].lin.poses, r.data[0].lin.used
    middle, coefficients = poses[len(poses.translation) // 2], np.linalg.pinv(r.directions)
    usual = np.median(r.of_data(0).cov_px2[used], axis=0)
    noise = np.array([r.noise[name] for name in model.camera_names])[model.camera_of]
    count = sum(len(recording.seen) for recording in r.recordings) / r.correlation_frames
    cov = usual * noise[:, None, None] ** 2 * (_MOTION_FRAMES / count)
    t_s = np.linspace(0.0, 1.0, _MOTION_FRAMES)  # to one side, to the other and back: speeds that show clocks
    out = {}
    for axis, name in enumerate(MOTIONS):
        for halved in range(_HALVINGS + 1):
            step = np.zeros((_MOTION_FRAMES, 6))
            size = (_SHIFT_M if axis < 3 else _TURN_RAD) / 2**halved
            step[:, axis] = size * np.sin(2 * np.pi * t_s)
            moved = middle.plus(step)
            uv = model.project(moved)[0]
            seen = model.in_picture(uv) & finite(uv, -1)
            if np.all(seen.sum(axis=1) >= FEWEST_SPOTS):
                every = np.broadcast_to(cov, (*seen.shape, 2, 2))
                recording = ModelCheckRecording(t_s, seen, uv, every, moved)
                velocity = pixel_velocities(model, recording, np.arange(_MOTION_FRAMES))
                recording = replace(recording, velocity_px_s=velocity, clock_s=np.zeros((len(model), 2)))
                known = r.after.with_data([RecordingTerm(r.given, recording, free).reduced(r.values)])
                out[name] = size, np.sqrt(np.diagonal(coefficients @ known.covariance @ coefficients.T))
                break
    return out


def _usable(model: SpotModel, recording: ModelCheckRecording) -> ModelCheckRecording:
    """The frames of a recording that determine their poses and check their spots, without gross outliers."""
    lin = linearise(model, recording, np.arange(len(recording.seen)))
    rows = np.flatnonzero((lin.used.sum(axis=1) >= FEWEST_SPOTS) & (lin.rank == 6))
    return replace(recording, seen=lin.used, poses=lin.poses).at(rows)


def _blocks(recording: ModelCheckRecording) -> list[ModelCheckRecording]:
    """A recording as blocks of time, each with the views of all."""
    rows = np.arange(len(recording.seen))
    return [recording.at(some) for some in np.array_split(rows, min(FOLDS, len(rows) // FEWEST_FRAMES) or 1)]


def _outliers(d: Reduced) -> Bools:
    """(K, n): the worst spot of each frame, if it is an outlier against the frame's other spots."""
    weights = d.lin.inverse_redundancy()
    z2 = np.nan_to_num(np.sum(d.left * (weights @ d.left[..., None])[..., 0], axis=-1))
    worst = np.zeros_like(d.lin.used)
    worst[np.arange(len(worst)), z2.argmax(axis=1)] = True
    return np.asarray(worst & (z2 > chi2_limit(_P_OUTLIER, 2)))


def _noise_of_cameras(model: SpotModel, data: Sequence[Reduced]) -> Array:
    """Errors over sigmas (cameras,); 1 where nothing checks a camera's spots."""
    squares = sum(np.sum(d.left**2, axis=(0, 2)) for d in data)
    redundancy = sum(np.einsum("knii->n", d.lin.redundancy()) for d in data)
    out = np.ones(len(model.camera_names))
    for c in range(len(out)):
        total = float(np.sum(redundancy[model.camera_of == c]))
        if total > FEWEST_FRAMES:
            out[c] = np.sqrt(np.sum(squares[model.camera_of == c]) / total)
    return out


def _with_curvature(
    after: Knowledge, known: Knowledge, terms: Sequence[RecordingTerm], values: Values, changed: Bools
) -> Knowledge:
    """What is known with the errors of second order, which uncertain directions cause in well determined ones.

    The residuals of an error e are X e + H(e, e) / 2. The estimate takes the second part for an error of first order,
    P X^T H(e, e) / 2 with the covariance P: with errors of 3 mrad, and two of three cameras on one screen, directions
    known to 1/200 of the prior were off by 8.5 sigmas. H is from differences of X over one sigma, of some frames that
    stand for all. Its variances are increased such that three sigmas include what an error of three sigmas causes,
    9/4 H^2, since squares of normal errors have long tails (their mean square is 3/4 H^2).
    """
    few = [t.thinned(_CURVED_FRAMES // len(terms)) for t in terms]

    def slopes(v: Values) -> Array:
        return np.concatenate([t.slopes(v, values)[1] for t in few])

    X, root = slopes(values), known.with_data([t.reduced(values) for t in few]).root
    gain = np.where(changed[:, None], root @ root.T, 0.0) @ X.T
    H = np.stack([gain @ (slopes(terms[0].moved(values, e)) - X) @ after.root for e in after.root.T], axis=1)
    H = 3 / 4 * (H + np.swapaxes(H, 1, 2)).reshape(len(H), -1)
    u, size, _ = np.linalg.svd(np.concatenate([after.root, covariance_root(H @ H.T)], axis=1), full_matrices=False)
    return Knowledge(after.mean, (u * size)[:, : known.root.shape[1]])


def _held_out(
    known: Knowledge, data: Sequence[Reduced], given: Sequence[Reduced], changed: Bools
) -> tuple[HeldOut, ...]:
    """Each recording predicted from the others. given: the same at the rig as given. changed (p,)."""
    out = []
    for i, d in enumerate(data):
        others = [o for k, o in enumerate(data) if k != i]
        if not others:
            continue
        fold = known.with_data(others, changed)
        excess, _, log_density = fold.excess([d])
        refined = d.rest + float(np.sum((d.y - d.X @ fold.mean) ** 2))
        before = given[i].rest + float(given[i].y @ given[i].y)
        out.append(HeldOut((before, refined), d.dof, excess.p_value, (known.excess([d])[2], log_density)))
    return tuple(out)
