"""Recorded motions, interpolated and differentiated; the alignment of two of them, its residuals and their Jacobian.

R_ref(s) = A R(t) B and p_ref(s) = A (p(t) + R(t) l) + c with s = t + offset + rate (t - middle).
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np

from geometry import rotations
from geometry.arrays import Array, Bools, Ints, evenly_spaced, skew

GAP = 2.5  # times the median step: no interpolation across longer gaps
_BEYOND_ENDS = 0.01  # steps by which a time may lie before the first or after the last sample
_SLOPE_SAMPLES = 3  # on either side


@dataclass(frozen=True, slots=True)
class PoseSeries:
    """Attitudes, positions or both at n rising times. Either may be absent, not both."""

    t_s: Array  # (n,), rising
    rotation: Array | None  # (n, 3, 3), reference frame from body
    position_m: Array | None  # (n, 3)
    covariance: Array  # (n, 6, 6) of [dt (m), dtheta (rad, body)]; zero where the motion counts as exact

    def __post_init__(self) -> None:
        if self.rotation is None and self.position_m is None:
            raise ValueError("expected attitudes, positions or both")
        if len(self.t_s) < 2 or not np.all(np.diff(self.t_s) > 0):
            raise ValueError("expected two or more rising times")

    def __len__(self) -> int:
        return len(self.t_s)

    def select(self, rows: Bools | Ints) -> PoseSeries:
        """The motion at some of its times."""
        return PoseSeries(
            self.t_s[rows],
            None if self.rotation is None else self.rotation[rows],
            None if self.position_m is None else self.position_m[rows],
            self.covariance[rows],
        )

    @property
    def step_s(self) -> float:
        """The median step in time."""
        return float(np.median(np.diff(self.t_s)))


@dataclass(frozen=True, slots=True)
class Interpolated:
    """A motion at m other times; nan where it has a gap or is not recorded."""

    rotation: Array | None  # (m, 3, 3)
    position_m: Array | None  # (m, 3)
    covariance: Array  # (m, 6, 6): that of the nearest sample
    known: Bools  # (m,)


def interpolate(motion: PoseSeries, t_s: Array, gap: float = GAP) -> Interpolated:
    """The motion at times (m,): the cubic through four samples, a line at the ends and beside gaps.

    Rotations are interpolated as rotation vectors about the sample before. gap: in median steps; across longer ones
    nothing is interpolated. A time within 1e-9 steps of a sample returns that sample.
    """
    t_s = np.asarray(t_s, dtype=float)
    step = motion.step_s
    n = len(motion)
    before = np.clip(np.searchsorted(motion.t_s, t_s, side="right") - 1, 0, n - 2)
    u = (t_s - motion.t_s[before]) / (motion.t_s[before + 1] - motion.t_s[before])
    tolerance = 1e-6
    long = np.diff(motion.t_s) > gap * step
    on_first, on_second = np.abs(u) < tolerance, np.abs(u - 1) < tolerance
    inside = (u > -_BEYOND_ENDS) & (u < 1 + _BEYOND_ENDS)
    known = inside & (~long[before] | on_first | on_second)
    places = before[:, None] + np.array([-1, 0, 1, 2])
    long_around = np.concatenate([[True], long, [True]])  # before the first sample, between samples, after the last one
    cubic = ~(long_around[before] | long_around[before + 1] | long_around[before + 2])
    places = np.clip(places, 0, n - 1)
    weights = _lagrange_weights(motion.t_s[places], t_s, cubic)
    rotation = position = None
    if motion.position_m is not None:
        position = np.where(known[:, None], np.einsum("mk,mkj->mj", weights, motion.position_m[places]), np.nan)
    if motion.rotation is not None:
        base = motion.rotation[before]
        about = rotations.log(np.swapaxes(base, -1, -2)[:, None] @ motion.rotation[places])
        rotation = base @ rotations.exp(np.einsum("mk,mkj->mj", weights, about))
        rotation = np.where(known[:, None, None], rotation, np.nan)
    nearest = np.where(u > 0.5, before + 1, before)
    return Interpolated(rotation, position, motion.covariance[nearest], known)


def _lagrange_weights(nodes: Array, t: Array, cubic: Bools) -> Array:
    """Weights (m, 4) of four samples at times nodes (m, 4): cubic, or linear between the two in the middle."""
    weights = np.zeros(nodes.shape)
    scale = nodes[:, 2] - nodes[:, 1]
    x, z = (t - nodes[:, 1]) / scale, (nodes - nodes[:, 1:2]) / scale[:, None]
    weights[:, 1], weights[:, 2] = 1 - x, x
    for k in range(4):
        others = [j for j in range(4) if j != k]
        with np.errstate(divide="ignore", invalid="ignore"):
            w = np.prod([(x - z[:, j]) / (z[:, k] - z[:, j]) for j in others], axis=0)
        weights[:, k] = np.where(cubic, w, weights[:, k])
    return weights


def rates(motion: PoseSeries, gap: float = GAP) -> Array:
    """Velocity (m/s) and rotation rate (rad/s, body) of a motion, (n, 6); zero for what is absent or unknown.

    The slope of the samples up to three steps away, symmetric in time: the error of a sample and that of its rate are
    uncorrelated if the errors are stationary.
    """
    n = len(motion)
    longest = gap * motion.step_s
    top, bottom = np.zeros((n, 6)), np.zeros(n)
    index = np.arange(n)
    for k in range(1, _SLOPE_SAMPLES + 1):
        i = index[k : n - k]
        if not len(i):
            break
        dt = motion.t_s[i + k] - motion.t_s[i - k]
        good = np.where(dt < 2 * k * longest, dt, 0.0)
        change = np.zeros((len(i), 6))
        if motion.position_m is not None:
            change[:, :3] = motion.position_m[i + k] - motion.position_m[i - k]
        if motion.rotation is not None:
            here = np.swapaxes(motion.rotation[i], -1, -2)
            change[:, 3:] = rotations.log(here @ motion.rotation[i + k]) - rotations.log(here @ motion.rotation[i - k])
        top[i] += good[:, None] * change
        bottom[i] += good * dt
    return top / np.where(bottom > 0, bottom, 1.0)[:, None]


PARAMETERS = (
    "offset_s", "rate",
    "world_x_rad", "world_y_rad", "world_z_rad", "body_x_rad", "body_y_rad", "body_z_rad",
    "lever_x_m", "lever_y_m", "lever_z_m", "translation_x_m", "translation_y_m", "translation_z_m",
)  # fmt: skip
TIME, WORLD, BODY, LEVER, TRANSLATION = slice(0, 2), slice(2, 5), slice(5, 8), slice(8, 11), slice(11, 14)


@dataclass(frozen=True, slots=True)
class Alignment:
    """Clocks and frames of a reference relative to those of a result."""

    offset_s: float  # reference time minus result time, at middle_s
    rate: float  # how much faster the reference's clock runs, s/s
    middle_s: float  # result time
    world: Array  # (3, 3): A, reference world from result world
    body: Array  # (3, 3): B, result body from reference body
    lever_m: Array  # (3,): l, the reference's point in the result's body frame
    translation_m: Array  # (3,): c, in the reference's world

    @staticmethod
    def identity(offset_s: float = 0.0, middle_s: float = 0.0) -> Alignment:
        """The same frames, and clocks with a constant offset."""
        return Alignment(offset_s, 0.0, middle_s, np.eye(3), np.eye(3), np.zeros(3), np.zeros(3))

    def reference_time(self, t_s: Array) -> Array:
        """Times of the reference's clock at times (n,) of the result's clock."""
        return np.asarray(t_s + self.offset_s + self.rate * (t_s - self.middle_s))

    def plus(self, delta: Array) -> Alignment:
        """The alignment changed by delta (14,), in the order of PARAMETERS: Exp(a) A and B Exp(b)."""
        return Alignment(
            self.offset_s + float(delta[0]),
            self.rate + float(delta[1]),
            self.middle_s,
            rotations.exp(delta[WORLD]) @ self.world,
            self.body @ rotations.exp(delta[BODY]),
            self.lever_m + delta[LEVER],
            self.translation_m + delta[TRANSLATION],
        )

    def applied(self, result: PoseSeries) -> PoseSeries:
        """The result in the reference's frames, at the result's times."""
        rotation = None if result.rotation is None else self.world @ result.rotation @ self.body
        position = None
        if result.position_m is not None:
            point = result.position_m
            if result.rotation is not None:
                point = point + result.rotation @ self.lever_m
            position = point @ self.world.T + self.translation_m
        return PoseSeries(result.t_s, rotation, position, self._turned_covariance(result))

    def _turned_covariance(self, result: PoseSeries) -> Array:
        J = np.zeros((len(result), 6, 6))
        J[:, :3, :3] = self.world
        if result.rotation is not None:
            J[:, :3, 3:] = -self.world @ result.rotation @ skew(self.lever_m)
        J[:, 3:, 3:] = self.body.T
        return np.asarray(J @ result.covariance @ np.swapaxes(J, -1, -2))


@dataclass(frozen=True, slots=True)
class Residuals:
    """Reference minus aligned result: n times, [position (m), rotation (rad, reference body)]."""

    values: Array  # (n, 6); zero in components that are not compared
    result_covariance: Array  # (n, 6, 6), in the reference's frames
    reference_covariance: Array  # (n, 6, 6)
    known: Bools  # (n,): both motions are known there
    compared: Bools  # (6,): components that both motions have


def residuals(result: PoseSeries, reference: PoseSeries, alignment: Alignment, gap: float = GAP) -> Residuals:
    """Differences of the reference, interpolated at the result's times, to the aligned result."""
    aligned = alignment.applied(result)
    there = interpolate(reference, alignment.reference_time(result.t_s), gap)
    values, compared = np.zeros((len(result), 6)), np.zeros(6, dtype=bool)
    known = there.known.copy()
    if aligned.position_m is not None and there.position_m is not None:
        values[:, :3], compared[:3] = there.position_m - aligned.position_m, True
    if aligned.rotation is not None and there.rotation is not None:
        safe = np.where(known[:, None, None], there.rotation, np.eye(3))
        values[:, 3:], compared[3:] = rotations.log(np.swapaxes(aligned.rotation, -1, -2) @ safe), True
    known &= np.all(np.isfinite(values), axis=1)
    values = np.where(known[:, None], values, 0.0)
    return Residuals(values, aligned.covariance, there.covariance, known, compared)


