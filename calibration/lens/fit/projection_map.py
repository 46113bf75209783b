"""Effect of lens errors on pixels over the picture: the uncertainty map, and the difference between two lenses.

A small rotation of the camera and a change of its lens have similar effects, and the camera's pose is always solved for
with the same lens afterwards. So every change is compared after the rotation of the camera that minimises its sum of
squares over the picture, or over the part where corners were seen: a rotation that also fits where none were turns the
directions that are known. mrcal does this through the board poses ("A tour of mrcal", sections on projection
uncertainty and on differencing); the uniform weight over the pixels is ours.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc

from calibration.lens.fit.lens_models import LensModel, fold_r2, undistorted
from geometry.arrays import Array, Bools
from geometry.camera import project_points_full


@dataclass(frozen=True, slots=True)
class ProjectionMap:
    """Derivatives of pixels on a grid over the picture by the lens parameters.

    nan where the lens has no ray for a pixel.
    """

    pixels: Array  # (rows, columns, 2)
    rays: Array  # (rows, columns, 3): directions of the pixels, with z = 1
    by_parameter: Array  # (rows, columns, 2, p), px per unit of the model's free parameters, best rotation removed
    mm_per_px: Array  # (rows, columns, 2, 2): on a screen that faces the camera at the distance

    def usual_mm_per_px(self) -> float:
        """Length on that screen, mm, of a pixel: geometric mean of both axes, median over the picture."""
        known = np.isfinite(self.mm_per_px).all(axis=(-2, -1))
        return float(np.median(np.abs(np.linalg.det(self.mm_per_px[known]))) ** 0.5) if known.any() else np.nan

    def covariance_px2(self, covariance: Array) -> Array:
        """(rows, columns, 2, 2) from a covariance (p, p) of the parameters."""
        return self.by_parameter @ covariance @ np.swapaxes(self.by_parameter, -1, -2)

    def sigma_px(self, covariance: Array) -> Array:
        """(rows, columns): 1 sigma in the worst direction."""
        return _largest_axis(self.covariance_px2(covariance))

    def sigma_mm(self, covariance: Array) -> Array:
        """(rows, columns): 1 sigma in the worst direction on the screen, mm."""
        C = self.covariance_px2(covariance)
        return _largest_axis(self.mm_per_px @ C @ np.swapaxes(self.mm_per_px, -1, -2))


def projection_map(
    model: LensModel,
    lens: Array,
    image_size_px: tuple[int, int],
    distance_m: float,
    columns: int = 32,
    where: Callable[[Array], Bools] | None = None,
) -> ProjectionMap:
    """The map of a lens (18,), with `columns` points across the picture from border to border.

    where: of pixels (rows, columns, 2), those for which the rotation is the best one; None: all.
    """
    width, height = image_size_px
    rows = max(2, round(columns * height / width))
    u, v = np.meshgrid(np.linspace(-0.5, width - 0.5, columns), np.linspace(-0.5, height - 0.5, rows))
    pixels = np.stack([u, v], axis=-1)
    flat = undistorted(pixels.reshape(-1, 2), lens, model.fisheye)
    good = np.asarray(np.isfinite(flat).all(axis=1))
    rays = np.concatenate([np.where(good[:, None], flat, 0.0), np.ones((len(flat), 1))], axis=1)
    seen = project_points_full(
        rays, lens[:4], lens[4:], np.asarray(fold_r2(lens, model.fisheye)), np.asarray(model.fisheye)
    )
    by_lens = np.concatenate([seen.d_pinhole, seen.d_distortion], axis=-1)[..., model.free]
    # A rotation by omega moves the ray x by omega x x: d(pixel) = D (omega x x) = (x x D_row) . omega.
    by_turn = np.cross(rays[:, None, :], seen.d_point)
    known = good & where(pixels).ravel() if where is not None else good
    if not known.any():
        known = good
    A, B = by_turn[known].reshape(-1, 3), by_lens[known].reshape(-1, by_lens.shape[-1])
    left = by_lens - by_turn @ np.linalg.lstsq(A, B, rcond=None)[0]
    left[~good] = np.nan
    # The screen faces the camera: its points are distance_m (x, y, 1), and d_point at z = 1 is the derivative by x, y.
    to_mm = np.full((len(flat), 2, 2), np.nan)
    to_mm[good] = 1000 * distance_m * np.linalg.inv(seen.d_point[good][:, :, :2])
    rays[~good] = np.nan
    return ProjectionMap(
        pixels, rays.reshape(rows, columns, 3), left.reshape(rows, columns, 2, -1), to_mm.reshape(rows, columns, 2, 2)
    )  # fmt: skip


@dataclass(frozen=True, slots=True)
class Difference:
    """Difference over the picture between two lenses fitted to different photographs."""

    pixels: Array  # (rows, columns, 2)
    moved_px: Array  # (rows, columns, 2): second minus first
    rms_px: float
    expected_rms_px: float  # from the two covariances
    rms_mm: float
    p_value: float  # of a difference at least as large, if model and noise are right


def difference(at: ProjectionMap, delta: Array, C: Array) -> Difference:
    """Difference of two lenses, to first order about that of the map: delta (p,) of the parameters, covariance C."""
    moved = at.by_parameter @ delta
    rows = at.by_parameter.reshape(-1, len(delta))
    rows = rows[np.isfinite(rows).all(axis=1)]
    gram = rows.T @ rows / (len(rows) / 2)
    M = gram @ C
    expected = float(np.trace(M))
    found = float(delta @ gram @ delta)
    # The mean square is a weighted sum of chi-squares: Satterthwaite's chi-square has the same two moments.
    dof = expected**2 / float(np.trace(M @ M))
    mm = (at.mm_per_px @ moved[..., None])[..., 0]
    return Difference(
        pixels=at.pixels,
        moved_px=moved,
        rms_px=float(np.sqrt(found)),
        expected_rms_px=float(np.sqrt(expected)),
        rms_mm=float(np.sqrt(np.nanmean(np.sum(mm**2, axis=-1)))),
        p_value=float(chdtrc(dof, found / expected * dof)),
    )


def _largest_axis(C: Array) -> Array:
    """(...): the square root of the larger eigenvalue of (..., 2, 2)."""
    a, b, c = C[..., 0, 0], C[..., 0, 1], C[..., 1, 1]
    return np.sqrt(np.maximum((a + c) / 2 + np.hypot((a - c) / 2, b), 0.0))
