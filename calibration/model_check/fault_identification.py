"""The fault that explains the residuals of a recording: significance, noise of the cameras, effect on the poses.

The recording is reduced to normal equations over all parameters that may be wrong, with the poses of all frames
eliminated. They are equivalent to a few uncorrelated pixels y = X theta + noise, one per observable direction of theta;
`ExcessResidual` (calibration/changes.py) computes evidence, size and significance from these. The
calibration's own covariance is part of the noise: a deviation that it allows is no fault.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibration.changes import Change, ChangeCandidate, ExcessResidual
from calibration.model_check.faults import CAMERA, MOVED, PIXEL_OFFSET, VIEW, FaultParameters, PossibleFault
from calibration.model_check.linearised_frames import LinearisedFrames, ModelCheckRecording, correlation_time, linearise
from geometry.arrays import Array
from geometry.forward_model import SpotModel

P_FALSE_ALARM = 1e-6  # probability that a recording of a correct rig leads to any suspected fault, over all candidates
DECISIVE = 12.0  # difference of 2 ln(evidence), a factor of 400, at which the less probable fault is ruled out
# After linearisation a large fault explains its residuals only up to about this share of their chi-square: a smaller
# difference neither distinguishes two faults nor counts as a second fault. Measured: a camera 10 ms late (46 sigma)
# leaves 0.02 % of 2.6e6.
LINEARISATION_SHARE = 0.005
MOST_FAULTS = 3  # reported at once: where more seem wrong, the whole rig needs a calibration
MOST_ALTERNATIVES = 2  # reported beside the best
_LEAST_REDUNDANCY = 10.0  # degrees of freedom of a view: with fewer its noise is unknown
CORRELATED_FRAMES = 2.0  # correlation time from which errors count as correlated: white noise gives 1.0 to 1.2
_OBSERVABLE = 1e-10  # of the largest eigenvalue: smaller ones are rounding errors


@dataclass(frozen=True, slots=True)
class FittedFault:
    """A fault that was fitted to a recording."""

    fault: PossibleFault
    change: Change
    log_odds: float  # 2 ln of the posterior odds against "no fault", each component of a type being equally probable


@dataclass(frozen=True, slots=True)
class SuspectedFault:
    """The best explanation of the residuals, and the best fault of each other component that is as probable."""

    best: FittedFault
    alternatives: tuple[FittedFault, ...]
    more_alternatives: int  # number of those not listed

    @property
    def explanations(self) -> tuple[FittedFault, ...]:
        """The best one, then the alternatives."""
        return (self.best, *self.alternatives)


@dataclass(frozen=True, slots=True)
class FaultDiagnosis:
    """The suspected faults of a recording, and the tests behind them."""

    suspected_faults: tuple[SuspectedFault, ...]
    p_before: float  # p-value of the residuals under "no fault"
    p_after: float  # p-value of what the suspected faults leave
    residual_scale: float  # root of the reduced chi-square of all residuals: 1 if rig and sigmas are correct
    noise_scale: float  # the same of what no constant fault explains: errors over stated sigmas
    correlation_frames: float  # number of the used frames that count as one independent frame
    unexplained: bool  # whether a significant residual remains
    noise_of_views: Array  # (n,) noise_scale of each view; nan where it was not seen, or the poses absorb it

    @property
    def excess_noise(self) -> float:
        """The noise scale, at least 1."""
        return max(self.noise_scale, 1.0) if np.isfinite(self.noise_scale) else 1.0

    @property
    def is_correlated(self) -> bool:
        """Whether what no constant fault explains is correlated over several frames, unlike noise."""
        return self.correlation_frames > CORRELATED_FRAMES

    @property
    def is_random(self) -> bool:
        """Whether the rig explains all but random errors, however large."""
        return not (self.suspected_faults or self.unexplained or self.is_correlated)


def diagnose(
    lin: LinearisedFrames, jacobian: Array, covariance: Array, faults: Sequence[PossibleFault]
) -> FaultDiagnosis:
    """Diagnose K frames. jacobian (K, n, 2, p), whitened; covariance (p, p) of the parameters as stated."""
    free = lin.residual_part(jacobian)
    flat = free.reshape(-1, free.shape[-1])
    left = lin.residual_part(lin.residual)
    r = left.ravel()
    X, V = compressed(flat.T @ flat)
    y = V @ (flat.T @ r)
    fitted = (flat @ (V.T @ y)).reshape(left.shape)
    dof = lin.dof
    rest_dof = dof - len(y)
    chi2 = float(r @ r)
    noise_variance = float(np.sum((left - fitted) ** 2)) / rest_dof if rest_dof > 0 else 1.0
    series = np.where(lin.used[..., None], left - fitted, np.nan).reshape(len(left), -1)
    correlation_frames = correlation_time(series)
    redundancy = np.einsum("knii->n", lin.redundancy())
    own = redundancy * rest_dof / dof if rest_dof > 0 else np.zeros(lin.used.shape[1])
    squares = np.sum((left - fitted) ** 2, axis=(0, 2))
    enough = own > _LEAST_REDUNDANCY
    noise_of_views = np.where(enough, np.sqrt(squares / np.where(enough, own, 1.0)), np.nan)
    # Sigmas that are stated too small and correlated errors widen the noise; a noise scale below 1 is not applied.
    variance = max(noise_variance, 1.0) * correlation_frames
    root = np.linalg.cholesky(variance * np.eye(len(y)) + X @ covariance @ X.T)
    # Whitened once for all faults: the many small solves dominate the run time where BLAS runs in threads.
    start = ExcessResidual.of_white(np.linalg.solve(root, y))
    suspected, after = search_faults(start, np.linalg.solve(root, X), faults)
    return FaultDiagnosis(
        suspected_faults=suspected,
        p_before=start.p_value,
        p_after=after.p_value,
        residual_scale=float(np.sqrt(chi2 / dof)) if dof > 0 else float("nan"),
        noise_scale=float(np.sqrt(noise_variance)),
        correlation_frames=correlation_frames,
        noise_of_views=noise_of_views,
        unexplained=after.p_value < P_FALSE_ALARM and after.chi2 - after.dof > LINEARISATION_SHARE * start.chi2,
    )


def compressed(N: Array) -> tuple[Array, Array]:
    """X (q, p) with X^T X = N (p, p), and V (q, p) with V N = X, where q is the number of observable directions."""
    scale = np.sqrt(np.maximum(np.diagonal(N), 0.0))
    safe = np.where(scale > 0, scale, 1.0)
    values, vectors = np.linalg.eigh(N / np.outer(safe, safe))
    seen = values > _OBSERVABLE * max(float(values[-1]), 1e-300)
    root = np.sqrt(values[seen])[:, None]
    return root * vectors[:, seen].T * scale, vectors[:, seen].T / root / safe


def search_faults(
    start: ExcessResidual, X: Array, faults: Sequence[PossibleFault]
) -> tuple[tuple[SuspectedFault, ...], ExcessResidual]:
    """Adds suspected faults one by one. Returns them and the residual that they leave."""
    found: list[SuspectedFault] = []
    left = start
    while len(found) < MOST_FAULTS:
        more = _best(left, X, faults, found)
        if more is None or more.best.change.explained < LINEARISATION_SHARE * start.chi2:
            break
        found = [*found, more]
        if len(found) > 1:  # each is chosen again with the others free: they were unknown when it was chosen
            for i in range(len(found)):
                others = found[:i] + found[i + 1 :]
                again = _best(start.without(c.best.change for c in others), X, faults, others)
                found[i] = found[i] if again is None else again
        left = start.without(c.best.change for c in found)
    found.sort(key=lambda c: -c.best.log_odds)
    return tuple(found), left


def _best(
    left: ExcessResidual, X: Array, faults: Sequence[PossibleFault], known: Sequence[SuspectedFault]
) -> SuspectedFault | None:
    """The best significant explanation with its alternatives; None where none is significant."""
    taken = {_component(c.best.fault) for c in known}
    fitted = []
    for fault in faults:
        if _component(fault) in taken:
            continue
        change = left.fit(fault.kind, fault.name, ChangeCandidate(X @ fault.directions, fault.prior_sigma))
        alike = len({f.name for f in faults if f.component == fault.component})
        fitted.append(FittedFault(fault, change, change.evidence - 2 * float(np.log(alike))))
    return most_probable([e for e in fitted if e.log_odds > 0 and e.change.p_value < P_FALSE_ALARM / len(faults)])


def most_probable(significant: Sequence[FittedFault]) -> SuspectedFault | None:
    """The most probable of some explanations, with those of other components that are as probable; None of none."""
    if not significant:
        return None
    ranked = sorted(significant, key=lambda e: -e.log_odds)
    margin = max(DECISIVE, LINEARISATION_SHARE * ranked[0].log_odds)
    close = [e for e in ranked if e.log_odds > ranked[0].log_odds - margin]
    # A pixel offset is a symptom: a component that explains it as well is the cause.
    close.sort(key=lambda e: e.fault.kind == PIXEL_OFFSET)
    best_of_component: dict[tuple[str, str], FittedFault] = {}
    for e in close:
        best_of_component.setdefault(_component(e.fault), e)
    best, *others = best_of_component.values()
    others = [e for e in others if e.fault.component != VIEW or best.fault.component == VIEW]
    return SuspectedFault(best, tuple(others[:MOST_ALTERNATIVES]), max(len(others) - MOST_ALTERNATIVES, 0))


def _component(fault: PossibleFault) -> tuple[str, str]:
    return fault.component, fault.name


NOISY = 1.5  # noise scale from which it is reported; the limit of lab/runs/verdict/quality.py
UNEVEN = 1.5  # ratio of the cameras' largest to smallest noise scale from which each is reported
# Share of the squared residual scale that linearisation may leave of a fault in one camera. Measured: a camera 10 and
# 30 ms late in a motion with sharp turns leaves 0.5 and 0.9 %.
_LINEARISATION_SHARE = 0.02
_MOST_ITERATIONS, _CONVERGED = 5, 1.1  # converged: no noise scale changes by more than this factor


@dataclass(frozen=True, slots=True)
class WeightedDiagnosis:
    """A diagnosis with covariances that are scaled by the noise of each camera."""

    diagnosis: FaultDiagnosis
    lin: LinearisedFrames
    jacobian: Array  # (K, n, 2, p), whitened
    noise_of_cameras: tuple[float, ...]  # at least 1, in the order of SpotModel.camera_names
    stated_residual_scale: float  # residual scale under the covariances as stated


def is_noisy(noise_scale: float, residual_scale: float) -> bool:
    """Whether errors are so much larger than stated that it is reported.

    residual_scale includes all faults: linearisation leaves some of a large fault as apparent noise of one camera.
    """
    return noise_scale > NOISY and noise_scale**2 - 1 > _LINEARISATION_SHARE * residual_scale**2


def diagnose_with_noise_of_cameras(
    parameters: FaultParameters,
    recording: ModelCheckRecording,
    lin: LinearisedFrames,
    jacobian: Array,
    faults: Sequence[PossibleFault],
) -> WeightedDiagnosis:
    """Diagnose linearised frames, with one noise scale per camera where these differ much. jacobian: of `lin`.

    Sigmas that are wrong by different factors would invalidate all tests, which weight by them. The factors are
    variance components (Helmert): estimated, applied, and estimated again until they converge.
    """
    model = parameters.model
    diagnosis = diagnose(lin, jacobian, parameters.covariance, faults)
    factor = [max(f, 1.0) for f in _noise_of_cameras(diagnosis, model)]
    stated = diagnosis.residual_scale
    uneven = max(factor) > UNEVEN * min(factor) and is_noisy(max(factor), stated)
    for _ in range(_MOST_ITERATIONS if uneven else 0):
        wider = np.array(factor)[model.camera_of][:, None, None] ** 2
        lin = linearise(model, replace(recording, cov_px2=recording.cov_px2 * wider), lin.frames)
        jacobian = parameters.jacobian(recording, lin)
        diagnosis = diagnose(lin, jacobian, parameters.covariance, faults)
        before, factor = factor, [f * m for f, m in zip(factor, _noise_of_cameras(diagnosis, model), strict=True)]
        factor = [max(f, 1.0) for f in factor]
        if all(1 / _CONVERGED < f / b < _CONVERGED for f, b in zip(factor, before, strict=True)):
            break
    return WeightedDiagnosis(diagnosis, lin, jacobian, tuple(factor), stated)


def _noise_of_cameras(diagnosis: FaultDiagnosis, model: SpotModel) -> list[float]:
    """The noise scale of each camera; 1 where it is unknown.

    The median of its views: a single faulty view does not raise the scale of its camera.
    """
    out = []
    for c in range(len(model.camera_names)):
        known = diagnosis.noise_of_views[(model.camera_of == c) & np.isfinite(diagnosis.noise_of_views)]
        out.append(float(np.median(known)) if len(known) else 1.0)
    return out


_STEP_CHI2 = 60.0  # least difference of a step to constant faults; of 6 parameters and all frames chance makes 25
_STEP_SHARE = 0.05  # of what the step explains: a constant fault that is not linear is fitted better in a part as well
_LEAST_NOISE = 0.1  # noise scale: sigmas that are stated too large hide no step
_STEP_FRAMES = 5  # before the step and after it
_LEAST_STEP = 0.3  # sum of its squares over the spots, in stated sigmas, in a frame: less may be errors of places


def movement_of_a_camera(weighted: WeightedDiagnosis, faults: Sequence[PossibleFault]) -> int:
    """Index among the K frames of the first one after a camera has moved, as the residuals show it; -1: none has.

    A movement from each frame on must explain more of the residuals than constant faults do. Which of two cameras it
    was these do not show: the poses absorb what both have in common.
    """
    lin, diagnosis = weighted.lin, weighted.diagnosis
    K = len(lin.frames)
    r = lin.residual_part(lin.residual).reshape(K, -1)
    variance = max(diagnosis.noise_scale, _LEAST_NOISE) ** 2 * diagnosis.correlation_frames
    constant = sum(c.best.change.explained for c in diagnosis.suspected_faults)
    constant *= diagnosis.excess_noise**2 * diagnosis.correlation_frames / variance
    most, out = 0.0, -1
    for fault in faults if K > 2 * _STEP_FRAMES else ():
        if fault.component != CAMERA or fault.kind != MOVED:
            continue
        A = lin.residual_part(weighted.jacobian @ fault.directions).reshape(K, r.shape[1], -1)
        after = np.s_[::-1]  # sums from each frame to the last
        N = np.cumsum((np.swapaxes(A, 1, 2) @ A)[after], axis=0)[after] / variance + np.diag(fault.prior_sigma**-2)
        b = np.cumsum(np.einsum("kri,kr->ki", A, r)[after], axis=0)[after] / variance
        explained = np.einsum("ki,ki->k", b, np.linalg.solve(N, b[..., None])[..., 0])
        k = _STEP_FRAMES + int(np.argmax(explained[_STEP_FRAMES : K - _STEP_FRAMES]))
        gain = float(explained[k]) - max(float(explained[0]), constant)
        large = gain * variance > _LEAST_STEP * (K - k)
        if large and gain > max(_STEP_CHI2, _STEP_SHARE * explained[k], most):
            most, out = gain, k
    return out


@dataclass(frozen=True, slots=True)
class Effect:
    """Root mean squares over the frames used."""

    view: int  # index of the affected view with the largest leave-one-out residual, in sigmas
    axis: int  # of that residual: 0 u, 1 v; -1 where no spot is measured together with enough others
    off_px: float  # that residual
    off_sigmas: float  # the same in sigmas of one measurement: as stated, times the noise scale where that is above 1
    attitude_deg: float  # rotation of the pose; nan where no frame alone determines its pose
    position_mm: float  # displacement of the pose; nan likewise
    pose_sigmas: float  # largest ratio of bias to stated sigma over x, y, z and the three rotations; nan likewise


def effect_of(weighted: WeightedDiagnosis, variances: Array, fitted: FittedFault) -> Effect:
    """The effect of a fault on the views that it affects, and on the poses, of these variances (K, 6)."""
    lin, noise_scale, views = weighted.lin, weighted.diagnosis.excess_noise, fitted.fault.views
    moved = weighted.jacobian @ (fitted.fault.directions @ fitted.change.delta)
    weights = lin.inverse_redundancy()
    off = (weights @ lin.residual_part(moved)[..., None])[..., 0]
    back = np.linalg.inv(np.where(lin.used[..., None, None], lin.W, np.eye(2)))
    off_px = (back @ off[..., None])[..., 0]
    sigma_px = noise_scale * np.sqrt(np.diagonal(back @ np.swapaxes(back, -1, -2), axis1=-2, axis2=-1))
    px, sigmas = _rms(off_px), _rms(off_px / sigma_px)
    sigmas_of_views = np.where(views[:, None] & np.isfinite(sigmas), sigmas, -1.0)
    view, axis = (int(i) for i in np.unravel_index(np.argmax(sigmas_of_views), sigmas.shape))
    seen = bool(sigmas_of_views[view, axis] >= 0)
    own = lin.rank == 6
    bias = lin.pose_shift(moved)[own]
    nan = float("nan")
    turn = move = pose_sigmas = nan
    if own.any():
        turn = float(np.rad2deg(np.sqrt(np.mean(np.sum(bias[:, 3:] ** 2, axis=1)))))
        move = float(1e3 * np.sqrt(np.mean(np.sum(bias[:, :3] ** 2, axis=1))))
        variances = variances[own]
        known = np.isfinite(variances).all(axis=1) & (variances > 0).all(axis=1)
        if known.any():
            pose_sigmas = float(np.sqrt(np.mean(bias[known] ** 2 / variances[known], axis=0)).max())
    return Effect(
        view=view,
        axis=axis if seen else -1,
        off_px=float(px[view, axis]) if seen else nan,
        off_sigmas=float(sigmas[view, axis]) if seen else nan,
        attitude_deg=turn,
        position_mm=move,
        pose_sigmas=pose_sigmas,
    )


def pose_variances(weighted: WeightedDiagnosis, covariance: Array, stated: Array | None) -> Array:
    """(K, 6) variances of the poses, m^2 and rad^2.

    stated (K, 6, 6): by the run; None: of fits to single frames, with the calibration's covariance (p, p).
    """
    if stated is not None:
        return np.asarray(np.diagonal(stated, axis1=-2, axis2=-1))
    lin = weighted.lin
    variances = weighted.diagnosis.excess_noise**2 * np.diagonal(lin.normal_inverse, axis1=-2, axis2=-1)
    known = np.flatnonzero(np.diagonal(covariance) > 0)
    if known.size:
        shifts = lin.pose_shift(weighted.jacobian[..., known])
        variances = variances + np.einsum("kip,pq,kiq->ki", shifts, covariance[np.ix_(known, known)], shifts)
    return np.asarray(variances)


def _rms(values: Array) -> Array:
    """Root mean squares over frames, (K, ...) -> (...), ignoring nan; nan where all values are nan."""
    known = np.isfinite(values)
    count = known.sum(axis=0)
    total = np.sum(np.where(known, values, 0.0) ** 2, axis=0)
    return np.where(count > 0, np.sqrt(total / np.maximum(count, 1)), np.nan)