def jacobians(result: PoseSeries, reference: PoseSeries, alignment: Alignment, compared: Bools) -> tuple[Array, Array]:
    """Two Jacobians (n, 6, 14) of the residuals: with the rates of the result, and with those of the reference.

    The errors of the result's rates are uncorrelated with the residuals, those of the interpolated reference are not:
    the first is used as the instrument in the normal equations, so that noise does not shift the time offset.
    """
    aligned = alignment.applied(result)
    J = np.zeros((len(result), 6, len(PARAMETERS)))
    if aligned.position_m is not None:
        J[:, :3, WORLD] = skew(aligned.position_m - alignment.translation_m)
        J[:, :3, TRANSLATION] = -np.eye(3)
        if result.rotation is not None:
            J[:, :3, LEVER] = -alignment.world @ result.rotation
    if aligned.rotation is not None:
        J[:, 3:, WORLD] = -np.swapaxes(aligned.rotation, -1, -2)
        J[:, 3:, BODY] = -np.eye(3)
    with_reference = J.copy()
    at = alignment.reference_time(result.t_s)
    of_reference = rates(reference)
    elapsed = result.t_s - alignment.middle_s
    there = np.stack([np.interp(at, reference.t_s, of_reference[:, k]) for k in range(6)], axis=1)
    for target, rate in ((J, rates(aligned)), (with_reference, there)):
        target[:, :, 0], target[:, :, 1] = rate, rate * elapsed[:, None]
        target[:, ~compared] = 0.0
    return J, with_reference


