"""Intrinsic calibration of a camera from photographs of a board: lens model, parameters and covariance."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from calibration.least_squares.adjustment import AdjustmentError, Values
from calibration.lens.board_shape import MOST_POINTS, SIGNIFICANT, BoardShapeOptions, BoardTest, WarpTest, board_test
from calibration.lens.fit.corner_table import CornerTable
from calibration.lens.fit.coverage import Coverage, coverage_of, seen_at, spread_deg
from calibration.lens.fit.lens_adjustment import BRIEF
from calibration.lens.fit.lens_fit import (
    FEWEST_CORNERS,
    LensFit,
    fit,
    robust_fit,
    used_views,
    with_picture_noise,
    with_view_noise,
)
from calibration.lens.fit.lens_models import LensModel, folds_in_picture
from calibration.lens.fit.lens_parameters import AS_STATED, BOARD_BLOCKS, BoardFreedom, board_as_stated
from calibration.lens.fit.lens_start import StartError, start
from calibration.lens.fit.model_selection import (
    ModelCandidate,
    ModelSelection,
    beyond_noise,
    cell_means,
    difference_px,
    inliers_of_rich_models,
    select_model,
)
from calibration.lens.fit.projection_map import Difference, ProjectionMap, difference, projection_map
from calibration.lens.fit.view_equations import BEND_PROBABLE, Scatter, ViewEquations, scattered
from calibration.terms.surveyed import pose_of
from geometry.arrays import Array, Bools
from geometry.camera import camera_matrix

# Error of the lens model itself, from correlated residuals and from the other models.
#
# The covariance of the parameters contains the noise of the corners, but not the error of a model that cannot describe
# the lens. Two figures show such an error. First, the mean residuals in cells of the picture, which are noise if the
# model is right. Second, the difference to the other models, weighted with their probabilities (see
# `calibration/lens/fit/model_selection.py`). Both are added to the stated uncertainty. Ours.


@dataclass(frozen=True, slots=True)
class ModelUncertainty:
    """Model error beyond the covariance of the parameters."""

    p_value: float  # of mean residuals at least as large, if they are noise
    left_px: float  # RMS per coordinate of correlated residuals beyond noise; 0 where not significant
    between_px: float  # RMS difference to the other models where corners were seen, by their probabilities
    factor: float  # on the sigmas of the lens, so that they include both


def estimate_model_uncertainty(
    table: CornerTable,
    found: LensFit,
    selection: ModelSelection,
    at: ProjectionMap,
    covariance: Array,
    scatter: float = 1.0,
) -> ModelUncertainty:
    """Model error of a lens with parameter covariance (p, p), over the part of the picture where corners were seen.

    scatter: factor by which photographs scatter more than noise explains. Errors that are correlated within a
    photograph also enlarge the means of cells, and are already in the covariance.
    """
    noise = min([found.sigma_px, *(r.fit.sigma_px for r in selection.candidates if r.fit is not None)])
    cells, count = cell_means(table, found)
    p, left = beyond_noise(cells, count, noise * scatter)
    inside = seen_at(table, found.used, at.pixels) & np.isfinite(at.by_parameter).all(axis=(2, 3))
    between = selection.chosen.model_error_px
    claimed = float(np.mean(np.trace(at.covariance_px2(covariance)[inside], axis1=-2, axis2=-1))) if inside.any() else 0
    factor = float(np.sqrt(1 + (between**2 + 2 * left**2) / claimed)) if claimed > 0 else 1.0
    return ModelUncertainty(p, left, between, factor)


# The result of a camera's calibration: the lens, its covariance and the quality figures.


@dataclass(frozen=True, slots=True)
class Origins:
    """Comparison of photographs of two origins (folders, videos, first parts of names)."""

    names: tuple[str, str]
    difference: Difference


@dataclass(frozen=True, slots=True)
class Intrinsics:
    """A calibrated lens with its quality figures."""

    table: CornerTable
    model: LensModel
    fit: LensFit
    parameters: tuple[str, ...]  # fx, fy, cx, cy, k1 ...
    covariance: Array  # (p, p) in that order; with scatter between photographs, an unsolved bend and model error
    model_uncertainty: ModelUncertainty
    correlated_noise: float  # factor on the sigmas from that scatter and from the correlation of neighbouring corners
    scatter: Scatter
    held_out_rms_px: float  # per coordinate, of corners in photographs that the lens was predicted without
    selection: ModelSelection
    board: BoardTest | None  # None where the photographs do not determine the board's bend
    halves: Difference | None  # None where one half does not determine the lens
    origins: Origins | None  # None where all photographs have the same origin
    map: ProjectionMap
    distance_m: float
    coverage: Coverage

    @property
    def warp(self) -> WarpTest | None:
        """The test for a bent board; None where the views do not determine it."""
        return None if self.board is None else self.board.warp

    @property
    def matrix(self) -> Array:
        """(3, 3), px."""
        return camera_matrix(self.fit.lens[:4])

    @property
    def distortion(self) -> tuple[float, ...]:
        """Distortion coefficients in OpenCV's order, as many as the model has."""
        return tuple(float(v) for v in self.fit.lens[4 : 4 + self.model.coefficients])

    @property
    def sigmas(self) -> Array:
        """(p,): 1 sigma of each parameter."""
        return np.sqrt(np.diagonal(self.covariance))

    @property
    def rms_px(self) -> float:
        """RMS of the residuals of the used corners, per coordinate."""
        return float(np.sqrt(np.mean(self.fit.residuals[self.fit.used] ** 2)))

    @property
    def rms_2d_px(self) -> float:
        """RMS per corner, as OpenCV reports it: sqrt(2) times larger."""
        return self.rms_px * float(np.sqrt(2))


