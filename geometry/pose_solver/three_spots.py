"""The poses that three spots allow, by the real roots of a polynomial."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np

from geometry.arrays import Array
from geometry.compilation.jit import compiled
from geometry.pose import Pose

# Real roots of polynomials of degree 8, compiled. Coefficients are given with the lowest power first. Source: ours.


@compiled
def add_product(out: Array, a: Array, deg_a: int, b: Array, deg_b: int, factor: float) -> None:
    """out += factor a b, of polynomials a and b of the given degrees."""
    for i in range(deg_a + 1):
        x = factor * a[i]
        if x != 0.0:
            for j in range(deg_b + 1):
                out[i + j] += x * b[j]


@compiled
def roots_within(p: Array, d: Array, before: Array, roots: Array) -> int:
    """Writes the real roots in [-1, 1] of a polynomial p (9,) to roots (9,), ascending; returns their number.

    d, before (9,) are scratch. Between two neighbouring zeros of its derivative a polynomial has at most one root, so
    the roots of the derivatives are found from the linear one upwards. A minimum that misses zero by less than the
    rounding of the coefficients counts as a root: a double one.
    """
    size = 0.0
    for r in range(9):
        size = max(size, abs(p[r]))
    if not size > 0.0:
        return 0
    count = 0
    for degree in range(1, 9):
        # The derivative of this degree, of order 8 - degree.
        for r in range(degree + 1):
            factor = 1.0
            for s in range(8 - degree):
                factor *= (r + 8 - degree - s) / (8 - s)
            d[r] = p[r + 8 - degree] * factor
        for r in range(count):
            before[r] = roots[r]
        extremes, count = count, 0
        left, at_left = -1.0, _value(d, degree, -1.0)
        for r in range(extremes + 1):
            right = before[r] if r < extremes else 1.0
            at_right = _value(d, degree, right)
            if at_left == 0.0:
                roots[count] = left
                count += 1
            elif (at_left < 0.0) != (at_right < 0.0) and at_right != 0.0:
                roots[count] = _root_between(d, degree, left, right, at_left)
                count += 1
            elif degree == 8 and r < extremes and abs(at_right) < 1e-12 * size:
                roots[count] = right
                count += 1
            left, at_left = right, at_right
        if at_left == 0.0:
            roots[count] = left
            count += 1
        if count > degree:
            count = degree
    return count


@compiled
def _value(p: Array, degree: int, x: float) -> float:
    """The value at x of a polynomial of this degree."""
    y = p[degree]
    for r in range(degree - 1, -1, -1):
        y = y * x + p[r]
    return y


@compiled
def _root_between(p: Array, degree: int, left: float, right: float, at_left: float) -> float:
    """The root in an interval with a change of sign: Newton's method, and bisection where that leaves the interval."""
    x = 0.5 * (left + right)
    for _ in range(60):
        y, slope = p[degree], 0.0
        for r in range(degree - 1, -1, -1):
            slope = slope * x + y
            y = y * x + p[r]
        if (y < 0.0) == (at_left < 0.0):
            left = x
        else:
            right = x
        step = y / slope
        x_new = x - step
        if not (left < x_new < right):
            x_new = 0.5 * (left + right)
        if abs(x_new - x) < 1e-14:
            return x_new
        x = x_new
    return x