# First values of the frames of an alignment, in closed form, for given clocks.


_BASES = 5  # samples that are tried as the one to which the others are related: some may be outliers
_TURNS = 24  # rotations about the main axis of the motion that are tried: one axis alone does not determine A
_ALTERNATIONS = 8  # between rotation and places: each lowers the misfit
_MOST_SAMPLES = 400  # evenly spread: it is a start only


def first_alignment(result: PoseSeries, reference: PoseSeries, start: Alignment, free: Bools) -> Alignment:
    """Frames of an alignment for the clocks of `start`; free (14,): which parameters may change.

    Rotation vectors, or centred positions, are turned onto each other (Kabsch 1976); what attitudes leave open, the
    positions decide. What neither determines stays as near to the identity as it can.
    """
    known = np.flatnonzero(interpolate(reference, start.reference_time(result.t_s)).known)
    if not len(known):
        return start
    result = result.select(known[:: max(1, len(known) // _MOST_SAMPLES)])
    there = interpolate(reference, start.reference_time(result.t_s))
    found = start
    if result.rotation is not None and there.rotation is not None:
        noise = float(np.trace(result.covariance[:, 3:, 3:], axis1=1, axis2=2).sum())
        found = _by_attitude(start, result.rotation, there.rotation, noise, free)
    if result.position_m is None or there.position_m is None:
        return found
    places = there.position_m
    turns = [found.world]
    if free[WORLD].all():
        if result.rotation is not None and there.rotation is not None:
            axis = _main_axis(there.rotation)
            angles = np.arange(1, _TURNS) * 2 * np.pi / _TURNS
            turns += list(rotations.exp(angles[:, None] * axis) @ found.world)
        noise = float(np.trace(result.covariance[:, :3, :3], axis1=1, axis2=2).sum())
        p, q = result.position_m, places
        by_places = _turn_of_places(p, q, noise, np.eye(3))
        turns.append(by_places)
        if result.rotation is not None and there.rotation is None:
            turns += _with_lever_arm(start, result, q, noise, by_places, free)
    candidates = []
    for world in turns:
        candidate = replace(found, world=world)
        if free[BODY].all() and result.rotation is not None and there.rotation is not None:
            candidate = replace(
                candidate, body=_mean_rotation(np.swapaxes(world @ result.rotation, -1, -2) @ there.rotation)
            )
        candidate = _with_places(candidate, result, places, free)
        candidates.append((_misfit(result, reference, candidate), candidate))
    least = min(misfit for misfit, _ in candidates)
    return next(candidate for misfit, candidate in candidates if misfit <= 1.05 * least)


def _with_lever_arm(
    start: Alignment, result: PoseSeries, places: Array, noise: float, first: Array, free: Bools
) -> list[Array]:
    """Rotations A for places of a point with an unknown lever arm, by alternating between A and the lever arm.

    From 24 starting rotations, since the alternation finds the nearest minimum.
    """
    assert result.position_m is not None
    assert result.rotation is not None
    found = []
    for quarter in _quarter_turns():
        world = quarter @ first
        for _ in range(_ALTERNATIONS):
            lever = _with_places(replace(start, world=world), result, places, free).lever_m
            points = result.position_m + result.rotation @ lever
            world = _turn_of_places(points, places, noise, world)
        found.append(world)
    return found


def _turn_of_places(points: Array, places: Array, noise: float, near: Array) -> Array:
    """The rotation between two clouds of points (n, 3) with unknown centres, without the worst tenth."""
    good, world = np.ones(len(points), dtype=bool), near
    for _ in range(2):
        moved, seen = points - points[good].mean(axis=0), places - places[good].mean(axis=0)
        world = _turn(moved[good], seen[good], noise, near)
        away = np.linalg.norm(seen - moved @ world.T, axis=1)
        good = away <= np.quantile(away, 0.9)
    return world


def _quarter_turns() -> list[Array]:
    """The 24 rotations of a cube."""
    found = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            matrix = np.zeros((3, 3))
            matrix[range(3), order] = signs
            if np.linalg.det(matrix) > 0:
                found.append(matrix)
    return found


def _misfit(result: PoseSeries, reference: PoseSeries, alignment: Alignment) -> float:
    """The median of the squared residuals over the mean variances."""
    r = residuals(result, reference, alignment)
    variances = np.diagonal(r.result_covariance + r.reference_covariance, axis1=1, axis2=2).mean(axis=0)
    d2 = np.sum(r.values[r.known] ** 2 / np.where(variances > 0, variances, 1.0), axis=1)
    return float(np.median(d2)) if len(d2) else np.inf


def _with_places(alignment: Alignment, result: PoseSeries, places: Array, free: Bools) -> Alignment:
    """Lever arm and translation by linear least squares, twice: the second time without the worst tenth."""
    assert result.position_m is not None
    n = len(places)
    rest = places - result.position_m @ alignment.world.T
    J = np.zeros((n, 3, 6))
    if free[LEVER].all() and result.rotation is not None:
        J[:, :, :3] = alignment.world @ result.rotation
    else:
        rest = rest - (0 if result.rotation is None else alignment.world @ result.rotation @ alignment.lever_m)
    if free[TRANSLATION].all():
        J[:, :, 3:] = np.eye(3)
    else:
        rest = rest - alignment.translation_m
    rest = rest - (middle := np.median(rest, axis=0) * bool(free[TRANSLATION].all()))
    good = np.ones(n, dtype=bool)
    x: Array = np.zeros(6)
    for _ in range(2):
        # rcond: where attitudes hardly change, the lever arm stays near zero.
        x = np.asarray(np.linalg.lstsq(J[good].reshape(-1, 6), rest[good].ravel(), rcond=1e-2)[0])
        away = np.linalg.norm(rest - J @ x, axis=1)
        good = away <= np.quantile(away, 0.9)
    lever = x[:3] if free[LEVER].all() else alignment.lever_m
    translation = x[3:] + middle if free[TRANSLATION].all() else alignment.translation_m
    return replace(alignment, lever_m=lever, translation_m=translation)


def _main_axis(stack: Array) -> Array:
    """The axis (3,) about which attitudes (n, 3, 3) rotate most, in their outer frame."""
    turned = rotations.log(stack @ stack[len(stack) // 2].T)
    return np.asarray(np.linalg.eigh(turned.T @ turned)[1][:, -1])


def _by_attitude(start: Alignment, R: Array, Q: Array, noise: float, free: Bools) -> Alignment:
    """A and B with Q = A R B for attitudes (n, 3, 3): the best of several samples to which the others are related."""
    best, found = np.inf, (start.world, start.body)
    for i in evenly_spaced(np.arange(len(R)), _BASES).tolist():
        world, body = found if best < np.inf else (start.world, start.body)
        if free[WORLD].all():
            world = _turn(rotations.log(R @ R[i].T), rotations.log(Q @ Q[i].T), noise)
        if free[BODY].all():
            body = _mean_rotation(np.swapaxes(world @ R, -1, -2) @ Q)
        away = float(np.median(rotations.angle(np.swapaxes(world @ R @ body, -1, -2) @ Q)))
        if away < best:
            best, found = away, (world, body)
    return replace(start, world=found[0], body=found[1])


def _turn(moved: Array, seen: Array, noise: float, near: Array | None = None) -> Array:
    """The rotation A (3, 3) with seen = A moved, both (n, 3); about axes without motion close to `near` (identity)."""
    length = np.linalg.norm(moved, axis=1)
    gap = np.linalg.norm(np.abs(np.linalg.norm(seen, axis=1) - length)[:, None], axis=1)
    good = gap <= 3 * np.median(gap) + 1e-12  # lengths do not depend on A: outliers show before A is known
    M = seen[good].T @ moved[good]
    M = M + (1e-3 * float(np.sum(moved[good] ** 2)) + 10 * noise + 1e-12) * (np.eye(3) if near is None else near)
    return rotations.nearest_rotation(M)


def _mean_rotation(stack: Array) -> Array:
    """A rotation in the middle of a stack (n, 3, 3), robust: the mean of the half nearest to the plain mean."""
    mean = rotations.nearest_rotation(stack.mean(axis=0))
    away = rotations.angle(mean.T @ stack)
    return rotations.nearest_rotation(stack[away <= np.median(away)].mean(axis=0))
