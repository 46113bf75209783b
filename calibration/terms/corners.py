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

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from calibration.least_squares.adjustment import Linearised, Loss, Part, Values
from calibration.terms.surveyed import array_of, bow_shape, bow_slope, pose_of
from geometry.arrays import Array, Bools, Ints, cross
from geometry.camera import Projected, project_points_full

# The centroid of the image of a circle, from images of points on its outline.
#
# The centroid of a blob is not the image of the circle's centre: perspective and distortion enlarge the nearer half.
# For a circle of 7 mm at 0.5 m under 45 deg the two differ by 0.1 to 0.3 px, in the same direction for all circles.
# Area and centroid follow from the outline by Green's theorem; the tangent is the derivative of the trigonometric
# polynomial through the nodes. Source: Heikkila (2000), "Geometric camera calibration using circular control points",
# IEEE Trans. PAMI 22, for the effect under perspective; the nodes on the outline, which work with any lens model, are
# ours.

# The images of circles contain harmonics 1 and 2 of the angle, the second a hundredth of the first. Products of three
# of them that six nodes cannot distinguish from a constant are below 1e-5 px. With five nodes errors reach 1e-3 px.
NODES = 6
_ANGLE = 2 * np.pi * np.arange(NODES) / NODES
ON_CIRCLE = np.stack([np.cos(_ANGLE), np.sin(_ANGLE)], axis=1)  # (NODES, 2): of radius 1


def _derivative_matrix(n: int) -> Array:
    """Matrix (n, n) from values at n (even) nodes to the derivatives of the trigonometric polynomial through them."""
    j = np.arange(n)
    steps = j[:, None] - j[None, :]
    with np.errstate(divide="ignore"):
        D = 0.5 * (-1.0) ** steps / np.tan(np.pi * steps / n)
    D[steps == 0] = 0.0
    return np.asarray(D, dtype=float)


_D = _derivative_matrix(NODES)
_W = 2 * np.pi / NODES


def centroid(outline: Array) -> tuple[Array, Array]:
    """Centroids (n, 2) of the areas within outlines (n, NODES, 2), and their derivatives by the nodes (n, 2, NODES, 2).

    The nodes are the images of ON_CIRCLE, in that order. nan where a node is nan.
    """
    middle = np.full(NODES, 1 / NODES) @ outline
    x, y = np.moveaxis(outline - middle[:, None], -1, 0)  # (n, NODES)
    dx, dy = x @ _D.T, y @ _D.T
    area = _W * np.einsum("ij,ij->i", x, dy)
    with np.errstate(invalid="ignore", divide="ignore"):
        cx = 0.5 * _W * np.einsum("ij,ij,ij->i", x, x, dy) / area
        cy = -0.5 * _W * np.einsum("ij,ij,ij->i", y, y, dx) / area
        G = np.empty((len(outline), 2, NODES, 2))
        share = (_W / area)[:, None]
        G[:, 0, :, 0] = share * (x - cx[:, None]) * dy
        G[:, 0, :, 1] = share * (-0.5 * (x * x) @ _D.T + cx[:, None] * dx)
        G[:, 1, :, 0] = share * (0.5 * (y * y) @ _D.T - cy[:, None] * dy)
        G[:, 1, :, 1] = share * (cy[:, None] - y) * dx
    return middle + np.stack([cx, cy], axis=1), G


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
        out = np.empty((len(self), 2))
        for rows, outline in self._kinds(values):
            pixels = self._projected(values, _Placed.of(self, values, rows, outline)).pixels
            out[rows] = pixels[:, 0] if outline is None else centroid(pixels)[0]
        return out

    def linearise(self, values: Values) -> Linearised:
        """Predicted minus measured pixels (N, 2), in sigmas, and their derivatives by all stacks."""
        residuals = np.empty((len(self), 2))
        jacobians: dict[str, Array] = {}
        for rows, outline in self._kinds(values):
            placed = _Placed.of(self, values, rows, outline)
            projected = self._projected(values, placed)
            by = self._derivatives(values, placed, projected)
            if outline is None:
                pixels, by = projected.pixels[:, 0], {name: J[:, 0] for name, J in by.items()}
            else:
                pixels, G = centroid(projected.pixels)
                G = G.reshape(len(G), 2, 2 * NODES)
                by = {name: G @ J.reshape(len(G), 2 * NODES, -1) for name, J in by.items()}
            residuals[rows] = (pixels - self.pixels[rows]) / self.sigma_px[rows, None]
            for name, J in by.items():
                whole = jacobians.setdefault(name, np.empty((len(self), *J.shape[1:])))
                whole[rows] = J / self.sigma_px[rows, None, None]
        return Linearised(residuals, [Part(name, self._index(name), J) for name, J in jacobians.items()])

    def radii_by_areas(self, values: Values) -> Array:
        """Radius (boards,), m, of each board's circles; 0 without areas.

        The median of measured areas over those of circles of 1 m at the local scale of the image, with distortion.
        """
        assert self.areas_px2 is not None
        centres = {name: stack for name, stack in values.items() if name not in ("radius", "print")}
        placed = _Placed.of(self, centres, np.s_[:], None)
        by_place = placed.turned(self._projected(centres, placed).d_point)[1][:, 0, :, :2]
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

    def _kinds(self, values: Values) -> list[tuple[Ints | slice, Array | None]]:
        """The rows that are corners, with None, and the rows that are circles, with their radii (n,), m."""
        radius = array_of(values, "radius")[self.board, 0] if "radius" in values else np.zeros(len(self))
        if radius.all() or not radius.any():
            return [(np.s_[:], radius if radius.any() else None)]
        return [(np.flatnonzero(radius == 0), None), (np.flatnonzero(radius != 0), radius[radius != 0])]

    def _derivatives(self, values: Values, placed: _Placed, projected: Projected) -> Mapping[str, Array]:
        """Derivatives (n, k, 2, dof) of the pixels by each stack."""
        by_world_point, by_board_point = placed.turned(projected.d_point)
        # d(R Exp(theta) x)/dtheta = -R [x]_x; with a row w of the derivative by the point: -w [x]_x = x cross w.
        out: dict[str, Callable[[], Array]] = {
            "intrinsics": lambda: np.concatenate([projected.d_pinhole, projected.d_distortion], axis=-1),
            "boards": lambda: np.concatenate(
                [by_world_point, cross(placed.on_board[:, :, None], by_board_point)], axis=-1
            ),
            "cameras": lambda: np.concatenate(
                [projected.d_point, cross(placed.in_world[:, :, None], by_world_point)], axis=-1
            ),
            "warp": lambda: by_board_point[..., 2:] * bow_shape(placed.from_middle)[:, :, None],
            "stretch": lambda: by_board_point[..., :1] * placed.from_middle[:, :, None],
            "print": lambda: by_board_point,
            "radius": lambda: (by_board_point @ placed.by_radius[..., None])[..., :1],
        }
        return {name: by() for name, by in out.items() if name in values and name not in self.fixed}

    def _projected(self, values: Values, placed: _Placed) -> Projected:
        """Pixels (n, k, 2) with derivatives.

        The cameras are processed one by one, so that what depends on the lens alone (the tilt of the sensor) is
        computed once per camera and not once for each of, say, twenty thousand corners. The fold of the lens model is
        ignored: a solve may pass through lenses that fold; `lens_models.folds_in_picture` checks the result.
        """
        lenses = array_of(values, "intrinsics")

        def by_camera(k: int, points: Array) -> Projected:
            wide = np.asarray(self.fisheye[k])
            return project_points_full(points, lenses[k, :4], lenses[k, 4:], np.asarray(np.inf), wide)

        if len(lenses) == 1:
            return by_camera(0, placed.in_camera)
        n = placed.in_camera.shape[:2]
        out = Projected(np.empty((*n, 2)), np.empty((*n, 2, 3)), np.empty((*n, 2, 4)), np.empty((*n, 2, 14)))
        for k in np.unique(placed.camera):
            of_camera = placed.camera == k
            one = by_camera(k, placed.in_camera[of_camera])
            out.pixels[of_camera], out.d_point[of_camera] = one.pixels, one.d_point
            out.d_pinhole[of_camera], out.d_distortion[of_camera] = one.d_pinhole, one.d_distortion
        return out


