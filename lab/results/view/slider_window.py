"""A window of Open3D with a slider, a button that plays, and the keys of the other window.

Its drawing needs a driver of Vulkan (Linux) or of the system's own kind; where there is none, the window with keys
alone opens. A graphics driver may write to standard output and may end the process: windows and pictures are drawn in a
process of their own. Without a display Open3D draws pictures through EGL, where the system has it.
"""

from __future__ import annotations

import multiprocessing
import os
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from calibration.open3d_loader import open3d
from geometry.arrays import Array
from lab.report.calibration.calibration_scene import VIEWS
from lab.results.view.scene import Mesh, View, mesh_of

SIZE_PX = (1280, 900)
_SECONDS = 120.0  # for all pictures; software drawing takes a few


def render(mesh: Mesh, views: dict[str, Path]) -> list[Path]:
    """Write PNG pictures of a mesh; views: file by name of a view, of VIEWS. Returns those that could be drawn."""
    for path in views.values():
        path.unlink(missing_ok=True)
    context = multiprocessing.get_context("spawn")
    jobs = [(VIEWS[name], str(path)) for name, path in views.items()]
    worker = context.Process(target=_draw, args=(mesh, jobs), daemon=True)
    worker.start()
    worker.join(_SECONDS)
    if worker.is_alive():
        worker.kill()
        worker.join()
    return [path for path in views.values() if path.is_file()]


def as_open3d(mesh: Mesh) -> Any:
    """Open3D's triangle mesh, with normals."""
    o3d = open3d()
    out = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(mesh.vertices), o3d.utility.Vector3iVector(mesh.triangles.astype(np.int32))
    )
    out.vertex_colors = o3d.utility.Vector3dVector(mesh.colours)
    out.compute_vertex_normals()
    return out


def look_along(control: Any, right: Array, up: Array, zoom: float = 0.75) -> None:
    """Set Open3D's view control so that these world directions point right and up."""
    control.set_front(np.cross(right, up))
    control.set_up(up)
    control.set_zoom(zoom)


def _draw(mesh: Mesh, jobs: list[tuple[tuple[Array, Array], str]]) -> None:
    """The work of the process. What libraries print goes nowhere."""
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 1)
    os.dup2(null, 2)
    o3d = open3d()
    drawn = as_open3d(mesh)
    window = o3d.visualization.Visualizer()
    if not window.create_window("beampose", *SIZE_PX, visible=False):
        return
    window.add_geometry(drawn)
    window.get_render_option().mesh_show_back_face = True
    for (right, up), path in jobs:
        look_along(window.get_view_control(), right, up)
        window.poll_events()
        window.update_renderer()
        part = f"{path}.part.png"
        window.capture_screen_image(part, do_render=True)
        if os.path.isfile(part):
            os.replace(part, path)
    window.destroy_window()


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


KEYS = "space: play or pause; arrows: a frame, a twentieth of the run; home, end: first, last frame"
_FIELD_OF_VIEW_DEG = 45.0
_GAP_EM = 0.5  # around the slider, in heights of a letter


class Controls:
    """The slider, the button and the caption of a player, and what happens when they are used.

    gui: Open3D's module of widgets. show: draws the pose of the player; it is called when that pose has changed.
    """

    def __init__(self, gui: Any, player: Player, show: Callable[[], None]) -> None:
        self.player, self._show = player, show
        self.slider = gui.Slider(gui.Slider.INT)
        self.slider.set_limits(0, max(len(player.known) - 1, 1))
        self.slider.set_on_value_changed(self.slid)
        self.button = gui.Button("Play")
        self.button.tooltip = KEYS
        self.button.set_on_clicked(lambda: self._do(self._toggle))
        self.caption = gui.Label("")
        name, last = gui.KeyName, len(player.known)
        self._keys: dict[Any, Callable[[], None]] = {
            name.SPACE: self._toggle,
            name.RIGHT: lambda: player.step(1),
            name.LEFT: lambda: player.step(-1),
            name.UP: lambda: player.leap(0.05),
            name.DOWN: lambda: player.leap(-0.05),
            name.HOME: lambda: player.step(-last),
            name.END: lambda: player.step(last),
        }
        self._refresh()

    def slid(self, value: float) -> None:
        """The slider has been moved to the number of a known pose."""
        self._do(lambda: self.player.seek(round(value)))

    def press(self, key: Any) -> bool:
        """Do what a key is for. Whether it is for anything."""
        action = self._keys.get(key)
        if action is None:
            return False
        self._do(action)
        return True

    def tick(self, now_s: float) -> bool:
        """Time has passed. Whether anything has changed; now_s: of the clock that `time.monotonic` shows."""
        changed = self.player.advance(now_s)
        if changed:
            self._refresh()
            self._show()
        return changed

    def _toggle(self) -> None:
        self.player.toggle(time.monotonic())

    def _do(self, action: Callable[[], None]) -> None:
        action()
        self._refresh()
        self._show()

    def _refresh(self) -> None:
        self.slider.int_value = self.player.at
        self.button.text = "Pause" if self.player.playing else "Play"
        self.caption.text = self.player.caption


