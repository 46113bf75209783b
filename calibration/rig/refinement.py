"""Refinement of a rig by recordings: its prior covariance and the spots of all frames, whose poses are free.

The recordings determine some directions of the rig's parameters well and others not at all: a motion of the whole rig,
or of all beams in the body, leaves no residual. What the rig file states decides those. All tests use the recordings
without their poses (calibration/rig/recordings.py): y = X delta + noise of sigma 1, with the prior delta ~ N(m, C).
Source: ours; priors in a bundle adjustment: Triggs et al. (2000), "Bundle adjustment: a modern synthesis", section 6.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibration.least_squares.adjustment import AdjustmentError, At, Limits, Values, solve
from calibration.model_check.fault_identification import SuspectedFault
from calibration.model_check.faults import pixel_velocities
from calibration.model_check.linearised_frames import (
    ModelCheckRecording,
    correlation_time,
    linearise,
)
from calibration.rig.knowledge import Knowledge, normal_equations
from calibration.rig.moved_parts import MovedParts, difference
from calibration.rig.recordings import STACKS, RecordingTerm, Reduced
from calibration.terms.rig_blocks import BEAMS, CAMERAS, SCREENS, named_errors, names_at, prior_of, rig_of, stacks_of
from geometry.arrays import Array, Bools, finite
from geometry.forward_model import SpotModel
from geometry.rig import Rig
from geometry.uncertainty.chi_square import chi2_limit
from geometry.uncertainty.rig_uncertainty import RigCovariance, covariance_root, unlimited

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
        steps = [new[s].pick(np.array([i])).minus(old[s].pick(np.array([i])))[0] for s, i in self.at]
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
            f"no recording has {fewest} frames with {FEWEST_SPOTS} and more spots that determine a pose"
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
    frames = _correlation(reduced)
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
    given_data = [t.reduced(stacks_of(rig)) for t in terms]
    S, _ = normal_equations(data)
    gain, vectors = np.linalg.eigh(known.root.T @ S @ known.root)
    names, T = named_errors(rig, values, prior.at)
    directions = known.root @ vectors
    if not for_labels:
        after = _with_curvature(after, known, terms, values, changed)
    matrix = T @ after.covariance @ T.T
    named = np.diagonal(matrix) > 0
    moved, lenses = ((), {}) if start is None else MovedParts(rig, prior, terms, free, values, known).found()
    return Refinement(
        given=rig,
        rig=rig_of(rig, {s: v for s, v in values.items() if s in stacks}),
        covariance=RigCovariance(tuple(np.array(names)[named].tolist()), matrix[np.ix_(named, named)]),
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
        held_out=_held_out(known, data, given_data, changed),
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


def _correlation(data: Sequence[Reduced]) -> float:
    """Largest number of frames, of any recording, that count as one."""
    return max(correlation_time(np.where(d.lin.used[..., None], d.left, np.nan).reshape(len(d.left), -1)) for d in data)


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
