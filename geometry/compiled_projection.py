"""The compiled implementation of the forward model: pixels of a rig's views and their Jacobian by the pose.

The forward model is geometry/forward_model.py; start there. Its `SpotModel.project` and `SpotModel.derivatives` call
`project_all`, `derivatives_all` and `lit_points`, and the trackers' compiled loops call `project_view`. The lenses
are called by lens.py as well. tests/geometry/test_forward_model.py compares with a computation by other means.
"""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from geometry.arrays import Array, Bools
from geometry.compilation.jit import compiled, compiled_in_caller

# The numbers of a SpotModel as one record per view; meanings and units as there. They form one array because numba
# unpacks a tuple of arrays at every call: with thirteen arrays a frame took 0.39 ms instead of 0.32.
VIEW = np.dtype(
    [
        ("point", np.float64, 3),
        ("ray", np.float64, 3),
        ("screen_rotation", np.float64, (3, 3)),
        ("screen_origin", np.float64, 3),
        ("bow", np.float64, 3),
        ("half_size", np.float64, 2),
        ("camera_rotation", np.float64, (3, 3)),
        ("camera_translation", np.float64, 3),
        ("pinhole", np.float64, 4),
        ("distortion", np.float64, 14),
        ("tilt", np.float64, (3, 3)),  # homography of the sensor's tilt, from the last two distortion numbers
        ("lens", np.int64),  # distortion model; 0: none, 1: polynomial, 2: polynomial and tilt, 3: fisheye
        ("fold_r2", np.float64),
        # px, added to the pixel: how far the spot moves from the instant of the pose to that of the picture, if they
        # differ (tracking/rigid_body/models/information.py). Trackers set it frame by frame, in a copy.
        ("shift", np.float64, 2),
    ],
    align=True,
)
Views: TypeAlias = NDArray[np.void]  # (n,) of VIEW


class _LitPoint(NamedTuple):
    """Where a ray meets its screen, in world. Numbers and no arrays, because each array is allocated and counted."""

    length: float  # m, of the ray; 0: it is parallel to the screen
    facing: float  # normal . ray
    dx: float  # the ray
    dy: float
    dz: float
    nx: float  # the surface's normal
    ny: float
    nz: float
    x: float  # m, the lit point
    y: float
    z: float


@compiled
def inside(uv: Array, size: Array) -> bool:
    """Whether a pixel (2,) lies in a picture of a size (2,): width, height; False for nan."""
    return uv[0] >= -0.5 and uv[1] >= -0.5 and uv[0] < size[0] - 0.5 and uv[1] < size[1] - 0.5


@compiled
def project_all(v: Views, R: Array, t: Array) -> tuple[Array, Array]:
    """Pixels (m, n, 2) and Jacobians (m, n, 2, 6) of n views for poses R (m, 3, 3), t (m, 3), m.

    nan and 0 where a view has no projection.
    """
    m, n = R.shape[0], v.shape[0]
    uv, J = np.empty((m, n, 2)), np.empty((m, n, 2, 6))
    for k in range(m):
        for i in range(n):
            project_view(v, i, R[k], t[k], uv[k, i], J[k, i])
    return uv, J


@compiled
def project_with_covariances(v: Views, R: Array, t: Array, P: Array) -> tuple[Array, Array]:
    """Pixels (m, n, 2) of n views for poses R (m, 3, 3), t (m, 3), m, and their covariances (m, n, 2, 2), px^2.

    P (m, 6, 6): the poses' covariances. nan and 0 where a view has no projection.
    """
    m, n = R.shape[0], v.shape[0]
    uv, cov = np.empty((m, n, 2)), np.empty((m, n, 2, 2))
    J, JP = np.empty((2, 6)), np.empty((2, 6))
    for k in range(m):
        for i in range(n):
            project_view(v, i, R[k], t[k], uv[k, i], J)
            for a in range(2):
                for c in range(6):
                    JP[a, c] = 0.0
                    for b in range(6):
                        JP[a, c] += J[a, b] * P[k, b, c]
                for b in range(2):
                    cov[k, i, a, b] = 0.0
                    for c in range(6):
                        cov[k, i, a, b] += JP[a, c] * J[b, c]
    return uv, cov


