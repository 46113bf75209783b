"""The points of light detected in one picture, and the clock of the picture."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.light_centroid import CentroidOffsets
from tracking.noise import NoiseModel


@dataclass(frozen=True, slots=True)
class PictureClock:
    """The clock of one picture. Its middle row is exposed delay_s after the frame's instant."""

    delay_s: float
    row_time_s: float  # by which each row is exposed later than the one above; 0: a global shutter
    middle_row: float  # (height - 1) / 2
    sigma_s: float = 0.0  # of the delay, where it is being estimated
    row_sigma_s: float = 0.0  # of the row time, likewise
    # Of the picture's own time, for each of its spots: all of them together know it no better than its stamp.
    stamp_sigma_s: float = 0.0

    def after_s(self, v_px: Array) -> Array:
        """(...): when points in these rows (...) were exposed, s after the frame's instant."""
        return np.asarray(self.delay_s + (v_px - self.middle_row) * self.row_time_s)

    def reversed(self) -> PictureClock:
        """The same for a time that runs backward."""
        return replace(self, delay_s=-self.delay_s, row_time_s=-self.row_time_s)

    def variance_s2(self, v_px: Array) -> Array:
        """(...): variances of these times, s^2."""
        return np.asarray(self.delay_sigma_s**2 + ((v_px - self.middle_row) * self.row_sigma_s) ** 2)

    @property
    def delay_sigma_s(self) -> float:
        """Of the delay, with what is unknown of the picture's own time."""
        return float(np.hypot(self.sigma_s, self.stamp_sigma_s))

    @property
    def numbers(self) -> tuple[float, float, float]:
        """For compiled functions: delay, row time, middle row."""
        return self.delay_s, self.row_time_s, self.middle_row


AT_THE_FRAME = (0.0, 0.0, 0.0)  # the numbers of a picture without a clock of its own


UNMATCHED = -1  # used instead of the row of a detection: no detection


@dataclass(frozen=True, slots=True)
class Detections:
    """n points of light of one picture, brightest first. All arrays have n rows.

    Centres are in distorted pixels; (0, 0) is the centre of the top-left pixel.
    """

    uv_px: Array  # (n, 2)
    cov_px2: Array  # (n, 2, 2), covariance of uv
    flux: Array  # (n,) sum above the local background, DN
    peak: Array  # (n,) maximum above the local background, DN
    major_px: Array  # (n,) 1-sigma half axes of the fitted Gaussian
    minor_px: Array  # (n,)
    angle_deg: Array  # (n,) angle of the major axis, from +u towards +v, in (-90, 90]
    # (n,) part of a coordinate's variance that belongs to the place on the screen, so that averaging over a vehicle at
    # rest does not reduce it; None: not known
    place_px2: Array | None = field(default=None, kw_only=True)
    # (n,) share of the covariance due to misfits of the Gaussian (speckle, texture, a skewed spot); None: not known
    misfit: Array | None = field(default=None, kw_only=True)
    chi2: Array | None = field(default=None, kw_only=True)  # (n,) of the fit, per degree of freedom; None: not known
    # (n,) rms of what the Gaussian leaves, over its height; None, or 0: not known
    unexplained: Array | None = field(default=None, kw_only=True)
    # (n,) 1: the point is in its place in the whole recording, while others move; None: not known
    at_rest: Array | None = field(default=None, kw_only=True)
    clock: PictureClock | None = field(default=None, kw_only=True)  # None: exposed at the frame's instant

    def __len__(self) -> int:
        return len(self.uv_px)

    @property
    def variance_px2(self) -> Array:
        """(n,): variance of a coordinate, the mean of both."""
        return np.asarray(0.5 * (self.cov_px2[:, 0, 0] + self.cov_px2[:, 1, 1]))

    @property
    def profile_px2(self) -> Array:
        """(n, 2, 2): second moments of the fitted Gaussians."""
        c, s = np.cos(np.radians(self.angle_deg)), np.sin(np.radians(self.angle_deg))
        major2, minor2 = self.major_px**2, self.minor_px**2
        across = (major2 - minor2) * c * s
        u, v = major2 * c**2 + minor2 * s**2, major2 * s**2 + minor2 * c**2
        return np.stack([np.stack([u, across], axis=-1), np.stack([across, v], axis=-1)], axis=-2)

    def __getitem__(self, rows: Ints | Bools | slice) -> Detections:
        """The points of the given rows, in that order."""
        known: list[Array] = [getattr(self, name)[rows] for name in Detections.__slots__[:7]]
        more: dict[str, Array] = {}
        for name in Detections.__slots__[7:-1]:
            if (values := getattr(self, name)) is not None:
                more[name] = values[rows]
        return Detections(*known, **more, clock=self.clock)

    def joined(self, more: Detections, most: int) -> Detections:
        """These and more points of the same picture, brightest first, at most so many; what is unknown becomes 0."""
        if not len(more):
            return self
        order = np.argsort(-np.concatenate([self.flux, more.flux]), kind="stable")[:most]
        values: dict[str, Array] = {}
        for name in Detections.__slots__[:-1]:
            parts = [np.zeros(len(d)) if (x := getattr(d, name)) is None else x for d in (self, more)]
            values[name] = np.concatenate(parts)[order]
        return Detections(**values, clock=self.clock)

    @staticmethod
    def none() -> Detections:
        """No points."""
        return Detections.at(np.zeros((0, 2)), np.zeros((0, 2, 2)))

    @staticmethod
    def at(uv_px: Array, cov_px2: Array) -> Detections:
        """Points with known position (n, 2), px, and covariance (n, 2, 2), px^2; all other fields are nan."""
        n = len(uv_px)
        unknown = np.full(n, np.nan)
        return Detections(
            np.asarray(uv_px, dtype=float), np.asarray(cov_px2, dtype=float), *(unknown.copy() for _ in range(5))
        )


CLIPPED = 0.85  # of the range above the background: a spot whose peak is higher is taken to be clipped


def on_beam_axes(
    found: Detections, offsets: CentroidOffsets, noise: NoiseModel | None, saturation_dn: float
) -> Detections:
    """Detections (n) with positions shifted from the light's centroid to the image of the beam's axis.

    saturation_dn: grey value at which the sensor clips.
    """
    if not len(found) or noise is None:
        return found
    shape = found.profile_px2[:, [0, 0, 1], [0, 1, 1]]
    clipped = found.peak > CLIPPED * (saturation_dn - noise.black_dn)
    height = np.where(clipped, found.flux / (2 * np.pi * found.major_px * found.minor_px), found.peak)
    brightness = noise.slope_dn * height / noise.floor_dn2
    clip = np.where(clipped, found.peak / np.maximum(height, 1e-9), 1.0)
    return replace(found, uv_px=found.uv_px - offsets.at(found.uv_px, shape, brightness, clip))
