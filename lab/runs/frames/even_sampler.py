"""Samples frames of a run of unknown length while it is processed, in bounded memory."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Generic, TypeVar

T = TypeVar("T")
BLOCK = 3  # consecutive frames that are kept together: they give the velocities of the spots


@dataclass(slots=True)
class EvenSampler(Generic[T]):
    """Keeps evenly spaced blocks of consecutive frames: whenever it is full, every other block is dropped."""

    most: int  # frames
    kept: list[T] = field(default_factory=list)
    _numbers: list[int] = field(default_factory=list)
    _stride: int = 1  # of the blocks that are kept
    _count: int = 0

    def add(self, frame: T) -> None:
        """Add the next frame."""
        number, self._count = self._count, self._count + 1
        if (number // BLOCK) % self._stride:
            return
        self.kept.append(frame)
        self._numbers.append(number)
        if len(self.kept) > self.most:
            self._stride *= 2
            rows = [i for i, n in enumerate(self._numbers) if not (n // BLOCK) % self._stride]
            self.kept = [self.kept[i] for i in rows]
            self._numbers = [self._numbers[i] for i in rows]

    @property
    def blocks(self) -> list[list[T]]:
        """All runs of BLOCK consecutive frames that are kept."""
        rows = range(len(self.kept) - BLOCK + 1)
        whole = (i for i in rows if self._numbers[i + BLOCK - 1] - self._numbers[i] == BLOCK - 1)
        return [self.kept[i : i + BLOCK] for i in whole]
