"""Real spots on real backgrounds: `python -m bench.real_spots DATA_FOLDER --pictures 1000 --seed 1`.

Light cut from photographs (laser pointers in rooms, a saturated close-up, beams on a bare sensor at several scales,
stars) is added to other photographs (rooms, boards, bright field, streets) at known sub-pixel positions, and written as
PNG or JPEG (quality 70 to 95), in grey or colour, as one picture or as a series of six with a static background. The
files are searched as `beampose detect` does. --keep FOLDER keeps the pictures in which a spot was missed.

A local sigma is the standard deviation of the background's pixels within 15 px of the place, before the light is added,
and of the noise and the errors of the compression there. A spot's peak is what the file holds of it: compression and
clipping take a part of the light, and of some faint narrow spots all of it. The stars are those of the catalogue: the
brightest pixels of the star fields include a hot pixel, at the same place in each.
"""

from __future__ import annotations

import argparse
import tempfile
from collections import Counter, defaultdict
from csv import DictReader
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, optimize

from lab.pictures.source import open_inputs, pictures, pictures_of_frames
from lab.runs.detect.picture_series import PictureSeries
from lab.runs.frames.sensor_noise import noise_frames
from tracking.detections import Detections
from tracking.parameters import DetectParameters

Image = NDArray[Any]
# The spots in laser_spot_room: place, and radius, px, of the place around them that holds nothing else.
ROOM = {"4": (1434, 1146, 26), "5": (1635, 731, 16), "6": (837, 746, 26), "7": (1919, 284, 26)}
STREETS = ("chessboard_webcam_c920/*.jpg", "circles_stills/*g", "charuco_aruco_stills/*.jpg")
BOARDS = ("chessboard_stereo_opencv/*.jpg", "chessboard_lowquality_400x300/*.png")
GROUPS = {
    "room": ("laser_spot_room/*.jpg",), "board": BOARDS, "bright field": ("rings_brightfield/*.png",),
    "street": STREETS,
    "outdoors": ("star_fields/tree.jpg", "moving_target_spider/*.mp4"),
}  # fmt: skip
SIZE = (400, 320)  # px, of the pictures
SERIES = 6  # pictures
LOCAL = 15  # px
FOUND = 4.0  # px, or 1.5 widths: a detection nearer than this is the spot


@dataclass(frozen=True, slots=True)
class Light:
    """The light of one spot above its background, with the place of its Gaussian fit."""

    kind: str
    pixels: Image  # (h, w), largest value 1
    centre: tuple[float, float]  # px
    width: float  # px, sigma


def _read(path: Path) -> Image | None:
    if path.suffix == ".mp4":
        return cv2.VideoCapture(str(path)).read()[1]
    return cv2.imread(str(path), cv2.IMREAD_UNCHANGED)


def _grey(image: Image) -> Image:
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image, float)


def _gaussian_centre(light: Image, start: tuple[float, float], width: float) -> tuple[float, float, float]:
    """The centre and mean width, px, of an unweighted least-squares fit of a Gaussian on a plane."""
    v, u = np.mgrid[: light.shape[0], : light.shape[1]].astype(float)

    def misfit(p: Image) -> Image:
        x, y = (u - p[0]) / np.exp(p[2]), (v - p[1]) / np.exp(p[3])
        r = np.tanh(p[4])
        shape = np.exp(-0.5 * (x * x - 2 * r * x * y + y * y) / (1 - r * r))
        return np.asarray(p[5] * shape + p[6] + p[7] * (u - p[0]) + p[8] * (v - p[1]) - light).ravel()

    first = np.array([*start, np.log(width), np.log(width), 0.0, 1.0, 0.0, 0.0, 0.0])
    p = optimize.least_squares(misfit, first).x
    return float(p[0]), float(p[1]), float(np.exp(0.5 * (p[2] + p[3])))


def _cut(image: Image, at: tuple[int, int], half: int) -> Image:
    """The light about a point above the plane through the border of its window, fading to 0 there; largest value 1."""
    u, v = at
    own = image[v - half : v + half + 1, u - half : u + half + 1]
    b, a = np.mgrid[-half : half + 1, -half : half + 1].astype(float) / half
    away = np.hypot(a, b)
    ring = (away > 0.8) & (away < 1.0)
    plane = np.linalg.lstsq(np.column_stack([np.ones(ring.sum()), a[ring], b[ring]]), own[ring], rcond=None)[0]
    light = (own - plane[0] - plane[1] * a - plane[2] * b) * np.clip((1.0 - away) / 0.25, 0.0, 1.0)
    return np.asarray(np.maximum(light, 0.0) / light.max())


