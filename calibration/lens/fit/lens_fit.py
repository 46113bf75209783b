"""One lens model fitted to one camera's corners: the least squares, and what is thrown out as not being the board."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import solve_triangular

from calibration.least_squares.adjustment import Adjusted, Cauchy, Limits, Loss, Term, solve
from calibration.least_squares.parameter_blocks import Poses, Stack, Vectors
from calibration.least_squares.priors import Anchors, independent
from calibration.lens.fit.corner_table import CornerTable
from calibration.lens.fit.lens_models import LensModel
from calibration.terms.corners import INTRINSICS, CornerTerm, single_camera
from geometry.arrays import Array, Bools, Ints
from geometry.pose import Pose

Values = Mapping[str, Stack]
BOARD_STACKS = ("warp", "stretch", "print", "radius")
FEWEST_CORNERS = 6  # of a view: four fix its pose, the rest must say something of the lens
# Distance of a corner from where it should be, in sigmas of one coordinate, beyond which it is no corner: of normal
# errors one in 25 000 lies there, so what is cut from a clean set changes its sigma by less than 0.1 %.
CORNER_GATE = 4.5
# A view whose corners miss by this many times what those of the median view do was blurred, or its board moved.
VIEW_GATE = 3.0
SETTLED = Limits()
_ROUNDS = 6  # of solving and rejecting; sets seen so far settle within three


# A circle's size by its blobs' areas: blur and the ink's soft edge move it by .1 to .3 %, the same in all views.
_RADIUS_SIGMA = 0.005
_STATED_RADIUS_SIGMA = 0.02  # of a printed circle, by what was said: ink spreads and light edges bloom
_MODERATE, _MODERATE_PRISM = 3.0, 0.1  # of a distortion number times its power of the radius, at the picture's edge
_PRINT_SIGMA = 0.02  # of a printed point's place, in spacings: wide: it fixes their common place, turn and scale


@dataclass(frozen=True, slots=True)
class BoardFreedom:
    """What of a board's shape is solved for, beside its circles' radius."""

    warp: bool = False  # its bend
    stretch: bool = False  # its scale along x against y, and the angle between them
    points: bool = False  # the place of every point; bend and stretch then stay as they were found

    def __or__(self, other: BoardFreedom) -> BoardFreedom:
        return BoardFreedom(self.warp or other.warp, self.stretch or other.stretch, self.points or other.points)


AS_STATED = BoardFreedom()


@dataclass(frozen=True, slots=True)
class LensFit:
    """A lens, the board's poses and its shape, where the used corners' residuals are smallest."""

    model: LensModel
    values: Values  # the engine's stacks; world is the camera
    adjusted: Adjusted
    used: Bools  # (N,)
    residuals: Array  # (N, 2), px, of ALL corners: projected less measured; nan for those of views without a pose
    sigma_px: float  # of a corner's coordinate, from the used residuals and their degrees of freedom
    relative_sigma: float  # the same in the sigmas that the adjustment was solved with
    board: BoardFreedom
    dropped: Mapping[int, str] = field(default_factory=dict)  # view -> why it was not used

    @property
    def lens(self) -> Array:
        """(18,)."""
        return lens_of(self.values)

    @property
    def warp(self) -> Array:
        """(3,), 1/m."""
        return _array(self.values, "warp")[0]

    @property
    def stretch(self) -> Array:
        """(2,): how much longer the board is along x, as a share, and how far x leans with y."""
        return _array(self.values, "stretch")[0]

    @property
    def printed(self) -> Array:
        """(P, 3), m: by how much each point of the board lies off."""
        return _array(self.values, "print")

    @property
    def radius_m(self) -> float:
        """Of the board's circles; 0 where its points are points."""
        return float(_array(self.values, "radius")[0, 0])

    @property
    def radius_sigma_m(self) -> float:
        """1 sigma of it; 0 where the points are points. AdjustmentError."""
        return float(np.sqrt(self.adjusted.covariance([("radius", 0)])[0, 0])) * self.relative_sigma

    @property
    def poses(self) -> Pose:
        """camera_from_board of all V views."""
        stack = self.values["boards"]
        assert isinstance(stack, Poses)
        return stack.pose

    @property
    def covariance(self) -> Array:
        """Joint covariance (p, p) of the model's parameters, from the corners' own scatter. AdjustmentError."""
        whole = self.adjusted.covariance([("intrinsics", 0)])
        free = self.model.free
        return whole[np.ix_(free, free)] * self.relative_sigma**2

    @property
    def shape_covariance(self) -> Array:
        """(5, 5) of warp (1/m) and stretch; 0 for what was held. AdjustmentError."""
        return self.adjusted.covariance([("warp", 0), ("stretch", 0)]) * self.relative_sigma**2


