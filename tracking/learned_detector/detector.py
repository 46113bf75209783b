"""A picture at several sizes, each with its exact scale."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from geometry.arrays import Array
from tracking.drogue_circle.detectors import CircleCandidate, CircleDetector, Window, crop_bounds
from tracking.noise import Picture

Floats: TypeAlias = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class PyramidLevel:
    """A reduced picture (h, w) of 0 to 1, and its exact scales: sizes are whole numbers, so they differ a little."""

    grey: Floats
    scale_u: float
    scale_v: float

    @property
    def scale(self) -> float:
        """Of lengths."""
        return float(np.sqrt(self.scale_u * self.scale_v))


def pyramid(grey: Floats, scale: float, reaches_px: float, largest_px: float) -> list[PyramidLevel]:
    """A picture (h, w) reduced to a scale, then by further factors of 2, the last one such that the largest drogue of
    interest is no larger than what a level reaches.
    """
    levels: list[PyramidLevel] = []
    full_height, full_width = grey.shape
    while True:
        width, height = max(round(scale * full_width), 1), max(round(scale * full_height), 1)
        source = levels[-1].grey if levels else grey
        reduced = source
        if source.shape != (height, width):
            reduced = np.asarray(cv2.resize(source, (width, height), interpolation=cv2.INTER_AREA), np.float32)
        levels.append(PyramidLevel(reduced, width / full_width, height / full_height))
        if reaches_px / scale >= largest_px:
            return levels
        scale /= 2


# Drogues found by a small fully convolutional network on an image pyramid, run by `cv2.dnn`.
#
# The network was trained by studies/learned_detector/train.py on rendered drogues; no deep-learning library is needed
# to run it. Per cell of STRIDE pixels it gives the logit of a centre, the offset of the centre and the log of the
# diameter. Source: after Zhou (2020), section 1, whose network has 42 layers; ours has eleven.


WEIGHTS = Path(__file__).with_name("weights.onnx")
STRIDE = 4  # px of the picture per cell of the answer: from the layers of the network
SMALLEST_PX, LARGEST_PX = 7.0, 40.0  # diameters that one level of the pyramid finds
COARSEST_PX = 28.0  # the coarsest level shows the largest drogue no larger: there, its parts are no candidates
MIN_CONFIDENCE = 0.05  # of a candidate
MIN_LOGIT = -3.0  # of a candidate
MAX_CANDIDATES = 20  # of a picture: the tracker considers a few
SAME_SHARE = 0.5  # of the larger diameter: two centres nearer than this are one drogue
ALIKE_RATIO, ALIKE_CONFIDENCE = 2.0, 0.5  # of the diameters and confidences of candidates whose mean is taken
# What is smaller than a drogue by PART_RATIO and within PART_SHARE of its diameter from its centre is a part of it, if
# the larger one has this confidence. Ratios of 2 to 3 and confidences of 0.1 to 0.8 give the same recall to 0.5 %.
PART_RATIO, PART_SHARE, WHOLE_CONFIDENCE = 2.5, 0.6, 0.7
_MARGIN_PX = 48  # around a window: the network sees 47 px on each side of a cell
_LEAST_SIDE_PX, _MULTIPLE = 64, 8

# Of a candidate of the levels: the log odds that it is right over the network's logit (slope, offset), fitted on
# pictures as in training, seed 5. The best MOST_LOOKED_AT of those with FIRST_CONFIDENCE (less of all would lose 3 of
# 710 drogues) are shown to the network again, enlarged or reduced such that the drogue has each of LOOKS_PX: a house or
# a bush of a few pixels looks like a drogue of 7 px, but enlarged not like one of 32. The middle LOOK_CELLS squared of
# the answer count. Beyond its edges the picture is mirrored: repeated pixels made a drogue of whole pictures of clouds.
FIRST_SLOPE, FIRST_OFFSET = 5.077, -4.170
FIRST_CONFIDENCE, MOST_LOOKED_AT = 0.01, 12
LOOKS_PX, LOOK_SIDE_PX, LOOK_CELLS = (20.0, 32.0), 64, 4
# Confidence by calibration: log odds over `features`, a logistic curve fitted on 500 pictures as in training, seed 9,
# and with half of their weight 600 of bench/related_measurements/renderers/third_renderer.py, seed 42: `python -m
# bench.related_measurements.learned_detector --frames 500 --seed 9 --calibrate` prints CALIBRATION and GROWTH. Of the
# pairs of 15, 17, 20, 24, 28, 32 px in LOOKS_PX this one fits best. Looks that disagree see a part of a drogue, or
# none: without this input minus the log likelihood is 526 in place of 380. With the diameter, and a weight of each look
# that depends on it, it is 353, but drogues of 9 px, the smallest of those pictures, are then found less often.
CALIBRATION = (1.64, 2.22, 0.2, -7.07)
GROWTH = 0.07  # of the log of the diameter per log of the enlargement, which blurs: median of the same pictures
# A rim with nearly the grey value of what is behind it is not seen, only the edge of the inside: before clouds, where
# they differ by less than 15 DN, diameters are 8 to 20 % too small. So each drogue is shown once more with STRETCH
# times the contrast about the middle between the rim and what is beside it (WITHIN and BESIDE, radii); its log diameter
# is the mean of both. RMS error of the log diameter of 142 drogues of the third renderer and 115 of the training's:
# .116 and .111 before, .112 and .107 with 2, .116 and .121 with 3. They look larger by STRETCH_GROWTH: .023 and .019.
STRETCH, STRETCH_GROWTH, WITHIN, BESIDE = 2.0, 0.02, (0.9, 1.0), (1.1, 1.3)


@dataclass(frozen=True, slots=True)
class DrogueCandidate:
    """A drogue in a picture."""

    u_px: float  # centre of the rim's image
    v_px: float
    diameter_px: float
    confidence: float  # probability that it is a drogue, calibrated on rendered pictures


@cache
def _network(weights: Path) -> cv2.dnn.Net:
    # The same answers in three quarters of the time of OpenCV 5's new engine; OpenCV 4 has no other one.
    classic = (cv2.dnn.ENGINE_CLASSIC,) if hasattr(cv2.dnn, "ENGINE_CLASSIC") else ()
    try:
        return cv2.dnn.readNetFromONNX(str(weights), *classic)
    except cv2.error as error:
        remedy = "install beampose again" if weights == WEIGHTS else "expected a file of studies.learned_detector.train"
        raise ValueError(f"{weights}: the weights of the learned detector are damaged: {remedy}") from error


def find_drogues(
    picture: Picture,
    smallest_px: float = SMALLEST_PX,
    largest_px: float | None = None,
    min_confidence: float = MIN_CONFIDENCE,
    weights: Path | None = None,
) -> list[DrogueCandidate]:
    """Drogues of a picture (h, w), the most confident first.

    smallest_px, largest_px: range of the diameters; None: up to the picture's smaller side. 16-bit pictures are scaled
    by their largest value. weights: of another network of studies/learned_detector/train.py, whose confidence is an
    order and no probability; None: those of the package. Raises ValueError: the picture is not grey, or the file of the
    weights is damaged.
    """
    weights = weights or WEIGHTS
    rows, levels = first_candidates(picture, smallest_px, largest_px, weights)
    found = np.array([_seen_again(row, levels, weights) for row in rows]).reshape(-1, 4)
    # A look that gives another size than the candidate's shows something else, mostly smaller than the network can see.
    same = np.abs(np.log(found[:, 3] / rows[:, 3])) < np.log(ALIKE_RATIO)
    found = _distinct(_without_parts(found[same & (found[:, 0] >= min(min_confidence, WHOLE_CONFIDENCE))]))
    seen = [_stretched(row, levels, weights) for row in found if row[0] >= min_confidence]
    return [d for d in seen if d is not None]


def first_candidates(
    picture: Picture, smallest_px: float, largest_px: float | None, weights: Path
) -> tuple[Array, list[PyramidLevel]]:
    """What is looked at again: confidence, u, v, diameter (n, 4), and the picture with its levels."""
    if picture.ndim != 2:
        raise ValueError(f"picture: expected a grey picture (h, w), got the shape {picture.shape}")
    full = 255 if picture.dtype == np.uint8 else max(int(picture.max()), 1)
    grey = np.asarray(picture, dtype=np.float32) / np.float32(full)
    top = float(min(picture.shape)) if largest_px is None else largest_px
    levels = pyramid(grey, SMALLEST_PX / max(smallest_px, SMALLEST_PX), COARSEST_PX, top)
    found = np.concatenate([_of_level(level, weights) for level in levels])
    found[:, 0] = 1 / (1 + np.exp(-(FIRST_SLOPE * found[:, 0] + FIRST_OFFSET)))
    found = found[np.argsort(-found[:, 0], kind="stable")][:MOST_LOOKED_AT]
    return found[found[:, 0] >= FIRST_CONFIDENCE], [PyramidLevel(grey, 1.0, 1.0), *levels]


def looked_at(row: Array, levels: list[PyramidLevel], weights: Path, stretch: float = 1.0) -> Array:
    """Logit, u, v, log diameter and log enlargement (looks, 5) of a candidate (4,), shown in each of LOOKS_PX.

    stretch: factor of the contrast about the middle between the grey values of the rim and of what is beside it.
    """
    _, u, v, diameter = row.tolist()
    half, first = (LOOK_SIDE_PX - 1) / 2, (LOOK_SIDE_PX // STRIDE - LOOK_CELLS) // 2
    radius = np.hypot(*(np.indices((LOOK_SIDE_PX, LOOK_SIDE_PX)) - half))
    seen = []
    for look_px in LOOKS_PX:
        scale = look_px / diameter
        level = [level for level in levels if level.scale >= min(scale, 1.0)][-1]
        scales = np.array([level.scale_u, level.scale_v])
        shift = half - (scale / scales) * ((np.array([u, v]) + 0.5) * scales - 0.5)
        turn_and_shift = np.column_stack([np.diag(scale / scales), shift])
        size = (LOOK_SIDE_PX, LOOK_SIDE_PX)
        part = cv2.warpAffine(level.grey, turn_and_shift, size, borderMode=cv2.BORDER_REFLECT_101)
        if stretch > 1:
            rings = [(radius > low * look_px / 2) & (radius < high * look_px / 2) for low, high in (WITHIN, BESIDE)]
            middle = np.mean([np.median(part[ring]) for ring in rings])
            part = np.clip(0.5 + stretch * (part - middle), 0, 1)
        cells = _cells(np.asarray(part, np.float32), weights)[:, first:, first:][:, :LOOK_CELLS, :LOOK_CELLS]
        i, j = np.unravel_index(np.argmax(cells[0]), cells[0].shape)
        logit, du, dv, size_log = cells[:, i, j].tolist()
        away = (STRIDE * (np.array([j + du, i + dv]) + 0.5 - LOOK_CELLS / 2)) / scale
        seen.append([logit, u + away[0], v + away[1], size_log - np.log(scale), max(np.log(scale), 0.0)])
    return np.array(seen)


def features(row: Array, seen: Array) -> Array:
    """The inputs (4,) of the confidence: 1, the mean logit of the looks, the log odds before them, and how far the
    looks disagree in place (diameters) and size (its logarithm).
    """
    size = _size_log(seen)
    apart = np.hypot(*(seen[0, 1:3] - seen[1, 1:3])) / np.exp(size.mean())
    disagree = min(float(np.hypot(apart, size[0] - size[1])), 1.0)
    return np.array([1.0, seen[:, 0].mean(), np.log(row[0] / max(1 - row[0], 1e-9)), disagree])


def _size_log(seen: Array) -> Array:
    """Log diameter (looks,), corrected for the blur of the enlargement."""
    return np.asarray(seen[:, 3] - GROWTH * seen[:, 4])


def _seen_again(row: Array, levels: list[PyramidLevel], weights: Path) -> Array:
    """A candidate (4,), confidence, u, v, diameter, after it was shown to the network again."""
    seen = looked_at(row, levels, weights)
    u, v = seen[:, 1:3].mean(axis=0)
    confidence = 1 / (1 + np.exp(-np.dot(CALIBRATION, features(row, seen))))
    return np.array([confidence, u, v, np.exp(_size_log(seen).mean())])


def _stretched(row: Array, levels: list[PyramidLevel], weights: Path) -> DrogueCandidate | None:
    """A drogue (4,), confidence, u, v, diameter, with the size that it has with more contrast, too; None: no drogue."""
    confidence, u, v, diameter = row.tolist()
    sizes = _size_log(looked_at(row, levels, weights, STRETCH)) - STRETCH_GROWTH - np.log(diameter)
    if np.abs(sizes).max() > np.log(ALIKE_RATIO):
        return None
    return DrogueCandidate(u, v, float(diameter * np.exp(sizes.mean() / 2)), confidence)


def _of_level(level: PyramidLevel, weights: Path) -> Array:
    """Logit, u, v, diameter (n, 4) of the candidates of a level, in pixels of the picture."""
    found = _candidates(level.grey, weights)
    scales = np.array([level.scale_u, level.scale_v])
    found[:, 1:3] = (found[:, 1:3] + 0.5) / scales - 0.5
    found[:, 3] /= level.scale
    return found


def _cells(grey: Floats, weights: Path) -> Array:
    """The network's answer (4, h / STRIDE, w / STRIDE) for a picture (h, w) of 0 to 1."""
    network = _network(weights)
    network.setInput(np.ascontiguousarray(grey, dtype=np.float32)[None, None])
    return np.asarray(network.forward()[0], dtype=float)


