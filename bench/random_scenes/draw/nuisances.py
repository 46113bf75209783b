"""Disturbances of a recording: occlusions, missing pictures, false points and static reflections."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.rig import Rig

CLEAN_FRAMES = 10  # at the start: no occlusions and no missing pictures


@dataclass(frozen=True, slots=True)
class FalsePoints:
    """The frequency of false points."""

    beside: float  # probability of one beside each spot in the picture, visible or not, in each frame
    beside_px: tuple[float, float]  # smallest and largest distance from it
    anywhere: float  # mean number anywhere in each picture, at most MOST_ANYWHERE
    reflections: tuple[Array, ...]  # by camera (m, 2), px: fixed points
    reflection_seen: float = 0.97  # probability in each frame
    exactly: int | None = None  # number anywhere in each picture, instead of the mean

    @property
    def text(self) -> str:
        """A short description."""
        parts = [f"clutter {self.beside:.0%}"] if self.beside else []
        parts += [f"{self.anywhere:.1f} anywhere"] if self.anywhere else []
        parts += [f"{self.exactly} anywhere"] if self.exactly else []
        many = sum(map(len, self.reflections))
        parts += [f"{many} static"] if many else []
        return ", ".join(parts) or "no false points"


MOST_ANYWHERE = 5


def draw_false_points(rng: np.random.Generator, rig: Rig, uv_px: Array, camera_of: Ints) -> FalsePoints:
    """Independent draws of each kind; uv_px (T, n, 2): where the spots are."""
    beside = 0.0 if rng.random() < 0.3 else float(rng.uniform(0, 1))
    anywhere = 0.0 if rng.random() < 0.4 else float(rng.uniform(0, MOST_ANYWHERE))
    reflections = []
    some = rng.random() < 0.4
    for c, camera in enumerate(rig.cameras.values()):
        count = int(rng.integers(0, 3)) if some else 0
        near = bool(rng.random() < 0.6)
        reflections.append(draw_reflections(rng, count, camera.image_size_px, uv_px[:, camera_of == c], near))
    return FalsePoints(beside, (15.0, 40.0), anywhere, tuple(reflections))


def draw_reflections(
    rng: np.random.Generator,
    count: int,
    size_px: tuple[int, int],
    uv_px: Array,
    near: bool,
    at_frame: int | None = None,
) -> Array:
    """Fixed points (count, 2), px: 10 to 80 px from the median position of a spot (or that in a frame), or anywhere.

    uv_px (T, m, 2): the camera's spots.
    """
    size = np.array(size_px, dtype=float)
    out = rng.uniform(0, size - 1, (count, 2))
    if near and count:
        with np.errstate(invalid="ignore"):
            middles = np.median(uv_px, axis=0) if at_frame is None else uv_px[at_frame]
        middles = middles[~np.isnan(middles).any(axis=-1)]
        for i in range(count if len(middles) else 0):
            turn, radius = rng.uniform(0, 2 * np.pi), rng.uniform(10, 80)
            place = middles[rng.integers(len(middles))] + radius * np.array([np.cos(turn), np.sin(turn)])
            if np.all((place >= 0) & (place <= size - 1)):
                out[i] = place
    return out


def draw_hidden(
    rng: np.random.Generator, frames: int, camera_of: Ints, spot_of: Ints, corner_frames: Array
) -> tuple[Bools, str]:
    """The occluded views (T, n), and a short description.

    corner_frames: corners of the motion, in frames and fractions. An occluded spot is invisible to all cameras.
    """
    hidden = np.zeros((frames, len(camera_of)), dtype=bool)
    words = []
    events = 0 if rng.random() < 0.25 else int(rng.integers(1, 6))
    spots = np.unique(spot_of)
    for _ in range(events):
        length = int(np.exp(rng.uniform(0, np.log(40.9))))
        usable = corner_frames[corner_frames > CLEAN_FRAMES + 1]
        if usable.size and rng.random() < 0.5:
            first = int(usable[rng.integers(usable.size)] - rng.uniform(0, length))
        else:
            first = int(rng.integers(CLEAN_FRAMES, max(frames - 1, CLEAN_FRAMES + 1)))
        first = max(first, CLEAN_FRAMES)
        what = str(rng.choice(["one", "two", "screen", "all"], p=[0.35, 0.25, 0.2, 0.2]))
        if what == "all":
            views = np.ones(len(camera_of), dtype=bool)
        elif what == "screen":
            views = camera_of == rng.integers(camera_of.max() + 1)
        else:
            views = np.isin(spot_of, rng.choice(spots, {"one": 1, "two": 2}[what], replace=False))
        hidden[first : first + length, views] = True
        words.append(f"{what} {first}-{min(first + length, frames) - 1}")
    missed = 0.0 if rng.random() < 0.3 else rng.uniform(0, 0.03)
    gone = rng.random(hidden.shape) < missed
    gone[:CLEAN_FRAMES] = False
    text = f"hidden {', '.join(words)}" if words else "nothing hidden"
    return hidden | gone, text + (f", {missed:.1%} missed" if missed else "")


def draw_missing(rng: np.random.Generator, frames: int, cameras: int) -> tuple[Bools, str]:
    """The existing pictures (T, cameras), and a short description; in one of five scenes some are missing."""
    has_image = np.ones((frames, cameras), dtype=bool)
    if rng.random() > 0.2:
        return has_image, ""
    first, length = int(rng.integers(CLEAN_FRAMES, frames)), int(np.exp(rng.uniform(0, np.log(40.9))))
    camera = int(rng.integers(cameras + 1))
    has_image[first : first + length, camera if camera < cameras else slice(None)] = False
    who = f"camera {camera}" if camera < cameras else "all cameras"
    return has_image, f"{who} without pictures {first}-{min(first + length, frames) - 1}"
