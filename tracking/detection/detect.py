"""From a grey picture to the points of light in it."""

from __future__ import annotations

import threading
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from geometry.arrays import Array, Ints
from geometry.camera import SensorNoise
from tracking.detection.block_search import Blocks, bin_pixels, runs_of
from tracking.detection.candidates import AT_U, AT_V, HEIGHT, NEAREST, Noise, find_apart, room_for_a_block
from tracking.detection.gaussian_fit import reach_of
from tracking.detection.measuring import DetectionLimits, measure, write_out
from tracking.detection.pixels import Pixels
from tracking.detection.regions import MARGIN, NEAR, boxes_of, find_relevant
from tracking.detection.search import HALO, find_peaks_in
from tracking.detection.table import ALGEBRA, CELL_ROWS, COLUMNS, MOST_CELLS, SPAN
from tracking.detections import Detections
from tracking.noise import NoiseModel, Picture, guess_noise
from tracking.parameters import DetectParameters

_EVERYWHERE = np.array([[0.0, 0.0, 1e9]])
_own = threading.local()  # .finder: each thread's last one


def find_spots(
    image: Picture,
    parameters: DetectParameters = DetectParameters(),  # noqa: B008  (frozen)
    noise: SensorNoise | NoiseModel | None = None,
    regions: ArrayLike | None = None,
) -> Detections:
    """The spots of a grey picture (h, w), 8 or 16 bit, brightest (by flux) first.

    Without a noise model the background's noise is taken from the picture itself (0.3 ms more); a run does better to
    estimate it once, from several pictures (tracking.noise.estimate_noise).

    regions (n, 3), px: boxes u, v, half size; only spots in one of them are looked for and returned. They are the same,
    bit for bit, as those of the whole picture there, as long as that has fewer than max_detections. Boxes with nan or
    of negative size hold nothing.

    Errors: ValueError if the picture or the regions are not of that form.
    """
    if image.ndim != 2 or image.dtype not in (np.uint8, np.uint16):
        raise ValueError(f"picture: expected grey (h, w) of uint8 or uint16, got shape {image.shape} of {image.dtype}")
    if not image.size:
        return Detections.none()
    finder: SpotFinder | None = getattr(_own, "finder", None)
    if finder is None or (finder.height, finder.width, finder.most) != (*image.shape, parameters.max_detections):
        finder = _own.finder = SpotFinder(image.shape[1], image.shape[0], parameters.max_detections)
    return finder.find(image, parameters, noise, regions)


