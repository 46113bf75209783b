"""Poses and spots in closed form: from beams of which both spots are seen, and from coplanar beams."""

from __future__ import annotations

import numpy as np

from geometry.arrays import Array, Bools, normalised
from geometry.planes import common_perpendicular, nearest_point
from geometry.pose import Pose

# The pose in closed form from beams of which both spots are seen.
#
# It is a start value for geometry/pose_solver/gauss_newton.py. For three single spots see
# geometry/pose_solver/three_spots.py. Source: ours; the rotation from directions is Wahba's problem, solved by scipy
# (Kabsch's method).


def pose_from_lines(
    beam_points: Array, beam_directions: Array, line_points: Array, line_directions: Array
) -> Pose | None:
    """world_from_body from m >= 2 beams, in body, observed as lines, in world; points (m, 3), m, directions (m, 3).

    A beam's direction has the same sense in both frames. Kabsch's method on the directions gives the rotation. Each
    line, shifted by its beam's point, then passes through the origin of body, which is the point nearest to all shifted
    lines. The beams need not meet. None if all are parallel.
    """
    body, world = normalised(beam_directions), normalised(line_directions)
    if len(body) < 2 or np.linalg.matrix_rank(body, tol=1e-6) < 2:
        return None
    from scipy.spatial.transform import Rotation  # imported here because the import takes 0.1 s

    R = Rotation.align_vectors(world, body)[0].as_matrix()
    origin = nearest_point(line_points - beam_points @ R.T, world)
    return None if np.isnan(origin).any() else Pose(R, origin)


# The paper's closed forms for a spot out of view: coplanar beams through one point.
#
# Source: Huo, Yang & Yang, Optics and Precision Engineering 23(8), 2015, section 4.2, eqs. (10) to (14), with its
# misprints corrected: (11) C = B + k (B - A) is right, and the coefficients of (14) belong to it; (12) must end in
# X_B, Y_B; l begins with (X_B - X_O)^2. The formulas are written with vectors, so that the screen may be any plane,
# and with two angles, which may differ.
#
# O is the point where the beams meet; A, B, C are the spots of three beams on one screen, in this order; alpha is the
# angle AOB and beta the angle BOC.


# Largest difference, rad, between the angle AOC of the accepted root and alpha + beta. With noise, the wrong root (it
# gives A, or a point behind O) is off by at least the smaller of 2 alpha and 180 deg - 2 alpha.
ANGLE_TOLERANCE = np.deg2rad(3.0)


def meeting_point(point_a: Array, direction_a: Array, point_b: Array, direction_b: Array) -> Array:
    """O (..., 3), m: the middle of the common perpendicular of two beams. Points (..., 3), m, directions (..., 3)."""
    on_a, on_b = common_perpendicular(point_a, direction_a, point_b, direction_b)
    return 0.5 * (on_a + on_b)


def quadratic_coefficients(O: Array, A: Array, B: Array, beta: float) -> tuple[Array, Array, Array]:
    """a, b, c (...) of the paper's a k^2 + b k + c = 0, eq. (14), for C = B + k (B - A) and the angle BOC = beta.

    O, A, B (..., 3), m; beta in rad.
    """
    OB, AB = B - O, B - A
    l = np.sum(OB * OB, axis=-1)
    m = np.sum(OB * AB, axis=-1)
    cos2 = np.cos(beta) ** 2
    m1 = l * np.sum(AB * AB, axis=-1) * cos2
    m2 = 2 * cos2 * l * m
    m3 = cos2 * l * l
    return m1 - m * m, m2 - 2 * m * l, m3 - l * l


def outer_spot(O: Array, A: Array, B: Array, alpha: float, beta: float) -> Array:
    """C (..., 3), m, eq. (11): the spot beyond B, of a beam at the angle `beta` (rad) from B's; nan if it misses.

    O, A, B (..., 3), m, in world; alpha, the calibrated angle AOB, and beta are in (0, pi/2). Of the two roots of eq.
    (14), the one with k > 0 and an angle AOC of alpha + beta, within ANGLE_TOLERANCE, is taken. The paper's rule, "the
    root whose angle AOC is 2 alpha", is not fulfilled by any root if the beam points away from the plane (8 % of
    geometries for alpha of 10 to 30 deg, 90 % for 60 to 89 deg); the nearest root is then A itself.
    """
    a, b, c = quadratic_coefficients(O, A, B, beta)
    with np.errstate(invalid="ignore", divide="ignore"):
        # b^2 - 4ac = 4 l^2 sin^2(beta) cos^2(beta) |OB x AB|^2 >= 0; rounding may make it negative.
        root = np.sqrt(np.maximum(b * b - 4 * a * c, 0.0))
        # The form without cancellation: one root is q / a, the other c / q. If a = 0 (OC parallel to AB), k is inf.
        q = -0.5 * (b + np.where(b >= 0, root, -root))
        k = np.stack([q / a, c / q], axis=-1)  # (..., 2)
        C = B[..., None, :] + k[..., None] * (B - A)[..., None, :]
        OA, OC = normalised(A - O)[..., None, :], normalised(C - O[..., None, :])
        off = np.abs(_angle(OA, OC) - (alpha + beta))
        fits = np.isfinite(k) & (k > 0) & (off < ANGLE_TOLERANCE)
        best = np.argmin(np.where(fits, off, np.inf), axis=-1)
    chosen = np.take_along_axis(C, best[..., None, None], axis=-2)[..., 0, :]
    return np.where(np.any(fits, axis=-1, keepdims=True), chosen, np.nan)


def middle_spot(O: Array, A: Array, C: Array, alpha: float, beta: float, world_from_screen: Pose) -> Array:
    """B (..., 3), m: the spot between A and C, of a beam `alpha` from A's and `beta` from C's (rad); nan if it misses.

    The paper has no formula like eq. (14) for the middle beam: OA is rotated towards OC by the share
    alpha / (alpha + beta) of the measured angle AOC, then intersected with the screen. Source: ours.
    """
    OA, OC = normalised(A - O), normalised(C - O)
    across = normalised(OC - np.sum(OA * OC, axis=-1)[..., None] * OA)
    turn = _angle(OA, OC) * (alpha / (alpha + beta))
    ray = np.cos(turn)[..., None] * OA + np.sin(turn)[..., None] * across
    normal = world_from_screen.rotation[:, 2]
    facing = ray @ normal
    height = (world_from_screen.translation - O) @ normal
    with np.errstate(invalid="ignore", divide="ignore"):
        t = height / facing
        ahead: Bools = np.asarray((t > 0) & np.isfinite(t))
        return np.where(ahead[..., None], O + t[..., None] * ray, np.nan)


def _angle(a: Array, b: Array) -> Array:
    """Angle (...), rad, between unit vectors; accurate near 0 and pi too."""

    return 2 * np.arctan2(np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1))
