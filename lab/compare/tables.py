"""The tables of a comparison: differences.csv, allan.csv and comparison.json."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from lab.compare.compare import Comparison
from lab.files.text.csv_text import write_table
from lab.files.text.json_text import write_json
from lab.versions import versions
from tracking.comparison.frame_alignment import PARAMETERS

SCHEMA = "beampose/comparison/1"
SUMMARY = "comparison.json"
DIFFERENCES = (
    "frame", "t_s", "reference_t_s", "dx_m", "dy_m", "dz_m", "rotation_x_deg", "rotation_y_deg", "rotation_z_deg",
    "dyaw_deg", "dpitch_deg", "droll_deg", "sigma_dx_m", "sigma_dy_m", "sigma_dz_m", "sigma_rotation_x_deg",
    "sigma_rotation_y_deg", "sigma_rotation_z_deg", "chi2", "used",
)  # fmt: skip
ALLAN = ("angle", "tau_s", "deviation_deg", "low_deg", "high_deg", "slope", "degrees_of_freedom")


def write_tables(comparison: Comparison, folder: Path) -> None:
    """Write the tables into a folder. Raises InputError."""
    found = comparison.differences
    degrees = np.rad2deg
    place, turn = found.values[:, :3], degrees(found.values[:, 3:])
    sigmas = np.concatenate([found.sigmas[:, :3], degrees(found.sigmas[:, 3:])], axis=1)
    numbers = np.column_stack([place, turn, degrees(found.ypr), sigmas, found.chi2])
    rows: list[list[object]] = []
    for i, frame in enumerate(comparison.frames.tolist()):
        cells = ["" if not np.isfinite(v) else f"{v:.9g}" for v in numbers[i].tolist()]
        times = (f"{comparison.t_s[i]:.12g}", f"{found.reference_t_s[i]:.16g}" if found.known[i] else "")
        rows.append([frame, *times, *cells, int(comparison.used[i])])
    write_table(folder / "differences.csv", DIFFERENCES, rows)
    if comparison.still is not None:
        rows = []
        for name, a in comparison.still.of_result:
            columns = np.stack([a.tau_s, a.deviation, a.low, a.high, a.slope, a.freedom], axis=1)
            rows += [[name, *(f"{v:.6g}" for v in row)] for row in columns.tolist()]
        write_table(folder / "allan.csv", ALLAN, rows)
    write_json(_summary(comparison), folder / SUMMARY)


def _summary(comparison: Comparison) -> dict[str, Any]:
    return {
        "schema": SCHEMA,
        "result": str(comparison.result),
        "other": str(comparison.other),
        "versions": versions(),
        "frames": {
            "result": len(comparison.frames),
            "in_common": int(comparison.differences.known.sum()),
            "used": int(comparison.used.sum()),
        },
        "alignment": _alignment(comparison),
        "statistics": {
            a.name.replace(" ", "_") + f"_{a.unit}": {
                "mean": [a.figures.mean, a.figures.mean_sigma],
                "rms": [a.figures.rms, a.figures.rms_sigma],
                "median": [a.figures.median, a.figures.median_sigma],
                "largest": a.figures.largest,
                "largest_frame": int(comparison.frames[a.figures.largest_index]),
            }
            for a in comparison.axes
        },
        "chi_square": {"per_degree_of_freedom": comparison.noise.factor, "sigma": comparison.noise.sigma},
        "notes": list(comparison.notes),
    }


def _alignment(comparison: Comparison) -> dict[str, Any] | None:
    e = comparison.estimate
    if e is None:
        return None
    a = e.alignment
    estimated = [name for name, free in zip(PARAMETERS, e.free.tolist(), strict=True) if free]
    return {
        "offset_s": a.offset_s,
        "rate": a.rate,
        "middle_s": a.middle_s,
        "world": a.world.tolist(),
        "body": a.body.tolist(),
        "lever_m": a.lever_m.tolist(),
        "translation_m": a.translation_m.tolist(),
        "estimated": estimated,
        "sigmas": dict(zip(PARAMETERS, e.sigmas.tolist(), strict=True)),
        "covariance": e.covariance.tolist(),
        "undetermined": {
            "clocks": list(e.determined.undetermined),
            "world_axes": e.determined.world_axes.tolist(),
            "lever_axes": e.determined.lever_axes.tolist(),
            "other_offsets_s": list(e.other_offsets),
        },
    }
