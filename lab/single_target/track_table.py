"""track.csv: the target's position, velocity and covariance in every frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lab.files.text.csv_text import write_table
from lab.single_target.recording import PointRecording
from tracking.detections import UNMATCHED
from tracking.single_target.point_tracker import PointEstimate

_UPPER = np.triu_indices(4)
COLUMNS = (
    "frame", "t_s", "u_px", "v_px", "sigma_u_px", "sigma_v_px", "status", "predicted_u_px", "predicted_v_px", "nis",
    "measured_u_px", "measured_v_px", "velocity_u_px_frame", "velocity_v_px_frame", "velocity_u_px_s",
    "velocity_v_px_s", *(f"c{i}{j}" for i in range(4) for j in range(i, 4)),
)  # fmt: skip
"""The entries c00 to c33 are the upper triangle of the covariance of u, v (px) and their rates (px/frame)."""


def write_track(recording: PointRecording, track: list[PointEstimate], path: Path) -> None:
    """Write the table: a row per frame number, with empty fields for what is not known.

    Raises:
        InputError: the file cannot be written.
    """
    write_table(path, COLUMNS, (_row(recording, track, k) for k in range(len(track))))


def _row(recording: PointRecording, track: list[PointEstimate], k: int) -> list[object]:
    e, found = track[k], recording.found[k]
    t = None if recording.t_s is None else float(recording.t_s[k])
    measured = [np.nan, np.nan] if found is None or e.row == UNMATCHED else found.uv_px[e.row].tolist()
    rate = np.nan if recording.rate_hz is None else recording.rate_hz
    sigma = np.sqrt(np.diagonal(e.P)[:2]).tolist()
    velocity = [*e.x[2:].tolist(), *(e.x[2:] * rate).tolist()]
    numbers = [*measured, *velocity, *e.P[_UPPER].tolist()]
    return [
        int(recording.frames[k]),
        _number(t),
        *map(_number, (*e.x[:2].tolist(), *sigma)),
        e.status.value,
        *map(_number, (*e.predicted_px.tolist(), e.nis)),
        *map(_number, numbers),
    ]


def _number(value: float | None) -> str:
    """Ten significant digits; empty for None and nan."""
    return "" if value is None or value != value else f"{value:.10g}"
