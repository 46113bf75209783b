"""A body frame for beams of which only the shape can be known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.adjustment import Linearised, Loss, Part, Values
from calibration.excitation import body_motion
from calibration.rig_stacks import BEAMS, lines_in
from calibration.stacks import Lines
from geometry.arrays import Array

# m and rad to which the frame is held: far below what any spot tells, far above rounding. What is held does not
# compete with the spots, which say nothing of it, so the number is of no account to the result.
_HELD_TO = 1e-7


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
        G = body_motion(self.nominal)
        held: Array = np.linalg.qr(G)[0].T / _HELD_TO
        lines = lines_in(values)
        away = lines.minus(self.nominal)
        k = len(self.nominal)
        parts = [
            Part(BEAMS, np.array([i]), (held[:, 4 * i : 4 * i + 4] @ _turned(lines, self.nominal, i))[None])
            for i in range(k)
        ]
        return Linearised((held @ away.ravel())[None], parts)


def _turned(lines: Lines, nominal: Lines, i: int) -> Array:
    """d(lines.minus(nominal)) / d(error of the line), (4, 4), to first order in how far the two are apart."""
    across = nominal.basis[i].T @ lines.basis[i]
    # Offsets are compared across from the nominal point, to which the line's own point is slid.
    slide = (nominal.points[i] - lines.points[i]) @ nominal.directions[i]
    J = np.zeros((4, 4))
    J[:2, :2] = J[2:, 2:] = across
    J[2:, :2] = slide * across
    return J