class SpotFinder:
    """Finds spots in pictures of one size and keeps the room to work in; for one thread at a time."""

    def __init__(self, width: int, height: int, most: int = 400) -> None:
        """most: DetectParameters.max_detections of the calls to come."""
        self.width, self.height, self.most = width, height, most
        self._blocks = Blocks.of(width, height)
        rows, columns = self._blocks.maps.shape[1:]
        self._whole = np.array([[0, rows - 1, 0, columns - 1]])
        self._runs = np.zeros((rows + 4, 3), np.int64)
        self._searched = np.zeros((rows, columns), np.uint8)
        self._standing_out = np.zeros((rows * columns, 3), np.int64)
        self._room, self._peaks = room_for_a_block(), np.zeros((4 * rows * columns, 5))
        self._apart, self._near, self._gaps = (
            np.zeros(4 * most, np.int64),
            np.zeros(NEAREST, np.int64),
            np.zeros(NEAREST),
        )
        self._cells, self._algebra = np.zeros((CELL_ROWS, MOST_CELLS)), np.zeros((ALGEBRA, 9, 10))
        self._table, self._count, self._out = np.zeros((most, COLUMNS)), 0, np.zeros((most, 10))

    def find(
        self,
        image: Picture,
        parameters: DetectParameters,
        noise: SensorNoise | NoiseModel | None,
        regions: ArrayLike | None = None,
    ) -> Detections:
        """What find_spots does, for a picture of this size."""
        task = _Task.of(image, parameters, NoiseModel.of(noise) if isinstance(noise, SensorNoise) else noise)
        self._searched[:] = 0
        if regions is None:
            self._measure(task, self._search(task, self._whole, 0))
            return self._detections(_EVERYWHERE)
        boxes = np.asarray(regions, dtype=float)
        if boxes.ndim != 2 or boxes.shape[1] != 3:
            raise ValueError(f"regions: expected (n, 3): u, v and half size in px, got shape {boxes.shape}")
        boxes = np.ascontiguousarray(boxes)
        self._find_near(task, boxes)
        return self._detections(boxes)

    def _find_near(self, task: _Task, regions: Array) -> None:
        """Measure the peaks in regions and all that bear on them."""
        room = np.zeros((max(len(regions), 64), 4), np.int64)
        boxes, count = room[: boxes_of(regions, self.width, self.height, room)], 0
        reach = np.zeros(0)
        while True:
            count = self._search(task, boxes, count)
            reach = np.concatenate([reach, np.full(count - len(reach), NEAR)])
            relevant = np.zeros(count, np.int64)
            more = find_relevant(
                self._peaks[:count], regions, reach, self._searched, self.width, self.height, relevant, room
            )
            if more:
                boxes = room[:more]
                continue
            chosen = self._measure(task, count, relevant)
            needed = np.array([reach_of(int(cell)) for cell in self._table[: len(chosen), SPAN]])
            far = needed + MARGIN > reach[chosen]
            far &= needed > reach_of(1)
            if not far.any():
                return
            reach[chosen[far]] = needed[far] + MARGIN
            boxes = room[:0]

    def _search(self, task: _Task, boxes: Ints, count: int) -> int:
        """Add the peaks in boxes of blocks to the first `count` ones; their number then."""
        rows, columns = self._blocks.maps.shape[1:]
        needed = int((boxes[:, 1] - boxes[:, 0] + 5).sum())
        if len(self._runs) < needed:
            self._runs = np.zeros((2 * needed, 3), np.int64)
        bin_pixels(task.image, self._runs[: runs_of(boxes, HALO, HALO, rows, columns, self._runs)], self._blocks.pairs)
        return find_peaks_in(
            boxes, task.pixels, self._blocks, task.noise, task.limits.threshold_sigma, self._searched,
            self._standing_out, self._runs, self._room, self._peaks, count,
        )  # fmt: skip

    def _measure(self, task: _Task, count: int, relevant: Ints | None = None) -> Ints:
        """Measure the relevant ones of the first `count` peaks that are spots of their own: which, row by row."""
        peaks = self._peaks[:count]
        order = np.lexsort((peaks[:, AT_U], peaks[:, AT_V], -peaks[:, HEIGHT]))[: len(self._apart)]
        n = find_apart(task.pixels, peaks, order, task.noise, self._apart, self._near, self._gaps)
        chosen = self._apart[:n]
        if relevant is not None:
            chosen = chosen[relevant[chosen] > 0]
        chosen = chosen[: self.most]
        self._count = len(chosen)
        table = self._table[: self._count]
        measure(task.pixels, peaks, chosen, task.noise, task.limits, table, self._cells, self._algebra)
        return chosen

    def _detections(self, regions: Array) -> Detections:
        """The spots among the candidates measured last that lie in one of the regions."""
        rows = self._out[: write_out(self._table[: self._count], regions, self._out)]
        cov = rows[:, [2, 3, 3, 4]].reshape(-1, 2, 2)
        return Detections(rows[:, :2].copy(), cov, *(rows[:, k].copy() for k in range(5, 10)))


class _Task(NamedTuple):
    """One picture and how it is to be searched."""

    image: Picture
    pixels: Pixels
    noise: Noise
    limits: DetectionLimits

    @staticmethod
    def of(image: Picture, parameters: DetectParameters, noise: NoiseModel | None) -> _Task:
        model = noise or guess_noise(image)
        image = image if image.flags.c_contiguous else image.copy()
        saturation = parameters.saturation_dn
        limits = DetectionLimits(
            float(parameters.threshold_sigma),
            float(np.iinfo(image.dtype).max if saturation is None else saturation),
            float(parameters.min_sigma_px),
            float(parameters.max_sigma_px),
            float(parameters.min_explained),
        )
        pixels = Pixels(image.view(np.uint8), image.itemsize, image.shape[1], image.shape[0])
        search = float(model.texture), float(model.banding_dn)
        known = Noise(float(model.floor_dn2), float(model.slope_dn), float(model.black_dn), *search)
        return _Task(image, pixels, known, limits)