@compiled
def derivatives_all(
    v: Views, sign: Array, R: Array, t: Array
) -> tuple[Array, Array, Array, Array, Array, Array, Array, Array]:
    """Pixels (m, n, 2) of n views for poses R (m, 3, 3), t (m, 3), m, and what SpotDerivatives has but the lens.

    v, sign (1 or m, n): the views of all poses, or of each; sign as in SpotModel. Then the derivatives (m, n, 2, .) by
    the pose, camera, screen, bow, direction and point, and the lit points (m, n, 3) in the cameras' frames, (0, 0, 1)
    without a projection. nan and 0 as in `project_all`.
    """
    m, n = R.shape[0], v.shape[1]
    uv, pose, camera = np.full((m, n, 2), np.nan), np.zeros((m, n, 2, 6)), np.zeros((m, n, 2, 6))
    screen, bow, in_camera = np.zeros((m, n, 2, 6)), np.zeros((m, n, 2, 3)), np.zeros((m, n, 3))
    direction, point = np.zeros((m, n, 2, 3)), np.zeros((m, n, 2, 3))
    hit, on_screen = np.empty(3), np.empty(3)
    for k in range(m):
        j = k if v.shape[0] > 1 else 0
        of_pose = v[j]
        for i in range(n):
            view = of_pose[i]
            in_camera[k, i, 2] = 1.0
            lit = _lit_point(of_pose, i, R[k], t[k])
            there, u_along, v_along = _image(of_pose, i, R[k], t[k], lit, uv[k, i], pose[k, i])
            if not there:
                uv[k, i, 0] = uv[k, i, 1] = np.nan
                pose[k, i] = 0.0
                continue
            hit[0], hit[1], hit[2] = lit.x, lit.y, lit.z
            S, s0, C = view["screen_rotation"], view["screen_origin"], view["camera_rotation"]
            for a in range(3):
                c = C[a, 0] * hit[0] + C[a, 1] * hit[1] + C[a, 2] * hit[2]
                in_camera[k, i, a] = c + view["camera_translation"][a]
                on_screen[a] = S[0, a] * (hit[0] - s0[0]) + S[1, a] * (hit[1] - s0[1]) + S[2, a] * (hit[2] - s0[2])
            x, y = on_screen[0], on_screen[1]
            for row in range(2):
                # If the screen moves by delta at the lit point, the point moves along the ray by (n.delta) / (n.d).
                along = u_along if row == 0 else v_along
                n0, n1, n2 = along * lit.nx, along * lit.ny, along * lit.nz
                by_hit = pose[k, i, row]
                g0, g1, g2 = by_hit[0] + n0, by_hit[1] + n1, by_hit[2] + n2  # px per m of the lit point, in world
                _by_frame(camera[k, i, row], C, g0, g1, g2, hit, True)
                _by_frame(screen[k, i, row], S, n0, n1, n2, on_screen, False)
                raised = n0 * S[0, 2] + n1 * S[1, 2] + n2 * S[2, 2]
                bow[k, i, row, 0], bow[k, i, row, 1], bow[k, i, row, 2] = raised * x * x, raised * x * y, raised * y * y
                for a in range(3):
                    p = by_hit[0] * R[k, 0, a] + by_hit[1] * R[k, 1, a] + by_hit[2] * R[k, 2, a]
                    point[k, i, row, a], direction[k, i, row, a] = p, sign[j, i] * lit.length * p
    return uv, pose, camera, screen, bow, direction, point, in_camera


@compiled
def _by_frame(out: Array, F: Array, g0: float, g1: float, g2: float, at: Array, into: bool) -> None:
    """Writes the derivative (6,) by the error of a transform's translation and rotation, from that by a point in world.

    F (3, 3): the transform's rotation, into or from a part's frame. g: px per m of the point in world, at (3,), m: the
    point in the frame that the transform is applied to.
    """
    for a in range(3):
        out[a] = F[a, 0] * g0 + F[a, 1] * g1 + F[a, 2] * g2 if into else (g0, g1, g2)[a]
    # By a turn theta: F [theta]x at = -F [at]x theta.
    h0, h1, h2 = g0, g1, g2
    if not into:
        h0 = F[0, 0] * g0 + F[1, 0] * g1 + F[2, 0] * g2
        h1 = F[0, 1] * g0 + F[1, 1] * g1 + F[2, 1] * g2
        h2 = F[0, 2] * g0 + F[1, 2] * g1 + F[2, 2] * g2
    out[3] = at[1] * h2 - at[2] * h1
    out[4] = at[2] * h0 - at[0] * h2
    out[5] = at[0] * h1 - at[1] * h0


