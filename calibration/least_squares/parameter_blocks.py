"""The unknowns of a calibration: stacks of vectors, of transforms and of lines, with their small errors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np

from geometry.arrays import Array, Ints, normalised
from geometry.pose import Pose

S = TypeVar("S", bound="Stack")


class Stack(Protocol):
    """k unknowns of one kind. The error of an unknown is a vector of `dof` numbers."""

    @property
    def dof(self) -> int:
        """Size of the error vector of one unknown."""

    def __len__(self) -> int: ...

    def plus(self: S, delta: Array) -> S:
        """The stack with its unknowns changed by delta (k, dof)."""

    def minus(self: S, other: S) -> Array:
        """The delta (k, dof) with other.plus(delta) = self; for lines to first order."""

    def pick(self: S, index: Ints) -> S:
        """Some of the unknowns."""


@dataclass(frozen=True, slots=True)
class Vectors:
    """Vectors: lens parameters, bows, points."""

    array: Array  # (k, d)

    @property
    def dof(self) -> int:
        return self.array.shape[1]

    def __len__(self) -> int:
        return len(self.array)

    def plus(self, delta: Array) -> Vectors:
        return Vectors(self.array + delta)

    def minus(self, other: Vectors) -> Array:
        return self.array - other.array

    def pick(self, index: Ints) -> Vectors:
        return Vectors(self.array[index])


@dataclass(frozen=True, slots=True)
class Poses:
    """Transforms a_from_b with the error [dt (m, in a), dtheta (rad, in b)] of section 1 of the file contract."""

    pose: Pose  # a stack of k

    @property
    def dof(self) -> int:
        return 6

    def __len__(self) -> int:
        return len(self.pose.translation)

    def plus(self, delta: Array) -> Poses:
        return Poses(self.pose.plus(delta))

    def minus(self, other: Poses) -> Array:
        return self.pose.minus(other.pose)

    def pick(self, index: Ints) -> Poses:
        return Poses(self.pose[index])

    @staticmethod
    def of(poses: list[Pose]) -> Poses:
        """A stack of single transforms."""
        rotation = np.array([p.rotation for p in poses], dtype=float).reshape(-1, 3, 3)
        return Poses(Pose(rotation, np.array([p.translation for p in poses], dtype=float).reshape(-1, 3)))


@dataclass(frozen=True, slots=True)
class Lines:
    """Lines in space, each a point and a unit direction, with four degrees of freedom.

    The error is [change of the direction (2, rad), change of the point (2, m)], both perpendicular to the line, along
    the two axes of `basis`. A shift of the point along the line has no effect and is not an error.
    """

    points: Array  # (k, 3), m
    directions: Array  # (k, 3), unit

    @property
    def dof(self) -> int:
        return 4

    def __len__(self) -> int:
        return len(self.points)

    @property
    def basis(self) -> Array:
        """Two unit vectors perpendicular to each line, (k, 3, 2); a function of the direction alone."""
        # The coordinate axis farthest from the line gives the best conditioned cross product.
        least = np.eye(3)[np.argmin(np.abs(self.directions), axis=1)]
        first = normalised(np.cross(self.directions, least))
        return np.stack([first, np.cross(self.directions, first)], axis=-1)

    def plus(self, delta: Array) -> Lines:
        B = self.basis
        turned = self.directions + (B @ delta[:, :2, None])[..., 0]
        return Lines(self.points + (B @ delta[:, 2:, None])[..., 0], normalised(turned))

    def minus(self, other: Lines) -> Array:
        # The points that represent the lines are arbitrary, so the point opposite the other line's point is compared.
        shift = self.points - other.points
        along = np.sum(shift * other.directions, axis=1) / np.sum(self.directions * other.directions, axis=1)
        shift = shift - along[:, None] * self.directions
        turn = self.directions / np.sum(self.directions * other.directions, axis=1)[:, None]
        return np.concatenate([(v[:, None, :] @ other.basis)[:, 0] for v in (turn, shift)], axis=1)

    def pick(self, index: Ints) -> Lines:
        return Lines(self.points[index], self.directions[index])
