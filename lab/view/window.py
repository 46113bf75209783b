"""An Open3D window: the scene, with the vehicle, its beams and spots at a moment that keys change."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from calibration.open3d_loader import open3d
from lab.report.calibration.calibration_scene import VIEWS
from lab.view.render import as_open3d, look_along
from lab.view.scene import View
from lab.view.solids import mesh_of

KEYS = (
    "space: play or pause; right, left: next, previous frame; up, down: a twentieth of the run; home, end: first,"
    " last; drag: turn; wheel: zoom; Q: close"
)
_SPACE, _LEFT, _RIGHT, _DOWN, _UP, _HOME, _END = 32, 263, 262, 264, 265, 268, 269  # GLFW's numbers


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


def open_window(view: View, index: int | None) -> bool:
    """Show the view until the window is closed. False: no window could be opened."""
    o3d = open3d()
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        window = o3d.visualization.VisualizerWithKeyCallback()
        if not window.create_window(f"beampose: {view.content.name}", 1280, 900):
            return False
        fill(window, view, Player(view, index))
        window.run()
        window.destroy_window()
    return True


def fill(window: Any, view: View, player: Player) -> None:
    """Add the scene to a window, and what keys and time do."""
    window.add_geometry(as_open3d(mesh_of(view.fixed, view.ellipsoids, view.reach_m, view.extent_m)))
    shown: list[Any] = []

    def show(first: bool = False) -> bool:
        for old in shown:
            window.remove_geometry(old, reset_bounding_box=False)
        shown.clear()
        things = view.moving(player.index)
        if things:
            shown.append(as_open3d(mesh_of(things, [], view.reach_m, view.extent_m)))
            window.add_geometry(shown[0], reset_bounding_box=first)
        return True

    def key(action: Any) -> Any:
        def pressed(_: Any) -> bool:
            action()
            return show()

        return pressed

    def tick(_: Any) -> bool:
        return show() if player.advance(time.monotonic()) else False

    show(first=True)
    window.get_render_option().mesh_show_back_face = True
    look_along(window.get_view_control(), *next(iter(VIEWS.values())))
    last = len(player.known)
    for number, action in (
        (_SPACE, lambda: player.toggle(time.monotonic())),
        (_RIGHT, lambda: player.step(1)),
        (_LEFT, lambda: player.step(-1)),
        (_UP, lambda: player.leap(0.05)),
        (_DOWN, lambda: player.leap(-0.05)),
        (_HOME, lambda: player.step(-last)),
        (_END, lambda: player.step(last)),
    ):
        window.register_key_callback(number, key(action))
    window.register_animation_callback(tick)
