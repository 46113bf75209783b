"""What moves in front of a fixed background: found after the background has been subtracted.

The cameras and screens of a recording do not move, so texture, objects, lamps and the offsets of pixels are the same in
all of its pictures. They limit the detection in a single picture; in the difference from the fixed picture only what
moves is left, and the noise. Lights at rest are measured separately (resting_lights.py). Source: ours; the subtraction
of a mean background is usual in particle image velocimetry, e.g. Raffel et al. (2018), "Particle Image Velocimetry".
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from geometry.arrays import Array, Bools, Ints
from tracking.background.joint_fit import Modulation
from tracking.background.lights_on_edges import with_lights_on_edges
from tracking.background.mean_pictures import (
    GAIN_BITS,
    LEAST_CHANGE,
    LOWER_VARIANCE,
    highest_of_blocks,
    in_steps,
    raised_difference,
    smooth_part,
)
from tracking.background.places import (
    AROUND_LIGHT,
    AROUND_SPOT,
    SAME_LIGHT,
    inside,
    near_each,
    nearest,
    places_of,
)
from tracking.background.resting_lights import RestingLights
from tracking.background.shown_light import Shown, ShownLight, fits_around, sample_of
from tracking.detection.detect import find_spots, saturation_of
from tracking.detection.pixels import TEXTURE_SHARE
from tracking.detections import Detections
from tracking.noise import NoiseModel, Picture
from tracking.noise_estimation.texture_shift import TextureShift
from tracking.parameters import DetectParameters

_HIGHEST = 30.0  # sigmas of noise and texture
_LOW = 0.25  # quantile of the background whose noise the difference is taken to have; brighter places count as uneven
_STEPS = 16  # grey values per DN: the differences are not rounded to whole DN
_AS_WIDE = 0.7  # of a light at rest: what is in its middle and as wide is that light, brighter than in the mean
_LEAST_MODULATION = 0.1  # of the light by the surface: less is not undone
_MODULATION = (0.25, 4.0)  # of the light, at most
_LEAST_SIGMA = 0.005  # widths: least error of a light at rest, which is no Gaussian
_OF_PEAK = 0.3  # of the shot noise at the peak: what counts for the centre, where a fit's weights are of other noise
TRIED = 3  # every such picture shows whether there are further spots


@dataclass(frozen=True, slots=True)
class StaticBackground:
    """The fixed structure of the pictures (h, w) of one camera."""

    pictures: int  # from which it is made
    structure: NDArray[np.float32]  # (h, w), DN: the fixed picture without its smooth part
    smooth: NDArray[np.float32]  # DN, on the pixels of shown_light.sample_of
    near_lights: Bools  # (h, w): near lights that do not move
    blind: Bools  # (h, w): the difference does not show what is there
    shares: NDArray[np.float32]  # (h, w): variance of the fixed picture's own errors over that of a picture's noise
    lights: RestingLights
    unknown: NDArray[np.float64]  # (m, 3): u, v and half side, px, of places that are searched in the pictures
    parameters: DetectParameters
    steps: int  # grey values per DN of the difference
    level_dn: float  # of the difference
    low_dn: float  # level of the pictures whose noise `model` has at that level
    subtracted: NDArray[np.uint16]  # (h, w): what is added to a picture in these steps
    model: NoiseModel  # of the difference, in its steps
    noise: NoiseModel  # of the pictures
    shown: ShownLight
    spot_px: float = 0.0  # usual width of the lights that move; 0: not known
    shifts_px: NDArray[np.float32] | None = None  # (h, w): `local_shifts` of such a light
    # (n,): `local_shifts` of each light at rest, as wide as it is
    rest_shifts_px: Array | None = None
    fixed: Bools = field(default_factory=lambda: np.zeros(0, dtype=bool))  # lights at rest while others move
    misfit_share: float = float("nan")  # of the lights that move, as in TextureShift
    grainy: bool = False  # those lights, as in NoiseEstimate
    # (h, w), in 2^-GAIN_BITS: undoes what the brightness of the surface does to a light; None: nothing
    gain: NDArray[np.uint16] | None = None
    # Of each texture: the lights at rest with their errors, and the errors by the texture in the light that moves.
    known: dict[TextureShift, tuple[Detections, TextureShift]] = field(
        init=False, repr=False, compare=False, default_factory=dict
    )

    def with_light(self, pictures: Sequence[Picture]) -> StaticBackground:
        """The background whose light is 1 in a typical one of the pictures that it is made from."""
        shown = ShownLight.of(
            self.structure, self.smooth, self.near_lights, self.noise, self._noise_share, self.pictures,
            pictures[::TRIED],
        )  # fmt: skip
        return replace(self, shown=shown)

    def with_lights_on_edges(self, mean: NDArray[np.float32], modulation: Modulation | None) -> StaticBackground:
        """The background with the lights at rest on its edges; mean (h, w), DN: it is made from."""
        found = with_lights_on_edges(
            mean, self.lights.found, self.noise, self.parameters, self.steps, self.lights.clips_dn, modulation
        )
        near_lights = self.near_lights | places_of(found, mean.shape, AROUND_LIGHT)
        lights = RestingLights.of(mean, found, self.noise, self.lights.clips_dn)
        return replace(self, lights=lights, near_lights=near_lights)

    @property
    def _noise_share(self) -> float:
        """Variance of the background's own noise over that of a picture."""
        return LOWER_VARIANCE / self.pictures

    def with_modulation(self, modulation: Modulation, at: tuple[Ints, Ints], response: Array) -> StaticBackground:
        """The background whose surface modulates the lights that fall on it; known responses (m,) at some pixels.

        The light of a spot is brighter on its side on the brighter part of the surface. In the difference this is
        undone: spots are where their light is, not where the surface is bright. Darker places are noisier then.
        """
        share, plain = modulation.share, self.plain()
        if share < _LEAST_MODULATION:
            return self
        factor = modulation.response(plain)
        factor[at] = response
        factor = 1 / np.clip(factor, *_MODULATION)
        gain = np.rint(factor * 2**GAIN_BITS).astype(np.uint16)
        variance = np.asarray(factor**2 * self.noise.variance(plain), np.float32)
        more = np.maximum(highest_of_blocks(variance) - float(self.noise.variance(self.low_dn)), 0.0)
        uneven = np.asarray(np.sqrt(more / 9.0) / (TEXTURE_SHARE * self.level_dn), np.float32)
        return replace(self, gain=gain, model=replace(self.model, local_texture=uneven))

    def with_mean(self, row: Ints, column: Ints, mean: Array | NDArray[np.float32]) -> StaticBackground:
        """The background that subtracts these means (m,), DN, at some pixels; all else of it stays."""
        subtracted = self.subtracted.copy()
        subtracted[row, column] = in_steps(np.asarray(self.level_dn - mean, np.float32), self.steps)
        return replace(self, subtracted=subtracted)

    def plain(self) -> NDArray[np.float32]:
        """(h, w), DN: the fixed picture."""
        rows, columns = self.structure.shape
        smooth = cv2.resize(self.smooth, (columns, rows), interpolation=cv2.INTER_LINEAR)
        return np.asarray(self.structure + smooth, np.float32)

    def usual_dn(self) -> float:
        """The usual brightness of the surface, DN."""
        rows, columns = sample_of(self.structure.shape)
        return max(float(np.median(self.structure[::rows, ::columns] + self.smooth)), 1.0)

    @staticmethod
    def of_mean(
        mean: NDArray[np.float32], pictures: Sequence[Picture], model: NoiseModel, parameters: DetectParameters
    ) -> StaticBackground:
        share = LOWER_VARIANCE / len(pictures)
        smooth = smooth_part(mean)
        sigma = float(np.hypot(np.sqrt(model.floor_dn2), model.texture * model.black_dn))
        # In 16 bits there is no room for what is higher: a light, or a hot pixel.
        structure = mean - smooth if pictures[0].dtype == np.uint8 else np.minimum(mean - smooth, _HIGHEST * sigma)
        plain, most = smooth + structure, float(np.iinfo(np.uint16).max)
        level, steps = float(np.ceil(plain.max())), _STEPS
        while steps > 1 and (max(int(p.max()) for p in pictures) + level) * steps > most:
            steps //= 2
        level = min(level, 0.5 * most / steps)
        once = model.in_steps(steps)
        clips = saturation_of(parameters, pictures[0])
        at_rest = find_spots(in_steps(mean, steps), replace(parameters, saturation_dn=(clips - 0.5) * steps), once)
        at_rest = replace(at_rest, flux=at_rest.flux / steps, peak=at_rest.peak / steps)
        # The difference has one level everywhere, and the noise of the picture.
        # Of less noise than most pixels have, the misfits of all spots would count a second time.
        low = max(float(np.quantile(plain[::8, ::8], _LOW)), model.black_dn)
        at_low = float(model.variance(low))
        brighter = np.maximum(model.variance(highest_of_blocks(plain)) - at_low, 0.0)
        uneven = np.asarray(np.sqrt(brighter / 9.0) / (TEXTURE_SHARE * level), np.float32)
        of_difference = replace(
            once,
            floor_dn2=at_low * steps**2 * (1 + share),
            black_dn=level * steps,
            shadow_dn2=0.0,
            texture=0.0,
            local_texture=uneven,
        )
        rows, columns = sample_of(mean.shape)
        blind = cv2.dilate(mean - np.minimum(plain, level), np.ones((3, 3))) > 1 / steps
        near_lights = places_of(at_rest, mean.shape, AROUND_LIGHT) | blind
        return StaticBackground(
            len(pictures), structure, smooth[::rows, ::columns].copy(), near_lights, blind,
            np.full(mean.shape, share, np.float32), RestingLights.of(mean, at_rest, model, clips - 0.5),
            np.zeros((0, 3)), parameters, steps, level, low,
            in_steps(np.asarray(level - plain, np.float32), steps), of_difference, model,
            ShownLight.of(structure, smooth[::rows, ::columns].copy(), near_lights, model, share, len(pictures), ()),
        )  # fmt: skip

    def found_in(self, picture: Picture, parameters: DetectParameters, shift: TextureShift) -> Detections | None:
        """The points of a picture, brightest first, with the errors by texture: what moves, and the lights at rest.

        What moves is searched in the difference from the background; the lights at rest are measured by one step, and
        searched where they have changed. None: the picture and the background do not fit.
        """
        parts = self.parts(picture, parameters, shift)
        return None if parts is None else parts[0].joined(parts[1], parameters.max_detections)

    def parts(
        self, picture: Picture, parameters: DetectParameters, shift: TextureShift, fit: Shown | None = None
    ) -> tuple[Detections, Detections] | None:
        """The points of a picture that move or have changed, and the lights at rest that have not.

        fit: what `self.shown` has found in the picture, if it is known.
        """
        fit = fit or self.shown.in_picture(picture)
        if fit is None:
            return None
        spots, hidden = self._moving(picture, parameters, shift, fit)
        lights, changed, passed = self.lights.in_picture(picture, self.fixed)
        # A lamp that flickers is in the difference, too.
        as_wide = spots.major_px[:, None] > _AS_WIDE * lights.major_px
        same = near_each(spots, lights, SAME_LIGHT) & as_wide & ~changed & ~passed
        apart = np.asarray(~same.any(axis=1))
        known, _ = self._known(shift)
        rest = replace(lights, cov_px2=known.cov_px2, place_px2=known.place_px2, at_rest=known.at_rest)
        of_changed = np.column_stack([self.lights.found.uv_px, self.lights.half_px])[changed]
        boxes = np.concatenate([self.unknown, of_changed, hidden])
        if not len(boxes):
            return spots[apart], rest
        again = find_spots(picture, parameters, self.noise, boxes)
        again = shift.added_to(again, self.noise, self._shifts_at(again))
        # The picture may not show a faint spot on a structure that the difference does not have.
        in_box = inside(boxes, spots)
        alone = in_box & ~near_each(spots, again, AROUND_SPOT).any(axis=1)
        found = spots[apart & ~in_box].joined(again, parameters.max_detections)
        found = found.joined(self._beside_lights(spots[apart & alone]), parameters.max_detections)
        return found, rest[~changed & ~inside(boxes, rest)]

    def _beside_lights(self, spots: Detections) -> Detections:
        """Spots with the error, at most, by the light at rest that the background has subtracted with them."""
        near = near_each(spots, self.lights.found, AROUND_LIGHT)
        share = np.minimum(near @ self.lights.found.flux / spots.flux, 1.0)
        more = share**2 * spots.major_px * spots.minor_px
        place = more if spots.place_px2 is None else spots.place_px2 + more
        return replace(spots, cov_px2=spots.cov_px2 + more[:, None, None] * np.eye(2), place_px2=place)

    def _known(self, shift: TextureShift) -> tuple[Detections, TextureShift]:
        """The lights at rest in the mean picture, with the errors that they have in each picture; errors of others."""
        if shift not in self.known:
            lights = self.lights.found
            # The error of the mean picture's fit is the same in all pictures, as is what a Gaussian leaves.
            least = _LEAST_SIGMA**2 * lights.major_px * lights.minor_px
            common = self._noise_share * lights.variance_px2 + least
            # Most of them are objects, whose misfits are no grain of the light.
            own = replace(shift, misfit_share=self.misfit_share)
            lights = own.added_to(lights, self.noise, self.rest_shifts_px, at_rest=True)
            place = np.zeros(len(lights)) if lights.place_px2 is None else lights.place_px2
            at_rest = self.fixed.astype(float) if len(self.fixed) else None
            covariance = lights.cov_px2 + common[:, None, None] * np.eye(2)
            lights = replace(lights, cov_px2=covariance, place_px2=place + common, at_rest=at_rest)
            moving = shift.of_light
            if self.shifts_px is not None:
                moving = replace(moving, misfit_share=self.misfit_share)
            self.known[shift] = lights, moving
        return self.known[shift]

    def _shifts_at(self, points: Detections) -> Array | None:
        """(n,): `local_shifts` of points; None: not known."""
        if self.shifts_px is None:
            return None
        row, column = (nearest(points.uv_px[:, i], self.shifts_px.shape[1 - i]) for i in (1, 0))
        return np.asarray(self.shifts_px[row, column] * np.sqrt(points.major_px * points.minor_px) / self.spot_px)

    def spots_in(
        self, picture: Picture, parameters: DetectParameters, shift: TextureShift, inverted: bool = False,
        regions: NDArray[np.float64] | None = None, fit: Shown | None = None,
    ) -> Detections:  # fmt: skip
        """The spots in the difference of a picture (h, w) from the background, where that shows them.

        shift: errors of spots by the texture; the part that the background causes is subtracted with it. inverted: the
        holes of the difference instead. regions: of `find_spots`. fit: as in `parts`.
        """
        fit = fit or self.shown.in_picture(picture)
        return Detections.none() if fit is None else self._moving(picture, parameters, shift, fit, inverted, regions)[0]

    def _moving(
        self, picture: Picture, parameters: DetectParameters, shift: TextureShift, fit: Shown,
        inverted: bool = False, regions: NDArray[np.float64] | None = None,
    ) -> tuple[Detections, NDArray[np.float64]]:  # fmt: skip
        """`spots_in`, with the result of `ShownLight.in_picture`; and boxes (m, 3) of what is in front of something
        else, px."""
        light, rows, model = fit.light, fit.rows, self.model
        more, raised = np.zeros((2, len(picture)))
        if rows is not None:
            more, raised = (1 - rows[0]) * self.steps, -rows[1] * self.steps
        elif abs(light - 1) > LEAST_CHANGE:
            own, more = self._noise_share, more + (1 - light) * self.steps
            model = replace(model, floor_dn2=model.floor_dn2 * (1 + light**2 * own) / (1 + own))
        clips = saturation_of(parameters, picture)
        top = min(int((clips + self.level_dn) * self.steps), np.iinfo(np.uint16).max)
        clipped = np.inf if inverted else clips
        level = int(self.level_dn * self.steps)
        difference = raised_difference(
            picture, self.steps, self.subtracted, self.structure, (more, raised), clipped, top, level, self.gain
        )
        if inverted:
            difference = np.asarray(
                cv2.subtract(np.full_like(difference, 2 * int(self.level_dn * self.steps)), difference)
            )
        spots = find_spots(difference, replace(parameters, saturation_dn=float(top)), model, regions)
        row, column = (nearest(spots.uv_px[:, i], picture.shape[1 - i]) for i in (1, 0))
        sample = sample_of(picture.shape)
        sampled = (
            np.minimum(row // sample[0], len(fit.clear) - 1),
            np.minimum(column // sample[1], fit.clear.shape[1] - 1),
        )
        kept, fits = ~self.blind[row, column], fits_around(fit.clear, fit.left, spots, sample)
        half_px = AROUND_SPOT[0] * spots.major_px + AROUND_SPOT[1]
        hidden = np.column_stack([spots.uv_px, half_px])[kept & ~fits]
        kept &= fits
        spots, row, column, sampled = spots[kept], row[kept], column[kept], (sampled[0][kept], sampled[1][kept])
        if not len(spots):
            return spots, hidden
        gain = 1.0 if self.gain is None else self.gain[row, column] / 2.0**GAIN_BITS
        peak = spots.peak / (self.steps * gain)
        bright = self.smooth[sampled] + self.structure[row, column]
        light_of_spot = _OF_PEAK * self.noise.slope_dn * peak
        used = self.noise.variance(self.low_dn) + gain * light_of_spot
        here = self.noise.variance(bright) + light_of_spot
        errors = self.shares[row, column]
        here *= gain**2 * (1 + errors) / (1 + self._noise_share)
        covariance = spots.cov_px2 * (here / used)[:, None, None]
        spots = replace(spots, flux=spots.flux / (self.steps * gain), peak=peak, cov_px2=covariance)
        # The background's own noise is the same in all pictures.
        noise_share = 1.0 if spots.misfit is None else 1 - spots.misfit
        fixed = errors / (1 + errors) * noise_share * spots.variance_px2
        shifts = self._shifts_at(spots)
        spots = self._known(shift)[1].added_to(spots, self.noise, shifts)
        place = np.zeros(len(spots)) if spots.place_px2 is None else spots.place_px2
        return replace(spots, place_px2=place + fixed), hidden
