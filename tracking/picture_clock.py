"""When the rows of a camera's picture were exposed, relative to the instant of the picture's frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geometry.arrays import Array


@dataclass(frozen=True, slots=True)
class PictureClock:
    """The clock of one picture. Its middle row is exposed delay_s after the frame's instant."""

    delay_s: float
    row_time_s: float  # by which each row is exposed later than the one above; 0: a global shutter
    middle_row: float  # (height - 1) / 2

    def after_s(self, v_px: Array) -> Array:
        """(...): when points in these rows (...) were exposed, s after the frame's instant."""
        return np.asarray(self.delay_s + (v_px - self.middle_row) * self.row_time_s)

    def reversed(self) -> PictureClock:
        """The same for a time that runs backward."""
        return PictureClock(-self.delay_s, -self.row_time_s, self.middle_row)

    @property
    def numbers(self) -> tuple[float, float, float]:
        """For compiled functions: delay, row time, middle row."""
        return self.delay_s, self.row_time_s, self.middle_row


AT_THE_FRAME = (0.0, 0.0, 0.0)  # the numbers of a picture without a clock of its own
