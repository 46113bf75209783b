"""The lens models: OpenCV's distortions of normalised image points, their Jacobians, and the radius where they fold.

The perspective model has twelve polynomial coefficients and two tilt angles, in OpenCV's order: k1, k2, p1, p2, k3, k4,
k5, k6, s1, s2, s3, s4, tau_x, tau_y. The fisheye model has four. Source: OpenCV, calib3d, "Detailed description"; the
tests compare with cv2.projectPoints and cv2.fisheye.projectPoints.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.polynomial import polynomial as poly

from geometry.arrays import Array, Bools
from geometry.compiled_projection import VIEW, by_coefficients_all, distort_all, lens_codes, undistort_all

N_DISTORTION = 14
ALLOWED_LENGTHS = (0, 4, 5, 8, 12, 14)


def padded(distortion: tuple[float, ...]) -> Array:
    """All fourteen coefficients (14,) of a model given by its first 0, 4, 5, 8, 12 or 14."""
    out = np.zeros(N_DISTORTION)
    out[: len(distortion)] = distortion
    return out


def distort(xy: Array, coefficients: Array, fisheye: Bools | bool = False) -> tuple[Array, Array]:
    """Distorted normalised points (..., 2) and d(distorted)/d(xy) (..., 2, 2).

    xy (..., 2): X/Z and Y/Z in the camera frame. coefficients (..., 14), broadcast against the points' leading axes, as
    fisheye (...): whether they are the fisheye model's, k1, k2, k3, k4 and zeros. Its radius of an angle t off the axis
    is t (1 + k1 t^2 + k2 t^4 + ...). Source: OpenCV, calib3d, "Fisheye camera model".
    """
    stack, wide, numbers = _for_compiled(xy, coefficients, fisheye)
    rows, J_rows = distort_all(*numbers)
    out, J = rows.reshape(*stack, 2), J_rows.reshape(*stack, 2, 2)
    tau_x, tau_y = np.where(wide, 0.0, coefficients[..., 12]), np.where(wide, 0.0, coefficients[..., 13])
    return _tilt(out, J, tau_x, tau_y) if np.any(tau_x) or np.any(tau_y) else (out, J)


def _for_compiled(
    xy: Array, coefficients: Array, fisheye: Bools | bool
) -> tuple[tuple[int, ...], Bools, tuple[Array, Array, Bools]]:
    """The points' leading axes, which are fisheye lenses, and the arguments of `distort_all`."""
    wide = np.asarray(fisheye, dtype=bool)
    stack = np.broadcast_shapes(xy.shape[:-1], coefficients.shape[:-1], wide.shape)
    k = coefficients if coefficients.ndim == 1 else np.broadcast_to(coefficients, (*stack, N_DISTORTION))
    wide = wide if wide.ndim == 0 else np.broadcast_to(wide, stack)
    # Copies, because read-only arrays have another type for numba, which would compile a second time for them.
    points = np.array(np.broadcast_to(xy, (*stack, 2)), dtype=np.float64, order="C").reshape(-1, 2)
    k = np.array(k, dtype=np.float64, order="C").reshape(-1, N_DISTORTION)
    return stack, wide, (points, k, np.array(wide, order="C").reshape(-1))


def _tilt(xy: Array, J: Array, tau_x: Array, tau_y: Array) -> tuple[Array, Array]:
    """Distorted points (..., 2) and Jacobians (..., 2, 2) after the Scheimpflug tilt of the sensor, applied last."""
    out, _, D = _tilted(tilt_matrix(np.asarray(tau_x), np.asarray(tau_y)), xy)
    return out, D @ J


def _tilted(T: Array, xy: Array) -> tuple[Array, Array, Array]:
    """Points (..., 2) after the homography T (..., 3, 3), their depths (..., 1), and the Jacobians (..., 2, 2)."""
    h = _turned(T, xy)
    out = h[..., :2] / h[..., 2:]
    return out, h[..., 2:], (T[..., :2, :2] - out[..., :, None] * T[..., 2:, :2]) / h[..., 2:, None]