FEWEST_VIEWS = 4
# With a smaller angle between the boards' normals, focal length and distance cannot be separated.
LEAST_TILT_DEG = 5.0
_SCATTER_OF_TWO_LENSES = 2.0  # least factor on the noise: below it one cannot measure what two lenses leave of it
# Most of the variance of the scatter that they leave (0 to .07 in four mixed sets) of so many photographs or more; of
# FEWEST_VIEWS none, in between in proportion. The best split of as many normal numbers into two groups of FEWEST_VIEWS
# or more leaves less in 1 of 10,000 samples: .025 of 8, .034 of 10, .053 of 12, .081 of 16, .105 of 20 (simulated; the
# test is that of Engelman and Hartigan 1969, J. American Statistical Association 64).
_LEFT_BY_TWO_LENSES, _LEFT_AS_MUCH_OF = 0.1, 20
_NOISE_OF_SECOND = 2.0  # most noise of the smaller group over that of the other: rejected views have three times it
_LENSES_DIFFER_PX = 1.0  # of directions, RMS over the picture; the sigmas include what smaller differences do
_MOST_NAMES = 12  # of photographs in a message
_NOISE_DIFFERS = 0.2  # relative, of any corner, from which on the fit is repeated: less changes sigmas by about 1 %


class IntrinsicsError(ValueError):
    """The photographs do not allow a calibration; the message gives the cause and the remedy."""


class TooFewViewsError(IntrinsicsError):
    """Fewer photographs than a calibration requires."""


@dataclass(frozen=True, slots=True)
class IntrinsicsOptions:
    """Options of the calibration."""

    distance_m: float | None = None  # of the screen, for figures in mm; None: the median distance of the boards
    lens: LensModel | None = None  # None: chosen by the expected error of directions
    warp: bool | None = None  # whether to correct a bent board; None: where it is significant
    stretch: bool | None = None  # whether to correct rows and columns that are not to scale; None: where significant
    origins: tuple[str, ...] = ()  # of each view; different origins may mean different cameras; empty: unknown
    names: tuple[str, ...] = ()  # of each view, for messages; empty: their numbers


def calibrate_intrinsics(table: CornerTable, options: IntrinsicsOptions | None = None) -> Intrinsics:
    """The complete calibration of one camera. Raises IntrinsicsError: the photographs do not allow a calibration."""
    options = IntrinsicsOptions() if options is None else options
    _check_enough(table)
    try:
        return _calibrated(table, options)
    except StartError as error:
        raise IntrinsicsError(
            f"{error}; check the kind and size of the board, then photograph it again: 15 to 30 sharp photographs,"
            " tilted by 20 to 45 deg to all sides and moved into the picture's corners"
        ) from None
    except AdjustmentError as error:
        raise IntrinsicsError(
            f"the photographs do not determine the lens: {error}; take more of them, the board tilted by 20 to 45 deg"
            " to all sides and moved into the picture's corners"
        ) from None


