"""How a long step reports its progress: one type for all commands and for Python."""

from __future__ import annotations

from typing import Protocol


class Progress(Protocol):
    """Called after each item of a long step; may raise, to stop it."""

    def __call__(self, done: int, total: int | None, stage: str = "", /) -> None:
        """done, total: number of items (frames, pictures, changes tried), the total where it is known.

        stage: the name of the step or of the item, where there is one.
        """
