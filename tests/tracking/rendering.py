"""Rendered pictures of spots with known truth, for tests and the benchmark. Shares no code with what it tests.

A spot is integrated over each pixel by Gauss-Legendre nodes (4 x 4 per pixel; exact to 1e-5 of the peak at sigma 0.5;
of tilted ones 2 x 2 from a sigma of 20 px on, exact to 1e-8).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import erf

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(4)


@dataclass(frozen=True)
class Spot:
    """Centre (px), peak before pixels integrate it (DN), 1-sigma axes (px), the major one's angle (deg, +u to +v)."""

    u: float
    v: float
    peak: float
    major: float = 2.0
    minor: float = 2.0
    angle: float = 0.0
    streak: float = 0.0  # px: uniform motion along `angle` during the exposure

    @property
    def flux(self) -> float:
        return 2 * np.pi * self.major * self.minor * self.peak

    def covariance(self) -> NDArray:
        """(2, 2), px^2, of the light, motion included."""
        a = np.radians(self.angle)
        R = np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
        return R @ np.diag([self.major**2 + self.streak**2 / 12, self.minor**2]) @ R.T


@dataclass(frozen=True)
class Scene:
    """Spots on a background, and the sensor."""

    spots: list[Spot]
    size: tuple[int, int] = (1280, 1024)  # width, height
    background: float = 12.0  # DN at the centre
    gradient: tuple[float, float] = (0.0, 0.0)  # DN over the width, over the height
    reflections: list[Spot] = field(default_factory=list)  # smooth, wide spots
    hot: int = 0
    gain: float = 30.0  # e-/DN
    read: float = 1.5  # DN
    speckle: float = 0.0  # contrast of a multiplicative texture with grains of 1 px sigma, on the spots


def round_lights(shape: tuple[int, int], centres: ArrayLike, peak: float, sigma_px: float) -> NDArray:
    """The sum (h, w) of equal round Gaussians at centres (n, 2), by the values at the centres of the pixels."""
    u, v = np.asarray(centres, dtype=float).reshape(-1, 2).T
    columns, rows = (
        np.exp(-0.5 * ((np.arange(count) - at[:, None]) / sigma_px) ** 2)
        for count, at in ((shape[1], u), (shape[0], v))
    )
    return peak * (rows.T @ columns)


def light(spot: Spot, size: tuple[int, int]) -> tuple[NDArray, tuple[slice, slice]]:
    """Mean values of the pixels of a spot, and their place in the picture (rows, columns)."""
    width, height = size
    reach = int(np.ceil(6 * max(spot.major, spot.minor) + spot.streak / 2 + 2))
    u0, u1 = max(int(spot.u) - reach, 0), min(int(spot.u) + reach + 1, width)
    v0, v1 = max(int(spot.v) - reach, 0), min(int(spot.v) + reach + 1, height)
    if u0 >= u1 or v0 >= v1:
        return np.zeros((0, 0)), (slice(0, 0), slice(0, 0))
    w = _WEIGHTS / 2
    if not spot.streak and (spot.major == spot.minor or spot.angle == 0.0):
        along, across = (
            np.exp(-0.5 * ((np.arange(first, last)[:, None] + _NODES / 2 - centre) / sigma) ** 2) @ w
            for first, last, centre, sigma in ((u0, u1, spot.u, spot.major), (v0, v1, spot.v, spot.minor))
        )
        return spot.peak * np.outer(across, along), (slice(v0, v1), slice(u0, u1))
    a = np.radians(spot.angle)
    nodes, weights = (_NODES, _WEIGHTS) if spot.minor < 20 else (np.array([-1.0, 1.0]) / np.sqrt(3), np.ones(2))
    uu = (np.arange(u0, u1)[:, None] + nodes / 2).reshape(-1)
    vv = (np.arange(v0, v1)[:, None] + nodes / 2).reshape(-1)
    du, dv = np.meshgrid(uu - spot.u, vv - spot.v)
    p, q = du * np.cos(a) + dv * np.sin(a), -du * np.sin(a) + dv * np.cos(a)
    if spot.streak:  # the mean over the motion in closed form
        ends = [erf((p + s * spot.streak / 2) / (np.sqrt(2) * spot.major)) for s in (1, -1)]
        total = np.sqrt(np.pi / 2) * spot.major / spot.streak * (ends[0] - ends[1])
        total *= np.exp(-0.5 * (q / spot.minor) ** 2)
    else:
        total = np.exp(-0.5 * ((p / spot.major) ** 2 + (q / spot.minor) ** 2))
    cells, w = total.reshape(v1 - v0, len(nodes), u1 - u0, len(nodes)), weights / 2
    return spot.peak * np.einsum("aibj,i,j->ab", cells, w, w), (slice(v0, v1), slice(u0, u1))


