"""Fit of a lens model to the corners of one camera, with rejection of outliers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.special import chdtrc

from calibration.least_squares.adjustment import Adjusted, Cauchy, Limits, Values, Vectors
from calibration.lens.fit.corner_table import CornerTable
from calibration.lens.fit.lens_adjustment import BRIEF, CONVERGED, FitSettings, adjust, term_of, with_circle_radius
from calibration.lens.fit.lens_models import LensModel
from calibration.lens.fit.lens_parameters import BoardFreedom, lens_of
from calibration.terms.surveyed import array_of, pose_of
from geometry.arrays import Array, Bools, Ints, robust_sigma
from geometry.pose import Pose

FEWEST_CORNERS = 6  # of a view: four determine its pose, the others contribute to the lens
# Residual length of a corner, in sigmas of one coordinate, above which it is an outlier: of normal errors one in 25 000
# exceeds it, so that rejection changes the sigma of a set without outliers by less than 0.1 %.
CORNER_GATE = 4.5
# A view with residuals this many times those of the median view was blurred, or its board moved.
VIEW_GATE = 3.0
_NOISE_DIFFERS = 1e-3  # p-value of the same noise in all views below which each has its own ...
_NOISE_RATIO = 1.5  # ... if the largest is that many times the smallest: weights change little below it
_ROUNDS = 6  # of fitting and rejecting; all sets tried so far converge within three


@dataclass(frozen=True, slots=True)
class LensFit:
    """The least-squares solution for a lens, the poses of the board and its shape."""

    model: LensModel
    values: Values  # parameter blocks; the world frame is the camera's
    adjusted: Adjusted
    used: Bools  # (N,)
    residuals: Array  # (N, 2), px, of ALL corners: projected minus measured; nan for those of views without a pose
    sigma_px: float  # of a corner's coordinate, from the residuals of the used corners and their degrees of freedom
    relative_sigma: float  # sigma_px in units of the sigma assumed in the adjustment
    board: BoardFreedom
    dropped: Mapping[int, str] = field(default_factory=dict)  # view -> reason why it is excluded

    @property
    def lens(self) -> Array:
        """(18,): fx, fy, cx, cy and fourteen distortion coefficients."""
        return lens_of(self.values)

    @property
    def warp(self) -> Array:
        """(3,), 1/m."""
        return array_of(self.values, "warp")[0]

    @property
    def stretch(self) -> Array:
        """(2,): relative excess length of the board along x, and how far x shifts with y."""
        return array_of(self.values, "stretch")[0]

    @property
    def printed(self) -> Array:
        """(P, 3), m: displacement of each point of the board from its stated position."""
        return array_of(self.values, "print")

    @property
    def radius_m(self) -> float:
        """Radius of the board's circles; 0 if its points are not circles."""
        return float(array_of(self.values, "radius")[0, 0])

    @property
    def radius_sigma_m(self) -> float:
        """1 sigma of the radius; 0 if the points are not circles. Raises AdjustmentError."""
        return float(np.sqrt(self.adjusted.covariance([("radius", 0)])[0, 0])) * self.relative_sigma

    @property
    def poses(self) -> Pose:
        """camera_from_board of all V views."""
        return pose_of(self.values, "boards")

    @property
    def covariance(self) -> Array:
        """Joint covariance (p, p) of the model's parameters, from the scatter of corners. Raises AdjustmentError."""
        whole = self.adjusted.covariance([("intrinsics", 0)])
        free = self.model.free
        return whole[np.ix_(free, free)] * self.relative_sigma**2


def fit(
    table: CornerTable,
    used: Bools,
    model: LensModel,
    values: Values,
    board: BoardFreedom,
    dropped: Mapping[int, str] = {},
    limits: Limits = CONVERGED,
) -> LensFit:
    """Plain least squares over the used corners (N,).

    The sigma of a corner is estimated from the start values. It only sets the size of the last step: a model that
    misses by pixels need not converge to a thousandth of a pixel. Raises AdjustmentError: the adjustment is singular or
    does not converge.
    """
    values, _ = with_circle_radius(table, used, model, values)
    scale = _spread((_residuals(table, used, model, values) / table.noise[:, None])[used])
    adjusted = adjust(table, used, model, values, board, FitSettings(scale, limits=limits))
    everything = term_of(table, np.ones(len(table), dtype=bool), model.fisheye)
    residuals = everything.project(adjusted.values) - table.pixels
    residuals[~(table.counts(used) > 0)[table.view]] = np.nan
    relative = float(np.sqrt(adjusted.chi2 / max(adjusted.dof, 1)))
    return LensFit(model, adjusted.values, adjusted, used, residuals, relative * scale, relative, board, dict(dropped))


