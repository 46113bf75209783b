"""Frame numbers for the pictures of a device, which has none: counted, and checked against the clock."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

_SURE = 12  # pictures that must all be late before a gap is believed: a burst after a pause is late only at its start


@dataclass(slots=True)
class FrameClock:
    """Counts pictures; where all of the last dozen come a frame or more too late for their count, pictures were lost.

    So the number times the frame's duration stays the time since the first picture. The numbers of the dozen pictures
    after a gap are too small by the gap: nothing shows it earlier. Ours.
    """

    rate_hz: float
    left_out: int = 0  # numbers that no picture has
    _next: int = 0
    _start_s: float = 0.0
    _late: deque[float] = field(default_factory=lambda: deque(maxlen=_SURE))

    def count(self) -> int:
        """The number of the next picture where none can be lost."""
        self._next += 1
        return self._next - 1

    def number(self, now_s: float) -> int:
        """The number of a picture that came at this time, s of any clock that runs evenly."""
        if self._next == 0:
            self._start_s = now_s
        self._late.append((now_s - self._start_s) * self.rate_hz - self._next)
        if min(self._late) < 0:  # the first picture was itself late: the clock starts earlier
            self._start_s += min(self._late) / self.rate_hz
            self._late.clear()
        elif len(self._late) == _SURE and min(self._late) >= 1:
            lost = int(min(self._late))
            self.left_out += lost
            self._next += lost
            self._late.clear()
        return self.count()
