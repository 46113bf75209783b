"""Errors of a spot that depend on its place on the screen; averaging over a vehicle at rest does not reduce them.

Texture and speckle of the screen, the skewed shape of an oblique spot and the phase of the pixels shift a centroid by
an amount that belongs to the place on the screen. A vehicle at rest shows the same shift in every frame; a spot that
has moved by its own width shows another one. The share of such errors in the variance follows from the residuals of a
smoothed run: the mean product of one view's residuals in two frames is zero for noise, but not for these errors.
Source: ours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from geometry.arrays import Array, Ints

USUAL_WIDTH_PX = 2.0  # of spots whose width is not known
_CHUNK = 256  # consecutive frames that are compared with each other
_MIN_CORRELATION = 0.05  # below it two places count as different
PLACE_REACH = 2.0  # widths of the spot: assumed correlation length of the errors, for their number
_REACHES = (1.0, 2.0, 4.0, 8.0)  # tried correlation lengths, in widths of the spot
_SHARES = np.concatenate([[0.0], 1 / (1 + np.geomspace(1e3, 1e-3, 61))])  # of the variance: hypotheses
PLACE_FACTOR = 1.5  # 1 sigma of the ratio of a predicted standard deviation of the errors of places to the true one
_UNFORESEEN = 0.1  # probability that the errors of places are not those predicted: none, or any
_LEAST_SQUARE = 0.1  # of its expectation by noise: the statistic scatters below zero
_SIGNIFICANT = 3.0  # sigmas of the statistic under noise alone, above which it decides about the correlation length
_MAX_ABSORBED = 0.8  # largest share of the errors that is assumed to be absorbed by the poses


@dataclass(frozen=True, slots=True)
class PlaceErrors:
    """Estimate for T frames and n views."""

    share: float  # of the spots' error variance that belongs to places, in [0, 1]
    factor: Array  # (T,) of covariances that were computed as if the errors of all frames were independent
    more: Array  # (T, n): the same less 1, of errors that all belong to places, for each view
    reach_px: Array  # (n,) correlation length: the sigma of a spot whose mean over white texture would make it
    elsewhere: float = 0.0  # share of the variance that is the same in all places: errors of the rig, not of a place


def correlation(distance_px: Array, width_px: Array | float) -> Array:
    """Correlation of the errors in two places at a distance, of a spot with this width (1 sigma).

    The error is a mean over the spot, so its correlation is that of two Gaussians of sigma `width_px`:
    exp(-d^2 / (4 width^2)).
    """
    rho = np.exp(-0.25 * (distance_px / width_px) ** 2)
    return np.asarray(np.where(rho < _MIN_CORRELATION, 0.0, rho))


def place_errors(
    residual: Array, uv_px: Array, width_px: Array, averaged: Array, taken: Array, predicted: float = 0.0
) -> PlaceErrors:
    """Estimate the errors that belong to places from a run's residuals and from what is predicted.

    residual (T, n, 2): labelled pixels less those of the smoothed poses, in sigmas; nan without a label. uv_px
    (T, n, 2): the pixels. width_px (n,): 1-sigma width of the spots, nan where not known. averaged (T,): number of
    frames that each pose is a mean of. taken (T, n) or (n,): variance, in sigmas squared, of what the residuals may
    have lost or kept, the same in all frames, when the errors of the rig were taken from them (`RigErrors`). predicted:
    the share according to the texture of the background and the misfit of the fits; 0: nothing is known.

    The share is its mean under the posterior distribution. Few places, or few spots, whose poses absorb such errors,
    hardly show it: then the prediction decides. Many places show it whatever was predicted. The mean of a variance is
    that of Student's distribution, which allows for the few places from which it was estimated.
    """
    width = usable_widths(width_px)
    labelled = np.isfinite(residual[..., 0])
    count = float(np.mean(labelled.sum(axis=1)[labelled.any(axis=1)])) if labelled.any() else 0.0
    absorbed = min(3.0 / max(count, 1e-9), _MAX_ABSORBED)
    # Coarse texture and edges of the screen reach farther than a spot is wide: take the most significant length.
    sums = _products(residual, uv_px, [r * width for r in _REACHES], np.broadcast_to(taken, labelled.shape))
    best = max(sums, key=lambda p: p.significance)
    if best.significance * np.sqrt(1 - absorbed) < _SIGNIFICANT:
        best = sums[0]
    share = predicted
    if best.expected > 0:
        # The poses absorb part of the residuals, which reduces the degrees of freedom.
        place = _SHARES * (1 - absorbed)
        expected = place / (place + (1 - _SHARES) * (1 - absorbed / float(np.median(np.maximum(averaged, 1.0)))))
        # A place counts with its pairs of frames: one that a moving spot passes in a single frame shows nothing.
        frames = np.where(labelled, np.maximum(best.same_error_frames, 1.0), 1.0)
        places = float(np.sum(frames - 1) ** 2 / np.sum(frames * (frames - 1) ** 2))
        free = 2 * (1 - absorbed) * places
        # The statistic is a mean square of `free` means over places, less that by noise: a multiple of chi-square.
        by_noise = np.sqrt(0.25 * free / best.expected / (1 - absorbed))
        mean_square = max(best.near / best.expected + by_noise, _LEAST_SQUARE * by_noise)
        log_likelihood = -0.5 * free * (mean_square / (expected + by_noise) + np.log(expected + by_noise))
        weight = _prior(predicted) * np.exp(log_likelihood - log_likelihood.max())
        share = float(weight @ _SHARES / weight.sum())
    more = np.stack([more_of_means(uv_px[:, i], best.reach_px[i], averaged) for i in range(len(width))], axis=-1)
    total, views = np.where(labelled, more, 0.0).sum(axis=1), np.maximum(labelled.sum(axis=1), 1)
    return PlaceErrors(share, 1 + share * total / views, more, best.reach_px, best.elsewhere)


def _prior(predicted: float) -> Array:
    """Probabilities of _SHARES before the residuals are seen, given the predicted share."""
    out = np.full(len(_SHARES), 0.5 * _UNFORESEEN / (len(_SHARES) - 1))
    out[0] = 0.5 * _UNFORESEEN
    if predicted <= 0:
        out[0] += 1 - _UNFORESEEN
        return out
    # The variance of the noise is known: uncertain is its ratio to that of the errors of places.
    noise = np.log(1 / min(predicted, _SHARES[-1]) - 1)
    away = (np.log(1 / _SHARES[1:] - 1) - noise) / (2 * np.log(PLACE_FACTOR))
    near = np.exp(-0.5 * away**2)
    out[1:] += (1 - _UNFORESEEN) * near / near.sum()
    return out


def scaled_shares(shares: Array, predicted: float, found: float) -> Array:
    """The shares (m,) of single errors, whose mean was predicted and found to be another: one factor on their odds."""
    least = _SHARES[1]
    if predicted < least or found < least:
        return np.full(len(shares), found)
    odds = [np.clip(x, 0.0, _SHARES[-1]) / (1 - np.clip(x, 0.0, _SHARES[-1])) for x in (shares, predicted, found)]
    scaled = odds[0] * odds[2] / odds[1]
    return np.asarray(scaled / (1 + scaled))


def with_places(pose_P: Array, J: Array, cov: Array, at: tuple[Ints, Ints], more: Array) -> Array:
    """Covariances (F, 6, 6) of means of poses, given those for independent errors, with the errors of places.

    Spots on edges have larger ones than others; they lie in the directions of the pose that these spots determine.
    J (F, n, 2, 6): Jacobians; at: frame and view of m points; cov (m, 2, 2), px^2; more (m,): variance that errors of
    places add to a mean, times the number of frames in it, over the variance of one.
    """
    out = np.zeros_like(pose_P)
    frame, view = at
    for i in range(J.shape[1]):
        of_view = view == i
        J_i = J[frame[of_view], i]
        information = np.swapaxes(J_i, 1, 2) @ np.linalg.solve(cov[of_view], J_i)
        out[frame[of_view]] += more[of_view, None, None] * information
    return np.asarray(pose_P + pose_P @ out @ pose_P)


def usable_widths(width_px: Array) -> Array:
    """(n,): the widths of the spots, px; a usual one where not known."""
    return np.where(np.isfinite(width_px), np.maximum(width_px, 0.5), USUAL_WIDTH_PX)


def _distances(uv_px: Array) -> Array:
    """(m, m): between all pairs of pixels (m, 2)."""
    du, dv = uv_px[:, None, 0] - uv_px[None, :, 0], uv_px[:, None, 1] - uv_px[None, :, 1]
    return np.asarray(np.sqrt(du * du + dv * dv))


def frames_with_same_error(uv_px: Array, reach_px: float) -> Array:
    """(T,): number of frames in which one view's spot, at uv_px (T, 2), has the same error; nan without a spot."""
    out = np.full(len(uv_px), np.nan)
    rows = np.flatnonzero(np.isfinite(uv_px).all(axis=-1))
    for start in range(0, len(rows), _CHUNK):
        some = rows[start : start + _CHUNK]
        at = uv_px[some]
        out[some] = correlation(_distances(at), reach_px).sum(axis=1)
    return out