@compiled
def project_view(v: Views, i: int, R: Array, t: Array, uv: Array, J: Array) -> bool:
    """Writes the pixel of view i to uv (2,) and its Jacobian to J (2, 6); False, nan and 0 if there is no projection.

    R (3, 3), t (3,), m: world_from_body.
    """
    if _image(v, i, R, t, _lit_point(v, i, R, t), uv, J)[0]:
        return True
    for row in range(2):
        uv[row] = np.nan
        for k in range(6):
            J[row, k] = 0.0
    return False


@compiled
def lit_points(v: Views, R: Array, t: Array) -> Array:
    """Lit points (m, n, 3), m, in world, of n views for poses R (m, 3, 3), t (m, 3), m; nan beside the screen."""
    m, n = R.shape[0], v.shape[0]
    out = np.full((m, n, 3), np.nan)
    for k in range(m):
        for i in range(n):
            lit = _lit_point(v, i, R[k], t[k])
            if _on_screen(v, i, lit):
                out[k, i, 0], out[k, i, 1], out[k, i, 2] = lit.x, lit.y, lit.z
    return out


@compiled_in_caller
def _on_screen(v: Views, i: int, lit: _LitPoint) -> bool:
    """Whether the ray of view i meets its screen ahead and within its extent."""
    view = v[i]
    S, s0 = view["screen_rotation"], view["screen_origin"]
    x, y, z = lit.x - s0[0], lit.y - s0[1], lit.z - s0[2]
    across = S[0, 0] * x + S[1, 0] * y + S[2, 0] * z
    down = S[0, 1] * x + S[1, 1] * y + S[2, 1] * z
    return lit.length > 0.0 and abs(across) <= view["half_size"][0] and abs(down) <= view["half_size"][1]


@compiled
def _image(v: Views, i: int, R: Array, t: Array, lit: _LitPoint, uv: Array, J: Array) -> tuple[bool, float, float]:
    """As `project_view`, of the lit point, but leaves uv and J undefined if there is no projection.

    Then how far u and v move, px, if the surface moves by 1 m along its normal: the spot moves along the ray.
    """
    view = v[i]
    if not _on_screen(v, i, lit):
        return False, 0.0, 0.0
    # Image of the lit point in the camera.
    C = view["camera_rotation"]
    x = C[0, 0] * lit.x + C[0, 1] * lit.y + C[0, 2] * lit.z + view["camera_translation"][0]
    y = C[1, 0] * lit.x + C[1, 1] * lit.y + C[1, 2] * lit.z + view["camera_translation"][1]
    z = C[2, 0] * lit.x + C[2, 1] * lit.y + C[2, 2] * lit.z + view["camera_translation"][2]
    if not z > 1e-9:
        return False, 0.0, 0.0
    x, y = x / z, y / z
    bx, by, xx, xy, yx, yy = _distorted(v, i, x, y)  # and the Jacobian [[xx, xy], [yx, yy]] of the distortion
    if view["lens"] != 0 and not (x * x + y * y < view["fold_r2"] and xx * yy - xy * yx > 0.0):
        return False, 0.0, 0.0
    fx, fy = view["pinhole"][0], view["pinhole"][1]
    uv[0] = fx * bx + view["pinhole"][2] + view["shift"][0]
    uv[1] = fy * by + view["pinhole"][3] + view["shift"][1]
    # d(pixel)/d(hit), in world, row by row; the component of the vehicle's motion along the ray has no effect.
    u_along = v_along = 0.0
    lx, ly, lz = lit.x - t[0], lit.y - t[1], lit.z - t[2]  # the lever from the vehicle's origin
    for row in range(2):
        gx, gy = (fx * xx / z, fx * xy / z) if row == 0 else (fy * yx / z, fy * yy / z)
        gz = -(gx * x + gy * y)
        g0 = gx * C[0, 0] + gy * C[1, 0] + gz * C[2, 0]
        g1 = gx * C[0, 1] + gy * C[1, 1] + gz * C[2, 1]
        g2 = gx * C[0, 2] + gy * C[1, 2] + gz * C[2, 2]
        along_ray = (g0 * lit.dx + g1 * lit.dy + g2 * lit.dz) / lit.facing
        u_along, v_along = (along_ray, 0.0) if row == 0 else (u_along, along_ray)
        g0, g1, g2 = g0 - along_ray * lit.nx, g1 - along_ray * lit.ny, g2 - along_ray * lit.nz
        J[row, 0], J[row, 1], J[row, 2] = g0, g1, g2
        # g . ((R e_k) x lever) = (lever x g) . (R e_k)
        c0, c1, c2 = ly * g2 - lz * g1, lz * g0 - lx * g2, lx * g1 - ly * g0
        for k in range(3):
            J[row, 3 + k] = c0 * R[0, k] + c1 * R[1, k] + c2 * R[2, k]
    return True, u_along, v_along


