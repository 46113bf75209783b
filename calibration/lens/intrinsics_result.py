"""What a camera's calibration results in: the lens, its covariance, and the evidence of how good they are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.findings import Finding, Level, verdict
from calibration.lens.board_shape import BoardTest, WarpTest
from calibration.lens.fit.corner_table import CornerTable
from calibration.lens.fit.coverage import Coverage
from calibration.lens.fit.hold_out import HeldOut, Scatter
from calibration.lens.fit.lens_fit import LensFit
from calibration.lens.fit.lens_models import LensModel
from calibration.lens.fit.model_selection import Ladder
from calibration.lens.fit.projection_map import Difference, ProjectionMap
from calibration.lens.model_doubt import ModelDoubt
from geometry.arrays import Array


@dataclass(frozen=True, slots=True)
class Origins:
    """Photographs of two origins (folders, videos, first parts of names) against each other."""

    names: tuple[str, str]
    difference: Difference


@dataclass(frozen=True, slots=True)
class Intrinsics:
    """A calibrated lens and what is known of its quality."""

    table: CornerTable
    model: LensModel
    fit: LensFit
    parameters: tuple[str, ...]  # fx, fy, cx, cy, k1 ...
    covariance: Array  # (p, p) in that order, scatter between photographs and the model's own doubt included
    doubt: ModelDoubt
    correlated_noise: float  # factor on the sigmas from that scatter; 1 where it is not significant
    scatter: Scatter
    held: HeldOut
    ladder: Ladder
    board: BoardTest | None  # the board as the photographs show it; None where they do not determine its bend
    halves: Difference | None  # None where a half does not determine the lens
    origins: Origins | None  # None where all photographs are of one origin
    map: ProjectionMap
    distance_m: float
    coverage: Coverage
    findings: tuple[Finding, ...] = ()

    @property
    def warp(self) -> WarpTest | None:
        """The board's bend; None where the views do not determine it."""
        return None if self.board is None else self.board.warp

    @property
    def verdict(self) -> Level:
        """The gravest finding."""
        return verdict(self.findings)

    @property
    def matrix(self) -> Array:
        """(3, 3), px."""
        fx, fy, cx, cy = self.fit.lens[:4]
        return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])

    @property
    def distortion(self) -> tuple[float, ...]:
        """OpenCV's order, as many as the model has."""
        return tuple(float(v) for v in self.fit.lens[4 : 4 + self.model.coefficients])

    @property
    def sigmas(self) -> Array:
        """(p,): 1 sigma of each parameter."""
        return np.sqrt(np.diagonal(self.covariance))

    @property
    def map_covariance_px2(self) -> Array:
        """(rows, columns, 2, 2): of a pixel's direction over the picture, all that is known to be uncertain."""
        return self.map.covariance_px2(self.covariance)

    @property
    def rms_px(self) -> float:
        """Of the used corners' residuals, per coordinate."""
        return float(np.sqrt(np.mean(self.fit.residuals[self.fit.used] ** 2)))

    @property
    def rms_2d_px(self) -> float:
        """The same per corner, as OpenCV reports it: sqrt(2) larger."""
        return self.rms_px * float(np.sqrt(2))
