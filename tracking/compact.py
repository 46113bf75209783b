"""Bright compact things that no Gaussian fits: burnt-out cores with rings, spots beside an edge of the screen."""

from __future__ import annotations

import numpy as np

from geometry.arrays import Array, Bools
from tracking import ellipses
from tracking.noise import NoiseModel, Picture

_OCTANTS = np.arange(8) * (np.pi / 4)
_CORE, _RING = np.array([0.4, 0.8]), np.array([2.4, 2.8, 3.2])  # sigmas of the moments' ellipse
_CENTRE_SHARE = 0.15  # of the ellipse's sigma: how far such a thing's moments may lie from the beam's centre. On the
# three burnt-out laser spots of the real pictures the moments and the middle of the core differ by 0.05 to 0.15
_STANDS_OUT = 1.5  # times the detection threshold: the second opinion of a fit is missing


def compact(
    image: Picture, uv: Array, shape: Array, noise: NoiseModel, threshold_sigma: float
) -> tuple[Bools, Array, Array]:
    """Which of the ellipses (centres (n, 2), px, covariances (n, 3), px^2) hold light that falls off on all sides.

    The core must stand out of the ring around it, and in each of eight directions by at least half as much as in
    the median one: edges, corners and ridges do not. Returns that, the covariances (n, 2, 2) of the centres, px^2,
    and the heights (n,), DN, above the ring. Ours.
    """
    height, width = image.shape
    root = np.linalg.cholesky(ellipses.matrices(ellipses.at_least(shape, 0.1)))
    circle = np.stack([np.cos(_OCTANTS), np.sin(_OCTANTS)], axis=1)
    rays = np.concatenate([_CORE, _RING])[:, None, None] * circle  # (radius, octant, 2)
    at = np.rint(uv[:, None, None, :] + np.einsum("nij,roj->nroi", root, rays)).astype(np.int64)
    inside = ((at >= 0) & (at < [width, height])).all(axis=-1)
    at = np.clip(at, 0, [width - 1, height - 1])
    values = image[at[..., 1], at[..., 0]].astype(np.float64)
    core = np.median(values[:, : len(_CORE)].reshape(len(uv), len(_CORE) * len(_OCTANTS)), axis=1)
    rings = np.median(values[:, len(_CORE) :], axis=1)
    ground = np.median(rings, axis=1)
    above = core - ground
    good = (core - rings.max(axis=1) >= 0.5 * above) & inside.all(axis=(1, 2))
    good &= above > _STANDS_OUT * threshold_sigma * np.sqrt(noise.variance(ground))
    return good, _CENTRE_SHARE**2 * ellipses.matrices(shape) + 0.01 * np.eye(2), above