@compiled_in_caller
def _lit_point(v: Views, i: int, R: Array, t: Array) -> _LitPoint:
    """Where the ray of view i meets its screen, of any extent, for a pose R (3, 3), t (3,), m."""
    view = v[i]
    S, s0, p, r = view["screen_rotation"], view["screen_origin"], view["point"], view["ray"]
    ox = R[0, 0] * p[0] + R[0, 1] * p[1] + R[0, 2] * p[2] + t[0]  # where the ray starts
    oy = R[1, 0] * p[0] + R[1, 1] * p[1] + R[1, 2] * p[2] + t[1]
    oz = R[2, 0] * p[0] + R[2, 1] * p[1] + R[2, 2] * p[2] + t[2]
    dx = R[0, 0] * r[0] + R[0, 1] * r[1] + R[0, 2] * r[2]
    dy = R[1, 0] * r[0] + R[1, 1] * r[1] + R[1, 2] * r[2]
    dz = R[2, 0] * r[0] + R[2, 1] * r[1] + R[2, 2] * r[2]
    nx, ny, nz = S[0, 2], S[1, 2], S[2, 2]
    facing = nx * dx + ny * dy + nz * dz
    height = nx * (s0[0] - ox) + ny * (s0[1] - oy) + nz * (s0[2] - oz)
    length = height / facing if abs(facing) > 1e-12 else 0.0
    if length != 0.0 and (view["bow"][0] != 0.0 or view["bow"][1] != 0.0 or view["bow"][2] != 0.0):
        length, nx, ny, nz = _intersect_bent(v, i, ox, oy, oz, dx, dy, dz, length)
        facing = nx * dx + ny * dy + nz * dz
    return _LitPoint(length, facing, dx, dy, dz, nx, ny, nz, ox + length * dx, oy + length * dy, oz + length * dz)


@compiled
def _intersect_bent(
    v: Views, i: int, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, length: float
) -> tuple[float, float, float, float]:
    """Length, m, of a ray d from a point o, m, to the bent screen of view i, and the surface's normal there, in world.

    Newton's method from the flat screen, at the given length: a bow of centimetres over metres converges to rounding in
    two or three steps; the fourth is for larger bows.
    """
    view = v[i]
    S, s0 = view["screen_rotation"], view["screen_origin"]
    a, b, c = view["bow"][0], view["bow"][1], view["bow"][2]
    p, q = np.empty(3), np.empty(3)
    for k in range(3):
        p[k] = S[0, k] * (ox - s0[0]) + S[1, k] * (oy - s0[1]) + S[2, k] * (oz - s0[2])
        q[k] = S[0, k] * dx + S[1, k] * dy + S[2, k] * dz
    for _ in range(4):
        x, y = p[0] + length * q[0], p[1] + length * q[1]
        height = p[2] + length * q[2] - (a * x * x + b * x * y + c * y * y)
        slope = q[2] - (2 * a * x + b * y) * q[0] - (b * x + 2 * c * y) * q[1]
        length -= height / (slope if abs(slope) > 1e-12 else 1.0)
    x, y = p[0] + length * q[0], p[1] + length * q[1]
    nx, ny = -(2 * a * x + b * y), -(b * x + 2 * c * y)
    return (
        length,
        S[0, 0] * nx + S[0, 1] * ny + S[0, 2],
        S[1, 0] * nx + S[1, 1] * ny + S[1, 2],
        S[2, 0] * nx + S[2, 1] * ny + S[2, 2],
    )