# All poses that put three rays of the vehicle through three known points, compiled.
#
# The rays are given in body, the points in world. This is the generalised perspective-three-point problem: with the
# rays through one point it is P3P (Grunert 1841), otherwise it has up to eight solutions (Nister & Stewenius 2007, "A
# minimal solution to the generalised 3-point pose problem", J. Math. Imaging Vis. 27). The formulation by the three
# lengths is theirs; the elimination and the root finder are ours.
#
# With q_i = p_i + l_i d_i the lit point of ray i in body, the distances between the lit points are those between the
# world points X_i:
#
#     |q_i - q_j|^2 = l_i^2 + l_j^2 - 2 c_ij l_i l_j + e_ij l_i + f_ij l_j + g_ij = 0,    c_ij = d_i . d_j.
#
# The pair (1, 3) is a quadratic in l_1 with coefficients that depend on x = l_3, the pair (2, 3) one in l_2: l_1^2 +
# B_1 l_1 + C_1 = 0 and l_2^2 + B_2 l_2 + C_2 = 0. Subtracting both from the pair (1, 2) leaves an equation that is
# linear in l_1, so l_1 = -N / M with N and M linear in l_2. Substituted into the first quadratic and reduced by the
# second, this becomes P(x) l_2 + Q(x) = 0; substituted into the second quadratic, it gives Q^2 - B_2 P Q + C_2 P^2 =
# 0, of degree 8 in x.


MOST_POSES = 8
# Two rays are parallel where the sine of their angle is below this: a distance then does not bound their lengths.
PARALLEL = 1e-7
# Three points are on one line where the sine of the angle at the first is below this: a turn about the line is free.
COLLINEAR = 1e-9
SAME = 1e-7  # lengths that differ by less, relative to the largest distance, are the same solution
# Squared distances must agree to this, relative to the largest one: rounding leaves about 1e-15.
EXACT = 1e-10

Coefficients: TypeAlias = tuple[float, float, float, float]  # c, e, f, g of the equation of a pair of rays


def poses_from_three_spots(points: Array, rays: Array, world: Array) -> Pose:
    """All poses (..., 8), world from body, that put three rays through three points; nan where there are fewer.

    points, rays: (..., 3, 3), m and unit, in body, one row per ray; world: (..., 3, 3), m, one row per point. All are
    broadcast. Each point lies ahead on its ray (positive length). Three points on a line, or three parallel rays, have
    a continuum of solutions or none: nan.
    """
    stack = np.broadcast_shapes(points.shape[:-2], rays.shape[:-2], world.shape[:-2])
    flat = [
        np.array(np.broadcast_to(a, (*stack, 3, 3)), dtype=np.float64, order="C").reshape(-1, 3, 3)
        for a in (points, rays, world)
    ]
    R, t = solve_many(*flat)
    return Pose(R.reshape(*stack, MOST_POSES, 3, 3), t.reshape(*stack, MOST_POSES, 3))


@compiled
def solve_many(points: Array, rays: Array, world: Array) -> tuple[Array, Array]:
    """As `poses_from_three_spots`, of stacks (m, 3, 3): rotations (m, 8, 3, 3) and translations (m, 8, 3)."""
    m = world.shape[0]
    R, t = np.full((m, 8, 3, 3), np.nan), np.full((m, 8, 3), np.nan)
    work, lengths = np.empty((16, 9)), np.empty((8, 3))
    for k in range(m):
        count = spot_lengths(points[k], rays[k], world[k], work, lengths)
        kept = 0
        for s in range(count):
            if pose_of_lengths(points[k], rays[k], world[k], lengths[s], R[k, kept], t[k, kept]):
                kept += 1
    return R, t