def values_of(lens: Array, camera_from_board: Pose, points: int) -> Values:
    """The engine's stacks for one camera, which is the world: lens (18,), V poses, a board of so many points.

    The board is as stated; circles have the radius 0, which stands for one that is not known yet.
    """
    return {
        "intrinsics": Vectors(np.asarray(lens, dtype=float)[None]),
        "cameras": Poses.of([Pose.identity()]),
        "boards": Poses(camera_from_board),
        **board_as_stated(points),
    }


def board_as_stated(points: int) -> Values:
    """The stacks of a board of so many points, with nothing known beyond what was said."""
    return {
        "warp": Vectors(np.zeros((1, 3))),
        "stretch": Vectors(np.zeros((1, 2))),
        "print": Vectors(np.zeros((points, 3))),
        "radius": Vectors(np.zeros((1, 1))),
    }


def lens_of(values: Values) -> Array:
    """(18,): the camera's numbers."""
    return _array(values, "intrinsics")[0]


def _array(values: Values, name: str) -> Array:
    stack = values[name]
    assert isinstance(stack, Vectors)
    return stack.array


def term_of(
    table: CornerTable, used: Bools, fisheye: bool, sigma_px: float = 1.0, loss: Loss | None = None
) -> CornerTerm:
    """The used corners (N,) as a term of the cost."""
    return single_camera(
        table.pixels[used],
        table.points[used],
        table.middle,
        table.view[used],
        sigma_px,
        fisheye,
        loss,
        table.point[used],
    )


def moderate_numbers(table: CornerTable, used: Bools, model: LensModel, values: Values) -> Term:
    """That each distortion number does a moderate thing to a point at the picture's edge: k r^2, k r^4 ... are of some.

    The numerator and the denominator of the rational model nearly cancel: without this, photographs leave directions
    of its numbers open that no corner shows, and the solve runs along them for ever. Its bias is far below the noise.
    """
    poses = values["boards"]
    assert isinstance(poses, Poses)
    xyz = poses.pose[table.view[used]].apply(table.points[used])
    with np.errstate(invalid="ignore", divide="ignore"):
        r2 = np.nanquantile(np.sum(xyz[:, :2] ** 2, axis=1) / xyz[:, 2] ** 2, 0.99)
    power = np.array([1, 2, 0, 0, 3, 1, 2, 3, 1, 2, 1, 2, 0, 0])
    sigmas = np.full(INTRINSICS, np.inf)
    radial = np.array([0, 1, 4, 5, 6, 7])
    sigmas[4 + radial] = _MODERATE / float(r2) ** power[radial]
    prism = np.array([8, 9, 10, 11])
    sigmas[4 + prism] = _MODERATE_PRISM / float(r2) ** power[prism]
    sigmas[~model.free] = np.inf
    return independent("intrinsics", Vectors(np.zeros((1, INTRINSICS))), sigmas[None])[0]


def with_radius(table: CornerTable, used: Bools, model: LensModel, values: Values) -> tuple[Values, list[Term]]:
    """The values with the radius of the board's circles, by their blobs' areas, and what is known of it so.

    Without areas it is the stated one, or (start of an unknown) a quarter of the spacing.
    """
    if table.circles is None:
        return values, []
    areas, stated = table.circles.areas_px2, table.circles.diameter_m
    radius, sigma = table.spacing_m / 4, np.inf
    if areas is not None and used.any():
        radius, sigma = _radius_by_areas(table, used, model, values), _RADIUS_SIGMA
    elif stated is not None:
        radius, sigma = stated / 2, _STATED_RADIUS_SIGMA
    elif _array(values, "radius")[0, 0] > 0:
        return values, []
    known = Vectors(np.array([[radius]]))
    prior: list[Term] = list(independent("radius", known, np.array([[radius * sigma]]))) if np.isfinite(sigma) else []
    return {**values, "radius": known}, prior