@compiled
def _distorted(v: Views, i: int, x: float, y: float) -> tuple[float, float, float, float, float, float]:
    """The normalised point as the lens of view i distorts it, and the entries xx, xy, yx, yy of the Jacobian."""
    view = v[i]
    kind = view["lens"]
    if kind == 0:
        return x, y, 1.0, 0.0, 0.0, 1.0
    k = view["distortion"]
    if kind == 3:
        return _fisheye(k, x, y)
    bx, by, a, b, c, e = _polynomial(k, x, y)
    if kind == 2:
        T = view["tilt"]
        hx = T[0, 0] * bx + T[0, 1] * by + T[0, 2]
        hy = T[1, 0] * bx + T[1, 1] * by + T[1, 2]
        hz = T[2, 0] * bx + T[2, 1] * by + T[2, 2]
        bx, by = hx / hz, hy / hz
        d00, d01 = (T[0, 0] - bx * T[2, 0]) / hz, (T[0, 1] - bx * T[2, 1]) / hz
        d10, d11 = (T[1, 0] - by * T[2, 0]) / hz, (T[1, 1] - by * T[2, 1]) / hz
        a, b, c, e = d00 * a + d01 * c, d00 * b + d01 * e, d10 * a + d11 * c, d10 * b + d11 * e
    return bx, by, a, b, c, e


@compiled_in_caller
def _polynomial(k: Array, x: float, y: float) -> tuple[float, float, float, float, float, float]:
    """As `_distorted`, with twelve polynomial coefficients k, the first of (14,)."""
    r2 = x * x + y * y
    p1, p2 = k[2], k[3]
    denominator = 1 + r2 * (k[5] + r2 * (k[6] + r2 * k[7]))
    radial = (1 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))) / denominator
    d_radial = (
        k[0] + r2 * (2 * k[1] + 3 * r2 * k[4]) - radial * (k[5] + r2 * (2 * k[6] + 3 * r2 * k[7]))
    ) / denominator  # by r2
    d_prism_x, d_prism_y = k[8] + 2 * r2 * k[9], k[10] + 2 * r2 * k[11]
    bx = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) + r2 * (k[8] + r2 * k[9])
    by = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y + r2 * (k[10] + r2 * k[11])
    mixed = 2 * x * y * d_radial + 2 * p1 * x + 2 * p2 * y
    a = radial + 2 * x * x * d_radial + 2 * p1 * y + 6 * p2 * x + 2 * x * d_prism_x
    b = mixed + 2 * y * d_prism_x
    c = mixed + 2 * x * d_prism_y
    e = radial + 2 * y * y * d_radial + 6 * p1 * y + 2 * p2 * x + 2 * y * d_prism_y
    return bx, by, a, b, c, e


@compiled_in_caller
def _fisheye(k: Array, x: float, y: float) -> tuple[float, float, float, float, float, float]:
    """As `_distorted`, with the four coefficients k of a fisheye lens, the first of (14,)."""
    r2 = x * x + y * y
    scale, growth = 1.0, 0.0
    if r2 >= 1e-16:
        r = np.sqrt(r2)
        angle = np.arctan(r)
        w = angle * angle
        drawn = angle * (1 + w * (k[0] + w * (k[1] + w * (k[2] + w * k[3]))))
        slope = 1 + w * (3 * k[0] + w * (5 * k[1] + w * (7 * k[2] + w * 9 * k[3])))
        scale = drawn / r
        growth = (slope / (1 + r2) - scale) / r2  # d(scale)/dr / r
    return (
        scale * x,
        scale * y,
        scale + growth * x * x,
        growth * x * y,
        growth * x * y,
        scale + growth * y * y,
    )


@compiled
def distort_all(xy: Array, k: Array, fisheye: Bools) -> tuple[Array, Array]:
    """Distorted points (n, 2) and Jacobians (n, 2, 2) of normalised points xy (n, 2), without the sensor's tilt.

    k (1 or n, 14), fisheye (1 or n): the coefficients of all points, or of each, and whose model's they are.
    """
    out, J = np.empty_like(xy), np.empty((len(xy), 2, 2))
    for i in range(len(xy)):
        own, wide = k[i if len(k) > 1 else 0], fisheye[i if len(fisheye) > 1 else 0]
        point = distorted_point(own, wide, xy[i, 0], xy[i, 1])
        out[i, 0], out[i, 1], J[i, 0, 0], J[i, 0, 1], J[i, 1, 0], J[i, 1, 1] = point
    return out, J


@compiled
def distorted_point(k: Array, fisheye: bool, x: float, y: float) -> tuple[float, float, float, float, float, float]:
    """One point of `distort_all`, and the entries xx, xy, yx, yy of its Jacobian; k (14,)."""
    return _fisheye(k, x, y) if fisheye else _polynomial(k, x, y)


