"""circle.csv: a row for every frame number from the first to the last, dropped ones too."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tracking.drogue_circle.frames import CircleFrame

CIRCLE = (
    "frame", "t_s", "u_px", "v_px", "radius_px", "sigma_u_px", "sigma_v_px", "sigma_radius_px", "status", "cause",
    "predicted_u_px", "predicted_v_px", "predicted_radius_px", "rate_u_px_s", "rate_v_px_s", "rate_radius_px_s",
    "sigma_rate_u_px_s", "sigma_rate_v_px_s", "sigma_rate_radius_px_s", "cov_uv_px2", "occlusion", "coverage", "rms_px",
    "measured_u_px", "measured_v_px", "measured_radius_px", "major_px", "minor_px", "angle_deg",
)  # fmt: skip


def circle_row(number: int, rate_hz: float, frame: CircleFrame) -> list[object]:
    """The row of one frame. Fields without a value are empty."""
    sigma = np.sqrt(np.diag(frame.covariance))
    fit = frame.measured
    rates, rate_sigmas = rate_hz * frame.state[3:], rate_hz * sigma[3:]
    # As many digits as the measurement resolves: a tenth of a millipixel.
    cells = [*_texts(frame.state[:3]), *_texts(sigma[:3]), frame.status.value, frame.cause.value]
    cells += [*_texts(frame.predicted), *_texts(rates), *_texts(rate_sigmas)]
    cells += _texts([frame.covariance[0, 1]], 7) + _texts([frame.occlusion])
    if fit is None:
        cells += [""] * 8
    else:
        away = float(np.hypot(fit.rim.cos2_px, fit.rim.sin2_px))
        angle = 0.5 * np.degrees(np.arctan2(fit.rim.sin2_px, fit.rim.cos2_px))
        angle = 90.0 - (90.0 - angle) % 180.0 if away else 0.0  # into (-90, 90]
        radius = fit.rim.radius_px
        cells += _texts([fit.coverage, fit.rms_px, *fit.circle, radius + away, radius - away, angle])
    return [number, f"{number / rate_hz:.9g}", *cells]


def _texts(values: Sequence[float] | np.ndarray, decimals: int = 4) -> list[str]:
    return [f"{v:.{decimals}f}" if np.isfinite(v) else "" for v in values]
