"""A view shows what the rig and the results say, as a page and a mesh."""

from __future__ import annotations

import json
import re
import sys

import numpy as np
import pytest

from calibration.screens.clouds import open3d
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from lab.errors import InputError
from lab.files.rig.rig_file import save_rig
from lab.results.view import page as solids
from lab.results.view import page as view_module
from lab.results.view.page import read_content, scene_data, show, view_of, write_glb, write_page
from tests.lab.fake_results import make
from tests.lab.simulate.test_own_motion import elsewhere
from tests.marks import needs_open3d


@pytest.fixture(scope="module")
def fake(tmp_path_factory):
    return make(tmp_path_factory.mktemp("fake"))


@pytest.fixture
def content(fake):
    return read_content(fake.results, None)


def test_the_poses_of_results_and_of_a_runs_truth_are_shown(fake, content):
    assert content.known.sum() > 10
    assert read_content(fake.run_folder, None).known.sum() > 10


@pytest.mark.parametrize(
    "rig_of", [lambda content: content.rig, lambda _: elsewhere("2 cameras, 2 screens, 5 beams", 2)]
)
def test_a_rig_alone_is_shown_with_beams_and_its_workspace_wherever_it_stands(content, tmp_path, rig_of):
    rig = rig_of(content)
    save_rig(rig, tmp_path / "rig.yaml")
    alone = read_content(tmp_path / "rig.yaml", None)
    index = alone.at_frame(None)
    view = view_of(alone, index)
    assert len(view.moving(index)) > len(rig.beams)
    at = alone.world_from_body[0]
    box = next(t for t in view.fixed if t.name == "workspace").places
    low, high = np.nanmin(box, axis=0), np.nanmax(box, axis=0)
    model = SpotModel.of(rig)
    enough = max(3, -(-int(np.sum(model.in_picture(model.project(at)[0]))) // 2))

    def seen(place):
        return int(np.sum(model.in_picture(model.project(Pose(at.rotation, place))[0])))

    for axis in range(3):
        for end, beyond in ((low[axis], -0.05), (high[axis], 0.05)):
            place = at.translation.copy()
            place[axis] = end
            assert seen(place) >= enough
            place[axis] += beyond
            assert seen(place) < enough
    write_page(view, index, tmp_path / "view.html")
    text = (tmp_path / "view.html").read_text()
    assert '<div class="controls" hidden>' in text
    assert "a rig, with the vehicle where its cameras see it, in a grey box of" in text
    with pytest.raises(InputError, match="has no poses"):
        alone.at_frame(3)


def test_the_beams_end_where_the_forward_model_says(content):
    index = content.at_frame(None)
    view = view_of(content, index)
    ends = np.array([t.end for t in view.moving(index) if hasattr(t, "end")])
    hits = SpotModel.of(content.rig).hits(content.world_from_body[index])
    hits = np.unique(hits[np.isfinite(hits).all(axis=1)].round(9), axis=0)
    np.testing.assert_allclose(np.unique(ends.round(9), axis=0), hits, atol=1e-9)


def test_the_ellipsoids_are_the_sigmas_times_the_stated_scale(content):
    view = view_of(content, None, 100.0)
    first = int(np.flatnonzero(content.known)[0])
    e = view.ellipsoids[0]
    np.testing.assert_allclose(e.axes @ e.axes.T, 1e4 * content.position_covariance[first], rtol=1e-9, atol=1e-15)
    drawn = solids.ball(e.centre, e.axes, e.colour)
    off = drawn.vertices - e.centre
    chi2 = np.einsum("ni,ij,nj->n", off, np.linalg.inv(e.axes @ e.axes.T), off)
    np.testing.assert_allclose(chi2, 1.0, rtol=1e-6)


def test_an_ellipsoid_that_would_cover_the_scene_is_counted_and_not_drawn(content):
    content.position_covariance[np.flatnonzero(content.known)[0]] = 1e4 * np.eye(3)
    view = view_of(content, None)
    assert view.too_large >= 1
    assert max(np.linalg.norm(e.axes, axis=0).max() for e in view.ellipsoids) < 0.25 * view.extent_m
    assert view_of(content, None, 1e-6).too_large == 0


def test_an_unknown_frame_and_a_missing_run_folder_are_named(fake, content, tmp_path):
    with pytest.raises(InputError, match=r"--frame 99999: expected a frame with a pose, \d+ to \d+"):
        content.at_frame(99999)
    with pytest.raises(InputError, match=r"expected a rig.yaml, a run folder or a folder of results, found nothing"):
        read_content(tmp_path / "nothing", None)
    moved = tmp_path / "moved"
    moved.mkdir()
    for path in fake.results.iterdir():
        if path.is_file():
            (moved / path.name).write_bytes(path.read_bytes())
    summary = json.loads((moved / "summary.json").read_text())
    text = json.dumps(summary).replace(json.dumps(str(fake.run_folder))[1:-1], "gone")
    (moved / "summary.json").write_text(text)
    with pytest.raises(InputError, match=r"its run folder .* is not there; name its rig: --rig rig.yaml"):
        read_content(moved, None)
    save_rig(content.rig, tmp_path / "rig.yaml")
    assert read_content(moved, tmp_path / "rig.yaml").known.any()


def test_the_page_has_a_moment_for_each_pose_and_opens_offline(content, tmp_path):
    index = content.at_frame(None)
    view = view_of(content, index)
    write_page(view, index, tmp_path / "view.html")
    page = (tmp_path / "view.html").read_text()
    data = json.loads(re.search(r'<script type="application/json" id="scene-data">(.*?)</script>', page, re.DOTALL)[1])
    assert data == json.loads(json.dumps(scene_data(view, index)))
    assert [m["k"] for m in data["moments"]] == content.frames[content.known].tolist()
    assert data["moments"][data["first"]]["k"] == content.frames[index]
    assert not re.search(r"""(?:src|href)=["']?(?!data:|#)""", page)


@needs_open3d
def test_the_glb_has_the_mesh_in_the_upright_frame_of_gltf(content, tmp_path):
    view = view_of(content, None)
    mesh = solids.mesh_of(view.fixed, view.ellipsoids, view.reach_m, view.extent_m)
    write_glb(mesh, tmp_path / "scene.glb")
    read = open3d().io.read_triangle_mesh(str(tmp_path / "scene.glb"))
    points = np.asarray(read.vertices)
    assert len(read.triangles) == len(mesh.triangles)
    upright = mesh.vertices @ np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    for one in (points, upright, mesh.vertices):
        assert np.isfinite(one).all()
    box = [(p.min(axis=0), p.max(axis=0)) for p in (points, upright, mesh.vertices)]
    # Open3D's reader may leave the node's rotation out.
    assert np.allclose(box[0], box[1], atol=1e-4) or np.allclose(box[0], box[2], atol=1e-4)


def test_tubes_and_balls_are_closed_to_the_outside():
    ball = solids.ball(np.zeros(3), np.diag([1.0, 2.0, 3.0]), "#0072B2")
    a, b, c = (ball.vertices[ball.triangles[:, k]] for k in range(3))
    volume = np.einsum("ni,ni->n", a, np.cross(b, c)).sum() / 6
    assert 0.8 * 8 * np.pi < volume < 8 * np.pi  # 4/3 pi 1 2 3, from inside
    tube = solids.tube(np.array([[0.0, 0, 0], [1, 0, 0], [np.nan] * 3, [2, 0, 0]]), 0.1, "#0072B2")
    assert len(tube.vertices) == 12  # nothing to or from the gap
    np.testing.assert_allclose(np.linalg.norm(tube.vertices[:, 1:], axis=1), 0.1)
    a, b, c = (tube.vertices[tube.triangles[:, k]] for k in range(3))
    assert (np.einsum("ni,ni->n", np.cross(b - a, c - a), (a + b + c) * [0, 1, 1]) > 0).all()


def test_files_are_written_without_a_display(fake, tmp_path, monkeypatch):
    monkeypatch.setattr(view_module, "has_display", lambda: False)
    monkeypatch.chdir(tmp_path)
    done = show(fake.results, None)
    assert [path.name for path in done.result] == ["view.html", "scene.glb"]
    assert all(path.stat().st_size > 1000 for path in done.result)


@pytest.mark.parametrize("display", [True, False])
@pytest.mark.parametrize("out", [None, "out"])
def test_the_page_opens_in_the_browser_where_there_is_a_display_and_no_out(fake, tmp_path, monkeypatch, display, out):
    opened = []
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setenv("DISPLAY", ":0" if display else "")
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setattr(view_module.webbrowser, "open", opened.append)
    show(fake.results, out and tmp_path / out)
    page = tmp_path / (out or "results/view") / "view.html"
    assert page.is_file()
    assert opened == ([page.resolve().as_uri()] if display and out is None else [])
