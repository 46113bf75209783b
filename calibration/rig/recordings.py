"""A recording as a term of an adjustment of the rig, whose poses are free and eliminated; what is known of the rig.

For given values of the rig, each frame has its least-squares pose, and residuals and derivatives are projected onto
what the poses cannot absorb: the Schur complement, frame by frame (variable projection: Golub and Pereyra 1973,
SIAM J. Numer. Anal. 10). What is left of a whole recording are as many numbers as it determines directions of the rig.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from calibration.changes import ExcessResidual
from calibration.least_squares.adjustment import At, Linearised, Loss, Part, Values, places
from calibration.model_check.fault_identification import compressed
from calibration.model_check.linearised_frames import (
    LinearisedFrames,
    ModelCheckRecording,
    clock_derivatives,
    linearised_at,
    whitening,
    with_clocks,
)
from calibration.terms.rig_blocks import (
    BEAMS,
    BOWS,
    CAMERAS,
    INTRINSICS,
    OFFSETS,
    ROW_TIMES,
    SCREENS,
    lines_in,
    rig_of,
)
from calibration.terms.surveyed import array_of
from geometry.arrays import Array, Bools, Ints, evenly_spaced, finite
from geometry.forward_model import SpotModel
from geometry.rig import Rig
from geometry.uncertainty.rig_uncertainty import unlimited


@dataclass(frozen=True, slots=True)
class Knowledge:
    """What is known of p errors delta: a mean and a covariance L L^T."""

    mean: Array  # (p,)
    root: Array  # (p, r)

    @property
    def covariance(self) -> Array:
        """(p, p)"""
        return np.asarray(self.root @ self.root.T)

    def with_data(self, data: Sequence[Reduced], changed: Bools | None = None) -> Knowledge:
        """After some recordings.

        changed (p,): the numbers that are changed; the others keep their mean and stay uncertain (Schmidt 1966,
        "Application of state-space methods to navigation problems"). None: all.
        """
        S, g = normal_equations(data)
        values, vectors = np.linalg.eigh(np.eye(self.root.shape[1]) + self.root.T @ S @ self.root)
        root = self.root @ (vectors / np.sqrt(values))
        step = root @ (root.T @ (g - S @ self.mean))
        if changed is None or changed.all():
            return Knowledge(self.mean + step, root)
        gain = np.where(changed[:, None], root @ root.T, 0.0)
        own = self.root - gain @ S @ self.root
        return Knowledge(
            self.mean + np.where(changed, step, 0.0), np.concatenate([own, gain @ compressed(S)[0].T], axis=1)
        )

    def excess(self, data: Sequence[Reduced]) -> tuple[ExcessResidual, Array, float]:
        """What this does not explain of some recordings, the whitened X (q, p) that belongs to it, and ln p(data)."""
        X, y = np.concatenate([d.X for d in data]), np.concatenate([d.y for d in data])
        spread = X @ self.root
        factor = np.linalg.cholesky(np.eye(len(y)) + spread @ spread.T)
        white = np.linalg.solve(factor, y - X @ self.mean)
        chi2 = float(white @ white) + sum(d.rest for d in data)
        log_density = -0.5 * chi2 - float(np.sum(np.log(np.diagonal(factor))))
        return ExcessResidual.of_white(white), np.linalg.solve(factor, X), log_density

    def log_density(self, data: Sequence[Reduced]) -> float:
        """ln p of some recordings, up to a constant that is the same for all knowledge and values of the rig."""
        return self.excess(data)[2]


def normal_equations(data: Sequence[Reduced]) -> tuple[Array, Array]:
    """X^T X (p, p) and X^T y (p,) of some recordings."""
    return np.sum([d.X.T @ d.X for d in data], axis=0), np.sum([d.X.T @ d.y for d in data], axis=0)


STACKS = (INTRINSICS, CAMERAS, SCREENS, BOWS, BEAMS, OFFSETS, ROW_TIMES)
_POSE_STEPS = 3  # Gauss-Newton steps of the poses: from 5 mrad and 10 mm the second one is shorter than 1e-6
_LAST_STEP = 1e-6  # m, rad: the next one, which is about the square, is below rounding
_LARGEST_STEP = np.array([0.3] * 3 + [0.2] * 3)  # m, rad: a pose that would move farther is not determined


@dataclass(frozen=True, slots=True)
class Reduced:
    """A recording without its poses: y = X delta + noise of sigma 1, where delta are the errors of the unknowns."""

    X: Array  # (q, p)
    y: Array  # (q,) measured minus predicted
    rest: float  # chi-square of the residuals that no change of the unknowns explains
    dof: int  # number of residuals minus that of the poses' parameters
    lin: LinearisedFrames  # at the poses that fit the rig best
    left: Array  # (K, n, 2) whitened residuals, measured minus predicted


@dataclass(frozen=True, slots=True)
class RecordingTerm:
    """The spots of a recording, in sigmas, with free poses.

    The stacks are those of rig_blocks.py in the rig's order. Screens are unlimited: a measured spot did hit its screen.
    """

    rig: Rig  # for what the stacks do not contain
    recording: ModelCheckRecording  # K frames, of which each determines its pose
    free: Mapping[str, Bools]  # per stack (k, dof): the numbers that are unknown
    at: tuple[At, ...] = field(init=False)  # the unknowns of which some number is free: p numbers in total
    loss: Loss | None = None
    _last: list[tuple[Values, Reduced]] = field(init=False, repr=False, compare=False, default_factory=list)

    def __post_init__(self) -> None:
        at = [(s, int(i)) for s in STACKS if s in self.free for i in np.flatnonzero(self.free[s].any(axis=1))]
        object.__setattr__(self, "at", tuple(at))

    def linearise(self, values: Values) -> Linearised:
        """One residual of q + 1 numbers; nan where a measured spot cannot be predicted."""
        reduced = self.reduced(values)
        lost = reduced.lin.used.sum() < self.recording.usable.sum()
        residual = np.append(-reduced.y, np.sqrt(reduced.rest))
        slopes = np.append(reduced.X, np.zeros((1, reduced.X.shape[1])), axis=0)
        parts = [Part(s, np.array([i]), slopes[None, :, own]) for (s, i), own in places(self.at, values).items()]
        return Linearised(np.full_like(residual, np.nan)[None] if lost else residual[None], parts)

    def reduced(self, values: Values) -> Reduced:
        """The recording at these values of the rig, without its poses. Of the last values it is kept."""
        if self._last and self._last[0][0] is values:
            return self._last[0][1]
        lin, flat = self.slopes(values, values)
        left = lin.residual_part(lin.residual)
        X, V = compressed(flat.T @ flat)
        y = V @ (flat.T @ left.ravel())
        rest = max(float(left.ravel() @ left.ravel() - y @ y), 0.0)
        self._last[:] = [(values, Reduced(X, y, rest, lin.dof, lin, left))]
        return self._last[0][1]

    def thinned(self, most: int) -> RecordingTerm:
        """At most so many of the frames, at least six, with covariances as if they were all."""
        rows = evenly_spaced(np.arange(len(self.recording.seen)), max(most, 6))
        some = self.recording.at(rows)
        share = len(rows) / len(self.recording.seen)
        return replace(self, recording=replace(some, cov_px2=some.cov_px2 * share))

    def moved(self, values: Values, errors: Array) -> Values:
        """The values with these errors (p,) of the unknowns."""
        steps = {s: np.zeros((len(values[s]), values[s].dof)) for s, _ in self.at}
        for (stack, i), own in places(self.at, values).items():
            steps[stack][i] = errors[own]
        return {**values, **{s: values[s].plus(step) for s, step in steps.items()}}

    def slopes(self, values: Values, about: Values) -> tuple[LinearisedFrames, Array]:
        """The recording at these values, and its derivatives (K n 2, p) without what the poses absorb, whitened.

        about: the values to whose errors the derivatives belong.
        """
        model = unlimited(SpotModel.of(rig_of(self.rig, values)))
        clocks = np.concatenate([array_of(values, s) for s in (OFFSETS, ROW_TIMES)], axis=1)[model.camera_of]
        lin = with_own_poses(model, with_clocks(model, self.recording, clocks))
        free = lin.residual_part(lin.W @ self._derivatives(model, lin, about))
        return lin, free.reshape(-1, free.shape[-1])

    def _derivatives(self, model: SpotModel, lin: LinearisedFrames, values: Values) -> Array:
        """d(pixels)/d(unknowns) (K, n, 2, p); 0 for spots that are not used, and for numbers that are not free."""
        d = model.derivatives(lin.poses, of_lens=any(stack == INTRINSICS for stack, _ in self.at))
        B = lines_in(values).basis[model.beam_of]
        of: dict[str, tuple[Array, Ints]] = {
            INTRINSICS: (np.concatenate([d.pinhole, d.distortion], axis=-1), model.camera_of),
            CAMERAS: (d.camera, model.camera_of),
            SCREENS: (d.screen, model.screen_of),
            BOWS: (d.bow, model.screen_of),
            BEAMS: (np.concatenate([d.direction @ B, d.point @ B], axis=-1), model.beam_of),
        }
        if self.recording.velocity_px_s is not None:
            by_clock = clock_derivatives(model, self.recording.uv_px, self.recording.velocity_px_s)
            of |= {s: (by_clock[..., i : i + 1], model.camera_of) for i, s in enumerate((OFFSETS, ROW_TIMES))}
        used: Bools = np.asarray(lin.used[..., None, None])
        out = np.zeros((*lin.used.shape, 2, sum(values[s].dof for s, _ in self.at)))
        for (stack, i), own in places(self.at, values).items():
            if stack in of:  # not a clock without a motion that shows it
                block, element_of = of[stack]
                views = np.flatnonzero(element_of == i)
                part = np.where(used[:, views], block[:, views], 0.0) * self.free[stack][i]
                out[:, views, :, own[0] : own[-1] + 1] = part
        return out


def with_own_poses(model: SpotModel, recording: ModelCheckRecording) -> LinearisedFrames:
    """All frames of a recording, linearised at the poses that fit this model best."""
    used = recording.usable
    none, frames = np.zeros_like(used), np.arange(len(used))
    known = finite(recording.poses.translation, -1)
    poses = replace(
        recording.poses,
        rotation=np.where(known[:, None, None], recording.poses.rotation, np.eye(3)),
        translation=np.where(known[:, None], recording.poses.translation, 0.0),
    )
    W = whitening(recording.cov_px2, used)
    for _ in range(_POSE_STEPS):
        lin = linearised_at(model, frames, poses, used, none, recording.uv_px, W)
        step = lin.pose_shift(lin.residual)
        step = np.where(np.all(np.abs(step) < _LARGEST_STEP, axis=-1, keepdims=True), step, 0.0)
        poses = poses.plus(step)
        if np.all(np.abs(step) < _LAST_STEP):
            break
    return linearised_at(model, frames, poses, used, none, recording.uv_px, W)
