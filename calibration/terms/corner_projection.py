"""The compiled projection of board corners and circles, with derivatives by everything on which a pixel depends.

The centroid of a blob is not the image of the circle's centre: perspective and distortion enlarge the nearer half.
For a circle of 7 mm at 0.5 m under 45 deg the two differ by 0.1 to 0.3 px, in the same direction for all circles.
Area and centroid follow from images of points on the outline by Green's theorem; the tangent is the derivative of the
trigonometric polynomial through them. Source: Heikkila (2000), "Geometric camera calibration using circular control
points", IEEE Trans. PAMI 22, for the effect under perspective; the nodes on the outline, which work with any lens
model, are ours. Compiled, since arrays of all nodes with all derivatives took two thirds of the time of a calibration.
"""

from __future__ import annotations

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.compilation.jit import compiled, compiled_in_caller
from geometry.compiled_projection import by_coefficients, distorted_point

# The images of circles contain harmonics 1 and 2 of the angle, the second a hundredth of the first. Products of three
# of them that six nodes cannot distinguish from a constant are below 1e-5 px. With five nodes errors reach 1e-3 px.
NODES = 6
_ANGLE = 2 * np.pi * np.arange(NODES) / NODES
_ON_CIRCLE = np.stack([np.cos(_ANGLE), np.sin(_ANGLE)], axis=1)  # (NODES, 2): of radius 1

# The columns of the derivatives.
COLUMNS = {
    "intrinsics": slice(0, 18),
    "cameras": slice(18, 24),
    "boards": slice(24, 30),
    "warp": slice(30, 33),
    "stretch": slice(33, 35),
    "print": slice(35, 38),
    "radius": slice(38, 39),
}
_COUNT = 39


def _derivative_matrix(n: int) -> Array:
    """Matrix (n, n) from values at n (even) nodes to the derivatives of the trigonometric polynomial through them."""
    j = np.arange(n)
    steps = j[:, None] - j[None, :]
    with np.errstate(divide="ignore"):
        D = 0.5 * (-1.0) ** steps / np.tan(np.pi * steps / n)
    D[steps == 0] = 0.0
    return np.asarray(D, dtype=float)


_D = _derivative_matrix(NODES)


