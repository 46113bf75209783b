"""The alignment of two motions by least squares: candidates of the time offset, what is determined, the estimate."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft
from scipy.signal import fftconvolve

from geometry.arrays import Array, Bools, evenly_spaced, symmetric
from geometry.uncertainty.chi_square import chi2_limit
from tracking.comparison.frame_alignment import (
    BODY,
    GAP,
    LEVER,
    PARAMETERS,
    TIME,
    TRANSLATION,
    WORLD,
    Alignment,
    PoseSeries,
    Residuals,
    first_alignment,
    jacobians,
    rates,
    residuals,
)

# Candidates of the time offset between two motions, from the speeds, which do not depend on the frames.

_MOST_POINTS = 1 << 15  # of both series: a limit of the correlation's time
_LEAST_SHARE = 0.5  # of the shorter recording that must overlap
_LEAST_CORRELATION = 0.5  # of the largest one, for a candidate


def speeds_correlation(result: PoseSeries, reference: PoseSeries) -> tuple[Array, Array]:
    """Time offsets (k,), s, reference minus result, and the correlation (k,) of the speeds at these offsets.

    Rotation rates are used if both motions have attitudes, otherwise velocities.
    """
    rotating = result.rotation is not None and reference.rotation is not None
    part = slice(3, 6) if rotating else slice(0, 3)
    spans = [float(m.t_s[-1] - m.t_s[0]) for m in (result, reference)]
    step = max(min(result.step_s, reference.step_s), sum(spans) / _MOST_POINTS)
    series = []
    for motion, span in zip((result, reference), spans, strict=True):
        speed = np.linalg.norm(rates(motion)[:, part], axis=1)
        grid = motion.t_s[0] + step * np.arange(int(span / step) + 1)
        series.append(np.interp(grid, motion.t_s, speed))
    a, b = series
    ones_a, ones_b = np.ones(len(a)), np.ones(len(b))

    def correlate(x: Array, y: Array) -> Array:
        return np.asarray(fftconvolve(y, x[::-1]))

    a, b = a - a.mean(), b - b.mean()
    count = np.maximum(np.round(correlate(ones_a, ones_b)), 1.0)
    sum_a, sum_b = correlate(a, ones_b), correlate(ones_a, b)
    covariance = correlate(a, b) - sum_a * sum_b / count
    variance_a = correlate(a * a, ones_b) - sum_a**2 / count
    variance_b = correlate(ones_a, b * b) - sum_b**2 / count
    floor_a, floor_b = (1e-6 * float(np.sum(x * x)) + 1e-300 for x in (a, b))
    r = covariance / np.sqrt(np.maximum(variance_a, floor_a) * np.maximum(variance_b, floor_b))
    lags = np.arange(-(len(a) - 1), len(b))
    enough = count >= max(_LEAST_SHARE * min(len(a), len(b)), 2)
    offset = reference.t_s[0] - result.t_s[0] + step * lags
    return offset[enough], r[enough]


def offset_candidates(result: PoseSeries, reference: PoseSeries) -> list[float]:
    """Offsets at the six largest local maxima of the correlation of the speeds, best first."""
    offset, r = speeds_correlation(result, reference)
    if not len(r):
        return []
    padded = np.concatenate([[-np.inf], r, [-np.inf]])
    peaks = np.flatnonzero((padded[1:-1] >= padded[:-2]) & (padded[1:-1] > padded[2:]))
    order = peaks[np.argsort(-r[peaks], kind="stable")]
    return [float(offset[i]) for i in order[:6] if r[i] >= _LEAST_CORRELATION * r[order[0]]]


# What the motion determines: which parameters of an alignment the data distinguish from noise.


_SIGNIFICANT = 4.0  # sigmas by which the motion seen by both must exceed its noise, for the clocks
_NOISE_FACTOR = 100.0  # information must exceed what noise alone feigns by this factor: a motion of ten sigmas
_LARGEST_TURN_RAD = np.deg2rad(5.0)  # sigma above which a direction of the world's rotation counts as undetermined
_LARGEST_LEVER_M = 1.0  # sigma above which a direction of the lever arm counts as undetermined


@dataclass(frozen=True, slots=True)
class Determined:
    """A basis of the parameters that are estimated, and the directions that are not."""

    basis: Array  # (14, k): orthonormal columns
    undetermined: tuple[str, ...]  # parameters of the clocks that the motion does not show
    world_axes: Array  # (j, 3): axes, in the reference's world, about which A and B are not distinguished
    lever_axes: Array  # (j, 3): directions, in the result's body, along which the lever arm is not distinguished


@dataclass(frozen=True, slots=True)
class Information:
    """Normal equations of n residuals."""

    J: Array  # (n, 6, 14): with the result's rates
    J_reference: Array  # (n, 6, 14): with the reference's rates
    W: Array  # (n, 6, 6): weights, zero where nothing is compared
    noise: Array  # (n, 6, 6): covariance of the result in the reference's frames, as large as the residuals show


def determined(info: Information, basis: Array) -> Determined:
    """Removes from a basis (14, k) of the free parameters the directions that the data do not determine."""
    lost: list[str] = []
    for k in (1, 0):  # the rate first: it needs the offset
        column = np.eye(len(PARAMETERS))[:, k]
        if not np.any(basis[k]):
            continue
        others = _without(basis, column)
        if k == 0 and np.any(basis[1]):
            others = _without(others, np.eye(len(PARAMETERS))[:, 1])
        if not _clock_is_seen(info, column, others):
            lost.append(PARAMETERS[k])
            basis = _without(basis, column)
            if k == 0 and np.any(basis[1]):
                lost.append(PARAMETERS[1])
                basis = _without(basis, np.eye(len(PARAMETERS))[:, 1])
    W, noise = info.W, info.noise
    turn = _trace(noise[:, 3:, 3:])
    world_noise = float(np.sum(2 / 9 * (_trace(W[:, 3:, 3:]) * turn + _trace(W[:, :3, :3]) * _trace(noise[:, :3, :3]))))
    basis, world_axes = _reduced(info, basis, WORLD, world_noise, float(_LARGEST_TURN_RAD))
    lever_noise = float(np.sum(2 / 9 * _trace(W[:, :3, :3]) * turn))
    basis, lever_axes = _reduced(info, basis, LEVER, lever_noise, _LARGEST_LEVER_M)
    return Determined(basis, tuple(lost), world_axes, lever_axes)


def _clock_is_seen(info: Information, column: Array, others: Array) -> bool:
    """Whether both motions show the same rates, beyond what the other parameters explain and beyond noise."""
    rate, rate_there = info.J @ column, info.J_reference @ column
    if others.shape[1]:
        J = info.J @ others
        WJ = info.W @ J
        normal = np.einsum("nik,nil->kl", J, WJ)
        inverse = np.linalg.pinv(symmetric(normal), rcond=1e-12, hermitian=True)
        rate = rate - J @ (inverse @ np.einsum("nik,ni->k", WJ, rate))
        rate_there = rate_there - J @ (inverse @ np.einsum("nik,ni->k", WJ, rate_there))
    product = np.einsum("ni,nij,nj->n", rate, info.W, rate_there)
    total, scatter = float(product.sum()), float(np.sqrt(np.sum(product**2)))
    return total > _SIGNIFICANT * scatter > 0 and _is_larger_than_rounding(info, column, total)


def _is_larger_than_rounding(info: Information, column: Array, total: float) -> bool:
    rate = info.J @ column
    return total > 1e-9 * float(np.einsum("ni,nij,nj->", rate, info.W, rate))


def _reduced(info: Information, basis: Array, part: slice, noise: float, largest: float) -> tuple[Array, Array]:
    """The basis without the directions of one part (three parameters) that are undetermined, and these directions."""
    none = np.zeros((0, 3))
    if not np.any(basis[part]):
        return basis, none
    J = info.J @ basis
    H = symmetric(np.einsum("nik,nil->kl", J, info.W @ J))
    block = basis[part]  # (3, k)
    scale = 1 / np.sqrt(np.maximum(np.diag(H), 1e-300))
    eigenvalues, vectors = np.linalg.eigh(H * scale[:, None] * scale)
    # Covariance of the three parameters, with null directions at a relative 1e-13 of the information.
    half = (block * scale) @ (vectors / np.sqrt(np.maximum(eigenvalues, 1e-13 * eigenvalues[-1])))
    U, sigma, _ = np.linalg.svd(half, full_matrices=False)
    information = 1 / np.maximum(sigma, 1e-300) ** 2
    bad = (information < _NOISE_FACTOR * noise) | (sigma > largest)
    axes = U[:, bad].T
    for axis in axes:
        column = np.zeros(len(basis))
        column[part] = axis
        basis = _without(basis, column)
    return basis, _signed(axes)


def _signed(axes: Array) -> Array:
    """Axes (j, 3) with a positive largest component."""
    largest = np.take_along_axis(axes, np.argmax(np.abs(axes), axis=1)[:, None], axis=1) if len(axes) else axes[:, :1]
    return np.asarray(axes * np.where(largest < 0, -1.0, 1.0))


def _without(basis: Array, column: Array) -> Array:
    """An orthonormal basis of the part of a basis (m, k) that is orthogonal to a unit vector (m,)."""
    rest = basis - np.outer(column, column @ basis)
    U, sigma, _ = np.linalg.svd(rest, full_matrices=False)
    return np.asarray(U[:, sigma > 0.5])


def _trace(stack: Array) -> Array:
    return np.asarray(np.trace(stack, axis1=1, axis2=2))


# Estimates time offset, clock rate and frame alignment by robust weighted least squares, with covariance.


_OUTLIER_P = 1e-5  # a frame beyond it is left out: one of 100,000 good ones
_HUBER_P = 0.01  # a frame beyond it has a smaller weight
_MOST_STEPS = 30  # a limit: the steps end where they are small
_CANDIDATE_STEPS = 8  # enough to compare offsets of time
_BLOCKS = 30  # of consecutive frames, whose sums show how much the errors of neighbours have in common
_CANDIDATE_SAMPLES = 600  # of the result, where candidates of the offset are compared
_CORRELATION_STEPS = 20  # a limit; the correlation of residuals and what the parameters take follow from each other
_MOST_TAKEN = 0.8  # largest share of the degrees of freedom that the parameters take: more is not known from the rest
_SAME_FIT = 5.0  # sigmas of the residuals' variance within which two offsets explain their frames equally well
LEAST_FRAMES = 8  # fourteen unknowns, two or more numbers of each frame


class NotComparableError(ValueError):
    """The motions have too little in common; the message says what."""


@dataclass(frozen=True, slots=True)
class Free:
    """What may be estimated."""

    offset: bool = True
    rate: bool = True
    world: bool = True  # rotation A and translation c
    body: bool = True  # rotation B and lever arm l

    def mask(self, result: PoseSeries, reference: PoseSeries) -> Bools:
        """(14,): the parameters that may change, as far as both motions have attitudes or positions."""
        free = np.zeros(len(PARAMETERS), dtype=bool)
        angles = result.rotation is not None and reference.rotation is not None
        places = result.position_m is not None and reference.position_m is not None
        free[0], free[1] = self.offset, self.offset and self.rate
        free[WORLD], free[TRANSLATION] = self.world, self.world and places
        free[BODY] = self.body and angles
        free[LEVER] = self.body and places and result.rotation is not None
        return free


class Freedom(NamedTuple):
    """How many of the residuals of an alignment are independent of each other."""

    taken: float = 0.0  # degrees of freedom that the parameters take from them
    alike: float = 1.0  # sum of the squared correlations of an error with all errors of its coordinate; 1: independent

    @staticmethod
    def of(residual: Array, derivatives: Array) -> Freedom:
        """From residuals (n, m) in sigmas of an estimate of k parameters, and the derivatives (n, m, k).

        Poses of a smoothing pass have errors that are alike in dozens of frames: there a parameter takes not one degree
        of freedom, but as many. All take sum(rho(l) a(l)) over the lags l, with the correlations rho of the errors and
        the autocorrelations a of orthonormal columns of the derivatives. Those of the residuals are smaller by a(l)
        times what one parameter takes. They count up to the first two lags whose sum is not positive (Geyer,
        Statistical Science 7, 1992, section 3.3). Source for the rest: ours.
        """
        (n, m), k = residual.shape, derivatives.shape[2]
        if not k or not residual.any():
            return Freedom(float(k))
        columns = np.linalg.qr(derivatives.reshape(n * m, k))[0].reshape(n, m * k)
        seen, of_columns = _products(residual), _products(columns)
        twice = np.r_[1.0, np.full(len(seen) - 1, 2.0)]  # a lag is one of two, forward and backward
        pairs, each = m * np.arange(n, n - len(seen), -1), 1.0
        for _ in range(_CORRELATION_STEPS):
            rho = (seen * (n * m - each * k) / seen[0] + each * of_columns) / pairs
            end = np.flatnonzero(rho[1:-1] + rho[2:] <= 0)
            rho = rho[: int(end[0]) + 1 if len(end) else len(rho)]
            taken = float((twice * of_columns)[: len(rho)] @ rho)
            each = float(np.clip(taken / k, 1.0, _MOST_TAKEN * n * m / k))
        return Freedom(each * k, float(twice[: len(rho)] @ rho**2))


def _products(series: Array) -> Array:
    """(n // 2,): sums of the products of series (n, c) with themselves, by lag."""
    size = next_fast_len(2 * len(series), real=True)
    out = np.zeros(len(series) // 2)
    for column in series.T:
        out += irfft(np.abs(rfft(column, size)) ** 2, size)[: len(out)]
    return out


@dataclass(frozen=True, slots=True)
class Estimate:
    """An alignment with its uncertainty."""

    alignment: Alignment
    covariance: Array  # (14, 14), in the order of PARAMETERS; zero for what is not estimated
    free: Bools  # (14,): parameters that were to be estimated
    determined: Determined
    scale: float  # robust: residuals against the stated covariances; 1 if these are correct
    correlation: float  # largest factor by which correlated residuals increase the variances of parameters
    freedom: Freedom  # of the residuals
    inliers: Bools  # (n,)
    other_offsets: tuple[float, ...]  # time offsets that explain the data equally well

    @property
    def sigmas(self) -> Array:
        """(14,): standard deviations; zero for what is not estimated."""
        return np.asarray(np.sqrt(np.maximum(np.diag(self.covariance), 0.0)))


def estimate_alignment(
    result: PoseSeries, reference: PoseSeries, free: Free | None = None, offset_s: float | None = None, gap: float = GAP
) -> Estimate:
    """The alignment of a reference to a result.

    free: what may be estimated (default: everything that both motions have). offset_s: the approximate time offset;
    None: candidates from the correlation of the speeds, and zero. Raises NotComparableError: fewer than LEAST_FRAMES
    common times.
    """
    free = free or Free()
    mask = free.mask(result, reference)
    if not _in_common(result, reference):
        raise NotComparableError("one has only attitudes, the other only positions")
    middle = float(0.5 * (result.t_s[0] + result.t_s[-1]))
    offsets = [0.0 if offset_s is None else offset_s]
    if free.offset and offset_s is None:
        offsets += offset_candidates(result, reference)
    thin = result.select(evenly_spaced(np.arange(len(result)), _CANDIDATE_SAMPLES))
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


def _in_common(result: PoseSeries, reference: PoseSeries) -> bool:
    return (result.rotation is not None and reference.rotation is not None) or (
        result.position_m is not None and reference.position_m is not None
    )


def _distinct(estimates: list[Estimate]) -> list[Estimate]:
    """One estimate of each group with the same time offset."""
    kept: list[Estimate] = []
    for e in estimates:
        apart = ((abs(e.alignment.offset_s - k.alignment.offset_s), e.sigmas[0], k.sigmas[0]) for k in kept)
        if all(gap > 10 * max(one, other, 1e-6) for gap, one, other in apart):
            kept.append(e)
    return kept


def _as_good(best: Estimate) -> float:
    """The largest variance factor that is as good as the best one, for the number of independent residuals."""
    independent = max(float(best.inliers.sum()) * 3 / best.correlation**2, 2.0)
    return best.scale * (1.1 + _SAME_FIT * math.sqrt(2 / independent)) + 1e-12


@dataclass(frozen=True, slots=True)
class _Weighted:
    """Residuals with weights of one step."""

    r: Residuals
    W: Array  # (n, 6, 6)
    d2: Array  # (n,): squared Mahalanobis distances; nan where unknown
    dof: int
    scale: float


def _weighted(result: PoseSeries, reference: PoseSeries, alignment: Alignment, gap: float) -> _Weighted | None:
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
    result: PoseSeries, reference: PoseSeries, start: Alignment, mask: Bools, gap: float, steps: int = _MOST_STEPS
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
            if _is_small(delta, result):
                break
    w = _weighted(result, reference, alignment, gap)
    if w is None or what is None:
        return None
    info = _information(result, reference, alignment, w, (inliers & w.r.known).astype(float))
    covariance, correlation = _covariance(info, what.basis, w)
    used = inliers & w.r.known
    rows, compared = np.ix_(used, w.r.compared, w.r.compared), w.r.compared
    root = np.swapaxes(np.linalg.cholesky(w.W[rows]), 1, 2)
    white = np.einsum("nij,nj->ni", root, w.r.values[used][:, compared])
    freedom = Freedom.of(white, root @ (info.J[used][:, compared] @ what.basis))
    return Estimate(alignment, covariance, mask, what, w.scale, correlation, freedom, used, ())


def _is_small(delta: Array, result: PoseSeries) -> bool:
    """Whether a step changes the alignment by less than the residuals can show."""
    limit = np.array([1e-6 * result.step_s, 1e-6 * result.step_s / max(float(np.ptp(result.t_s)), 1e-9)])
    return bool(np.all(np.abs(delta[TIME]) < limit) and np.all(np.abs(delta[2:]) < 1e-10))


def _information(
    result: PoseSeries, reference: PoseSeries, alignment: Alignment, w: _Weighted, weight: Array
) -> Information:
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
