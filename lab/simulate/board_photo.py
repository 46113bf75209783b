"""Photographs of a calibration board by our own camera model, with the true positions of its points."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.boards.board_drawing import ink_at
from calibration.boards.board_types import Board
from geometry.arrays import Array, Bools, Ints
from geometry.camera import Camera
from geometry.pose import Pose

_MARGIN = 1.0  # width of the white margin around the outermost squares or circles, in spacings


@dataclass(frozen=True, slots=True)
class PhotoSettings:
    """Light, blur, noise and sampling of a photograph of a board."""

    paper_dn: float = 205.0  # paper
    ink_dn: float = 35.0  # ink
    background_dn: float = 110.0  # outside the paper
    gradient: float = 0.0  # relative decrease of the light from left to right
    blur_px: float = 0.7  # sigma of the blur of the lens, without the integration over pixels
    noise_dn: float = 0.0  # 1 sigma
    samples: int = 256  # rays per pixel; 64 displace corners of narrow squares by .01 px


@dataclass(frozen=True, slots=True)
class BoardPhoto:
    """A photograph and its truth."""

    image: NDArray[np.uint8]  # (h, w)
    ids: Ints  # (N,)
    pixels: Array  # (N, 2), true positions of the points of the board; nan where there is no projection


def warped(board: Board, warp: Array, xy: Array) -> Array:
    """Points (..., 3), m, of the bent board at (..., 2) of its frame: z = a dx^2 + b dx dy + c dy^2 about its centre.

    warp (3,): a, b, c, 1/m.
    """
    d = xy - board.middle[:2]
    z = warp[0] * d[..., 0] ** 2 + warp[1] * d[..., 0] * d[..., 1] + warp[2] * d[..., 1] ** 2
    return np.concatenate([xy, z[..., None]], axis=-1)


def photograph(
    board: Board,
    camera: Camera,
    world_from_board: Pose,
    warp: Array | None = None,
    look: PhotoSettings | None = None,
    seed: int = 0,
) -> BoardPhoto:
    """A photograph of a board at `world_from_board`, bent by `warp` (3,), 1/m."""
    bend = np.zeros(3) if warp is None else np.asarray(warp, dtype=float)
    look = PhotoSettings() if look is None else look
    width, height = camera.image_size_px
    board_xy = _board_coordinates(board, camera, world_from_board, bend)
    # The lens blurs before the pixels integrate, here in their quarters: blurred pixels displace corners by .004 px.
    light = np.full((2 * height, 2 * width), look.background_dn)
    piece = _piece_with_paper(board, board_xy)
    if piece is not None:
        rows, columns = piece
        corners = board_xy[rows.start : rows.stop + 1, columns.start : columns.stop + 1]
        within = np.s_[2 * rows.start : 2 * rows.stop, 2 * columns.start : 2 * columns.stop]
        light[within] = _light(board, _with_halves(_with_halves(corners, 0), 1), look)
    if look.blur_px > 0:
        light = np.asarray(cv2.GaussianBlur(light, (0, 0), 2 * look.blur_px, borderType=cv2.BORDER_REPLICATE))
    light = light.reshape(height, 2, width, 2).mean(axis=(1, 3))
    light *= 1 - look.gradient * np.linspace(0, 1, width)
    if look.noise_dn > 0:
        light = light + np.random.default_rng(seed).normal(0, look.noise_dn, light.shape)
    truth = camera.project(world_from_board.apply(warped(board, bend, board.points[:, :2])))
    return BoardPhoto(np.clip(np.round(light), 0, 255).astype(np.uint8), board.ids, truth)


def _board_coordinates(board: Board, camera: Camera, world_from_board: Pose, warp: Array) -> Array:
    """Intersections (h + 1, w + 1, 2), m, of the rays through the CORNERS of all pixels with the board; nan: none."""
    lens = (camera.image_size_px, np.asarray(camera.matrix, dtype=float).tobytes(), camera.distortion, camera.lens)
    board_from_camera = world_from_board.inverse() @ camera.camera_from_world.inverse()
    o, d = board_from_camera.translation, _corner_rays(*lens) @ board_from_camera.rotation.T
    middle = board.middle[:2]
    a, b, c = warp
    with np.errstate(invalid="ignore", divide="ignore"):
        t = -o[2] / d[..., 2]
        for _ in range(0 if not warp.any() else 6):  # Newton's method for the bent surface
            x, y = o[0] + t * d[..., 0] - middle[0], o[1] + t * d[..., 1] - middle[1]
            f = o[2] + t * d[..., 2] - (a * x * x + b * x * y + c * y * y)
            slope = d[..., 2] - (2 * a * x + b * y) * d[..., 0] - (b * x + 2 * c * y) * d[..., 1]
            t = t - f / slope
        xy = o[:2] + t[..., None] * d[..., :2]
    # No intersection on the back of the board or behind the camera.
    return np.where(((t > 0) & (d[..., 2] > 0))[..., None], xy, np.nan)


@lru_cache(maxsize=2)
def _corner_rays(size_px: tuple[int, int], matrix: bytes, distortion: tuple[float, ...], lens: str) -> Array:
    """Directions (h + 1, w + 1, 3) in the camera's frame through the corners of all pixels.

    Cached, since undistorting all corners takes 3 s for 1280 x 1024 pixels and many photographs share a lens.
    """
    camera = Camera("", "", size_px, np.frombuffer(matrix).reshape(3, 3), distortion, Pose.identity(), lens=lens)
    u, v = np.meshgrid(np.arange(size_px[0] + 1) - 0.5, np.arange(size_px[1] + 1) - 0.5)
    return camera.rays(np.stack([u, v], axis=-1))[1]


def _with_halves(values: Array, axis: int) -> Array:
    """Values at equal steps along an axis, and between them by the cubic of four; in the first and last step linear."""
    a = np.moveaxis(values, axis, 0)
    out = np.empty((2 * len(a) - 1, *a.shape[1:]))
    out[::2] = a
    out[1::2] = (a[:-1] + a[1:]) / 2
    out[3:-3:2] = (9 * (a[1:-2] + a[2:-1]) - a[:-3] - a[3:]) / 16
    return np.moveaxis(out, 0, axis)


def _light(board: Board, corners: Array, look: PhotoSettings) -> Array:
    """Mean shade (h, w) of quarters of pixels whose corners see the board at (h + 1, w + 1, 2).

    Rays are averaged only in quarters near which shades differ. Within one the board's coordinates are quadratic:
    bilinear ones displace the edges of a fisheye's picture by up to 1e-3 px, all towards its middle.
    """
    at_corners = _shade(board, corners, look).astype(np.float32)
    near = np.ones((4, 4), dtype=np.uint8)  # a pixel's own corners, and those of the pixels around
    high, low = cv2.dilate(at_corners, near, anchor=(1, 1)), cv2.erode(at_corners, near, anchor=(1, 1))
    out = np.asarray(at_corners[:-1, :-1], dtype=float)
    row, column = np.nonzero((high > low)[:-1, :-1])
    a, b = corners[row, column], corners[row, column + 1]
    c, d = corners[row + 1, column], corners[row + 1, column + 1]
    i, j = (np.clip(k, 1, n - 2) for k, n in zip((row, column), corners.shape, strict=False))
    bend_x = np.nan_to_num(corners[row, j + 1] - 2 * corners[row, j] + corners[row, j - 1]) / 2
    bend_y = np.nan_to_num(corners[i + 1, column] - 2 * corners[i, column] + corners[i - 1, column]) / 2
    along, down, twist = b - a - bend_x, c - a - bend_y, a - b - c + d
    total = np.zeros(len(row))
    lattice = _lattice(max(look.samples // 4, 1))
    for x, y in lattice:
        total += _shade(board, a + x * (along + x * bend_x + y * twist) + y * (down + y * bend_y), look)
    out[row, column] = total / len(lattice)
    return out


def _lattice(n: int) -> Array:
    """The centred Fibonacci lattice of n points (n, 2) in the unit square.

    No two points share an x or a y, so that edges along the rows of pixels are sampled as finely as others.
    """
    k = np.arange(n)
    rank = np.argsort(np.argsort((k * 0.6180339887498949) % 1))
    return np.stack([(k + 0.5) / n, (rank + 0.5) / n], axis=-1)


def _on_paper(board: Board, xy: Array) -> Bools:
    low = board.points[:, :2].min(axis=0) - (1 + _MARGIN) * board.spacing_m
    high = board.points[:, :2].max(axis=0) + (1 + _MARGIN) * board.spacing_m
    with np.errstate(invalid="ignore"):
        x, y = xy[..., 0], xy[..., 1]
        return (x > low[0]) & (x < high[0]) & (y > low[1]) & (y < high[1])


def _piece_with_paper(board: Board, corners: Array) -> tuple[slice, slice] | None:
    """The rows and columns of pixels that may show paper; None if there are none. corners (h + 1, w + 1, 2)."""
    rows, columns = np.nonzero(_on_paper(board, corners))
    if len(rows) == 0:
        return None
    height, width = corners.shape[0] - 1, corners.shape[1] - 1
    return (
        slice(max(int(rows.min()) - 1, 0), min(int(rows.max()) + 1, height)),
        slice(max(int(columns.min()) - 1, 0), min(int(columns.max()) + 1, width)),
    )


def _shade(board: Board, xy: Array, look: PhotoSettings) -> Array:
    paper = look.paper_dn - (look.paper_dn - look.ink_dn) * ink_at(board, xy)
    return np.where(_on_paper(board, xy), paper, look.background_dn)
