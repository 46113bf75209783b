"""Errors of the spots' centres due to the screen's texture, predicted from the texture of the background.

A fit with equal weights moves by s^2 sum(x G d) / sum(x^2 G^2) if the light changes by d, with G the spot's Gaussian of
sigma s. Texture of relative contrast t changes the spot's own light, A G, by A G t and that of the background, B, by
B t. So the error is the output of two linear filters of t, with the kernels s^2 x G^2 / sum(x^2 G^2) and, times B / A,
s^2 x G / sum(x^2 G^2). Their outputs anywhere on the background have the distribution of the errors of the spots.
Source: ours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from geometry.arrays import Array
from geometry.compilation.jit import compiled
from tracking.detections import Detections
from tracking.noise import BLOCK, NORMAL_68, NoiseModel, Picture, quantile_variance
from tracking.noise_estimation.black_level import level_over_light
from tracking.noise_estimation.texture import MeanPicture
from tracking.shapes import DEVELOPED_SPECKLE

_WIDTHS_PX = (0.8, 1.6, 3.2, 6.4, 12.8, 25.6)  # of spots
_COARSE_PX = 4.0  # width from which the smooth part of the background counts: it may be uneven response (vignetting)
_LARGEST_CONTRAST = 0.3  # more is an edge or an object
_REACH = 3.0  # sigmas of the kernel to each side
_USUAL_FALL = 0.2  # share of the light lost in the corners by usual lenses
_OBLIQUE = 0.35  # usual share by which what is seen obliquely is larger half a diagonal nearer to the camera
_USUAL_TEXTURE = 0.002  # of the width: error on a surface of 0.5 % texture, less than that of paper or matt paint
_PLANE_FITS = 4  # each without the cells that the one before shows to be no screen
_BRIGHT = 0.2  # above the background: a light, whose surroundings are left out on the coarse scale
_FEWEST = 60  # samples of the filters' outputs on the coarse scale; with fewer the last error is used
_FEWER_PIXELS = 1.6  # pixels per sigma of a spot above which pixels are averaged in pairs
_NARROWEST_PX = 0.5  # half axis, with the pixel's own width
_USUAL = 0.3  # quantile of the lights' misfits: of reflections and other clutter many have larger ones than spots
_RESOLVED_PX, _CLEAR = 1.8, 0.02  # width from which a misfit shows; noise of the centre, in widths, of clear lights
_FEWEST_LIGHTS = 6  # whose quantile is used
_WIDER = 4.0  # times the usual width: no spot
_CLEARLY_MORE = 6.0  # ratio of the variance that a fit shows to that expected: of one spot it has a factor of two
_FEWEST_PLACES = 500  # samples of the filters' outputs without lights and lines; with fewer all are used
# Height of a Gaussian at which the weights of its fit count: by a Monte Carlo of fits with 9 parameters on texture of
# 1.2 px, which shifts spots of 1.6 px with a brightness of 4.6 by 0.9 of what it does with equal weights.
_WEIGHTED = 0.145
_UNSURE = 0.02  # of the noise of the mean picture, which is subtracted: usual error of its estimate
_SURROUNDINGS = 6.0  # widths: of a spot, beyond the reach of the kernel
_SAMPLED = 3  # px: step of the sample of the filters' outputs
LARGEST_SHARE = 0.25  # of the spot's width: a larger error is not assumed; faint spots on texture have half of it
_IN_BACKGROUND = 2.0, 4.0  # shift of a fit by the background over that by its light: at edges, on coarse texture
_OWN, _RING = 1.5, (2.2, 5.5)  # widths: the surroundings of a light at rest, and the ring around them
_NOISIER = 4.0  # times the usual noise: places of which a light at rest hides the structure
_LARGEST_AT_REST = 1.0  # the same of a light at rest, whose fit absorbs structure of its own width


@dataclass(frozen=True, slots=True)
class TextureShift:
    """Sigmas, px and per coordinate, of spots of the widths (k,), px, at any place of the screen."""

    widths_px: tuple[float, ...]
    light_px: tuple[float, ...]  # by the texture in the spot's own light
    background_px: tuple[float, ...]  # by the texture in the background, for a spot as bright as the background
    known: bool = True  # the pictures could show it: neither too small nor too coarsely rounded
    half_diagonal_px: float = float("inf")  # of the pictures; inf: not known
    # Usual error of the lights in the pictures by misfits of their fits, as a share of their widths; nan: too few
    # lights that are wide enough to show it
    misfit_share: float = float("nan")
    over_light: float = 1.0  # ratio of the background's level, which contains the black level, to its light

    @staticmethod
    def none() -> TextureShift:
        """No texture."""
        return TextureShift((1.0,), (0.0,), (0.0,), known=False)

    @staticmethod
    def usual(picture: Picture) -> TextureShift:
        """For pictures (h, w) that cannot show it: little texture."""
        light, none = tuple(_USUAL_TEXTURE * w for w in _WIDTHS_PX), tuple(0.0 for _ in _WIDTHS_PX)
        return TextureShift(_WIDTHS_PX, light, none, False, 0.5 * float(np.hypot(*picture.shape)))

    def with_lights(self, found: Sequence[Detections], least_dn: float = 0.0) -> TextureShift:
        """These errors with `misfit_share` from the lights found in pictures.

        Reflections are much wider than the spots, which are the bright lights, and no Gaussians. least_dn: peak of
        narrow ones that are no texture.
        """
        narrow: list[float] = []
        shares: list[float] = []
        widths = [np.sqrt(points.major_px * points.minor_px) for points in found]
        every, peaks = np.concatenate([*widths, np.zeros(1)]), np.concatenate([*(p.peak for p in found), np.zeros(1)])
        order = np.argsort(every)
        by_peak = np.cumsum(peaks[order])
        usual_px = every[order][np.searchsorted(by_peak, 0.5 * by_peak[-1])]  # median, weighted with the peaks
        for points, width in zip(found, widths, strict=True):
            variance = points.variance_px2
            misfit = np.zeros(len(points)) if points.misfit is None else points.misfit
            clear = (width < _WIDER * usual_px) & (variance * (1 - misfit) < (_CLEAR * width) ** 2)
            share, wide = np.sqrt(misfit * variance) / width, width > _RESOLVED_PX
            shares.extend(share[clear & wide])
            narrow.extend(share[clear & ~wide & (points.peak > least_dn)])
        usual, of_all = _usual_of(shares), _usual_of(narrow + shares)
        usual = of_all if of_all > DEVELOPED_SPECKLE else usual
        return replace(self, misfit_share=usual) if np.isfinite(usual) else self

    @property
    def of_light(self) -> TextureShift:
        """That of the spot's own light alone."""
        return replace(self, background_px=tuple(0.0 for _ in self.widths_px))

    def sigma_px(
        self, width_px: Array, contrast: Array, brightness: Array | float = 0.0, light_px: Array | None = None,
        largest: float = LARGEST_SHARE,
    ) -> Array:  # fmt: skip
        """Sigmas (n,), px, of spots with these widths (n,), px, and peaks (n,) relative to the background.

        brightness (n,): variance of the shot noise at the peak over that of the background's noise; a fit gives bright
        pixels less weight, so that its kernel in the light is rather x G^p with p < 2, which is (p / 2) times that of a
        spot wider by sqrt(2 / p). Both parts come from the same texture, so they are added. nan where a width is not
        known. light_px (n,): `local_shifts` at their places, instead of those of any place. largest: share of the
        width.
        """
        at, widths = np.log(np.maximum(width_px, 1e-3)), np.log(self.widths_px)
        shot = _WEIGHTED * np.maximum(brightness, 0.0)
        p = 2 - shot / (1 + shot)
        light = 0.5 * p * np.interp(at + 0.5 * np.log(2 / p), widths, self.light_px)
        background = np.interp(at, widths, self.background_px)
        if light_px is not None:
            # As many times as far as the kernel in the light as elsewhere; at an edge twice as far.
            times = background / np.maximum(np.interp(at, widths, self.light_px), 1e-9)
            background = np.clip(times, *_IN_BACKGROUND) * light_px * (max(self.background_px) > 0)
            light = np.sqrt(0.5 * p) * light_px
        return np.minimum(light + background / np.maximum(contrast, 1e-3), largest * np.asarray(width_px))

    def _fall_per_px(self) -> float:
        """Relative change of the light per pixel, since a lens transmits less to the corners: it shifts by s^2 of it.

        The usual one half way to the corner, or what the background shows in the shift of the narrowest coarse width.
        """
        usual = _USUAL_FALL / self.half_diagonal_px
        coarse = [i for i, w in enumerate(self.widths_px) if w > _COARSE_PX] if self.known else []
        return min(usual, self.light_px[coarse[0]] / self.widths_px[coarse[0]] ** 2) if coarse else usual

    def added_to(
        self, found: Detections, noise: NoiseModel, light_px: Array | None = None, at_rest: bool = False
    ) -> Detections:
        """Points whose covariances include these errors; noise: of the pictures, with the background's level.

        light_px (n,): sigmas by the texture in the light of each, with equal weights, where its place is known.
        at_rest: that texture is in the shapes of the fits as well, which therefore do not show a direction.

        The kernels above of an elliptical Gaussian give variances along its axes in proportion to its half axes. The
        fits' misfits show these errors as well, less precisely; if they are clearly larger, they count instead: they
        contain other errors, such as speckle. Both belong to the place.
        """
        misfit = np.zeros(len(found)) if found.misfit is None else found.misfit
        width_px, brightness = np.sqrt(found.major_px * found.minor_px), noise.slope_dn * found.peak / noise.floor_dn2
        largest = _LARGEST_AT_REST if at_rest else LARGEST_SHARE
        sigma_px = self.sigma_px(width_px, found.peak / max(noise.black_dn, 1.0), brightness, light_px, largest)
        # The half of a wide light that is nearer to the camera looks larger: its axis is not in its middle.
        narrow_px2 = np.minimum(width_px**2, _COARSE_PX**2)
        uneven_px = self._fall_per_px() * narrow_px2 + _OBLIQUE * (width_px**2 - narrow_px2) / self.half_diagonal_px
        sigma_px = np.hypot(sigma_px, uneven_px)
        axes = np.stack([found.major_px, found.minor_px, np.radians(found.angle_deg)])
        if at_rest:  # round
            axes = np.stack([width_px, width_px, np.zeros(len(found))])
        cov_px2, place_px2 = _with_errors(np.asarray(found.cov_px2), misfit, axes, sigma_px, self.misfit_share)
        return replace(found, cov_px2=cov_px2, place_px2=place_px2)


