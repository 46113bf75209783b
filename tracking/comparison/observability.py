"""What the motion determines: which parameters of an alignment the data distinguish from noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geometry.arrays import Array, symmetric
from tracking.comparison.frame_alignment import LEVER, PARAMETERS, WORLD

_SIGNIFICANT = 4.0  # sigmas by which the motion seen by both must exceed its noise, for the clocks
_NOISE_FACTOR = 100.0  # information must exceed what noise alone feigns by this factor: a motion of ten sigmas
_LARGEST_TURN_RAD = np.deg2rad(5.0)  # sigma above which a direction of the world's rotation counts as undetermined
_LARGEST_LEVER_M = 1.0


@dataclass(frozen=True, slots=True)
class Determined:
    """A basis of the parameters that are estimated, and the directions that are not."""

    basis: Array  # (14, k): orthonormal columns
    undetermined: tuple[str, ...]  # parameters of the clocks that the motion does not show
    world_axes: Array  # (j, 3): axes, in the reference's world, about which A and B are not distinguished
    lever_axes: Array  # (j, 3): directions, in the result's body, along which the lever arm is not distinguished


@dataclass(frozen=True, slots=True)
class Information:
    """Normal equations of n residuals."""

    J: Array  # (n, 6, 14): with the result's rates
    J_reference: Array  # (n, 6, 14): with the reference's rates
    W: Array  # (n, 6, 6): weights, zero where nothing is compared
    noise: Array  # (n, 6, 6): covariance of the result in the reference's frames, as large as the residuals show


def determined(info: Information, basis: Array) -> Determined:
    """Removes from a basis (14, k) of the free parameters the directions that the data do not determine."""
    lost: list[str] = []
    for k in (1, 0):  # the rate first: it needs the offset
        column = np.eye(len(PARAMETERS))[:, k]
        if not np.any(basis[k]):
            continue
        others = _without(basis, column)
        if k == 0 and np.any(basis[1]):
            others = _without(others, np.eye(len(PARAMETERS))[:, 1])
        if not _clock_is_seen(info, column, others):
            lost.append(PARAMETERS[k])
            basis = _without(basis, column)
            if k == 0 and np.any(basis[1]):
                lost.append(PARAMETERS[1])
                basis = _without(basis, np.eye(len(PARAMETERS))[:, 1])
    W, noise = info.W, info.noise
    turn = _trace(noise[:, 3:, 3:])
    world_noise = float(np.sum(2 / 9 * (_trace(W[:, 3:, 3:]) * turn + _trace(W[:, :3, :3]) * _trace(noise[:, :3, :3]))))
    basis, world_axes = _reduced(info, basis, WORLD, world_noise, float(_LARGEST_TURN_RAD))
    lever_noise = float(np.sum(2 / 9 * _trace(W[:, :3, :3]) * turn))
    basis, lever_axes = _reduced(info, basis, LEVER, lever_noise, _LARGEST_LEVER_M)
    return Determined(basis, tuple(lost), world_axes, lever_axes)


def _clock_is_seen(info: Information, column: Array, others: Array) -> bool:
    """Whether both motions show the same rates, beyond what the other parameters explain and beyond noise."""
    rate, rate_there = info.J @ column, info.J_reference @ column
    if others.shape[1]:
        J = info.J @ others
        WJ = info.W @ J
        normal = np.einsum("nik,nil->kl", J, WJ)
        inverse = np.linalg.pinv(symmetric(normal), rcond=1e-12, hermitian=True)
        rate = rate - J @ (inverse @ np.einsum("nik,ni->k", WJ, rate))
        rate_there = rate_there - J @ (inverse @ np.einsum("nik,ni->k", WJ, rate_there))
    product = np.einsum("ni,nij,nj->n", rate, info.W, rate_there)
    total, scatter = float(product.sum()), float(np.sqrt(np.sum(product**2)))
    return total > _SIGNIFICANT * scatter > 0 and _is_larger_than_rounding(info, column, total)


def _is_larger_than_rounding(info: Information, column: Array, total: float) -> bool:
    rate = info.J @ column
    return total > 1e-9 * float(np.einsum("ni,nij,nj->", rate, info.W, rate))


def _reduced(info: Information, basis: Array, part: slice, noise: float, largest: float) -> tuple[Array, Array]:
    """The basis without the directions of one part (three parameters) that are undetermined, and these directions."""
    none = np.zeros((0, 3))
    if not np.any(basis[part]):
        return basis, none
    J = info.J @ basis
    H = symmetric(np.einsum("nik,nil->kl", J, info.W @ J))
    block = basis[part]  # (3, k)
    scale = 1 / np.sqrt(np.maximum(np.diag(H), 1e-300))
    eigenvalues, vectors = np.linalg.eigh(H * scale[:, None] * scale)
    # Covariance of the three parameters, with null directions at a relative 1e-13 of the information.
    half = (block * scale) @ (vectors / np.sqrt(np.maximum(eigenvalues, 1e-13 * eigenvalues[-1])))
    U, sigma, _ = np.linalg.svd(half, full_matrices=False)
    information = 1 / np.maximum(sigma, 1e-300) ** 2
    bad = (information < _NOISE_FACTOR * noise) | (sigma > largest)
    axes = U[:, bad].T
    for axis in axes:
        column = np.zeros(len(basis))
        column[part] = axis
        basis = _without(basis, column)
    return basis, _signed(axes)


def _signed(axes: Array) -> Array:
    """Axes (j, 3) with a positive largest component."""
    largest = np.take_along_axis(axes, np.argmax(np.abs(axes), axis=1)[:, None], axis=1) if len(axes) else axes[:, :1]
    return np.asarray(axes * np.where(largest < 0, -1.0, 1.0))


def _without(basis: Array, column: Array) -> Array:
    """An orthonormal basis of the part of a basis (m, k) that is orthogonal to a unit vector (m,)."""
    rest = basis - np.outer(column, column @ basis)
    U, sigma, _ = np.linalg.svd(rest, full_matrices=False)
    return np.asarray(U[:, sigma > 0.5])


def _trace(stack: Array) -> Array:
    return np.asarray(np.trace(stack, axis1=1, axis2=2))
