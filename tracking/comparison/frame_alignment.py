"""The alignment of two motions: clocks, frames and lever arm; its residuals and their Jacobian.

R_ref(s) = A R(t) B and p_ref(s) = A (p(t) + R(t) l) + c with s = t + offset + rate (t - middle).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geometry import rotations
from geometry.arrays import Array, Bools, skew
from tracking.comparison.motion import GAP, Motion, interpolate, rates

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

    def minus(self, other: Alignment) -> Array:
        """The delta (14,) for which other.plus(delta) = self."""
        clocks = [self.offset_s - other.offset_s, self.rate - other.rate]
        world = rotations.log(self.world @ other.world.T)
        body = rotations.log(other.body.T @ self.body)
        return np.concatenate(
            [clocks, world, body, self.lever_m - other.lever_m, self.translation_m - other.translation_m]
        )

    def applied(self, result: Motion) -> Motion:
        """The result in the reference's frames, at the result's times."""
        rotation = None if result.rotation is None else self.world @ result.rotation @ self.body
        position = None
        if result.position_m is not None:
            point = result.position_m
            if result.rotation is not None:
                point = point + result.rotation @ self.lever_m
            position = point @ self.world.T + self.translation_m
        return Motion(result.t_s, rotation, position, self._turned_covariance(result))

    def _turned_covariance(self, result: Motion) -> Array:
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


def residuals(result: Motion, reference: Motion, alignment: Alignment, gap: float = GAP) -> Residuals:
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


def jacobians(result: Motion, reference: Motion, alignment: Alignment, compared: Bools) -> tuple[Array, Array]:
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