def _candidates(grey: Floats, weights: Path) -> Array:
    """Logit, u, v, diameter (n, 4), px, of the candidates in a picture (h, w) of 0 to 1."""
    height, width = grey.shape
    below, beside = -height % _MULTIPLE, -width % _MULTIPLE
    below, beside = max(below, _LEAST_SIDE_PX - height), max(beside, _LEAST_SIDE_PX - width)
    if below or beside:
        grey = np.asarray(cv2.copyMakeBorder(grey, 0, below, 0, beside, cv2.BORDER_REPLICATE), np.float32)
    cells = _cells(grey, weights)
    logit = cells[0]
    peak = logit >= cv2.dilate(logit, np.ones((3, 3), np.uint8))
    rows, columns = np.nonzero(peak & (logit >= MIN_LOGIT))
    answer = cells[:, rows, columns]
    u, v = (STRIDE * (k + 0.5 + answer[1 + i]) - 0.5 for i, k in enumerate((columns, rows)))
    out = np.column_stack([answer[0], u, v, np.exp(answer[3])])
    return out[(out[:, 3] >= SMALLEST_PX * 0.7) & (out[:, 3] <= LARGEST_PX * 1.25)]


def _without_parts(found: Array) -> Array:
    """Rows (n, 4) (confidence, u, v, diameter) that are no part of a much larger drogue.

    The coupling in the middle of a drogue and the markers on its rim look like small drogues on the fine levels, with
    a higher confidence than the whole has on the coarse ones.
    """
    confidence, u, v, diameter = found.T
    away = np.hypot(u[:, None] - u, v[:, None] - v)
    inside = (diameter > PART_RATIO * diameter[:, None]) & (away < PART_SHARE * diameter)
    part = inside & (confidence >= WHOLE_CONFIDENCE)
    return found[~part.any(axis=1)]


