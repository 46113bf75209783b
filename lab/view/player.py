"""Which pose a window of `beampose view` shows, and how keys, a slider and the clock change it."""

from __future__ import annotations

from typing import Any

import numpy as np

from lab.view.scene import View


class Player:
    """The moment that is shown, of the known poses of a view."""

    def __init__(self, view: View, index: int | None) -> None:
        self.view = view
        self.known = np.flatnonzero(view.content.known)
        self.at = 0 if index is None else int(np.searchsorted(self.known, index))
        self._started: tuple[float, float] | None = None  # while playing: clock, s, and time of the run, s

    @property
    def index(self) -> int | None:
        """Of the pose shown; None without poses."""
        return int(self.known[self.at]) if len(self.known) else None

    @property
    def playing(self) -> bool:
        """Whether time runs."""
        return self._started is not None

    @property
    def caption(self) -> str:
        """The frame shown and its time, and whether its pose is measured; empty without poses."""
        if self.index is None:
            return ""
        content = self.view.content
        kind = "" if content.measured[self.index] or not content.measured.any() else ", predicted"
        return f"frame {content.frames[self.index]}, {content.t_s[self.index]:.3f} s{kind}"

    def seek(self, at: int) -> None:
        """Go to a known pose by its number, from 0; playing stops."""
        self.step(at - self.at)

    def step(self, frames: int) -> None:
        """Go some known poses on or back, at most to the ends; playing stops."""
        self._started = None
        self.at = int(np.clip(self.at + frames, 0, max(len(self.known) - 1, 0)))

    def leap(self, share: float) -> None:
        """Go a share of the run on or back."""
        self.step(round(share * len(self.known)) or int(np.sign(share)))

    def toggle(self, now_s: float) -> None:
        """Play from here, from the start if this is the end; or pause."""
        if self.playing or len(self.known) < 2:
            self._started = None
            return
        if self.at == len(self.known) - 1:
            self.at = 0
        self._started = (now_s, float(self._times()[self.at]))

    def advance(self, now_s: float) -> bool:
        """Move to the pose of this moment while playing, at the speed of the recording. Whether the pose changed."""
        if self._started is None:
            return False
        before = self.at
        clock, begun = self._started
        self.at = int(np.searchsorted(self._times(), begun + now_s - clock, side="right")) - 1
        self.at = max(self.at, before)
        if self.at >= len(self.known) - 1:
            self._started = None
        return self.at != before

    def _times(self) -> Any:
        return self.view.content.t_s[self.known]
