"""Detection of grids of circles: centres and areas of the ellipses in the picture.

A centre is the centroid of the blob, not the image of the circle's centre. The two differ by tenths of a pixel; the
observation equation of the calibration contains this difference (calibration/terms/corners.py) and requires the
areas. Ellipses from tangents are the start of a fit of the blurred outline to the pixels as they are.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial import cKDTree
from scipy.special import erf

from calibration.boards import corner_refinement
from calibration.boards.board_types import CircleGrid
from calibration.boards.board_view import (
    QUICK_SEARCH_FAILED,
    BoardView,
    GreyImage,
    NotFound,
    at_full_size,
    if_sharp,
    low_contrast,
    scaled,
    scales,
)
from calibration.boards.chessboard_detection import upright
from calibration.boards.corner_refinement import SINGLE, Pixelwise
from calibration.boards.grid_shape import misfit, predicted, straightened
from geometry.arrays import Array, Bools, Ints

_BIG_DOT = 1.35  # relative area of a corner circle, above which it marks the origin
_SEARCHED_PX = 800  # longer side of the copy that is searched first: circles of most boards are large enough in it
_STRAY = 100  # blobs allowed besides three times the board's: among thousands OpenCV searches for many minutes
_LATTICE = 0.25  # share of blobs arranged as in a lattice: boards among twice as many other blobs have more
_INK = 0.5  # diameter over distance of neighbours where no blob gives it
_AT_ONCE, _STEPS, _SMALL_PX = 16, 8, 2e-3  # outlines fitted together, and their iteration
_MOST_MOVED = 0.1  # by the fit of an outline, in radii; more means that something else is beside it
_REACH, _EDGE_PX, _BESIDE = 1.5, 1.5, 8  # of a patch: radii, px beyond for the edge, px with blur and slope
_EVERY_PX, _LARGEST_STEP = 6, 4  # minor radius from twice of which on every second pixel will do; and the most
_MOST_OFF = 0.8  # radii from its approximate centre to that of an ellipse
_FEWEST = 8  # pixels on the edge of a circle: an ellipse has five unknowns
_FIT_PX = 0.08  # of the spacing: residual of a grid against a plane's picture by a lens with one coefficient


@dataclass(frozen=True, slots=True)
class Ellipses:
    """Fitted ellipses; nan where none fits."""

    centres: Array  # (n, 2), px
    shapes: Array  # (n, 2, 2), px^2: L L^T of the outline c + L (cos a, sin a)
    blurs: Array  # (n,), px: sigma of the edge, including the width of a pixel
    sigmas_px: Array  # (n,): of a coordinate of the centre, from the noise of the picture; nan where not measured

    @property
    def areas(self) -> Array:
        """(n,), px^2."""
        with np.errstate(invalid="ignore"):  # nan where there is no ellipse
            return np.asarray(np.pi * np.sqrt(np.linalg.det(self.shapes)))


def find_circles(image: GreyImage, board: CircleGrid, thorough: bool = True) -> BoardView | NotFound:
    """All centres of a grid of circles, with the areas of the blobs, or the reason why they were not found.

    thorough: if False, the reason is not determined.
    """
    blobs, reason = np.empty((0, 3)), None
    for scale in sorted(scales(image), key=lambda s: abs(np.log(s * max(image.shape) / _SEARCHED_PX))):
        small = scaled(image, scale)
        for light in (False, True):
            black = 255 - small if light else small
            # Centres and diameters (n, 3), px.
            seen = np.array([[*k.pt, k.size] for k in _detector(black).detect(black)]).reshape(-1, 3)
            for grid in _grids(seen, board, (small.shape[1], small.shape[0])):
                ordered = _ordered(grid, board, (small.shape[1], small.shape[0]))
                if not isinstance(ordered, NotFound):
                    at_full = np.column_stack([at_full_size(seen[:, :2], scale), seen[:, 2] / scale])
                    return _measured(
                        255 - image if light else image, at_full_size(ordered, scale), at_full, board, light
                    )
                reason = reason or ordered
            if scale == 1.0 and not light:
                blobs = seen
    return reason or (_why_not(image, board, blobs) if thorough else QUICK_SEARCH_FAILED)


def _detector(image: GreyImage) -> cv2.SimpleBlobDetector:
    """Detector of black blobs, with a tilt up to 75 deg, from 3 px across to a quarter of the picture."""
    p = cv2.SimpleBlobDetector.Params()
    p.filterByColor, p.blobColor = True, 0
    p.filterByArea, p.minArea, p.maxArea = True, 7.0, image.size / 16
    p.filterByCircularity = False  # the image of a tilted circle is not circular
    p.filterByInertia, p.minInertiaRatio = True, 0.05
    p.filterByConvexity, p.minConvexity = True, 0.8
    p.minDistBetweenBlobs = 3.0
    p.minThreshold, p.maxThreshold, p.thresholdStep = 10.0, 245.0, 10.0
    p.minRepeatability = 2
    return cv2.SimpleBlobDetector.create(p)


def _grids(
    blobs: Array, board: CircleGrid, image_size_px: tuple[int, int], size: tuple[int, int] | None = None
) -> Iterator[Array]:
    """Possible approximate centres (rows, columns, 2), px, of blobs (n, 3) in OpenCV's order."""
    columns, rows = size or (board.columns, board.rows)
    if not columns * rows <= len(blobs) <= 3 * columns * rows + _STRAY:
        return
    kind = cv2.CALIB_CB_ASYMMETRIC_GRID if board.asymmetric else cv2.CALIB_CB_SYMMETRIC_GRID
    for plane in straightened(blobs[:, :2], image_size_px):
        points = plane.astype(SINGLE).reshape(-1, 1, 2)
        for how in (0, cv2.CALIB_CB_CLUSTERING) if _lattice_share(plane) >= _LATTICE else ():
            # Without a blob detector, the points are the candidates; the stubs do not know this.
            found, centres = cv2.findCirclesGrid(
                points,
                (columns, rows),
                kind | how,
                None,
                cv2.CirclesGridFinderParameters(),  # type: ignore[call-overload]
            )
            if found and centres is not None and centres.size == 2 * columns * rows:
                yield blobs[cKDTree(plane).query(centres.reshape(rows, columns, 2))[1], :2]


