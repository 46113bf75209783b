"""The parameter blocks of a lens fit: the lens, the poses of the board and its shape."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.least_squares.adjustment import Poses, Values, Vectors
from calibration.terms.surveyed import array_of
from geometry.arrays import Array
from geometry.pose import Pose

BOARD_BLOCKS = ("warp", "stretch", "print", "radius")


@dataclass(frozen=True, slots=True)
class BoardFreedom:
    """Which parameters of the board's shape are free, besides the radius of its circles."""

    warp: bool = False  # the bend
    stretch: bool = False  # the scale along x against y, and the angle between them
    points: bool = False  # the position of every point; bend and stretch then keep their values

    def __or__(self, other: BoardFreedom) -> BoardFreedom:
        return BoardFreedom(self.warp or other.warp, self.stretch or other.stretch, self.points or other.points)


AS_STATED = BoardFreedom()


def values_of(lens: Array, camera_from_board: Pose, points: int) -> Values:
    """The parameter blocks of one camera, whose frame is the world: lens (18,), V board poses, a board of P points.

    The board is as stated; the radius 0 of circles stands for an unknown one.
    """
    return {
        "intrinsics": Vectors(np.asarray(lens, dtype=float)[None]),
        "cameras": Poses.of([Pose.identity()]),
        "boards": Poses(camera_from_board),
        **board_as_stated(points),
    }


def board_as_stated(points: int) -> Values:
    """The parameter blocks of a board with this number of points, undeformed."""
    return {
        "warp": Vectors(np.zeros((1, 3))),
        "stretch": Vectors(np.zeros((1, 2))),
        "print": Vectors(np.zeros((points, 3))),
        "radius": Vectors(np.zeros((1, 1))),
    }


def lens_of(values: Values) -> Array:
    """(18,): the parameters of the lens."""
    return array_of(values, "intrinsics")[0]