def coefficient_jacobian(xy: Array, coefficients: Array, fisheye: Bools | bool = False) -> Array:
    """d(distorted)/d(coefficients) (..., 2, 14) of `distort`; arguments as there."""
    stack, wide, numbers = _for_compiled(xy, coefficients, fisheye)
    J = by_coefficients_all(*numbers).reshape(*stack, 2, N_DISTORTION)
    tau_x, tau_y = np.where(wide, 0.0, coefficients[..., 12]), np.where(wide, 0.0, coefficients[..., 13])
    if not (np.any(tau_x) or np.any(tau_y)):
        return J
    T, *dT = np.moveaxis(tilt_with_derivatives(tau_x, tau_y), -3, 0)
    bent = distort_all(*numbers)[0].reshape(*stack, 2)
    out, depth, D = _tilted(T, bent)
    J[..., :12] = D @ J[..., :12]
    for column in (0, 1):
        dh = _turned(dT[column], bent)
        by_tilt = (dh[..., :2] - out * dh[..., 2:]) / depth
        J[..., 12 + column] = np.where(wide[..., None], 0.0, by_tilt)
    return J


def _turned(T: Array, xy: Array) -> Array:
    """T (..., 3, 3) applied to points (..., 2), as (..., 3)."""
    return np.asarray(T[..., 0] * xy[..., :1] + T[..., 1] * xy[..., 1:] + T[..., 2])


def tilt_with_derivatives(tau_x: Array, tau_y: Array) -> Array:
    """The tilt homography, d(T)/d(tau_x) and d(T)/d(tau_y) (..., 3, 3, 3): the product rule on T = along(R) R.

    Constant entries of the factors cancel in the differences.
    """
    cx, sx, cy, sy = np.cos(tau_x), np.sin(tau_x), np.cos(tau_y), np.sin(tau_y)
    R = _tilt_rotation(cx, sx, cy, sy)
    by_x = _tilt_rotation(-sx, cx, cy, sy) - _tilt_rotation(0 * cx, 0 * sx, cy, sy)
    by_y = _tilt_rotation(cx, sx, -sy, cy) - _tilt_rotation(cx, sx, 0 * cy, 0 * sy)
    along = _along_axis(R)
    parts = [
        along @ R,
        (_along_axis(by_x) - _along_axis(0 * by_x)) @ R + along @ by_x,
        (_along_axis(by_y) - _along_axis(0 * by_y)) @ R + along @ by_y,
    ]
    return np.stack(parts, axis=-3)


def _tilt_rotation(cx: Array, sx: Array, cy: Array, sy: Array) -> Array:
    """R_y R_x (..., 3, 3) of OpenCV's tilt, from the cosines and sines of its angles."""
    about_x, about_y = np.zeros((*np.shape(cx), 3, 3)), np.zeros((*np.shape(cx), 3, 3))
    about_x[..., 0, 0] = about_y[..., 1, 1] = 1.0
    about_x[..., 1, 1], about_x[..., 1, 2], about_x[..., 2, 1], about_x[..., 2, 2] = cx, sx, -sx, cx
    about_y[..., 0, 0], about_y[..., 0, 2], about_y[..., 2, 0], about_y[..., 2, 2] = cy, -sy, sy, cy
    return about_y @ about_x


def _along_axis(R: Array) -> Array:
    """The projection (..., 3, 3) onto the sensor along the optical axis, of the tilt's rotation (..., 3, 3)."""
    out = np.zeros(R.shape)
    out[..., 0, 0] = out[..., 1, 1] = R[..., 2, 2]
    out[..., 0, 2], out[..., 1, 2] = -R[..., 0, 2], -R[..., 1, 2]
    out[..., 2, 2] = 1.0
    return out


def tilt_matrix(tau_x: Array, tau_y: Array) -> Array:
    """OpenCV's tilt homography (..., 3, 3) of the two angles (...), rad."""
    R = _tilt_rotation(np.cos(tau_x), np.sin(tau_x), np.cos(tau_y), np.sin(tau_y))
    return _along_axis(R) @ R