def _lattice_share(points: Array) -> float:
    """Share of points (n, 2) that have another one opposite to their nearest neighbour, like the points of a lattice.

    About 0.1 for random blobs, for which OpenCV's search for a grid does not end; 0.7 and more for boards alone.
    """
    if len(points) < 3:
        return 0.0
    tree = cKDTree(points)
    distance, index = (np.asarray(found)[:, 1] for found in tree.query(points, k=2))
    opposite = 2 * points - points[index.astype(int)]
    return float(np.mean(np.asarray(tree.query(opposite)[0]) < 0.25 * distance))


def _measured(image: GreyImage, ordered: Array, blobs: Array, board: CircleGrid, light: bool) -> BoardView | NotFound:
    more = _goes_on(ordered, board, blobs)
    if more:
        return NotFound(
            f"the grid continues {more} beyond {board.columns}x{board.rows} circles; count again (circles in a row,"
            " rows)"
        )
    centres = ordered.reshape(-1, 2)
    expected, by_board = predicted(centres, board.points[:, :2], (image.shape[1], image.shape[0]))
    shapes = _radii(centres, by_board, board, blobs)[:, None, None] * by_board
    ellipses = fit_ellipses(image, centres, shapes)
    lost = np.isnan(ellipses.areas)
    if lost.any():  # other blobs were taken for them, or several circles that are one at a high threshold
        ellipses = fit_ellipses(image, np.where(lost[:, None], expected, centres), shapes)
        lost = np.isnan(ellipses.areas)
    if lost.any():
        return NotFound(f"{lost.sum()} of {len(lost)} circles have no clean outline: hidden, in glare or blurred")
    order = _by_big_dot(ordered.shape[:2], ellipses.areas / np.linalg.det(by_board), board)
    pixels = ellipses.centres[order]
    blur = float(np.median(ellipses.blurs))
    apart = corner_refinement.spacing(pixels.reshape(ordered.shape))
    notes = ("white circles on a black ground",) if light else ()
    areas, sigmas = ellipses.areas[order], ellipses.sigmas_px[order]
    return if_sharp(BoardView(board.ids, pixels, apart, blur, notes, areas, sigmas))


