"""Lights that do not move: fitted once, then measured by one linear step in each picture in which they are unchanged.

A recording's lamps, reflections and bright objects, and the spots of a vehicle at rest, are the same in picture after
picture. The Gauss-Newton step from the mean picture to a single one (ours; the model of detection/gaussian_fit.py) has
the covariance of a whole fit at a hundredth of its cost. Where the residuals or the step show that something else is
there, the place is searched.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geometry.arrays import Array, Bools, Ints
from geometry.compilation.jit import compiled_for_threads
from tracking.detections import Detections
from tracking.noise import NoiseModel, Picture

_WINDOW = (3.0, 4.0)  # widths, and px: half side of a window
_SAMPLES = 13  # largest number of pixels from the centre of a window to its side: of wide lights every n-th counts
_LARGEST_STEP = 0.25  # widths: a longer step of the centre is not linear
_LARGEST_CHANGE = 0.3  # of the flux, as a share
_MISFIT, _MISFIT_SIGMAS = 1.4, 5.0  # chi-square per degree of freedom of an unchanged light: factor, and its sigmas
_LEAST_MOVE = 0.03  # widths, rms: lights that move by less, apart from what all do, stay where they are
_PARAMETERS = 9  # of a light: centre, flux, three of its shape, and the plane below it
_BY_CHANCE = _MISFIT * (_PARAMETERS + _MISFIT_SIGMAS * (2.0 * _PARAMETERS) ** 0.5)  # decrease of chi-square by a step


@dataclass(frozen=True, slots=True)
class RestingLights:
    """n lights of the mean of some pictures (h, w) with N pixels in their windows, one window after the other.

    A step's parameters are factors: of a light times 1, x, y, x^2, xy, y^2, and of 1, x, y, with x, y from its centre
    in its width.
    """

    found: Detections  # (n,), in the mean picture
    half_px: Array  # (n,), half sides of the windows
    windows: Ints  # (n, 5), first row and column, their numbers, and the pixels from one to the next
    width_px: Array  # (n,)
    mean: NDArray[np.float32]  # (N,), DN
    weight: NDArray[np.float32]  # (N,), 1/DN^2; 0: clipped
    light: NDArray[np.float32]  # (N,), DN
    free: Array  # (n,), degrees of freedom
    inverse: Array  # (n, 9, 9), of the normal matrices
    centre_of: Array  # (n, 2, 2), px: centre by the factors of x and y
    flux_of: Array  # (n, 9): relative flux by the parameters
    clips_dn: float  # of the sensor
    moving: Bools = field(default_factory=lambda: np.zeros(0, dtype=bool))  # (n,), `which_move`

    @staticmethod
    def of(mean: NDArray[Any], found: Detections, noise: NoiseModel, saturation_dn: float) -> RestingLights:
        """The lights found in a mean picture (h, w), with covariances as of a single one. noise: of its pixels."""
        n = len(found)
        half = np.maximum(_WINDOW[0] * found.major_px + 1, 0) + _WINDOW[1]
        windows, inverse = np.zeros((n, 5), np.int64), np.zeros((n, _PARAMETERS, _PARAMETERS))
        used, centre_of, flux_of = np.zeros(n), np.zeros((n, 2, 2)), np.zeros((n, _PARAMETERS))
        turn = np.deg2rad(found.angle_deg)
        axes = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]).transpose(2, 0, 1)
        size2 = np.column_stack([found.major_px, found.minor_px]) ** 2 + 1 / 12
        width = size2.prod(axis=1) ** 0.25
        # In black places a light at rest changes by more than their noise: also there that of the background counts.
        noise = replace(noise.of_means, shadow_dn2=0.0)
        seen, weights, lights = ([np.zeros(0)] for _ in range(3))
        for i in range(n):
            rows, columns, apart = _window(mean.shape, found.uv_px[i], half[i])
            windows[i] = rows[0], columns[0], len(rows), len(columns), apart
            y, x = (d.ravel() for d in np.meshgrid(rows, columns, indexing="ij"))
            d = np.array([x - found.uv_px[i, 0], y - found.uv_px[i, 1]]) / width[i]
            covariance = axes[i] * (size2[i] / width[i] ** 2) @ axes[i].T
            form = np.exp(-0.5 * np.einsum("in,ij,jn->n", d, np.linalg.inv(covariance), d))
            light = found.flux[i] / (2 * np.pi * width[i] ** 2) * form
            plane = np.array([np.ones_like(d[0]), *d])
            slopes = np.concatenate([light * plane, light * d[0] * d, [light * d[1] ** 2], plane])
            value = mean[y, x].astype(float)
            weight = np.where(value < saturation_dn, 1.0 / noise.variance(value), 0.0)
            inverse[i] = np.linalg.pinv((slopes * weight) @ slopes.T, hermitian=True)
            used[i], centre_of[i] = np.count_nonzero(weight), covariance * width[i]
            flux_of[i, :6] = 1.0, 0.0, 0.0, covariance[0, 0], covariance[0, 1], covariance[1, 1]
            for of, values in ((seen, value), (weights, weight), (lights, light)):
                of.append(values)
        return RestingLights(
            found, half, windows, width, _joined(seen), _joined(weights), _joined(lights),
            np.maximum(used - _PARAMETERS, 1.0), inverse, centre_of, flux_of, saturation_dn,
        )  # fmt: skip

    def in_picture(self, picture: Picture, fixed: Bools | None = None) -> tuple[Detections, Bools, Bools]:
        """The lights (n,) in a picture (h, w), which of them have changed, and which are passed by another light.

        fixed (n,): lights that stay where they are; they are measured only in pictures that differ from the mean there.
        Those that have changed are not measured correctly. Where there is more light than in the mean and nowhere less,
        something else passes over an unchanged light: that is in the difference from the mean, and the light stays
        where the mean shows it. So does a faint light of which a single picture shows no more than that it has not
        changed, unless the pictures together show that it moves.
        """
        sums = np.zeros((len(self.found), _PARAMETERS + 3))
        centre = self.found.uv_px
        _add(picture, centre, self.windows, self.width_px, self.mean, self.weight, self.light, sums)
        right, (whole, darkness, darker) = sums[:, :_PARAMETERS], sums[:, _PARAMETERS:].T
        step = np.einsum("nij,nj->ni", self.inverse, right)
        gain = np.einsum("ni,ni->n", step, right)
        more, moved = np.einsum("ni,ni->n", self.flux_of, step), np.einsum("nij,nj->ni", self.centre_of, step[:, 1:3])
        largest = _largest_chi2(self.free)
        same = fixed & (whole <= largest) if fixed is not None and len(fixed) else np.zeros(len(right), dtype=bool)
        misfit = (whole - gain > largest) & ~same
        passed = misfit & (darkness < _largest_chi2(np.maximum(darker, 1.0)))
        far = np.linalg.norm(moved, axis=1) > _LARGEST_STEP * self.found.minor_px
        far |= np.abs(more) > _LARGEST_CHANGE
        clear = gain > _BY_CHANCE
        if len(self.moving):
            clear |= self.moving
        changed = misfit | (far & clear & ~same)
        stays = passed | same | (far & ~changed)
        moved, more = np.where(stays[:, None], 0.0, moved), np.where(stays, 0.0, more)
        found = replace(self.found, uv_px=centre + moved, flux=self.found.flux * (1.0 + more))
        return found, np.asarray(changed & ~passed), np.asarray(passed)

    def which_move(self, places: Array, counted: Bools) -> Bools:
        """Which lights (n,) are not in the same place in some pictures.

        places (k, n, 2), px: as `in_picture` measures them; counted (k, n): where it does. What the camera's vibration
        does to most lights is no move of one.
        """
        if not len(self.found):
            return np.zeros(0, dtype=bool)
        apart = places - self.found.uv_px
        apart = np.where(counted[..., None], apart - np.median(apart, axis=1, keepdims=True), 0.0)
        count = np.maximum(np.count_nonzero(counted, axis=0), 1)
        apart -= np.where(counted[..., None], apart.sum(axis=0) / count[:, None], 0.0)
        chi2 = np.einsum("kni,nij,knj->n", apart, np.linalg.inv(self.found.cov_px2), apart)
        rms = np.sqrt(np.sum(apart**2, axis=(0, 2)) / count)
        return np.asarray((chi2 > _largest_chi2(2.0 * count)) & (rms > _LEAST_MOVE * self.found.minor_px))


def _largest_chi2(free: Array) -> Array:
    """(n,): of an unchanged light with these degrees of freedom."""
    return _MISFIT * (1.0 + _MISFIT_SIGMAS * np.sqrt(2.0 / free)) * free


def _joined(parts: list[Array]) -> NDArray[np.float32]:
    return np.concatenate(parts, dtype=np.float32)


def _window(shape: tuple[int, ...], uv_px: Array, half: float) -> tuple[Ints, Ints, int]:
    """Rows and columns of a picture (h, w) around a light, and the pixels from one to the next."""
    apart = max(int(half) // _SAMPLES, 1)
    reach = int(half) // apart * apart
    columns, rows = (np.arange(round(x) - reach, round(x) + reach + 1, apart) for x in uv_px)
    return rows[(rows >= 0) & (rows < shape[0])], columns[(columns >= 0) & (columns < shape[1])], apart


@compiled_for_threads
def _add(
    picture: Picture, uv_px: Array, windows: Ints, width_px: Array, mean: NDArray[np.float32],
    weight: NDArray[np.float32], light: NDArray[np.float32], sums: Array,
) -> None:  # fmt: skip
    """Add up the windows of n lights in a picture (h, w): what it shows more than the mean by its slopes (n, 9).

    After these chi-square, the part of it in pixels that are darker than the mean, and their number. Row by row, since
    the sums of a row by x are those of all slopes.
    """
    at = 0
    for i in range(len(windows)):
        row, column, rows, columns, apart = windows[i]
        out = sums[i]
        for r in range(rows):
            y = (row + r * apart - uv_px[i, 1]) / width_px[i]
            pixels = picture[row + r * apart]
            of_light = by_x = by_xx = of_plane = plane_x = chi2 = darkness = darker = 0.0
            for c in range(columns):
                x = (column + c * apart - uv_px[i, 0]) / width_px[i]
                residual = np.float64(pixels[column + c * apart]) - mean[at]
                weighted = residual * weight[at]
                lit = weighted * light[at]
                of_light += lit
                by_x += lit * x
                by_xx += lit * x * x
                of_plane += weighted
                plane_x += weighted * x
                chi2 += residual * weighted
                darkness += min(residual, 0.0) * weighted
                darker += np.float64(weighted < 0)
                at += 1
            of_row = of_light, by_x, y * of_light, by_xx, y * by_x, y * y * of_light, of_plane, plane_x, y * of_plane
            for k in range(9):
                out[k] += of_row[k]
            out[9] += chi2
            out[10] += darkness
            out[11] += darker
