"""Definition of the body frame (gauge) for beams of which only the shape can be determined."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from calibration.beams.excitation import body_motion
from calibration.least_squares.adjustment import Linearised, Loss, Part, Values
from calibration.least_squares.parameter_blocks import Lines
from calibration.terms.rig_blocks import BEAMS, lines_in
from geometry.arrays import Array

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
