"""Detection of the points of light in a grey picture."""

from __future__ import annotations

import math
import threading
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from geometry.arrays import Array, Bools, Ints
from geometry.camera import SensorNoise
from tracking.detection.block_search import TEXTURE, Blocks, bin_pixels, find_highest_between, runs_of
from tracking.detection.candidates import PeakSearch, block_workspace
from tracking.detection.measuring import DetectionLimits, Wings, measure
from tracking.detection.pixels import TEXTURE_SHARE, Noise, Pixels
from tracking.detection.regions import EVERYWHERE, MARGIN, boxes_of, write_detections
from tracking.detection.search import BORDER_BLOCKS, MAX_COMPARED, find_peaks_in, find_separate_peaks
from tracking.detection.table import ALGEBRA, CANDIDATE, CELL_ROWS, MOST_CELLS, PEAK, Peaks
from tracking.detections import Detections
from tracking.noise import NoiseModel, Picture, guess_noise
from tracking.parameters import DetectParameters
from tracking.squares import WIDE_SIDE, for_squares, noise_of_squares, of_squares, squares_of

_thread_local = threading.local()  # .finders: the last finders of each thread, by width, height, most points
_MOST_FINDERS = 4  # per thread: memory of 4 sizes of pictures, as many as the cameras of a usual rig

WIDE_PX = 30.0  # sigma above which a light is sought in sums of pixels; a plain fit has windows for twice that
_BRIGHT = 0.5  # share of the picture's range that the peak of a light must have to be named as overlooked
_INSIDE = 2.0  # sigmas of a wide light: detections of its speckle and its edges are nearer than this ...
_PART = 1 / 3  # ... and wider than this share of it; a narrower one is a spot of its own


def find_spots(
    image: Picture,
    parameters: DetectParameters = DetectParameters(),  # noqa: B008  (frozen)
    noise: SensorNoise | NoiseModel | None = None,
    regions: ArrayLike | None = None,
) -> Detections:
    """The spots of a grey picture (h, w), 8 or 16 bit, brightest (by flux) first.

    Without a noise model the noise of the background is estimated from the picture (0.3 ms more). For a run it is
    better to estimate it once from several pictures (noise_estimation.photon_transfer.estimate_noise).

    regions (n, 3), px: boxes u, v, half size; only spots in one of them are searched and returned. The light of others
    is subtracted as in the whole picture if they are nearer to the box than its half size, or than 16 px; that of
    others farther away is not. Boxes with nan or a negative size are empty. Raises ValueError: if the picture or the
    regions have another shape or type.
    """
    if image.ndim != 2 or image.dtype not in (np.uint8, np.uint16):
        raise ValueError(f"picture: expected grey (h, w) of uint8 or uint16, got shape {image.shape} of {image.dtype}")
    if not image.size:
        return Detections.none()
    finders: dict[tuple[int, ...], SpotFinder] = _thread_local.__dict__.setdefault("finders", {})
    key = (image.shape[1], image.shape[0], parameters.max_detections)
    finder = finders.pop(key, None) or SpotFinder(*key)
    finders[key] = finder  # last: the one used longest ago is the first
    if len(finders) > _MOST_FINDERS:
        del finders[next(iter(finders))]
    return finder.find(image, parameters, noise, regions)


def saturation_of(parameters: DetectParameters, picture: Picture) -> float:
    """The grey value at which the sensor clips, DN."""
    clips = parameters.saturation_dn
    return float(np.iinfo(picture.dtype).max) if clips is None else float(clips)


def without_wide(parameters: DetectParameters) -> DetectParameters:
    """The same for lights that are not found in sums of pixels."""
    return replace(parameters, max_sigma_px=min(parameters.max_sigma_px, WIDE_PX))


def of_all_sizes(narrow: Detections, wide: Detections, parameters: DetectParameters) -> Detections:
    """Points of a picture and its wide lights together, without the points that are parts of these."""
    apart = np.linalg.norm(narrow.uv_px[:, None] - wide.uv_px[None], axis=2)
    parts = (apart < _INSIDE * wide.major_px) & (narrow.major_px[:, None] > _PART * wide.minor_px)
    return narrow[~parts.any(axis=1)].joined(wide, parameters.max_detections)