def robust_fit(
    table: CornerTable,
    model: LensModel,
    values: Values,
    board: BoardFreedom,
    limits: Limits = CONVERGED,
    search: Limits = BRIEF,
) -> LensFit:
    """The fit without outliers: these are detected under a Cauchy loss and then excluded.

    values must hold a pose for each view; a view whose pose is nan is excluded. search: of the outliers.

    Raises AdjustmentError: too few corners remain, or they do not determine the parameters.
    """
    dropped = _without_pose(table, values)
    candidates = ~np.isin(table.view, list(dropped))
    values, _ = with_circle_radius(table, candidates, model, values)
    noise = table.noise[:, None]
    residuals = _residuals(table, candidates, model, values)
    candidates &= np.isfinite(residuals).all(axis=1)  # others are beyond the angle at which the start's lens folds
    sigma = _spread((residuals / noise)[candidates])
    for _ in range(2):  # the scale of the loss is from residuals, which the first round reduces
        adjusted = adjust(table, candidates, model, values, board, FitSettings(sigma, Cauchy(), search))
        values = adjusted.values
        residuals = _residuals(table, candidates, model, values)
        smaller = _spread((residuals / noise)[candidates])
        if smaller > 0.8 * sigma:
            break
        sigma = smaller
    sigma = smaller
    dropped |= _bad_views(table, residuals, candidates, sigma, dropped)
    used = _used(table, residuals, sigma, dropped)
    for _ in range(_ROUNDS):
        found = fit(table, used, model, values, board, dropped, limits)
        values = found.values
        again = _used(table, found.residuals, found.sigma_px, dropped)
        if np.array_equal(again, used):
            break
        used = again
    return found


def _residuals(table: CornerTable, candidates: Bools, model: LensModel, values: Values) -> Array:
    """(N, 2), px; nan for all but the candidates."""
    out = np.full((len(table), 2), np.nan)
    term = term_of(table, candidates, model.fisheye)
    values = {**values, "intrinsics": Vectors(model.cut(lens_of(values))[None])}
    out[candidates] = term.project(values) - term.pixels
    return out


def _spread(residuals: Array) -> float:
    """Robust sigma of a coordinate from the median of residuals (n, 2), with a breakdown point of 50 %; >= 1e-6 px."""
    return max(float(robust_sigma(residuals)), 1e-6)


def _without_pose(table: CornerTable, values: Values) -> dict[int, str]:
    lost = ~np.isfinite(pose_of(values, "boards").translation).all(axis=1)
    few = table.counts() < FEWEST_CORNERS
    out = {int(v): "no pose of the board explains its corners" for v in np.flatnonzero(lost)}
    return out | {int(v): f"fewer than {FEWEST_CORNERS} corners" for v in np.flatnonzero(few)}


def _bad_views(
    table: CornerTable, residuals: Array, candidates: Bools, sigma: float, dropped: Mapping[int, str]
) -> dict[int, str]:
    """Views in which most corners are outliers, or which are much worse than the others, with the reason."""
    length = np.linalg.norm(residuals, axis=1)
    typical = np.full(table.views, np.nan)
    for v in set(range(table.views)) - set(dropped):
        mine = (table.view == v) & candidates
        typical[v] = np.median(length[mine] / (1.0 if table.picture_noise is None else table.picture_noise[mine]))
    median = float(np.nanmedian(typical))
    good = table.mean_per_view((length < CORNER_GATE * sigma * table.noise).astype(float), candidates)
    out = {}
    for v in np.flatnonzero(np.isfinite(typical)).tolist():
        if typical[v] > VIEW_GATE * median:
            out[v] = (
                f"its residuals of {typical[v]:.2f} px are {typical[v] / median:.1f} times those of the median view:"
                " the view is blurred, or the board or the camera moved"
            )
        elif good[v] * table.counts()[v] < FEWEST_CORNERS or good[v] < 0.5:
            out[v] = f"only {good[v]:.0%} of its corners fit the board"
    return out