def open_slider_window(view: View, index: int | None) -> bool:
    """Show the view until the window is closed. False: this system cannot open such a window.

    In a process of its own: a driver may end it, and after a failed attempt Open3D opens no other window.
    view: what is shown; index: of the pose shown first; None: the first known one.
    """
    context = multiprocessing.get_context("spawn")
    answer, opened = context.Pipe(duplex=False)
    worker = context.Process(target=_show, args=(view, index, opened), daemon=True)
    worker.start()
    opened.close()  # of the worker alone, so that its end is seen here
    try:
        answer.recv()  # the window is open
    except EOFError:
        return False
    finally:
        worker.join()
    return True


def _show(view: View, index: int | None, opened: Connection) -> None:
    """The work of the process. What libraries print goes nowhere."""
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 1)
    os.dup2(null, 2)
    o3d = open3d()
    app = o3d.visualization.gui.Application.instance
    app.initialize()
    window = app.create_window(f"beampose: {view.content.name}", *SIZE_PX)
    fill(o3d, window, Player(view, index))
    opened.send(True)
    app.run()


def fill(o3d: Any, window: Any, player: Player) -> Controls:
    """Put the scene and the controls into a window. o3d: the module open3d."""
    gui, rendering, view = o3d.visualization.gui, o3d.visualization.rendering, player.view
    scene = gui.SceneWidget()
    scene.scene = rendering.Open3DScene(window.renderer)
    scene.scene.set_background([1.0, 1.0, 1.0, 1.0])
    scene.scene.view.set_post_processing(False)  # which changes the colours
    material = rendering.MaterialRecord()
    material.shader = "defaultUnlit"  # its colours are those of the drawings, from both sides

    def show() -> None:
        """In one mesh: with two, Mesa's software driver of Vulkan stops drawing (measured with 22.3)."""
        things = [*view.fixed, *view.moving(player.index)]
        mesh = as_open3d(mesh_of(things, view.ellipsoids, view.reach_m, view.extent_m))
        if scene.scene.has_geometry("scene"):
            scene.scene.remove_geometry("scene")
        scene.scene.add_geometry("scene", mesh, material)
        window.post_redraw()

    controls = Controls(gui, player, show)
    show()
    right, up = next(iter(VIEWS.values()))
    box = scene.scene.bounding_box
    distance = 0.5 * np.linalg.norm(box.get_extent()) / np.tan(np.radians(_FIELD_OF_VIEW_DEG) / 2)
    centre = np.asarray(box.get_center(), dtype=float)
    scene.setup_camera(_FIELD_OF_VIEW_DEG, box, centre)
    scene.look_at(centre, centre + distance * np.cross(right, up), up)
    window.add_child(scene)
    bar = [] if len(player.known) < 2 else [controls.button, controls.slider, controls.caption]
    for widget in bar:
        window.add_child(widget)

    def place(context: Any) -> None:
        area = window.content_rect
        gap = round(_GAP_EM * window.theme.font_size)
        line = round(1.5 * window.theme.font_size)
        height = 2 * gap + line if bar else 0
        scene.frame = gui.Rect(area.x, area.y, area.width, area.height - height)
        at, y = area.x + gap, area.get_bottom() - height + gap
        widths = [5 * window.theme.font_size, 0, 16 * window.theme.font_size]
        widths[1] = area.width - sum(widths) - 4 * gap
        for widget, width in zip(bar, widths, strict=False):
            widget.frame = gui.Rect(at, y, max(width, 1), line)
            at += width + gap

    window.set_on_layout(place)
    window.set_on_key(lambda event: event.type == gui.KeyEvent.DOWN and controls.press(event.key))
    window.set_on_tick_event(lambda: controls.tick(time.monotonic()))
    return controls
