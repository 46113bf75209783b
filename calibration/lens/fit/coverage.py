"""Coverage of the sensor by the board, and the range of its tilts."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import cv2
import numpy as np

from calibration.lens.fit.corner_table import CornerTable
from geometry.arrays import Array, Bools
from geometry.pose import Pose

_CELLS = 96  # across the picture, for the covered share
_NEAR_CORNER = 0.18  # of the diagonal: a board point this near to the picture's corner determines the lens there
_NEAR_SIDE = 0.12  # of the picture's width or height


@dataclass(frozen=True, slots=True)
class Coverage:
    """Areas of the sensor and directions from which the board was seen."""

    filled: float  # share of the picture's area inside the corners of some view
    gaps: tuple[str, ...]  # sides and corners of the picture without board points near them
    tilt_deg: Array  # (V,): of the board's normal against the optical axis; nan where not used
    azimuth_deg: Array  # (V,): direction of that tilt
    spread_deg: float  # the largest angle between two boards' normals


def coverage_of(table: CornerTable, used: Bools, camera_from_board: Pose) -> Coverage:
    """Coverage by the used corners (N,), with the V poses of the board."""
    in_use = table.counts(used) > 0
    normals = camera_from_board.rotation[..., 2]
    tilt = np.degrees(np.arccos(np.clip(normals[:, 2], -1, 1)))
    azimuth = np.degrees(np.arctan2(normals[:, 1], normals[:, 0]))
    return Coverage(
        filled=float(_mask(table, used).mean()),
        gaps=_gaps(table.pixels[used], table.image_size_px),
        tilt_deg=np.where(in_use, tilt, np.nan),
        azimuth_deg=np.where(in_use, azimuth, np.nan),
        spread_deg=spread_deg(normals[in_use]),
    )


def spread_deg(normals: Array) -> float:
    """The largest angle between any two unit vectors (n, 3); 0 for fewer than two."""
    if len(normals) < 2:
        return 0.0
    return float(np.degrees(np.arccos(np.clip(normals @ normals.T, -1, 1).min())))


def seen_at(table: CornerTable, used: Bools, pixels: Array) -> Bools:
    """Which pixels (..., 2) lie inside the corners of some view; False for nan."""
    mask = _mask(table, used)
    scale = _CELLS / table.image_size_px[0]
    cell = np.nan_to_num((pixels + 0.5) * scale, nan=-1.0)
    i, j = np.floor(cell[..., 1]).astype(int), np.floor(cell[..., 0]).astype(int)
    inside = (i >= 0) & (j >= 0) & (i < mask.shape[0]) & (j < mask.shape[1])
    out: Bools = inside & mask[np.clip(i, 0, mask.shape[0] - 1), np.clip(j, 0, mask.shape[1] - 1)]
    return out


def _mask(table: CornerTable, used: Bools) -> Bools:
    """(rows, _CELLS): the parts of the picture inside the corners of some view."""
    width, height = table.image_size_px
    scale = _CELLS / width
    mask = np.zeros((max(1, round(height * scale)), _CELLS), dtype=np.uint8)
    for v in np.flatnonzero(table.counts(used) > 2):
        corners = (table.pixels[used & (table.view == v)] + 0.5) * scale - 0.5
        cv2.fillConvexPoly(mask, cv2.convexHull(corners.astype(np.float32)).round().astype(np.int32), 1)
    return np.asarray(mask > 0)


def _gaps(pixels: Array, size: tuple[int, int]) -> tuple[str, ...]:
    width, height = size
    u, v = pixels.T
    sides = {
        "left side": u.min() / width,
        "right side": 1 - u.max() / width,
        "top": v.min() / height,
        "bottom": 1 - v.max() / height,
    }
    empty = [name for name, share in sides.items() if share > _NEAR_SIDE]
    diagonal = np.hypot(width, height)
    for (row, y), (column, x) in product((("top", 0), ("bottom", height)), (("left", 0), ("right", width))):
        name = f"{row} {column} corner"
        side_is_empty = any(word in name for side in empty for word in side.split()[:1])
        if not side_is_empty and np.hypot(u - x, v - y).min() / diagonal > _NEAR_CORNER:
            empty.append(name)
    return tuple(empty)