def _calibrated(table: CornerTable, options: IntrinsicsOptions) -> Intrinsics:
    starts = _starts(table)
    used, rich = inliers_of_rich_models(table, starts, options.lens)
    _check_one_lens(table, rich[0], options)
    # Twice by the picture, since the first fit has equal weights. By views once: what fits a view raises its weight.
    for with_noise in (with_picture_noise, with_picture_noise, with_view_noise):
        weighted = with_noise(table, rich[0])
        if not np.allclose(np.log(weighted.noise), np.log(table.noise), atol=_NOISE_DIFFERS):
            try:
                used, rich = inliers_of_rich_models(weighted, [(f.model, f.values) for f in rich], options.lens)
            except AdjustmentError:  # weights sharpen a fit; where views contradict each other it may not converge
                break
            table = weighted
    shape = _shape(table, rich[0], options)
    free = AS_STATED if shape is None else shape.free
    as_found = (rich[0] if shape is None else shape.fit).values
    board = {name: as_found[name] for name in BOARD_BLOCKS} if shape else board_as_stated(len(table.board_points))
    selection = select_model(table, used, rich, board, replace(free, points=False), options.lens)
    found, equations = _final(table, selection.chosen, free)
    spread = equations.scatter()
    noise = spread.raised
    distance = options.distance_m or _typical_depth(table, found)
    seen = partial(seen_at, table, found.used)
    pixel_map = projection_map(found.model, found.lens, table.image_size_px, distance, where=seen)
    covariance = scattered(found, equations, spread) + _by_unsolved_board(table, found, shape, options)
    model_uncertainty = estimate_model_uncertainty(table, found, selection, pixel_map, covariance, noise)
    odd = np.arange(len(equations.views)) % 2 == 1
    return Intrinsics(
        table=table,
        model=found.model,
        fit=found,
        parameters=found.model.parameters,
        covariance=covariance * model_uncertainty.factor**2,
        model_uncertainty=model_uncertainty,
        correlated_noise=noise,
        scatter=spread,
        held_out_rms_px=found.sigma_px * float(np.sqrt(np.mean(equations.held_out_px2()))),
        selection=selection,
        board=shape,
        halves=_difference(equations, pixel_map, noise, ~odd, odd),
        origins=_origins(equations, pixel_map, options.origins),
        map=pixel_map,
        distance_m=distance,
        coverage=coverage_of(table, found.used, found.poses),
    )


def _check_enough(table: CornerTable) -> None:
    usable = int(np.sum(table.counts() >= FEWEST_CORNERS))
    if usable < FEWEST_VIEWS:
        raise TooFewViewsError(
            f"expected {FEWEST_VIEWS} photographs or more with a board in them, got {usable}; take 15 to 30, the board"
            " tilted by 20 to 45 deg to all sides and moved into the picture's corners"
        )


def _starts(table: CornerTable) -> list[tuple[LensModel, Values]]:
    """Start values for each kind of lens: what is found of the board does not depend on the model that is asked for.

    The start of a rational model for a wide lens is a fisheye: five coefficients do not describe it.
    """
    out: list[tuple[LensModel, Values]] = []
    errors = []
    for fisheye in (False, True):
        try:
            out.append(start(table, fisheye))
        except StartError as error:
            errors.append(error)
    if not out:
        raise errors[0]
    for _, values in out:
        _check_tilts(values)
    return out


def _check_tilts(values: Values) -> None:
    """Raises IntrinsicsError if all boards are parallel: they fit any focal length."""
    normals = pose_of(values, "boards").rotation[..., 2]
    normals = normals[np.isfinite(normals).all(axis=1)]
    spread = spread_deg(normals)
    if spread < LEAST_TILT_DEG:
        raise IntrinsicsError(
            f"the board has the same orientation in all {len(normals)} photographs (within {spread:.1f} deg), so that"
            " the focal length is not determined: a longer lens farther away gives the same pictures; tilt the board"
            " by 20 to 45 deg to all sides"
        )


def _check_one_lens(table: CornerTable, found: LensFit, options: IntrinsicsOptions) -> None:
    """Raises IntrinsicsError if the photographs are those of two lenses.

    Two lenses, each fitted to its own photographs, then leave almost none of the scatter between photographs. Errors of
    each photograph's own, such as a lens that refocuses, are left in part: a quarter of many (uniform errors of one
    unknown, split in the middle), less of a few. Photographs rejected as a whole may be those of the second lens.
    """
    try:
        equations = ViewEquations.of(table, found)
    except AdjustmentError:
        return
    spread = equations.scatter()
    scatters = spread.is_significant and spread.factor >= _SCATTER_OF_TWO_LENSES
    second = equations.two_groups() if scatters else np.zeros(len(equations.views), dtype=bool)
    if 2 * second.sum() > len(second):
        second = ~second
    rejected = np.setdiff1d(np.flatnonzero(table.counts() >= FEWEST_CORNERS), equations.views)
    groups = [np.sort(np.append(equations.views[second], rejected)), equations.views[~second]]
    if min(map(len, groups)) < FEWEST_VIEWS:
        return
    left, fits, count = 0.0, [], sum(map(len, groups))
    for views in groups:
        part = table.only_views(views)
        try:
            fits.append(inliers_of_rich_models(part, _starts(part), options.lens)[1][0])
            left += len(views) / count * (ViewEquations.of(part, fits[-1]).scatter().factor ** 2 - 1)
        except (AdjustmentError, StartError, IntrinsicsError):
            return  # the photographs of one group do not determine a lens
    most = _LEFT_BY_TWO_LENSES * min((count - FEWEST_VIEWS) / (_LEFT_AS_MUCH_OF - FEWEST_VIEWS), 1.0)
    if left > most * (max(spread.factor, _SCATTER_OF_TWO_LENSES) ** 2 - 1):
        return
    if fits[0].sigma_px > _NOISE_OF_SECOND * fits[1].sigma_px:
        return  # blurred
    at = projection_map(fits[0].model, fits[0].lens, table.image_size_px, 1.0)
    apart = difference_px(at.pixels.reshape(-1, 2), at.rays.reshape(-1, 3), fits[1])
    if apart < _LENSES_DIFFER_PX:
        return
    names = options.names or tuple(f"photograph {v + 1}" for v in range(table.views))
    few, many = groups
    listed = ", ".join(names[v] for v in few[:_MOST_NAMES])
    raise IntrinsicsError(
        "the photographs are from two cameras, or focus or zoom was changed in between:"
        f" {listed}{f' and {len(few) - _MOST_NAMES} more' if len(few) > _MOST_NAMES else ''} give a lens with fx"
        f" {fits[0].lens[0]:.4g} px, {len(many)} others one with fx {fits[1].lens[0]:.4g} px, and directions differ by"
        f" {apart:.1f} px; calibrate each set separately, and fix focus and zoom before the first photograph"
    )


