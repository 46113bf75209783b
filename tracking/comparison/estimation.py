"""Estimates time offset, clock rate and frame alignment by robust weighted least squares, with covariance."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from geometry.arrays import Array, Bools, symmetric
from geometry.uncertainty.chi_square import chi2_limit
from tracking.comparison.first_alignment import first_alignment
from tracking.comparison.frame_alignment import (
    BODY,
    LEVER,
    PARAMETERS,
    TIME,
    TRANSLATION,
    WORLD,
    Alignment,
    Residuals,
    jacobians,
    residuals,
)
from tracking.comparison.motion import GAP, Motion
from tracking.comparison.observability import Determined, Information, determined
from tracking.comparison.time_candidates import offset_candidates

_OUTLIER_P = 1e-5
_HUBER_P = 0.01
_MOST_STEPS = 30
_CANDIDATE_STEPS = 8
_BLOCKS = 30
_CANDIDATE_SAMPLES = 600  # of the result, where candidates of the offset are compared
_SAME_FIT = 5.0  # sigmas of the residuals' variance within which two offsets explain their frames equally well
LEAST_FRAMES = 8


class NotComparableError(ValueError):
    """The motions have too little in common; the message says what."""


@dataclass(frozen=True, slots=True)
class Free:
    """What may be estimated."""

    offset: bool = True
    rate: bool = True
    world: bool = True  # rotation A and translation c
    body: bool = True  # rotation B and lever arm l

    def mask(self, result: Motion, reference: Motion) -> Bools:
        """(14,): the parameters that may change, as far as both motions have attitudes or positions."""
        free = np.zeros(len(PARAMETERS), dtype=bool)
        angles = result.rotation is not None and reference.rotation is not None
        places = result.position_m is not None and reference.position_m is not None
        free[0], free[1] = self.offset, self.offset and self.rate
        free[WORLD], free[TRANSLATION] = self.world, self.world and places
        free[BODY] = self.body and angles
        free[LEVER] = self.body and places and result.rotation is not None
        return free


@dataclass(frozen=True, slots=True)
class Estimate:
    """An alignment with its uncertainty."""

    alignment: Alignment
    covariance: Array  # (14, 14), in the order of PARAMETERS; zero for what is not estimated
    free: Bools  # (14,): parameters that were to be estimated
    determined: Determined
    scale: float  # robust: residuals against the stated covariances; 1 if these are correct
    correlation: float  # largest factor by which correlated residuals increase the variances of parameters
    inliers: Bools  # (n,)
    other_offsets: tuple[float, ...]  # time offsets that explain the data equally well

    @property
    def sigmas(self) -> Array:
        """(14,): standard deviations; zero for what is not estimated."""
        return np.asarray(np.sqrt(np.maximum(np.diag(self.covariance), 0.0)))


def estimate_alignment(
    result: Motion, reference: Motion, free: Free | None = None, offset_s: float | None = None, gap: float = GAP
) -> Estimate:
    """The alignment of a reference to a result.

    free: what may be estimated (default: everything that both motions have). offset_s: the approximate time offset;
    None: candidates from the correlation of the speeds, and zero.

    Raises:
        NotComparableError: fewer than LEAST_FRAMES common times.
    """
    free = free or Free()
    mask = free.mask(result, reference)
    if not _in_common(result, reference):
        raise NotComparableError("one has only attitudes, the other only positions")
    middle = float(0.5 * (result.t_s[0] + result.t_s[-1]))
    offsets = [0.0 if offset_s is None else offset_s]
    if free.offset and offset_s is None:
        offsets += offset_candidates(result, reference)
    thin = result.select(np.unique(np.linspace(0, len(result) - 1, _CANDIDATE_SAMPLES).round().astype(int)))
    found: list[Estimate] = []
    for offset in dict.fromkeys(offsets):
        start = Alignment.identity(offset, middle)
        if residuals(thin, reference, start, gap).known.sum() < LEAST_FRAMES:
            continue
        first = first_alignment(thin, reference, start, mask)
        fitted = _fit(thin, reference, first, mask, gap, steps=_CANDIDATE_STEPS)
        if fitted is not None:
            found.append(fitted)
    if not found:
        raise NotComparableError(f"fewer than {LEAST_FRAMES} common times")
    best = min(found, key=lambda e: e.scale)
    rivals = _distinct([best, *(e for e in found if e.scale <= _as_good(best))])
    if len(rivals) > 1:  # the alignment that explains the most frames; the others are reported
        best = max(rivals, key=lambda e: int(e.inliers.sum()))
    others = tuple(e.alignment.offset_s for e in rivals if e is not best)
    if "offset_s" in best.determined.undetermined:
        others = ()
        start = first_alignment(thin, reference, Alignment.identity(offsets[0], middle), mask)
        if residuals(result, reference, start, gap).known.sum() < LEAST_FRAMES:
            raise NotComparableError(
                "no motion determines the time offset, and the clocks as they are have no common times"
            )
        best = replace(best, alignment=start)
    final = _fit(result, reference, best.alignment, mask, gap)
    if final is None:
        raise NotComparableError(f"fewer than {LEAST_FRAMES} common times")
    return replace(final, other_offsets=others)


def _in_common(result: Motion, reference: Motion) -> bool:
    return (result.rotation is not None and reference.rotation is not None) or (
        result.position_m is not None and reference.position_m is not None
    )


def _distinct(estimates: list[Estimate]) -> list[Estimate]:
    """One estimate of each group with the same time offset."""
    kept: list[Estimate] = []
    for e in estimates:
        if all(abs(e.alignment.offset_s - k.alignment.offset_s) > 10 * _offset_sigma(e, k) for k in kept):
            kept.append(e)
    return kept


def _as_good(best: Estimate) -> float:
    """The largest variance factor that is as good as the best one, for the number of independent residuals."""
    independent = max(float(best.inliers.sum()) * 3 / best.correlation**2, 2.0)
    return best.scale * (1.1 + _SAME_FIT * math.sqrt(2 / independent)) + 1e-12


def _offset_sigma(a: Estimate, b: Estimate) -> float:
    return max(float(a.sigmas[0]), float(b.sigmas[0]), 1e-6)


@dataclass(frozen=True, slots=True)
class _Weighted:
    """Residuals with weights of one step."""

    r: Residuals
    W: Array  # (n, 6, 6)
    d2: Array  # (n,): squared Mahalanobis distances; nan where unknown
    dof: int
    scale: float


def _weighted(result: Motion, reference: Motion, alignment: Alignment, gap: float) -> _Weighted | None:
    r = residuals(result, reference, alignment, gap)
    if r.known.sum() < LEAST_FRAMES:
        return None
    # A reference with fewer samples than the result serves several frames: its errors are common to them.
    at = alignment.reference_time(result.t_s[r.known])
    samples = int(np.sum((reference.t_s >= at.min()) & (reference.t_s <= at.max())))
    shared = max(1.0, r.known.sum() / max(samples, 1))
    W = inverse_covariances(r, shared)
    d2 = np.where(r.known, np.einsum("ni,nij,nj->n", r.values, W, r.values), np.nan)
    dof = int(r.compared.sum())
    scale = max(float(np.nanmedian(d2)) / chi2_limit(0.5, dof), 1e-18)
    return _Weighted(r, W, d2, dof, scale)


def inverse_covariances(r: Residuals, shared: float = 1.0) -> Array:
    """Weights (n, 6, 6) of residuals; zero where they are unknown. shared: frames that one reference sample serves."""
    covariance = r.result_covariance + shared * r.reference_covariance
    used = np.flatnonzero(r.compared)
    W = np.zeros_like(covariance)
    rows = np.flatnonzero(r.known)
    W[np.ix_(rows, used, used)] = np.linalg.inv(covariance[np.ix_(rows, used, used)])
    return symmetric(W)


def _fit(
    result: Motion, reference: Motion, start: Alignment, mask: Bools, gap: float, steps: int = _MOST_STEPS
) -> Estimate | None:
    """Huber's weights until convergence, then without the outliers. None where too few times are common."""
    alignment, what = start, None
    inliers = np.ones(len(result), dtype=bool)
    for robust in (True, False):
        for step in range(steps):
            w = _weighted(result, reference, alignment, gap)
            if w is None:
                return None
            if robust:
                ratio = chi2_limit(_HUBER_P, w.dof) * w.scale / np.maximum(w.d2, 1e-300)
                weight = np.where(w.r.known, np.minimum(1.0, np.sqrt(ratio)), 0.0)
            else:
                if step == 0:
                    inliers = w.r.known & (w.d2 <= chi2_limit(_OUTLIER_P, w.dof) * w.scale)
                weight = (inliers & w.r.known).astype(float)
            info = _information(result, reference, alignment, w, weight)
            if step == 0:
                what = determined(info, np.eye(len(PARAMETERS))[:, mask])
            assert what is not None
            gain, _ = _gain(info, what.basis)
            delta = what.basis @ np.einsum("kni,ni->k", gain, w.r.values)
            alignment = alignment.plus(-delta)
            if _is_small(delta, w, result):
                break
    w = _weighted(result, reference, alignment, gap)
    if w is None or what is None:
        return None
    info = _information(result, reference, alignment, w, (inliers & w.r.known).astype(float))
    covariance, correlation = _covariance(info, what.basis, w)
    return Estimate(alignment, covariance, mask, what, w.scale, correlation, inliers & w.r.known, ())


