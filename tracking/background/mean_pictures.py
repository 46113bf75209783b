"""Means of a camera's pictures, over pictures and over their surroundings, for the static background."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from geometry.arrays import Array, evenly_spread
from geometry.compilation.jit import compiled_for_threads
from tracking.noise import BLOCK, Picture

MOST_BYTES = 150_000_000  # of these pictures
STRIP = 4 * BLOCK  # rows that are computed at once: several arrays of them are in the processor's cache
_CUT = 0.25  # share of the lowest and of the highest grey values of a pixel that is left out
LOWER_VARIANCE, MIDDLE_VARIANCE = 1.4, 1.2  # of the means of `means_of`, times the pictures, over that of normal noise
LEAST_CHANGE = 0.03  # the light has not changed by more than this share: the structure is not scaled
LEAST_LIGHT, MOST_LIGHT = 0.2, 5.0  # changes of the light beyond which a picture is searched without subtraction
GAIN_BITS = 8  # binary places of a factor on the difference
_SMOOTH_BLOCKS = 6.0  # blocks: sigma of the smooth part of the background, which is no structure


def usable(pictures: Sequence[Picture]) -> list[Picture]:
    """As many of the pictures as may be in memory, evenly spaced; none if they are too small or not alike."""
    if not pictures or min(pictures[0].shape) < 4 * BLOCK:
        return []
    if any(p.shape != pictures[0].shape or p.dtype != pictures[0].dtype for p in pictures):
        return []
    return [pictures[i] for i in evenly_spread(np.arange(len(pictures)), MOST_BYTES // pictures[0].nbytes)]


def means_of(pictures: Sequence[NDArray[Any]], passed: bool = False) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The means (h, w) of the lower half of each pixel's grey values, without the lowest, and of the middle half.

    The lower half does not contain lights that were elsewhere in half of the pictures; its noise is larger. passed:
    something darker was in front of each pixel in some pictures, a person: as much is left out of the lower half.
    """
    lower, middle = np.empty((2, *pictures[0].shape), np.float32)
    count = len(pictures)
    cut = int(_CUT * count)
    for top in range(0, len(lower), STRIP):
        part = np.s_[top : top + STRIP]
        values = _in_order([p[part].copy() for p in pictures])
        lower[part] = _mean(values[cut if passed else 1 : count // 2])
        middle[part] = _mean(values[cut : count - cut])
    return lower, middle


def _in_order(values: list[NDArray[Any]]) -> list[NDArray[Any]]:
    """Arrays of one shape, with their values sorted pixel by pixel; the arrays given are overwritten.

    A network of comparisons of whole arrays, ten times as fast as a sort of each pixel. Source: Batcher's merge
    exchange, Knuth, The Art of Computer Programming, volume 3, 5.2.2, algorithm M.
    """
    n, spare = len(values), np.empty_like(values[0])
    first = 1 << max((n - 1).bit_length() - 1, 0)
    p = first
    while p > 0:
        q, r, d = first, 0, p
        while True:
            for i in (k for k in range(n - d) if k & p == r):
                np.minimum(values[i], values[i + d], out=spare)
                np.maximum(values[i], values[i + d], out=values[i + d])
                values[i], spare = spare, values[i]
            if q == p:
                break
            d, q, r = q - p, q // 2, p
        p //= 2
    return values


def _mean(values: list[NDArray[Any]]) -> NDArray[np.float32]:
    total = values[0].astype(np.float32)
    for more in values[1:]:
        total += more
    return np.asarray(total / np.float32(len(values)), np.float32)


def smooth_part(mean: NDArray[np.float32]) -> NDArray[np.float32]:
    """What of a picture (h, w) varies over many blocks, without small lights."""
    height, width = mean.shape
    whole = height // BLOCK * BLOCK, width // BLOCK * BLOCK
    blocks = cv2.resize(mean[: whole[0], : whole[1]], (width // BLOCK, height // BLOCK), interpolation=cv2.INTER_AREA)
    blurred = cv2.GaussianBlur(cv2.medianBlur(blocks, 5), (0, 0), _SMOOTH_BLOCKS)
    return np.asarray(cv2.resize(blurred, (width, height), interpolation=cv2.INTER_LINEAR), np.float32)


def highest_of_blocks(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """The highest mean of each block of BLOCK x BLOCK pixels and its neighbours."""
    rows, columns = (-(-n // BLOCK) for n in values.shape)
    missing = (0, rows * BLOCK - values.shape[0]), (0, columns * BLOCK - values.shape[1])
    blocks = cv2.resize(np.pad(values, missing, mode="edge"), (columns, rows), interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.dilate(blocks, np.ones((3, 3))), np.float32)


def in_steps(values: NDArray[np.float32], steps: int) -> NDArray[np.uint16]:
    """Grey values, DN, in steps of a fraction of 1 DN."""
    return np.clip(np.rint(values * steps), 0, np.iinfo(np.uint16).max).astype(np.uint16)


def raised_difference(
    picture: Picture, steps: int, subtracted: NDArray[np.uint16], structure: NDArray[np.float32],
    rows: tuple[Array, Array], clips: float, top: int, level: int = 0, gain: NDArray[np.uint16] | None = None,
) -> NDArray[np.uint16]:  # fmt: skip
    """A picture (h, w) in steps of a fraction of 1 DN, plus `subtracted`, and more in some rows.

    rows (h,) each: there so much times the structure (h, w), and so many steps. Pixels of at least `clips`, DN, become
    `top`. gain (h, w): what is above or below `level` is multiplied by it; 256 is 1. In one pass:
    whole pictures in between take most of the time.
    """
    out = np.empty_like(subtracted)
    most = int(np.iinfo(picture.dtype).max) + 1
    limit = min(int(np.ceil(min(clips, most))), most)
    more, raised = rows[0].astype(np.float32), np.rint(rows[1]).astype(np.int32)
    if gain is None:
        _raise(picture, steps, subtracted, structure, more, raised, limit, top, out)
    else:
        _raise_by(picture, steps, subtracted, structure, more, raised, limit, top, level, gain, out)
    return out


@compiled_for_threads
def _raise(
    picture: NDArray[Any], steps: int, subtracted: NDArray[np.uint16], structure: NDArray[np.float32],
    more: NDArray[np.float32], raised: NDArray[np.int32], clips: int, top: int, out: NDArray[np.uint16],
) -> None:  # fmt: skip
    many, limit, high = np.int32(steps), np.int32(clips), np.int32(top)
    lowest, most = np.int32(0), np.int32(65535)
    for i in range(out.shape[0]):
        seen, added, to = picture[i], subtracted[i], out[i]
        factor_of, lift = more[i], raised[i]
        if factor_of == np.float32(0.0) and lift == 0:
            for j in range(to.shape[0]):
                x = np.int32(seen[j])
                y = x * many + np.int32(added[j])
                y = y if y < most else most
                to[j] = np.uint16(y if x < limit else high)
            continue
        own = structure[i]
        for j in range(to.shape[0]):
            x = np.int32(seen[j])
            z = np.int32(added[j]) + np.int32(factor_of * own[j]) + lift
            z = z if z > lowest else lowest
            y = x * many + (z if z < most else most)
            y = y if y < most else most
            to[j] = np.uint16(y if x < limit else high)


@compiled_for_threads
def _raise_by(
    picture: NDArray[Any], steps: int, subtracted: NDArray[np.uint16], structure: NDArray[np.float32],
    more: NDArray[np.float32], raised: NDArray[np.int32], clips: int, top: int, level: int, gain: NDArray[np.uint16],
    out: NDArray[np.uint16],
) -> None:  # fmt: skip
    many, limit, high, base = np.int32(steps), np.int32(clips), np.int32(top), np.int32(level)
    lowest, most, bits = np.int32(0), np.int32(65535), np.int32(GAIN_BITS)
    for i in range(out.shape[0]):
        seen, added, factor, own, to = picture[i], subtracted[i], gain[i], structure[i], out[i]
        factor_of, lift = more[i], raised[i]
        if factor_of == np.float32(0.0) and lift == 0:
            for j in range(to.shape[0]):
                x = np.int32(seen[j])
                z = x * many + np.int32(added[j]) - base
                y = base + ((z * np.int32(factor[j])) >> bits)
                y = y if y > lowest else lowest
                y = y if y < most else most
                to[j] = np.uint16(y if x < limit else high)
            continue
        for j in range(to.shape[0]):
            x = np.int32(seen[j])
            z = x * many + np.int32(added[j]) + np.int32(factor_of * own[j]) + lift - base
            y = base + ((z * np.int32(factor[j])) >> bits)
            y = y if y > lowest else lowest
            y = y if y < most else most
            to[j] = np.uint16(y if x < limit else high)