def _usual_of(shares: Sequence[float]) -> float:
    return float(np.quantile(shares, _USUAL)) if len(shares) >= _FEWEST_LIGHTS else float("nan")


@compiled
def _with_errors(
    cov_px2: Array, misfit: Array, axes: Array, sigma_px: Array, usual_share: float
) -> tuple[Array, Array]:
    """The covariances (n, 2, 2) with these errors, and the part (n,) of a coordinate's variance that is theirs.

    misfit (n,): share of the covariance; axes (3, n): half axes, px, and angle, rad; sigma_px (n,), nan: not known;
    usual_share: misfit_share of TextureShift.
    """
    out, place_px2 = cov_px2.copy(), np.zeros(len(cov_px2))
    for k in range(len(out)):
        major, minor, known = max(axes[0, k], _NARROWEST_PX), max(axes[1, k], _NARROWEST_PX), axes[:, k].sum() < np.inf
        along, across, ratio = np.cos(axes[2, k]), np.sin(axes[2, k]), major / minor
        if not known:  # round
            along, across, ratio = 1.0, 0.0, 1.0
        uu, vv = ratio * along**2 + across**2 / ratio, ratio * across**2 + along**2 / ratio
        uv = (ratio - 1 / ratio) * along * across
        trace, seen = 0.5 * (uu + vv), 0.5 * misfit[k] * (cov_px2[k, 0, 0] + cov_px2[k, 1, 1])
        variance = 0.0 if np.isnan(sigma_px[k]) else sigma_px[k] ** 2
        other = seen > _CLEARLY_MORE * variance * trace
        place_px2[k] = seen if other else variance * trace
        # The grain of the light is the same for all spots of a camera, but does not show in each: then it is at least
        # usual.
        usual = usual_share**2 * major * minor
        if usual_share > 0 and known and place_px2[k] < usual:
            variance, other, place_px2[k] = usual, False, usual * trace
        if not other:
            for i in range(2):
                for j in range(2):
                    part = uu if i + j == 0 else (vv if i + j == 2 else uv)
                    out[k, i, j] = (1 - misfit[k]) * cov_px2[k, i, j] + variance * part
    return out, place_px2


