"""Numbers in tables that no lab and no camera can have: a digit too many, a wrong unit, a placeholder."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from geometry.arrays import Array
from lab.errors import InputError

FARTHEST_M = 10_000.0  # m from the origin: surveys in national grids are carried over to a lab's own frame first
FARTHEST_IN_SCAN = 1e8  # units of a scanned cloud, which may be millimetres and in a national grid
BEYOND = 1.0  # pictures beyond the picture's edge: a spot outside it may be foretold there, but none is measured
SIGMAS_M = (1e-9, FARTHEST_M)
SIGMAS_PX = (1e-6, 1e5)
SIGMAS_DEG = (0.0, 360.0)


def refuse_far_places(
    path: Path, lines: Sequence[int], names: Sequence[str], xyz: Array, farthest_m: float = FARTHEST_M
) -> None:
    """Raises InputError at the first coordinate of xyz (n, k), m, that lies outside any lab. names: the k columns."""
    bad = np.argwhere(~(np.abs(xyz) <= farthest_m))
    if len(bad):
        i, k = bad[0]
        raise InputError(
            f"{path}: line {lines[i]}: {names[k]}: expected metres, within {farthest_m / 1e3:g} km of the origin, got"
            f" {xyz[i, k]:.7g}; are these millimetres, or a national grid? give metres in the lab's own frame"
        )


def refuse_far_pixels(
    path: Path, lines: Sequence[int], cameras: Sequence[str], pixels: Array, sizes: Mapping[str, tuple[int, int]]
) -> None:
    """Raises InputError at the first of pixels (n, 2) more than `BEYOND` pictures outside its camera's picture.

    sizes: width and height, px, of each camera; pixels of other cameras are passed over.
    """
    known = np.array([sizes.get(c, (np.inf, np.inf)) for c in cameras], dtype=float).reshape(-1, 2)
    bad = np.argwhere((pixels < -BEYOND * known) | (pixels > (1 + BEYOND) * known))
    if len(bad):
        i, k = bad[0]
        width, height = sizes[cameras[i]]
        raise InputError(
            f"{path}: line {lines[i]}: {('u_px', 'v_px')[k]}: expected a pixel in or near the picture of camera"
            f" {cameras[i]!r} ({width} x {height} px), got {pixels[i, k]:.7g}; correct it, or remove the row"
        )


def refuse_sigmas(
    path: Path, lines: Sequence[int], name: str, sigma: Array, allowed: tuple[float, float], unit: str
) -> None:
    """Raises InputError at the first sigma (n,) outside what is allowed; nan stands for none."""
    least, largest = allowed
    bad = np.flatnonzero((sigma < least) | (sigma > largest))
    if bad.size:
        i = bad[0]
        expected = "0 or more" if least == 0 else "a number above 0"
        if sigma[i] > largest:
            expected += f", up to {largest:g} {unit}"
        elif sigma[i] > 0:
            expected += f", from {least:g} {unit}"
        raise InputError(
            f"{path}: line {lines[i]}: {name}: expected {expected}, got {sigma[i]:.7g}; give the measurement's standard"
            " deviation, or leave the field empty"
        )