def find_wide_lights(picture: Picture, parameters: DetectParameters, noise: NoiseModel | None) -> Detections:
    """Lights (n) with a sigma of WIDE_PX to max_sigma_px in a grey picture (h, w); flux in DN of its pixels."""
    squares = squares_of(picture)
    if min(squares.shape) < 2 * WIDE_SIDE:
        return Detections.none()
    of_sums = noise_of_squares(noise or guess_noise(picture), picture)
    return wide_of_squares(find_spots(squares, for_wide(parameters, picture), of_sums), picture)


def for_wide(parameters: DetectParameters, picture: Picture) -> DetectParameters:
    """The same for wide lights in `squares_of` a picture."""
    usual = replace(parameters, saturation_dn=saturation_of(parameters, picture))
    return replace(for_squares(usual, picture), min_sigma_px=0.5 * WIDE_PX / WIDE_SIDE)


def wide_of_squares(found: Detections, picture: Picture) -> Detections:
    """Of the points found in `squares_of` a picture those wider than WIDE_PX, in its pixels and grey values."""
    return of_squares(found[WIDE_SIDE * found.major_px > WIDE_PX], picture)


def limit_that_admits(sigma_px: float) -> int:
    """A max_sigma_px for lights of this width, which vary."""
    return 10 * math.ceil(1.3 * sigma_px / 10)


def overlooked_lights(
    picture: Picture, parameters: DetectParameters, noise: NoiseModel | None, found: Detections
) -> Detections:
    """Bright lights of any width that max_sigma_px excludes and of which nothing as wide is among the points found."""
    lights = find_wide_lights(picture, replace(parameters, max_sigma_px=float(max(picture.shape))), noise)
    low, high = np.quantile(picture[::4, ::4], [0.5, 0.999])
    lights = lights[(lights.major_px > parameters.max_sigma_px) & (lights.peak > _BRIGHT * (high - low))]
    apart = np.linalg.norm(lights.uv_px[:, None] - found.uv_px[None], axis=2) / lights.major_px[:, None]
    as_wide = found.major_px[None] > 0.5 * lights.major_px[:, None]
    return lights[~((apart < 1.0) & as_wide).any(axis=1)]


