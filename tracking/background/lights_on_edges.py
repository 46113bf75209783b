"""Lights at rest on edges of the background, or near them: found where straight structures have been subtracted.

A Gaussian on a plane does not explain a light whose window contains an edge. The background behind a light that is in
all pictures is not known, but edges are longer than spots: the largest grey value that a straight line of pixels
through a place nowhere falls below, in any direction, contains edges, corners and lines, and hardly anything of a
light that is shorter than the line. Source: ours; a top-hat by openings with lines, e.g. Soille (2003), "Morphological
Image Analysis", 4.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from geometry.arrays import Array, Bools
from tracking.background.joint_fit import MODULATED, Modulation
from tracking.background.mean_pictures import STRIP, in_steps
from tracking.background.places import SAME_LIGHT, near_each
from tracking.detection.detect import find_spots
from tracking.detections import Detections
from tracking.noise import NoiseModel
from tracking.parameters import DetectParameters

_HALF_LINE = 14  # px: lights of up to 3 px (1 sigma) are shorter than such a line
_DIRECTIONS = 24  # so that at the ends of the lines neighbouring directions are 2 px apart, with those of the pixels
_RING = 3.5, 10.0  # widths: where the structure around a light is measured ...
_HIGH, _SIGMAS = 0.99, 2.33  # ... by this quantile of what is left there, which of noise is so many sigmas
_LEAST_FACTOR = np.float32(0.25)  # of the light by the surface
_NEAR = 2.0  # widths, and px: of a part of a light from its middle
_WINDOW = 55.0  # pixels of a fit, in squared widths
_EXPLAINED = 0.85  # share of the squared light that a spot explains
_WHOLE = 0.5  # of the squared light of a spot: with less than that a part of it is left
_LEAST_CHI2 = 0.1  # of a mean of some pictures, relative to the noise of one
_DECIDED = 4  # power of chi-square with which directions count less
_BETTER = 2.0  # ratio of chi-square from which a light fits better without the edges


def with_lights_on_edges(
    mean: NDArray[np.float32], found: Detections, noise: NoiseModel, parameters: DetectParameters, steps: int,
    clips_dn: float, modulation: Modulation | None = None,
) -> Detections:  # fmt: skip
    """The lights found in a mean picture (h, w), with those that edges hide, and measured again where edges disturb.

    noise: of one picture; steps: grey values per DN in which the search is made; clips_dn: of the sensor; modulation:
    of the lights by the surface, if known.
    """
    level = max(float(np.median(mean)), 1.0)
    search = _Search(
        mean, mean >= clips_dn, level, noise, parameters, steps, modulation or Modulation(MODULATED[0], level)
    )
    behind = without_lights(mean)
    again = search.spots_before(behind, modulated=False)
    again = again[_stand_out(mean - behind, again, parameters.threshold_sigma, float(np.sqrt(noise.variance(level))))]
    again = _along_edges(search, again)
    same = near_each(again, found, SAME_LIGHT)
    chi2 = [np.ones(len(d)) if d.chi2 is None else np.maximum(d.chi2, 1.0) for d in (again, found)]
    better = same & (chi2[1] > _BETTER * chi2[0][:, None])
    used = np.asarray(~(same & ~better).any(axis=1))
    kept = found[np.asarray(~better[used].any(axis=0))]
    return kept.joined(again[used], len(found) + len(again)) if len(kept) else again[used]


@dataclass(frozen=True, slots=True)
class _Search:
    """The search for spots in a picture without some background."""

    mean: NDArray[np.float32]  # (h, w), DN
    clipped: Bools  # (h, w)
    level_dn: float
    noise: NoiseModel
    parameters: DetectParameters
    steps: int
    modulation: Modulation  # of the light by the background

    def spots_before(
        self, behind: NDArray[np.float32], modulated: bool = True, boxes: Array | None = None
    ) -> Detections:
        """Those in front of a background (h, w). modulated: its brightness modulates them; boxes: of `find_spots`."""
        steps, share, black = self.steps, self.modulation.share, np.float32(self.modulation.black_dn)
        once = replace(self.noise.in_steps(steps), texture=0.0, local_texture=None)
        clips = np.iinfo(np.uint16).max // steps
        raised = np.empty(behind.shape, np.uint16)
        for top in range(0, len(raised), STRIP):  # in the processor's cache
            part = np.s_[top : top + STRIP]
            light = self.mean[part] - behind[part]
            if modulated:
                of_surface = share * (behind[part] - black) / np.float32(self.modulation.level_dn)
                light /= np.maximum(1 - share + of_surface, _LEAST_FACTOR)
            light += np.float32(self.level_dn)
            light[self.clipped[part]] = clips
            raised[part] = in_steps(light, steps)
        usual = replace(self.parameters, saturation_dn=(clips - 0.5) * steps)
        found = find_spots(raised, usual, once, boxes)
        return replace(found, flux=found.flux / steps, peak=found.peak / steps)


def _along_edges(search: _Search, spots: Detections) -> Detections:
    """Spots (n,) measured in front of what is left behind them in single directions, the best of which count most.

    A line along an edge next to a light leaves the edge and nothing of the light; lines across it leave a part of the
    light as well. Of the directions in which a spot explains what is not left, that with most light counts most. Others
    that do not agree on the place show its error.
    """
    places, lights, misfits = [spots.uv_px], [np.full(len(spots), 1e-9)], [np.ones(len(spots))]
    unexplained = [np.full(len(spots), np.inf)]
    reach = _NEAR * spots.major_px + _NEAR
    boxes = np.column_stack([spots.uv_px, reach])
    for k in range(0, _DIRECTIONS, 2) if len(spots) else ():
        found = search.spots_before(_opened(search.mean, k), boxes=boxes)
        if not len(found):
            continue
        size2, chi2 = found.major_px * found.minor_px, np.ones(len(found)) if found.chi2 is None else found.chi2
        light2 = found.flux**2 / (4 * np.pi * size2)
        left2 = _WINDOW * size2 * search.noise.floor_dn2 * chi2
        light2 *= light2 > _EXPLAINED * (light2 + left2)
        gap = np.linalg.norm(spots.uv_px[:, None] - found.uv_px, axis=-1)
        best = np.where(gap < reach[:, None], light2, 0.0)
        j = best.argmax(axis=1)
        places.append(found.uv_px[j])
        lights.append(best.max(axis=1))
        misfits.append(np.maximum(chi2[j], _LEAST_CHI2))
        unexplained.append(np.zeros(len(spots)) if found.unexplained is None else found.unexplained[j])
    uv = np.array(places)
    whole = np.array(lights) >= _WHOLE * np.max(lights, axis=0)
    weight = whole / np.array(misfits) ** _DECIDED
    weight /= weight.sum(axis=0)
    mean = np.einsum("kn,kni->ni", weight, uv)
    place = 0.5 * np.einsum("kn,kni->n", weight, (uv - mean) ** 2)
    before = np.zeros(len(spots)) if spots.misfit is None else spots.misfit
    variance = spots.variance_px2
    return replace(
        spots, uv_px=mean, cov_px2=spots.cov_px2 + place[:, None, None] * np.eye(2),
        misfit=(before * variance + place) / (variance + place), chi2=np.where(whole, misfits, np.inf).min(axis=0),
        unexplained=np.where(whole, unexplained, np.inf).min(axis=0),
    )  # fmt: skip


def without_lights(mean: NDArray[np.float32]) -> NDArray[np.float32]:
    """A picture (h, w) without what is brighter than its surroundings and shorter than a line in all directions."""
    out = np.full_like(mean, -np.inf)
    for k in range(_DIRECTIONS):
        np.maximum(out, _opened(mean, k), out=out)
    return out


def _opened(mean: NDArray[np.float32], direction: int) -> NDArray[np.float32]:
    """The largest value that a line in one direction through each pixel nowhere falls below."""
    line = _line(np.pi * direction / _DIRECTIONS)
    return np.asarray(cv2.morphologyEx(mean, cv2.MORPH_OPEN, line), np.float32)


def _line(angle_rad: float) -> NDArray[np.uint8]:
    """The pixels of a line through the middle of a square."""
    along = np.arange(-_HALF_LINE, _HALF_LINE + 1)
    x, y = np.cos(angle_rad), np.sin(angle_rad)
    steepest = max(abs(x), abs(y))
    line = np.zeros((len(along), len(along)), np.uint8)
    column, row = (np.rint(along * part / steepest).astype(int) + _HALF_LINE for part in (x, y))
    line[row, column] = 1
    return line


def _stand_out(left: NDArray[np.float32], lights: Detections, threshold: float, sigma: float) -> Bools:
    """Which lights are higher than what else is left around them in a flattened picture (h, w), DN."""
    out = np.zeros(len(lights), dtype=bool)
    for i, (u, v) in enumerate(lights.uv_px):
        width = max(float(np.sqrt(lights.major_px[i] * lights.minor_px[i])), 1.0)
        half = _RING[1] * width
        row, column = max(int(v - half), 0), max(int(u - half), 0)
        part = left[row : int(v + half) + 1, column : int(u + half) + 1]
        y, x = np.mgrid[row : row + part.shape[0], column : column + part.shape[1]]
        away = np.hypot(x - u, y - v) / width
        around = part[(away > _RING[0]) & (away < _RING[1])]
        high = float(np.quantile(around, _HIGH)) / _SIGMAS if around.size else 0.0
        out[i] = lights.peak[i] > threshold * max(high, sigma)
    return out