def _distinct(found: Array) -> Array:
    """Drogues (n, 4) (confidence, u, v, diameter), the best first, of candidates (m, 4); at most MAX_CANDIDATES.

    Candidates on a better one are the same drogue, often seen on another level. Centre and log diameter are the means
    of those of alike size and confidence, weighted by the confidence: a coarse level can give a diameter that is too
    large with a slightly higher confidence.
    """
    ordered = found[np.argsort(-found[:, 0], kind="stable")]
    confidence, u, v, diameter = ordered.T
    free, out = np.ones(len(ordered), dtype=bool), []
    for i in range(len(ordered)):
        if not free[i]:
            continue
        same = np.hypot(u - u[i], v - v[i]) < SAME_SHARE * np.maximum(diameter, diameter[i])
        free &= ~same
        ratio = np.exp(np.abs(np.log(diameter / diameter[i])))
        alike = same & (ratio < ALIKE_RATIO) & (confidence >= ALIKE_CONFIDENCE * confidence[i])
        weight = confidence[alike] / confidence[alike].sum()
        centre = weight @ ordered[alike, 1:3]
        out.append([confidence[i], *centre, np.exp(weight @ np.log(diameter[alike]))])
        if len(out) == MAX_CANDIDATES:
            break
    return np.array(out).reshape(-1, 4)


def learned_detector(min_radius_px: float, max_radius_px: float | None = None) -> CircleDetector:
    """The detector for the trackers of circles; radii in px."""

    def detect(picture: Picture, window: Window | None) -> list[CircleCandidate]:
        if window is None:
            found = find_drogues(picture, 2 * min_radius_px, None if max_radius_px is None else 2 * max_radius_px)
            return [CircleCandidate(d.u_px, d.v_px, d.diameter_px / 2, d.confidence) for d in found]
        top, bottom, left, right = crop_bounds(picture.shape, window)
        top, left = max(top - _MARGIN_PX, 0), max(left - _MARGIN_PX, 0)
        crop = picture[top : bottom + _MARGIN_PX, left : right + _MARGIN_PX]
        if not crop.size:
            return []
        out = []
        for d in find_drogues(crop, 2 * window.min_radius_px, 2 * window.max_radius_px):
            u, v = d.u_px + left, d.v_px + top
            if np.hypot(u - window.u_px, v - window.v_px) <= window.gate_px:
                out.append(CircleCandidate(u, v, d.diameter_px / 2, d.confidence))
        return out

    return detect
