"""Prior knowledge of unknowns, from surveys, data sheets or earlier calibrations, as terms of an adjustment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from calibration.least_squares.adjustment import At, Linearised, Loss, Part, Values
from calibration.least_squares.parameter_blocks import Poses, Stack, Vectors
from geometry import rotations
from geometry.arrays import Array


@dataclass(frozen=True, slots=True)
class Prior:
    """Prior values of any unknowns of any stacks, with the joint covariance of their errors.

    Numbers with an infinite variance (on the diagonal) are not known and give no residual; neither do directions of
    zero variance, which the caller holds fixed.

    Raises:
        ValueError: the covariance does not have the size of the values.
    """

    at: tuple[At, ...]
    values: tuple[Stack, ...]  # stacks of one unknown each
    covariance: Array  # (p, p) of the errors, in that order
    loss: Loss | None = None
    _root: Array = field(init=False)  # (m, p): whitening matrix

    def __post_init__(self) -> None:
        sizes = sum(v.dof for v in self.values)
        if self.covariance.shape != (sizes, sizes):
            raise ValueError(f"prior: expected a covariance of {sizes} numbers, got shape {self.covariance.shape}")
        known = np.flatnonzero(np.isfinite(np.diagonal(self.covariance)))
        finite = self.covariance[np.ix_(known, known)]
        sigmas = np.sqrt(np.maximum(np.diagonal(finite), 0.0))
        unit = np.where(sigmas > 0, sigmas, 1.0)
        eigenvalues, vectors = np.linalg.eigh(finite / np.outer(unit, unit))
        real = eigenvalues > 1e-12
        root = np.zeros((int(real.sum()), sizes))
        root[:, known] = (vectors[:, real] / np.sqrt(eigenvalues[real])).T / unit
        object.__setattr__(self, "_root", root)

    def linearise(self, values: Values) -> Linearised:
        """One residual of m numbers."""
        deltas, parts, start = [], [], 0
        for (stack, element), known in zip(self.at, self.values, strict=True):
            one = np.array([element])
            delta = values[stack].pick(one).minus(known)[0]
            deltas.append(delta)
            J = self._root[:, start : start + known.dof] @ _minus_jacobian(known, delta)
            parts.append(Part(stack, one, J[None]))
            start += known.dof
        return Linearised((self._root @ np.concatenate(deltas))[None], parts)


@dataclass(frozen=True, slots=True)
class Anchors:
    """Independent prior values of all unknowns of a stack of vectors, with one sigma."""

    stack: str
    known: Array  # (k, d)
    sigma: float  # of each number, in its unit
    loss: Loss | None = None

    def linearise(self, values: Values) -> Linearised:
        """k residuals of d numbers."""
        now = values[self.stack]
        assert isinstance(now, Vectors)
        k, d = self.known.shape
        residuals = now.minus(Vectors(self.known)) / self.sigma
        J = np.broadcast_to(np.eye(d) / self.sigma, (k, d, d))
        return Linearised(residuals, [Part(self.stack, np.arange(k), J)])


def _minus_jacobian(known: Stack, delta: Array) -> Array:
    """d(value.minus(known)) / d(error of value) (dof, dof), at the difference delta (dof,)."""
    J = np.eye(known.dof)
    if isinstance(known, Poses):
        J[3:, 3:] = np.linalg.inv(rotations.right_jacobian(delta[3:]))
    return J


def independent(stack: str, values: Stack, sigmas: Array, first: int = 0) -> Sequence[Prior]:
    """A prior for each of k successive unknowns of a stack, from the index `first`.

    values: the k unknowns; sigmas (k, dof): inf where nothing is known.
    """

    return [
        Prior(((stack, first + i),), (values.pick(np.array([i])),), np.diag(sigmas[i] ** 2))
        for i in range(len(values))
        if np.isfinite(sigmas[i]).any()
    ]
