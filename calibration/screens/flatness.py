"""How flat a screen is: a plane or a bent surface through measured points, and what is left of them.

In a frame that lies nearly in the screen a surface is a polynomial of the height z over x and y, and its fit linear:
z = h + p x + q y [+ a x^2 + b x y + c y^2]. Ours; the scatter beyond the points' own sigmas is found as in Paule and
Mandel (1982), "Consensus values and weighting factors", J. Res. NBS 87(5), eq. 8.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq
from scipy.stats import chi2, f

from geometry.arrays import Array, Bools

SIGNIFICANT = 0.01  # chance at which a flat screen is called bent, or a good survey worse than its sigmas
OUTLIER_SIGMAS = 5.0  # a point farther off, of its own sigma and the surface's, was not on the screen
_MOST_OUTLIERS = 0.3  # of all points; with more there is no telling what is the screen
_MANY = 60  # points beyond which a wrong one hardly bends the surface, and judging each by the others takes long
_SMALLEST_SIGMA_M = 2e-5  # m: no painted screen is smoother


@dataclass(frozen=True, slots=True)
class Surface:
    """A polynomial surface over the x-y plane and what the points say of it."""

    bent: bool
    coefficients: Array  # (6,): h (m), p, q (rad, nearly), a, b, c (1/m); the last three 0 where it is flat
    covariance: Array  # (6, 6); 0 for the last three where it is flat
    heights_m: Array  # (n,): points over the surface
    sigma_m: Array  # (n,): of a point's height: its own, and the surface's scatter
    scatter_m: float  # sigma of the surface about the polynomial, beyond what the points' own sigmas explain
    used: Bools  # (n,): False for points that are not on the screen
    p_fits: float  # chance of a misfit as large as found where nothing but the points' own sigmas acts

    @property
    def rms_m(self) -> float:
        """Of the used points' heights."""
        return float(np.sqrt(np.mean(self.heights_m[self.used] ** 2)))

    @property
    def largest_m(self) -> float:
        """The largest distance of a used point from the surface."""
        return float(np.max(np.abs(self.heights_m[self.used])))


@dataclass(frozen=True, slots=True)
class Flatness:
    """The plane, the bent surface where one can be fitted, and which of them the points ask for."""

    flat: Surface
    bent: Surface | None  # None: too few points
    p_flat: float  # chance that a flat screen would look as bent as this one; nan where nothing can be said
    chosen: Surface


def judge_flatness(xyz: Array, sigma_m: Array, bow: str = "auto", scatter_m: float | None = None) -> Flatness:
    """The surface that points ask for.

    xyz (n, 3), m, in a frame that lies in the screen to a few degrees; sigma_m (n,): of z. bow: "auto" takes the bent
    surface where it is significant, "always" and "never" do not ask. scatter_m: of the surface, where known.
    """
    # What does not fit even a bent surface is no part of the screen; a bow must not be taken for outliers.
    enough = len(xyz) >= 9
    used = _on_surface(xyz, sigma_m, bent=enough and bow != "never", scatter_m=scatter_m)
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
    """Weighted least squares. scatter_m None: as large as the points ask for, 0 where their sigmas explain them.

    Raises ValueError where the used points do not determine the surface.
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

    p_fits = float(chi2.sf(misfit(0.0), dof)) if dof else 1.0
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
    """The scatter that a screen's surface is given at least."""
    return max(scatter_m, _SMALLEST_SIGMA_M)


def _polynomial(xy: Array, bent: bool) -> Array:
    x, y = xy[:, 0], xy[:, 1]
    columns = [np.ones_like(x), x, y] + ([x * x, x * y, y * y] if bent else [])
    return np.stack(columns, axis=1)


def _balanced(A: Array) -> Array:
    """Columns of length one, so that a rank does not depend on units."""
    length = np.linalg.norm(A, axis=0)
    return A / np.where(length > 0, length, 1.0)


def _least_squares(A: Array, z: Array, sigma: Array) -> tuple[Array, Array]:
    """Covariance of the coefficients and what is left of z."""
    W = A / sigma[:, None]
    scale = np.linalg.norm(W, axis=0)
    inverse = np.linalg.inv((W / scale).T @ (W / scale)) / np.outer(scale, scale)
    return inverse, z - A @ (inverse @ (W.T @ (z / sigma)))


def _p_flat(flat: Surface, bent: Surface, sigma_m: Array, scatter_m: float | None) -> float:
    """Chance of a gain by three more numbers as large as found, if the screen is flat."""
    use = flat.used
    # The same sigmas for both, those of the better surface: else the plane's misfit is called scatter.
    sigma = bent.sigma_m[use] if scatter_m is None else np.hypot(sigma_m[use], scatter_m)
    gain = float(np.sum((flat.heights_m[use] / sigma) ** 2) - np.sum((bent.heights_m[use] / sigma) ** 2))
    dof = int(np.sum(use)) - 6
    if scatter_m is not None or bent.scatter_m == 0 or dof < 1:
        return float(chi2.sf(max(gain, 0.0), 3))
    return float(f.sf(max(gain, 0.0) / 3, 3, dof))


def _on_surface(xyz: Array, sigma_m: Array, bent: bool, scatter_m: float | None) -> Bools:
    """Which points lie on the screen: the worst one goes while it is far off what the others say of it.

    Each is judged by the surface through the others, since one wrong point of six bends the surface through all.
    """
    used = np.ones(len(xyz), dtype=bool)
    if len(xyz) > _MANY:
        return _near_most(xyz, sigma_m, bent)
    fewest = 8 if bent else 5
    while np.sum(used) > max(fewest, (1 - _MOST_OUTLIERS) * len(xyz)):
        worst, largest = -1, OUTLIER_SIGMAS
        for i in np.flatnonzero(used):
            rest = used.copy()
            rest[i] = False
            try:
                surface = fit_surface(xyz, sigma_m, bent, scatter_m, rest)
            except ValueError:
                continue  # the others do not determine a surface: nothing can be said of this point
            row = _polynomial(xyz[i : i + 1, :2], bent)[0]
            C = surface.covariance[: len(row), : len(row)]
            # Few others give an uncertain scatter: a Student's t of few degrees has wide tails.
            wide = 1.0 if surface.scatter_m == 0 else np.sqrt(1 + 6 / max(int(np.sum(rest)) - len(row), 1))
            off = abs(surface.heights_m[i]) / (wide * np.sqrt(surface.sigma_m[i] ** 2 + row @ C @ row))
            if off > largest:
                worst, largest = int(i), float(off)
        if worst < 0:
            break
        used[worst] = False
    return used


def _near_most(xyz: Array, sigma_m: Array, bent: bool) -> Bools:
    """Which of many points lie within five of their common scatter, as their median distance shows it."""
    used = np.ones(len(xyz), dtype=bool)
    for _ in range(10):
        surface = fit_surface(xyz, sigma_m, bent, 0.0, used)
        # The median distance of a Gaussian is 0.6745 sigmas.
        scatter = float(np.median(np.abs(surface.heights_m))) / 0.6745
        now = np.abs(surface.heights_m) < OUTLIER_SIGMAS * np.maximum(scatter, sigma_m)
        if np.array_equal(now, used) or np.mean(now) < 0.5:
            break
        used = now
    return used
