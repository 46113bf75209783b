"""Errors of a spot that stay the same while the spot stays in its place, and that averaging does not lessen.

Texture and speckle of the screen, the skewed shape of an oblique spot and the phase of the pixels shift a centroid by
an amount that belongs to the place on the screen. A vehicle at rest shows the same shift in every frame; a spot that
has moved by its own width shows another one. The share of such errors in the variance follows from the residuals of a
smoothed run: the products of one view's residuals in two frames vanish for noise, and not for these errors. Ours.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geometry.arrays import Array

USUAL_WIDTH_PX = 2.0  # of spots whose width is not known
_CHUNK = 256  # frames that are compared with each other
_ALIKE = 0.05  # correlation below which two places count as different
_REACHES = (1.0, 2.0, 4.0, 8.0)  # widths of the spot
_SIGNIFICANT = 3.0  # sigmas of what noise alone shows
_LARGEST_STUDENT = 3.0  # that of three free numbers
_MOST_ABSORBED = 0.8  # share of the errors that the poses take up, above which the residuals say too little


@dataclass(frozen=True, slots=True)
class PlaceErrors:
    """T frames."""

    share: float  # of the spots' error variance, in [0, 1]
    alike: Array  # (T,) number of frames, this one included, with the same errors; mean over the views
    reach_px: Array  # (n,) distance over which they are alike, as the sigma of a spot that they are a mean over
    elsewhere: float = 0.0  # what share of it is the same in all places: errors of the rig, not of a place
    few: float = 1.0  # factor of their variance for what so few places leave unknown of it

    def factor(self, averaged: Array) -> Array:
        """(T,) by which covariances grow that were made as if all errors were new in each frame.

        averaged (T,): number of frames that each pose is a mean of.
        """
        return np.asarray(1 + self.share * (self.few * np.minimum(self.alike, np.maximum(averaged, 1.0)) - 1))


def correlation(distance_px: Array, width_px: Array | float) -> Array:
    """Of the errors in two places so far apart, of a spot of this sigma.

    The error is a mean over the spot, so its correlation is that of two Gaussians of sigma `width_px`:
    exp(-d^2 / (4 width^2)).
    """
    rho = np.exp(-0.25 * (distance_px / width_px) ** 2)
    return np.asarray(np.where(rho < _ALIKE, 0.0, rho))


def place_errors(residual: Array, uv_px: Array, width_px: Array, averaged: Array, explained: Array) -> PlaceErrors:
    """What a run's residuals say of errors that belong to places.

    residual (T, n, 2): labelled pixels less those of the smoothed poses, in sigmas; nan without a label. uv_px
    (T, n, 2): the pixels. width_px (n,): sigma of the spots, nan where not known. averaged (T,): number of frames that
    each pose is a mean of. explained (n,): share of the residuals' variance that calibration errors are expected to
    make, which are constant as well.
    """
    width = np.where(np.isfinite(width_px), np.maximum(width_px, 0.5), USUAL_WIDTH_PX)
    labelled = np.isfinite(residual[..., 0])
    count = float(np.mean(labelled.sum(axis=1)[labelled.any(axis=1)])) if labelled.any() else 0.0
    absorbed = min(3.0 / max(count, 1e-9), _MOST_ABSORBED)
    # Coarse structure of the screen and its edges reach farther than a spot is wide: what the residuals show best.
    reaches = [r * width for r in _REACHES]
    sums = max((_products(residual, uv_px, reach, explained) for reach in reaches), key=lambda p: p.significance)
    alike = np.where(labelled.any(axis=1), (sums.alike * labelled).sum(axis=1) / np.maximum(labelled.sum(axis=1), 1), 1)
    # The poses take up so much of the residuals that fewer numbers are free than there are.
    if sums.significance * np.sqrt(1 - absorbed) < _SIGNIFICANT:
        return PlaceErrors(0.0, alike, sums.reach_px)
    seen = sums.near / sums.expected
    place = min(seen, 1.0) / (1 - absorbed)
    white = max(1 - seen, 0.0) / (1 - absorbed / float(np.median(np.maximum(averaged, 1.0))))
    # Few places say little of the size of their errors: Student's distribution is wider by this factor in variance.
    free = 2 * (1 - absorbed) * float(np.sum(labelled / np.maximum(sums.alike, 1.0)))
    few = min(free / max(free - 2, 1e-9), _LARGEST_STUDENT)
    return PlaceErrors(place / (place + white), alike, sums.reach_px, sums.elsewhere, few)


@dataclass(frozen=True, slots=True)
class _Products:
    """Sums over pairs of frames of the products of a view's residuals, over their mean square."""

    reach_px: Array  # (n,) over which errors are taken to be alike
    alike: Array  # (T, n) number of frames with the same errors
    near: float  # weighted by the correlation of their places, less what the calibration explains
    expected: float  # the same if all errors belonged to places
    elsewhere: float  # mean over pairs in different places

    @property
    def significance(self) -> float:
        """`near` in sigmas of what white residuals in two coordinates would show."""
        return self.near / np.sqrt(0.5 * self.expected) if self.expected > 0 else 0.0


def _products(residual: Array, uv_px: Array, reach_px: Array, explained: Array) -> _Products:
    alike = np.ones(residual.shape[:2])
    near = expected = far = far_pairs = 0.0
    for view in range(residual.shape[1]):
        rows = np.flatnonzero(np.isfinite(residual[:, view]).all(axis=-1))
        mean_square = float(np.mean(np.sum(residual[rows, view] ** 2, axis=-1))) if len(rows) > 1 else 0.0
        if mean_square <= 0:
            continue
        for start in range(0, len(rows), _CHUNK):
            some = rows[start : start + _CHUNK]
            r, at = residual[some, view], uv_px[some, view]
            products = r @ r.T / mean_square
            rho = correlation(np.linalg.norm(at[:, None] - at[None], axis=-1), reach_px[view])
            far += float(np.sum(products[rho == 0]))
            far_pairs += float(np.count_nonzero(rho == 0))
            np.fill_diagonal(rho, 0.0)
            alike[some, view] = 1 + rho.sum(axis=1)
            # Each pair is counted twice.
            near += 0.5 * float(np.sum(rho * products) - explained[view] * np.sum(rho**2))
            expected += 0.5 * float(np.sum(rho**2))
    return _Products(reach_px, alike, near, expected, max(far / far_pairs, 0.0) if far_pairs else 0.0)
