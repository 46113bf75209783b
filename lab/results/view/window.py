"""A window of Open3D with keys alone, for systems on which the one with a slider cannot open.

It shows the scene, with the vehicle, its beams and spots at a moment that keys change.
"""

from __future__ import annotations

import time
from typing import Any

from calibration.open3d_loader import open3d
from lab.report.calibration.calibration_scene import VIEWS
from lab.results.view.page import Player
from lab.results.view.render import as_open3d, look_along
from lab.results.view.scene import View, mesh_of
from lab.results.view.slider_window import open_slider_window

KEYS = (
    "space: play or pause; right, left: next, previous frame; up, down: a twentieth of the run; home, end: first,"
    " last; drag: turn; wheel: zoom; Q: close"
)
_SPACE, _LEFT, _RIGHT, _DOWN, _UP, _HOME, _END = 32, 263, 262, 264, 265, 268, 269  # GLFW's numbers


def open_window(view: View, index: int | None) -> bool:
    """Show the view until the window is closed, with a slider if possible. False: no window could be opened."""
    if open_slider_window(view, index):
        return True
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