def _radius_by_areas(table: CornerTable, used: Bools, model: LensModel, values: Values) -> float:
    """Of all circles, m: each area over that which a circle of 1 m would have by the local scale; their median."""
    assert table.circles is not None
    assert table.circles.areas_px2 is not None
    term = term_of(table, used, model.fisheye)
    flat = {**values, "radius": Vectors(np.zeros((1, 1))), "print": Vectors(np.zeros((len(table.board_points), 3)))}
    # d(pixel)/d(print) is the derivative by the place on the board; its first two columns lie in the board.
    by_place = next(p for p in term.linearise(flat).parts if p.stack == "print").jacobian[..., :2]
    with np.errstate(invalid="ignore", divide="ignore"):
        squared = table.circles.areas_px2[used] / (np.pi * np.abs(np.linalg.det(by_place)))
    return float(np.sqrt(np.nanmedian(squared)))


def adjust(
    table: CornerTable,
    used: Bools,
    model: LensModel,
    values: Values,
    board: BoardFreedom = AS_STATED,
    sigma_px: float = 1.0,
    loss: Loss | None = None,
    lens_free: Bools | None = None,
    limits: Limits = SETTLED,
) -> Adjusted:
    """The least squares alone. lens_free (18,): which numbers may move, the model's own if None. AdjustmentError.

    Distortion numbers that the model does not have are set to 0; what of the board's shape is not free stays. The
    radius of circles is free wherever the lens is, held by what their areas say.
    """
    values = {**values, "intrinsics": Vectors(model.cut(lens_of(values))[None])}
    in_use = table.counts(used) > 0
    whole_lens = lens_free is None
    known: list[Term] = []
    if whole_lens:
        values, known = with_radius(table, used, model, values)
    free: dict[str, bool | Bools] = {
        "intrinsics": (model.free if lens_free is None else lens_free)[None],
        "boards": np.repeat(in_use[:, None], 6, axis=1),
        "warp": board.warp and not board.points,
        "stretch": board.stretch and not board.points,
        "radius": whole_lens and table.circles is not None,
    }
    if model.coefficients > 5 and whole_lens:
        known.append(moderate_numbers(table, used, model, values))
    if board.points:
        seen = np.bincount(table.point[used], minlength=len(table.board_points)) > 0
        free["print"] = np.repeat(seen[:, None], 3, axis=1)
        known.append(Anchors("print", np.zeros((len(seen), 3)), _PRINT_SIGMA * table.spacing_m))
    term = term_of(table, used, model.fisheye, sigma_px, loss)
    basis = {"intrinsics": _lens_basis(term, known, model, values)} if whole_lens and model.coefficients > 5 else {}
    return solve(values, [term, *known], free, limits, basis)


def _lens_basis(term: CornerTerm, known: Sequence[Term], model: LensModel, values: Values) -> Array:
    """(18, 18): combinations of the lens' numbers that each move the corners in a way of their own, by about a sigma.

    From the triangle of a QR decomposition of the derivatives at the start; the numbers themselves where that is
    singular.
    """
    own = [p.jacobian for t in [term, *known] for p in t.linearise(values).parts if p.stack == "intrinsics"]
    rows = np.concatenate([J.reshape(-1, INTRINSICS) for J in own])[:, model.free]
    basis = np.eye(INTRINSICS)
    scale = np.linalg.norm(rows, axis=0)
    if not (np.isfinite(scale).all() and np.all(scale > 0)):
        return basis
    R = np.linalg.qr(rows / scale, mode="r")
    if np.min(np.abs(np.diagonal(R))) > 1e-12:
        basis[np.ix_(model.free, model.free)] = solve_triangular(R, np.eye(len(R))) / scale[:, None]
    return basis


def fit(
    table: CornerTable,
    used: Bools,
    model: LensModel,
    values: Values,
    board: BoardFreedom,
    dropped: Mapping[int, str] = {},
    limits: Limits = SETTLED,
    sigma_px: float | None = None,
) -> LensFit:
    """Plain least squares over the used corners (N,). AdjustmentError.

    sigma_px: about what a corner will miss by, None: as at the start. It sets how small a last step must be, no more: a
    model that misses by pixels then need not settle to a thousandth of one.
    """
    values, _ = with_radius(table, used, model, values)
    scale = sigma_px or _spread(_residuals(table, used, model, values)[used])
    adjusted = adjust(table, used, model, values, board, scale, limits=limits)
    everything = term_of(table, np.ones(len(table), dtype=bool), model.fisheye)
    residuals = everything.project(adjusted.values) - table.pixels
    residuals[~(table.counts(used) > 0)[table.view]] = np.nan
    relative = float(np.sqrt(adjusted.chi2 / max(adjusted.dof, 1)))
    return LensFit(model, adjusted.values, adjusted, used, residuals, relative * scale, relative, board, dict(dropped))


