"""The occlusion coefficient: the area of the target that is seen, against the expected one.

Zhou (2014), eq. (4), divides the area by that of the previous frame. Then the coefficient returns to zero one frame
after an occlusion has begun, and an approach counts as one. Here gamma = clip(1 - N_t / N_exp), where N_exp is a
share of the disc's area pi r^2 that is estimated while the target is clear.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from geometry.arrays import Array, Bools, upper_median
from tracking.drogue_circle.rim_fit import SECTORS, RimFit
from tracking.noise import Picture

_RINGS, _FINE = 20, 2  # of the cells, and their sectors in one of the rim's: 1280 of a 20th of the radius
_INSET_PX, _LARGEST_PX = 1.0, 60.0  # from the rim, whose blur mixes with what is behind; radius without reduction
_MATCH = 3.0  # mean absolute deviations within which a cell looks as before
_LEAST_DEVIATION = 0.06  # least deviation, as a share of the contrast of the target
_LIGHT = 0.15  # largest change of the light from the mean appearance, as a share of the grey level
_RATE, _FIRST = 0.1, 8  # of the running means; the first frames are averaged
_NEXT_TO_RIM, _SECTOR_SHARE = 0.75, 0.5  # part of the radius, and least share of its cells in a sector that match
_USUAL = 0.35  # share of the rays of a sector, below which its edges are left out
_CLEAR = 0.2  # coefficient below which the rim of a frame is that of a clear target
_CHANGED = 1 / 500  # rate at which cells that look different become the appearance: no probe stays for that long
_RHO = np.sqrt((np.arange(_RINGS) + 0.5) / _RINGS)  # cells of equal area
_THETA = 2 * np.pi * (np.arange(_FINE * SECTORS) + 0.5) / (_FINE * SECTORS)
_X, _Y = np.outer(_RHO, np.cos(_THETA)), np.outer(_RHO, np.sin(_THETA))


@dataclass(frozen=True, slots=True)
class Appearance:
    """Grey values of the disc in cells of equal area, averaged over clear frames."""

    mean_dn: Array  # (rings, sectors)
    deviation_dn: Array  # (rings, sectors) mean absolute difference from the mean
    fill: float  # share of the disc that looks as before in clear frames: N_exp / (pi r^2)
    frames: int

    def coefficient(self, cells_dn: Array, inside: Bools) -> float:
        """gamma of the cells (rings, sectors) of a frame, 0 to 1. Cells outside the picture count as not seen."""
        same, away = self._compared(cells_dn, inside)
        # The blurred outline of an occluder reaches over cells beside it: those more like the target than like the
        # occluder near them are seen.
        weight = np.where(inside & ~same, away**2, 0.0)
        occluder_dn = _mean_near(weight * cells_dn) / np.maximum(_mean_near(weight), 1e-9)
        beside = inside & (_mean_near(same) > 0.01) & (away < np.abs(cells_dn - occluder_dn))
        filled = float(np.mean(same | beside))  # share of the cells that look as before
        return float(np.clip(1 - filled / max(self.fill, 0.05), 0.0, 1.0))

    def hidden_sectors(self, cells_dn: Array, inside: Bools) -> Bools:
        """Sectors (sectors,) that look different next to the rim: the edges there are those of an occluder."""
        outer = self._compared(cells_dn, inside)[0][_RHO > _NEXT_TO_RIM].reshape(-1, SECTORS, _FINE)
        return np.asarray(np.mean(outer, axis=(0, 2)) < _SECTOR_SHARE)

    def updated(self, cells_dn: Array, inside: Bools) -> Appearance:
        """The appearance with one more frame.

        After the first frames only the cells that look as before are averaged, so that a probe that comes slowly does
        not become part of the appearance; for the same reason the filled share falls slowly.
        """
        new = self.frames < _FIRST
        rate = max(_RATE, 1 / (self.frames + 1)) if new else _RATE
        away = cells_dn - self.mean_dn
        same, _ = self._compared(cells_dn, inside)
        away = away - upper_median(away[inside & same] if same.any() else away[inside])
        step = np.where(inside, np.where(same | new, rate, _CHANGED), 0.0)
        filled = float(np.mean(same)) - self.fill
        fill = self.fill if self.frames < 2 else self.fill + (rate if filled > 0 or new else _CHANGED) * filled
        return Appearance(
            self.mean_dn + step * (cells_dn - self.mean_dn),
            self.deviation_dn + np.where(same | new, step, 0.0) * (np.abs(away) - self.deviation_dn),
            float(np.clip(fill, 0.3, 1.0)),
            self.frames + 1,
        )

    def _compared(self, cells_dn: Array, inside: Bools) -> tuple[Bools, Array]:
        """Which cells look as before, apart from a change of the light, which is common to all; the differences, DN."""
        if inside.mean() < 0.2:
            return np.zeros(inside.shape, dtype=bool), np.zeros(inside.shape)
        low, high = _contrast(self.mean_dn)
        tolerance = _MATCH * np.maximum(self.deviation_dn, max(_LEAST_DEVIATION * (high - low), 2.0))
        away = cells_dn - self.mean_dn
        # The common change is limited: an occluder over the whole target is not a change of the light. Where half of
        # the target is hidden, the median may be that of the occluder: no change is tried, too.
        most = _LIGHT * max(abs(upper_median(self.mean_dn)), 1.0)
        common = float(np.clip(upper_median(away[inside]), -most, most))
        both = [np.abs(away - change) for change in (0.0, common)]
        plain, corrected = (inside & (size < tolerance) for size in both)
        return (corrected, both[1]) if corrected.sum() > plain.sum() else (plain, both[0])


def _mean_near(values: Array | Bools) -> Array:
    """Means of values (rings, sectors) over five by five cells."""
    around = np.pad(values.astype(np.float32), ((0, 0), (2, 2)), mode="wrap")
    return np.asarray(cv2.blur(around, (5, 5)), float)[:, 2:-2]


def first_appearance(cells_dn: Array, inside: Bools) -> Appearance:
    """The appearance after the first frame, with a broad deviation."""
    low, high = _contrast(cells_dn[inside]) if inside.any() else (0.0, 1.0)
    return Appearance(cells_dn, np.full(cells_dn.shape, 0.12 * max(float(high - low), 20.0)), 0.95, 1)


def _contrast(values_dn: Array) -> tuple[float, float]:
    """The 5th and 95th percentile of grey values, n > 0."""
    flat = values_dn.ravel()
    low, high = int(0.05 * (len(flat) - 1)), int(0.95 * (len(flat) - 1))
    ordered = np.partition(flat, (low, high))
    return float(ordered[low]), float(ordered[high])


@dataclass(frozen=True, slots=True)
class RimHabit:
    """Where the rim shows in clear frames: it may have no edge against a part of its background."""

    sectors: Array  # (sectors,) mean share of the rays with an edge on the rim
    frames: int

    @property
    def coverage(self) -> float:
        """Usual share of the rim with edge points."""
        return float(np.mean(self.sectors))

    @property
    def without_edge(self) -> Bools:
        """Sectors (sectors,) whose edges are usually not those of the rim."""
        return np.asarray(self.sectors < _USUAL) if self.frames >= _FIRST else np.zeros(SECTORS, dtype=bool)

    def updated(self, fit: RimFit) -> RimHabit:
        """With one more clear frame."""
        rate = max(_RATE, 1 / (self.frames + 1))
        return RimHabit(self.sectors + rate * (fit.sectors - self.sectors), self.frames + 1)


def is_clear(coefficient: float) -> bool:
    """Whether a frame with this coefficient updates the appearance."""
    return coefficient < _CLEAR


def disc_cells(picture: Picture, u_px: float, v_px: float, radius_px: float) -> tuple[Array, Bools]:
    """Grey values of the disc in cells of equal area, and which of them lie in the picture, both (rings, sectors).

    Each value is a bilinear sample. Large discs are first reduced, by a factor that changes with the radius without
    steps: a cell is a mean.
    """
    height, width = picture.shape[:2]
    reach = max(radius_px - _INSET_PX, 0.5 * radius_px)
    x, y = u_px + reach * _X, v_px + reach * _Y
    inside: Bools = (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
    left, top = max(int(np.floor(u_px - radius_px)) - 2, 0), max(int(np.floor(v_px - radius_px)) - 2, 0)
    right, bottom = int(np.ceil(u_px + radius_px)) + 3, int(np.ceil(v_px + radius_px)) + 3
    crop = picture[top : max(bottom, top), left : max(right, left)].astype(np.float32)
    if min(crop.shape) < 3:
        return np.zeros(x.shape), np.zeros(x.shape, dtype=bool)
    scale = min(_LARGEST_PX / radius_px, 1.0)
    if scale < 1:
        crop = np.asarray(cv2.resize(crop, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.float32)
    columns, rows = (((k + 0.5) * scale - 0.5).astype(np.float32) for k in (x - left, y - top))
    cells = cv2.remap(crop, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.where(inside, cells, 0.0).astype(float), inside
