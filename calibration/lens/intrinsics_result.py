"""The result of a camera's calibration: the lens, its covariance and the quality figures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.lens.board_shape import BoardTest, WarpTest
from calibration.lens.fit.corner_table import CornerTable
from calibration.lens.fit.coverage import Coverage
from calibration.lens.fit.lens_fit import LensFit
from calibration.lens.fit.lens_models import LensModel
from calibration.lens.fit.model_selection import ModelSelection
from calibration.lens.fit.projection_map import Difference, ProjectionMap
from calibration.lens.fit.view_equations import Scatter
from calibration.lens.model_uncertainty import ModelUncertainty
from geometry.arrays import Array
from geometry.camera import camera_matrix


@dataclass(frozen=True, slots=True)
class Origins:
    """Comparison of photographs of two origins (folders, videos, first parts of names)."""

    names: tuple[str, str]
    difference: Difference


@dataclass(frozen=True, slots=True)
class Intrinsics:
    """A calibrated lens with its quality figures."""

    table: CornerTable
    model: LensModel
    fit: LensFit
    parameters: tuple[str, ...]  # fx, fy, cx, cy, k1 ...
    covariance: Array  # (p, p) in that order; with scatter between photographs, an unsolved bend and model error
    model_uncertainty: ModelUncertainty
    correlated_noise: float  # factor on the sigmas from that scatter; 1 where it is not significant
    scatter: Scatter
    held_out_rms_px: float  # per coordinate, of corners in photographs that the lens was predicted without
    selection: ModelSelection
    board: BoardTest | None  # None where the photographs do not determine the board's bend
    halves: Difference | None  # None where one half does not determine the lens
    origins: Origins | None  # None where all photographs have the same origin
    map: ProjectionMap
    distance_m: float
    coverage: Coverage

    @property
    def warp(self) -> WarpTest | None:
        """The test for a bent board; None where the views do not determine it."""
        return None if self.board is None else self.board.warp

    @property
    def matrix(self) -> Array:
        """(3, 3), px."""
        return camera_matrix(self.fit.lens[:4])

    @property
    def distortion(self) -> tuple[float, ...]:
        """Distortion coefficients in OpenCV's order, as many as the model has."""
        return tuple(float(v) for v in self.fit.lens[4 : 4 + self.model.coefficients])

    @property
    def sigmas(self) -> Array:
        """(p,): 1 sigma of each parameter."""
        return np.sqrt(np.diagonal(self.covariance))

    @property
    def rms_px(self) -> float:
        """RMS of the residuals of the used corners, per coordinate."""
        return float(np.sqrt(np.mean(self.fit.residuals[self.fit.used] ** 2)))

    @property
    def rms_2d_px(self) -> float:
        """RMS per corner, as OpenCV reports it: sqrt(2) times larger."""
        return self.rms_px * float(np.sqrt(2))