@compiled
def by_coefficients_all(xy: Array, k: Array, fisheye: Bools) -> Array:
    """Derivatives (n, 2, 14) of distorted points by all coefficients k, of a sensor without tilt; as `distort_all`."""
    J = np.zeros((len(xy), 2, 14))
    for i in range(len(xy)):
        own, wide = k[i if len(k) > 1 else 0], fisheye[i if len(fisheye) > 1 else 0]
        by_coefficients(own, wide, xy[i, 0], xy[i, 1], J[i])
    return J


@compiled
def by_coefficients(k: Array, fisheye: bool, x: float, y: float, J: Array) -> None:
    """Writes the derivatives of one point of `by_coefficients_all` to J (2, 14), which is 0 where a lens has none."""
    r2 = x * x + y * y
    if fisheye:
        r = np.sqrt(r2)
        angle = np.arctan(r)
        scale = angle * angle * angle / (r if r > 1e-8 else 1.0)
        for column in range(4):
            J[0, column], J[1, column] = x * scale, y * scale
            scale *= angle * angle
        return
    r4, r6 = r2 * r2, r2 * r2 * r2
    denominator = 1 + r2 * (k[5] + r2 * (k[6] + r2 * k[7]))
    radial = (1 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))) / denominator
    for column, power in ((0, r2), (1, r4), (4, r6)):
        J[0, column], J[1, column] = x * power / denominator, y * power / denominator
    for column, power in ((5, r2), (6, r4), (7, r6)):
        change = -radial * power / denominator
        J[0, column], J[1, column] = x * change, y * change
    J[0, 2], J[1, 2] = 2 * x * y, r2 + 2 * y * y
    J[0, 3], J[1, 3] = r2 + 2 * x * x, 2 * x * y
    J[0, 8], J[0, 9] = r2, r4
    J[1, 10], J[1, 11] = r2, r4
    bx, by = _polynomial(k, x, y)[:2]
    J[0, 12], J[1, 12] = bx * by, by * by
    J[0, 13], J[1, 13] = -bx * bx, -bx * by


@compiled
def undistort_all(v: Views, target: Array) -> Array:
    """Normalised points (n, 2) whose distortion by the lens of v[0] is `target` (n, 2); nan without one.

    Newton's method from the target itself. Each step is shortened until the point stays inside the fold and the
    residual does not grow.
    """
    lens = v[0]
    limit = np.sqrt(lens["fold_r2"]) * (1 - 1e-9)
    out = np.empty_like(target)
    for i in range(len(target)):
        radius = np.sqrt(target[i, 0] ** 2 + target[i, 1] ** 2)
        inside_fold = min(1.0, 0.7 * limit / max(radius, 1e-300))
        x, y = target[i, 0] * inside_fold, target[i, 1] * inside_fold
        bx, by, xx, xy, yx, yy = _distorted(v, 0, x, y)
        du, dv = target[i, 0] - bx, target[i, 1] - by
        for _ in range(60):
            det = xx * yy - xy * yx
            if abs(det) < 1e-12:
                det = 1e-12
            step_x, step_y = (yy * du - xy * dv) / det, (xx * dv - yx * du) / det
            moved = False
            for _ in range(12):
                px, py = x + step_x, y + step_y
                bx, by, axx, axy, ayx, ayy = _distorted(v, 0, px, py)
                eu, ev = target[i, 0] - bx, target[i, 1] - by
                if eu * eu + ev * ev <= du * du + dv * dv and np.sqrt(px * px + py * py) < limit:
                    x, y, xx, xy, yx, yy, du, dv = px, py, axx, axy, ayx, ayy, eu, ev
                    moved = abs(step_x) > 1e-15 or abs(step_y) > 1e-15
                    break
                step_x, step_y = step_x / 2, step_y / 2
            if not moved:
                break
        found = np.sqrt(du * du + dv * dv) < 1e-9 and x * x + y * y < lens["fold_r2"] and xx * yy - xy * yx > 0.0
        out[i, 0], out[i, 1] = (x, y) if found else (np.nan, np.nan)
    return out


def lens_codes(distortion: Array, fisheye: Bools) -> Array:
    """The field `lens` of VIEW (n,), from distortion numbers (n, 14) and whether they are the fisheye model's (n,)."""

    bent = np.any(distortion != 0, axis=-1)
    tilted = np.any(distortion[..., 12:] != 0, axis=-1)
    return np.where(fisheye, 3, np.where(tilted, 2, np.where(bent, 1, 0))).astype(np.int64)
