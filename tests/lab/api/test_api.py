"""The program from Python: what notebooks use."""

from __future__ import annotations

import ast
import doctest
import importlib
import json
import subprocess
import sys

import numpy as np
import pandas as pd
import pytest

import lab
from lab.api.tracking import _detections
from lab.files.run.run_file import load_run
from lab.files.text import columns
from tests.paths import ROOT

MODULES = ("lab.api.results", "lab.api.tracking", "lab.simulate.write")


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory):
    return lab.simulate_run("huo2015", tmp_path_factory.mktemp("api") / "run", frames=40, points=True, seed=3)


@pytest.fixture(scope="module")
def processed(run_folder):
    return lab.process(run_folder, run_folder.parent / "results")


@pytest.mark.parametrize("module", MODULES)
def test_the_examples_in_the_docstrings_are_true(module, processed, run_folder, tmp_path):
    names = {"lab": lab, "results": processed.folder, "run_folder": run_folder, "new_folder": tmp_path / "new"}
    done = doctest.testmod(importlib.import_module(module), extraglobs=names)
    assert (done.failed, done.attempted > 0) == (0, True)


def test_import_lab_loads_no_library_and_every_name_of_it_works():
    code = (
        "import sys, lab; heavy = {'numpy', 'pandas', 'cv2', 'numba', 'scipy'} & set(sys.modules);"
        "values = [getattr(lab, name) for name in lab.__all__];"
        "print(heavy or 'none', all(map(callable, values)), set(lab.__all__) <= set(dir(lab)), 'open3d' in sys.modules)"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT).stdout
    assert out.split() == ["none", "True", "True", "False"]


def test_a_type_checker_sees_the_same_names_as_the_program():
    tree = ast.parse((ROOT / "lab" / "__init__.pyi").read_text())
    seen = {a.asname: n.module for n in tree.body if isinstance(n, ast.ImportFrom) for a in n.names}
    assert seen == lab._PLACES


def test_a_name_that_the_package_does_not_have_is_an_attribute_error():
    with pytest.raises(AttributeError, match="has no attribute 'laod'"):
        lab.laod  # noqa: B018


def test_frames_have_the_columns_and_numbers_of_the_files(processed):
    tables = {
        "attitude": columns.ATTITUDE,
        "attitude_causal": columns.ATTITUDE,
        "spots": columns.SPOTS,
        "detections": columns.DETECTIONS,
        "beams": columns.BEAMS,
    }
    for name, expected in tables.items():
        frame = getattr(processed, name)
        read = pd.read_csv(processed.folder / f"{name}.csv", dtype={"spot": str})
        assert tuple(frame.columns) == expected
        for column in expected:
            if read[column].dtype.kind in "if":
                np.testing.assert_array_equal(frame[column], read[column])
            else:
                assert frame[column].tolist() == read[column].tolist()


def test_name_frames_and_events_are_those_of_the_summary(processed):
    summary = json.loads((processed.folder / "summary.json").read_text("utf-8"))
    assert processed.name == summary["name"]
    assert repr(processed).startswith(f"<Results of {summary['name']}: {summary['verdict']['status']}, 40 frames, ")
    assert processed.frames.tolist() == list(range(40))
    listed = summary["events"]
    assert listed
    assert processed.events["frame"].tolist() == [e["frame"] for e in listed]
    assert processed.events["text"].tolist() == [e["text"] for e in listed]


def test_arrays_agree_with_the_frames(processed):
    a = processed.attitude
    np.testing.assert_array_equal(processed.positions, a[["x_m", "y_m", "z_m"]])
    yaw = np.degrees(np.arctan2(processed.rotations[:, 1, 0], processed.rotations[:, 0, 0]))
    np.testing.assert_allclose(yaw, a["yaw_deg"], atol=1e-6)
    sigma = np.sqrt(np.diagonal(processed.covariance, axis1=1, axis2=2)[:, :3])
    np.testing.assert_allclose(sigma, a[["sigma_x_m", "sigma_y_m", "sigma_z_m"]], rtol=1e-6)
    assert processed.measured.sum() == (a["status"] == "measured").sum() > 30


def test_the_residuals_have_the_size_of_the_noise_of_the_points(processed):
    r = processed.residuals
    assert len(r) == (processed.spots["status"].isin(["matched", "turned"])).sum()
    assert 0.05 < r[["du_px", "dv_px"]].stack().std() < 0.12  # noise 0.1 px, of which the fit takes up a part


def test_the_tracker_on_arrays_gives_the_causal_poses_of_the_run(processed, run_folder):
    prior = load_run(run_folder).prior
    rate = load_run(run_folder).frame_rate_hz
    poses = lab.track(processed.detections, run_folder / "rig.yaml", frame_rate_hz=rate, prior=prior)
    expected = processed.attitude_causal
    assert poses["status"].tolist() == expected["status"].tolist()
    # Ten digits are written in the tables, of the detections too.
    np.testing.assert_allclose(poses[["x_m", "y_m", "z_m"]], expected[["x_m", "y_m", "z_m"]], atol=1e-8)
    np.testing.assert_allclose(poses["sigma_yaw_deg"], expected["sigma_yaw_deg"], rtol=1e-6)