@lru_cache(maxsize=256)  # a camera is made again for each step of an adjustment, mostly with the same lens
def fold_limit(distortion: tuple[float, ...]) -> float:
    """The squared normalised radius at which the distorted image stops growing in some direction; inf if it never does.

    Beyond it two directions share one pixel: a point far outside the picture would seem to lie in it. The limit is the
    first root of d(r N/D)/dr = 0 or of D = 0, with N, D the model's numerator and denominator. The contribution of the
    tangential and prism terms in their worst direction, r^2 (3 p1 sin + 3 p2 cos) and so on, is subtracted from that
    slope: where it comes close to zero without reaching it, these terms alone can fold the image. Source: ours.
    """
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = padded(distortion)[:12]
    N = np.array([1.0, 0, k1, 0, k2, 0, k3])  # polynomials in r, lowest power first
    D = np.array([1.0, 0, k4, 0, k5, 0, k6])
    slope = poly.polysub(
        poly.polymul(poly.polyadd(N, poly.polymulx(poly.polyder(N))), D),
        poly.polymul(poly.polymulx(N), poly.polyder(D)),
    )
    worst = np.array([0.0, 6 * np.hypot(p1, p2) + 2 * np.hypot(s1, s3), 0, 4 * np.hypot(s2, s4)])
    growth = poly.polysub(slope, poly.polymul(worst, poly.polymul(D, D)))
    return min(_first_sign_change(growth), _first_sign_change(D)) ** 2


def _first_sign_change(p: Array) -> float:
    """The smallest r in (0, 1e6) at which a polynomial (n,), lowest power first, p[0] = 1, becomes negative; else inf.

    The roots are computed in 1/r, where the leading coefficient is 1: a highest power that is only rounding (a k3 of
    1e-20 from a calibration) then does no harm. Each root is verified and refined by bisection.
    """
    inverse = np.roots(p)
    near_real = (inverse.real > 1e-6) & (np.abs(inverse.imag) <= 1e-5 * np.abs(inverse))
    for r in sorted(1 / w for w in inverse.real[near_real]):
        below, above = r * (1 - 1e-5), r * (1 + 1e-5)
        if poly.polyval(below, p) > 0 > poly.polyval(above, p):
            return _bisected(p, below, above)
    return np.inf


def _bisected(p: Array, below: float, above: float) -> float:
    """The zero of a polynomial (n,) that is positive at `below` and negative at `above`, to the last bit."""
    while True:
        middle = 0.5 * (below + above)
        if not below < middle < above:
            return middle
        if poly.polyval(middle, p) > 0:
            below = middle
        else:
            above = middle


def is_one_to_one(xy: Array, jacobian: Array, fold_r2: Array) -> Bools:
    """Whether the model is one to one at points (..., 2): inside the fold, and with a positive determinant."""
    r2 = np.sum(xy * xy, axis=-1)
    det = jacobian[..., 0, 0] * jacobian[..., 1, 1] - jacobian[..., 0, 1] * jacobian[..., 1, 0]
    return (r2 < fold_r2) & (det > 0)


@lru_cache(maxsize=256)
def fisheye_fold_limit(distortion: tuple[float, ...]) -> float:
    """As `fold_limit`, for the fisheye model: inf where the radius grows up to 90 deg off the axis."""
    k1, k2, k3, k4 = padded(distortion)[:4]
    slope = np.array([1.0, 0, 3 * k1, 0, 5 * k2, 0, 7 * k3, 0, 9 * k4])
    limit = _first_sign_change(slope)
    return float(np.tan(limit) ** 2) if limit < np.pi / 2 else np.inf


def undistort(target: Array, coefficients: Array, fold_r2: float, fisheye: bool = False) -> Array:
    """Normalised points (n, 2) whose distortion is `target` (n, 2); nan where there is none inside the fold."""
    target = np.array(target, dtype=np.float64, order="C")
    coefficients = np.asarray(coefficients, dtype=float)
    lens = np.zeros(1, VIEW)
    lens["distortion"], lens["tilt"], lens["fold_r2"] = coefficients, tilt_matrix(*coefficients[-2:]), fold_r2
    lens["lens"] = lens_codes(coefficients, np.asarray(fisheye))
    return undistort_all(lens, target)