def texture_shift(
    seen: MeanPicture, noise: NoiseModel, full_dn: float, found: Sequence[Detections], black_dn: float | None
) -> TextureShift:
    """The errors of spots on the background of one camera's pictures, less those by noise. full_dn: full scale.

    The lights found in the pictures and lines, such as edges and seams, are not texture. black_dn: grey value without
    light; None: not known.

    As in `texture_of`, the background counts without its smooth part. For wide spots the smooth part counts, except for
    a plane over the picture: light that falls from one side does not shift a spot, but a response of lens and screen
    that varies over the spot does, and both look alike.
    """
    mean, background, pictures = seen
    level = np.maximum(background, 1.0)
    texture: NDArray[Any] = np.clip((mean - background) / level, -_LARGEST_CONTRAST, _LARGEST_CONTRAST)
    sample = level[::BLOCK, ::BLOCK].astype(float)
    objects = lights_and_lines(texture, found)
    own = _without_rows_and_columns(texture, objects)
    cell = 1
    variance = noise.of_means.variance(sample) / pictures
    white = float(np.median(variance / sample**2))
    # Contrasts are relative to the level; those of the light are larger.
    more = level_over_light(mean - background, level, float(np.median(variance)), full_dn, black_dn)
    light, around = [], []
    for sigma_px in (w for w in _WIDTHS_PX if w < _COARSE_PX):
        if sigma_px > _FEWER_PIXELS * cell:
            cell *= 2
            texture, own = (cv2.resize(t, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA) for t in (texture, own))
        some = np.asarray(cv2.resize(objects, texture.shape[::-1], interpolation=cv2.INTER_NEAREST), np.uint8)
        light.append(cell * _shift(own, some, sigma_px / cell, 2, white / cell**2))
        around.append(cell * _shift(texture, some, sigma_px / cell, 1, white / cell**2))
    for sigma_px in (w for w in _WIDTHS_PX if w > _COARSE_PX):
        cell *= 2
        shifts = _coarse_shifts(mean, objects, cell, sigma_px / cell, white / cell**2)
        light.append(light[-1] if shifts is None else max(cell * shifts[0], light[-1]))
        around.append(around[-1] if shifts is None else max(cell * shifts[1], around[-1]))
    half_diagonal = 0.5 * float(np.hypot(*mean.shape))
    return TextureShift(_WIDTHS_PX, tuple(more * x for x in light), tuple(around), True, half_diagonal, over_light=more)