def _reduced(fine: Image, scale: int, shift: tuple[int, int]) -> Image:
    """Area means over squares of `scale` px after a shift by whole fine pixels: exact sub-pixel positions."""
    moved = np.pad(fine, ((scale + shift[1], 2 * scale), (scale + shift[0], 2 * scale)))
    h, w = (n // scale * scale for n in moved.shape)
    return np.asarray(moved[:h, :w].reshape(h // scale, scale, w // scale, scale).mean(axis=(1, 3)))


class Lights:
    """Draws spots from the photographs of a data folder."""

    def __init__(self, data: Path) -> None:
        self.rooms = [
            _cut(_grey(cv2.imread(str(data / f"laser_spot_room/{name}.jpg"))), (u, v), half)
            for name, (u, v, half) in ROOM.items()
        ]
        close = _grey(cv2.imread(str(data / "laser_spot_saturated/laser point.png")))
        core = np.argwhere(close > 245).mean(axis=0)[::-1].round().astype(int)
        self.close = _cut(close, (int(core[0]), int(core[1])), int(min(core.min(), 112 - core.max() - 1)))
        self.beams = []
        for path in sorted((data / "laser_beam_series_t").glob("*.pgm")):
            image = ndimage.gaussian_filter(_grey(cv2.imread(str(path), -1)), 2.0)
            v, u = np.unravel_index(np.argmax(ndimage.gaussian_filter(image, 10.0)), image.shape)
            half = int(min(u, v, image.shape[1] - u - 1, image.shape[0] - v - 1, 260))
            self.beams.append(_cut(image, (int(u), int(v)), half))
        self.stars = []
        with (data / "star_fields/matches.csv").open(encoding="utf-8") as lines:
            known = [
                (row["picture"], float(row["tetra3_u_px"]), float(row["tetra3_v_px"])) for row in DictReader(lines)
            ]
        for path in sorted((data / "star_fields").glob("*.tiff")):
            image = _grey(cv2.imread(str(path), -1))
            smooth = ndimage.gaussian_filter(image, 1.0)
            highest = (smooth == ndimage.maximum_filter(smooth, 41)) & (image < 50_000)
            v, u = (x + 40 for x in np.nonzero(highest[40:-40, 40:-40]))
            stars = np.array([(a, b) for name, a, b in known if name == path.name])
            real = np.hypot(u[:, None] - stars[:, 0], v[:, None] - stars[:, 1]).min(axis=1) < 1.5
            u, v = u[real], v[real]
            order = np.argsort(-smooth[v, u])[:8]
            self.stars += [_cut(image, (int(u[i]), int(v[i])), 8) for i in order]

    def draw(self, random: np.random.Generator) -> Light:
        """A spot of a random kind, scale and place within the pixel."""
        kind = str(random.choice(["room", "close-up", "beam", "beam", "star"]))
        if kind == "star":
            pixels = self.stars[random.integers(len(self.stars))]
            start, width = (8.0, 8.0), 0.7
        elif kind == "room":
            pixels = self.rooms[random.integers(len(self.rooms))]
            scale = int(random.integers(1, 4))
            if scale == 1:
                pixels = np.maximum(ndimage.shift(pixels, random.uniform(-0.5, 0.5, 2), order=3), 0.0)
            else:
                pixels = _reduced(pixels, scale, (int(random.integers(scale)), int(random.integers(scale))))
            start, width = (0.0, 0.0), 5.0 / scale
        else:
            fine = self.close if kind == "close-up" else self.beams[random.integers(len(self.beams))]
            width_px = 0.18 * fine.shape[0]
            scale = max(int(width_px / random.uniform(1.5, 9.0)), 2 if kind == "close-up" else 8)
            pixels = _reduced(fine, scale, (int(random.integers(scale)), int(random.integers(scale))))
            start, width = (0.0, 0.0), width_px / scale
        pixels = pixels / pixels.max()
        if start == (0.0, 0.0):
            v, u = np.unravel_index(np.argmax(ndimage.gaussian_filter(pixels, 0.5 * width)), pixels.shape)
            start = float(u), float(v)
        u, v, width = _gaussian_centre(pixels, start, width)
        return Light(kind, pixels, (u, v), width)


@dataclass(frozen=True, slots=True)
class Picture:
    """One picture with one spot."""

    image: Image
    background: Image  # (h, w), DN, grey, without the light
    uv: tuple[float, float]  # px
    light: Light
    peak: float  # DN
    sigma: float  # DN, of the background and the noise at the place

    def local_sigmas(self, file: Path) -> float:
        """The spot's peak in the file in local sigmas, with the errors of compression that the file has there."""
        j, i = round(self.uv[0]), round(self.uv[1])
        here = np.s_[max(i - LOCAL, 0) : i + LOCAL + 1, max(j - LOCAL, 0) : j + LOCAL + 1]
        kept, light = _grey(cv2.imread(str(file), cv2.IMREAD_UNCHANGED)), self.light.pixels
        error = kept[here] - _grey(self.image)[here]
        left, top = round(self.uv[0] - self.light.centre[0]), round(self.uv[1] - self.light.centre[1])
        own = np.s_[top : top + light.shape[0], left : left + light.shape[1]]
        shown = float(np.sum(light * (kept - self.background)[own]) / np.sum(light * light))  # least squares
        return min(shown, self.peak) / float(np.hypot(self.sigma, error.std()))


def draw_pictures(backgrounds: list[Image], lights: Lights, random: np.random.Generator) -> list[Picture]:
    """One picture, or a series with a moving spot on one background."""
    light = lights.draw(random)
    count = SERIES if random.random() < 0.3 else 1
    back = backgrounds[random.integers(len(backgrounds))]
    colour = random.random() < 0.5 and back.ndim == 3
    back = back.astype(float) if colour else _grey(back)
    shrink = float(random.choice([0.5, 1.0])) if min(back.shape[:2]) > 900 else 1.0
    back = cv2.resize(back, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
    w, h = min(SIZE[0], back.shape[1]), min(SIZE[1], back.shape[0])
    left, top = int(random.integers(back.shape[1] - w + 1)), int(random.integers(back.shape[0] - h + 1))
    back = back[top : top + h, left : left + w] * random.uniform(0.3, 1.0)
    noise, tint = float(random.choice([0.0, 0.6, 1.5])), np.array([[0.3, 0.4, 1.0], [0.4, 1.0, 0.4], [1.0, 1.0, 1.0]])
    bgr = tint[random.integers(3)]
    bgr = bgr / (bgr @ [0.114, 0.587, 0.299])
    half_u, half_v = light.pixels.shape[1], light.pixels.shape[0]
    u, v = int(random.integers(w - half_u - 60)), int(random.integers(h - half_v - 60))
    step, brightness, out = random.integers(3, 10, 2), np.exp(random.uniform(np.log(4.0), np.log(100.0))), []
    peak = 0.0
    for _ in range(count):
        at_u, at_v = u + light.centre[0], v + light.centre[1]
        grey = _grey(back.astype(np.float32)) if colour else back
        i, j = round(at_v), round(at_u)
        here = grey[max(i - LOCAL, 0) : i + LOCAL + 1, max(j - LOCAL, 0) : j + LOCAL + 1]
        sigma = float(np.hypot(max(here.std(), 0.3), noise))
        if not out:
            peak = min(brightness * sigma, 1.3 * (255.0 - float(np.median(here))))
        image, more = back.copy(), peak * light.pixels
        own = image[v : v + more.shape[0], u : u + more.shape[1]]
        own += more[..., None] * bgr if colour else more
        image = np.clip(np.rint(image + random.normal(0.0, 1.0, image.shape) * noise), 0, 255).astype(np.uint8)
        out.append(Picture(image, grey, (at_u, at_v), light, peak, sigma))
        u, v = u + int(step[0]), v + int(step[1])
    return out


def write_pictures(drawn: list[Picture], folder: Path, random: np.random.Generator) -> str:
    """Write pictures as PNG or JPEG; returns the kind of file."""
    quality = int(random.integers(70, 96)) if random.random() < 0.6 else 0
    for k, one in enumerate(drawn):
        name = folder / (f"{k:03d}.jpg" if quality else f"{k:03d}.png")
        cv2.imwrite(str(name), one.image, [cv2.IMWRITE_JPEG_QUALITY, quality] if quality else [])
    return f"JPEG {10 * (quality // 10)}" if quality else "PNG"


def search(folder: Path) -> list[Detections]:
    """The spots of each picture of a folder, as `beampose detect` finds them."""
    inputs = open_inputs([folder])
    series = PictureSeries(inputs.camera, str(folder), DetectParameters())
    series.estimate_noise(list(pictures_of_frames(inputs, noise_frames(inputs)).values()))
    return [series.search(frame, picture)[0] for frame, picture in pictures(inputs)]


@dataclass(frozen=True, slots=True)
class Outcome:
    """What was found, by kind of light, background and file."""

    found: dict[str, list[tuple[bool, float]]]  # whether a spot of 8 local sigmas was found, and its error in sigmas
    others: dict[str, list[float]]  # other points per megapixel of each picture
    faint: tuple[int, int]  # fainter spots: found, drawn


def measured(data: Path, pictures: int, seed: int, keep: Path | None = None) -> Outcome:
    """Draw pictures and search them. keep: folder for the pictures in which a spot was missed or misplaced."""
    random, lights = np.random.default_rng(seed), Lights(data)
    backgrounds = {
        name: [b for p in patterns for f in sorted(data.glob(p)) if (b := _read(f)) is not None]
        for name, patterns in GROUPS.items()
    }
    found: dict[str, list[tuple[bool, float]]] = defaultdict(list)
    others: dict[str, list[float]] = defaultdict(list)
    faint: Counter[bool] = Counter()
    done = 0
    while done < pictures:
        group = str(random.choice(list(GROUPS)))
        drawn = draw_pictures(backgrounds[group], lights, random)
        with tempfile.TemporaryDirectory() as name:
            file = write_pictures(drawn, Path(name), random)
            answers = search(Path(name))
            heights = [one.local_sigmas(f) for one, f in zip(drawn, sorted(Path(name).iterdir()), strict=True)]
        for one, answer, height in zip(drawn, answers, heights, strict=True):
            done += 1
            away = answer.uv_px - np.asarray(one.uv)
            near = np.hypot(*away.T)
            hit = bool(len(near)) and float(near.min()) < max(FOUND, 1.5 * one.light.width)
            others[group].append((len(near) - hit) / (one.image.shape[0] * one.image.shape[1] / 1e6))
            if height < 8.0:
                faint[hit] += 1
                continue
            k = int(np.argmin(near)) if hit else 0
            error = float(np.sqrt(away[k] @ np.linalg.solve(answer.cov_px2[k], away[k]) / 2)) if hit else np.nan
            for kind in ("all", one.light.kind, f"on {group}", file, "series" if len(drawn) > 1 else "single"):
                found[kind].append((hit, error))
            if keep is not None and (not hit or error > 3.0):
                keep.mkdir(parents=True, exist_ok=True)
                what = f"off {error:.1f}" if hit else "missed"
                name = f"{done} {what} {one.light.kind} on {group} {height:.0f} at {one.uv[0]:.1f} {one.uv[1]:.1f}.png"
                cv2.imwrite(str(keep / name), one.image)
    return Outcome(found, others, (faint[True], faint.total()))


def main() -> None:
    """Draw, search and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--pictures", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--keep", type=Path)
    given = parser.parse_args()
    outcome = measured(given.data, given.pictures, given.seed, given.keep)
    print("spots of 8 local sigmas and more; of {1} fainter ones {0} were found".format(*outcome.faint))
    print(f"{'':16}{'number':>8}{'recall':>8}{'within 3 sigma':>16}{'median sigmas':>15}")
    for kind, rows in sorted(outcome.found.items()):
        errors = np.array([e for hit, e in rows if hit])
        hits = np.mean([hit for hit, _ in rows])
        print(f"{kind:16}{len(rows):8}{hits:8.3f}{np.mean(errors < 3.0):16.3f}{np.median(errors):15.2f}")
    for group, counts in sorted(outcome.others.items()):
        print(f"other points per megapixel on {group}: mean {np.mean(counts):.1f}, median {np.median(counts):.1f}")


if __name__ == "__main__":
    main()
