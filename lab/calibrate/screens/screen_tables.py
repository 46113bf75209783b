"""Tables of `calibrate screen`: residuals of pixels and control points."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from calibration.screens.screens import ScreensResult
from lab.files.text.csv_text import write_table

RESIDUALS, DOTS = "residuals.csv", "dots.csv"
RESIDUAL_COLUMNS = ("camera", "point", "u_px", "v_px", "residual_u_px", "residual_v_px", "sigmas", "used")
DOT_COLUMNS = ("point", "screen", "x_m", "y_m", "z_m", "shift_x_m", "shift_y_m", "shift_z_m", "height_m", "used")


def write_tables(result: ScreensResult, folder: Path) -> None:
    """Write residuals.csv (a row per observation and per board corner) and dots.csv (a row per control point).

    Residuals are measured minus predicted; the `point` of a corner is the name of its board placement. Shifts are
    adjusted minus surveyed; height_m is the height above the screen's surface, `used` whether the row was used.
    """
    network, fit = result.network, result.fit
    cameras, screens = list(fit.rig.cameras), list(fit.rig.screens)
    s = network.point_observations
    rows: list[list[object]] = []
    for i in range(len(s)):
        names = [cameras[s.camera_of[i]], network.control_points.names[s.point_of[i]]]
        sigmas = round(float(fit.normalised_residuals[i]), 3)
        rows.append(
            [*names, *s.pixels[i].round(4), *fit.observation_residuals_px[i].round(4), sigmas, int(fit.used[i])]
        )
    if fit.corners is not None:
        c = fit.corners
        in_sigmas = np.linalg.norm(fit.corner_errors_px, axis=1) / c.sigma_px
        for i in range(len(c)):
            names = [cameras[c.camera[i]], network.placements[c.placement[i]]]
            rows.append(
                [*names, *c.pixels[i].round(4), *fit.corner_errors_px[i].round(4), round(float(in_sigmas[i]), 3), 1]
            )
    write_table(folder / RESIDUALS, RESIDUAL_COLUMNS, rows)
    height = np.full(len(network.control_points), np.nan)
    used = np.ones(len(network.control_points), dtype=bool)
    for screen in result.screens:
        if screen.control_points and screen.flatness is not None:
            height[list(screen.control_points)] = screen.flatness.chosen.heights_m
            used[list(screen.control_points)] = screen.used
    xyz = network.control_points.xyz + fit.control_point_shifts_m
    points: list[list[object]] = []
    for i, (name, k) in enumerate(zip(network.control_points.names, network.control_points.screen_of, strict=True)):
        height_m = "" if np.isnan(height[i]) else round(float(height[i]), 7)
        screen_name = "" if k < 0 else screens[k]
        points.append(
            [name, screen_name, *xyz[i].round(7), *fit.control_point_shifts_m[i].round(7), height_m, int(used[i])]
        )
    write_table(folder / DOTS, DOT_COLUMNS, points)
