"""Calibration of the lasers' directions and offsets in the vehicle, from spots at known or unknown stand positions.

The body frame is that of the stand's carriage: `stand_from_body` as recorded. If no position is known, only the shape
of the set of beams can be determined, and the body frame is chosen so that the beams are nearest to the nominal ones.
Results include the angles between beams, and tests whether opposed beams are collinear.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy.linalg import block_diag
from scipy.special import chdtrc

from calibration.beams.excitation import BodyGauge, StandMotion, in_words, without_frame
from calibration.beams.spot_fit import SpotFit, beams_through_spots, body_poses, fit_spots, stand_of
from calibration.least_squares.adjustment import (
    Adjusted,
    AdjustmentError,
    At,
    Cauchy,
    Lines,
    Poses,
    Prior,
    Term,
    Values,
    independent,
    solve,
)
from calibration.terms.rig_blocks import (
    BEAMS,
    POSES,
    STAND,
    SpotPixels,
    SpotTerm,
    lines_in,
    named_covariance,
    prior_of,
    rig_of,
    stacks_of,
)
from calibration.terms.surveyed import pose_of
from geometry.arrays import Array, Bools, evenly_spaced, normalised
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.rig import Beam, Rig, Spot
from geometry.uncertainty.rig_uncertainty import RigCovariance

_OPPOSED = np.deg2rad(5.0)  # largest deviation of beams meant to be collinear: mounting by eye is better than this


@dataclass(frozen=True, slots=True)
class BeamAngle:
    """Angle between the directions of two beams."""

    first: str
    second: str
    angle: float  # rad, 0 to pi
    sigma: float  # rad


@dataclass(frozen=True, slots=True)
class CollinearityTest:
    """Test whether two opposed beams are collinear."""

    first: str
    second: str
    turn: float  # rad, between the first's direction and the second's reversed
    turn_sigma: float  # rad
    gap: float  # m, across the first beam, between the points of either nearest to the body's origin
    gap_sigma: float  # m
    p: float  # p-value of the difference, if the beams are collinear


def angles_between(names: Sequence[str], lines: Lines, covariance: Array) -> list[BeamAngle]:
    """The angles of all pairs, with sigmas from the joint covariance (4 k, 4 k) of the lines' errors.

    The angle of a pair that is parallel or opposed to within its sigma is at the edge of its range; its sigma is then
    that of one of the two components of the rotation.
    """
    out = []
    for i, j in combinations(range(len(names)), 2):
        a, b = lines.directions[i], lines.directions[j]
        # d(angle) = -b'.d(a) - a'.d(b); a' and b' are unit vectors across each direction, towards the other one.
        normal = np.cross(a, b)
        if np.linalg.norm(normal) < 1e-12:
            normal = lines.basis[i, :, 0]
        normal = normalised(normal)
        angle = float(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))
        g = np.zeros(len(covariance))
        g[4 * i : 4 * i + 2] = -np.cross(normal, a) @ lines.basis[i]
        g[4 * j : 4 * j + 2] = np.cross(normal, b) @ lines.basis[j]
        out.append(BeamAngle(names[i], names[j], angle, float(np.sqrt(g @ covariance @ g))))
    return out


def opposed_pairs(names: Sequence[str], lines: Lines, covariance: Array) -> list[CollinearityTest]:
    """Collinearity tests of all pairs of beams that are opposed to within 5 deg.

    covariance (4 k, 4 k) of the lines' errors. The four differences between the first line and the second one reversed
    are tested together (chi-square). Points should be those nearest to the body's origin.
    """
    out = []
    for i, j in combinations(range(len(names)), 2):
        if lines.directions[i] @ lines.directions[j] > -np.cos(_OPPOSED):
            continue
        B, C = lines.basis[i], lines.basis[j]
        difference = np.concatenate([-lines.directions[j] @ B, (lines.points[j] - lines.points[i]) @ B])
        J = np.zeros((4, len(covariance)))
        J[:2, 4 * i : 4 * i + 2] = J[2:, 4 * i + 2 : 4 * i + 4] = -np.eye(2)
        J[:2, 4 * j : 4 * j + 2], J[2:, 4 * j + 2 : 4 * j + 4] = -B.T @ C, B.T @ C
        S = J @ covariance @ J.T
        p = float(chdtrc(4, difference @ np.linalg.solve(S, difference)))
        turn, turn_sigma = _size(difference[:2], S[:2, :2])
        gap, gap_sigma = _size(difference[2:], S[2:, 2:])
        out.append(CollinearityTest(names[i], names[j], turn, turn_sigma, gap, gap_sigma, p))
    return out


def _size(vector: Array, covariance: Array) -> tuple[float, float]:
    """Length and its sigma; for a zero length, the sigma along the major axis."""
    size = float(np.linalg.norm(vector))
    if size < 1e-15:
        return 0.0, float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))
    u = vector / size
    return size, float(np.sqrt(u @ covariance @ u))


_FOR_THE_STAND = 15  # positions used for the start value of its pose


@dataclass(frozen=True, slots=True)
class StandModel:
    """Recorded poses of the stand that carried the vehicle, with their uncertainty."""

    stand_from_body: Pose  # (P,) as recorded: the carriage, which is the body frame
    pose_sigmas: Array  # (6,) or (P, 6) of each record: m along the stand's axes, rad about the body's; 0: exact
    world_from_stand: Pose | None  # None: estimated from the nominal beams
    stand_covariance: Array | None  # (6, 6) of the error of world_from_stand; None: estimated without a prior


@dataclass(frozen=True, slots=True)
class BeamCalibration:
    """Calibrated beams, with their covariance and diagnostics."""

    rig: Rig  # with the estimated beams, and cameras and screens as adjusted within their priors
    covariance: RigCovariance  # joint: beams, and cameras and screens if these have errors
    lines: Lines  # the beams, points nearest to the body's origin
    lines_covariance: Array  # (4 k, 4 k) of their errors
    angles: Sequence[BeamAngle]
    collinearity: Sequence[CollinearityTest]  # opposed beams, and the two ends of a beam that has both
    world_from_stand: Pose | None  # None where no position is known
    stand_covariance: Array | None  # (6, 6)
    world_from_body: Pose  # (P,) at the positions, estimated
    spots: SpotPixels  # the input
    fit: SpotFit
    motion: StandMotion
    undetermined: Sequence[str]  # undetermined motions in words, or empty; sigmas are then of the determined part
    frame_free: int  # number of undetermined motions of the body frame: 6 if no position is known
    dropped: Sequence[int]  # positions with too few spots to determine their pose

    @property
    def direction_sigmas(self) -> Array:
        """Sigma of each beam's direction (k,), rad: RMS of the two axes across it."""
        return self._across(0)

    @property
    def offset_sigmas(self) -> Array:
        """Sigma of each beam's offset (k,), m: RMS of the two axes across it, at the point nearest to the origin."""
        return self._across(2)

    def _across(self, first: int) -> Array:
        variances = np.diagonal(self.lines_covariance).reshape(-1, 4)[:, first : first + 2]
        return np.sqrt(np.mean(variances, axis=1))