def _without_rows_and_columns(texture: NDArray[Any], objects: NDArray[np.uint8]) -> NDArray[Any]:
    """A texture (h, w) less the means of its rows and columns: these are offsets of the sensor, not of the screen."""
    weight = (objects == 0).astype(np.float32)
    rows = np.sum(weight * texture, axis=1, keepdims=True) / np.maximum(weight.sum(axis=1, keepdims=True), 1)
    columns = np.sum(weight * texture, axis=0) / np.maximum(weight.sum(axis=0), 1)
    return np.asarray(texture - rows - columns)


def _shift(texture: NDArray[Any], objects: NDArray[np.uint8], sigma_px: float, power: int, white: float) -> float:
    """Sigma, px, of the filter with G^power of a texture (h, w), less the part of white noise of this variance.

    objects (h, w): 1 where something else than texture is seen; the filter does not reach these places.
    """
    reach = _reach(sigma_px, power)
    inner = reach + 2 * BLOCK
    if min(texture.shape) < 2 * inner + 4 * _SAMPLED:
        return 0.0
    kernels = odd, smooth = _kernels(sigma_px, power, reach)
    middle = slice(inner, -inner, _SAMPLED)
    free = cv2.dilate(objects, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8))[middle, middle] == 0
    if np.count_nonzero(free) < _FEWEST_PLACES:
        free[:] = True
    outputs = [o[middle, middle][free] for o in _filtered(texture, *kernels)]
    variance = quantile_variance(np.abs(np.concatenate(outputs)))
    return float(np.sqrt(max(variance - (1 + _UNSURE) * white * np.sum(odd**2) * np.sum(smooth**2), 0.0)))


