"""The tables that `calibrate screen` writes: what each pixel and each dot misses."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from calibration.screens.screens import ScreensResult
from lab.files.text.csv_text import write_table

RESIDUALS, DOTS = "residuals.csv", "dots.csv"
RESIDUAL_COLUMNS = ("camera", "point", "u_px", "v_px", "residual_u_px", "residual_v_px", "sigmas", "used")
DOT_COLUMNS = ("point", "screen", "x_m", "y_m", "z_m", "shift_x_m", "shift_y_m", "shift_z_m", "height_m", "used")


def write_tables(result: ScreensResult, folder: Path) -> None:
    """residuals.csv (a row per pixel of a dot, and per corner of a board) and dots.csv (a row per surveyed dot).

    Residuals are measured less predicted; a corner's `point` is its board's place. Shifts are adjusted less surveyed;
    height_m is that over the screen's surface, `used` whether a pixel or a dot took part.
    """
    network, fit = result.network, result.fit
    cameras, screens = list(fit.rig.cameras), list(fit.rig.screens)
    s = network.sightings
    rows: list[list[object]] = []
    for i in range(len(s)):
        names = [cameras[s.camera_of[i]], network.dots.names[s.dot_of[i]]]
        sigmas = round(float(fit.sighting_sigmas[i]), 3)
        rows.append([*names, *s.pixels[i].round(4), *fit.sighting_errors_px[i].round(4), sigmas, int(fit.used[i])])
    if fit.corners is not None:
        c = fit.corners
        off = np.linalg.norm(fit.corner_errors_px, axis=1) / c.sigma_px
        for i in range(len(c)):
            names = [cameras[c.camera[i]], network.placements[c.placement[i]]]
            rows.append([*names, *c.pixels[i].round(4), *fit.corner_errors_px[i].round(4), round(float(off[i]), 3), 1])
    write_table(folder / RESIDUALS, RESIDUAL_COLUMNS, rows)
    height = np.full(len(network.dots), np.nan)
    used = np.ones(len(network.dots), dtype=bool)
    for screen in result.screens:
        if screen.dots and screen.flatness is not None:
            height[list(screen.dots)] = screen.flatness.chosen.heights_m
            used[list(screen.dots)] = screen.used
    places = network.dots.xyz + fit.dot_shifts_m
    dots: list[list[object]] = []
    for i, (name, k) in enumerate(zip(network.dots.names, network.dots.screen_of, strict=True)):
        over = "" if np.isnan(height[i]) else round(float(height[i]), 7)
        screen_name = "" if k < 0 else screens[k]
        dots.append([name, screen_name, *places[i].round(7), *fit.dot_shifts_m[i].round(7), over, int(used[i])])
    write_table(folder / DOTS, DOT_COLUMNS, dots)
