"""The frame of a screen and its surface: origin and axes, flatness, residual scatter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq
from scipy.special import chdtrc, fdtrc

from geometry.arrays import NORMAL_MEDIAN, Array, Bools, cross, normalised
from geometry.pose import Pose

# Definition of a screen's frame: its origin and axes.
#
# It is defined by named dots. Without them the origin is the centre of the dots' extent, z points to the side of the
# cameras that observe the screen, y as close to the world's z as the plane allows (to its y if the screen is
# horizontal), and x = y x z.


def plane_through(points: Array) -> tuple[Array, Array, Array]:
    """Middle (3,), unit normal (3,) and RMS extents (3,) along the three axes, largest first, m, of points (n, 3)."""
    middle = points.mean(axis=0)
    _, s, axes = np.linalg.svd(points - middle, full_matrices=False)
    extents = np.zeros(3)
    extents[: len(s)] = s / np.sqrt(len(points))
    normal = axes[2] if len(axes) > 2 else cross(axes[0], axes[1])
    return middle, normal, extents


def frame_of_extent(points: Array, seen_from: Array | None = None) -> Pose:
    """world_from_screen from points (n, 3), m, of a screen; z towards `seen_from` (3,), if given."""
    middle, normal, _ = plane_through(points)
    if seen_from is not None:
        normal = normal if normal @ (seen_from - middle) >= 0 else -normal
    elif normal[np.argmax(np.abs(normal))] < 0:
        normal = -normal
    upward = np.array([0.0, 0.0, 1.0])
    if abs(normal @ upward) > 0.9:  # within 26 deg of horizontal the world's z hardly defines a direction
        upward = np.array([0.0, 1.0, 0.0])
    y = normalised(upward - (upward @ normal) * normal)
    R = np.stack([cross(y, normal), y, normal], axis=1)
    flat = (points - middle) @ R[:, :2]
    centre = (flat.min(axis=0) + flat.max(axis=0)) / 2
    return Pose(R, middle + R[:, :2] @ centre)


def frame_of_dots(points: Array, origin: Array, along_x: Array, on_y_side: Array, origin_at: Array) -> Pose:
    """world_from_screen from three named dots (3,) each, m: `origin` has the coordinates `origin_at` (2,), m.

    x points from it towards `along_x`; y is positive on the side of `on_y_side`. Raises ValueError: the three dots are
    collinear.
    """
    _, normal, _ = plane_through(points)
    x = along_x - origin
    x = x - (x @ normal) * normal
    side = on_y_side - origin
    across = side - (side @ normal) * normal - (side @ normalised(x)) * normalised(x)
    if np.linalg.norm(across) < 0.02 * np.linalg.norm(x) or np.linalg.norm(x) < 1e-6:
        raise ValueError("the three dots of the frame lie on one line")
    x, y = normalised(x), normalised(across)
    R = np.stack([x, y, cross(x, y)], axis=1)
    return Pose(R, origin - R[:, :2] @ origin_at)


# Flatness of a screen: a plane or a bent surface fitted to measured points, with the residual scatter.
#
# In a frame nearly in the plane of the screen, a surface is a polynomial of the height z over x and y, and its fit is
# linear: z = h + p x + q y [+ a x^2 + b x y + c y^2]. Ours; scatter in excess of the points' sigmas is estimated as in
# Paule and Mandel (1982), "Consensus values and weighting factors", J. Res. NBS 87(5), eq. 8.

SIGNIFICANT = 0.01  # p-value below which a screen is bent, or a survey is worse than its sigmas
OUTLIER_SIGMAS = 5.0  # of a point's own sigma and the surface's, above which the point is not on the screen
_MOST_OUTLIERS = 0.3  # of all points; with more outliers the screen cannot be identified
_MANY = 60  # points above which an outlier hardly bends the surface, and leave-one-out tests take too long
_SMALLEST_SIGMA_M = 2e-5  # m: no painted screen is smoother


@dataclass(frozen=True, slots=True)
class Surface:
    """A polynomial surface over the x-y plane, fitted to points."""

    bent: bool
    coefficients: Array  # (6,): h (m), p, q (rad, nearly), a, b, c (1/m); the last three are 0 for a plane
    covariance: Array  # (6, 6); 0 for the last three of a plane
    heights_m: Array  # (n,): of the points over the surface
    sigma_m: Array  # (n,): of a point's height, including the scatter of the surface
    scatter_m: float  # sigma of the surface about the polynomial, in excess of the points' sigmas
    used: Bools  # (n,): False for outliers, which are not on the screen
    p_fits: float  # p-value of the misfit, if the points' own sigmas are its only cause

    @property
    def rms_m(self) -> float:
        """RMS of the used points' heights."""
        return float(np.sqrt(np.mean(self.heights_m[self.used] ** 2)))

    @property
    def largest_m(self) -> float:
        """The largest distance of a used point from the surface."""
        return float(np.max(np.abs(self.heights_m[self.used])))