def expected(scene: Scene, rng: np.random.Generator | None = None) -> NDArray:
    """The picture without noise (h, w), DN."""
    width, height = scene.size
    gu, gv = scene.gradient
    u, v = np.linspace(-0.5, 0.5, width), np.linspace(-0.5, 0.5, height)
    picture = scene.background + gu * u[None, :] + gv * v[:, None]
    shine = np.zeros((height, width))
    for k, spot in enumerate([*scene.spots, *scene.reflections]):
        cells, where = light(spot, scene.size)
        if scene.speckle and rng is not None and cells.size and k < len(scene.spots):
            cells = cells * grains(cells.shape, scene.speckle, rng)
        shine[where] += cells
    return picture + shine


def grains(shape: tuple[int, ...], contrast: float, rng: np.random.Generator) -> NDArray:
    """Multiplicative texture (h, w) with mean 1 and this contrast."""
    x = np.arange(-4, 5)
    kernel = np.exp(-0.5 * x**2)
    noise = rng.normal(size=(shape[0] + 8, shape[1] + 8))
    noise = np.apply_along_axis(np.convolve, 0, noise, kernel, "valid")
    noise = np.apply_along_axis(np.convolve, 1, noise, kernel, "valid")
    return np.maximum(1 + contrast * noise / np.sum(kernel**2), 0.0)


def photograph(scene: Scene, rng: np.random.Generator, bits: int = 8) -> NDArray:
    """The picture as a camera records it, uint8 or uint16."""
    return expose(expected(scene, rng), scene, rng, bits)


def expose(mean: NDArray, scene: Scene, rng: np.random.Generator, bits: int = 8) -> NDArray:
    """An expected picture (h, w), DN, with shot noise, read noise, hot pixels, rounding and clipping."""
    electrons = rng.normal(mean, np.sqrt(np.maximum(mean, 0) / scene.gain))
    picture = rng.normal(electrons, scene.read)
    for _ in range(scene.hot):
        picture[rng.integers(picture.shape[0]), rng.integers(picture.shape[1])] += rng.uniform(40, 200)
    top = 2**bits - 1
    return np.clip(np.rint(picture), 0, top).astype(np.uint8 if bits == 8 else np.uint16)


def bound(spot: Spot, scene: Scene, mean: NDArray, saturation: float = np.inf, step: float = 1e-3) -> NDArray:
    """Cramer-Rao bound (2, 2), px^2, of the centre with unknown flux, shape and background plane, and known noise.

    `mean` is expected(scene). Numerical derivatives of the rendered spot; variance per pixel = level/gain + read^2 +
    1/12; pixels whose expected value is saturated give no information.
    """
    base, where = light(spot, scene.size)
    level = mean[where]
    variance = np.maximum(level, 0) / scene.gain + scene.read**2 + 1 / 12
    weight = np.where(level < saturation, 1 / variance, 0.0)

    def spot_with(**change: float) -> NDArray:
        wider = Spot(**{**spot.__dict__, **{k: getattr(spot, k) + d for k, d in change.items()}})
        cells, there = light(wider, scene.size)
        whole = np.zeros((scene.size[1], scene.size[0]))
        whole[there] = cells
        return whole[where]

    rows = [(spot_with(**{k: step}) - spot_with(**{k: -step})) / (2 * step) for k in ("u", "v", "major", "minor")]
    a = np.radians(spot.angle)
    vv, uu = np.mgrid[where]
    p = (uu - spot.u) * np.cos(a) + (vv - spot.v) * np.sin(a)
    q = -(uu - spot.u) * np.sin(a) + (vv - spot.v) * np.cos(a)
    rows += [base * p * q, base, np.ones_like(base), uu - spot.u, vv - spot.v]
    J = np.stack([r.reshape(-1) for r in rows])
    d = np.sqrt(np.einsum("kp,p,kp->k", J, weight.reshape(-1), J)) + 1e-300
    J = J / d[:, None]
    N = (J * weight.reshape(-1)) @ J.T
    return (np.linalg.pinv(N, hermitian=True) / np.outer(d, d))[:2, :2]