@compiled
def spot_lengths(points: Array, rays: Array, world: Array, work: Array, out: Array) -> int:
    """Writes all positive lengths (l_1, l_2, l_3), m, to the rows of out (8, 3); returns their number.

    points, rays, world (3, 3) as in `poses_from_three_spots`; work (16, 9) is scratch.
    """
    # The most nearly parallel pair goes first: the distances to the third ray then bound the lengths.
    i, j, k = 0, 1, 2
    s01, s02, s12 = _sine2(rays, 0, 1), _sine2(rays, 0, 2), _sine2(rays, 1, 2)
    if s02 < s01 and s02 <= s12:
        i, j, k = 0, 2, 1
    elif s12 < s01 and s12 < s02:
        i, j, k = 1, 2, 0
    pair12 = _distance_equation(points, rays, world, i, j)
    pair13 = _distance_equation(points, rays, world, i, k)
    pair23 = _distance_equation(points, rays, world, j, k)
    size2 = max(_gap2(world, i, j), max(_gap2(world, i, k), _gap2(world, j, k)))
    if not size2 > 0.0:
        return 0
    low, high = _range_of_third(pair13, pair23, size2)
    if not (high < np.inf and high > low - 1e-9 * np.sqrt(size2)):
        return 0
    margin = 1e-7 * (high - low) + 1e-9 * np.sqrt(size2)
    middle, half = 0.5 * (low + high), 0.5 * (high - low) + margin
    _eliminate(pair12, pair13, pair23, middle, half, work)
    roots = work[15]
    count = roots_within(work[9], work[13], work[14], roots)
    c, e, f, g = pair12
    c1, e1, f1, g1 = pair13
    c2, e2, f2, g2 = pair23
    found = 0
    for r in range(count):
        x = middle + half * roots[r]
        d1, d2 = e1 - 2 * c1 * x, e2 - 2 * c2 * x
        r1 = np.sqrt(max(d1 * d1 - 4 * ((x + f1) * x + g1), 0.0))
        r2 = np.sqrt(max(d2 * d2 - 4 * ((x + f2) * x + g2), 0.0))
        for which in range(4):
            l1 = 0.5 * (-d1 + (r1 if which % 2 == 0 else -r1))
            l2 = 0.5 * (-d2 + (r2 if which < 2 else -r2))
            # One or two of the four combinations nearly fulfil the equation of the pair (1, 2).
            if abs(l1 * l1 + l2 * l2 - 2 * c * l1 * l2 + e * l1 + f * l2 + g) > 1e-2 * size2:
                continue
            l1, l2, l3, misfit = _refined(pair12, pair13, pair23, l1, l2, x, size2)
            if not (misfit < EXACT * size2 and l1 > 0.0 and l2 > 0.0 and l3 > 0.0):
                continue
            new = found < 8
            for other in range(found):
                difference = max(abs(out[other, i] - l1), max(abs(out[other, j] - l2), abs(out[other, k] - l3)))
                if difference < SAME * np.sqrt(size2):
                    new = False
            if new:
                out[found, i], out[found, j], out[found, k] = l1, l2, l3
                found += 1
    return found


@compiled
def _range_of_third(pair13: Coefficients, pair23: Coefficients, size2: float) -> tuple[float, float]:
    """The range of l_3, m, in which both quadratics have real roots; high < low if there is none, inf if unbounded.

    B^2 - 4 C >= 0 with B = e - 2 c x and C = x^2 + f x + g.
    """
    low, high = 0.0, np.inf
    for c, e, f, g in (pair13, pair23):
        A, B, C = 1.0 - c * c, f + c * e, g - 0.25 * e * e  # A x^2 + B x + C <= 0
        if A < PARALLEL**2:
            continue
        root2 = B * B - 4 * A * C
        if root2 < 0.0:
            if root2 < -1e-9 * size2:
                return np.inf, -np.inf
            root2 = 0.0
        root = np.sqrt(root2)
        low, high = max(low, (-B - root) / (2 * A)), min(high, (-B + root) / (2 * A))
    return low, high


