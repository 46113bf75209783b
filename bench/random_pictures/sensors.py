"""Random sensors: from light in electrons to a picture of 8 or 16 bits in one of several file formats."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from geometry.arrays import Array

Picture: TypeAlias = NDArray[np.uint8] | NDArray[np.uint16]
Light: TypeAlias = NDArray[np.float32]

_SKEWED_BELOW_E = 2_000.0  # below this number of electrons the third cumulant of the shot noise is rendered as well


@dataclass(frozen=True, slots=True)
class Sensor:
    """The sensor of a camera and the format of its files."""

    bits: int  # of the converter
    full_well_e: float  # electrons from black to full scale
    read_e: float  # read noise, electrons
    black_share: float  # black level, share of full scale
    row_e: float = 0.0  # noise common to a row of one picture, electrons
    shift: int = 0  # left shift of the values in the file, bits
    file_format: str = "png"  # png, jpg or mjpg
    quality: int = 95  # of jpg and mjpg

    @property
    def top_dn(self) -> int:
        """Largest number of the converter."""
        return (1 << self.bits) - 1

    @property
    def black_dn(self) -> float:
        """Level without light, converter DN."""
        return self.black_share * self.top_dn

    @property
    def gain_e_per_dn(self) -> float:
        """Electrons per converter DN."""
        return self.full_well_e / (self.top_dn - self.black_dn)

    @property
    def lossy(self) -> bool:
        """The file has lossy compression."""
        return self.file_format != "png"

    def variance_e2(self, light_e: Array | Light) -> Array:
        """Variance of a pixel with these expected electrons, with rounding, without saturation and compression."""
        shot = np.maximum(light_e, 0.0)
        return np.asarray(shot + self.read_e**2 + self.row_e**2 + self.gain_e_per_dn**2 / 12)

    @property
    def text(self) -> str:
        """A short description."""
        kind = f"{self.bits} bit" + (f" shifted by {self.shift}" if self.shift else "")
        how = "" if not self.lossy else f" {self.file_format} quality {self.quality}"
        row = f", rows {self.row_e:.1f} e" if self.row_e else ""
        return (
            f"{kind}{how}, {self.full_well_e:.0f} e, read {self.read_e:.1f} e{row}, black {self.black_dn:.1f} DN,"
            f" {self.gain_e_per_dn:.3g} e/DN"
        )


def expose(sensor: Sensor, light_e: Light, rng: np.random.Generator) -> Picture:
    """The picture of expected electrons (h, w), before any lossy compression.

    Shot and read noise as normal deviates; where electrons are few, with the third cumulant of the shot noise
    (Cornish and Fisher's first term): z -> z + k3 (z^2 - 1) / 6.
    """
    variance = light_e + np.float32(sensor.read_e**2)
    np.maximum(variance, np.float32(1e-6), out=variance)
    z = rng.standard_normal(light_e.shape, dtype=np.float32)
    electrons = np.sqrt(variance)
    electrons *= z
    if float(np.median(light_e[::16, ::16])) < _SKEWED_BELOW_E:
        np.multiply(z, z, out=z)
        z -= np.float32(1)
        z *= light_e
        z /= variance
        z *= np.float32(1 / 6)
        electrons += z
    electrons += light_e
    if sensor.row_e:
        electrons += np.float32(sensor.row_e) * rng.standard_normal((len(light_e), 1), dtype=np.float32)
    electrons *= np.float32(1 / sensor.gain_e_per_dn)
    electrons += np.float32(sensor.black_dn)
    np.rint(electrons, out=electrons)
    np.clip(electrons, 0, sensor.top_dn, out=electrons)
    if sensor.bits == 8:
        return cast(Picture, electrons.astype(np.uint8))
    return cast(Picture, np.left_shift(electrons.astype(np.uint16), np.uint16(sensor.shift)))


def compressed(sensor: Sensor, picture: Picture) -> Picture:
    """The picture as read by the program: through JPEG for files with lossy compression."""
    if not sensor.lossy:
        return picture
    good, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, sensor.quality])
    assert good
    return cast(Picture, cv2.imdecode(data, cv2.IMREAD_UNCHANGED))


def true_noise(sensor: Sensor, light_e: float, rng: np.random.Generator) -> tuple[float, float]:
    """Mean level (file DN) and variance over time (file DN^2) of a pixel on a flat field with this light.

    Measured on 24 exposures of 128 x 128 pixels, so that saturation, rounding and compression are included; its error
    is 0.5 %.
    """
    flat = np.full((128, 128), light_e, dtype=np.float32)
    stack = np.stack([compressed(sensor, expose(sensor, flat, rng)) for _ in range(24)]).astype(np.float64)
    return float(stack.mean()), float(stack.var(axis=0, ddof=1).mean())


def draw_sensor(rng: np.random.Generator, kind: str = "any") -> Sensor:
    """kind: any, 8, 12in16, 16, jpg, mjpg or clipped (a black level of 0 with 8 bits)."""
    full_well = float(np.exp(rng.uniform(np.log(5_000), np.log(60_000))))
    read = float(np.exp(rng.uniform(np.log(1.0), np.log(10.0))))
    black = 0.0 if rng.random() < 0.25 else float(rng.uniform(0.0, 0.05))
    row = float(rng.uniform(0.3, 1.0) * read) if rng.random() < 0.15 else 0.0
    quality = int(rng.integers(80, 99))
    if kind == "any":
        kind = str(rng.choice(["8", "12in16", "16", "jpg", "mjpg"], p=[0.5, 0.22, 0.1, 0.1, 0.08]))
    if kind == "clipped":
        return Sensor(8, full_well, read, 0.0, row)
    if kind == "12in16":
        bits = int(rng.choice([10, 12]))
        return Sensor(bits, full_well, read, black, row, int(rng.choice([0, 16 - bits])))
    if kind == "16":
        return Sensor(16, full_well, read, black, row)
    if kind in ("jpg", "mjpg"):
        return Sensor(8, full_well, read, black, row, file_format=kind, quality=quality)
    return Sensor(8, full_well, read, black, row)