def more_of_means(uv_px: Array, reach_px: float, averaged: Array) -> Array:
    """(T,): by how much the variance of means exceeds that of means of independent errors, relative to the latter.

    Of the errors of one view's spot, at uv_px (T, 2); averaged (T,): number N of frames that each mean is of. The
    weights of the mean are taken to be a Gaussian over time, the sum of whose squares is 1 / N. 0 without a spot.
    """
    out = np.zeros(len(uv_px))
    rows = np.flatnonzero(np.isfinite(uv_px).all(axis=-1))
    for start in range(0, len(rows), _CHUNK):
        some = rows[start : start + _CHUNK]
        rho, many = correlation(_distances(uv_px[some]), reach_px), np.maximum(averaged[some], 1.0)
        np.fill_diagonal(rho, 0.0)
        weight = np.exp(-0.5 * ((some[:, None] - some) * (2 * np.sqrt(np.pi) / many)[:, None]) ** 2)
        weight /= weight.sum(axis=1, keepdims=True)
        out[some] = many * np.sum((weight @ rho) * weight, axis=1)
    return out


@dataclass(slots=True)
class _Products:
    """Sums over pairs of frames of the products of a view's residuals, divided by their mean square."""

    reach_px: Array  # (n,) assumed correlation length
    same_error_frames: Array  # (T, n) number of frames with the same errors
    near: float = 0.0  # weighted with the correlation of their places
    expected: float = 0.0  # the same if all errors belonged to places
    far: float = 0.0  # of pairs in different places
    far_pairs: float = 0.0
    independent: float = 0.0  # those of them that are independent of each other

    def add(self, some: Ints, view: int, products: Array, rho: Array) -> None:
        """Add a view's pairs among some frames (m,): products (m, m) and correlations (m, m)."""
        self.far += float(np.sum(products[rho == 0]))
        pairs = float(np.count_nonzero(rho == 0))
        self.far_pairs += pairs
        np.fill_diagonal(rho, 0.0)
        self.same_error_frames[some, view] = 1 + rho.sum(axis=1)
        self.independent += 0.5 * pairs / float(np.mean(self.same_error_frames[some, view])) ** 2
        # Each pair is counted twice.
        self.near += 0.5 * float(np.sum(rho * products))
        self.expected += 0.5 * float(np.sum(rho**2))

    @property
    def significance(self) -> float:
        """`near` in standard deviations of its distribution for white residuals in two coordinates."""
        return self.near / np.sqrt(0.5 * self.expected) if self.expected > 0 else 0.0

    @property
    def elsewhere(self) -> float:
        """Mean over pairs in different places, as far as significant.

        Less one sigma: a spot that hardly moves shows few places that differ, and their errors may agree by chance.
        """
        return max(self.far / self.far_pairs - np.sqrt(0.5 / self.independent), 0.0) if self.far_pairs else 0.0


def _products(residual: Array, uv_px: Array, reaches_px: Sequence[Array], taken: Array) -> list[_Products]:
    """For each of several assumed correlation lengths (n,)."""
    sums = [_Products(reach_px, np.ones(residual.shape[:2])) for reach_px in reaches_px]
    for view in range(residual.shape[1]):
        rows = np.flatnonzero(np.isfinite(residual[:, view]).all(axis=-1))
        lost = 2 * float(np.mean(taken[rows, view])) if len(rows) else 0.0
        mean_square = lost + float(np.mean(np.sum(residual[rows, view] ** 2, axis=-1))) if len(rows) > 1 else 0.0
        if mean_square <= 0:
            continue
        for start in range(0, len(rows), _CHUNK):
            some = rows[start : start + _CHUNK]
            r, at = residual[some, view], uv_px[some, view]
            products = (r @ r.T + lost) / mean_square
            distance = _distances(at)
            for one in sums:
                one.add(some, view, products, correlation(distance, one.reach_px[view]))
    return sums