def _is_small(delta: Array, w: _Weighted, result: Motion) -> bool:
    """Whether a step changes the alignment by less than the residuals can show."""
    limit = np.array([1e-6 * result.step_s, 1e-6 * result.step_s / max(float(np.ptp(result.t_s)), 1e-9)])
    return bool(np.all(np.abs(delta[TIME]) < limit) and np.all(np.abs(delta[2:]) < 1e-10))


def _information(result: Motion, reference: Motion, alignment: Alignment, w: _Weighted, weight: Array) -> Information:
    J, J_reference = jacobians(result, reference, alignment, w.r.compared)
    noise = w.r.result_covariance * max(w.scale, 1.0)
    return Information(J, J_reference, w.W * weight[:, None, None], noise * (weight > 0)[:, None, None])


def _gain(info: Information, basis: Array) -> tuple[Array, Array]:
    """The linear map (k, n, 6) from residuals to the step of the parameters, and the parameters' covariance (k, k)."""
    J, there = info.J @ basis, info.J_reference @ basis
    WJ = info.W @ J
    crossed = np.einsum("nik,nil->kl", WJ, there)
    normal = np.einsum("nik,nil->kl", WJ, J)
    scale = 1 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    inverse = np.linalg.pinv(crossed * scale[:, None] * scale, rcond=1e-12) * scale[:, None] * scale
    gain = np.einsum("kl,nil->kni", inverse, WJ)
    return gain, inverse @ normal @ inverse.T


