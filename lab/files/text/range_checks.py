"""Range checks of table columns: a digit too many, a wrong unit, a placeholder."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from lab.files.text.csv_table import Table

MAX_COORDINATE_M = (
    10_000.0  # m from the origin: coordinates of a national grid must be transformed to a local frame first
)
MAX_SCAN_COORDINATE = 1e8  # units of a scanned cloud, which may be millimetres and in a national grid
MARGIN_PICTURES = 1.0  # how far outside the picture, in picture widths, a pixel is accepted: predictions lie there
MAX_TIME_S = 1e12  # s, thirty thousand years
SIGMA_RANGE_M = (1e-9, MAX_COORDINATE_M)
SIGMA_RANGE_PX = (1e-6, 1e5)
SIGMA_RANGE_DEG = (0.0, 360.0)


def check_coordinates(table: Table, names: Sequence[str], farthest_m: float = MAX_COORDINATE_M) -> None:
    """Raises InputError at the first coordinate, m, of the columns `names` that lies outside any lab."""
    xyz = table.stack(*names)
    for i, k in np.argwhere(~(np.abs(xyz) <= farthest_m))[:1]:
        raise table.error(
            i,
            f"{names[k]}: expected metres, within {farthest_m / 1e3:g} km of the origin, got {xyz[i, k]:.7g}; are these"
            " millimetres, or a national grid? give metres in the lab's own frame",
        )


def check_pixels(table: Table, sizes: Mapping[str, tuple[int, int]]) -> None:
    """Raises InputError at the first pixel (u_px, v_px) more than MARGIN_PICTURES outside its camera's picture.

    sizes: width and height, px, of each camera; rows of other cameras are not checked.
    """
    cameras = table.words["camera"]
    known = np.array([sizes.get(c, (np.inf, np.inf)) for c in cameras.words], dtype=float).reshape(-1, 2)
    size, pixels = known[cameras.codes], table.stack("u_px", "v_px")
    bad = np.argwhere((pixels < -MARGIN_PICTURES * size) | (pixels > (1 + MARGIN_PICTURES) * size))
    for i, k in bad[:1]:
        name = cameras.words[cameras.codes[i]]
        width, height = sizes[name]
        raise table.error(
            i,
            f"{('u_px', 'v_px')[k]}: expected a pixel in or near the picture of camera {name!r} ({width} x {height}"
            f" px), got {pixels[i, k]:.7g}; correct it, or remove the row",
        )


def check_sigmas(table: Table, name: str, allowed: tuple[float, float], unit: str) -> None:
    """Raises InputError at the first sigma of the column `name` outside the allowed range; nan: not given."""
    sigma, (least, largest) = table.numbers[name], allowed
    for i in np.flatnonzero((sigma < least) | (sigma > largest))[:1]:
        expected = "0 or more" if least == 0 else "a number above 0"
        if sigma[i] > largest:
            expected += f", up to {largest:g} {unit}"
        elif sigma[i] > 0:
            expected += f", from {least:g} {unit}"
        raise table.error(
            i,
            f"{name}: expected {expected}, got {sigma[i]:.7g}; give the measurement's standard deviation, or leave the"
            " field empty",
        )
