"""A sensor's noise estimated from its own pictures: photon transfer on static pixels, with a prior on the slope.

The variance of a pixel is half the variance of the difference of two pictures of a static scene (Janesick, Photon
Transfer, SPIE 2007, chapter 5; EMVA Standard 1288, release 4.0, 6.6). Texture, edges and spots of a vehicle at rest
cancel in the difference. Moving spots and changing light are removed by subtracting the local mean and by robust
statistics. The likelihood of the slope is combined with a broad prior, so that neither structure nor a lack of bright
pixels can lead to an impossible sensor. The combination is ours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from geometry.arrays import Array
from tracking.detection.detect import find_spots
from tracking.noise import FULL_SCALE_E, NoiseModel, Picture, quantile_variance
from tracking.noise_estimation.grey_values import (
    block_step,
    clipped_background,
    full_scale,
    grey_step,
    saturation_level,
)
from tracking.noise_estimation.levels import LEAST_PIXELS, LEVELS, SIDE, LevelVariances, level_variances
from tracking.noise_estimation.speckle import shows_grains
from tracking.noise_estimation.spot_profile import spot_profile
from tracking.noise_estimation.spot_residuals import SpotResiduals, residuals_of_spots
from tracking.noise_estimation.texture import MeanPicture, local_texture, texture_of
from tracking.noise_estimation.texture_shift import TextureShift, texture_shift
from tracking.parameters import DetectParameters
from tracking.rounding import banding

_WELL_E = (1_000.0, 200_000.0)  # electrons at full scale: range from the smallest to the largest sensors
_WELL_SPREAD = 1.2  # prior sigma of the logarithm about FULL_SCALE_E: a decade is two sigmas
_SLOPES = 81  # number of slopes in the grid
_READ_E = (0.7, 20.0)  # electrons of read noise: range from scientific to old sensors
_LARGEST_MISFIT = 9.0  # squared sigmas: a level farther from the line has other errors than noise
_SURE = 0.25  # sigma of the slope's logarithm up to which photon transfer alone is used, without the spots' residuals
_MOST_SPOTS = 40  # per picture: the brightest
_LEAST_OF_SPOTS, _MOST_OF_SPOTS = 30, 300  # pixels per brightness class; residuals of one spot are not independent
_CONTRASTS = (0.0, 0.005, 0.01, 0.02, 0.04, 0.08, 0.16, 0.32)  # contrasts of the light's grain that are tried
_ABOVE_TEXTURE = 10.0  # sigmas of the texture: peak of a narrow light that is none of its grains
_STEPS_SEEN = 0.003  # of a background: rounding errors above this look like texture ...
_TEXTURE_SEEN = 0.5  # ... unless they are smaller than this share of it
_OF_STEP = 0.42  # of a block's step, as its sigma: with the usual threshold a spot must be 2.1 steps high
# Of a block's step squared. JPEG's steps of coarse details are 6 to 8 times that of a block's mean (T.81, annex K), so
# the error of each of them has a variance of 3 to 5 step^2; a spot has about a third of all of them.
_OF_LIGHT = 4 / 3
_GRAIN_SIGMA = 0.5  # relative uncertainty of the grain's variance


@dataclass(frozen=True, slots=True)
class NoiseEstimate:
    """A noise model estimated from pictures, with its uncertainty."""

    model: NoiseModel
    floor_sigma: float  # of the floor's logarithm
    slope_sigma: float  # of the slope's logarithm; 1.2: from the prior only
    saturation_dn: float | None  # level at which the sensor clips in the pictures; None: they do not clip
    step_dn: float  # grey values are multiples of this: 16 for 12 bits stored in the upper bits of 16
    pictures: int  # number of pictures used
    temporal: bool  # from differences in time; False: within pictures, where structure counts as noise
    texture_shift: TextureShift = field(default_factory=TextureShift.none)  # errors of spots due to texture
    grainy: bool = False  # speckle makes the spots so grainy that they are measured better in sums of pixels


def estimate_noise(pictures: Sequence[Picture], black_dn: float | None = None) -> NoiseEstimate:
    """The noise of a sensor from pictures (h, w) of one camera in order of time, preferably consecutive in pairs.

    One picture gives a usable model, two to six an accurate one. Pictures with another size or type than the first are
    ignored. black_dn: grey value without light; None: not known.

    Raises:
        ValueError: without a picture.
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
    clipped = None if small else clipped_background(usable, step)
    levels = None if small else level_variances(usable, top, rounding)
    if levels is None or (clipped is None and not len(levels.level)):  # too few pixels for a level
        model = NoiseModel(max(_small_picture_variance(usable), rounding), full / FULL_SCALE_E, background)
        return NoiseEstimate(model, 1.0, _WELL_SPREAD, saturation, step, len(usable), temporal=False)
    lines = _Lines.fit(levels, background, full, rounding) if clipped is None else _Lines.from_point(*clipped, full)
    slope, slope_sigma = lines.slope(rounding)
    first = lines.model(slope, rounding)
    step_of_blocks = block_step(usable)
    shared = max(banding(first.floor_dn2, rounding), _OF_STEP * step_of_blocks)
    # The steps of blocks make means of their pixels scatter as well; they count once.
    correlation = levels.correlation if clipped is None and not step_of_blocks else 1.0
    lossy = _OF_LIGHT * step_of_blocks**2
    first = replace(first, banding_dn=shared, correlation=correlation, compression_dn2=lossy)
    seen = MeanPicture.of(usable)
    first = replace(first, texture=texture_of(seen, first))
    first = replace(first, local_texture=local_texture(seen, first, usable[0].shape[::-1]))
    if slope_sigma > _SURE:  # no static pixel is bright enough: use the spots' residuals
        found = [find_spots(p, DetectParameters(max_detections=_MOST_SPOTS), first) for p in usable]
        lines.add(residuals_of_spots(usable, found, top))
        slope, slope_sigma = lines.slope(rounding)
    floor = lines.model(slope, rounding).floor_dn2
    lowest = min(float(levels.level.min(initial=background)), background) if levels.temporal else background
    shadow = min(slope * (background - lowest), floor - rounding)
    model = replace(first, slope_dn=slope, floor_dn2=floor, shadow_dn2=shadow)
    floor_sigma = float(np.interp(slope, lines.slopes, lines.floor_sigma)) / model.floor_dn2
    # With hardly any noise on a background of few grey values their steps look like texture, unless it is larger.
    steps = banding(model.floor_dn2, rounding)
    stepped = steps > max(_STEPS_SEEN, _TEXTURE_SEEN * model.texture) * background
    found = [find_spots(p, DetectParameters(max_detections=_MOST_SPOTS), model) for p in usable]
    shift = TextureShift.usual(usable[0]) if stepped else texture_shift(seen, model, full, found, black_dn)
    shift = shift.with_lights(found, _ABOVE_TEXTURE * model.texture * background)
    model = replace(model, profile=spot_profile(usable, found, model, saturation))
    grainy = shows_grains(usable, found, model, top)
    return NoiseEstimate(model, floor_sigma, slope_sigma, saturation, step, len(usable), levels.temporal, shift, grainy)