def _kernels(sigma_px: float, power: int, reach: int) -> tuple[Array, Array]:
    """The factors of a filter, s^2 x G^power / sum(x^2 G^2) and G^power of the other coordinate, (2 reach + 1,)."""
    x = np.arange(-reach, reach + 1)
    G = np.exp(-0.5 * (x / sigma_px) ** 2)
    smooth = G**power
    return sigma_px**2 * x * smooth / (np.sum(x**2 * G**2) * np.sum(G**2)), smooth


def _filtered(texture: NDArray[Any], odd: Array, smooth: Array) -> list[NDArray[Any]]:
    """The shifts in u and in v, both (h, w)."""
    return [cv2.sepFilter2D(texture, cv2.CV_32F, *k) for k in ((odd, smooth), (smooth, odd))]


def local_shifts(
    background: NDArray[np.float32], variance: NDArray[np.float32] | float, width_px: float
) -> NDArray[np.float32]:
    """Sigmas, px, of a spot of this width at each place of a known background (h, w), by the texture in its light.

    That of the surroundings of a pixel, as large as the spot, as if the background were the screen, lit evenly. Where
    it is not, or is lit by other lamps as well, the errors are smaller: an upper bound, of which the residuals show how
    much is true. variance (h, w), DN^2: of the background's own errors. Where they hide the texture, as behind a bright
    light, it is that of the wider surroundings: the mean of both, each with the inverse square of its error.
    """
    seen, noise = _squared_shifts(background, variance, width_px)
    side, wide = 2 * int(np.ceil(width_px)) + 1, 2 * _wider(width_px) + 1
    here, error = cv2.blur(seen, (side, side)), cv2.blur(noise, (side, side))
    usual = max(float(np.median(noise)), 1e-30)
    weight = (usual / (usual + noise)) ** 2
    around = np.maximum(cv2.blur(weight * seen, (wide, wide)) / cv2.blur(weight, (wide, wide)), 0.0)
    share = around**2 / np.maximum(around**2 + error**2, np.float32(1e-30))
    return np.asarray(np.sqrt(np.maximum(share * here + (1 - share) * around, 0.0)), np.float32)


