"""Board corners in photographs as terms of an adjustment: any number of cameras, boards and placements.

The stacks it touches: "intrinsics" Vectors (cameras, 18): fx, fy, cx, cy (px) and fourteen distortion numbers in
OpenCV's order; "cameras" Poses camera_from_world; "boards" Poses world_from_board, one per placement; "warp" Vectors
(boards, 3), 1/m: the board's surface is z = a dx^2 + b dx dy + c dy^2 about its middle.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from calibration.least_squares.adjustment import Linearised, Loss, Part, Values
from calibration.least_squares.stacks import Poses, Vectors
from geometry.arrays import Array, Bools, Ints, cross
from geometry.camera import Projected, project_points_full

S = TypeVar("S")

INTRINSICS = 18  # fx, fy, cx, cy and OpenCV's fourteen


@dataclass(frozen=True, slots=True)
class CornerTerm:
    """N corners, each seen once by one camera on one placement of one board."""

    pixels: Array  # (N, 2)
    points: Array  # (N, 3), m, in the board's frame; z is 0, or what a survey of the board gave
    from_middle: Array  # (N, 2), m: x and y from the board's middle, about which it is bent
    camera: Ints  # (N,) into "intrinsics" and "cameras"
    placement: Ints  # (N,) into "boards"
    board: Ints  # (N,) into "warp": which physical board
    sigma_px: Array  # (N,), of each coordinate
    fisheye: Bools  # (cameras,)
    loss: Loss | None = None

    def __len__(self) -> int:
        return len(self.pixels)

    def project(self, values: Values) -> Array:
        """Where the corners should be: pixels (N, 2); nan behind the camera, or where the lens model has folded."""
        return self._projected(values, *self._points(values)[1:])[0].pixels

    def linearise(self, values: Values) -> Linearised:
        """Residuals (projected less measured) (N, 2) in sigmas and derivatives; see least_squares/adjustment.py."""
        on_board, in_world, in_camera = self._points(values)
        seen, R_camera = self._projected(values, in_world, in_camera)
        boards = _stack(values, "boards", Poses).pose
        whiten = 1.0 / self.sigma_px[:, None, None]
        by_camera_point = seen.d_point * whiten
        by_world_point = by_camera_point @ R_camera
        by_board_point = by_world_point @ boards.rotation[self.placement]
        # Of R Exp(theta) x: d/dtheta = -R [x]_x; a row w of the derivative by the point gives -w [x]_x = x x w.
        by_camera = np.concatenate([by_camera_point, cross(in_world[:, None], by_world_point)], axis=2)
        by_placement = np.concatenate([by_world_point, cross(on_board[:, None], by_board_point)], axis=2)
        by_warp = by_board_point[..., 2:] * _bend(self.from_middle)[:, None]
        by_lens = np.concatenate([seen.d_pinhole, seen.d_distortion], axis=2) * whiten
        return Linearised(
            (seen.pixels - self.pixels) / self.sigma_px[:, None],
            [
                Part("intrinsics", self.camera, by_lens),
                Part("boards", self.placement, by_placement),
                Part("cameras", self.camera, by_camera),
                Part("warp", self.board, by_warp),
            ],
        )

    def _points(self, values: Values) -> tuple[Array, Array, Array]:
        """The corners (N, 3), m, on their boards, in world, and in their cameras."""
        warp = _stack(values, "warp", Vectors).array[self.board]
        boards, cameras = _stack(values, "boards", Poses).pose, _stack(values, "cameras", Poses).pose
        on_board = self.points.copy()
        on_board[:, 2] += np.sum(warp * _bend(self.from_middle), axis=1)
        in_world = boards[self.placement].apply(on_board)
        return on_board, in_world, cameras[self.camera].apply(in_world)

    def _projected(self, values: Values, in_world: Array, in_camera: Array) -> tuple[Projected, Array]:
        """Pixels with derivatives, and camera from world (N, 3, 3).

        Camera by camera, not with each point's own lens: what depends on the lens alone (the tilt of the sensor)
        is then computed once and not for each of twenty thousand corners. Where the radial model folds is not asked:
        a solve may pass through such lenses on its way; `lens_models.folds_in_picture` asks of the result.
        """
        lenses = _stack(values, "intrinsics", Vectors).array
        R = _stack(values, "cameras", Poses).pose.rotation[self.camera]
        out = Projected(
            np.empty((len(self), 2)),
            np.empty((len(self), 2, 3)),
            np.empty((len(self), 2, 4)),
            np.empty((len(self), 2, 14)),
        )
        for k in np.unique(self.camera):
            mine = self.camera == k
            wide = np.asarray(self.fisheye[k]) if self.fisheye[k] else None
            one = project_points_full(in_camera[mine], lenses[k, :4], lenses[k, 4:], np.asarray(np.inf), wide)
            out.pixels[mine], out.d_point[mine] = one.pixels, one.d_point
            out.d_pinhole[mine], out.d_distortion[mine] = one.d_pinhole, one.d_distortion
        return out, R


def single_camera(
    pixels: Array,
    points: Array,
    middle: Array,
    placement: Ints,
    sigma_px: float,
    fisheye: bool,
    loss: Loss | None = None,
) -> CornerTerm:
    """The corners (N) that one camera sees of one board; points (N, 3) and middle (3,) in the board's frame, m."""
    one = np.zeros(len(pixels), dtype=np.int64)
    return CornerTerm(
        pixels=pixels,
        points=points,
        from_middle=points[:, :2] - middle[:2],
        camera=one,
        placement=placement,
        board=one,
        sigma_px=np.full(len(pixels), sigma_px),
        fisheye=np.array([fisheye]),
        loss=loss,
    )


def _bend(from_middle: Array) -> Array:
    """What a, b and c of the warp lift a point by: (N, 3), m^2."""
    x, y = from_middle[:, 0], from_middle[:, 1]
    return np.stack([x * x, x * y, y * y], axis=1)


def _stack(values: Values, name: str, kind: type[S]) -> S:
    stack = values[name]
    if not isinstance(stack, kind):
        raise TypeError(f"the stack {name!r} holds {type(stack).__name__}, expected {kind.__name__}")
    return stack