def _small_picture_variance(pictures: Sequence[Picture]) -> float:
    pixels = np.concatenate([np.abs(np.diff(p.astype(float), axis=1)).ravel() for p in pictures] or [np.zeros(0)])
    return quantile_variance(pixels / np.sqrt(2)) if pixels.size else 0.0


@dataclass(slots=True)
class _Lines:
    """A grid of slopes with the best floor for each and the likelihood of the pair."""

    slopes: Array  # (k,), DN
    floor: Array  # (k,), DN^2, variance at `background`
    floor_sigma: Array  # (k,)
    background: float  # DN
    full: float  # DN, full scale
    log_likelihood: Array  # (k,)

    @staticmethod
    def fit(levels: LevelVariances, background: float, full: float, rounding: float) -> _Lines:
        """The lines fitted to the variances by level, robust to levels that contradict them."""
        slopes = np.geomspace(full / _WELL_E[1], full / _WELL_E[0], _SLOPES)
        if not len(levels.level):
            unknown = np.full(_SLOPES, rounding)
            return _Lines(slopes, unknown, unknown.copy(), background, full, np.zeros(_SLOPES))
        if not levels.temporal:  # structure, and the gamma curve of photographs, bend the line: only its start counts
            return _Lines.from_point(background, max(levels.nearest(background), rounding), full)
        lift = levels.level - background
        rise = slopes[:, None] * lift
        weight = np.ones_like(rise) / levels.sigma**2
        floor = np.full(_SLOPES, levels.nearest(background))
        for _ in range(4):
            # Below the background's level the variance stays above that of rounding.
            expected = np.maximum(floor[:, None] + rise, 0.5 * rounding)
            misfit = ((levels.variance - expected) / levels.sigma) ** 2
            robust = weight / np.maximum(misfit / _LARGEST_MISFIT, 1.0)
            floor = np.maximum(np.sum(robust * (levels.variance - rise), axis=1) / np.sum(robust, axis=1), rounding)
        sigma = 1 / np.sqrt(np.sum(robust, axis=1))
        log_likelihood = -0.5 * np.minimum(misfit, _LARGEST_MISFIT).sum(axis=1)
        return _Lines(slopes, floor, sigma, background, full, log_likelihood)

    @staticmethod
    def from_point(background: float, variance: float, full: float) -> _Lines:
        """The lines through one point: the background, if it is clipped at zero or known from one picture only."""
        slopes = np.geomspace(full / _WELL_E[1], full / _WELL_E[0], _SLOPES)
        floor = np.full(_SLOPES, variance)
        return _Lines(slopes, floor, 0.2 * floor, background, full, np.zeros(_SLOPES))

    def add(self, spots: SpotResiduals) -> None:
        """Add the likelihood of the residuals of fitted spots, averaged over contrasts of the light's grain.

        The grain of the light (texture, speckle, a spot that is not Gaussian) adds a variance of (contrast times
        light)^2 with a large uncertainty: where it dominates, the residuals do not constrain the slope.
        """
        if len(spots.square) < LEAST_PIXELS:
            return
        brightest = float(spots.light.max())
        edges = np.geomspace(max(0.03 * brightest, 1e-6), brightest * 1.001, LEVELS)
        brightness = np.digitize(spots.light, edges)
        rows = [r for r in (brightness == k for k in range(len(edges))) if np.count_nonzero(r) >= _LEAST_OF_SPOTS]
        measured = np.array(
            [np.mean(np.minimum(spots.square[r], 12 * np.median(spots.square[r]) + 1e-9)) for r in rows]
        )
        light2 = np.array([np.mean(spots.grainy[r] ** 2) for r in rows])
        lift = np.array([np.mean(np.maximum(spots.level[r] - self.background, 0.0)) for r in rows])
        count = np.array([np.count_nonzero(r) for r in rows])
        log_likelihoods = np.zeros((len(_CONTRASTS), _SLOPES))
        for row, contrast in enumerate(_CONTRASTS):
            grain = contrast**2 * light2
            expected = self.floor[:, None] + self.slopes[:, None] * lift + grain
            known = (2 / np.minimum(count, _MOST_OF_SPOTS) + 0.1**2) * expected**2
            sigma = np.sqrt(known + (_GRAIN_SIGMA * grain) ** 2)
            misfit = np.minimum(((measured - expected) / sigma) ** 2, _LARGEST_MISFIT)
            log_likelihoods[row] = -0.5 * np.sum(misfit + 2 * np.log(sigma), axis=1)
        self.log_likelihood = self.log_likelihood + np.logaddexp.reduce(log_likelihoods - log_likelihoods.max(), axis=0)

    def slope(self, rounding: float) -> tuple[float, float]:
        """The slope, DN, as the posterior mean of its logarithm, and the logarithm's sigma."""
        log_posterior = self.log_likelihood + self._log_prior(rounding)
        weight = np.exp(log_posterior - log_posterior.max())
        weight /= weight.sum()
        log = np.log(self.slopes)
        mean = float(weight @ log)
        return float(np.exp(mean)), float(np.sqrt(weight @ (log - mean) ** 2))

    def model(self, slope: float, rounding: float) -> NoiseModel:
        """The noise model with this slope and the floor that belongs to it."""
        return NoiseModel(max(float(np.interp(slope, self.slopes, self.floor)), rounding), slope, self.background)

    def _log_prior(self, rounding: float) -> Array:
        """(k,): log prior of a usual full well and of a read noise within _READ_E."""
        full_well = -0.5 * (np.log(self.slopes * FULL_SCALE_E / self.full) / _WELL_SPREAD) ** 2
        # The floor is read noise plus the shot noise of the background's light, which is between 0 and its level.
        read2 = np.maximum(self.floor - rounding, 0.02 * rounding)
        too_noisy = np.log(np.maximum((_READ_E[0] * self.slopes) ** 2 / read2, 1.0))
        shot = self.slopes * max(self.background, 0.0)
        too_quiet = np.log(np.maximum(read2 / ((_READ_E[1] * self.slopes) ** 2 + shot), 1.0))
        return np.asarray(full_well - 2.0 * (too_noisy**2 + too_quiet**2))
