"""How far a stand's positions move the vehicle, descriptions of undetermined motions, and the gauge of the body frame.

An undetermined direction of the parameters, which changes no spot, is an eigenvector of eigenvalue 0 of the normal
matrix. Here it is described as a motion of the whole target relative to the stand, or of one beam. Where only the shape
of the set of beams can be determined, inner constraints fix the body frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from calibration.least_squares.adjustment import Linearised, Lines, Loss, Part, Values
from calibration.terms.rig_blocks import BEAMS, lines_in
from geometry import rotations
from geometry.arrays import Array, cross, normalised
from geometry.pose import Pose
from geometry.rotations import nearest_rotation

_SHARE = 0.98  # of a direction's length that a motion of the whole target must explain
_TURN_RMS = np.deg2rad(2.0)  # about an axis: smaller rotations do not excite it
_SHIFT_RMS = 0.02  # m, likewise along an axis


@dataclass(frozen=True, slots=True)
class StandMotion:
    """Variation of a stand's positions: RMS about their mean, along and about its three axes."""

    turns: Array  # (3,) rad, about x, y, z of the stand
    shifts: Array  # (3,) m, along them

    @staticmethod
    def of(stand_from_body: Pose) -> StandMotion:
        """The variation of positions (P,)."""
        shifts = np.sqrt(np.mean((stand_from_body.translation - stand_from_body.translation.mean(axis=0)) ** 2, axis=0))
        turns = rotations.log(stand_from_body.rotation @ nearest_rotation(stand_from_body.rotation.mean(axis=0)).T)
        return StandMotion(np.sqrt(np.mean(turns**2, axis=0)), shifts)

    def __str__(self) -> str:
        turns = ", ".join(f"{a} {np.rad2deg(t):.1f} deg" for a, t in zip("xyz", self.turns, strict=True))
        shifts = ", ".join(f"{a} {s * 1e3:.0f} mm" for a, s in zip("xyz", self.shifts, strict=True))
        return f"RMS rotations about {turns}; RMS shifts along {shifts}"

    @property
    def flat(self) -> list[str]:
        """The axes with too little rotation about them."""
        return [a for a, t in zip("xyz", self.turns, strict=True) if t < _TURN_RMS]

    def remedy(self) -> str:
        """Positions to add, in words."""
        if self.flat:
            return f"add positions turned by 10 deg or more about the stand's {_and(self.flat)}"
        still = [a for a, s in zip("xyz", self.shifts, strict=True) if s < _SHIFT_RMS]
        if still:
            return f"add positions shifted by 100 mm or more along the stand's {_and(still)}"
        return "add positions that differ more from each other"


def body_motion(lines: Lines) -> Array:
    """Change (4 k, 6) of the errors of k lines by a small motion of the body frame [shift (m), rotation (rad)].

    The sign (lines relative to the frame, or the reverse) is irrelevant here.
    """
    G = np.zeros((len(lines), 4, 6))
    B_t = np.swapaxes(lines.basis, 1, 2)
    axes = np.eye(3)
    G[:, :2, 3:] = B_t @ np.swapaxes(cross(axes[None], lines.directions[:, None]), 1, 2)
    G[:, 2:, :3] = B_t
    G[:, 2:, 3:] = B_t @ np.swapaxes(cross(axes[None], lines.points[:, None]), 1, 2)
    return G.reshape(-1, 6)


def without_frame(directions: Array, lines: Lines) -> Array:
    """Undetermined directions (m, 4 k) without the motions of the body frame, (m - 6, 4 k)."""
    frame = np.linalg.qr(body_motion(lines))[0]
    rest = directions - directions @ frame @ frame.T
    return np.linalg.svd(rest)[2][: max(len(directions) - 6, 0)]


def in_words(directions: Array, beam_names: Sequence[str], lines: Lines, world_from_stand: Pose | None) -> list[str]:
    """Descriptions of undetermined directions (m, 4 k) or, with the six of the stand at the end, (m, 4 k + 6).

    world_from_stand: None if the stand is not estimated. Pure shifts are distinguished from rotations.
    """
    if not len(directions):
        return []
    beams = 4 * len(beam_names)
    G = body_motion(lines)
    if world_from_stand is not None and directions.shape[1] > beams:
        stand = directions[:, beams:]
        if np.all(np.linalg.norm(stand, axis=1) > 0.05 * np.linalg.norm(directions, axis=1)):
            shifts = stand[:, :3] @ world_from_stand.rotation
            found = _motions(np.concatenate([shifts, stand[:, 3:]], axis=1))
            return [f"all beams relative to the stand: {w}" for w in found]
    motions = np.linalg.lstsq(G, directions[:, :beams].T, rcond=None)[0].T
    explained = motions @ G.T
    rigid = np.linalg.norm(explained, axis=1) > _SHARE * np.linalg.norm(directions[:, :beams], axis=1)
    out = [f"all beams together: {w}" for w in _motions(motions[rigid])] if rigid.any() else []
    for direction in directions[~rigid]:
        each = direction[:beams].reshape(-1, 4)
        size = np.linalg.norm(each, axis=1)
        most = 0.2 * float(np.max(size))
        moving = [f"beam {n}: {_beam_motion(e)}" for n, e, s in zip(beam_names, each, size, strict=True) if s > most]
        out.append("; ".join(moving))
    return out