@compiled
def _eliminate(
    pair12: Coefficients, pair13: Coefficients, pair23: Coefficients, middle: float, half: float, work: Array
) -> None:
    """Writes the polynomial of degree 8 in z = (x - middle) / half to work[9], lowest power first.

    work (16, 9): its rows hold the polynomials of the derivation at the top, in z.
    """
    c, e, f, g = pair12
    c1, e1, f1, g1 = pair13
    c2, e2, f2, g2 = pair23
    B1, C1, B2, C2 = work[0], work[1], work[2], work[3]
    B1[0], B1[1] = e1 - 2 * c1 * middle, -2 * c1 * half
    C1[0], C1[1], C1[2] = (middle + f1) * middle + g1, (2 * middle + f1) * half, half * half
    B2[0], B2[1] = e2 - 2 * c2 * middle, -2 * c2 * half
    C2[0], C2[1], C2[2] = (middle + f2) * middle + g2, (2 * middle + f2) * half, half * half
    m, n, h = work[4], work[5], work[6]  # l_1 = -(n l_2 + h) / (m - 2 c l_2)
    m[0], m[1] = e - B1[0], -B1[1]
    n[0], n[1] = f - B2[0], -B2[1]
    h[0], h[1], h[2] = g - C1[0] - C2[0], -C1[1] - C2[1], -C1[2] - C2[2]
    P, Q, p = work[7], work[8], work[9]
    a2, a1, a0 = work[10], work[11], work[12]  # of a2 l_2^2 + a1 l_2 + a0
    for r in range(9):
        a2[r] = a1[r] = a0[r] = P[r] = Q[r] = p[r] = 0.0
    t, u = work[13], work[14]
    add_product(a2, n, 1, n, 1, 1.0)
    add_product(a2, B1, 1, n, 1, 2 * c)
    for r in range(3):
        a2[r] += 4 * c * c * C1[r]
    for r in range(9):
        t[r] = 0.0
    add_product(t, n, 1, m, 1, 1.0)
    for r in range(3):
        t[r] -= 2 * c * h[r]
    add_product(a1, n, 1, h, 2, 2.0)
    add_product(a1, B1, 1, t, 2, -1.0)
    add_product(a1, m, 1, C1, 2, -4 * c)
    for r in range(9):
        t[r] = u[r] = 0.0
    add_product(t, h, 2, m, 1, 1.0)
    add_product(u, m, 1, m, 1, 1.0)
    add_product(a0, h, 2, h, 2, 1.0)
    add_product(a0, B1, 1, t, 3, -1.0)
    add_product(a0, C1, 2, u, 2, 1.0)
    for r in range(9):
        P[r], Q[r] = a1[r], a0[r]
    add_product(P, a2, 2, B2, 1, -1.0)
    add_product(Q, a2, 2, C2, 2, -1.0)
    for r in range(9):
        t[r] = u[r] = 0.0
    add_product(p, Q, 4, Q, 4, 1.0)
    add_product(t, P, 3, Q, 4, 1.0)
    add_product(p, B2, 1, t, 7, -1.0)
    add_product(u, P, 3, P, 3, 1.0)
    add_product(p, C2, 2, u, 6, 1.0)


@compiled
def _refined(
    pair12: Coefficients, pair13: Coefficients, pair23: Coefficients, l1: float, l2: float, l3: float, size2: float
) -> tuple[float, float, float, float]:
    """Newton's method on the three lengths, m; returns them with the largest misfit of a squared distance, m^2."""
    c, e, f, g = pair12
    c1, e1, f1, g1 = pair13
    c2, e2, f2, g2 = pair23
    misfit = np.inf
    for _ in range(6):
        F12 = l1 * l1 + l2 * l2 - 2 * c * l1 * l2 + e * l1 + f * l2 + g
        F13 = l1 * l1 + l3 * l3 - 2 * c1 * l1 * l3 + e1 * l1 + f1 * l3 + g1
        F23 = l2 * l2 + l3 * l3 - 2 * c2 * l2 * l3 + e2 * l2 + f2 * l3 + g2
        misfit = max(abs(F12), max(abs(F13), abs(F23)))
        if misfit < 1e-15 * size2:
            break
        a, b = 2 * l1 - 2 * c * l2 + e, 2 * l2 - 2 * c * l1 + f
        a_, b_ = 2 * l1 - 2 * c1 * l3 + e1, 2 * l3 - 2 * c1 * l1 + f1
        a__, b__ = 2 * l2 - 2 * c2 * l3 + e2, 2 * l3 - 2 * c2 * l2 + f2
        # [[a, b, 0], [a_, 0, b_], [0, a__, b__]] by Cramer's rule
        det = -a * b_ * a__ - b * a_ * b__
        if det == 0.0:
            break
        l1 -= (-F12 * b_ * a__ - b * (F13 * b__ - b_ * F23)) / det
        l2 -= (a * (F13 * b__ - b_ * F23) - F12 * a_ * b__) / det
        l3 -= (-a * F13 * a__ - b * a_ * F23 + F12 * a_ * a__) / det
    return l1, l2, l3, misfit


