"""Pictures of one level of the detector's pyramid with their truth: rendered once, kept in files, changed at use."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from geometry.arrays import Array
from lab.learned_detector.samples import Sample, draw_sample

RENDERED_PX, SIZE_PX = 144, 112  # sides of a rendered picture and of the part that is shown to the network
DIAMETERS_PX = (7.0, 44.0)  # one level of the pyramid; the detector uses 7 to 40
CHUNK = 1000  # samples in a file
# Levels of the pyramid: the picture itself and pictures reduced by these factors, with their shares of the samples.
REDUCED, REDUCED_SHARES = (1.0, 9 / 8, 9 / 4, 9 / 2), (0.35, 0.3, 0.27, 0.08)
_WARPED_SHARE, _LARGEST_SCALE = 0.5, 1.2

Pictures = NDArray[np.uint8]  # (n, side, side)


def level_sample(rng: np.random.Generator) -> Sample:
    """One random picture of RENDERED_PX squared as a level of the pyramid shows it: rendered larger, then reduced."""
    factor = float(rng.choice(REDUCED, p=REDUCED_SHARES))
    side = round(factor * RENDERED_PX)
    sample = draw_sample(rng, (side, side), (factor * DIAMETERS_PX[0], factor * DIAMETERS_PX[1]))
    if side == RENDERED_PX:
        return sample
    image = cv2.resize(sample.image, (RENDERED_PX, RENDERED_PX), interpolation=cv2.INTER_AREA)
    u, v = ((x + 0.5) / factor - 0.5 for x in sample.centre_px)
    return Sample(np.asarray(image, dtype=np.uint8), (u, v), sample.diameter_px / factor)


def rendered(number: int, seed: int, folder: Path) -> tuple[Pictures, Array]:
    """Pictures (n, RENDERED_PX, RENDERED_PX) and truths (n, 3): centre u, v and diameter, px; nan without one.

    Files of the folder are used again: an interrupted run continues where it was.
    """
    images, truths = [], []
    folder.mkdir(parents=True, exist_ok=True)
    for chunk in range(-(-number // CHUNK)):
        path = folder / f"samples_{seed}_{chunk}.npz"
        if not path.is_file():
            rng = np.random.default_rng([seed, chunk])
            drawn = [level_sample(rng) for _ in range(CHUNK)]
            part = path.with_suffix(".part.npz")
            truth = [(*s.centre_px, s.diameter_px) for s in drawn]
            np.savez(part, images=np.stack([s.image for s in drawn]), truth=np.array(truth))
            part.replace(path)
        with np.load(path) as file:
            images.append(file["images"])
            truths.append(file["truth"])
    return np.concatenate(images)[:number], np.concatenate(truths)[:number]


def augmented(images: Pictures, truth: Array, rng: np.random.Generator) -> tuple[NDArray[np.float32], Array]:
    """Parts (n, SIZE_PX, SIZE_PX) of pictures, in [0, 1], moved, mirrored, turned, scaled, with another contrast.

    A drogue whose centre leaves the part is no longer in the truth.
    """
    out, wanted = np.empty((len(images), SIZE_PX, SIZE_PX), np.float32), truth.copy()
    spare = RENDERED_PX - SIZE_PX
    for i, image in enumerate(images):
        left, top = rng.integers(0, spare + 1, 2)
        if rng.random() < _WARPED_SHARE:
            out[i], wanted[i] = _warped(image, truth[i], rng)
        else:
            out[i] = image[top : top + SIZE_PX, left : left + SIZE_PX]
            wanted[i, :2] -= left, top
    if rng.random() < 0.5:
        out, wanted = out[:, :, ::-1], wanted * [-1, 1, 1] + [SIZE_PX - 1, 0, 0]
    if rng.random() < 0.5:
        out, wanted = out.swapaxes(1, 2), wanted[:, [1, 0, 2]]
    gain = rng.uniform(0.5, 1.3, (len(out), 1, 1)).astype(np.float32)
    offset = rng.uniform(-25, 40, (len(out), 1, 1)).astype(np.float32)
    away = (wanted[:, :2] < -0.5).any(axis=1) | (wanted[:, :2] > SIZE_PX - 0.5).any(axis=1)
    wanted[away] = np.nan
    return np.asarray(np.clip(gain * out + offset, 0, 255) / 255, np.float32), wanted


def middle(images: Pictures, truth: Array) -> tuple[NDArray[np.float32], Array]:
    """The middle parts (n, SIZE_PX, SIZE_PX) of pictures, in [0, 1], for validation."""
    cut = (RENDERED_PX - SIZE_PX) // 2
    wanted = truth - [cut, cut, 0]
    wanted[(wanted[:, :2] < -0.5).any(axis=1) | (wanted[:, :2] > SIZE_PX - 0.5).any(axis=1)] = np.nan
    part = images[:, cut : cut + SIZE_PX, cut : cut + SIZE_PX]
    return part.astype(np.float32) / np.float32(255), wanted


def _warped(image: NDArray[np.uint8], truth: Array, rng: np.random.Generator) -> tuple[NDArray[np.float32], Array]:
    """A part of a picture, turned, scaled and moved by a random similarity, and its truth."""
    scale = float(np.exp(rng.uniform(-1, 1) * np.log(_LARGEST_SCALE)))
    turn, half = rng.uniform(0, 2 * np.pi), (RENDERED_PX - 1) / 2
    A = scale * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    place = (SIZE_PX - 1) / 2 + rng.uniform(-16, 16, 2)
    M = np.column_stack([A, place - A @ [half, half]])
    size = (SIZE_PX, SIZE_PX)
    out = cv2.warpAffine(image, M, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
    return np.asarray(out, dtype=np.float32), np.array([*(A @ truth[:2] + M[:, 2]), scale * truth[2]])
