"""Frame numbers for the pictures of a device without any: counted, and checked against the clock."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

_CONFIRMING = 12  # consecutive late pictures that confirm a loss: a burst after a pause is late only at its start


@dataclass(slots=True)
class FrameClock:
    """Counts pictures, and detects lost ones: the last dozen are then all late by a frame interval or more.

    The number times the frame interval stays the time since the first picture. The numbers of the dozen pictures after
    a gap are too small by the gap, since it cannot be detected earlier. Ours.
    """

    rate_hz: float
    lost: int = 0  # numbers without a picture
    _next: int = 0
    _start_s: float = 0.0
    _late: deque[float] = field(default_factory=lambda: deque(maxlen=_CONFIRMING))

    def count(self) -> int:
        """The number of the next picture of a source that loses none."""
        self._next += 1
        return self._next - 1

    def number(self, now_s: float) -> int:
        """The number of a picture that arrived at this time, s, of any steady clock."""
        if self._next == 0:
            self._start_s = now_s
        self._late.append((now_s - self._start_s) * self.rate_hz - self._next)
        if min(self._late) < 0:  # the first picture was itself late: the clock starts earlier
            self._start_s += min(self._late) / self.rate_hz
            self._late.clear()
        elif len(self._late) == _CONFIRMING and min(self._late) >= 1:
            lost = int(min(self._late))
            self.lost += lost
            self._next += lost
            self._late.clear()
        return self.count()
