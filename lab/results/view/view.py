"""`beampose view`: a window where a display exists, else files."""

from __future__ import annotations

import ctypes
import os
import sys
from pathlib import Path

from calibration.open3d_loader import MissingOpen3DError, open3d
from lab.errors import InputError
from lab.findings.outcome import Done
from lab.report.calibration.calibration_scene import LAB_VIEWS
from lab.results.view.page import write_page
from lab.results.view.scene import Mesh, View, mesh_of, read_content, view_of, write_glb

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
        from lab.results.view.window import open_window

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
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{out}: the folder cannot be made: {error.strerror}; choose another --out") from None
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
    from lab.results.view.render import as_open3d, render

    part, ply = out / ".scene.part.ply", out / "scene.ply"
    if not open3d().io.write_triangle_mesh(str(part), as_open3d(mesh)):
        raise InputError(f"{ply}: cannot be written; choose another --out")
    part.replace(ply)
    return [ply, *render(mesh, {view: out / name for view, name in _PICTURES.items()})]