@dataclass(frozen=True, slots=True)
class _Placed:
    """The points of n corners in all frames (k = 1), or k = NODES points on the outline of each of n circles."""

    camera: Ints  # (n,)
    from_middle: Array  # (n, k, 2), m
    on_board: Array  # (n, k, 3), m
    in_world: Array  # (n, k, 3), m
    in_camera: Array  # (n, k, 3), m
    by_radius: Array  # (n, k, 3): d(on_board)/d(radius), 0 for corners
    camera_from_world: Array  # (n, 3, 3), the rotation
    world_from_board: Array  # (n, 3, 3), the rotation

    @staticmethod
    def of(term: CornerTerm, values: Values, rows: Ints | slice, radii: Array | None) -> _Placed:
        """The points of some rows of a term; radii (rows,), m, of circles, None for corners."""
        board, placement, camera = term.board[rows], term.placement[rows], term.camera[rows]
        step = np.zeros((1, 2)) if radii is None else ON_CIRCLE
        offset = (np.zeros(1) if radii is None else radii)[:, None, None] * step
        from_middle = term.from_middle[rows, None] + offset
        on_board = term.points[rows, None].repeat(len(step), axis=1)
        on_board[..., :2] += offset
        if "print" in values:
            assert term.point is not None
            on_board += array_of(values, "print")[term.point[rows], None]
        stretch = array_of(values, "stretch")[board, None] if "stretch" in values else np.zeros((1, 1, 2))
        warp = array_of(values, "warp")[board, :, None]
        on_board[..., 0] += stretch[..., 0] * from_middle[..., 0] + stretch[..., 1] * from_middle[..., 1]
        on_board[..., 2] += (bow_shape(from_middle) @ warp)[..., 0]
        by_radius = np.zeros(on_board.shape)
        if radii is not None:
            by_radius[..., :2] = step
            by_radius[..., 0] += stretch[..., 0] * step[:, 0] + stretch[..., 1] * step[:, 1]
            by_radius[..., 2] += (bow_slope(from_middle, step) @ warp)[..., 0]
        boards, cameras = pose_of(values, "boards")[placement], pose_of(values, "cameras")[camera]
        in_world = on_board @ np.swapaxes(boards.rotation, 1, 2) + boards.translation[:, None]
        in_camera = in_world @ np.swapaxes(cameras.rotation, 1, 2) + cameras.translation[:, None]
        return _Placed(
            camera, from_middle, on_board, in_world, in_camera, by_radius, cameras.rotation, boards.rotation
        )  # fmt: skip

    def turned(self, d_point: Array) -> tuple[Array, Array]:
        """Derivatives (n, k, 2, 3) of pixels by points in the world and on the board, from those in the camera."""
        by_world = d_point.reshape(len(d_point), -1, 3) @ self.camera_from_world
        return by_world.reshape(d_point.shape), (by_world @ self.world_from_board).reshape(d_point.shape)


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
