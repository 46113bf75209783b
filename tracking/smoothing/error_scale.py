"""By how much the spots' errors exceed what their detections claim, from the residuals of the frames' own fits."""

from __future__ import annotations

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.compiled_projection import Views
from tracking.rigid_body.information import fit_alone
from tracking.rigid_body.variance_factor import DEADBAND
from tracking.smoothing.fixed_interval import Reference
from tracking.smoothing.reassociation import AllDetections, labelled_points

# Share of a spot's sigma by which texture, speckle and its shape shift its centre at most: 4 % texture makes 0.04,
# speckle of contrast 0.3 makes 0.1.
LARGEST_WIDTH_SHARE = 0.1
_FRAMES = 300  # from which that share is estimated


def width_covariance(width_px: Array, share: float) -> Array:
    """(m, 2, 2) of errors that are this share of the spots' sigmas (m,), px; 0 where these are not known."""
    return ((share * np.nan_to_num(width_px, nan=0.0)) ** 2)[:, None, None] * np.eye(2)


def width_share(
    views: Views, every: AllDetections, assigned: Ints, calibration_cov: Array, ref: Reference, measured: Bools
) -> float:
    """Errors beyond the claimed ones as a share of the spots' widths; 0 if the claims are right or no width is known.

    Texture and speckle shift a spot in proportion to its width, whatever its noise is: where the residuals are larger
    than claimed, that is added before all claims are scaled (`noise_scale`).
    """
    if not np.isfinite(every.size_px).any():
        return 0.0
    frames = _evenly_spread(np.flatnonzero(measured), _FRAMES)

    def misfit(share: float) -> float:
        wider = every._replace(cov=every.cov + width_covariance(every.size_px, share))
        return _mean_misfit(views, wider, assigned, calibration_cov, ref, frames)

    if misfit(0.0) <= DEADBAND:
        return 0.0
    low, high = 0.0, LARGEST_WIDTH_SHARE
    if misfit(high) > 1.0:
        return high
    for _ in range(8):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if misfit(middle) > 1.0 else (low, middle)
    return 0.5 * (low + high)


def _evenly_spread(rows: Ints, most: int) -> Ints:
    """At most so many of the rows, evenly spread."""
    return rows if len(rows) <= most else rows[np.linspace(0, len(rows) - 1, most).astype(np.int64)]


def noise_scale(
    views: Views, every: AllDetections, assigned: Ints, calibration_cov: Array, ref: Reference, measured: Bools
) -> float:
    """How much larger than claimed the spots' errors are, from the frames' own fits; 1 if the claims are right."""
    mean = _mean_misfit(views, every, assigned, calibration_cov, ref, np.flatnonzero(measured))
    return float(np.sqrt(mean)) if mean > DEADBAND else 1.0


def _mean_misfit(
    views: Views, every: AllDetections, assigned: Ints, calibration_cov: Array, ref: Reference, frames: Ints
) -> float:
    """Chi-square per degree of freedom of the frames' own fits, robust to outliers; 1 where no frame can tell."""
    shares = []
    for k in frames.tolist():
        use, uv, cov = labelled_points(every, k, assigned[k], calibration_cov)
        _, _, _, chi2, count = fit_alone(views, ref.R[k], ref.t[k], use, uv, cov)
        if count > 3:
            shares.append(chi2 / (2 * count - 6))
    return float(np.mean(np.minimum(shares, 3 * np.median(shares)))) if shares else 1.0