def _radii(centres: Array, by_board: Array, board: CircleGrid, blobs: Array) -> Array:
    """Radii (n,), m, at approximate centres (n, 2), from the blobs (m, 3) there and derivatives (n, 2, 2), px/m.

    All circles of a board have the same size, so that one radius is used for all; only a markedly larger blob, the dot
    that marks the origin, keeps its own. Single blobs can be much too small where the ink is paler inside.
    """
    enlarged = np.sqrt(np.abs(np.linalg.det(by_board)))
    radii = np.full(len(centres), board.neighbours_m * _INK / 2)
    if len(blobs):
        distance, best = cKDTree(blobs[:, :2]).query(centres)
        hit = distance < enlarged * board.neighbours_m / 3
        if hit.any():
            own = blobs[best, 2] / 2 / enlarged
            radii[:] = np.median(own[hit])
            radii = np.where(hit & (own > 1.3 * radii), own, radii)
    return np.clip(radii, 1.5 / enlarged, 0.6 * board.neighbours_m)


def fit_ellipses(image: GreyImage, centres: Array, shapes: Array) -> Ellipses:
    """The ellipse around each approximate centre (n, 2) of a black circle with about the outline shape (cos a, sin a).

    shapes (n, 2, 2), px: with them, patches of oblique circles do not contain neighbours. Every pixel on the outline
    gives a tangent l = (g_x, g_y, -g . p) by its gradient g; the tangents of an ellipse satisfy l^T D l = 0 with its
    dual conic D, which is solved for by least squares with the weight |g|^2. An isotropic blur does not move the
    centre. Source: Ouellet and Hebert (2009), "Precise ellipse estimation without contour point extraction", Machine
    Vision and Applications 21.
    """
    reach = _REACH * np.linalg.norm(shapes, axis=2) + _BESIDE
    # The part of the picture around all circles.
    first = np.maximum(np.floor(np.min(centres - reach, axis=0)), 0).astype(int)
    last = np.ceil(np.max(centres + reach, axis=0)).astype(int)
    part = image[first[1] : last[1] + 1, first[0] : last[0] + 1].astype(SINGLE)
    smooth = cv2.GaussianBlur(part, (0, 0), 0.7)
    picture = np.stack([*(cv2.Scharr(smooth, cv2.CV_32F, *d) / 32 for d in ((1, 0), (0, 1))), smooth])
    out, by_size = np.empty((len(centres), 6)), np.argsort(reach.max(axis=1))
    for rows in np.split(by_size, range(_AT_ONCE, len(by_size), _AT_ONCE)):
        out[rows] = _ellipses(picture, centres[rows] - first, shapes[rows])
    outlines = out[:, [2, 3, 3, 4]].reshape(-1, 2, 2)
    return _outlines(image, Ellipses(out[:, :2] + first, outlines, out[:, 5], np.full(len(out), np.nan)))