def _squared_shifts(
    background: NDArray[np.float32], variance: NDArray[np.float32] | float, width_px: float
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(h, w), px^2: squares of the shifts of such spots without what the errors cause, and that; as `local_shifts`."""
    odd, smooth = _kernels(width_px, 2, _reach(width_px))
    light = np.maximum(cv2.sepFilter2D(background, cv2.CV_32F, smooth / smooth.sum(), smooth / smooth.sum()), 1.0)
    moved = [(x / light) ** 2 for x in _filtered(background, odd, smooth)]
    everywhere = np.broadcast_to(np.asarray(variance, np.float32), background.shape)
    noise = np.asarray(sum(_filtered(everywhere, odd**2, smooth**2)) / (2 * light**2), np.float32)
    return np.asarray(0.5 * (moved[0] + moved[1]) - noise, np.float32), noise


def _reach(width_px: float, power: int = 2) -> int:
    """Half side, px, of the kernel with G^power; 2: that in the light of a spot."""
    return int(np.ceil(_REACH * width_px / np.sqrt(power)))


def _wider(width_px: float) -> int:
    """Half side, px, of the surroundings of a spot that show the texture where its own light hides it."""
    return _reach(width_px) + int(np.ceil(_SURROUNDINGS * width_px))


def shifts_at_rest(background: NDArray[np.float32], variance: NDArray[np.float32], lights: Detections) -> Array:
    """(n,) px: as `local_shifts`, at the places of lights at rest, each as wide as it is.

    background, variance (h, w): as there, without the lights. Their fits have taken up structure as if it were light.
    So it is at least as large as the usual one of the ring around each. An edge that crosses the ring is not in it: it
    would be seen on both sides if the light hid a part.
    """
    out = np.zeros(len(lights))
    # The fit of a light at the border may lie beyond it.
    places = np.clip(np.rint(lights.uv_px), 0, np.array(background.shape[::-1]) - 1).astype(int)
    for i, (u, v) in enumerate(places):
        width = max(float(np.sqrt(lights.major_px[i] * lights.minor_px[i])), _NARROWEST_PX)
        half = _wider(width) + _reach(width) + 1
        top, left = max(v - half, 0), max(u - half, 0)
        part = np.s_[top : v + half + 1, left : u + half + 1]
        seen, noise = _squared_shifts(background[part], variance[part], width)
        rows, columns = np.ogrid[: seen.shape[0], : seen.shape[1]]
        away = np.hypot(columns + left - u, rows + top - v) / width
        inner, ring = away < _OWN, (away > _RING[0]) & (away < _RING[1])
        clear = ring & (noise < _NOISIER * np.median(noise))
        ring = clear if clear.any() else ring
        around = max(float(np.median(seen[ring])) / np.log(2), 0.0) if ring.any() else 0.0
        # Its own noise hides structure that is weaker.
        share = around**2 / max(around**2 + float(noise[inner].mean()) ** 2, 1e-30)
        out[i] = np.sqrt(share * max(float(seen[inner].mean()), around) + (1 - share) * around)
    return out


def _coarse_shifts(
    mean: NDArray[Any], objects: NDArray[np.uint8], cell: int, sigma_px: float, white: float
) -> tuple[float, float] | None:
    """Sigmas, cells, by the light's and by the background's texture in cells of a mean picture (h, w); None: no room.

    objects (h, w): as in `_shift`; sigma_px: of a spot, in cells; white: variance of the noise of a cell, relative.
    Places near a light are left out.
    """
    cells = cv2.resize(mean, (mean.shape[1] // cell, mean.shape[0] // cell), interpolation=cv2.INTER_AREA)
    reach = _reach(sigma_px, 1)
    if min(cells.shape) < 2 * reach + 2 * _SAMPLED:
        return None
    level = np.maximum(cv2.blur(cv2.medianBlur(cells, 5), (2 * reach + 1, 2 * reach + 1)), 1.0)
    lit = cells - level > _BRIGHT * level
    lit |= cv2.resize(objects, cells.shape[::-1], interpolation=cv2.INTER_NEAREST) > 0
    near = cv2.dilate(lit.astype(np.uint8), np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)) > 0
    y, x = np.mgrid[: cells.shape[0], : cells.shape[1]]
    A = np.stack([np.ones_like(x), x - x.mean(), y - y.mean()], axis=-1).astype(float)
    if np.count_nonzero(~near) < _FEWEST:
        return None
    used, plane = ~near, level.astype(float)
    for _ in range(_PLANE_FITS):  # of the screen: what is far from the plane is something else
        plane = A @ np.linalg.lstsq(A[used], cells[used].astype(float), rcond=None)[0]
        closer = ~near & (np.abs(cells / np.maximum(plane, 1.0) - 1) < _LARGEST_CONTRAST)
        used = closer if np.count_nonzero(closer) >= _FEWEST else used
    texture = np.clip(cells / np.maximum(plane, 1.0) - 1, -_LARGEST_CONTRAST, _LARGEST_CONTRAST).astype(np.float32)
    inner = slice(reach, -reach)
    used = ~near[inner, inner]
    if np.count_nonzero(used) < _FEWEST:
        return None
    out = []
    for power in (2, 1):
        odd, smooth = _kernels(sigma_px, power, reach)
        own = white * np.sum(odd**2) * np.sum(smooth**2)
        outputs = _filtered(texture, odd, smooth)
        if power == 1:  # a slope over the spot is the plane of its fit's background
            flat = np.ones(2 * reach + 1)
            straight = np.arange(-reach, reach + 1.0)
            slope = np.sum(odd * straight) * np.sum(smooth) / (np.sum(straight**2) * np.sum(flat))
            outputs = [o - p for o, p in zip(outputs, _filtered(texture, slope * straight, flat), strict=True)]
        sizes = np.concatenate([np.abs(o[inner, inner][used]) for o in outputs])
        variance = (float(np.quantile(sizes, 0.68)) / NORMAL_68) ** 2
        out.append(float(np.sqrt(max(variance - own, 0.0))))
    return out[0], out[1]


# Places of the background that do not belong to its texture: lights, and lines such as edges, seams and cables. A line
# has gradients of one direction over a long way, texture of all directions. The eigenvalues a >= b of the mean of the
# gradients' products over a window distinguish them: white noise adds the same to both. Source: ours; the matrix is the
# structure tensor of Bigun & Granlund 1987.

_SMOOTH_PX = 1.0  # sigma of the derivatives' kernel
_LINE_WINDOW_PX = 10.0  # sigma of the window
_COHERENT = 0.7  # (a - b) / (a + b - 2 n) of a line, with n the part by noise
_CLEAR_LINE = 8.0  # times the median of a - b: lines; noise and texture scatter less
_LIGHT_SIGMAS = 5.0  # half side of the square around a light, in its larger half axes


def lights_and_lines(picture: NDArray[Any], found: Sequence[Detections]) -> NDArray[np.uint8]:
    """(h, w): 1 where a relative picture (h, w) shows a line or one of the lights found in its exposures."""
    lights = np.zeros(picture.shape, np.uint8)
    for points in found:
        half = _LIGHT_SIGMAS * np.maximum(points.major_px, 1.0)
        for (u, v), reach in zip(points.uv_px, half, strict=True):
            rows = slice(max(int(v - reach), 0), max(int(v + reach) + 2, 0))
            lights[rows, max(int(u - reach), 0) : max(int(u + reach) + 2, 0)] = 1
    return np.asarray(lights | _lines(np.where(lights, np.float32(0.0), picture)))


def _lines(picture: NDArray[Any]) -> NDArray[np.uint8]:
    smooth = cv2.GaussianBlur(picture, (0, 0), _SMOOTH_PX)
    du, dv = cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1)
    size = picture.shape[1] // BLOCK, picture.shape[0] // BLOCK
    products = [cv2.resize(p, size, interpolation=cv2.INTER_AREA) for p in (du * du, du * dv, dv * dv)]
    for p in products:  # the background of the outermost blocks, an extrapolation, has the gradients of uneven light
        p[:2], p[-2:], p[:, :2], p[:, -2:] = 0.0, 0.0, 0.0, 0.0
    uu, uv, vv = (cv2.GaussianBlur(p, (0, 0), _LINE_WINDOW_PX / BLOCK) for p in products)
    difference, total = np.hypot(uu - vv, 2 * uv), uu + vv
    noise = float(np.median(total - difference))
    line = (difference > _CLEAR_LINE * np.median(difference)) & (difference > _COHERENT * (total - noise))
    return np.asarray(cv2.resize(line.astype(np.uint8), picture.shape[::-1], interpolation=cv2.INTER_NEAREST), np.uint8)
