"""The shape that narrow spots share in one camera, estimated from its pictures.

A lens gives a point of light a sharp core with wings. In a spot of about one pixel a Gaussian that is fitted to both is
too wide, and its centre is pulled towards the centre of the brightest pixel, by up to a tenth of a pixel. So the spots
are fitted with a sum of Gaussians of one centre (detection/normal_equations.py) whose shares are those of the camera.
Each spot keeps its own covariance, since the sharpness of a lens varies over the picture.

Pixels alone do not determine the shape within a pixel: with any function of the place within the pixel added to all
centres, another shape fits as well. This is also true of an effective point spread function on a grid (Anderson & King
2000, PASP 112:1360), which needs pictures shifted by known amounts. Here two things decide: the sum of Gaussians is
smooth, and among the shapes that fit equally well the one is taken that distributes the centres evenly over the pixel.
It is used if spots that had no part in the choice fit better with it. What it leaves is a share of each pixel's light,
which counts as noise. Source: ours; measured by bench/star_fields.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from geometry.arrays import Array
from tracking.detection.detect import find_spots
from tracking.detection.measuring import NARROW_PX
from tracking.detections import Detections
from tracking.noise import NORMAL_68, NoiseModel, Picture, SpotProfile
from tracking.parameters import DetectParameters

_MOST = 400  # spots of all pictures: the brightest
_CLEAR = 0.1  # sigma of the centre over the width of the spot: of a fainter one the pixels do not show the shape, and
# it is found more easily in the middle of a pixel
_FEWEST = 24  # narrow and clear spots ...
_PLACES, _PLACE_PX = 16, 0.2  # ... at so many places: of a spot at rest all pictures show the same
_FIRST = SpotProfile(0.5, 0.6, 0.05, 0.1)
_FAR, _NEAR, _NEAR_PX = (0.0, 0.1, 0.15), (0.2, 0.4, 0.6, 0.8), (0.5, 0.6, 0.7, 0.85)
_SIGMAS = 3.0  # of the number of spots that fit better
_SHAPE_NOISE, _LEAST_SCATTER = 3.0, 0.3  # of the shapes: factor for noise; share of their scatter that is not noise
_UNEVEN = (0.0, 0.05, 0.1, 0.15, 0.2, 0.25)  # shares of uneven light that are tried
_BRIGHT = 1 / 8  # share of the spots, whose fits show what is left
_FAINT = 0.25  # of their flux: much fainter
_NOISE_KNOWN = 0.1  # relative uncertainty of the variance of a pixel
_CUT = 0.5  # largest misfit that counts: two stars in one spot, or a hot pixel, have more


def spot_profile(
    pictures: Sequence[Picture], found: Sequence[Detections], noise: NoiseModel, saturation_dn: float | None
) -> SpotProfile:
    """The profile of narrow spots in pictures (h, w); without wings if these do not fit better.

    found: the brightest spots of each picture. noise: without a profile.
    """
    if sum(map(len, map(_narrow_and_clear, found))) < _FEWEST:
        return SpotProfile()
    spots = _NarrowSpots.of(pictures, noise, saturation_dn)
    if spots.places < _PLACES:
        return SpotProfile()
    tried = {_FIRST: spots.fits(_FIRST)}

    def best(rows: slice = slice(None)) -> SpotProfile:
        return min(tried, key=lambda p: float(tried[p].misfits[rows].sum()))

    def compare(profiles: Sequence[SpotProfile]) -> None:
        tried.update({p: spots.fits(p) for p in profiles if p not in tried})

    gaussian = spots.fits(SpotProfile()).misfits
    if _better(gaussian, tried[_FIRST].misfits) < _SIGMAS:
        return SpotProfile()
    compare([replace(_FIRST, far=far) for far in _FAR])
    compare([SpotProfile(near, px, best().far, _FIRST.uneven) for near in _NEAR for px in _NEAR_PX])
    even, odd = slice(0, None, 2), slice(1, None, 2)
    held_out = [
        spots.fits(replace(best(half), uneven=0.0)).misfits[other] for half, other in ((even, odd), (odd, even))
    ]
    if _better(np.concatenate([gaussian[odd], gaussian[even]]), np.concatenate(held_out)) < _SIGMAS:
        return SpotProfile()
    fittest = tried[best()].misfits
    weights = []
    for fits in tried.values():
        worse = fits.misfits - fittest
        # In units of log-likelihood. Sums of misfits have their observed scatter, because they are not only noise.
        improbable = 0.5 * worse.sum() ** 2 / np.sum(worse**2 + 1e-12) + spots.places * fits.concentration
        weights.append(np.exp(-improbable))
    shapes = [[p.near, p.near_px, p.far] for p in tried]
    near, near_px, far = np.average(shapes, axis=0, weights=weights).tolist()
    mean = SpotProfile(near, near_px, far, _FIRST.uneven)
    return spots.with_uneven(spots.with_shape(mean))


def _better(before: Array, after: Array) -> float:
    """By how many sigmas more than half of the misfits (n,) have become smaller."""
    return float(np.sum(np.sign(before - after)) / np.sqrt(len(before)))


@dataclass(frozen=True, slots=True)
class _Fits:
    """Fits of n spots with one profile."""

    misfits: Array  # (n,) logarithms of chi-square per degree of freedom
    shapes: Array  # (n, 3) px^2: covariances uu, uv, vv
    variances: Array  # (n,) px^2, of the centres
    concentration: float  # sum over u and v of squared mean cosines of the phase in a pixel: 0 if it is even


@dataclass(frozen=True, slots=True)
class _NarrowSpots:
    """The narrow and clear spots of some pictures, fitted with Gaussians."""

    pictures: tuple[Picture, ...]
    spots: tuple[Detections, ...]
    noise: NoiseModel
    parameters: DetectParameters
    places: int  # different ones

    @staticmethod
    def of(pictures: Sequence[Picture], noise: NoiseModel, saturation_dn: float | None) -> _NarrowSpots:
        parameters = DetectParameters(max_detections=-(-_MOST // len(pictures)), saturation_dn=saturation_dn)
        spots = tuple(_narrow_and_clear(find_spots(p, parameters, noise)) for p in pictures)
        places = np.zeros((0, 2))
        for uv in (d.uv_px for d in spots):
            away = np.linalg.norm(uv[:, None] - places, axis=-1).min(axis=1, initial=np.inf)
            places = np.concatenate([places, uv[away > _PLACE_PX]])
        return _NarrowSpots(tuple(pictures), spots, noise, parameters, len(places))

    @property
    def count(self) -> int:
        """n."""
        return sum(map(len, self.spots))

    def fits(self, profile: SpotProfile) -> _Fits:
        """A spot that is not found again keeps its Gaussian."""
        misfits, centres, shapes, variances, model = [], [], [], [], replace(self.noise, profile=profile)
        for picture, spots in zip(self.pictures, self.spots, strict=True):
            boxes = np.column_stack([spots.uv_px, np.full(len(spots), NARROW_PX)])
            again = find_spots(picture, self.parameters, model, boxes)
            away = np.linalg.norm(spots.uv_px[:, None] - again.uv_px, axis=-1)
            there = away.min(axis=1, initial=np.inf) < NARROW_PX
            nearest = away[there].argmin(axis=1) if len(again) else np.zeros(0, int)
            misfit, centre, shape, variance = _log_chi2(spots), spots.uv_px.copy(), _shapes(spots), _variances(spots)
            misfit[there], centre[there] = _log_chi2(again)[nearest], again.uv_px[nearest]
            shape[there], variance[there] = _shapes(again)[nearest], _variances(again)[nearest]
            misfits.append(misfit)
            centres.append(centre)
            shapes.append(shape)
            variances.append(variance)
        cosines = np.cos(2 * np.pi * np.concatenate(centres)).mean(axis=0)
        joined = [np.concatenate(part) for part in (misfits, shapes, variances)]
        return _Fits(joined[0], joined[1], joined[2], float(cosines @ cosines))

    def with_shape(self, profile: SpotProfile) -> SpotProfile:
        """The profile with the usual shape of the brighter half and its scatter.

        The variance of an element of a shape S by noise is 2 S to 4 S times that of the centre.
        """
        bright = np.argsort(-np.concatenate([d.flux for d in self.spots]))[: (self.count + 1) // 2]
        fits = self.fits(profile)
        usual = np.median(fits.shapes[bright], axis=0)
        scatter = float(np.quantile(np.abs(fits.shapes[bright] - usual), 0.68)) / NORMAL_68
        uu, uv, vv = map(float, usual)
        by_noise = _SHAPE_NOISE * 0.5 * (uu + vv) * float(np.median(fits.variances[bright]))
        sigma = float(np.sqrt(max(scatter**2 - by_noise, (_LEAST_SCATTER * scatter) ** 2)))
        return replace(profile, shape_px2=(uu, uv, vv), shape_sigma_px2=sigma)

    def with_uneven(self, profile: SpotProfile) -> SpotProfile:
        """The profile with what it leaves of the light: with that, the brightest spots fit no worse than faint ones.

        Without much fainter ones they fit as well as the noise model states, as far as that is known.
        """
        flux = np.concatenate([d.flux for d in self.spots])
        bright = np.argsort(-flux)[: int(np.ceil(_BRIGHT * self.count))]
        faint = np.flatnonzero(flux < _FAINT * np.median(flux[bright]))
        before, last = 0.0, 0.0
        for uneven in _UNEVEN:
            misfits = np.clip(self.fits(replace(profile, uneven=uneven)).misfits, -_CUT, _CUT)
            expected = _NOISE_KNOWN
            if len(faint) >= _FEWEST:
                expected = float(misfits[faint].mean() + misfits[bright].std() / np.sqrt(len(bright)))
            worse = float(misfits[bright].mean()) - expected
            if worse <= 0.0:
                uneven -= (uneven - last) * worse / min(worse - before, -1e-12)
                break
            before, last = worse, uneven
        return replace(profile, uneven=uneven)


def _narrow_and_clear(found: Detections) -> Detections:
    """Those whose shape the pixels show."""
    width = np.sqrt(found.major_px * found.minor_px)
    return found[(width < NARROW_PX) & (np.sqrt(_variances(found)) < _CLEAR * width)]


def _variances(found: Detections) -> Array:
    """(n,) px^2, of a coordinate of the centre."""
    return np.asarray(0.5 * np.trace(found.cov_px2, axis1=1, axis2=2))


def _shapes(found: Detections) -> Array:
    """(n, 3) px^2: covariances uu, uv, vv."""
    major, minor, angle = found.major_px**2, found.minor_px**2, np.radians(found.angle_deg)
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([major * c**2 + minor * s**2, (major - minor) * c * s, major * s**2 + minor * c**2], axis=-1)


def _log_chi2(found: Detections) -> Array:
    """(n,) logarithms of chi-square per degree of freedom."""
    assert found.chi2 is not None  # of all detections in pictures
    return np.log(np.maximum(found.chi2, 1e-300))