class SpotFinder:
    """Finds spots in pictures of one size with preallocated arrays; for one thread at a time."""

    def __init__(self, width: int, height: int, most: int = 400) -> None:
        """most: DetectParameters.max_detections of all later calls."""
        self.width, self.height, self.most = width, height, most
        self._blocks = Blocks.of(width, height)
        rows, columns = self._blocks.maps.shape[1:]
        self._runs = np.zeros((rows + 4, 3), np.int64)
        self._searched = np.zeros((rows, columns), np.uint8)
        self._bright_blocks = np.zeros((rows * columns, 3), np.int64)
        self._workspace, self._scratch = block_workspace(), np.zeros(16)
        self._peaks = np.zeros(4 * rows * columns, PEAK)
        self._separate, self._near, self._gaps = (
            np.zeros(4 * most, np.int64),
            np.zeros(MAX_COMPARED, np.int64),
            np.zeros(MAX_COMPARED),
        )
        self._cells, self._algebra = np.zeros((CELL_ROWS, MOST_CELLS)), np.zeros((ALGEBRA, 9, 10))
        self._table, self._count, self._out = np.zeros(most, CANDIDATE), 0, np.zeros((most, 13))

    def find(
        self,
        image: Picture,
        parameters: DetectParameters,
        noise: SensorNoise | NoiseModel | None,
        regions: ArrayLike | None = None,
    ) -> Detections:
        """As `find_spots`, for a picture of this size."""
        task = _Task.of(image, parameters, NoiseModel.of(noise) if isinstance(noise, SensorNoise) else noise)
        self._searched[:] = 0
        self._blocks.maps[TEXTURE] = task.model.texture_of_blocks(*self._blocks.maps.shape[1:])
        places = np.ascontiguousarray(EVERYWHERE if regions is None else regions, dtype=float)
        if places.ndim != 2 or places.shape[1] != 3:
            raise ValueError(f"regions: expected (n, 3): u, v and half size in px, got shape {places.shape}")
        boxes = np.zeros((len(places), 4), np.int64)
        boxes = boxes[: boxes_of(places, self.width, self.height, boxes)]
        self._measure(task, self._search(task, boxes) if len(boxes) else 0, places)
        return self._detections(places)

    def _search(self, task: _Task, boxes: Ints) -> int:
        """Find the peaks in boxes of blocks; returns their number."""
        rows, columns = self._blocks.maps.shape[1:]
        needed = int((boxes[:, 1] - boxes[:, 0] + 5).sum())
        if len(self._runs) < needed:
            self._runs = np.zeros((2 * needed, 3), np.int64)
        bin_pixels(
            task.image,
            self._runs[: runs_of(boxes, BORDER_BLOCKS, BORDER_BLOCKS, rows, columns, self._runs)],
            self._blocks.pairs,
        )
        inner = self._runs[: runs_of(boxes, 0, 0, rows, columns, self._runs)]
        find_highest_between(task.image, inner, self._blocks.maps, self._blocks.lines[0])
        search = PeakSearch(
            task.pixels, task.noise, task.limits.saturation, self._blocks, self._workspace, self._scratch, self._peaks
        )
        threshold = task.limits.threshold_sigma
        return find_peaks_in(boxes, search, threshold, self._searched, self._bright_blocks, self._runs, 0)

    def _measure(self, task: _Task, count: int, regions: Array) -> None:
        """Measure the separate spots among the first `count` peaks that lie in the regions (n, 3), or near them."""
        peaks = self._peaks[:count]
        order = np.lexsort((peaks["u"], peaks["v"], -peaks["height"]))
        if count > len(self._separate):  # bright objects have many peaks, which must not displace spots in even places
            first = np.argsort(_insignificance(peaks[order], task.model), kind="stable")[: len(self._separate)]
            order = order[np.sort(first)]
        away = np.maximum(*(np.abs(peaks[x][:, None] - regions[:, i]) for i, x in enumerate("uv")))
        # Around them, peaks of their spots are measured, and of others beside those.
        wanted: Bools = np.any(away <= regions[:, 2] + np.maximum(regions[:, 2], MARGIN), axis=1)
        near, threshold = (self._near, self._gaps), task.limits.threshold_sigma
        n = find_separate_peaks(task.pixels, peaks, order, wanted, task.noise, threshold, self._separate, *near)
        chosen = self._separate[: min(n, self.most)].copy()
        self._count = len(chosen)
        table = self._table[: self._count]
        measure(task.pixels, peaks, chosen, task.noise, task.limits, table, self._cells, self._algebra)

    def _detections(self, regions: Array) -> Detections:
        """The spots, among the candidates measured last, that lie in one of the regions."""
        rows = self._out[: write_detections(self._table[: self._count], regions, self._out)]
        columns = rows.T.copy()
        cov = rows[:, [2, 3, 3, 4]].reshape(-1, 2, 2)
        fit = dict(zip(("misfit", "chi2", "unexplained"), columns[10:], strict=True))
        return Detections(rows[:, :2].copy(), cov, *columns[5:10], **fit)


def _insignificance(peaks: Peaks, model: NoiseModel) -> Array:
    """(n,): the noise and structure at each peak relative to its height."""
    structure = TEXTURE_SHARE * peaks["contrast"] * peaks["level"]
    return np.asarray((model.variance(peaks["level"]) / 9.0 + structure**2) / peaks["height"] ** 2)


class _Task(NamedTuple):
    """One picture with the parameters of its search."""

    image: Picture
    pixels: Pixels
    model: NoiseModel
    noise: Noise
    limits: DetectionLimits

    @staticmethod
    def of(image: Picture, parameters: DetectParameters, noise: NoiseModel | None) -> _Task:
        model = (noise or guess_noise(image)).of_means
        image = image if image.flags.c_contiguous else image.copy()
        p = model.profile
        limits = DetectionLimits(
            float(parameters.threshold_sigma),
            saturation_of(parameters, image),
            float(parameters.min_sigma_px),
            float(parameters.max_sigma_px),
            float(parameters.min_explained),
            Wings(*map(float, (p.near, p.near_px**2, p.far, p.uneven**2, *p.shape_px2, p.shape_sigma_px2**2))),
        )
        pixels = Pixels(image.view(np.uint8), image.itemsize, image.shape[1], image.shape[0])
        others = float(model.texture), float(model.banding_dn), float(model.compression_dn2)
        known = Noise(float(model.floor_dn2), float(model.slope_dn), float(model.black_dn), *others)
        return _Task(image, pixels, model, known, limits)