def _ellipses(picture: Pixelwise, centres: Array, shapes: Array) -> Array:
    """Centre x, y, shape xx, xy, yy, sigma of the edge (n, 6); nan where none is.

    centres (n, 2) and shapes (n, 2, 2): approximate ones. picture (3, h, w): slopes along x and y, and grey values.
    """
    minor = np.linalg.svd(shapes, compute_uv=False)[:, 1]
    reach = _REACH + _EDGE_PX / minor  # in units of the shape, in which all circles have the radius 1
    whole, half = np.round(centres).astype(int), int(np.max(reach[:, None] * np.linalg.norm(shapes, axis=2))) + 1
    # The outline of a large circle has more pixels than a start needs.
    step = int(np.clip(minor.min() // _EVERY_PX, 1, _LARGEST_STEP))
    place = _square(half // step) * step
    at, size = whole[:, None] + place, np.array(picture.shape[:0:-1])
    dx, dy = np.moveaxis((place - (centres - whole)[:, None]).astype(SINGLE), -1, 0)
    to_circle = np.linalg.inv(shapes).astype(SINGLE)[..., None]
    x, y = (to_circle[:, k, 0] * dx + to_circle[:, k, 1] * dy for k in (0, 1))
    away = np.hypot(x, y)
    near = (away < reach[:, None]) & np.all((at >= 0) & (at < size), axis=-1)
    at = np.clip(at, 0, size - 1)
    gx, gy, grey = picture[:, at[..., 1], at[..., 0]]
    strength = np.hypot(gx, gy) * near
    strongest = strength.max(axis=1, keepdims=True, initial=1e-6)
    L = (shapes / strongest[..., None]).astype(SINGLE)[..., None]
    a, b = (gx * L[:, 0, k] + gy * L[:, 1, k] for k in (0, 1))
    # Only slopes that rise outwards, as on a black circle; those of a neighbour do not.
    edge = (a * x + b * y > 0) & (strength > 0.2 * strongest)
    a, b = a * edge, b * edge
    c = -(a * x + b * y)
    # D = [[A, B/2, D/2], [B/2, C, E/2], [D/2, E/2, 1]], |l| = |g| already weighs each row by |g|^2.
    rows = np.stack([a * a, a * b, b * b, a * c, b * c, -c * c], axis=1)
    N = (rows @ np.swapaxes(rows, 1, 2)).astype(float)
    A, B, C, D, E = np.linalg.solve(N[:, :5, :5] + 1e-9 * np.eye(5), N[:, :5, 5:])[..., 0].T
    middle = np.stack([D, E], axis=-1) / 2
    # With the centre subtracted, D's upper block is -1 times the ellipse's shape matrix.
    found = middle[:, :, None] * middle[:, None] - np.stack([A, B / 2, B / 2, C], axis=-1).reshape(-1, 2, 2)
    inside = near & (np.hypot(x - middle[:, :1], y - middle[:, 1:]) < 1.2 * step / minor[:, None])
    black = np.min(grey, axis=1, where=inside, initial=np.inf)
    white = _quantile(grey, near & (away > 0.85 * reach[:, None]), 0.5)
    with np.errstate(invalid="ignore"):
        blur = (white - black) / _quantile(strength, edge, 0.9) / np.sqrt(2 * np.pi)
    good = (np.linalg.det(found) > 0) & (np.trace(found, axis1=1, axis2=2) > 0) & (edge.sum(axis=1) >= _FEWEST)
    good &= np.isfinite(blur) & (np.linalg.norm(middle, axis=1) < _MOST_OFF)
    centres = centres + (shapes @ middle[..., None])[..., 0]
    found = (shapes @ found @ np.swapaxes(shapes, 1, 2)).reshape(-1, 4)[:, [0, 1, 3]]
    return np.where(good[:, None], np.column_stack([centres, found, blur]), np.nan)


def _quantile(values: Pixelwise, which: Bools, q: float) -> Array:
    """The quantile (n,) of some (n, m) of the values (n, m) of each row, interpolated; nan where there are none."""
    ordered = np.sort(np.where(which, values, np.inf), axis=1)
    k = q * np.maximum(np.sum(which, axis=1) - 1, 0)
    low, row = np.floor(k).astype(int), np.arange(len(k))
    part = (k - low).astype(values.dtype)
    with np.errstate(invalid="ignore"):
        return np.where(part > 0, (1 - part) * ordered[row, low] + part * ordered[row, low + 1], ordered[row, low])


def _outlines(image: GreyImage, start: Ellipses) -> Ellipses:
    """Ellipses with centres and shapes from a least-squares fit of blurred discs to the pixels beside their outlines.

    Grey values are (b + b' d) + (c + c' d) S at the offset d from the centre, with S the error function of the distance
    from the outline over its sigma. The outline is c + L (z + g conj(z)^2), |z| = 1, in complex numbers: of the
    second-order part of perspective and distortion, the rest moves a circle as a whole or changes it in second order,
    and g leaves the centroid at c. An ellipse fitted to an oblique outline with g is not at its centroid. Ours.
    """
    centres, shapes, noise = start.centres.copy(), start.shapes.copy(), np.full((len(start.centres), 3), np.nan)
    good = np.flatnonzero(np.isfinite(shapes).all(axis=(1, 2)) & np.isfinite(start.blurs))
    good = good[np.argsort(start.areas[good])]
    for first in range(0, len(good), _AT_ONCE):
        rows = good[first : first + _AT_ONCE]
        found, L2, noise[rows] = _fitted_outlines(image, centres[rows], shapes[rows], start.blurs[rows])
        size = np.sqrt(np.linalg.det(shapes[rows]))
        with np.errstate(invalid="ignore"):
            near = np.linalg.norm(found - centres[rows], axis=1) < _MOST_MOVED * np.sqrt(size)
            near &= np.abs(np.sqrt(np.linalg.det(L2)) / size - 1) < _MOST_MOVED
        centres[rows[near]], shapes[rows[near]] = found[near], L2[near]
    return Ellipses(centres, shapes, start.blurs, corner_refinement.of_noise(noise))


def _fitted_outlines(image: GreyImage, centres: Array, shapes: Array, blur: Array) -> tuple[Array, Array, Array]:
    """Centres (n, 2), shapes (n, 2, 2) and noise (n, 3) of `_outlines`, from start values.

    blur (n,), px: sigmas of the edges.
    """
    values, vectors = np.linalg.eigh(shapes)
    A = (vectors / np.sqrt(values)[:, None]) @ np.swapaxes(vectors, 1, 2)  # offset in px to the unit circle
    whole = np.round(centres).astype(int)
    band = np.minimum(3 * blur + 1, 0.5 * np.sqrt(values[:, 0]) + 1)
    place, weight = _beside(A, centres - whole, band, np.sqrt(values[:, 1]))
    most = place.shape[1]
    at = whole[:, None] + place
    height, width = image.shape
    weight *= np.all((at >= 0) & (at < [width, height]), axis=-1)
    grey = weight * image[np.clip(at[..., 1], 0, height - 1), np.clip(at[..., 0], 0, width - 1)]
    size = np.sqrt(values.prod(axis=1) ** 0.5)  # px
    scale = np.stack([np.ones_like(size)] * 2 + [1 / size] * 3 + [np.ones_like(size)] * 3, axis=1)
    x = np.concatenate([centres - whole, A.reshape(-1, 4)[:, [0, 1, 3]], np.zeros((len(A), 2)), blur[:, None]], axis=1)
    largest = np.array([0.5, 0.5, 0.05, 0.05, 0.05, 0.05, 0.05, 0.3]) * scale
    J, B = (np.empty((len(grey), k, most), dtype=SINGLE) for k in (8, 6))
    B[:, 0] = weight
    place = np.swapaxes(place, 1, 2).astype(SINGLE)  # (n, 2, m)
    for _ in range(_STEPS):
        y = x.astype(SINGLE)
        d = place - y[:, :2, None]
        to_circle = y[:, [2, 3, 3, 4]].reshape(-1, 2, 2)
        w = to_circle @ d
        length = np.maximum(np.hypot(w[:, 0], w[:, 1]), 1e-6)
        w /= length[:, None]
        (p, q), (a, b) = np.moveaxis(w, 1, 0), (w * w).swapaxes(0, 1)
        cube = np.stack([p * (a - 3 * b), q * (3 * a - b)], axis=1)  # of the complex number p + i q
        # The outline is where the length times h is 1; h and its derivative by the angle give normal and curvature.
        h = 1 - (y[:, None, 5:7] @ cube)[:, 0]
        turn = 3 * (y[:, 5:6] * cube[:, 1] - y[:, 6:7] * cube[:, 0])
        slant = np.stack([h * p - turn * q, h * q + turn * p], axis=1)
        normal = to_circle @ slant
        n = np.maximum(np.hypot(normal[:, 0], normal[:, 1]), 1e-9)
        away = (length * h - 1) / n
        curved = np.linalg.det(to_circle)[:, None] ** 2 * (9 - 8 * h) * (h / n) ** 3  # 1/px
        sigma = y[:, 7:]
        e = away / sigma + sigma * curved / 2  # blur displaces a curved edge towards its centre of curvature
        B[:, 1:3] = weight[:, None] * d / size[:, None, None]
        B[:, 3:] = B[:, :3] * erf(e / SINGLE(2**0.5))[:, None]
        linear = corner_refinement.linear_part(B, grey)
        slope = np.swapaxes(linear[:, 3:], 1, 2).astype(SINGLE) @ B[:, :3]
        g = slope[:, 0] * SINGLE((2 / np.pi) ** 0.5) * np.exp(-e * e / 2) / (sigma * n)
        J[:, :2] = -g[:, None] * normal
        (p, q), (a, b) = np.moveaxis(slant, 1, 0), np.moveaxis(d, 1, 0)
        J[:, 2], J[:, 3], J[:, 4] = g * p * a, g * (p * b + q * a), g * q * b
        J[:, 5:7] = -(g * length)[:, None] * cube
        J[:, 7] = g * n * (curved * sigma / 2 - away / sigma)
        step, noise = corner_refinement.step_of(J, B, grey, linear)
        x = x + np.clip(step, -largest, largest)
        x[:, 7] = np.maximum(x[:, 7], 0.25)
        if np.max(np.abs(step[:, :2])) < _SMALL_PX:
            break
    inverse = np.linalg.inv(x[:, [2, 3, 3, 4]].reshape(-1, 2, 2))
    return whole + x[:, :2], inverse @ np.swapaxes(inverse, 1, 2), noise


def _beside(A: Array, centres: Array, band: Array, reach: Array) -> tuple[Ints, Pixelwise]:
    """Offsets (n, m, 2), px, of the pixels within `band` (n,) of ellipses about centres (n, 2), and weights (n, m).

    A (n, 2, 2): to the unit circle. Weights are 1; 0 where an ellipse has fewer than m such pixels.
    """
    half = int(np.ceil(np.max(reach + band))) + 1
    pixels = _square(half)
    x, y = np.moveaxis((pixels - centres[:, None]).astype(SINGLE), -1, 0)
    a, b, c = (A.reshape(-1, 4)[:, k, None].astype(SINGLE) for k in (0, 1, 3))
    p, q = a * x + b * y, b * x + c * y
    length = np.hypot(p, q)
    near = np.abs(length - 1) * length < band[:, None] * np.hypot(a * p + b * q, b * p + c * q)
    ellipse, pixel = np.nonzero(near)
    counts = np.bincount(ellipse, minlength=len(A))
    column = np.arange(len(pixel)) - np.repeat(np.cumsum(counts) - counts, counts)
    place, weight = np.zeros((len(A), counts.max(), 2), dtype=int), np.zeros((len(A), counts.max()), dtype=SINGLE)
    place[ellipse, column], weight[ellipse, column] = pixels[pixel], 1
    return place, weight


def _square(half: int) -> Ints:
    """x and y (m, 2) of a square about 0, row by row."""
    v, u = np.mgrid[-half : half + 1, -half : half + 1]
    return np.stack([u, v], axis=-1).reshape(-1, 2)


def _ordered(grid: Array, board: CircleGrid, image_size_px: tuple[int, int]) -> Array | NotFound:
    """The grid numbered as on the board and not mirrored; of several such numberings the upright one."""
    ways = [grid, grid[::-1], grid[:, ::-1], grid[::-1, ::-1]]
    if board.asymmetric and board.rows % 2 == 0:
        # OpenCV swaps the two rows of each pair if the number of rows is even.
        paired = grid.reshape(board.rows // 2, 2, board.columns, 2)[:, ::-1].reshape(grid.shape)
        ways += [paired, paired[::-1], paired[:, ::-1], paired[::-1, ::-1]]
    if board.columns == board.rows and not board.asymmetric:
        ways += [np.swapaxes(way, 0, 1) for way in ways]
    fitting: list[Array] = []
    mirrored: list[Array] = []
    limit = _FIT_PX * corner_refinement.spacing(grid) + 1.0
    for way in ways:
        away, is_mirrored = misfit(way.reshape(-1, 2), board.points[:, :2] / board.spacing_m, image_size_px)
        if away < limit:
            (mirrored if is_mirrored else fitting).append(way)
    if fitting:
        return upright(fitting)
    if mirrored:
        return NotFound("the picture is mirrored: switch off the mirroring of the camera or its software")
    return NotFound(
        "circles were found, but not arranged as on this board; check circles or acircles, columns and rows"
    )


def _goes_on(grid: Array, board: CircleGrid, blobs: Array) -> str:
    """Sides on which more circles of the pattern follow: 'above', ...; empty where the grid ends."""
    if len(blobs) == 0:
        return ""
    step = 2 if board.asymmetric else 1  # rows of the same kind
    sides = {
        "above": 2 * grid[0] - grid[step] if board.rows > step else grid[:0, 0],
        "below": 2 * grid[-1] - grid[-1 - step] if board.rows > step else grid[:0, 0],
        "to the left": 2 * grid[:, 0] - grid[:, 1],
        "to the right": 2 * grid[:, -1] - grid[:, -2],
    }
    if board.asymmetric:  # the adjacent row, not the next one with the same shift
        sides["above"], sides["below"] = grid[1] + grid[0] - grid[2], grid[-2] + grid[-1] - grid[-3]
    limit = 0.25 * corner_refinement.spacing(grid)
    names = []
    for side, outside in sides.items():
        distance = np.linalg.norm(outside[:, None] - blobs[None, :, :2], axis=-1).min(axis=1)
        if np.mean(distance < limit) > 0.7:
            names.append(side)
    return " and ".join(names)


def _by_big_dot(shape: tuple[int, ...], areas: Array, board: CircleGrid) -> Ints:
    """The order (n,) of the circles in which a markedly larger corner circle comes first; as they are without one.

    areas (n,): on the board. On boards with unequal sides, a large dot that could come first only by mirroring becomes
    the last one of the first row.
    """
    number = np.arange(len(areas)).reshape(shape)
    if board.asymmetric:
        return number.ravel()
    size = areas.reshape(shape)
    size = size / np.median(size)
    corners = {(0, 0): size[0, 0], (0, -1): size[0, -1], (-1, 0): size[-1, 0], (-1, -1): size[-1, -1]}
    big = [where for where, share in corners.items() if share > _BIG_DOT]
    if len(big) != 1:
        return number.ravel()
    ways = [number, number[::-1, ::-1]]
    if board.columns == board.rows:
        ways += [number[::-1].T, number[:, ::-1].T]
    first = [way for way in ways if way[0, 0] == number[big[0]]]
    return (first[0] if first else next(way for way in ways if way[0, -1] == number[big[0]])).ravel()


def _why_not(image: GreyImage, board: CircleGrid, blobs: Array) -> NotFound:
    pale = low_contrast(image)
    if pale is not None:
        return pale
    wanted, shape = board.columns * board.rows, (image.shape[1], image.shape[0])
    regular = max(map(_lattice_share, straightened(blobs[:, :2], shape)), default=0.0)
    if len(blobs) > 3 * wanted + _STRAY or (len(blobs) >= wanted and regular < _LATTICE):
        return NotFound(
            f"no grid of circles: {len(blobs)} round black blobs without a regular arrangement; the board must lie"
            " wholly in the picture, before a plain background"
        )
    other = CircleGrid(board.columns, board.rows, board.spacing_m, not board.asymmetric)
    if any(True for _ in _grids(blobs, other, shape)):
        return NotFound(
            f"the circles are {'in shifted rows' if other.asymmetric else 'in straight columns'}: write {other.kind}"
            f" instead of {board.kind}"
        )
    for count in range(len(blobs), max(len(blobs) - 3, 8), -1):
        for columns in range(3, count // 3 + 1):
            if count % columns == 0 and any(True for _ in _grids(blobs, board, shape, (columns, count // columns))):
                wide, high = sorted((columns, count // columns), reverse=board.columns >= board.rows)
                return NotFound(
                    f"a grid of {wide}x{high} circles, not {board.columns}x{board.rows}: part of the"
                    " board is outside the picture, or count again (circles in a row, then rows)"
                )
    if len(blobs) < 0.5 * wanted:
        return NotFound(
            f"no grid of circles: {len(blobs)} round black blobs of {wanted}; the board must lie wholly in the picture"
        )
    return NotFound(
        f"no {board.columns}x{board.rows} grid among {len(blobs)} round black blobs: a circle is hidden, in glare or"
        " outside the picture, or the numbers of columns and rows are wrong"
    )
