"""A run whose clocks are to be estimated: offsets and row times that the motion shows, and those that nothing shows."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml
from click.testing import Result

from lab.files.run.results import read_poses
from lab.pictures.picture_file import DROPPED, MissingPicture
from lab.results.certificate import CLOCKS, certificate
from lab.runs.frames.frames import FoundPoints
from lab.simulate.write import simulate
from tests.lab.command import typed
from tests.lab.tables import rows_of
from tracking.detections import Detections

FRAMES, SEED = 80, 3
LATE_S, ROW_TIMES_S = 0.013, {"left": 8e-6, "right": 5e-6}  # of the scenario `clocks`


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("clocks") / "run"
    return simulate("clocks", folder, seed=SEED, frames=FRAMES, points=True)


@pytest.fixture(scope="module")
def rest(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("static") / "run"
    return simulate("static", folder, seed=SEED, frames=60, points=True)


@pytest.fixture(scope="module")
def estimated(recording, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("estimated")
    run(with_cameras(recording, folder / "run", late="estimate", rows="estimate"), folder / "out")
    return folder / "out"


def with_cameras(recording: Path, folder: Path, late: str, rows: str = "", left: str = "", only: str = "") -> Path:
    """A copy of a recording with these fields of its cameras: late of the right one, left of the left one."""
    shutil.copytree(recording, folder)
    content = yaml.safe_load((recording / "run.yaml").read_text())
    cameras = {name: {"detections": block["detections"]} for name, block in content["cameras"].items()}
    for name, offset in (("left", left), ("right", late)):
        cameras[name] |= {"time_offset_s": offset} if offset else {}
        cameras[name] |= {"row_time_s": rows} if rows else {}
    content["cameras"] = {name: block for name, block in cameras.items() if only in ("", name)}
    (folder / "run.yaml").write_text(yaml.safe_dump(content))
    return folder


def run(folder: Path, out: Path) -> Result:
    done = typed("run", folder, "--out", out, "--quiet")
    assert done.exit_code in (0, 4), done.output
    return done


def summary(out: Path) -> dict:
    return dict(json.loads((out / "summary.json").read_text()))


def clock_findings(out: Path) -> list[dict]:
    return [f for f in summary(out)["model_check"]["findings"] if f["code"] == "BP-M09"]


def attitude_rms_deg(out: Path) -> float:
    return float(summary(out)["errors"]["pose"]["measured"]["rotation_deg"]["rms"])


def test_offset_and_row_times_are_found_from_zero_to_their_sigmas(estimated):
    clocks = summary(estimated)["parameters"]["clocks"]
    right = clocks["right"]
    assert right["time_offset_sigma_s"] < 0.05e-2  # of 1 frame, 0.01 s
    assert abs(right["time_offset_s"] - LATE_S) < 4 * right["time_offset_sigma_s"]
    for camera, true in ROW_TIMES_S.items():
        assert abs(clocks[camera]["row_time_s"] - true) < 4 * clocks[camera]["row_time_sigma_s"]


def test_labels_and_attitude_are_those_of_known_clocks(recording, estimated, tmp_path):
    run(recording, tmp_path / "known")
    assert summary(estimated)["errors"]["spots"]["in_view_identity"] == 1.0
    assert attitude_rms_deg(estimated) < 1.3 * attitude_rms_deg(tmp_path / "known")


def test_the_report_states_the_numbers_and_the_tables_have_the_estimated_instants(estimated):
    assert [f["level"] for f in clock_findings(estimated)] == ["PASS"] * 3
    assert "time_offset_s of camera" in (estimated / "report.html").read_text()
    offset = summary(estimated)["parameters"]["clocks"]["right"]["time_offset_s"]
    late = {int(r["frame"]): float(r["t_s"]) for r in rows_of(estimated / "detections.csv") if r["camera"] == "right"}
    np.testing.assert_allclose([late[k] - k / 100 for k in late], offset, atol=1e-9)


def test_the_certificate_has_a_line_for_the_clocks_and_adds_up_to_the_covariance(estimated):
    poses = read_poses(estimated)
    frames = certificate(estimated, at=poses.frames[poses.has("measured")].tolist(), draws=0).frames
    rows = np.searchsorted(poses.frames, [frame.frame for frame in frames])
    stated = np.sqrt(np.diagonal(poses.covariance, axis1=1, axis2=2)[rows, :3])
    np.testing.assert_allclose([f.result.combined[:3] for f in frames], stated, rtol=1e-6)
    np.testing.assert_allclose([f.result.combined[3:] for f in frames], poses.sigma_ypr_deg[rows], rtol=1e-6)
    clocks = np.array([f.variances[f.lines.index(CLOCKS)] for f in frames])
    assert np.all(clocks.max(axis=0) > 0)
    assert min(f.variances.min() for f in frames) >= 0


def test_at_rest_the_prior_stays_and_a_finding_says_so(rest, tmp_path):
    run(with_cameras(rest, tmp_path / "run", late="estimate"), tmp_path / "out")
    right = summary(tmp_path / "out")["parameters"]["clocks"]["right"]
    prior = right["time_offset_prior_sigma_s"]
    assert right["time_offset_sigma_s"] > 0.5 * prior
    assert abs(right["time_offset_s"]) < 0.5 * prior
    (found,) = clock_findings(tmp_path / "out")
    assert found["level"] == "WARN"
    assert "hardly determines" in found["what"]
    assert "prior: 0 ± 10 ms" in found["what"]


def test_one_camera_has_nothing_to_be_compared_with(recording, tmp_path):
    run(with_cameras(recording, tmp_path / "run", late="estimate", only="right"), tmp_path / "out")
    (found,) = clock_findings(tmp_path / "out")
    assert found["level"] == "WARN"
    assert "no other camera" in found["what"]


def test_where_all_offsets_are_estimated_the_first_camera_is_the_reference(rest, tmp_path):
    run(with_cameras(rest, tmp_path / "run", late="estimate", left="estimate"), tmp_path / "out")
    assert "camera `left` is held at 0" in "".join(f["what"] for f in clock_findings(tmp_path / "out"))


def test_points_of_pictures_are_read_again_in_their_order(tmp_path):
    found = FoundPoints(tmp_path, ["left"])
    pictures = [(3, Detections.at(np.ones((2, 2)), np.ones((2, 2, 2)))), (5, MissingPicture(DROPPED))]
    for number, points in pictures:
        found.add("left", number, points)
        found.add("right", number, points)  # a camera whose points are in a table
    for _ in range(2):
        again = list(found.of("left"))
        assert [number for number, _ in again] == [3, 5]
        np.testing.assert_array_equal(again[0][1].uv_px, np.ones((2, 2)))
        assert again[1][1] == MissingPicture(DROPPED)
    found.close()


def test_verify_estimates_the_clocks_again_and_finds_the_same_tables(estimated):
    done = typed("verify", estimated)
    assert done.exit_code == 0, done.output
    assert "SAME: " in done.output
