"""Detection over a series of pictures: noise by size and depth, the spots, and the unreadable pictures.

Sizes, brightnesses and positions of the spots of many pictures, in bounded memory.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from geometry.arrays import Array
from lab.pictures.picture_file import GreyPicture
from lab.runs.frames.sensor_noise import CameraNoise
from tracking.detection.detect import overlooked_lights
from tracking.detections import Detections
from tracking.parameters import DetectParameters

_DISC = 3.2  # sigmas: radius of the disc in which the light is compared; beyond it a Gaussian is below 1 %
_PIXEL = 1 / 12  # px^2: variance of the light within a pixel
MOST_KEPT = 400_000  # spots kept for figures; beyond that every second one is dropped, repeatedly


def matched_snr(found: Detections, background_dn: float) -> Array:
    """Signal-to-noise ratio (n,) of spots after a matched filter, which decides whether a faint spot is found.

    background_dn: noise of a background pixel, 1 sigma. A Gaussian of flux F and axes a, b has F / (2 sqrt(pi a b)
    sigma); shot noise of the spot itself is not included. Source: Turin (1960), "An introduction to matched filters",
    IRE Trans. IT-6, for a two-dimensional Gaussian in white noise.
    """
    area = np.maximum(found.major_px * found.minor_px, 1e-12)
    return np.asarray(found.flux / (2 * np.sqrt(np.pi * area) * background_dn))


def laser_likeness(picture: GreyPicture, found: Detections, saturation_dn: float) -> Array:
    """How much each point (n,) of a picture (h, w) looks like the spot of a laser, 0 to 1.

    The share of the light's variance in a disc that a round Gaussian of the point's area explains, times the ratio of
    the axes, times the brightest of the 4x4 pixels about the centre over the grey value at which the sensor clips.
    Reflections, letters and corners of objects have other shapes and are seldom as bright as the laser. Source: ours,
    chosen with four photographs of rooms (tests/tracking/detection/test_real_pictures.py).
    """
    out = np.zeros(len(found))
    for i, (u, v) in enumerate(found.uv_px):
        variance = found.major_px[i] * found.minor_px[i] + _PIXEL
        reach = _DISC * np.sqrt(variance) + 1.0
        top, left = max(int(v - reach), 0), max(int(u - reach), 0)
        own = picture[top : int(v + reach) + 2, left : int(u + reach) + 2].astype(float)
        y, x = np.mgrid[: own.shape[0], : own.shape[1]] + np.array([top - v, left - u])[:, None, None]
        inside, core = x * x + y * y <= reach**2, np.maximum(np.abs(x), np.abs(y)) < 2.0
        if not core.any() or np.ptp(own[inside]) <= 0.0:
            continue
        A = np.stack([np.exp(-0.5 * (x * x + y * y) / variance), np.ones_like(x), x, y], axis=-1)[inside]
        light = own[inside]
        left_over = light - A @ np.linalg.lstsq(A, light, rcond=None)[0]
        explained = 1.0 - np.sum(left_over**2) / np.sum((light - light.mean()) ** 2)
        round_ = found.minor_px[i] / max(found.major_px[i], 1e-12)
        out[i] = explained * round_ * min(own[core].max() / saturation_dn, 1.0)
    return out


@dataclass(slots=True)
class SizeGroup:
    """Pictures of one size and depth, which share a noise model."""

    size_px: tuple[int, int]  # width, height
    bits: int  # of the data type: 8 or 16
    noise: CameraNoise
    pictures: int = 0

    def text(self) -> str:
        """`1280x1024, 8 bit`."""
        return f"{self.size_px[0]}x{self.size_px[1]}, {self.bits} bit"


@dataclass(slots=True)
class SpotCollection:
    """Spots of many pictures; columns frame, u, v, major, minor, snr, peak, likeness."""

    total: int = 0
    per_frame: list[tuple[int, int]] = field(default_factory=list)  # frame, number of its spots
    _kept: list[Array] = field(default_factory=list)
    _rows: int = 0
    _stride: int = 1

    def add(self, frame: int, found: Detections, snr: Array, likeness: Array) -> None:
        """Add the spots of one picture. snr, likeness: (n,)."""
        self.per_frame.append((frame, len(found)))
        self.total += len(found)
        shape = (found.uv_px, found.major_px, found.minor_px, snr, found.peak, likeness)
        rows = np.column_stack([np.full(len(found), float(frame)), *shape])[:: self._stride]
        self._kept.append(rows)
        self._rows += len(rows)
        if self._rows > MOST_KEPT:
            self._kept = [self.table()[::2]]
            self._rows = len(self._kept[0])
            self._stride *= 2

    def table(self) -> Array:
        """(n, 8): the columns of the kept spots."""
        return np.concatenate([np.zeros((0, 8)), *self._kept])


class WideLight(NamedTuple):
    """The brightest light of a picture that max_sigma_px excludes."""

    frame: int
    uv_px: tuple[float, float]
    sigma_px: float


@dataclass(slots=True)
class PictureSeries:
    """The results so far; the page and the summary are made from them."""

    camera: str
    source: str
    parameters: DetectParameters
    groups: dict[tuple[tuple[int, int], int], SizeGroup] = field(default_factory=dict)
    noise_pictures: dict[tuple[tuple[int, int], int], list[GreyPicture]] = field(
        default_factory=dict
    )  # the noise's source
    spots: SpotCollection = field(default_factory=SpotCollection)
    unreadable: dict[str, list[int]] = field(default_factory=dict)  # frames by reason
    overlooked: list[WideLight] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    @property
    def pictures(self) -> int:
        """Number of pictures searched."""
        return sum(group.pictures for group in self.groups.values())

    def group_of(self, picture: GreyPicture) -> SizeGroup:
        """The group of a picture; a new group estimates its noise from the first picture that is searched."""
        key = _kind(picture)
        if key not in self.groups:
            self.groups[key] = SizeGroup(*key, CameraNoise(self.camera))
        return self.groups[key]

    def estimate_noise(self, pictures: list[GreyPicture]) -> None:
        """Estimate the noise of each size and depth among some pictures."""
        for picture in pictures:
            self.noise_pictures.setdefault(_kind(picture), []).append(picture)
        for some in self.noise_pictures.values():
            self.group_of(some[0]).noise.estimate_from(some)

    def search(self, frame: int, picture: GreyPicture) -> tuple[Detections, Array]:
        """Detect the spots (n) of a picture and add them to the results; with their likeness to a laser's (n,)."""
        group = self.group_of(picture)
        found = group.noise.detect(picture, self.parameters)
        group.pictures += 1
        model = group.noise.model
        assert model is not None  # the search has estimated it
        wide = overlooked_lights(picture, self.parameters, model, found)
        if len(wide):
            i = int(np.argmax(wide.peak))
            self.overlooked.append(WideLight(frame, (wide.uv_px[i, 0], wide.uv_px[i, 1]), float(wide.major_px[i])))
        likeness = laser_likeness(picture, found, group.noise.saturation_dn(picture, self.parameters))
        self.spots.add(frame, found, matched_snr(found, float(np.sqrt(model.of_means.floor_dn2))), likeness)
        return found, likeness


def _kind(picture: GreyPicture) -> tuple[tuple[int, int], int]:
    return (picture.shape[1], picture.shape[0]), 8 * picture.dtype.itemsize