def calibrate_beams(
    rig: Rig, spots: SpotPixels, stand: StandModel, knowledge: RigCovariance | None = None
) -> BeamCalibration:
    """Beams from spots at recorded positions of a stand.

    rig: cameras and screens as calibrated, beams as drawn. knowledge: joint errors of cameras and screens; None: exact.
    Raises AdjustmentError: the spots are inconsistent, or no start is found.
    """
    start = _start(rig, spots, stand)
    values = {
        **stacks_of(start[0]),
        STAND: Poses.of([start[1]]),
        POSES: Poses(stand.stand_from_body),
    }
    others, free = _known(rig, knowledge)
    free[BEAMS] = True
    if stand.stand_covariance is None:
        free[STAND] = True
    elif np.any(stand.stand_covariance):
        others.append(Prior(((STAND, 0),), (Poses.of([start[1]]),), stand.stand_covariance))
        free[STAND] = np.diagonal(stand.stand_covariance)[None] > 0
    known = Poses(stand.stand_from_body)
    sigmas = np.broadcast_to(np.asarray(stand.pose_sigmas, dtype=float), (len(known), 6))
    if np.any(sigmas):
        others.extend(independent(POSES, known, np.where(sigmas > 0, sigmas, np.inf)))  # exact ones are held fixed
        free[POSES] = sigmas > 0
    return _finished(start[0], spots, values, others, free, stand, ())


