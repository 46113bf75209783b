"""Board corners and circles in photographs as a term of an adjustment: any number of cameras, boards, placements.

Stacks on which it depends:

- "intrinsics" Vectors (cameras, 18): fx, fy, cx, cy (px) and fourteen distortion coefficients in OpenCV's order;
- "cameras" Poses: camera_from_world;
- "boards" Poses: world_from_board, one per placement;
- "warp" Vectors (boards, 3), 1/m: the board's surface is z = a dx^2 + b dx dy + c dy^2 about its middle;
- "radius" Vectors (boards, 1), m, optional: radius of the board's circles, 0 for corners;
- "stretch" Vectors (boards, 2), optional: x is printed at x + e dx + s dy about the middle: rows and columns differ in
  scale by e, and their angle differs from 90 deg by s (rad);
- "print" Vectors (points, 3), m, optional: error of each point of a board.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from calibration.least_squares.adjustment import Linearised, Loss, Part, Values
from calibration.terms.corner_projection import COLUMNS, project_corners
from calibration.terms.surveyed import array_of, pose_of
from geometry import lens
from geometry.arrays import Array, Bools, Ints

_tilt = lru_cache(lens.tilt_with_derivatives)  # nearly all lenses have none
INTRINSICS_COUNT = 18  # numbers of a camera: fx, fy, cx, cy and OpenCV's fourteen distortion coefficients
_BY_BOARD = ("warp", "radius", "stretch")  # stacks with one unknown per board


@dataclass(frozen=True, slots=True)
class CornerTerm:
    """N corners, or centroids of circles; each is one observation by a camera of one placement of one board."""

    pixels: Array  # (N, 2)
    points: Array  # (N, 3), m, in the board's frame; z is 0 unless the board was surveyed
    from_middle: Array  # (N, 2), m: x and y relative to the board's middle, about which it is bent
    camera: Ints  # (N,) index into "intrinsics" and "cameras"
    placement: Ints  # (N,) index into "boards"
    board: Ints  # (N,) index of the physical board into "warp", "radius" and "stretch"
    sigma_px: Array  # (N,), of each coordinate
    fisheye: Bools  # (cameras,)
    loss: Loss | None = None
    point: Ints | None = None  # (N,) index of the board's point into "print"; None if that stack is not used
    areas_px2: Array | None = None  # (N,), of the blobs of circles; nan for corners
    fixed: frozenset[str] = frozenset()  # stacks by which no derivatives are needed

    def __len__(self) -> int:
        return len(self.pixels)

    def pick(self, rows: Bools, loss: Loss | None = None) -> CornerTerm:
        """Some of the corners, with this loss."""
        per_row = ["pixels", "points", "from_middle", "camera", "placement", "board", "sigma_px"]
        per_row += [name for name in ("point", "areas_px2") if getattr(self, name) is not None]
        return replace(self, **{name: getattr(self, name)[rows] for name in per_row}, loss=loss)

    def widened(self, scale: float) -> CornerTerm:
        """The same corners with all sigmas multiplied."""
        return replace(self, sigma_px=self.sigma_px * scale)

    def project(self, values: Values) -> Array:
        """Predicted pixels (N, 2) of the corners; nan behind the camera."""
        return self._projected(values)[0]

    def linearise(self, values: Values) -> Linearised:
        """Predicted minus measured pixels (N, 2), in sigmas, and their derivatives by all stacks."""
        pixels, J = self._projected(values)
        J /= self.sigma_px[:, None, None]
        parts = [
            Part(name, self._index(name), J[:, :, columns])
            for name, columns in COLUMNS.items()
            if name in values and name not in self.fixed
        ]
        return Linearised((pixels - self.pixels) / self.sigma_px[:, None], parts)

    def radii_by_areas(self, values: Values) -> Array:
        """Radius (boards,), m, of each board's circles; 0 without areas.

        The median of measured areas over those of circles of 1 m at the local scale of the image, with distortion.
        """
        assert self.areas_px2 is not None
        centres = {name: stack for name, stack in values.items() if name not in ("radius", "print")}
        by_place = self._projected(centres)[1][:, :, COLUMNS["print"]][:, :, :2]
        with np.errstate(invalid="ignore", divide="ignore"):
            squared = self.areas_px2 / (np.pi * np.abs(np.linalg.det(by_place)))
        out = np.zeros(len(values["warp"]))
        for board in np.unique(self.board[np.isfinite(squared)]):
            out[board] = np.sqrt(np.nanmedian(squared[self.board == board]))
        return out

    def _index(self, stack: str) -> Ints:
        """The unknown (N,) of a stack on which each corner depends."""
        if stack in _BY_BOARD:
            return self.board
        if stack == "print":
            assert self.point is not None
            return self.point
        return self.placement if stack == "boards" else self.camera

    def _projected(self, values: Values) -> tuple[Array, Array]:
        """Pixels (N, 2) and their derivatives (N, 2, 39), see COLUMNS.

        The fold of the lens model is ignored: a solve may pass through lenses that fold;
        `lens_models.folds_in_picture` checks the result.
        """
        points = self.points
        if "print" in values:
            assert self.point is not None
            points = points + array_of(values, "print")[self.point]
        lenses, boards = array_of(values, "intrinsics"), len(values["warp"])
        shapes = [
            array_of(values, name) if name in values else np.zeros((boards, size))
            for name, size in (("warp", 3), ("stretch", 2), ("radius", 1))
        ]
        cameras, placements = (
            np.concatenate([pose.rotation, pose.translation[:, :, None]], axis=2)
            for pose in (pose_of(values, "cameras"), pose_of(values, "boards"))
        )
        return project_corners(
            np.stack([self.camera, self.placement, self.board], axis=1),
            points,
            self.from_middle,
            lenses,
            np.stack([_tilt(*numbers[16:]) for numbers in lenses]),
            self.fisheye,
            cameras,
            placements,
            np.concatenate(shapes, axis=1),
        )


def single_camera(
    pixels: Array,
    points: Array,
    middle: Array,
    placement: Ints,
    sigma_px: Array | float,
    fisheye: bool,
    loss: Loss | None = None,
    point: Ints | None = None,
    areas_px2: Array | None = None,
) -> CornerTerm:
    """The N corners that one camera sees of one board; points (N, 3), m, and middle (3,), m, in the board's frame.

    placement (N,): index of each corner's placement. point (N,): index of its point on the board, required if the
    errors of the points are unknowns ("print"). areas_px2 (N,): of the blobs of circles, where they were measured.
    """
    one = np.zeros(len(pixels), dtype=np.int64)
    return CornerTerm(
        pixels=pixels,
        points=points,
        from_middle=points[:, :2] - middle[:2],
        camera=one,
        placement=placement,
        board=one,
        sigma_px=np.zeros(len(pixels)) + sigma_px,
        fisheye=np.array([fisheye]),
        loss=loss,
        point=point,
        areas_px2=areas_px2,
    )