@compiled
def project_corners(
    index: Ints,
    points: Array,
    from_middle: Array,
    lenses: Array,
    tilts: Array,
    fisheye: Bools,
    cameras: Array,
    boards: Array,
    shapes: Array,
) -> tuple[Array, Array]:
    """Pixels (N, 2) of N corners, or centroids of circles, and their derivatives (N, 2, 39), see COLUMNS.

    index (N, 3): camera, placement and board of each; points (N, 3), m: with the errors of the print; from_middle
    (N, 2), m. lenses (C, 18); tilts (C, 3, 3, 3): homography of the sensor's tilt and its derivatives by both angles;
    fisheye (C,). cameras (C, 3, 4): camera_from_world; boards (P, 3, 4): world_from_board; shapes (B, 6): warp,
    stretch and radius. nan where a point is behind the camera or the lens folds.
    """
    pixels, J = np.empty((len(points), 2)), np.zeros((len(points), 2, _COUNT))
    at, outline, G = np.empty((NODES, 3, 3)), np.empty((NODES, 2)), np.empty((2, NODES, 2))
    by_point, by_lens = np.empty((NODES, 2, 3)), np.zeros((NODES, 2, 18))
    for i in range(len(points)):
        c, p, b = index[i, 0], index[i, 1], index[i, 2]
        nodes = 1 if shapes[b, 5] == 0.0 else NODES
        for k in range(nodes):
            dx, dy = shapes[b, 5] * _ON_CIRCLE[k, 0], shapes[b, 5] * _ON_CIRCLE[k, 1]
            x, y = from_middle[i, 0] + dx, from_middle[i, 1] + dy
            at[k, 0, 0] = points[i, 0] + dx + shapes[b, 3] * x + shapes[b, 4] * y
            at[k, 0, 1] = points[i, 1] + dy
            at[k, 0, 2] = points[i, 2] + shapes[b, 0] * x * x + shapes[b, 1] * x * y + shapes[b, 2] * y * y
            for frame in range(2):
                X, Y, Z = at[k, frame, 0], at[k, frame, 1], at[k, frame, 2]
                T, j = (boards, p) if frame == 0 else (cameras, c)
                for a in range(3):
                    at[k, frame + 1, a] = T[j, a, 0] * X + T[j, a, 1] * Y + T[j, a, 2] * Z + T[j, a, 3]
            _pixel(lenses[c], tilts, c, fisheye[c], at, k, outline, by_point, by_lens)
        G[0, 0, 0], G[0, 0, 1], G[1, 0, 0], G[1, 0, 1] = 1.0, 0.0, 0.0, 1.0
        pixels[i, 0], pixels[i, 1] = _centroid(outline, G) if nodes > 1 else (outline[0, 0], outline[0, 1])
        for k in range(nodes):
            for row in range(2):
                g, h = G[row, k, 0], G[row, k, 1]
                for a in range(18):
                    J[i, row, a] += g * by_lens[k, 0, a] + h * by_lens[k, 1, a]
                n0 = g * by_point[k, 0, 0] + h * by_point[k, 1, 0]
                n1 = g * by_point[k, 0, 1] + h * by_point[k, 1, 1]
                n2 = g * by_point[k, 0, 2] + h * by_point[k, 1, 2]
                w0, w1, w2 = _turned_back(cameras, c, n0, n1, n2)
                o0, o1, o2 = _turned_back(boards, p, w0, w1, w2)
                _add_pose(J, i, row, 18, n0, n1, n2, at, k, 1, w0, w1, w2)
                _add_pose(J, i, row, 24, w0, w1, w2, at, k, 0, o0, o1, o2)
                q, r = (_ON_CIRCLE[k, 0], _ON_CIRCLE[k, 1]) if nodes > 1 else (0.0, 0.0)
                x, y = from_middle[i, 0] + shapes[b, 5] * q, from_middle[i, 1] + shapes[b, 5] * r
                J[i, row, 30] += o2 * x * x
                J[i, row, 31] += o2 * x * y
                J[i, row, 32] += o2 * y * y
                J[i, row, 33] += o0 * x
                J[i, row, 34] += o0 * y
                J[i, row, 35] += o0
                J[i, row, 36] += o1
                J[i, row, 37] += o2
                rise = shapes[b, 0] * 2 * x * q + shapes[b, 1] * (x * r + y * q) + shapes[b, 2] * 2 * y * r
                J[i, row, 38] += o0 * (q + shapes[b, 3] * q + shapes[b, 4] * r) + o1 * r + o2 * rise
    return pixels, J


@compiled_in_caller
def _turned_back(T: Array, j: int, x: float, y: float, z: float) -> tuple[float, float, float]:
    """A row vector times the rotation of a transform T[j] (3, 4)."""
    return (
        x * T[j, 0, 0] + y * T[j, 1, 0] + z * T[j, 2, 0],
        x * T[j, 0, 1] + y * T[j, 1, 1] + z * T[j, 2, 1],
        x * T[j, 0, 2] + y * T[j, 1, 2] + z * T[j, 2, 2],
    )


@compiled
def _add_pose(
    J: Array,
    i: int,
    row: int,
    first: int,
    x: float,
    y: float,
    z: float,
    at: Array,
    k: int,
    frame: int,
    u: float,
    v: float,
    w: float,
) -> None:
    """Adds the derivatives by a transform of node k from a frame: x, y, z by the point after it, u, v, w before it.

    d(R Exp(theta) x)/dtheta = -R [x]_x; with a row w of the derivative by the point: -w [x]_x = x cross w.
    """
    J[i, row, first] += x
    J[i, row, first + 1] += y
    J[i, row, first + 2] += z
    J[i, row, first + 3] += at[k, frame, 1] * w - at[k, frame, 2] * v
    J[i, row, first + 4] += at[k, frame, 2] * u - at[k, frame, 0] * w
    J[i, row, first + 5] += at[k, frame, 0] * v - at[k, frame, 1] * u


