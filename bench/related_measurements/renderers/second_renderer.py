"""A second renderer of circles and drogues, for checks: written from the question alone, without the code of studies/.

Pictures are 8-bit grey; pixel centres have whole coordinates. The target is drawn with 4 x 4 samples per pixel, the
probe with its distance to a rod; everything is blurred and gets white noise afterwards.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from geometry.arrays import Array

SIZE = (640, 480)
BLUR_PX, NOISE_DN = 1.0, 3.0
BACKGROUNDS = ("sky", "cloud", "ground", "trees", "water")
KINDS = ("plain", "ribbed", "textured", "thin", "drogue")
THIN = 0.035  # width of the thin rim, in radii
OPENING = 0.72  # radius of its opening, in radii
HUB = 0.35  # radius of the middle of a ribbed target, in radii
_SAMPLES = 4


def field(rng: np.random.Generator, size: tuple[int, int], coarse_px: float, fine_px: float, slope: float) -> Array:
    """Random field (height, width) of mean 0 and sigma 1; its octaves lose `slope` of their amplitude per halving."""
    out = np.zeros(size[::-1])
    cell, weight = coarse_px, 1.0
    while cell >= fine_px:
        small = rng.normal(size=(max(int(size[1] / cell), 1) + 3, max(int(size[0] / cell), 1) + 3))
        out += weight * cv2.resize(small, size, interpolation=cv2.INTER_CUBIC)
        cell, weight = cell / 2, weight * slope
    return np.asarray((out - out.mean()) / out.std())


def background(kind: str, rng: np.random.Generator, size: tuple[int, int] = SIZE) -> Array:
    """A scene without a target (height, width), DN."""
    y = np.linspace(0, 1, size[1])[:, None]
    if kind == "sky":
        return np.asarray(np.broadcast_to(rng.uniform(90, 150) + rng.uniform(10, 50) * y, size[::-1]).copy())
    if kind == "cloud":
        mass = field(rng, size, rng.uniform(120, 300), 4, rng.uniform(0.45, 0.65))
        return np.asarray(110 + 25 * y + rng.uniform(60, 100) / (1 + np.exp(-rng.uniform(1.5, 6) * mass)))
    if kind == "water":
        x = np.arange(size[0])[None, :]
        waves = field(rng, (size[0] // 3, size[1]), 24, 2, 0.8)
        long = np.asarray(cv2.resize(waves, size, interpolation=cv2.INTER_CUBIC))
        glitter = 70.0 * (long > 2.0 + 0.004 * np.abs(x - size[0] / 2))
        return np.asarray(80 + 30 * y + 12 * long + cv2.GaussianBlur(glitter, (0, 0), 0.7))
    if kind == "ground":
        return _ground(rng, size)
    return _trees(rng, size)


def _ground(rng: np.random.Generator, size: tuple[int, int]) -> Array:
    """Fields of different grey with roads, houses and a fine texture."""
    sites = rng.uniform(0, 1, (40, 2)) * size
    grid = np.stack(np.meshgrid(np.arange(size[0]), np.arange(size[1])), axis=-1).astype(float)
    nearest = np.argmin(((grid[:, :, None] - sites) ** 2).sum(-1), axis=-1)
    out = rng.uniform(60, 170, len(sites))[nearest] + 6 * field(rng, size, 40, 2, 0.9)
    for _ in range(6):
        a, b = (rng.uniform(-0.2, 1.2, 2) * size for _ in range(2))
        cv2.line(out, a.astype(int).tolist(), b.astype(int).tolist(), rng.uniform(50, 220), int(rng.integers(2, 9)))
    for _ in range(120):
        box = cv2.boxPoints((rng.uniform(0, 1, 2) * size, rng.uniform(4, 22, 2), rng.uniform(0, 90)))
        cv2.fillConvexPoly(out, box.astype(np.int32), rng.uniform(50, 230))
    return out


def _trees(rng: np.random.Generator, size: tuple[int, int]) -> Array:
    """Crowns from above: clumps of leaves, lit from one side, with shadows between them."""
    out = 70 + 10 * field(rng, size, 60, 3, 0.8)
    for _ in range(rng.integers(300, 700)):
        centre, radius = rng.uniform(0, 1, 2) * size, rng.uniform(4, 18)
        grey = rng.uniform(60, 130)
        for _ in range(rng.integers(6, 14)):
            at = centre + rng.normal(0, 0.45 * radius, 2)
            light = 25 * float(np.dot(at - centre, (-0.7, -0.7))) / radius
            turns = np.sort(rng.uniform(0, 2 * np.pi, 9))
            reach = rng.uniform(0.2, 0.65, 9) * radius + 1
            outline = at + reach[:, None] * np.stack([np.cos(turns), np.sin(turns)], axis=1)
            cv2.fillPoly(out, [np.rint(outline).astype(np.int32)], grey + light)
    return np.asarray(out + 8 * field(rng, size, 8, 2, 0.9))


@dataclass(frozen=True, slots=True)
class Face:
    """What a target looks like, in units of its radius."""

    kind: str
    bright: float  # DN
    shade: float
    ribs: int
    turn: float  # rad
    light: tuple[float, float]  # side light: share, and direction, rad
    hose: float | None  # direction of the hose, rad; None: none
    texture: Array  # (n, n) over the square around the disc, mean 0, sigma 1

    def sample(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Grey and opacity at places in units of the radius."""
        rho, theta = np.hypot(x, y), np.arctan2(y, x) + self.turn
        inside = (rho <= 1).astype(float)
        if self.kind == "thin":
            ring = (rho > 1 - THIN) & (rho <= 1)
            return np.where(rho <= OPENING, self.shade + 25, np.where(ring, self.shade, self.bright)), inside
        grey = np.full(x.shape, self.bright)
        rib = np.cos(self.ribs * theta)
        if self.kind == "ribbed":
            grey = np.where(rib > 0, self.bright, 0.55 * self.bright + 0.45 * self.shade)
            grey = np.where(rho < HUB, self.shade, grey)
        elif self.kind == "textured":
            n = len(self.texture) - 1
            place = [np.asarray((c + 1.05) / 2.1 * n, np.float32) for c in (x, y)]
            grey = grey + 22 * cv2.remap(self.texture.astype(np.float32), *place, cv2.INTER_LINEAR)
        elif self.kind == "drogue":
            grey = np.where(rib > -0.3, self.bright, 0.75 * self.bright + 0.25 * self.shade)
            struts = np.where(rib > 0.75, 0.5 * self.bright + 0.5 * self.shade, self.shade)
            grey = np.where(rho < 0.68, struts, grey)
            grey = np.where(rho < 0.2, 0.8 * self.bright, grey)
        share, towards = self.light
        return grey * (1 + share * (x * np.cos(towards) + y * np.sin(towards))), inside


