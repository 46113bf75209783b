"""A sensor's noise from its own pictures: photon transfer on what stays still, bounded by what sensors are like.

The variance of a pixel is the variance of the difference of two pictures, halved, where the scene stays still
(Janesick, Photon Transfer, SPIE 2007, chapter 5; EMVA Standard 1288, release 4.0, 6.6). Texture, edges and spots of a
vehicle at rest cancel in it. What does not cancel (moving spots, changing light) is removed by its local mean and by
robust statistics. The evidence for the slope is weighed together with a broad prior, so neither a structure nor a lack
of bright pixels can lead to a model that no sensor has. The combination is ours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from geometry.arrays import Array
from tracking.detection.detect import find_spots
from tracking.noise import FULL_SCALE_E, NoiseModel, Picture, quantile_variance
from tracking.noise_estimation.grey_values import clipped_background, full_scale, grey_step, saturation_level
from tracking.noise_estimation.levels import LEAST_PIXELS, LEVELS, SIDE, LevelVariances, level_variances
from tracking.noise_estimation.rounding import banding
from tracking.noise_estimation.spot_residuals import SpotResiduals, residuals_of_spots
from tracking.noise_estimation.texture import texture_of
from tracking.parameters import DetectParameters

_WELL_E = (1_000.0, 200_000.0)  # electrons at full scale: what sensors have, from the smallest to the largest
_WELL_SPREAD = 1.2  # sigma of the logarithm about FULL_SCALE_E: a decade is two sigmas
_SLOPES = 81
_READ_E = (0.7, 20.0)  # electrons of read noise, from scientific sensors to old ones
_LARGEST_MISFIT = 9.0  # squared sigmas: a level that contradicts the line by more is not noise alone
_SURE = 0.25  # sigma of the slope's logarithm from which spots are not asked: photon transfer is the better evidence
_MOST_SPOTS = 40  # of one picture: the brightest
_LEAST_OF_SPOTS, _MOST_OF_SPOTS = 30, 300  # pixels of one brightness; residuals of one spot are not independent
_CONTRASTS = (0.0, 0.005, 0.01, 0.02, 0.04, 0.08, 0.16, 0.32)  # of the light's grain
_GRAIN_SIGMA = 0.5  # share of its own variance to which the grain is known


@dataclass(frozen=True, slots=True)
class NoiseEstimate:
    """A noise model that was estimated from pictures, with its uncertainty."""

    model: NoiseModel
    floor_sigma: float  # of the floor's logarithm
    slope_sigma: float  # of the slope's logarithm; 1.2: nothing but the prior
    saturation_dn: float | None  # level at which the sensor clips, as seen; None: not seen to clip
    step_dn: float  # grey values are multiples of this: 16 for 12 bits at the upper end of 16
    pictures: int  # that were looked at
    temporal: bool  # from differences in time; False: within pictures, where structure counts as noise


def estimate_noise(pictures: Sequence[Picture]) -> NoiseEstimate:
    """The noise of a sensor from pictures (h, w) of one camera in their order of time, best in pairs of neighbours.

    One picture is enough for a usable model; two to six make it right. Pictures of other sizes than the first are left
    out.

    Errors: ValueError without a picture.
    """
    if not pictures:
        raise ValueError("estimate_noise: expected at least one picture, got none")
    usable = [p for p in pictures if p.shape == pictures[0].shape and p.dtype == pictures[0].dtype]
    step = grey_step(usable)
    saturation = saturation_level(usable, step)
    full = full_scale(usable, step)
    rounding = step**2 / 12
    top = float(np.iinfo(usable[0].dtype).max) if saturation is None else saturation
    background = float(np.median(np.concatenate([p[::8, ::8].ravel() for p in usable]))) if usable[0].size else 0.0
    small = min(usable[0].shape) < 2 * SIDE
    dark = None if small else clipped_background(usable, step)
    levels = None if small else level_variances(usable, top, rounding)
    if levels is None or (dark is None and not len(levels.level)):  # too few pixels for a level
        model = NoiseModel(max(_small_picture_variance(usable), rounding), full / FULL_SCALE_E, background)
        return NoiseEstimate(model, 1.0, _WELL_SPREAD, saturation, step, len(usable), temporal=False)
    lines = _Lines.through(levels, background, full, rounding) if dark is None else _Lines.from_point(*dark, full)
    slope, slope_sigma = lines.slope(rounding)
    first = lines.model(slope, rounding)
    first = replace(first, texture=texture_of(usable, first), banding_dn=banding(first.floor_dn2, rounding))
    if slope_sigma > _SURE:  # nothing still is bright enough: the spots themselves
        found = [find_spots(p, DetectParameters(max_detections=_MOST_SPOTS), first) for p in usable]
        lines.add(residuals_of_spots(usable, found, top))
        slope, slope_sigma = lines.slope(rounding)
    model = replace(first, slope_dn=slope, floor_dn2=lines.model(slope, rounding).floor_dn2)
    floor_sigma = float(np.interp(slope, lines.slopes, lines.floor_sigma)) / model.floor_dn2
    return NoiseEstimate(model, floor_sigma, slope_sigma, saturation, step, len(usable), levels.temporal)


def _small_picture_variance(pictures: Sequence[Picture]) -> float:
    pixels = np.concatenate([np.abs(np.diff(p.astype(float), axis=1)).ravel() for p in pictures] or [np.zeros(0)])
    return quantile_variance(pixels / np.sqrt(2)) if pixels.size else 0.0


@dataclass(slots=True)
class _Lines:
    """Every slope that a sensor may have (k,), DN, with the floor that goes with it and the belief in the pair."""

    slopes: Array
    floor: Array  # (k,), DN^2, variance at `background`
    floor_sigma: Array  # (k,)
    background: float  # DN
    full: float  # DN
    log_likelihood: Array  # (k,)

    @staticmethod
    def through(levels: LevelVariances, background: float, full: float, rounding: float) -> _Lines:
        """The lines through variances by level, each fitted without the levels that contradict it."""
        slopes = np.geomspace(full / _WELL_E[1], full / _WELL_E[0], _SLOPES)
        if not len(levels.level):
            unknown = np.full(_SLOPES, rounding)
            return _Lines(slopes, unknown, unknown.copy(), background, full, np.zeros(_SLOPES))
        lift = levels.level - background
        rise = slopes[:, None] * lift
        weight = np.ones_like(rise) / levels.sigma**2
        floor = np.full(_SLOPES, levels.nearest(background))
        for _ in range(4):
            # Below the background the noise cannot fall under its rounding.
            expected = np.maximum(floor[:, None] + rise, 0.5 * rounding)
            misfit = ((levels.variance - expected) / levels.sigma) ** 2
            held = weight / np.maximum(misfit / _LARGEST_MISFIT, 1.0)
            floor = np.maximum(np.sum(held * (levels.variance - rise), axis=1) / np.sum(held, axis=1), rounding)
        sigma = 1 / np.sqrt(np.sum(held, axis=1))
        evidence = -0.5 * np.minimum(misfit, _LARGEST_MISFIT).sum(axis=1) if levels.temporal else np.zeros(_SLOPES)
        return _Lines(slopes, floor, sigma, background, full, evidence)

    @staticmethod
    def from_point(background: float, variance: float, full: float) -> _Lines:
        """The lines through one point, of a background that is clipped at zero."""
        slopes = np.geomspace(full / _WELL_E[1], full / _WELL_E[0], _SLOPES)
        floor = np.full(_SLOPES, variance)
        return _Lines(slopes, floor, 0.2 * floor, background, full, np.zeros(_SLOPES))

    def add(self, spots: SpotResiduals) -> None:
        """Take the residuals of fitted spots as evidence, whichever contrast their light's grain has.

        The grain of the light (texture, speckle, a spot that is no Gaussian) adds the square of the contrast times the
        light, known to a share of itself only: where it rules, the residuals say nothing of the slope.
        """
        if len(spots.square) < LEAST_PIXELS:
            return
        brightest = float(spots.light.max())
        edges = np.geomspace(max(0.03 * brightest, 1e-6), brightest * 1.001, LEVELS)
        place = np.digitize(spots.light, edges)
        rows = [here for here in (place == k for k in range(len(edges))) if np.count_nonzero(here) >= _LEAST_OF_SPOTS]
        seen = np.array([np.mean(np.minimum(spots.square[r], 12 * np.median(spots.square[r]) + 1e-9)) for r in rows])
        light2 = np.array([np.mean(spots.grainy[r] ** 2) for r in rows])
        lift = np.array([np.mean(np.maximum(spots.level[r] - self.background, 0.0)) for r in rows])
        count = np.array([np.count_nonzero(r) for r in rows])
        belief = np.zeros((len(_CONTRASTS), _SLOPES))
        for row, contrast in enumerate(_CONTRASTS):
            grain = contrast**2 * light2
            expected = self.floor[:, None] + self.slopes[:, None] * lift + grain
            known = (2 / np.minimum(count, _MOST_OF_SPOTS) + 0.1**2) * expected**2
            sigma = np.sqrt(known + (_GRAIN_SIGMA * grain) ** 2)
            misfit = np.minimum(((seen - expected) / sigma) ** 2, _LARGEST_MISFIT)
            belief[row] = -0.5 * np.sum(misfit + 2 * np.log(sigma), axis=1)
        self.log_likelihood = self.log_likelihood + np.logaddexp.reduce(belief - belief.max(), axis=0)

    def slope(self, rounding: float) -> tuple[float, float]:
        """The slope, DN, as mean of its logarithm, and the logarithm's sigma."""
        belief = self.log_likelihood + self._log_prior(rounding)
        weight = np.exp(belief - belief.max())
        weight /= weight.sum()
        log = np.log(self.slopes)
        mean = float(weight @ log)
        return float(np.exp(mean)), float(np.sqrt(weight @ (log - mean) ** 2))

    def model(self, slope: float, rounding: float) -> NoiseModel:
        """The model of one slope."""
        return NoiseModel(max(float(np.interp(slope, self.slopes, self.floor)), rounding), slope, self.background)

    def _log_prior(self, rounding: float) -> Array:
        """(k,): a usual full well, and a read noise that exists."""
        belief = -0.5 * (np.log(self.slopes * FULL_SCALE_E / self.full) / _WELL_SPREAD) ** 2
        # The floor holds read noise and the shot noise of the background's light, which lies between 0 and its level.
        read2 = np.maximum(self.floor - rounding, 0.02 * rounding)
        too_noisy = np.log(np.maximum((_READ_E[0] * self.slopes) ** 2 / read2, 1.0))
        shot = self.slopes * max(self.background, 0.0)
        too_quiet = np.log(np.maximum(read2 / ((_READ_E[1] * self.slopes) ** 2 + shot), 1.0))
        return np.asarray(belief - 2.0 * (too_noisy**2 + too_quiet**2))
