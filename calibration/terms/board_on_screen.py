"""A board fixed flat to a screen, as a term of an adjustment: the two are parallel, at a known distance.

Stacks: "screens" (world_from_screen), "bow" (1/m), "boards" (world_from_board).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.least_squares.adjustment import Linearised, Loss, Part, Values
from calibration.terms.surveyed import array_of, bow_shape, pose_of, surface_heights, surface_slope
from geometry.arrays import Array, Ints, skew


@dataclass(frozen=True, slots=True)
class BoardOnScreenTerm:
    """n boards, each flat on its screen with the printed side outwards: the board's z axis points into the screen."""

    screen_of: Ints  # (n,) index into "screens" and "bow"
    placement_of: Ints  # (n,) index into "boards"
    middle: Array  # (n, 3), m, in the board's frame: the point at which the offset holds
    offset_m: Array  # (n,): height of the printed side above the screen's surface
    sigma_m: Array  # (n,): sigma of the offset
    tilt_sigma_rad: Array  # (n,): sigma of the angle between board and surface, about each axis of the board
    loss: Loss | None = None

    def linearise(self, values: Values) -> Linearised:
        """Height minus offset, and the slopes of the board's x and y axes against the surface: (n, 3), in sigmas."""
        world_from_screen = pose_of(values, "screens")[self.screen_of]
        world_from_board = pose_of(values, "boards")[self.placement_of]
        bow = array_of(values, "bow")[self.screen_of]
        screen_from_board = world_from_screen.inverse() @ world_from_board
        p = screen_from_board.apply(self.middle)
        axes = np.swapaxes(screen_from_board.rotation[..., :2], -1, -2)  # (n, 2, 3): the board's x, y
        g = surface_slope(p, bow)
        residuals = np.concatenate(
            [(surface_heights(p, bow) - self.offset_m)[:, None], (axes @ g[..., None])[..., 0]], axis=1
        )
        # p and the axes, in the screen's frame, depend on the board's pose and on the screen's.
        curve = np.zeros((*g.shape, 3))  # d(g)/d(p)
        a, b, c = np.moveaxis(bow, -1, 0)
        curve[:, 0, 0], curve[:, 0, 1], curve[:, 1, 0], curve[:, 1, 1] = -2 * a, -b, -b, -2 * c
        by_p = np.concatenate([g[:, None, :], axes @ curve], axis=1)  # (n, 3, 3)
        R_t = np.swapaxes(world_from_screen.rotation, -1, -2)
        R = screen_from_board.rotation
        by_board = np.concatenate([by_p @ R_t, -by_p @ R @ skew(self.middle)], axis=-1)
        by_screen = np.concatenate([-by_p @ R_t, by_p @ skew(p)], axis=-1)
        for k in range(2):
            # A rotation theta of the board changes its axis by R (theta x e), one of the screen by -theta x axis.

            e = np.broadcast_to(np.eye(3)[k], p.shape)
            by_board[:, 1 + k, 3:] += (-g[:, None, :] @ R @ skew(e))[:, 0]
            by_screen[:, 1 + k, 3:] += (g[:, None, :] @ skew(axes[:, k]))[:, 0]
        x, y = p[:, 0], p[:, 1]
        by_bow = np.zeros((len(p), 3, 3))
        by_bow[:, 0] = -bow_shape(p)
        for k in range(2):
            X, Y = axes[:, k, 0], axes[:, k, 1]
            by_bow[:, 1 + k] = -np.stack([2 * x * X, y * X + x * Y, 2 * y * Y], axis=-1)
        sigma = np.stack([self.sigma_m, self.tilt_sigma_rad, self.tilt_sigma_rad], axis=1)
        whiten = 1.0 / sigma[..., None]
        return Linearised(
            residuals / sigma,
            [
                Part("screens", self.screen_of, by_screen * whiten),
                Part("bow", self.screen_of, by_bow * whiten),
                Part("boards", self.placement_of, by_board * whiten),
            ],
        )