def _covariance(info: Information, basis: Array, w: _Weighted) -> tuple[Array, float]:
    """Covariance (14, 14), and the factor by which correlated residuals increase it.

    The sums of the residuals' contributions over blocks of time show how much the parameters scatter: with
    correlated errors more than the stated covariances say. The stated one is the lower limit.
    """
    gain, stated = _gain(info, basis)
    full = np.asarray(basis @ stated @ basis.T)
    each = basis @ np.einsum("kni,ni->kn", gain, w.r.values)
    rows = np.flatnonzero(w.r.known)
    blocks = min(_BLOCKS, len(rows) // 4)
    factors = np.ones(len(PARAMETERS))
    if blocks >= 5:
        sums = np.add.reduceat(each[:, rows], np.linspace(0, len(rows), blocks + 1).astype(int)[:-1], axis=1)
        scatter = np.sum(sums**2, axis=1) * blocks / (blocks - 1)
        variances = np.diag(full)
        for part in (TIME, slice(2, 8), slice(8, 14)):
            seen = variances[part] > 0
            if seen.any():
                factors[part] = max(1.0, float(np.mean(scatter[part][seen] / variances[part][seen])))
    else:
        factors[:] = max(1.0, w.scale)
    root = np.sqrt(factors)
    return symmetric(full * root[:, None] * root), math.sqrt(float(factors.max()))