def self_calibrate(
    rig: Rig, spots: SpotPixels, positions: int, knowledge: RigCovariance | None = None
) -> BeamCalibration:
    """The shape of the set of beams from spots at unknown positions.

    rig: its beams are the start. The body frame is chosen so that the estimated beams are, together, nearest to these
    (see BodyGauge; points are compared at the points nearest to the origin): a definition, not a measurement. Positions
    whose pose the spots do not determine are excluded. Raises AdjustmentError: fewer than two positions remain.
    """
    fits = body_poses(rig, spots, positions)
    usable = [k for k, f in enumerate(fits) if f is not None]
    if len(usable) < 2:
        raise AdjustmentError(
            f"the vehicle's pose can be determined at {len(usable)} of {positions} positions, two or more are needed:"
            " each requires spots of two or more beams, and nominal beams to start from"
        )
    place = np.full(positions, -1, dtype=np.int64)
    place[usable] = np.arange(len(usable))
    used = spots.pick(np.flatnonzero(place[spots.position] >= 0))
    used = replace(used, position=place[used.position])
    poses = Poses.of([f.world_from_body for f in fits if f is not None])
    values = {**stacks_of(rig), STAND: Poses.of([Pose.identity()]), POSES: poses}
    others, free = _known(rig, knowledge)
    others.append(BodyGauge(at_feet(lines_in(values))[0]))
    free |= {BEAMS: True, POSES: True}
    dropped = [k for k in range(positions) if place[k] < 0]
    return _finished(rig, used, values, others, free, None, dropped)


def _start(rig: Rig, spots: SpotPixels, stand: StandModel) -> tuple[Rig, Pose]:
    """The rig with start values of the beams, and world_from_stand."""
    world_from_stand = stand.world_from_stand
    if world_from_stand is None:
        count = len(stand.stand_from_body.translation)
        few = evenly_spaced(np.arange(count), _FOR_THE_STAND)
        place = np.full(count, -1, dtype=np.int64)
        place[few] = np.arange(len(few))
        there = spots.pick(place[spots.position] >= 0)
        fits = body_poses(rig, replace(there, position=place[there.position]), len(few))
        usable = [int(few[i]) for i, f in enumerate(fits) if f is not None]
        if not usable:
            raise AdjustmentError(
                "the stand's pose cannot be determined: at no position do the spots fit the nominal beams; check the"
                " labels of the spots, or give world_from_stand"
            )
        bodies = Poses.of([f.world_from_body for f in fits if f is not None]).pose
        world_from_stand = stand_of(bodies, stand.stand_from_body[np.array(usable)])
    found = beams_through_spots(rig, spots, world_from_stand @ stand.stand_from_body)
    from_spots = replace(rig, beams={**rig.beams, **found})
    at = {STAND: Poses.of([world_from_stand]), POSES: Poses(stand.stand_from_body)}
    costs = [_cost_per_beam(r, spots, at) for r in (rig, from_spots)]
    better = {
        b: found[b] if b in found and costs[1][i] < costs[0][i] else rig.beams[b] for i, b in enumerate(rig.beams)
    }
    return replace(rig, beams=better), world_from_stand


def _cost_per_beam(rig: Rig, spots: SpotPixels, at: dict[str, Poses]) -> Array:
    """Robust cost of the spots per beam, (beams,); spots that cannot be predicted have a very large residual."""
    r = SpotTerm(rig, spots).linearise({**stacks_of(rig), **at}).residuals
    s = np.nan_to_num(np.sum(r**2, axis=1), nan=1e12)
    return np.bincount(SpotModel.of(rig).beam_of[spots.view], Cauchy().cost(s), len(rig.beams)).astype(float)


def _known(rig: Rig, knowledge: RigCovariance | None) -> tuple[list[Term], dict[str, bool | Bools]]:
    """Priors of cameras and screens, and their free parameters."""
    if knowledge is None:
        return [], {}
    prior, free = prior_of(rig, knowledge.part([not n.startswith("beams.") for n in knowledge.names]))
    return ([] if prior is None else [prior]), dict(free)


