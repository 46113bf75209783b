"""`beampose view`: files of a scene, and its page in the web browser where there is a display."""

from __future__ import annotations

import multiprocessing
import os
import sys
import webbrowser
from pathlib import Path
from typing import Any

import numpy as np

from calibration.open3d_loader import MissingOpen3DError, open3d
from geometry.arrays import Array
from lab.errors import InputError
from lab.files.text.atomic_write import made_folder
from lab.findings.outcome import Done
from lab.report.calibration.calibration_scene import LAB_VIEWS, VIEWS
from lab.results.view.page import write_page
from lab.results.view.scene import Mesh, View, mesh_of, read_content, view_of, write_glb

DEFAULT_OUT = Path("results", "view")
_PICTURES = dict(zip(LAB_VIEWS, ("view-oblique.png", "view-above.png", "view-front.png"), strict=True))
_SIZE_PX = (1280, 900)
_SECONDS = 120.0  # for all pictures; software drawing takes a few


def show(
    path: Path,
    out: Path | None,
    *,
    frame: int | None = None,
    rig: Path | None = None,
    sigma_scale: float | None = None,
) -> Done[tuple[Path, ...]]:
    """Write the scene of a rig.yaml, a run folder or results; without `out`, also open its page in the browser.

    frame: of the beams and spots; None: the middle one. sigma_scale: of the ellipsoids; None: a round number that makes
    them visible. rig: a rig.yaml in place of the run's.

    Raises:
        InputError: an input is not as it should be, or a file cannot be written.
    """
    content = read_content(path, rig)
    index = content.at_frame(frame)
    return write_files(view_of(content, index, sigma_scale), index, out or DEFAULT_OUT, out is None and has_display())


def has_display() -> bool:
    """Whether a browser can show a page here, and not in the terminal."""
    names = ("DISPLAY", "WAYLAND_DISPLAY")
    return not sys.platform.startswith("linux") or any(os.environ.get(name) for name in names)


def write_files(view: View, index: int | None, out: Path, opened: bool = False) -> Done[tuple[Path, ...]]:
    """view.html and scene.glb, and where Open3D can be loaded scene.ply and pictures. opened: in the browser.

    Raises:
        InputError: a file cannot be written.
    """
    made_folder(out)
    write_page(view, index, out / "view.html")
    if opened:
        webbrowser.open((out / "view.html").resolve().as_uri())
    mesh = mesh_of([*view.fixed, *view.moving(index)], view.ellipsoids, view.reach_m, view.extent_m)
    write_glb(mesh, out / "scene.glb")
    files = [out / "view.html", out / "scene.glb"]
    notes: tuple[str, ...] = ()
    try:
        files += _by_open3d(mesh, out)
    except MissingOpen3DError as error:
        notes = (f"no scene.ply and no rendered pictures: {error}",)
    return Done(tuple(files), tuple(map(str, files)), notes)


def _by_open3d(mesh: Mesh, out: Path) -> list[Path]:
    """scene.ply, and the pictures that could be rendered; view.html has drawings in any case."""
    part, ply = out / ".scene.part.ply", out / "scene.ply"
    if not open3d().io.write_triangle_mesh(str(part), as_open3d(mesh)):
        raise InputError(f"{ply}: cannot be written; choose another --out")
    part.replace(ply)
    return [ply, *render(mesh, {view: out / name for view, name in _PICTURES.items()})]


def render(mesh: Mesh, views: dict[str, Path]) -> list[Path]:
    """Write PNG pictures of a mesh; views: file by name of a view, of VIEWS. Returns those that could be drawn.

    In a process of its own, since a graphics driver may write to standard output and may end the process. Without a
    display Open3D draws through EGL, where the system has it.
    """
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


def _draw(mesh: Mesh, jobs: list[tuple[tuple[Array, Array], str]]) -> None:
    """The work of the process. What libraries print goes nowhere."""
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 1)
    os.dup2(null, 2)
    o3d = open3d()
    drawn = as_open3d(mesh)
    window = o3d.visualization.Visualizer()
    if not window.create_window("beampose", *_SIZE_PX, visible=False):
        return
    window.add_geometry(drawn)
    window.get_render_option().mesh_show_back_face = True
    for (right, up), path in jobs:
        control = window.get_view_control()
        control.set_front(np.cross(right, up))
        control.set_up(up)
        control.set_zoom(0.75)
        window.poll_events()
        window.update_renderer()
        part = f"{path}.part.png"
        window.capture_screen_image(part, do_render=True)
        if os.path.isfile(part):
            os.replace(part, path)
    window.destroy_window()