def face(kind: str, rng: np.random.Generator, hose: bool = False) -> Face:
    """A random target of a kind."""
    texture = field(rng, (64, 64), rng.uniform(8, 24), 3, 0.7)
    light = (rng.uniform(0.05, 0.3) if kind == "drogue" else 0.0, rng.uniform(0, 2 * np.pi))
    bright = rng.uniform(185, 225) if rng.random() < 0.7 or kind in ("drogue", "thin") else rng.uniform(25, 50)
    shade = rng.uniform(30, 60) if bright > 100 else 120.0
    along = rng.uniform(-2.2, -0.9) if hose else None
    return Face(kind, bright, shade, int(rng.integers(8, 25)), rng.uniform(0, 6), light, along, texture)


@dataclass(frozen=True, slots=True)
class Probe:
    """A rod with a round tip from outside, in units of the target's radius, and how far it has come."""

    direction: float  # rad, from the target's centre to where it comes from
    half_width: float
    aside: float  # of its axis from the centre
    grey: float
    tip: float = 3.0  # distance of its tip from the centre, along `direction`; it falls as the probe moves in

    def distance(self, x: Array, y: Array) -> Array:
        """Signed distance of places from the outline, negative inside."""
        c, s = np.cos(self.direction), np.sin(self.direction)
        along, across = c * x + s * y, -s * x + c * y - self.aside
        return np.asarray(np.hypot(np.minimum(along - self.tip - self.half_width, 0), across) - self.half_width)

    def share(self, part: float = 1.0) -> float:
        """Covered share of the area of the disc, or of the disc inside the share `part` of the radius."""
        x, y = _DISC
        return float(np.mean(self.distance(part * x, part * y) < 0))

    def covering(self, share: float) -> Probe:
        """The probe where it covers a share of the disc."""
        low, high = -3.0, 3.0
        for _ in range(30):
            middle = 0.5 * (low + high)
            low, high = (low, middle) if replace(self, tip=middle).share() < share else (middle, high)
        return replace(self, tip=low)