def summary_of(undetermined: Sequence[str]) -> str:
    """A one-line summary: the first two undetermined motions and the number of others."""
    more = len(undetermined) - 2
    return "; ".join(undetermined[:2]) + (f"; and {more} more" if more > 0 else "")


def _motions(motions: Array) -> list[str]:
    """Descriptions of shifts and rotations (m, 6), recombined so that as few as possible are rotations."""
    out = []
    for row in np.linalg.svd(motions[:, 3:], full_matrices=True)[0].T @ motions:
        is_turn = np.linalg.norm(row[3:]) > 1e-3 * np.linalg.norm(row)
        out.append(f"a rotation about {_axis(row[3:])}" if is_turn else f"a shift along {_axis(row[:3])}")
    return sorted(set(out))


def _axis(vector: Array) -> str:
    u = normalised(vector)
    k = int(np.argmax(np.abs(u)))
    if abs(u[k]) > 0.98:
        return "xyz"[k]
    u = -u if u[k] < 0 else u
    return f"({u[0]:.2f}, {u[1]:.2f}, {u[2]:.2f})"


def _beam_motion(four: Array) -> str:
    turn, shift = np.linalg.norm(four[:2]), np.linalg.norm(four[2:])
    if shift < 0.02 * turn:
        return "its direction"
    if turn < 0.02 * shift:
        return "its offset"
    return "direction and offset, coupled"


def _and(words: Sequence[str]) -> str:
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"


# m and rad: sigma of the gauge constraint. It does not compete with the spots, which do not determine the frame, so
# that its value does not affect the result. Much smaller values make a curved valley in which steps become too short:
# with 1e-7 one of 200 simulated calibrations did not converge.
_GAUGE_SIGMA = 1e-4


@dataclass(frozen=True, slots=True)
class BodyGauge:
    """Inner constraints that fix the six parameters of the body frame: the beams stay nearest to the nominal ones.

    The differences between the lines and the nominal ones (a radian weighted like a metre) have no component along a
    motion of the whole frame: the inner constraints of a free network (Triggs et al. 2000, "Bundle adjustment: a modern
    synthesis", section 9).
    """

    nominal: Lines

    @property
    def loss(self) -> Loss | None:
        return None

    def linearise(self, values: Values) -> Linearised:
        """One residual of six numbers."""
        lines = lines_in(values)
        held = self._frame() / _GAUGE_SIGMA
        difference = lines.minus(self.nominal)
        J = held @ self._difference_jacobian(lines)
        parts = [Part(BEAMS, np.array([i]), J[None, :, 4 * i : 4 * i + 4]) for i in range(len(lines))]
        return Linearised((held @ difference.ravel())[None], parts)

    def projection(self, lines: Lines) -> Array:
        """Projection (4 k, 4 k) of errors of the lines onto those with an exactly fixed frame.

        It removes from a covariance the freedom of the frame and keeps that of the shape.
        """
        A = self._frame() @ self._difference_jacobian(lines)
        N = body_motion(lines)
        return np.eye(len(N)) - N @ np.linalg.solve(A @ N, A)

    def _frame(self) -> Array:
        """(6, 4 k): an orthonormal basis of the motions of the frame, as changes of the nominal lines."""
        return np.linalg.qr(body_motion(self.nominal))[0].T

    def _difference_jacobian(self, lines: Lines) -> Array:
        """d(lines.minus(nominal)) / d(errors of the lines), (4 k, 4 k)."""
        return block_diag(*(_line_jacobian(lines, self.nominal, i) for i in range(len(lines))))


def _line_jacobian(lines: Lines, nominal: Lines, i: int) -> Array:
    """d(lines.minus(nominal)) / d(error of the line), (4, 4), to first order in their difference."""
    across = nominal.basis[i].T @ lines.basis[i]
    # Offsets are compared across the nominal line, at its nominal point.
    slide = (nominal.points[i] - lines.points[i]) @ nominal.directions[i]
    J = np.zeros((4, 4))
    J[:2, :2] = J[2:, 2:] = across
    J[2:, :2] = slide * across
    return J