def robust_fit(table: CornerTable, model: LensModel, values: Values, board: BoardFreedom) -> LensFit:
    """The fit without what is no corner of the board: found under a Cauchy loss, then left out for good.

    values must hold a pose for each view; a view whose pose is nan is left out. AdjustmentError where too little stays.
    """
    dropped = _without_pose(table, values)
    candidates = ~np.isin(table.view, list(dropped))
    values, _ = with_radius(table, candidates, model, values)
    sigma = _spread(_residuals(table, candidates, model, values)[candidates])
    for _ in range(2):  # the scale of the loss comes from residuals that the first round has made smaller
        adjusted = adjust(table, candidates, model, values, board, sigma, Cauchy())
        values = adjusted.values
        residuals = _residuals(table, candidates, model, values)
        smaller = _spread(residuals[candidates])
        if smaller > 0.8 * sigma:
            break
        sigma = smaller
    sigma = smaller
    dropped |= _bad_views(table, residuals, candidates, sigma, dropped)
    used = _used(table, residuals, sigma, dropped)
    for _ in range(_ROUNDS):
        found = fit(table, used, model, values, board, dropped)
        values = found.values
        again = _used(table, found.residuals, found.sigma_px, dropped)
        if np.array_equal(again, used):
            break
        used = again
    return found


def _residuals(table: CornerTable, candidates: Bools, model: LensModel, values: Values) -> Array:
    """(N, 2), px; nan for other than candidates."""
    out = np.full((len(table), 2), np.nan)
    term = term_of(table, candidates, model.fisheye)
    values = {**values, "intrinsics": Vectors(model.cut(lens_of(values))[None])}
    out[candidates] = term.project(values) - term.pixels
    return out


def _spread(residuals: Array) -> float:
    """Sigma of a coordinate by the median of residuals (n, 2): half of them may be wrong; at least 1e-6 px."""
    return max(1.4826 * float(np.median(np.abs(residuals))), 1e-6)


def _without_pose(table: CornerTable, values: Values) -> dict[int, str]:
    boards = values["boards"]
    assert isinstance(boards, Poses)
    lost = ~np.isfinite(boards.pose.translation).all(axis=1)
    few = table.counts() < FEWEST_CORNERS
    out = {int(v): "no board position explains its corners" for v in np.flatnonzero(lost)}
    return out | {int(v): f"fewer than {FEWEST_CORNERS} corners" for v in np.flatnonzero(few)}


def _bad_views(
    table: CornerTable, residuals: Array, candidates: Bools, sigma: float, dropped: Mapping[int, str]
) -> dict[int, str]:
    """Views of which most corners lie off, or which as a whole are much worse than the others, and why."""
    length = np.linalg.norm(residuals, axis=1)
    typical = np.full(table.views, np.nan)
    for v in set(range(table.views)) - set(dropped):
        typical[v] = np.median(length[(table.view == v) & candidates])
    median = float(np.nanmedian(typical))
    good = table.mean_per_view((length < CORNER_GATE * sigma).astype(float), candidates)
    out = {}
    for v in np.flatnonzero(np.isfinite(typical)).tolist():
        if typical[v] > VIEW_GATE * median:
            out[v] = (
                f"its corners miss by {typical[v]:.2f} px, {typical[v] / median:.1f} times those of the median view:"
                " blurred, or the board or the camera moved"
            )
        elif good[v] * table.counts()[v] < FEWEST_CORNERS or good[v] < 0.5:
            out[v] = f"only {good[v]:.0%} of its corners fit the board"
    return out


def _used(table: CornerTable, residuals: Array, sigma: float, dropped: Mapping[int, str]) -> Bools:
    """(N,): corners within the gate, in views that are not dropped."""
    with np.errstate(invalid="ignore"):
        near = np.linalg.norm(residuals, axis=1) < CORNER_GATE * sigma
    return near & ~np.isin(table.view, list(dropped))


def used_views(fit: LensFit, table: CornerTable) -> Ints:
    """Which of the V views have used corners."""
    return np.flatnonzero(table.counts(fit.used) > 0)
