"""A body frame for beams of which only the shape can be known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from calibration.beams.excitation import body_motion
from calibration.least_squares.adjustment import Linearised, Loss, Part, Values
from calibration.least_squares.parameter_blocks import Lines
from calibration.terms.rig_blocks import BEAMS, lines_in
from geometry.arrays import Array

# m and rad to which the frame is held. It does not compete with the spots, which say nothing of it, so the number is of
# no account to the values. Much smaller ones make a valley that is bent and so narrow that steps along it end: with
# 1e-7 one of 200 simulated calibrations did not settle.
_HELD_TO = 1e-4


@dataclass(frozen=True, slots=True)
class BodyGauge:
    """Holds the six of the body frame so that the beams stay, together, nearest to where they were drawn.

    The errors of the lines from the nominal ones (a radian counting like a metre) have no part along a motion of the
    whole frame: the inner constraints of a free network (Triggs et al. 2000, "Bundle adjustment: a modern synthesis",
    section 9).
    """

    nominal: Lines

    @property
    def loss(self) -> Loss | None:
        return None

    def linearise(self, values: Values) -> Linearised:
        """One residual of six numbers."""
        lines = lines_in(values)
        held = self._frame() / _HELD_TO
        away = lines.minus(self.nominal)
        J = held @ self._compared(lines)
        parts = [Part(BEAMS, np.array([i]), J[None, :, 4 * i : 4 * i + 4]) for i in range(len(lines))]
        return Linearised((held @ away.ravel())[None], parts)

    def held_exactly(self, lines: Lines) -> Array:
        """What errors (4 k) of the lines become, (4 k, 4 k), when the frame is laid by them without any error.

        Removes from a covariance what the frame is free within; the part of the shape stays.
        """
        A = self._frame() @ self._compared(lines)
        N = body_motion(lines)
        return np.eye(len(N)) - N @ np.linalg.solve(A @ N, A)

    def _frame(self) -> Array:
        """(6, 4 k): an orthonormal basis of what motions of the frame do to the nominal lines."""
        return np.linalg.qr(body_motion(self.nominal))[0].T

    def _compared(self, lines: Lines) -> Array:
        """d(lines.minus(nominal)) / d(errors of the lines), (4 k, 4 k)."""
        return block_diag(*(_turned(lines, self.nominal, i) for i in range(len(lines))))


def _turned(lines: Lines, nominal: Lines, i: int) -> Array:
    """d(lines.minus(nominal)) / d(error of the line), (4, 4), to first order in how far the two are apart."""
    across = nominal.basis[i].T @ lines.basis[i]
    # Offsets are compared across from the nominal point, to which the line's own point is slid.
    slide = (nominal.points[i] - lines.points[i]) @ nominal.directions[i]
    J = np.zeros((4, 4))
    J[:2, :2] = J[2:, 2:] = across
    J[2:, :2] = slide * across
    return J
