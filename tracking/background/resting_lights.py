"""Lights that do not move: fitted once, then measured by one linear step in each picture in which they are unchanged.

A recording's lamps, reflections and bright objects, and the spots of a vehicle at rest, are the same in picture after
picture. The Gauss-Newton step from the mean picture to a single one (ours; the model of detection/gaussian_fit.py) has
the covariance of a whole fit at a hundredth of its cost. Where the residuals or the step show that something else is
there, the place is searched.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geometry.arrays import Array, Bools, Ints
from tracking.detections import Detections
from tracking.noise import NoiseModel, Picture

_WINDOW = (3.0, 4.0)  # widths, and px: half side of a window
_SAMPLES = 13  # largest number of pixels from the centre of a window to its side: of wide lights every n-th counts
_LARGEST_STEP = 0.25  # widths: a longer step of the centre is not linear
_LARGEST_CHANGE = 0.3  # of the flux, as a share
_MISFIT, _MISFIT_SIGMAS = 1.4, 5.0  # chi-square per degree of freedom of an unchanged light: factor, and its sigmas
_PARAMETERS = 9  # of a light: centre, flux, three of its shape, and the plane below it
_BY_CHANCE = _MISFIT * (_PARAMETERS + _MISFIT_SIGMAS * (2.0 * _PARAMETERS) ** 0.5)  # decrease of chi-square by a step


@dataclass(frozen=True, slots=True)
class RestingLights:
    """n lights of the mean of some pictures (h, w) with N pixels in their windows, one window after the other."""

    found: Detections  # (n,), in the mean picture
    half_px: Array  # (n,), half sides of the windows
    pixels: Ints  # (N,), places in a flat picture
    mean: NDArray[np.float32]  # (N,), DN
    weight: NDArray[np.float32]  # (N,), 1/DN^2; 0: clipped
    slopes: NDArray[np.float32]  # (9, N), DN: by centre, flux, shape and background
    starts: Ints  # (n,), of the windows
    free: Array  # (n,), degrees of freedom
    inverse: Array  # (n, 9, 9), of the normal matrices
    flux_of: Array  # (n, 9): relative flux by the parameters
    clips_dn: float  # of the sensor

    @staticmethod
    def of(mean: NDArray[Any], found: Detections, noise: NoiseModel, saturation_dn: float) -> RestingLights:
        """The lights found in a mean picture (h, w), with covariances as of a single one. noise: of its pixels."""
        half = np.maximum(_WINDOW[0] * found.major_px + 1, 0) + _WINDOW[1]
        windows = [_Window.of(mean.shape, found, i, half[i]) for i in range(len(found))]
        counts = np.array([len(w.pixels) for w in windows], dtype=np.int64)
        starts = np.concatenate([[0], np.cumsum(counts)])[:-1].astype(np.int64)
        pixels = np.concatenate([np.zeros(0, np.int64), *(w.pixels for w in windows)])
        slopes = np.concatenate([np.zeros((_PARAMETERS, 0)), *(w.slopes for w in windows)], axis=1)
        light = mean.ravel()[pixels].astype(float)
        # In black places a light at rest changes by more than their noise: also there that of the background counts.
        variance = replace(noise.of_means, shadow_dn2=0.0).variance(light)
        weight = np.where(light < saturation_dn, 1.0 / variance, 0.0)
        inverse = np.zeros((len(found), _PARAMETERS, _PARAMETERS))
        for i, (start, count) in enumerate(zip(starts, counts, strict=True)):
            own = np.s_[start : start + count]
            normal = (slopes[:, own] * weight[own]) @ slopes[:, own].T
            inverse[i] = np.linalg.pinv(normal, hermitian=True)
        used = np.add.reduceat(weight > 0, starts) if len(found) else np.zeros(0)
        flux_of = np.array([w.flux_of for w in windows]).reshape(-1, _PARAMETERS)
        return RestingLights(
            found, half, pixels, light.astype(np.float32), weight.astype(np.float32), slopes.astype(np.float32), starts,
            np.maximum(used - _PARAMETERS, 1.0), inverse, flux_of, saturation_dn,
        )  # fmt: skip

    def in_picture(self, picture: Picture, fixed: Bools | None = None) -> tuple[Detections, Bools, Bools]:
        """The lights (n,) in a picture (h, w), which of them have changed, and which are passed by another light.

        fixed (n,): lights that stay where they are; they are measured only in pictures that differ from the mean there.
        Those that have changed are not measured correctly. Where there is more light than in the mean and nowhere less,
        something else passes over an unchanged light: that is in the difference from the mean, and the light stays
        where the mean shows it. So does a faint light of which a single picture shows no more than that it has not
        changed.
        """
        found, (changed, passed) = self.found, np.zeros((2, len(self.found)), dtype=bool)
        if not len(found):
            return found, changed, passed
        residual = picture.ravel()[self.pixels].astype(np.float32) - self.mean
        if fixed is not None and fixed.any():
            chi2 = np.add.reduceat(residual * residual * self.weight, self.starts)
            differs = np.flatnonzero(~fixed | (chi2 > self._largest_chi2))
            if len(differs):
                some, rows = self._some(differs)
                measured, changed[differs], passed[differs] = some._measured(residual[rows])
                uv_px, flux = found.uv_px.copy(), found.flux.copy()
                uv_px[differs], flux[differs] = measured.uv_px, measured.flux
                found = replace(found, uv_px=uv_px, flux=flux)
            return found, changed, passed
        return self._measured(residual)

    @property
    def _largest_chi2(self) -> Array:
        """(n,): of an unchanged light."""
        return np.asarray(_MISFIT * (1.0 + _MISFIT_SIGMAS * np.sqrt(2.0 / self.free)) * self.free)

    @property
    def _ends(self) -> Ints:
        """(n,), of the windows."""
        return np.append(self.starts[1:], len(self.pixels))

    def _some(self, lights: Ints) -> tuple[RestingLights, Ints]:
        """Some of the lights, and the rows of their pixels."""
        rows = np.concatenate([np.arange(self.starts[i], self._ends[i]) for i in lights])
        counts = (self._ends - self.starts)[lights]
        return RestingLights(
            self.found[lights], self.half_px[lights], self.pixels[rows], self.mean[rows], self.weight[rows],
            self.slopes[:, rows], np.cumsum(counts) - counts, self.free[lights], self.inverse[lights],
            self.flux_of[lights], self.clips_dn,
        ), rows  # fmt: skip

    def _measured(self, residual: NDArray[np.float32]) -> tuple[Detections, Bools, Bools]:
        """As `in_picture`, from what a picture shows more than the mean, (N,) DN."""
        weighted = residual * self.weight
        right = np.array([self.slopes[:, a:b] @ weighted[a:b] for a, b in zip(self.starts, self._ends, strict=True)])
        step = np.einsum("nij,nj->ni", self.inverse, right)
        gain = np.einsum("ni,ni->n", step, right)
        chi2 = np.add.reduceat(residual * weighted, self.starts) - gain
        more = np.einsum("ni,ni->n", self.flux_of, step)
        misfit = chi2 > self._largest_chi2
        passed = misfit.copy()
        if passed.any():
            less = (residual < 0) & (self.weight > 0)
            darker = np.maximum(np.add.reduceat(less, self.starts, dtype=float), 1.0)
            allowed = _MISFIT * (1.0 + _MISFIT_SIGMAS * np.sqrt(2.0 / darker))
            passed &= np.add.reduceat(residual * weighted * less, self.starts) < allowed * darker
        far = np.linalg.norm(step[:, :2], axis=1) > _LARGEST_STEP * self.found.minor_px
        far |= np.abs(more) > _LARGEST_CHANGE
        changed = misfit | (far & (gain > _BY_CHANCE))
        stays = passed | (far & ~changed)
        step, more = np.where(stays[:, None], 0.0, step), np.where(stays, 0.0, more)
        found = replace(self.found, uv_px=self.found.uv_px + step[:, :2], flux=self.found.flux * (1.0 + more))
        return found, np.asarray(changed & ~passed), np.asarray(passed)


@dataclass(frozen=True, slots=True)
class _Window:
    pixels: Ints  # (m,)
    slopes: Array  # (9, m)
    flux_of: Array  # (9,)

    @staticmethod
    def of(shape: tuple[int, ...], found: Detections, i: int, half: float) -> _Window:
        """The window of a light, and the slopes of a Gaussian with its size."""
        (u0, v0), apart = found.uv_px[i], max(int(half) // _SAMPLES, 1)
        reach = int(half) // apart * apart
        columns = np.arange(round(u0) - reach, round(u0) + reach + 1, apart)
        rows = np.arange(round(v0) - reach, round(v0) + reach + 1, apart)
        columns, rows = columns[(columns >= 0) & (columns < shape[1])], rows[(rows >= 0) & (rows < shape[0])]
        v, u = (x.ravel() for x in np.meshgrid(rows, columns, indexing="ij"))
        turn = np.deg2rad(found.angle_deg[i])
        axes = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        size2 = np.array([found.major_px[i], found.minor_px[i]]) ** 2 + 1 / 12
        inverse = axes / size2 @ axes.T
        d = np.array([u - u0, v - v0])
        p, q = inverse @ d
        shape_of = np.exp(-0.5 * (p * d[0] + q * d[1]))
        light = found.flux[i] / (2 * np.pi * np.sqrt(size2.prod())) * shape_of
        scale = size2.prod() ** 0.25
        slopes = np.array([
            light * p, light * q, light, light * (p * scale) ** 2, light * p * q * scale**2, light * (q * scale) ** 2,
            np.ones_like(p), d[0] / scale, d[1] / scale,
        ])  # fmt: skip
        flux_of = np.zeros(_PARAMETERS)
        flux_of[2] = 1.0
        flux_of[3:6] = scale**2 * np.array([inverse[0, 0], inverse[0, 1], inverse[1, 1]])
        return _Window(np.asarray(v * shape[1] + u, np.int64), slopes, flux_of)