def _used(table: CornerTable, residuals: Array, sigma: float, dropped: Mapping[int, str]) -> Bools:
    """(N,): corners within the gate, in views that are not dropped."""
    with np.errstate(invalid="ignore"):
        near = np.linalg.norm(residuals, axis=1) < CORNER_GATE * sigma * table.noise
    return near & ~np.isin(table.view, list(dropped))


def used_views(fit: LensFit, table: CornerTable) -> Ints:
    """Indices of the views that have used corners."""
    return np.flatnonzero(table.counts(fit.used) > 0)


def with_picture_noise(table: CornerTable, found: LensFit) -> CornerTable:
    """The table with the noise of each corner by that of the picture; None where the residuals do not show it.

    Corners have the noise of the picture, which is large where squares are small, edges wide or markers near; and that
    of all other causes, which is the same for all. The shares of both have the maximum likelihood over all corners,
    also those that the fit rejects: with the noise of most, it rejects just the noisy ones, and the others do not show
    how noise differs. What is an outlier in any case has the density of a corner at the gate.
    """
    same = replace(table, picture_noise=None)
    if table.sigmas_px is None:
        return same
    own2 = (table.sigmas_px / np.median(table.sigmas_px)) ** 2
    there = np.isfinite(found.residuals).all(axis=1)
    length2 = np.sum(found.residuals[there] ** 2, axis=1)
    outlier = 2 * np.log(np.mean(np.sum(found.residuals[found.used] ** 2, axis=1)) / 2) + CORNER_GATE**2

    def variance(common: float) -> Array:
        return np.asarray(common + (1 - common) * own2)

    def deviance(common: float) -> float:
        w, used = variance(common)[there], found.used[there]
        for _ in range(_ROUNDS):
            v = w * np.mean((length2 / w)[used]) / 2
            one_by_one = 2 * np.log(v) + length2 / v
            before, used = used, one_by_one < outlier
            if np.array_equal(before, used):
                break
        return float(np.sum(np.minimum(one_by_one, outlier)))

    common = float(minimize_scalar(deviance, bounds=(0.0, 1.0), method="bounded").x)
    if chdtrc(1, max(deviance(1.0) - deviance(common), 0.0)) >= _NOISE_DIFFERS:
        return same
    noise = np.sqrt(variance(common))
    return replace(table, picture_noise=noise / np.median(noise[found.used]))


def with_view_noise(table: CornerTable, found: LensFit) -> CornerTable:
    """The table with a factor on the noise of each view, from its residuals; as it is where all may have the same.

    Near boards are out of focus, far ones sharp: in sets of real photographs the noise differs by up to 3.5 times.
    Bartlett's test (1937, Proc. R. Soc. A 160). Views that are not used have the noise of all.
    """
    numbers = table.counts(found.used) * 2.0 - 6
    mine = numbers > 0
    dof = np.where(mine, numbers * (1 - found.model.free.sum() / max(numbers[mine].sum(), 1)), 0.0)
    lengths2 = np.where(found.used, np.sum(found.residuals**2, axis=1) / table.noise**2, 0.0)
    squares = np.bincount(table.view, weights=lengths2, minlength=table.views)
    if mine.sum() < 2 or np.min(dof[mine]) <= 0 or np.min(squares[mine]) <= 0:
        return table
    common, dof = squares[mine].sum() / dof.sum(), dof[mine]
    variance = squares[mine] / dof
    score = dof.sum() * np.log(common) - np.sum(dof * np.log(variance))
    score /= 1 + (np.sum(1 / dof) - 1 / dof.sum()) / (3 * (len(dof) - 1))
    if chdtrc(len(dof) - 1, score) >= _NOISE_DIFFERS or variance.max() < _NOISE_RATIO**2 * variance.min():
        return table
    noise = np.ones(table.views)
    noise[mine] = np.sqrt(variance / common)
    return replace(table, view_noise=noise)