@dataclass(frozen=True, slots=True)
class Flatness:
    """The plane, the bent surface if there are enough points, and the chosen one of them."""

    flat: Surface
    bent: Surface | None  # None: too few points
    p_flat: float  # p-value of the bend, if the screen is flat; nan if unknown
    chosen: Surface


def assess_flatness(xyz: Array, sigma_m: Array, bow: str = "auto", scatter_m: float | None = None) -> Flatness:
    """The surface that fits the points: a plane, or a bent surface if its bend is significant.

    xyz (n, 3), m, in a frame within a few degrees of the screen; sigma_m (n,): of z. bow: "auto" tests the bend,
    "always" and "never" do not. scatter_m: of the surface, if known.
    """
    # Outliers are those that do not even fit a bent surface, so that a bow does not cause any.
    enough = len(xyz) >= 9
    used = _inliers_of_surface(xyz, sigma_m, bent=enough and bow != "never", scatter_m=scatter_m)
    flat = fit_surface(xyz, sigma_m, False, scatter_m, used)
    bent = fit_surface(xyz, sigma_m, True, scatter_m, used) if np.sum(used) >= 7 else None
    p_flat = float("nan") if bent is None else _p_flat(flat, bent, sigma_m, scatter_m)
    take_bent = bent is not None and (
        bow == "always" or (bow == "auto" and flat.p_fits < SIGNIFICANT and p_flat < SIGNIFICANT)
    )
    return Flatness(flat, bent, p_flat, bent if bent is not None and take_bent else flat)


def fit_surface(
    xyz: Array, sigma_m: Array, bent: bool, scatter_m: float | None = None, used: Bools | None = None
) -> Surface:
    """Weighted least squares. scatter_m None: estimated, 0 if the points' sigmas explain the residuals.

    Raises ValueError: the used points do not determine the surface.
    """
    use = np.ones(len(xyz), dtype=bool) if used is None else used
    A = _polynomial(xyz[:, :2], bent)
    if np.sum(use) < A.shape[1] or np.linalg.matrix_rank(_balanced(A[use]), tol=1e-6) < A.shape[1]:
        raise ValueError(f"{int(np.sum(use))} points do not determine a {'bent surface' if bent else 'plane'}")
    dof = int(np.sum(use)) - A.shape[1]
    own = np.maximum(sigma_m, 1e-9)

    def misfit(scatter: float) -> float:
        _, left = _least_squares(A[use], xyz[use, 2], np.hypot(own[use], scatter))
        return float(np.sum((left / np.hypot(own[use], scatter)) ** 2))

    p_fits = float(chdtrc(dof, misfit(0.0))) if dof else 1.0
    scatter = scatter_m if scatter_m is not None else 0.0
    if scatter_m is None and p_fits < SIGNIFICANT:
        top = 10 * float(np.std(xyz[use, 2])) + float(np.max(own[use]))
        scatter = float(brentq(lambda s: misfit(s) - dof, 0.0, top, xtol=1e-9))
    total = np.hypot(own, scatter)
    covariance, _ = _least_squares(A[use], xyz[use, 2], total[use])
    found = covariance @ (A[use].T @ (xyz[use, 2] / total[use] ** 2))
    out_c, out_C = np.zeros(6), np.zeros((6, 6))
    out_c[: len(found)], out_C[: len(found), : len(found)] = found, covariance
    return Surface(bent, out_c, out_C, xyz[:, 2] - A @ found, total, scatter, use, p_fits)


