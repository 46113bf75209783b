"""Where in a picture a spot may be: a fast look at all pixels, a closer one at the few bright places."""

from __future__ import annotations

import cv2
import numpy as np

from geometry.arrays import Array, Bools, Ints
from tracking.noise import NoiseModel, Picture

_BLOCK = 8  # px; one look per block, one background sample per block
_RADIUS = 48  # px: peaks further apart than this never belong to one spot of the largest size
_NEAREST = 4  # brighter peaks that a peak is compared with
_DIP = 0.12  # share of the fainter peak by which the light must fall between two spots: speckle falls by less
_HOT = 0.08  # light of the four neighbours over the pixel's: 0.15 for the sharpest spot (1 px wide), 0 for a hot pixel


def find_candidates(image: Picture, noise: NoiseModel, threshold_sigma: float, most: int) -> tuple[Array, Array]:
    """Peaks (n, 2), px, and the background under them (n,), DN, of a picture (h, w); the most significant first.

    The picture is halved (so the noise is too, but a spot hardly), each 8x8 block's maximum is compared with the
    median of the surrounding 5x5 blocks, and peaks are looked for in the blocks that stand out. At most 16 `most`
    blocks are looked at and 4 `most` peaks compared, which bounds the time in a picture full of light.
    """
    height, width = image.shape
    if height < 5 or width < 5:
        return np.zeros((0, 2)), np.zeros(0)
    block_u, block_v, ground, contrast = _bright_blocks(image, noise, threshold_sigma)
    if len(block_u) > 16 * most:
        best = np.argpartition(-contrast, 16 * most)[: 16 * most]
        block_u, block_v, ground = block_u[best], block_v[best], ground[best]
    if not len(block_u):
        return np.zeros((0, 2)), np.zeros(0)
    peaks, height_dn, level = _peaks_in_blocks(image, block_u, block_v, ground)
    sigma = np.sqrt(noise.variance(level))
    strong = height_dn > 0.4 * threshold_sigma * sigma  # a mean of 9 pixels: 1.2 times the threshold in its own sigmas
    strong &= ~_is_hot(image, peaks, np.sqrt(noise.variance(level + height_dn)))
    peaks, height_dn, level, sigma = peaks[strong], height_dn[strong], level[strong], sigma[strong]
    order = np.argsort(-height_dn, kind="stable")[: 4 * most]
    peaks, height_dn, level, sigma = peaks[order], height_dn[order], level[order], sigma[order]
    apart = _stands_apart(image, peaks, height_dn, level, sigma)
    return peaks[apart][:most].astype(float), level[apart][:most]