@compiled
def _pixel(
    lens: Array,
    tilts: Array,
    c: int,
    fisheye: bool,
    at: Array,
    k: int,
    outline: Array,
    by_point: Array,
    by_lens: Array,
) -> None:
    """Writes the pixel of node k through a lens (18,), and its derivatives by the point and the lens; nan behind."""
    in_front = at[k, 2, 2] > 1e-9
    z = at[k, 2, 2] if in_front else 1.0
    x, y = at[k, 2, 0] / z, at[k, 2, 1] / z
    numbers, by_lens[k] = lens[4:], 0.0
    bx, by, xx, xy, yx, yy = distorted_point(numbers, fisheye, x, y)
    by_coefficients(numbers, fisheye, x, y, by_lens[k, :, 4:])
    if not fisheye and (lens[16] != 0.0 or lens[17] != 0.0):
        px, py, pz = _homography(tilts, c, 0, bx, by, 1.0)
        px, py = px / pz, py / pz
        for a in range(14):
            h0, h1, h2 = _homography(tilts, c, 0, by_lens[k, 0, 4 + a], by_lens[k, 1, 4 + a], 0.0)
            if a >= 12:
                h0, h1, h2 = _homography(tilts, c, a - 11, bx, by, 1.0)
            by_lens[k, 0, 4 + a], by_lens[k, 1, 4 + a] = (h0 - px * h2) / pz, (h1 - py * h2) / pz
        h0, h1, h2 = _homography(tilts, c, 0, xx, yx, 0.0)
        xx, yx = (h0 - px * h2) / pz, (h1 - py * h2) / pz
        h0, h1, h2 = _homography(tilts, c, 0, xy, yy, 0.0)
        xy, yy = (h0 - px * h2) / pz, (h1 - py * h2) / pz
        bx, by = px, py
    good = in_front and xx * yy - xy * yx > 0.0
    outline[k, 0] = lens[0] * bx + lens[2] if good else np.nan
    outline[k, 1] = lens[1] * by + lens[3] if good else np.nan
    by_lens[k, 0, 0], by_lens[k, 1, 1], by_lens[k, 0, 2], by_lens[k, 1, 3] = bx, by, 1.0, 1.0
    for row in range(2):
        for a in range(4, 18):
            by_lens[k, row, a] *= lens[row]
        p, q = (xx, xy) if row == 0 else (yx, yy)
        p, q = lens[row] * p / z, lens[row] * q / z
        by_point[k, row, 0], by_point[k, row, 1], by_point[k, row, 2] = p, q, -(p * x + q * y)


@compiled
def _homography(T: Array, c: int, k: int, x: float, y: float, z: float) -> tuple[float, float, float]:
    """T[c, k] times a vector."""
    return (
        T[c, k, 0, 0] * x + T[c, k, 0, 1] * y + T[c, k, 0, 2] * z,
        T[c, k, 1, 0] * x + T[c, k, 1, 1] * y + T[c, k, 1, 2] * z,
        T[c, k, 2, 0] * x + T[c, k, 2, 1] * y + T[c, k, 2, 2] * z,
    )


@compiled
def _centroid(outline: Array, G: Array) -> tuple[float, float]:
    """The centroid of the area within an outline (NODES, 2); writes its derivatives by the nodes to G (2, NODES, 2).

    The nodes are the images of _ON_CIRCLE, in that order. nan where a node is nan.
    """
    mx = my = area = cx = cy = 0.0
    for k in range(NODES):
        mx, my = mx + outline[k, 0] / NODES, my + outline[k, 1] / NODES
    for k in range(NODES):
        x, y, dx, dy, xx, yy = outline[k, 0] - mx, outline[k, 1] - my, 0.0, 0.0, 0.0, 0.0
        for j in range(NODES):
            p, q = outline[j, 0] - mx, outline[j, 1] - my
            dx, dy, xx, yy = dx + _D[k, j] * p, dy + _D[k, j] * q, xx + _D[k, j] * p * p, yy + _D[k, j] * q * q
        area, cx, cy = area + x * dy, cx + x * x * dy / 2, cy - y * y * dx / 2
        G[0, k, 0], G[0, k, 1], G[1, k, 0], G[1, k, 1] = dy, dx, xx, yy
    cx, cy = cx / area, cy / area
    for k in range(NODES):
        dy, dx, xx, yy = G[0, k, 0], G[0, k, 1], G[1, k, 0], G[1, k, 1]
        G[0, k, 0], G[0, k, 1] = (outline[k, 0] - mx - cx) * dy / area, (cx * dx - xx / 2) / area
        G[1, k, 0], G[1, k, 1] = (yy / 2 - cy * dy) / area, (cy - outline[k, 1] + my) * dx / area
    return mx + cx, my + cy