def smallest_scatter(scatter_m: float) -> float:
    """A screen's surface scatter, limited from below."""
    return max(scatter_m, _SMALLEST_SIGMA_M)


def _polynomial(xy: Array, bent: bool) -> Array:
    x, y = xy[:, 0], xy[:, 1]
    columns = [np.ones_like(x), x, y] + ([x * x, x * y, y * y] if bent else [])
    return np.stack(columns, axis=1)


def _balanced(A: Array) -> Array:
    """The matrix with columns of length one, so that its rank does not depend on units."""
    length = np.linalg.norm(A, axis=0)
    return A / np.where(length > 0, length, 1.0)


def _least_squares(A: Array, z: Array, sigma: Array) -> tuple[Array, Array]:
    """Covariance of the coefficients, and the residuals of z."""
    W = A / sigma[:, None]
    scale = np.linalg.norm(W, axis=0)
    inverse = np.linalg.inv((W / scale).T @ (W / scale)) / np.outer(scale, scale)
    return inverse, z - A @ (inverse @ (W.T @ (z / sigma)))


def _p_flat(flat: Surface, bent: Surface, sigma_m: Array, scatter_m: float | None) -> float:
    """P-value of the improvement by three more parameters, if the screen is flat."""
    use = flat.used
    # Both with the sigmas of the bent surface: otherwise the plane's misfit would count as scatter.
    sigma = bent.sigma_m[use] if scatter_m is None else np.hypot(sigma_m[use], scatter_m)
    gain = float(np.sum((flat.heights_m[use] / sigma) ** 2) - np.sum((bent.heights_m[use] / sigma) ** 2))
    dof = int(np.sum(use)) - 6
    if scatter_m is not None or bent.scatter_m == 0 or dof < 1:
        return float(chdtrc(3, max(gain, 0.0)))
    return float(fdtrc(3, dof, max(gain, 0.0) / 3))


def _inliers_of_surface(xyz: Array, sigma_m: Array, bent: bool, scatter_m: float | None) -> Bools:
    """Which points lie on the screen, by removing the worst outlier repeatedly.

    Each is tested against the surface through the others, because one outlier of six bends the surface through all.
    """
    used = np.ones(len(xyz), dtype=bool)
    if len(xyz) > _MANY:
        return _robust_inliers(xyz, sigma_m, bent)
    fewest = 8 if bent else 5
    while np.sum(used) > max(fewest, (1 - _MOST_OUTLIERS) * len(xyz)):
        worst, largest = -1, OUTLIER_SIGMAS
        for i in np.flatnonzero(used):
            rest = used.copy()
            rest[i] = False
            try:
                surface = fit_surface(xyz, sigma_m, bent, scatter_m, rest)
            except ValueError:
                continue  # the others do not determine a surface, so that this point cannot be tested
            row = _polynomial(xyz[i : i + 1, :2], bent)[0]
            C = surface.covariance[: len(row), : len(row)]
            # With few points the scatter is uncertain: Student's t has wide tails for few degrees of freedom.
            wide = 1.0 if surface.scatter_m == 0 else np.sqrt(1 + 6 / max(int(np.sum(rest)) - len(row), 1))
            off = abs(surface.heights_m[i]) / (wide * np.sqrt(surface.sigma_m[i] ** 2 + row @ C @ row))
            if off > largest:
                worst, largest = int(i), float(off)
        if worst < 0:
            break
        used[worst] = False
    return used


def _robust_inliers(xyz: Array, sigma_m: Array, bent: bool) -> Bools:
    """Which of many points are within five sigmas of the surface, by a robust sigma from their median distance."""
    used = np.ones(len(xyz), dtype=bool)
    for _ in range(10):
        surface = fit_surface(xyz, sigma_m, bent, 0.0, used)
        scatter = float(np.median(np.abs(surface.heights_m))) / NORMAL_MEDIAN
        now = np.abs(surface.heights_m) < OUTLIER_SIGMAS * np.maximum(scatter, sigma_m)
        if np.array_equal(now, used) or np.mean(now) < 0.5:
            break
        used = now
    return used