@compiled
def pose_of_lengths(points: Array, rays: Array, world: Array, lengths: Array, R: Array, t: Array) -> bool:
    """Writes the pose that puts the lit points p_i + l_i d_i on the world points to R (3, 3), t (3,).

    False, and nothing written, if the points lie on one line.
    """
    q, body, lab = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    for i in range(3):
        for a in range(3):
            q[i, a] = points[i, a] + lengths[i] * rays[i, a]
    if not (_triangle_axes(q, body) and _triangle_axes(world, lab)):
        return False
    for a in range(3):
        for b in range(3):
            R[a, b] = lab[0, a] * body[0, b] + lab[1, a] * body[1, b] + lab[2, a] * body[2, b]
    for a in range(3):
        s = 0.0
        for i in range(3):
            s += world[i, a] - (R[a, 0] * q[i, 0] + R[a, 1] * q[i, 1] + R[a, 2] * q[i, 2])
        t[a] = s / 3
    return True


@compiled
def _triangle_axes(corners: Array, out: Array) -> bool:
    """Writes a triangle's axes to the rows of out (3, 3): first side, across it in the plane, normal.

    False if the corners (3, 3) lie on one line.
    """
    a0, a1, a2 = corners[1, 0] - corners[0, 0], corners[1, 1] - corners[0, 1], corners[1, 2] - corners[0, 2]
    b0, b1, b2 = corners[2, 0] - corners[0, 0], corners[2, 1] - corners[0, 1], corners[2, 2] - corners[0, 2]
    n0, n1, n2 = a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0
    long = np.sqrt(a0 * a0 + a1 * a1 + a2 * a2)
    area = np.sqrt(n0 * n0 + n1 * n1 + n2 * n2)
    if not area > COLLINEAR * (a0 * a0 + a1 * a1 + a2 * a2 + b0 * b0 + b1 * b1 + b2 * b2):
        return False
    out[0, 0], out[0, 1], out[0, 2] = a0 / long, a1 / long, a2 / long
    out[2, 0], out[2, 1], out[2, 2] = n0 / area, n1 / area, n2 / area
    out[1, 0] = out[2, 1] * out[0, 2] - out[2, 2] * out[0, 1]
    out[1, 1] = out[2, 2] * out[0, 0] - out[2, 0] * out[0, 2]
    out[1, 2] = out[2, 0] * out[0, 1] - out[2, 1] * out[0, 0]
    return True


@compiled
def _sine2(rays: Array, i: int, j: int) -> float:
    """The squared sine of the angle between two unit rays, by the cross product: accurate for small angles."""
    x = rays[i, 1] * rays[j, 2] - rays[i, 2] * rays[j, 1]
    y = rays[i, 2] * rays[j, 0] - rays[i, 0] * rays[j, 2]
    z = rays[i, 0] * rays[j, 1] - rays[i, 1] * rays[j, 0]
    return x * x + y * y + z * z


@compiled
def _gap2(points: Array, i: int, j: int) -> float:
    """Squared distance, m^2, of two rows."""
    s = 0.0
    for a in range(3):
        s += (points[i, a] - points[j, a]) ** 2
    return s


@compiled
def _distance_equation(points: Array, rays: Array, world: Array, i: int, j: int) -> Coefficients:
    """c, e, f, g of l_i^2 + l_j^2 - 2 c l_i l_j + e l_i + f l_j + g = 0 for the rays i and j."""
    c = e = f = 0.0
    for a in range(3):
        gap = points[i, a] - points[j, a]
        c += rays[i, a] * rays[j, a]
        e += 2 * gap * rays[i, a]
        f -= 2 * gap * rays[j, a]
    return c, e, f, _gap2(points, i, j) - _gap2(world, i, j)
