"""Tables of a beam calibration: beams.csv, angles.csv, residuals.csv."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from calibration.beams.beam_start import world_points
from calibration.beams.beams import BeamCalibration
from geometry.arrays import Array
from geometry.rig import Rig
from lab.calibrate.beams.beam_findings import ARCSEC
from lab.files.text.atomic_write import atomic_write_text
from lab.files.text.csv_text import csv_text

BEAMS, ANGLES, RESIDUALS = "beams.csv", "angles.csv", "residuals.csv"
BEAM_COLUMNS = (
    "beam", "dx", "dy", "dz", "px_m", "py_m", "pz_m", "sigma_direction_arcsec", "sigma_offset_mm",
    "from_drawing_arcsec", "from_drawing_mm",
)  # fmt: skip
ANGLE_COLUMNS = ("first", "second", "angle_deg", "sigma_arcsec")
RESIDUAL_COLUMNS = (
    "position", "camera", "spot", "u_px", "v_px", "residual_u_px", "residual_v_px", "residual_mm", "sigmas", "used",
)  # fmt: skip


def write_tables(c: BeamCalibration, nominal: Rig, positions: Sequence[str], folder: Path) -> None:
    """Write the three tables. nominal: the rig with the beams as designed; positions: names of all positions."""
    atomic_write_text(_beam_table(c, nominal), folder / BEAMS)
    atomic_write_text(_angle_table(c), folder / ANGLES)
    atomic_write_text(_residual_table(c, positions), folder / RESIDUALS)


def _beam_table(c: BeamCalibration, nominal: Rig) -> str:
    rows = []
    off = difference_from_nominal(c, nominal)
    for i, name in enumerate(c.rig.beams):
        numbers = [*c.lines.directions[i], *c.lines.points[i]]
        figures = [c.direction_sigmas[i] / ARCSEC, 1e3 * c.offset_sigmas[i], off[i, 0] / ARCSEC, 1e3 * off[i, 1]]
        if c.undetermined:
            figures[:2] = [np.nan, np.nan]
        rows.append([name, *(f"{v:.12g}" for v in numbers), *(_short(v) for v in figures)])
    return csv_text(BEAM_COLUMNS, rows)


def _angle_table(c: BeamCalibration) -> str:
    rows = [[a.first, a.second, f"{np.rad2deg(a.angle):.9g}", _short(a.sigma / ARCSEC)] for a in c.angles]
    return csv_text(ANGLE_COLUMNS, rows)


def _residual_table(c: BeamCalibration, positions: Sequence[str]) -> str:
    names = used_positions(c, positions)
    views = c.rig.views()
    mm = residuals_mm(c)
    rows = []
    for i in range(len(c.spots)):
        camera, spot = views[c.spots.view[i]]
        numbers = [*c.spots.pixels[i], *c.fit.residuals_px[i], mm[i], c.fit.sigmas[i]]
        words = [names[c.spots.position[i]], camera, spot]
        rows.append([*words, *(_short(v) for v in numbers), "yes" if c.fit.kept[i] else "no"])
    return csv_text(RESIDUAL_COLUMNS, rows)


def used_positions(c: BeamCalibration, positions: Sequence[str]) -> list[str]:
    """Names of the positions that the calibration uses, in its order."""
    return [p for i, p in enumerate(positions) if i not in set(c.dropped)]


def residuals_mm(c: BeamCalibration) -> Array:
    """Distance (N,) on the screen between each measured spot and its prediction, mm."""
    predicted = replace(c.spots, pixels=c.spots.pixels - c.fit.residuals_px)
    return 1e3 * np.linalg.norm(world_points(c.rig, c.spots) - world_points(c.rig, predicted), axis=1)


def difference_from_nominal(c: BeamCalibration, nominal: Rig) -> Array:
    """Difference (k, 2) of each beam from its design: angle (rad), and distance (m) across the beam at its point."""
    out = []
    for i, b in enumerate(nominal.beams.values()):
        d = c.lines.directions[i]
        gap = np.cross(c.lines.points[i] - b.point, b.direction)
        out.append((np.arctan2(np.linalg.norm(np.cross(d, b.direction)), d @ b.direction), np.linalg.norm(gap)))
    return np.array(out)


def _short(value: float) -> str:
    return f"{value:.6g}" if np.isfinite(value) else ""
