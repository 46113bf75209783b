"""Board corners in photographs as terms of an adjustment: any number of cameras, boards and placements.

The stacks it touches: "intrinsics" Vectors (cameras, 18): fx, fy, cx, cy (px) and fourteen distortion numbers in
OpenCV's order; "cameras" Poses camera_from_world; "boards" Poses world_from_board, one per placement; "warp" Vectors
(boards, 3), 1/m: the board's surface is z = a dx^2 + b dx dy + c dy^2 about its middle. Three more where they are
there: "radius" Vectors (boards, 1), m: of a board's circles, 0 for a board whose points are points; "stretch" Vectors
(boards, 2): x is drawn at x + e dx + s dy about the middle, so that rows and columns differ in scale by e and are not
at right angles by s; "print" Vectors (points, 3), m: by how much each point of a board lies off.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from calibration.least_squares.adjustment import Linearised, Loss, Part, Values
from calibration.least_squares.parameter_blocks import Poses, Vectors
from calibration.terms.circle_images import NODES, ON_CIRCLE, centroid
from geometry.arrays import Array, Bools, Ints, cross
from geometry.camera import Projected, project_points_full

S = TypeVar("S")

INTRINSICS = 18  # fx, fy, cx, cy and OpenCV's fourteen
_BY_BOARD = ("warp", "radius", "stretch")


@dataclass(frozen=True, slots=True)
class CornerTerm:
    """N corners, or centroids of circles, each seen once by one camera on one placement of one board."""

    pixels: Array  # (N, 2)
    points: Array  # (N, 3), m, in the board's frame; z is 0, or what a survey of the board gave
    from_middle: Array  # (N, 2), m: x and y from the board's middle, about which it is bent
    camera: Ints  # (N,) into "intrinsics" and "cameras"
    placement: Ints  # (N,) into "boards"
    board: Ints  # (N,) into "warp", "radius", "stretch": which physical board
    sigma_px: Array  # (N,), of each coordinate
    fisheye: Bools  # (cameras,)
    loss: Loss | None = None
    point: Ints | None = None  # (N,) into "print": which point of its board; None where that stack is not used

    def __len__(self) -> int:
        return len(self.pixels)

    def pick(self, rows: Bools, loss: Loss | None = None) -> CornerTerm:
        """Some of the corners, with this loss."""
        per_row = ["pixels", "points", "from_middle", "camera", "placement", "board", "sigma_px"]
        per_row += [] if self.point is None else ["point"]
        return replace(self, **{name: getattr(self, name)[rows] for name in per_row}, loss=loss)

    def widened(self, scale: float) -> CornerTerm:
        """The same corners with all sigmas multiplied."""
        return replace(self, sigma_px=self.sigma_px * scale)

    def project(self, values: Values) -> Array:
        """Where the corners should be: pixels (N, 2); nan behind the camera, or where the lens model has folded."""
        out = np.empty((len(self), 2))
        for rows, outline in self._kinds(values):
            placed = _Placed.of(self, values, rows, outline)
            seen = self._projected(values, placed)
            out[rows] = seen.pixels if outline is None else centroid(seen.pixels.reshape(-1, NODES, 2))[0]
        return out

    def linearise(self, values: Values) -> Linearised:
        """Residuals (projected less measured) (N, 2) in sigmas and derivatives; see least_squares/adjustment.py."""
        residuals = np.empty((len(self), 2))
        jacobians: dict[str, Array] = {}
        for rows, outline in self._kinds(values):
            placed = _Placed.of(self, values, rows, outline)
            seen = self._projected(values, placed)
            by = self._derivatives(values, placed, seen)
            pixels = seen.pixels
            if outline is not None:
                pixels, G = centroid(pixels.reshape(-1, NODES, 2))
                G = G.reshape(len(G), 2, 2 * NODES)
                by = {name: G @ J.reshape(len(G), 2 * NODES, -1) for name, J in by.items()}
            residuals[rows] = (pixels - self.pixels[rows]) / self.sigma_px[rows, None]
            for name, J in by.items():
                whole = jacobians.setdefault(name, np.empty((len(self), *J.shape[1:])))
                whole[rows] = J / self.sigma_px[rows, None, None]
        return Linearised(residuals, [Part(name, self._index(name), J) for name, J in jacobians.items()])

    def _index(self, stack: str) -> Ints:
        if stack in _BY_BOARD:
            return self.board
        if stack == "print":
            assert self.point is not None
            return self.point
        return self.placement if stack == "boards" else self.camera

    def _kinds(self, values: Values) -> list[tuple[Ints, Array | None]]:
        """Rows that are points with None, and rows that are circles with their radii (n,), m."""
        if "radius" not in values:
            return [(np.arange(len(self)), None)]
        radius = _stack(values, "radius", Vectors).array[self.board, 0]
        kinds = [(np.flatnonzero(radius == 0), None), (np.flatnonzero(radius != 0), radius[radius != 0])]
        return [kind for kind in kinds if len(kind[0])]

    def _derivatives(self, values: Values, placed: _Placed, seen: Projected) -> Mapping[str, Array]:
        """d(pixel) (n, 2, dof) by each stack."""
        boards, R = _stack(values, "boards", Poses).pose, _stack(values, "cameras", Poses).pose.rotation
        by_world_point = seen.d_point @ R[placed.camera]
        by_board_point = by_world_point @ boards.rotation[self.placement[placed.row]]
        # Of R Exp(theta) x: d/dtheta = -R [x]_x; a row w of the derivative by the point gives -w [x]_x = x x w.
        out = {
            "intrinsics": np.concatenate([seen.d_pinhole, seen.d_distortion], axis=2),
            "boards": np.concatenate([by_world_point, cross(placed.on_board[:, None], by_board_point)], axis=2),
            "cameras": np.concatenate([seen.d_point, cross(placed.in_world[:, None], by_world_point)], axis=2),
            "warp": by_board_point[..., 2:] * _bend(placed.from_middle)[:, None],
        }
        if "stretch" in values:
            out["stretch"] = by_board_point[..., :1] * placed.from_middle[:, None]
        if "print" in values:
            out["print"] = by_board_point
        if "radius" in values and not np.any(placed.by_radius):
            out["radius"] = np.zeros((*by_board_point.shape[:2], 1))
        elif "radius" in values:
            out["radius"] = (by_board_point @ placed.by_radius[..., None])[..., :1]
        return out

    def _projected(self, values: Values, placed: _Placed) -> Projected:
        """Pixels with derivatives.

        Camera by camera, not with each point's own lens: what depends on the lens alone (the tilt of the sensor)
        is then computed once and not for each of twenty thousand corners. Where the radial model folds is not asked:
        a solve may pass through such lenses on its way; `lens_models.folds_in_picture` asks of the result.
        """
        lenses = _stack(values, "intrinsics", Vectors).array
        n = len(placed.camera)
        out = Projected(np.empty((n, 2)), np.empty((n, 2, 3)), np.empty((n, 2, 4)), np.empty((n, 2, 14)))
        for k in np.unique(placed.camera):
            mine = placed.camera == k
            wide = np.asarray(self.fisheye[k]) if self.fisheye[k] else None
            one = project_points_full(placed.in_camera[mine], lenses[k, :4], lenses[k, 4:], np.asarray(np.inf), wide)
            out.pixels[mine], out.d_point[mine] = one.pixels, one.d_point
            out.d_pinhole[mine], out.d_distortion[mine] = one.d_pinhole, one.d_distortion
        return out


@dataclass(frozen=True, slots=True)
class _Placed:
    """Points of n corners, or NODES points on the outline of each circle in turn, in all frames."""

    row: Ints  # (n,) into the term
    camera: Ints  # (n,)
    from_middle: Array  # (n, 2), m
    on_board: Array  # (n, 3), m
    in_world: Array
    in_camera: Array
    by_radius: Array  # (n, 3): d(on_board)/d(radius), 0 for points

    @staticmethod
    def of(term: CornerTerm, values: Values, rows: Ints, radii: Array | None) -> _Placed:
        """Points of some rows of a term; radii (rows,), m: of circles, None for points."""
        step = np.zeros((len(rows), 2))
        if radii is not None:
            rows = np.repeat(rows, NODES)
            step = np.tile(ON_CIRCLE, (len(radii), 1))
            radii = np.repeat(radii, NODES)
        out_by = 0.0 if radii is None else radii[:, None]
        board, placement, camera = term.board[rows], term.placement[rows], term.camera[rows]
        warp = _stack(values, "warp", Vectors).array[board]
        stretch = _stack(values, "stretch", Vectors).array[board] if "stretch" in values else np.zeros((len(rows), 2))
        from_middle = term.from_middle[rows] + out_by * step
        on_board = term.points[rows].copy()
        on_board[:, :2] += out_by * step
        if "print" in values:
            assert term.point is not None
            on_board += _stack(values, "print", Vectors).array[term.point[rows]]
        on_board[:, 0] += np.sum(stretch * from_middle, axis=1)
        on_board[:, 2] += np.sum(warp * _bend(from_middle), axis=1)
        by_radius = np.zeros((len(rows), 3))
        if radii is not None:
            by_radius[:, :2] = step
            by_radius[:, 0] += np.sum(stretch * step, axis=1)
            by_radius[:, 2] += np.sum(warp * _bend_slope(from_middle, step), axis=1)
        in_world = _stack(values, "boards", Poses).pose[placement].apply(on_board)
        in_camera = _stack(values, "cameras", Poses).pose[camera].apply(in_world)
        return _Placed(rows, camera, from_middle, on_board, in_world, in_camera, by_radius)


def single_camera(
    pixels: Array,
    points: Array,
    middle: Array,
    placement: Ints,
    sigma_px: float,
    fisheye: bool,
    loss: Loss | None = None,
    point: Ints | None = None,
) -> CornerTerm:
    """The corners (N) that one camera sees of one board; points (N, 3) and middle (3,) in the board's frame, m.

    point (N,): which point of the board each is; needed where the points themselves are solved for.
    """
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
        point=point,
    )


def _bend(from_middle: Array) -> Array:
    """What a, b and c of the warp lift a point by: (N, 3), m^2."""
    x, y = from_middle[:, 0], from_middle[:, 1]
    return np.stack([x * x, x * y, y * y], axis=1)


def _bend_slope(from_middle: Array, step: Array) -> Array:
    """d(_bend) (N, 3), m, along directions `step` (N, 2)."""
    (x, y), (p, q) = from_middle.T, step.T
    return np.stack([2 * x * p, x * q + y * p, 2 * y * q], axis=1)


def _stack(values: Values, name: str, kind: type[S]) -> S:
    stack = values[name]
    if not isinstance(stack, kind):
        raise TypeError(f"the stack {name!r} holds {type(stack).__name__}, expected {kind.__name__}")
    return stack