def _finished(
    rig: Rig,
    spots: SpotPixels,
    values: Values,
    others: list[Term],
    free: dict[str, bool | Bools],
    stand: StandModel | None,
    dropped: Sequence[int],
) -> BeamCalibration:
    """Adjust, and compute covariance and diagnostics."""
    fit = fit_spots(rig, spots, values, others, free)
    kept = spots.pick(np.flatnonzero(fit.kept))
    kept = replace(kept, covariance=kept.covariance * fit.scale**2)
    values = fit.adjusted.values
    lines, slide = at_feet(lines_in(values))
    beams: list[At] = [(BEAMS, i) for i in range(len(lines))]
    parameters = beams + ([(STAND, 0)] if STAND in free else [])
    gauge = [t for t in others if isinstance(t, BodyGauge)]
    loose = fit.adjusted
    if gauge:
        loose = solve(values, [SpotTerm(rig, kept), *(t for t in others if t not in gauge)], free)
    directions = loose.undetermined(parameters)
    undetermined: list[str] = []
    if len(directions) > (6 if gauge else 0):
        world_from_stand = pose_of(values, STAND)[0] if STAND in free else None
        motions = without_frame(directions, lines_in(values)) if gauge else directions
        undetermined = in_words(motions, list(rig.beams), lines_in(values), world_from_stand)
        at, joint = parameters, _determined_covariance(loose, parameters)
    else:
        at = parameters + [(s, i) for s in free if s not in (BEAMS, STAND, POSES) for i in range(len(values[s]))]
        joint = fit.adjusted.covariance(at)
    for t in gauge:
        slide = slide @ t.projection(lines_in(values))
    K = block_diag(slide, np.eye(len(joint) - len(slide)))
    joint = K @ joint @ K.T
    values = {**values, BEAMS: lines}
    in_rig = np.concatenate([np.full(values[s].dof, s != STAND) for s, _ in at])
    of_rig = named_covariance(rig, values, [a for a in at if a[0] != STAND], joint[np.ix_(in_rig, in_rig)])
    of_lines = joint[: len(slide), : len(slide)]
    poses = pose_of(values, STAND)[0] @ pose_of(values, POSES)
    collinearity = opposed_pairs(list(rig.beams), lines, of_lines) + _end_collinearity(rig, kept, values, others, free)
    return BeamCalibration(
        rig=rig_of(rig, values),
        covariance=of_rig,
        lines=lines,
        lines_covariance=of_lines,
        angles=angles_between(list(rig.beams), lines, of_lines),
        collinearity=collinearity,
        world_from_stand=None if stand is None else pose_of(values, STAND)[0],
        stand_covariance=None if stand is None else (joint[~in_rig][:, ~in_rig] if STAND in free else np.zeros((6, 6))),
        world_from_body=poses,
        spots=spots,
        fit=fit,
        motion=StandMotion.of(poses if stand is None else stand.stand_from_body),
        undetermined=undetermined,
        frame_free=len(directions) if gauge else 0,
        dropped=dropped,
    )


def at_feet(lines: Lines) -> tuple[Lines, Array]:
    """The lines with their points next to the origin, and the Jacobian (4 k, 4 k) of their errors by the given ones."""
    along = -np.sum(lines.points * lines.directions, axis=1)
    blocks = []
    for s in along:
        block = np.eye(4)
        block[2:, :2] = s * np.eye(2)  # a point at a distance moves with the direction
        blocks.append(block)
    return Lines(lines.points + along[:, None] * lines.directions, lines.directions), block_diag(*blocks)


def _determined_covariance(adjusted: Adjusted, parameters: Sequence[At]) -> Array:
    """Covariance of the determined part of some parameters: 0 along the undetermined directions."""
    S = adjusted.reduced_normal(parameters)
    scale = 1.0 / np.sqrt(np.maximum(np.diagonal(S), 1e-300))
    return np.linalg.pinv(S * np.outer(scale, scale), rcond=1e-8, hermitian=True) * np.outer(scale, scale)


def _end_collinearity(
    rig: Rig, spots: SpotPixels, values: Values, others: list[Term], free: dict[str, bool | Bools]
) -> list[CollinearityTest]:
    """Collinearity tests of the beams with spots at both ends, by an adjustment with every end as a separate beam.

    Empty if there are none, or if the ends alone are not determined.
    """
    seen = {rig.views()[v][1] for v in spots.view}
    ends = {(s.beam, s.sign) for n, s in rig.spots.items() if n in seen}
    both = [b for b in rig.beams if {(b, 1), (b, -1)} <= ends]
    if not both:
        return []
    beams: dict[str, Beam] = {}
    of_end: dict[tuple[str, int], str] = {}
    for i, b in enumerate(rig.beams):
        lines = lines_in(values)
        for sign in (1, -1) if b in both else (1,):
            name = f"{b} end {'+' if sign > 0 else '-'}" if b in both else b
            beams[name] = Beam(name, sign * lines.directions[i], lines.points[i])
            of_end[b, sign] = name
    split_spots = {
        n: Spot(n, of_end[s.beam, s.sign], 1, s.screen) if s.beam in both else s for n, s in rig.spots.items()
    }
    split = replace(rig, beams=beams, spots=split_spots)
    split_values = {**values, BEAMS: stacks_of(split)[BEAMS]}
    terms = [BodyGauge(at_feet(lines_in(split_values))[0]) if isinstance(t, BodyGauge) else t for t in others]
    try:
        found = solve(split_values, [SpotTerm(split, spots), *terms], free)
        covariance = found.covariance([(BEAMS, i) for i in range(len(beams))])
    except AdjustmentError:
        return []
    lines, slide = at_feet(lines_in(found.values))
    pairs = opposed_pairs(list(beams), lines, slide @ covariance @ slide.T)
    return [p for p in pairs if any(p.first == of_end[b, 1] and p.second == of_end[b, -1] for b in both)]