def test_a_camera_without_a_picture_is_not_a_camera_without_points(processed, run_folder):
    first = processed.detections.query("frame == 0")
    left = first[first["camera"] == "left"]
    statuses = {}
    for name, right in (("none", None), ("empty", np.zeros((0, 2)))):
        tracker = lab.Tracker(run_folder / "rig.yaml", prior=load_run(run_folder).prior)
        done = tracker.step(0.0, {"left": left, "right": right})
        statuses[name] = {
            str(s) for s, (camera, _) in zip(done.status, tracker.views, strict=True) if camera == "right"
        }
    assert statuses["none"] & statuses["empty"] == set() or statuses == {"none": {"lost"}, "empty": {"lost"}}


def test_places_with_a_sigma_of_their_own_are_the_rows_of_a_table_with_it(processed, run_folder):
    first, poses = processed.detections.query("frame == 0"), []
    for sigma_px in (0.1, 0.4):
        table = first.assign(sigma_u_px=sigma_px, sigma_v_px=sigma_px, cov_uv_px2=0.0)
        for places in (False, True):
            points = {c: rows[["u_px", "v_px"]].to_numpy() if places else rows for c, rows in table.groupby("camera")}
            tracker = lab.Tracker(run_folder / "rig.yaml", prior=load_run(run_folder).prior, covariance=False)
            done = tracker.step(0.0, points, sigma_px=sigma_px)
            assert str(done.pose_status) == "measured"
            poses.append(np.sqrt(np.diag(done.pose_covariance)))
    np.testing.assert_allclose(poses[1], poses[0], rtol=1e-9)
    np.testing.assert_allclose(poses[3], poses[2], rtol=1e-9)
    assert np.all(poses[3] > 1.5 * poses[1])


@pytest.mark.parametrize("frame", [True, False])
def test_points_in_another_order_or_read_only_need_no_second_compilation(frame):
    """Compiled functions are compiled once more for arrays that are stored in another way."""
    points = pd.DataFrame({"u_px": [3.0, 5.0, 9.0], "v_px": [1.0, 2.0, 4.0], "flux": [1.0, 3.0, 2.0]})
    places = points[["u_px", "v_px"]].to_numpy()
    places.flags.writeable = False
    assert not places.flags.c_contiguous
    found = _detections(points if frame else places, "left", 0.1)
    for array in (found.uv_px, found.cov_px2):
        assert array.flags.c_contiguous
        assert array.flags.writeable
    np.testing.assert_array_equal(found.uv_px, places[[1, 2, 0]] if frame else places)


def test_a_temporary_result_lasts_as_long_as_its_object(run_folder):
    run = lab.process(run_folder, causal=True)
    folder = run.folder
    assert folder.is_dir()
    assert run.attitude_causal is None
    del run
    assert not folder.exists()


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda p, r: lab.process(r, r1_pix=3), "^settings: unknown key .r1_pix"),
        (lambda p, r: lab.find_spots(np.zeros((4, 4, 3), np.uint8)), r"^picture: expected grey \(h, w\)"),
        (lambda p, r: lab.find_spots(np.zeros((4, 4), np.uint8), threshold=5), "settings.*threshold"),
        (lambda p, r: lab.Tracker(r / "rig.yaml", methd="spots"), "settings.*methd"),
        (lambda p, r: lab.Tracker(r / "rig.yaml").step(0, {"lfet": None}), "did you mean 'left'|left"),
        (lambda p, r: lab.Tracker(r / "rig.yaml").step(0, {"left": np.zeros(3)}), "shape"),
        (lambda p, r: lab.Tracker(r / "rig.yaml").step(-1, {}), "dt_s"),
        (lambda p, r: lab.track(p.detections, r / "rig.yaml"), "t_s or a frame rate"),
        (lambda p, r: lab.track(p.detections, r / "rig.yaml", frame_rate_hz=0), "frame_rate_hz"),
        (lambda p, r: p.show(9999), "^frame 9999"),
        (lambda p, r: p.show(3, camera="middle"), "^camera middle"),
        (lambda p, r: lab.load(p.folder, run=r / "nowhere").residuals, "is not there"),
    ],
)
def test_a_mistake_is_an_input_error_that_names_it(call, words, processed, run_folder):
    with pytest.raises(lab.InputError, match=words):
        call(processed, run_folder)


def test_an_annotated_picture_is_a_png(processed, tmp_path):
    picture = processed.show(5)
    assert picture.pixels.ndim == 3
    assert picture.pixels.dtype == np.uint8
    assert picture._repr_png_() == picture.save(tmp_path / "frame.png").read_bytes()
    assert picture._repr_png_().startswith(b"\x89PNG")
