"""The kinds of unknowns of a calibration: stacks of vectors, of transforms, of lines, each with its small errors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np

from geometry.arrays import Array, Ints, normalised
from geometry.pose import Pose

S = TypeVar("S", bound="Stack")


class Stack(Protocol):
    """k unknowns of one kind; an error of one of them is a vector of `dof` numbers."""

    @property
    def dof(self) -> int:
        """How many numbers the error of one unknown has."""

    def __len__(self) -> int: ...

    def plus(self: S, delta: Array) -> S:
        """The stack with each unknown moved by delta (k, dof)."""

    def minus(self: S, other: S) -> Array:
        """The delta (k, dof) with other.plus(delta) = self; exact to first order for lines."""

    def pick(self: S, index: Ints) -> S:
        """Some of the unknowns."""


@dataclass(frozen=True, slots=True)
class Vectors:
    """Plain vectors: lenses, bows, points."""

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
    """Transforms a_from_b with the error [dt (m, in a), dtheta (rad, in b)] of section 1 of the files' contract."""

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
        """From single transforms."""
        rotation = np.array([p.rotation for p in poses], dtype=float).reshape(-1, 3, 3)
        return Poses(Pose(rotation, np.array([p.translation for p in poses], dtype=float).reshape(-1, 3)))


@dataclass(frozen=True, slots=True)
class Lines:
    """Lines in space: a point and a unit direction each, with the four errors that a line has.

    The error is [change of the direction (2, rad), change of the point (2, m)], both across the line, along the two
    axes of `basis`. What would move the point along the line is left out: it does nothing.
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
        """(k, 3, 2): two unit vectors across each line, the same ones for the same direction."""
        # The axis that lies least along the line makes the best conditioned cross product.
        least = np.eye(3)[np.argmin(np.abs(self.directions), axis=1)]
        first = normalised(np.cross(self.directions, least))
        return np.stack([first, np.cross(self.directions, first)], axis=-1)

    def plus(self, delta: Array) -> Lines:
        B = self.basis
        turned = self.directions + (B @ delta[:, :2, None])[..., 0]
        return Lines(self.points + (B @ delta[:, 2:, None])[..., 0], normalised(turned))

    def minus(self, other: Lines) -> Array:
        # A line has no point of its own: the one across from the other's point is compared.
        away = self.points - other.points
        along = np.sum(away * other.directions, axis=1) / np.sum(self.directions * other.directions, axis=1)
        away = away - along[:, None] * self.directions
        turn = self.directions / np.sum(self.directions * other.directions, axis=1)[:, None]
        return np.concatenate([(v[:, None, :] @ other.basis)[:, 0] for v in (turn, away)], axis=1)

    def pick(self, index: Ints) -> Lines:
        return Lines(self.points[index], self.directions[index])