def _shape(table: CornerTable, rich: LensFit, options: IntrinsicsOptions) -> BoardTest | None:
    try:
        return board_test(table, rich, BoardShapeOptions(options.warp, options.stretch))
    except AdjustmentError:
        if options.warp or options.stretch:
            raise
        return None


def _final(table: CornerTable, chosen: ModelCandidate, board: BoardFreedom) -> tuple[LensFit, ViewEquations]:
    """The chosen model fitted again to all corners, with outliers determined by this model."""
    assert chosen.fit is not None
    try:
        found = robust_fit(table, chosen.model, chosen.fit.values, board)
        folded, folds = (folds_in_picture(f.lens, f.model.fisheye, table.image_size_px) for f in (chosen.fit, found))
        if folded or not folds:
            return found, ViewEquations.of(table, found)
    except AdjustmentError:
        pass
    return chosen.fit, ViewEquations.of(table, chosen.fit)


def _by_unsolved_board(
    table: CornerTable, found: LensFit, shape: BoardTest | None, options: IntrinsicsOptions
) -> Array:
    """Covariance (p, p) of the lens by errors of the board that are not solved for: their square effect.

    Few photographs show displaced points or a bend without showing them in each half. 0 if they are solved for, not
    probable or significant, or excluded by the user.
    """
    change = np.zeros(len(found.model.parameters))
    if shape is None or found.board.points:
        return np.outer(change, change)
    few = len(table.board_points) <= MOST_POINTS
    try:
        if few and shape.points.p_value < SIGNIFICANT and options.stretch is None:
            board = replace(found.board, points=True)
            freed = fit(table, found.used, found.model, found.values, board, limits=BRIEF)
            change = (freed.lens - found.lens)[found.model.free]
        elif shape.warp.p_value < BEND_PROBABLE and options.warp is None and not found.board.warp:
            equations = ViewEquations.of(table, found, replace(found.board, warp=True))
            change = equations.solution()[0][: equations.lens]
    except AdjustmentError:
        pass  # the photographs do not determine these errors of the board: their effect is not known
    return np.outer(change, change)


def _typical_depth(table: CornerTable, found: LensFit) -> float:
    """The median distance of the boards along the optical axis, m."""
    depths = found.poses.apply(table.middle)[used_views(found, table), 2]
    return float(np.median(depths))


def _origins(equations: ViewEquations, at: ProjectionMap, origins: Sequence[str]) -> Origins | None:
    """The views of the two most frequent origins compared; None where the second one has too few views.

    Two cameras make the photographs scatter: the sigmas are therefore those of the corners' noise alone.
    """
    of_views = np.array([origins[v] for v in equations.views] if origins else [])
    common = [(name, count) for name, count in Counter(of_views.tolist()).most_common(2) if count >= FEWEST_VIEWS]
    if len(common) < 2:
        return None
    names = (common[0][0], common[1][0])
    found = _difference(equations, at, 1.0, *(of_views == name for name in names))
    return None if found is None else Origins(names, found)


def _difference(equations: ViewEquations, at: ProjectionMap, noise: float, *sets: Bools) -> Difference | None:
    """The difference between the lenses of two sets of views; None where one of them does not determine the lens."""
    p = equations.lens
    try:
        (first, C), (second, D) = (equations.solution(which) for which in sets)
    except AdjustmentError:
        return None
    return difference(at, (second - first)[:p], (C + D)[:p, :p] * noise**2)
