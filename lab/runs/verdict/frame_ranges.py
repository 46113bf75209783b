"""Frame numbers stored as ranges: memory grows with the number of gaps, not with the length of the run."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field


@dataclass(slots=True)
class FrameRanges:
    """Increasing frame numbers as ranges, first and last included."""

    ranges: list[list[int]] = field(default_factory=list)

    def add(self, frame: int) -> None:
        """Add the next frame number, which must be larger than all before."""
        if self.ranges and self.ranges[-1][1] == frame - 1:
            self.ranges[-1][1] = frame
        else:
            self.ranges.append([frame, frame])

    def __len__(self) -> int:
        """Number of frames."""
        return sum(last - first + 1 for first, last in self.ranges)

    def __iter__(self) -> Iterator[tuple[int, int]]:
        """The ranges."""
        return iter((first, last) for first, last in self.ranges)

    def as_text(self, most: int = 3) -> str:
        """`12 to 30, 41`; with more than `most` ranges, the first ones and the number of the others."""
        named = [str(a) if a == b else f"{a} to {b}" for a, b in self.ranges[:most]]
        more = len(self.ranges) - most
        return ", ".join(named) + (f" and {more} more range{'s' if more > 1 else ''}" if more > 0 else "")
