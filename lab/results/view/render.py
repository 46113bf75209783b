"""Pictures of a mesh by Open3D, in a process of its own.

Without a display Open3D draws through EGL, where the system has it. A graphics driver may write to standard output and
may end the process; neither reaches the command.
"""

from __future__ import annotations

import multiprocessing
import os
from pathlib import Path
from typing import Any

import numpy as np

from calibration.open3d_loader import open3d
from geometry.arrays import Array
from lab.report.calibration.calibration_scene import VIEWS
from lab.results.view.scene import Mesh

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