def _bright_blocks(image: Picture, noise: NoiseModel, threshold_sigma: float) -> tuple[Ints, Ints, Array, Array]:
    """Column and row (n,) of blocks with a maximum above threshold, px; their background, DN, and contrast, sigmas."""
    height, width = image.shape
    down, right = -height % _BLOCK, -width % _BLOCK
    whole = cv2.copyMakeBorder(image, 0, down, 0, right, cv2.BORDER_REPLICATE) if down or right else image
    half = cv2.resize(whole, (whole.shape[1] // 2, whole.shape[0] // 2), interpolation=cv2.INTER_AREA)
    n = _BLOCK // 2
    rows = half.reshape(half.shape[0] // n, n, half.shape[1]).max(axis=1)
    pairs = np.maximum(rows[:, 0::2], rows[:, 1::2])
    highest = np.maximum(pairs[:, 0::2], pairs[:, 1::2])
    ground = cv2.medianBlur(np.ascontiguousarray(half[n // 2 :: n, n // 2 :: n]), 5)
    # The mean of four pixels, rounded again.
    sigma = np.sqrt(noise.variance(ground.astype(np.float32)) / 4 + 1 / 12)
    contrast = (highest.astype(np.float32) - ground) / sigma
    at = np.flatnonzero(contrast.reshape(-1) > threshold_sigma)
    return (
        (at % highest.shape[1]) * _BLOCK,
        (at // highest.shape[1]) * _BLOCK,
        ground.reshape(-1)[at].astype(float),
        contrast.reshape(-1)[at].astype(float),
    )


def _peaks_in_blocks(image: Picture, block_u: Ints, block_v: Ints, ground: Array) -> tuple[Ints, Array, Array]:
    """Maxima of the 3x3 mean over 5x5 pixels: positions (n, 2), heights above the background, background."""
    height, width = image.shape
    reach = np.arange(-3, _BLOCK + 3)
    # Mirrored at the border: with repeated pixels the maximum of a spot at the edge would come to lie outside.
    columns, rows = _mirrored(block_u[:, None] + reach, width), _mirrored(block_v[:, None] + reach, height)
    values = image[rows[:, :, None], columns[:, None, :]].astype(np.float32)
    across = values[:, :, :-2] + values[:, :, 1:-1] + values[:, :, 2:]
    mean = (across[:, :-2] + across[:, 1:-1] + across[:, 2:]) / 9
    size = mean.shape[1]
    wide = mean[:, :, : size - 4].copy()
    for i in range(1, 5):
        np.maximum(wide, mean[:, :, i : size - 4 + i], out=wide)
    highest = wide[:, : size - 4].copy()
    for i in range(1, 5):
        np.maximum(highest, wide[:, i : size - 4 + i], out=highest)
    middle = mean[:, 2:-2, 2:-2]
    which, row, column = np.nonzero((middle >= highest) & (middle > ground[:, None, None]))
    u, v = block_u[which] + column, block_v[which] + row
    inside = (u < width) & (v < height)
    which, u, v, row, column = which[inside], u[inside], v[inside], row[inside], column[inside]
    return np.stack([u, v], axis=1), middle[which, row, column] - ground[which], ground[which]


def _is_hot(image: Picture, peaks: Ints, sigma: Array) -> Bools:
    """Whether the brightest pixel at each peak (n, 2) stands alone, as no light does that came through a lens.

    sigma (n,), DN, is the noise there: on the broad top of a wide spot the highest pixel is the luckiest one.
    """
    height, width = image.shape
    steps = np.arange(-1, 2)
    near_u = np.clip(peaks[:, :1] + steps, 0, width - 1)
    near_v = np.clip(peaks[:, 1:] + steps, 0, height - 1)
    best = image[near_v[:, :, None], near_u[:, None, :]].reshape(len(peaks), 9).argmax(axis=1)
    u = near_u[np.arange(len(peaks)), best % 3]
    v = near_v[np.arange(len(peaks)), best // 3]
    steps = np.arange(-2, 3)
    columns, rows = _mirrored(u[:, None] + steps, width), _mirrored(v[:, None] + steps, height)
    values = image[rows[:, :, None], columns[:, None, :]].reshape(len(peaks), 25).astype(np.float32)
    ring = np.sort(values[:, _RING], axis=1)[:, 7:9].mean(axis=1)  # their median
    cross = values[:, _CROSS].mean(axis=1)
    above = values[:, 12] - ring
    return (cross - ring < _HOT * above) & (above > 4 * sigma)


_RING = np.array([i for i in range(25) if max(abs(i // 5 - 2), abs(i % 5 - 2)) == 2])
_CROSS = np.array([7, 11, 13, 17])


def _mirrored(index: Ints, size: int) -> Ints:
    """Indices of rows or columns outside a picture, reflected at its outermost ones."""
    index = np.abs(index)
    return np.clip(np.where(index > size - 1, 2 * (size - 1) - index, index), 0, size - 1)


def _stands_apart(image: Picture, peaks: Ints, height: Array, level: Array, sigma: Array) -> Bools:
    """Whether between each peak and every near, brighter one (they come sorted) the light falls below both.

    It must fall by `_DIP` of the fainter peak, and by four sigmas of a mean of nine pixels.
    """
    n = len(peaks)
    apart = np.ones(n, dtype=bool)
    if n < 2:
        return apart
    at = peaks.astype(np.float32)
    gap2 = ((at[:, None, :] - at[None, :, :]) ** 2).sum(axis=2)
    gap2[np.triu_indices(n)] = np.inf  # only the brighter ones
    k = min(_NEAREST, n - 1)
    nearest = np.argpartition(gap2, k - 1, axis=1)[:, :k]
    close = np.take_along_axis(gap2, nearest, axis=1) < _RADIUS**2
    here = np.broadcast_to(np.arange(n)[:, None], nearest.shape)[close]
    there = nearest[close]
    if not len(here):
        return apart
    shares = np.linspace(0, 1, 13)[1:-1]
    line = peaks[here, None, :] * (1 - shares[:, None]) + peaks[there, None, :] * shares[:, None]
    lowest = _mean3(image, np.rint(line).astype(np.int64)).min(axis=1) - level[here]
    needed = np.maximum(_DIP * height[here], 4 / 3 * np.sqrt(2) * sigma[here])
    same = height[here] - lowest < needed
    apart[here[same]] = False
    return apart


def _mean3(image: Picture, points: Ints) -> Array:
    """Mean of the 3x3 pixels around whole points (..., 2); the border's pixels are repeated outside."""
    height, width = image.shape
    steps = np.arange(-1, 2)
    columns = np.clip(points[..., 0, None] + steps, 0, width - 1)
    rows = np.clip(points[..., 1, None] + steps, 0, height - 1)
    return image[rows[..., :, None], columns[..., None, :]].mean(axis=(-2, -1))
