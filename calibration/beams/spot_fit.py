"""Start values of a beam adjustment, the robust adjustment to spots, and labels that are exchanged in single pictures.

Start values are lines through spots, poses from a nominal rig, and the stand's pose. Outliers are detected with a
Cauchy loss and then excluded: the final values and their covariance are from plain least squares on the inliers, so
that neither outliers nor down-weighted spots affect them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

from calibration.least_squares.adjustment import Adjusted, AdjustmentError, Cauchy, Free, Limits, Term, Values, solve
from calibration.terms.rig_blocks import SpotPixels, SpotTerm
from geometry.arrays import Array, Bools, Ints, normalised
from geometry.forward_model import SpotModel, points_on_screens
from geometry.pose import Pose
from geometry.pose_solver.closed_form import pose_from_lines
from geometry.pose_solver.gauss_newton import PoseFit, fit_pose
from geometry.rig import Beam, Rig

_MOST_FOR_PAIRS = 60  # spots of a beam of which all pairs are tried
_NEAR_M = 0.02  # m from the line: spots at least this near are inliers
# Start attitudes for an unknown vehicle: the 24 rotations of a cube are within 63 deg of every attitude.
_START_ATTITUDES = Rotation.create_group("O")


def beams_through_spots(rig: Rig, spots: SpotPixels, world_from_body: Pose) -> dict[str, Beam]:
    """Each beam as the line through its spots in the body frame; beams without such a line are missing.

    world_from_body: (P,) of the stand's positions. A line requires spots at two places along it: at positions of
    different distance from the screen, or at both ends.
    """
    points = world_from_body[spots.position].inverse().apply(points_on_screens(rig, spots.view, spots.pixels))
    model = SpotModel.of(rig)
    out = {}
    for b, name in enumerate(rig.beams):
        rows = (model.beam_of[spots.view] == b) & np.isfinite(points).all(axis=1)
        line = line_through(points[rows])
        if line is not None:
            point, direction = line
            foot = point - (point @ direction) * direction
            # Spots of the end "+" are ahead of the point, the others behind it.
            ahead = np.sum(model.sign[spots.view[rows]] * ((points[rows] - foot) @ direction))
            out[name] = Beam(name, direction if ahead >= 0 else -direction, foot)
    return out


def line_through(points: Array) -> tuple[Array, Array] | None:
    """A point and the direction of the line near most of the points (m, 3); None if the points coincide.

    The line is that of the pair with the least median distance of the other points, refined by its inliers. Up to half
    of the points may be outliers.
    """
    few = points[:: max(1, -(-len(points) // _MOST_FOR_PAIRS))]
    if len(few) < 2:
        return None
    i, j = np.array(list(combinations(range(len(few)), 2))).T
    direction = few[j] - few[i]
    long = np.linalg.norm(direction, axis=1) > 1e-3
    if not long.any():
        return None
    i, direction = i[long], normalised(direction[long])
    distances = np.linalg.norm(np.cross(few[None] - few[i][:, None], direction[:, None]), axis=2)
    middle = np.median(distances, axis=1)
    best = int(np.argmin(middle))
    far = np.linalg.norm(np.cross(points - few[i[best]], direction[best]), axis=1)
    near = points[far <= max(3 * float(middle[best]), _NEAR_M)]
    centre = near.mean(axis=0)
    return centre, np.linalg.svd(near - centre)[2][0]


def body_poses(rig: Rig, spots: SpotPixels, count: int) -> list[PoseFit | None]:
    """world_from_body at each of the stand's `count` positions, fitted with the rig's beams; None where it fails.

    Spots are not checked for outliers; a wrong one affects its position.
    """
    model = SpotModel.of(rig)
    points = points_on_screens(rig, spots.view, spots.pixels)
    out: list[PoseFit | None] = []
    last: Pose | None = None
    for k in range(count):
        rows = np.flatnonzero(spots.position == k)
        here = spots.pick(rows)
        starts = [p for p in (_pose_from_whole_beams(rig, here, points[rows]), last) if p is not None]
        fit = _best(model, here, starts)
        if fit is None or not fit.observable or (last is None and fit.dof > 0 and fit.chi2 > 1e3 * fit.dof):
            middle = np.mean([s.world_from_screen.translation for s in rig.screens.values()], axis=0)
            turned = _best(model, here, [Pose(R, middle) for R in _START_ATTITUDES.as_matrix()])
            if turned is not None and (fit is None or not fit.observable or turned.chi2 < fit.chi2):
                fit = turned
        good = fit is not None and fit.observable
        out.append(fit if good else None)
        if fit is not None and good:
            last = fit.world_from_body
    return out


def stand_of(world_from_body: Pose, stand_from_body: Pose) -> Pose:
    """The world_from_stand of the position (m,) with the least median difference from the others."""
    each = world_from_body @ stand_from_body.inverse()
    gaps = np.array([np.linalg.norm(each.minus(each[i]), axis=-1) for i in range(len(each.translation))])
    return each[int(np.argmin(np.median(gaps, axis=1)))]


def _best(model: SpotModel, spots: SpotPixels, starts: list[Pose]) -> PoseFit | None:
    """The fit with the least chi-square."""
    if len(spots) < 3:
        return None
    fits = [fit_pose(model, spots.view, spots.pixels, spots.covariance, s) for s in starts]
    usable = [f for f in fits if f is not None]
    return min(usable, key=lambda f: (not f.observable, f.chi2), default=None)


def _pose_from_whole_beams(rig: Rig, spots: SpotPixels, points: Array) -> Pose | None:
    """The pose from the beams with both spots detected; None for fewer than two. points (N, 3) in world."""
    views = rig.views()
    ends: dict[str, dict[int, Array]] = {}
    for v, p in zip(spots.view, points, strict=True):
        spot = rig.spots[views[v][1]]
        if np.isfinite(p).all():
            ends.setdefault(spot.beam, {})[spot.sign] = p
    whole = {b: (e[-1], e[1]) for b, e in ends.items() if len(e) == 2}
    if len(whole) < 2:
        return None
    return pose_from_lines(
        np.array([rig.beams[b].point for b in whole]),
        np.array([rig.beams[b].direction for b in whole]),
        np.array([start for start, _ in whole.values()]),
        np.array([end - start for start, end in whole.values()]),
    )


P_OUTLIER = 1e-4  # probability that a correct spot is excluded
_MEDIAN_CHI2 = 2 * np.log(2)  # median of the chi-square with 2 degrees of freedom
_P_MISFIT = 1e-3  # p-value of chi-square below which the sigmas are increased
_ROUNDS = 8
# With changing weights the last digits converge slowly; for a start value less is sufficient.
_ROUGHLY = Limits(steps=120, small_step_sigmas=0.1)
_MOST_SCALE = 10.0  # largest factor on the stated sigmas; spots that scatter more are not of these beams


@dataclass(frozen=True, slots=True)
class SpotFit:
    """Adjustment of N spots."""

    adjusted: Adjusted  # terms: the kept spots first, then the others
    kept: Bools  # (N,): inliers
    residuals_px: Array  # (N, 2) measured minus predicted, of all spots
    sigmas: Array  # (N,) length of each residual in its stated sigmas
    scale: float  # factor on the stated sigmas from the scatter of the spots; 1 if they are consistent


def fit_spots(rig: Rig, spots: SpotPixels, values: Values, others: Sequence[Term], free: Free) -> SpotFit:
    """The adjustment to the spots and the other terms.

    If the inliers scatter significantly more than their sigmas, these are scaled up. They are never scaled down: larger
    ones are a safety margin of the user. Raises AdjustmentError: fewer than half of the spots agree, or the adjustment
    does not converge.
    """
    every = SpotTerm(rig, spots)
    robust = solve(values, [SpotTerm(rig, spots, Cauchy()), *others], free, _ROUGHLY)
    now = robust.values
    kept = _near(every, now)
    for _ in range(_ROUNDS):
        if 2 * np.sum(kept) < len(spots):
            raise AdjustmentError(
                f"only {int(np.sum(kept))} of {len(spots)} spots are consistent: labels, stand positions or the"
                " calibration of cameras and screens are wrong"
            )
        found = solve(now, [SpotTerm(rig, spots.pick(kept)), *others], free)
        again = _near(every, found.values)
        now = found.values
        if np.array_equal(again, kept):
            break
        kept = again
    scale = 1.0
    if found.dof > 0 and found.chi2 > chdtri(found.dof, _P_MISFIT):
        scale = float(np.sqrt(found.chi2 / found.dof))
        wider = replace(spots.pick(kept), covariance=spots.pick(kept).covariance * scale**2)
        found = solve(now, [SpotTerm(rig, wider), *others], free)
    r = every.linearise(found.values).residuals
    roots = np.linalg.cholesky(spots.covariance)
    residuals_px = -(roots @ r[..., None])[..., 0]
    return SpotFit(found, kept, residuals_px, np.linalg.norm(r, axis=1), scale)


def _near(term: SpotTerm, values: Values) -> Bools:
    """Inliers, relative to the scatter of the better half of the spots."""
    s = np.sum(term.linearise(values).residuals ** 2, axis=1)
    unit = float(np.clip(np.median(s) / _MEDIAN_CHI2, 1.0, _MOST_SCALE**2))
    return s < unit * chdtri(2, P_OUTLIER)


_OF_THEIR_DISTANCE = 0.15  # tolerance of the other's place, as a share of the distance between the two
_SIGMAS = 10.0  # the same in sigmas, if the two are close together


def swapped_pairs(spots: SpotPixels, kept: Bools, residuals_px: Array, camera_of: Ints) -> list[tuple[int, int]]:
    """Pairs of excluded rows that fit with exchanged labels.

    kept (N,): rows that are not excluded; residuals_px (N, 2): measured minus predicted; camera_of (N,). Only spots of
    the same position and camera can be exchanged.
    """
    predicted = spots.pixels - residuals_px
    wrong = np.flatnonzero(~kept)
    out = []
    for i, j in combinations(wrong.tolist(), 2):
        if spots.position[i] != spots.position[j] or camera_of[i] != camera_of[j]:
            continue
        sigma = float(np.sqrt(max(np.trace(spots.covariance[i]), np.trace(spots.covariance[j])) / 2))
        near = max(_OF_THEIR_DISTANCE * float(np.linalg.norm(spots.pixels[i] - spots.pixels[j])), _SIGMAS * sigma)
        distances = [np.linalg.norm(spots.pixels[a] - predicted[b]) for a, b in ((i, j), (j, i))]
        if max(distances) < near:
            out.append((i, j))
    return out
