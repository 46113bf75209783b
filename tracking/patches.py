"""Square windows of a picture around many spots at once, and the pixel-integrated Gaussian on them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geometry.arrays import Array, Bools, Ints
from tracking.noise import Picture


@dataclass(frozen=True, slots=True)
class Patches:
    """n windows of s x s cells, row by row; a cell is the mean of `cell_px` x `cell_px` pixels.

    `du`, `dv` (s*s,) are the cells' centres from the windows' origins, px; a cell is `valid` if none of its pixels lies
    outside the picture or is clipped.
    """

    origin: Array  # (n, 2), px: whole or half pixels
    values: Array  # (n, s*s), DN
    valid: Bools  # (n, s*s)
    du: Array  # (s*s,), px
    dv: Array  # (s*s,), px
    cell_px: int
    side: int  # s


def cut(image: Picture, uv_px: Array, half: int, cell_px: int, saturation_dn: float) -> Patches:
    """Windows of (2 half + 1)^2 cells around points (n, 2), px, of a picture (h, w), also where they hang over its edge."""
    height, width = image.shape
    side = 2 * half + 1
    first = np.rint(uv_px - 0.5 * (side * cell_px - 1)).astype(np.int64)
    steps = np.arange(side * cell_px)
    columns, rows = first[:, :1] + steps, first[:, 1:] + steps
    inside_u, inside_v = (columns >= 0) & (columns < width), (rows >= 0) & (rows < height)
    flat = np.clip(rows, 0, height - 1)[:, :, None] * width + np.clip(columns, 0, width - 1)[:, None, :]
    raw = image.reshape(-1)[flat]
    valid = (raw < saturation_dn) & (inside_v[:, :, None] & inside_u[:, None, :])
    values = raw.astype(float)
    if cell_px > 1:
        shape = (len(uv_px), side, cell_px, side, cell_px)
        values = values.reshape(shape).mean(axis=(2, 4))
        valid = valid.reshape(shape).all(axis=(2, 4))
    along = (np.arange(side) - half) * float(cell_px)
    dv, du = np.repeat(along, side), np.tile(along, side)
    origin = first + 0.5 * (side * cell_px - 1)
    n = len(uv_px)
    return Patches(origin, values.reshape(n, -1), valid.reshape(n, -1), du, dv, cell_px, side)


@dataclass(frozen=True, slots=True)
class Profile:
    """A Gaussian of flux 1 on patches: values and what their derivatives need, each (n, s*s)."""

    value: Array  # mean over the cell, DN per DN of flux, 1/px^2
    wu: Array  # S^-1 d, 1/px
    wv: Array
    inverse: Array  # (n, 3): S^-1 as uu, uv, vv, 1/px^2


def profile(patches: Patches, rows: Ints | slice, uv_px: Array, shape_px2: Array) -> Profile:
    """The mean over each cell of a normal density with centre (n, 2), px, and covariance (n, 3: uu, uv, vv), px^2.

    The integral over the cell is a convolution with a square, whose variance is added to the covariance (S) and
    whose fourth cumulant, -cell^4/120, enters as an Edgeworth term where the spot is narrow. Against the
    exact integral the error is 0.2 % of the peak at sigma 0.5 px, below 1e-4 from 0.8 px on.
    """
    cell = float(patches.cell_px)
    suu, suv, svv = shape_px2[:, 0] + cell**2 / 12, shape_px2[:, 1], shape_px2[:, 2] + cell**2 / 12
    determinant = suu * svv - suv**2
    auu, auv, avv = svv / determinant, -suv / determinant, suu / determinant
    offset = patches.origin[rows] - uv_px
    du = patches.du + offset[:, :1]
    dv = patches.dv + offset[:, 1:]
    wu = auu[:, None] * du + auv[:, None] * dv
    wv = auv[:, None] * du + avv[:, None] * dv
    value = np.exp(-0.5 * (du * wu + dv * wv)) / (2 * np.pi * np.sqrt(determinant))[:, None]
    narrow = np.maximum(auu, avv) * cell**2 > 0.5
    if narrow.any():
        term = 0.0
        for w, a in ((wu[narrow], auu[narrow, None]), (wv[narrow], avv[narrow, None])):
            w2 = w * w
            term = term + w2 * w2 - 6 * a * w2 + 3 * a * a
        value[narrow] *= np.maximum(1 - cell**4 / 2880 * term, 0.0)
    return Profile(value, wu, wv, np.stack([auu, auv, avv], axis=1))
