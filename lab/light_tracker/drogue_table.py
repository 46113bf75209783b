"""drogue.csv: a row for every frame number from the first to the last, dropped ones too."""

from __future__ import annotations

import numpy as np

from tracking.light_tracker.frames import DrogueFrame

DROGUE = (
    "frame", "t_s", "u_px", "v_px", "diameter_px", "sigma_u_px", "sigma_v_px", "sigma_diameter_px", "status", "cause",
    "confidence", "source", "correlation", "rate_u_px_s", "rate_v_px_s", "cov_uv_px2", "searched", "found", "event",
)  # fmt: skip


def drogue_row(number: int, rate_hz: float, frame: DrogueFrame) -> list[object]:
    """The row of one frame. Fields without a value are empty."""
    sigma = np.sqrt(np.diag(frame.covariance)).tolist()
    rates = (rate_hz * frame.rate_px).tolist()
    return [
        number,
        f"{number / rate_hz:.9g}",
        *map(_text, (*frame.centre_px.tolist(), frame.diameter_px, *sigma, frame.sigma_diameter_px)),
        frame.status.value,
        frame.cause.value,
        _text(frame.confidence),
        frame.source.value,
        *map(_text, (frame.correlation, *rates)),
        _text(float(frame.covariance[0, 1]), 7),
        frame.searched,
        frame.found if frame.searched else "",
        frame.event,
    ]


def _text(value: float, decimals: int = 4) -> str:
    return f"{value:.{decimals}f}" if np.isfinite(value) else ""
