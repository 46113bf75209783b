"""`beampose view`: a window where a display exists, else files.

A window of Open3D with keys alone, for systems on which the one with a slider cannot open.

It shows the scene, with the vehicle, its beams and spots at a moment that keys change.
"""

from __future__ import annotations

import ctypes
import os
import sys
import time
from pathlib import Path
from typing import Any

from calibration.open3d_loader import MissingOpen3DError, open3d
from lab.errors import InputError
from lab.files.text.atomic_write import made_folder
from lab.findings.outcome import Done
from lab.report.calibration.calibration_scene import LAB_VIEWS, VIEWS
from lab.results.view.page import write_page
from lab.results.view.scene import Mesh, View, mesh_of, read_content, view_of, write_glb
from lab.results.view.slider_window import Player, as_open3d, look_along, open_slider_window, render

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


DEFAULT_OUT = Path("results", "view")
_PICTURES = dict(zip(LAB_VIEWS, ("view-oblique.png", "view-above.png", "view-front.png"), strict=True))


def has_display() -> bool:
    """Whether a window can open.

    On Linux: whether the X server that DISPLAY names answers. Without one Open3D opens a window that nobody sees, and
    that nobody can close.
    """
    if not sys.platform.startswith("linux"):
        return True
    if not os.environ.get("DISPLAY"):
        return False
    try:
        x11 = ctypes.CDLL("libX11.so.6")
    except OSError:
        return False
    x11.XOpenDisplay.restype = ctypes.c_void_p
    display = x11.XOpenDisplay(None)
    if not display:
        return False
    x11.XCloseDisplay(ctypes.c_void_p(display))
    return True


def show(
    path: Path,
    out: Path | None,
    *,
    frame: int | None = None,
    rig: Path | None = None,
    sigma_scale: float | None = None,
) -> Done[tuple[Path, ...]]:
    """Show a rig.yaml, a run folder or results in a window; without a display, or with `out`, write files.

    frame: of the beams and spots; None: the middle one. sigma_scale: of the ellipsoids; None: a round number that makes
    them visible. rig: a rig.yaml in place of the run's.

    Raises:
        InputError: an input is not as it should be, or a file cannot be written.
    """
    content = read_content(path, rig)
    index = content.at_frame(frame)
    view = view_of(content, index, sigma_scale)
    notes: tuple[str, ...] = ()
    if out is None and has_display():
        try:
            if open_window(view, index):
                return Done((), ())
            notes = ("no window could be opened; files are written instead",)
        except MissingOpen3DError as error:
            notes = (f"no window: {error}",)
    return write_files(view, index, out or DEFAULT_OUT, notes)


def write_files(view: View, index: int | None, out: Path, notes: tuple[str, ...] = ()) -> Done[tuple[Path, ...]]:
    """view.html and scene.glb, and where Open3D can be loaded scene.ply and pictures.

    Raises:
        InputError: a file cannot be written.
    """
    made_folder(out)
    write_page(view, index, out / "view.html")
    mesh = mesh_of([*view.fixed, *view.moving(index)], view.ellipsoids, view.reach_m, view.extent_m)
    write_glb(mesh, out / "scene.glb")
    files = [out / "view.html", out / "scene.glb"]
    try:
        files += _by_open3d(mesh, out)
    except MissingOpen3DError as error:
        notes = (*notes, f"no scene.ply and no rendered pictures: {error}")
    return Done(tuple(files), tuple(map(str, files)), notes)


def _by_open3d(mesh: Mesh, out: Path) -> list[Path]:
    """scene.ply, and the pictures that could be rendered; view.html has drawings in any case."""
    part, ply = out / ".scene.part.ply", out / "scene.ply"
    if not open3d().io.write_triangle_mesh(str(part), as_open3d(mesh)):
        raise InputError(f"{ply}: cannot be written; choose another --out")
    part.replace(ply)
    return [ply, *render(mesh, {view: out / name for view, name in _PICTURES.items()})]