_AXIS = np.linspace(-1, 1, 201)
_DISC = tuple(c[np.hypot(*np.meshgrid(_AXIS, _AXIS)) <= 1] for c in np.meshgrid(_AXIS, _AXIS))


def probe(rng: np.random.Generator, most: float) -> Probe:
    """A random probe wide enough to cover the share `most`."""
    while True:
        made = Probe(rng.uniform(0, 2 * np.pi), rng.uniform(0.12, 0.9), rng.uniform(-0.3, 0.3), rng.uniform(20, 235))
        if replace(made, tip=-3.0).share() > 1.05 * most and made.half_width < 0.2 + most:
            return made


def draw(
    scene: Array,
    look: Face | None,
    u_px: float,
    v_px: float,
    radius_px: float,
    rng: np.random.Generator,
    rod: Probe | None = None,
) -> NDArray[np.uint8]:
    """One picture of a target, or of the scene alone."""  # fmt: skip
    out = scene.copy()
    if look is not None:
        if look.hose is not None:
            end = np.array([u_px, v_px]) + 900 * np.array([np.cos(look.hose), np.sin(look.hose)])
            line = [np.rint(16 * np.array(p)).astype(int).tolist() for p in ((u_px, v_px), end)]
            cv2.line(out, *line, 0.6 * look.shade, max(round(0.07 * radius_px), 1), cv2.LINE_8, 4)
        _compose(out, look, u_px, v_px, radius_px)
    if rod is not None:
        y, x = np.mgrid[: out.shape[0], : out.shape[1]].astype(float)
        away = radius_px * rod.distance((x - u_px) / radius_px, (y - v_px) / radius_px)
        opaque = np.clip(0.5 - away, 0, 1)
        out = out * (1 - opaque) + rod.grey * opaque
    seen = cv2.GaussianBlur(out, (0, 0), BLUR_PX) + rng.normal(0, NOISE_DN, out.shape)
    return np.clip(np.rint(seen), 0, 255).astype(np.uint8)


def _compose(out: Array, look: Face, u: float, v: float, radius: float) -> None:
    """Draw a target into the picture, in place."""
    top, left = max(int(v - radius) - 2, 0), max(int(u - radius) - 2, 0)
    bottom, right = min(int(v + radius) + 3, out.shape[0]), min(int(u + radius) + 3, out.shape[1])
    if bottom <= top or right <= left:
        return
    rows, columns = (bottom - top), (right - left)
    sub = (np.arange(_SAMPLES) + 0.5) / _SAMPLES - 0.5
    y = ((top + np.arange(rows))[:, None] + sub).ravel() - v
    x = ((left + np.arange(columns))[:, None] + sub).ravel() - u
    grey, opaque = look.sample(*np.broadcast_arrays((x / radius)[None, :], (y / radius)[:, None]))
    blocks = (rows, _SAMPLES, columns, _SAMPLES)
    cover = opaque.reshape(blocks).mean((1, 3))
    light = (grey * opaque).reshape(blocks).mean((1, 3))
    part = out[top:bottom, left:right]
    part[:] = part * (1 - cover) + light
