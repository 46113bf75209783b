"""From a run folder to its results: all files and rows, correct sigmas, and a folder that is complete or absent."""

from __future__ import annotations

import csv
import json
import shutil
import weakref
from collections import Counter
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml

from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.rotations import matrix_from_quaternion
from lab.errors import InputError, RunError
from lab.files.run.results import POSE_STATUSES, are_results, read_poses, read_spots
from lab.files.run.run_file import load_run
from lab.files.run.truth import read_true_poses
from lab.files.text import columns
from lab.files.text.json_text import plain_value
from lab.runs import process, processed, smoothing_pass
from lab.runs.batch.batch import process_batch
from lab.runs.frames.pipeline import FrameRecord, Pipeline
from lab.runs.process import process_run
from lab.runs.smoothing_pass import SMOOTHING, TRACKING, WRITING, TrackingAndSmoothing
from lab.runs.verdict.moved_camera import MovedCamera
from lab.runs.verdict.quality import LEAST_MEASURED
from lab.runs.verdict.run_statistics import CameraStatistics, RunStatistics
from lab.runs.verdict.score import normalised_squares
from lab.simulate.scenarios import SCENARIOS, RecordingFault
from lab.simulate.write import simulate
from tests.lab.run_folders import write_run
from tests.marks import further_slow
from tests.paths import ROOT
from tracking.curve_switching.spot_tracker import SpotTracker
from tracking.rigid_body.rigid_tracker import RigidTracker
from tracking.smoothing.smoothed import Smoothed
from tracking.statuses import Event, PoseStatus, SpotStatus, TrackedFrame

CAUSAL_FILES = (
    "attitude.csv", "beams.csv", "covariance.csv", "detections.csv", "report.html", "run.log", "spots.csv",
    "summary.json",
)  # fmt: skip
FILES = (*CAUSAL_FILES, "attitude_causal.csv", "covariance_causal.csv", "budget.csv")
HEADERS = {"attitude.csv": columns.ATTITUDE, "beams.csv": columns.BEAMS, "covariance.csv": columns.COVARIANCE,
           "detections.csv": columns.DETECTIONS, "spots.csv": columns.SPOTS,
           "attitude_causal.csv": columns.ATTITUDE, "covariance_causal.csv": columns.COVARIANCE,
           "budget.csv": columns.BUDGET}  # fmt: skip
FRAMES = 14
# Frame 4 in no camera; 6 and 7 only in the right one; 9 damaged in the right one.
DAMAGED = replace(
    SCENARIOS["smooth"],
    faults=(
        RecordingFault(4, "dropped"),
        RecordingFault(6, "dropped", "left"),
        RecordingFault(7, "dropped", "left"),
        RecordingFault(9, "truncated", "right"),
    ),
)


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def names(folder: Path) -> list[str]:
    return sorted(p.name for p in folder.iterdir())


def points_run(folder: Path, frames: int = 12, seed: int = 5) -> Path:
    return simulate("smooth", folder, seed=seed, frames=frames, points=True)


class WeakRecord(FrameRecord):
    """A record that supports weak references, unlike its base class with slots."""


def a_tracked_frame(n: int) -> TrackedFrame:
    """A lost frame of n views."""
    return TrackedFrame(
        np.full((n, 2), np.nan), np.full((n, 2, 2), np.nan), (SpotStatus.OCCLUDED,) * n, np.full((n, 2), np.nan),
        np.full(n, np.nan), np.full(n, -1), PoseStatus.LOST, None, None, 0, float("nan"), (),
    )  # fmt: skip


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory) -> Path:
    """Half-size pictures with missing and damaged ones."""
    return simulate(DAMAGED, tmp_path_factory.mktemp("process") / "run", seed=5, frames=FRAMES, scale=0.5)


@pytest.fixture(scope="module")
def results(run_folder) -> Path:
    out = run_folder.parent / "results"
    process_run(run_folder, out)
    return out


@pytest.fixture(scope="module")
def tables(results) -> dict[str, list[dict[str, str]]]:
    return {name: rows_of(results / name) for name in HEADERS}


# -- files and rows ---------------------------------------------------------------------------------------------------


def test_the_results_are_exactly_the_files_of_the_contract(results):
    assert names(results) == sorted(FILES)


def test_no_temporary_folder_is_left_beside_the_results(results, run_folder):
    assert names(results.parent) == ["results", "run"]


@pytest.mark.parametrize("name", HEADERS)
def test_every_line_has_exactly_the_columns_in_their_order(results, name):
    with (results / name).open(newline="", encoding="utf-8") as file:
        lines = list(csv.reader(file))
    assert tuple(lines[0]) == HEADERS[name]
    assert {len(line) for line in lines} == {len(HEADERS[name])}


def test_attitude_has_a_row_for_every_frame_number_including_dropped_ones(tables):
    assert [int(r["frame"]) for r in tables["attitude.csv"]] == list(range(FRAMES))
    np.testing.assert_allclose([float(r["t_s"]) for r in tables["attitude.csv"]], np.arange(FRAMES) / 100)


def test_spots_has_a_row_for_every_frame_camera_and_spot(tables, run_folder):
    views = load_run(run_folder).rig.views()
    assert [(int(r["frame"]), r["camera"], r["spot"]) for r in tables["spots.csv"]] == [
        (k, c, s) for k in range(FRAMES) for c, s in views
    ]


def test_beams_has_a_row_for_every_frame_and_beam(tables, run_folder):
    beams = load_run(run_folder).rig.beams
    assert [(int(r["frame"]), r["beam"]) for r in tables["beams.csv"]] == [(k, b) for k in range(FRAMES) for b in beams]


def test_covariance_has_a_row_for_every_frame_with_a_pose(tables):
    with_pose = [r["frame"] for r in tables["attitude.csv"] if r["status"] != "lost"]
    assert [r["frame"] for r in tables["covariance.csv"]] == with_pose


def test_a_missing_or_damaged_picture_has_the_status_no_image(tables):
    gone = {(4, "left"), (4, "right"), (6, "left"), (7, "left"), (9, "right")}
    found = {(int(r["frame"]), r["camera"]) for r in tables["spots.csv"] if r["status"] == "no_image"}
    assert found == gone
    assert gone.isdisjoint({(int(r["frame"]), r["camera"]) for r in tables["detections.csv"]})


def test_quaternions_have_unit_length_and_w_not_negative(tables):
    q = np.array([[float(r[n]) for n in ("qw", "qx", "qy", "qz")] for r in tables["attitude.csv"] if r["qw"]])
    assert np.all(q[:, 0] >= 0)
    np.testing.assert_allclose(np.linalg.norm(q, axis=1), 1.0, atol=1e-9)


def test_fields_are_empty_exactly_where_the_status_says_so(tables):
    for r in tables["spots.csv"]:
        empty = r["status"] in ("off_screen", "lost")
        assert (r["u_px"] == "") == (r["v_px"] == "") == (r["sigma_u_px"] == "") == empty
        assert (r["gain"] == "") or r["status"] in ("matched", "turned")
    for r in tables["attitude.csv"]:
        assert (r["x_m"] == "") == (r["status"] == "lost")
    text = {v.lower() for name in HEADERS for r in tables[name] for v in r.values()}
    assert text.isdisjoint({"nan", "inf", "-inf", "none"})


@pytest.mark.parametrize("causal", [True, False])
def test_a_beam_that_misses_its_screen_has_neither_position_nor_sigma(tmp_path, causal):
    process_run(ROOT / "sample_runs/four-skew-beams", tmp_path / "out", causal=causal)
    rows = [r for r in rows_of(tmp_path / "out/spots.csv") if r["status"] == "off_screen"]
    assert rows
    for name in ("u_px", "v_px", "sigma_u_px", "sigma_v_px", "cov_uv_px2"):
        assert {r[name] for r in rows} == {""}


def test_measured_poses_lie_within_their_sigmas_of_the_truth(tables, run_folder):
    truth = {r["frame"]: r for r in rows_of(run_folder / "truth/pose.csv")}
    squares = [
        ((float(r[f"{axis}_m"]) - float(truth[r["frame"]][f"{axis}_m"])) / float(r[f"sigma_{axis}_m"])) ** 2
        for r in tables["attitude.csv"]
        if r["status"] == "measured"
        for axis in "xyz"
    ]
    assert len(squares) >= 3 * 9
    assert 0.3 < np.mean(squares) < 3.0


# -- summary ----------------------------------------------------------------------------------------------------------


def test_the_counts_of_the_summary_are_those_of_the_tables(results, tables):
    summary = json.loads((results / "summary.json").read_text("utf-8"))
    counts = summary["counts"]
    assert counts["frames"] == FRAMES
    assert counts["pose_status"] == dict(Counter(r["status"] for r in tables["attitude.csv"]))
    for view, statuses in counts["spot_status"].items():
        camera, spot = view.split("/")
        here = Counter(r["status"] for r in tables["spots.csv"] if (r["camera"], r["spot"]) == (camera, spot))
        assert statuses == dict(here)
    assert counts["no_image"] == {"left": [[4, 4], [6, 7]], "right": [[4, 4], [9, 9]]}
    found = Counter(r["camera"] for r in tables["detections.csv"])
    assert counts["detections_per_frame"] == pytest.approx({c: n / FRAMES for c, n in found.items()})
    assert summary["rates"]["measured_share"] == counts["pose_status"]["measured"] / FRAMES


def test_the_summary_lists_inputs_parameters_and_versions(results, run_folder):
    summary = json.loads((results / "summary.json").read_text("utf-8"))
    assert {Path(e["path"]).name for e in summary["inputs"]} == {
        "run.yaml", "rig.yaml", "left", "right", "pose.csv", "spots.csv",
    }  # fmt: skip
    assert summary["parameters"]["tracker"]["r1_px"] == 10.0
    assert summary["parameters"]["prior"]["within_m"] == pytest.approx(1.0)
    assert summary["parameters"]["prior"]["within_deg"] == pytest.approx(30.0)
    assert {"python", "numpy", "beampose"} <= set(summary["versions"])
    assert summary["errors"] is not None  # there is truth
    assert summary["verdict"]["exit_status"] in (0, 4)
    assert all(s >= 0 for s in summary["timings"].values())


def test_the_summary_is_strict_json(results):
    def refuse(word):
        raise AssertionError(f"{word} is no JSON")

    json.loads((results / "summary.json").read_text("utf-8"), parse_constant=refuse)


def test_a_number_that_is_not_finite_is_null_in_the_summary():
    content = {"a": float("nan"), "b": [np.float64("inf"), np.int64(3)], "c": (np.float32(0.5), True, None, "text")}
    assert plain_value(content) == {"a": None, "b": [None, 3], "c": [0.5, True, None, "text"]}


def test_without_truth_there_are_no_errors(tmp_path):
    folder = points_run(tmp_path / "run")
    for file in (folder / "truth").iterdir():
        file.unlink()
    (folder / "truth").rmdir()
    outcome = process_run(folder, tmp_path / "out")
    assert outcome.summary["errors"] is None
    assert json.loads((tmp_path / "out/summary.json").read_text())["errors"] is None


# -- the outcome ------------------------------------------------------------------------------------------------------


def test_the_outcome_its_line_and_the_summary_agree(tmp_path):
    folder = points_run(tmp_path / "run")
    outcome = process_run(folder, tmp_path / "out")
    summary = json.loads((tmp_path / "out/summary.json").read_text())
    assert (outcome.result.frames, outcome.result.measured) == (12, summary["counts"]["pose_status"]["measured"])
    assert outcome.verdict.status == summary["verdict"]["status"] == "pass"
    assert outcome.exit_status == summary["verdict"]["exit_status"] == 0
    assert outcome.line() == (
        f"smooth-5: PASS: 12 of 12 frames measured ({outcome.verdict.texts[0]}) -> {tmp_path / 'out'}"
    )


def test_a_run_in_which_the_vehicle_is_never_found_fails_the_gate_and_has_all_its_files(tmp_path):
    """Grey pictures without any spot are processed, with exit status 4."""
    folder = write_run(tmp_path / "run")
    outcome = process_run(folder, tmp_path / "out")
    assert outcome.exit_status == 4
    assert outcome.result.measured == 0
    assert "never found" in outcome.line()
    assert names(tmp_path / "out") == sorted(FILES)
    attitude = rows_of(tmp_path / "out/attitude.csv")
    assert [r["status"] for r in attitude] == ["lost"] * 5
    assert {r["status"] for r in rows_of(tmp_path / "out/spots.csv")} == {"lost"}
    assert rows_of(tmp_path / "out/covariance.csv") == []


def lit(folder: Path, frames: int) -> Path:
    """A run of 40 frames with spots in the first `frames` and in the last one."""
    table = points_run(folder, frames=40) / "detections.csv"
    lines = table.read_text().splitlines(keepends=True)
    table.write_text(
        "".join(ln for i, ln in enumerate(lines) if i == 0 or int(ln.split(",")[0]) < frames or ln.startswith("39,"))
    )
    return folder


def reasons_of(out: Path) -> dict[str, dict]:
    """The reasons of a run's verdict by their kind, from summary.json."""
    return {e["kind"]: e for e in json.loads((out / "summary.json").read_text())["verdict"]["evidence"]}


def test_a_run_without_spots_in_nearly_all_of_its_frames_fails_the_gate(tmp_path):
    outcome = process_run(lit(tmp_path / "run", int(40 * LEAST_MEASURED) - 2), tmp_path / "out")
    assert outcome.result.frames == 40
    assert outcome.exit_status == 4


def test_a_run_without_spots_in_half_of_its_frames_does_not_fail(tmp_path):
    outcome = process_run(lit(tmp_path / "run", 18), tmp_path / "out")
    assert (outcome.result.measured, outcome.verdict.status, outcome.exit_status) == (19, "check", 0)
    few = reasons_of(tmp_path / "out")["few_measured"]
    assert few["numbers"]["causes"] == {"hidden": 21}
    assert few["remedy"]


def test_a_camera_without_detections_is_reported_with_a_remedy(tmp_path, with_page):
    folder = points_run(tmp_path / "run", frames=20)
    table = folder / "detections.csv"
    table.write_text("".join(ln for ln in table.read_text().splitlines(keepends=True) if ",right," not in ln))
    outcome = process_run(folder, tmp_path / "out")
    assert outcome.exit_status == 4
    reasons = reasons_of(tmp_path / "out")
    assert list(reasons) == ["never_found", "nothing_detected"]
    assert reasons["nothing_detected"]["what"] == "camera right: nothing was detected in any of its 20 pictures"
    assert reasons["nothing_detected"]["what"] in outcome.line()
    assert reasons["nothing_detected"]["remedy"].split(" If ")[0] in outcome.line()
    page = (tmp_path / "out/report.html").read_text("utf-8")
    assert "nothing was detected in any of its 20 pictures" in page
    assert "are the lasers on, the lens uncovered" in page


def test_a_wrong_prior_is_distinguished_from_missing_spots(tmp_path):
    folder = points_run(tmp_path / "run", frames=20)
    content = yaml.safe_load((folder / "run.yaml").read_text())
    content["prior"] |= {"position_m": [2.0, 1.5, 0.0], "within_m": 0.1, "within_deg": 3.0}
    (folder / "run.yaml").write_text(yaml.safe_dump(content))
    assert process_run(folder, tmp_path / "out").exit_status == 4
    reasons = reasons_of(tmp_path / "out")
    assert list(reasons) == ["never_found", "not_acquired"]
    assert reasons["not_acquired"]["remedy"].startswith("Check the prior")


def test_a_camera_that_stops_or_starts_late_is_reported(tmp_path):
    gone = tuple(RecordingFault(k, "dropped", camera) for camera, k in (("left", 12), ("left", 13), ("right", 0)))
    scenario = replace(SCENARIOS["smooth"], faults=gone)
    folder = simulate(scenario, tmp_path / "run", seed=5, frames=FRAMES, scale=0.3)
    process_run(folder, tmp_path / "out")
    reasons = reasons_of(tmp_path / "out")
    assert (
        reasons["camera_stopped"]["what"]
        == "camera left stopped before the end: it has no picture from frame 12 on (2 frames)"
    )
    assert reasons["camera_late"]["what"] == "camera right starts late: it has no picture of the first 1 frame"


@pytest.mark.parametrize("shift", further_slow([0, 3, 1], fast=2))
@pytest.mark.parametrize("camera", further_slow(["right", "left"]))
def test_points_whose_frames_are_numbered_differently_in_two_cameras_never_pass(tmp_path, camera, shift):
    """Where the motion is slow the residuals hardly show it: all poses combine points of different instants."""
    folder = points_run(tmp_path / "run", frames=24)
    points = pd.read_csv(folder / "detections.csv")
    points.loc[points["camera"] == camera, "frame"] += shift
    points.sort_values(["frame", "camera"], kind="stable").to_csv(folder / "detections.csv", index=False)
    shutil.rmtree(folder / "truth")
    process_run(folder, tmp_path / "out")
    verdict = json.loads((tmp_path / "out" / "summary.json").read_text())["verdict"]
    named = [e["what"] for e in verdict["evidence"] if f"numbered from {shift} and from 0" in e["what"]]
    assert len(named) == (shift > 0)
    assert all(what.startswith(f"camera {camera} shows nothing in its first {shift} frame") for what in named)
    assert verdict["status"] != "pass" or not shift


def test_a_vehicle_that_is_lost_only_in_the_causal_pass_is_not_reported_as_lost(tmp_path, monkeypatch, with_page):
    """Searches of the causal pass are events; the verdict counts the reported frames."""
    causal_step = RigidTracker.step

    def step(self, dt_s, found):
        tracked = causal_step(self, dt_s, found)
        return replace(tracked, events=(*tracked.events, Event("reacquired", "found from the prior alone")))

    monkeypatch.setattr(RigidTracker, "step", step)
    outcome = process_run(points_run(tmp_path / "run", frames=40), tmp_path / "out")
    counts = json.loads((tmp_path / "out/summary.json").read_text())["counts"]
    assert counts["events"]["reacquired"] == 40
    assert counts["found_again"] == 0
    assert outcome.verdict.status == "pass"
    assert "found again" not in (tmp_path / "out/report.html").read_text("utf-8")


@pytest.mark.parametrize("causal", [True, False])
def test_the_rms_residual_is_that_of_the_reported_pose_against_its_own_spots(tmp_path, causal):
    folder = points_run(tmp_path / "run", frames=40)
    process_run(folder, tmp_path / "out", causal=causal)
    model = SpotModel.of(load_run(folder).rig)
    poses, spots = read_poses(tmp_path / "out"), read_spots(tmp_path / "out")
    order = [spots.views.index(view) for view in model.views]
    residual = spots.uv_px[:, order] - model.project(poses.world_from_body)[0]
    residual[~spots.measured[:, order]] = np.nan
    measured = poses.has(PoseStatus.MEASURED)
    assert measured.sum() > 30
    rms = np.sqrt(np.nanmean(residual**2, axis=(1, 2)))
    np.testing.assert_allclose(poses.rms_px[measured], rms[measured], rtol=1e-4)


def test_a_wrong_smoothed_pose_is_reported_as_predicted_with_sigmas_that_cover_the_error(tmp_path, monkeypatch):
    """A pose with an error of 5 mm for ten frames and stated sigmas of 0.1 mm contradicts its spots."""
    smoothed_frame = Smoothed.frame

    def wrong_frame(self, k, causal, found):
        tracked = smoothed_frame(self, k, causal, found)
        if not 20 <= k < 30:
            return tracked
        return replace(tracked, pose=tracked.pose.plus(np.array([5e-3, 0, 0, 0, 0, 0])))

    folder = points_run(tmp_path / "run", frames=40)
    monkeypatch.setattr(Smoothed, "frame", wrong_frame)
    outcome = process_run(folder, tmp_path / "out")
    reasons = reasons_of(tmp_path / "out")["contradiction"]
    assert reasons["numbers"] == {"frames": [[20, 29]]}
    assert any("contradict their own spots" in text for text in outcome.verdict.texts)
    poses = read_poses(tmp_path / "out")
    assert np.flatnonzero(poses.has(PoseStatus.PREDICTED)).tolist() == list(range(20, 30))
    truth = rows_of(folder / "truth/pose.csv")
    q = np.array([[float(r[n]) for n in ("qw", "qx", "qy", "qz")] for r in truth])
    true = Pose.from_quaternion(q, np.array([[float(r[n]) for n in ("x_m", "y_m", "z_m")] for r in truth]))
    nees = normalised_squares(true.minus(poses.world_from_body), poses.covariance)
    assert np.all(nees[20:30] < 25)


@pytest.mark.parametrize("in_memory", further_slow([5, 0, smoothing_pass.IN_MEMORY]))
def test_the_same_run_gives_the_same_tables(tmp_path, run_folder, results, monkeypatch, in_memory):
    """Also if most frames are stored on disk between the passes."""
    monkeypatch.setattr(smoothing_pass, "IN_MEMORY", in_memory)
    process_run(run_folder, tmp_path / "again")
    for name in HEADERS:
        assert (tmp_path / "again" / name).read_bytes() == (results / name).read_bytes()


def test_the_written_detections_can_be_the_input_of_a_run(tmp_path, run_folder, results):
    """A run from its own detections.csv has the same poses, to a tenth of their sigmas.

    The table does not state which part of a variance belongs to the place; the two parts have factors of their own.
    """
    run = yaml.safe_load((run_folder / "run.yaml").read_text())
    other = tmp_path / "run"
    other.mkdir()
    (other / "rig.yaml").write_bytes((run_folder / "rig.yaml").read_bytes())
    (other / "detections.csv").write_bytes((results / "detections.csv").read_bytes())
    run["cameras"] = {name: {"detections": "detections.csv"} for name in run["cameras"]}
    (other / "run.yaml").write_text(yaml.safe_dump(run))
    process_run(other, tmp_path / "out")
    for a, b in zip(rows_of(tmp_path / "out/attitude.csv"), rows_of(results / "attitude.csv"), strict=True):
        if a["status"] == b["status"] == "measured" and a["spots_used"] == b["spots_used"]:
            assert abs(float(a["yaw_deg"]) - float(b["yaw_deg"])) < 0.1 * float(b["sigma_yaw_deg"])


def test_overrides_replace_parameters_of_the_run_and_of_its_blocks(tmp_path):
    folder = points_run(tmp_path / "run")
    process_run(folder, tmp_path / "out", overrides={"r1_px": 12.0, "labels.p_detect": 0.9, "method": "rigid"})
    tracker = json.loads((tmp_path / "out/summary.json").read_text())["parameters"]["tracker"]
    assert (tracker["r1_px"], tracker["labels"]["p_detect"], tracker["method"]) == (12.0, 0.9, "rigid")
    assert tracker["r2_px"] == 30.0


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        ({"r1_pz": 3}, r"--set: unknown key 'r1_pz'.*did you mean 'r1_px'"),
        ({"labels.p_detct": 3}, r"--set: labels.*'p_detct'.*did you mean 'p_detect'"),
        ({"lables.p_detect": 3}, r"'lables'.*did you mean 'labels'"),
        ({"r1_px.x": 3}, r"--set: .*r1_px\.x"),
        ({"p_detect": 1.5}, r"--set: p_detect: expected a number from 0 to 1, got 1.5"),
        ({"jerk_m_s3": -1}, r"--set: jerk_m_s3: expected a number of 0 or more, got -1"),
        ({"labels.max_refined": -2}, r"--set: labels: max_refined: expected a number of 1 or more, got -2"),
        ({"detect.max_detections": 0}, r"--set: detect: max_detections: expected a number of 1 or more, got 0"),
        ({"r1_px": "wide"}, r"--set: r1_px: expected a finite number, got 'wide'"),
        ({"method": "magic"}, r"--set: method: expected .*rigid.*spots.*'magic'"),
    ],
)
def test_a_wrong_override_is_an_input_error_and_nothing_is_written(tmp_path, overrides, words):
    folder = points_run(tmp_path / "run", frames=3)
    with pytest.raises(InputError, match=words):
        process_run(folder, tmp_path / "out", overrides=overrides)
    assert names(tmp_path) == ["run"]


@pytest.mark.parametrize("method", ["rigid", "spots"])
def test_a_run_without_a_prior_gives_the_same_as_with_one(tmp_path, method):
    """Four skew beams have no symmetry, so their first labels need no prior."""
    folder = simulate("four-skew-beams", tmp_path / "run", seed=5, frames=20, points=True)
    process_run(folder, tmp_path / "with", overrides={"method": method})
    content = yaml.safe_load((folder / "run.yaml").read_text())
    del content["prior"]
    (folder / "run.yaml").write_text(yaml.safe_dump(content))
    process_run(folder, tmp_path / "without", overrides={"method": method})
    assert json.loads((tmp_path / "without/summary.json").read_text())["parameters"]["prior"] is None
    one, other = (read_poses(tmp_path / which) for which in ("with", "without"))
    assert (other.status == POSE_STATUSES.index(PoseStatus.MEASURED)).all()
    away = one.world_from_body.minus(other.world_from_body)
    assert np.abs(away[:, :3]).max() < 1e-3
    assert np.abs(away[:, 3:]).max() < np.deg2rad(0.02)


# -- two passes -------------------------------------------------------------------------------------------------------


def test_in_the_last_frame_the_smoothed_pose_is_the_causal_one(tmp_path):
    """No frame follows it. (The jerk is given: an estimate from all frames would differ from the causal one.)

    The smoother's noise is what the residuals of the run show: of 60 frames it is known to 8 %.
    """
    known = {"learn_jerk": False, "jerk_m_s3": 2.0, "jerk_rad_s3": 5.0}
    process_run(points_run(tmp_path / "run", frames=60), tmp_path / "out", overrides=known)
    smoothed, causal = (read_poses(tmp_path / "out", causal=c) for c in (False, True))
    assert np.array_equal(smoothed.frames, causal.frames)
    away = normalised_squares(smoothed.world_from_body.minus(causal.world_from_body), causal.covariance)
    assert away[-1] < 0.2**2
    assert np.median(away[:-5]) > 1.0
    np.testing.assert_allclose(smoothed.sigma_position_m[-1], causal.sigma_position_m[-1], rtol=0.15)
    np.testing.assert_allclose(smoothed.sigma_ypr_deg[-1], causal.sigma_ypr_deg[-1], rtol=0.15)
    np.testing.assert_allclose(smoothed.sigma_velocity_m_s[-1], causal.sigma_velocity_m_s[-1], rtol=0.15)
    # In the middle of the run the following frames have as much information as the previous ones.
    inner = [np.median(p.sigma_ypr_deg[10:-10, 0]) for p in (smoothed, causal)]
    assert inner[0] < 0.75 * inner[1]


def test_in_the_first_frame_the_smoothed_sigmas_are_smaller_than_the_causal_ones(tmp_path):
    process_run(points_run(tmp_path / "run", frames=30), tmp_path / "out")
    smoothed, causal = (read_poses(tmp_path / "out", causal=c) for c in (False, True))
    assert np.all(smoothed.sigma_position_m[0] < causal.sigma_position_m[0])
    assert np.all(smoothed.sigma_velocity_m_s[0] < 0.1 * causal.sigma_velocity_m_s[0])


def test_the_tables_of_a_causal_run_are_the_causal_tables_of_a_smoothed_one(tmp_path):
    folder = points_run(tmp_path / "run")
    process_run(folder, tmp_path / "smoothed")
    process_run(folder, tmp_path / "causal", causal=True)
    assert names(tmp_path / "causal") == sorted(CAUSAL_FILES)
    for name in ("attitude", "covariance"):
        kept, alone = tmp_path / "smoothed" / f"{name}_causal.csv", tmp_path / "causal" / f"{name}.csv"
        assert kept.read_bytes() == alone.read_bytes()
        assert kept.read_bytes() != (tmp_path / "smoothed" / f"{name}.csv").read_bytes()
    summaries = [json.loads((tmp_path / which / "summary.json").read_text()) for which in ("smoothed", "causal")]
    assert [t["attitude"] for t in summaries] == ["smoothed", "causal"]
    assert [t["timings"]["smoothing_s"] > 0 for t in summaries] == [True, False]
    keys = {"jerk_m_s3", "jerk_rad_s3", "iterations", "relabelled", "place_share", "seconds"}
    assert set(summaries[0]["smoother"]) == keys
    assert summaries[1]["smoother"] is None
    assert [t["errors"]["pose_causal"] is None for t in summaries] == [False, True]


def test_the_predictions_are_the_same_in_both_passes(tmp_path):
    folder = points_run(tmp_path / "run")
    process_run(folder, tmp_path / "smoothed")
    process_run(folder, tmp_path / "causal", causal=True)
    smoothed, causal = (rows_of(tmp_path / which / "spots.csv") for which in ("smoothed", "causal"))
    for a, b in zip(smoothed, causal, strict=True):
        assert (a["predicted_u_px"], a["predicted_v_px"]) == (b["predicted_u_px"], b["predicted_v_px"])
    assert any(a["predicted_u_px"] for a in smoothed)


def test_the_papers_tracker_is_smoothed_too_and_keeps_its_labels(tmp_path):
    folder = points_run(tmp_path / "run")
    process_run(folder, tmp_path / "smoothed", overrides={"method": "spots"})
    process_run(folder, tmp_path / "causal", overrides={"method": "spots"}, causal=True)
    summary = json.loads((tmp_path / "smoothed/summary.json").read_text())
    assert (summary["attitude"], summary["smoother"]["relabelled"]) == ("smoothed", 0)
    smoothed, causal = (rows_of(tmp_path / which / "spots.csv") for which in ("smoothed", "causal"))
    assert [r["status"] for r in smoothed] == [r["status"] for r in causal]
    assert {r["label_probability"] for r in smoothed} == {""}  # this tracker does not estimate it
    assert {r["velocity_x_m_s"] for r in rows_of(tmp_path / "causal/attitude.csv")} == {""}  # it has none
    assert "" not in {r["velocity_x_m_s"] for r in rows_of(tmp_path / "smoothed/attitude.csv")}


def test_the_method_chooses_the_tracker(tmp_path):
    run = load_run(points_run(tmp_path / "run", frames=3))
    for method, kind in (("rigid", RigidTracker), ("spots", SpotTracker)):
        chosen = replace(run, tracker=replace(run.tracker, method=method))
        assert type(Pipeline.of(chosen).tracker) is kind
    assert run.tracker.method == "rigid"  # unless the run says otherwise


def test_frames_are_stored_on_disk_between_the_passes(tmp_path, monkeypatch):
    """Between the passes only the first records of the causal pass are in memory."""
    monkeypatch.setattr(smoothing_pass, "IN_MEMORY", 5)
    pipeline = Pipeline.of(load_run(points_run(tmp_path / "run", frames=40)))
    alive = []

    class Watched:
        """A pipeline with weak references to its records."""

        run, reader, timings = pipeline.run, pipeline.reader, pipeline.timings

        @staticmethod
        def records():
            for record in pipeline.records():
                copy = WeakRecord(*(getattr(record, f.name) for f in fields(record)))
                alive.append(weakref.ref(copy))
                yield copy

    left = []
    passes = TrackingAndSmoothing(
        Watched(), tmp_path, lambda done, total, stage: left.append(stage == SMOOTHING and still())
    )

    def still():
        return sum(ref() is not None for ref in alive)

    assert sum(1 for _ in passes.records()) == 40
    assert len(alive) == 40
    assert max(left) <= 5 + 1  # and the one that the loop still holds
    assert names(tmp_path) == ["run"]  # no file is left


def test_no_temporary_file_is_left_when_the_iteration_stops(tmp_path):
    pipeline = Pipeline.of(load_run(points_run(tmp_path / "run", frames=6)))
    work = tmp_path / "work"
    work.mkdir()
    records = TrackingAndSmoothing(pipeline, work).records()
    next(records)
    records.close()
    assert names(work) == []


def test_consecutive_frames_with_an_uncertain_label_are_one_event():
    statistics = RunStatistics({"left": CameraStatistics()}, (("left", "1"), ("left", "2")))
    tracked = replace(a_tracked_frame(2), label_probability=np.array([0.6, np.nan]))
    for frame in (3, 4, 5, 9):
        events = (Event("undecided", "label left open", 0), Event("dropped", "contradicts", 1))
        statistics.add(FrameRecord(frame, 0.0, 0.0, (None,), ("dropped",), replace(tracked, events=events)))
    listed = [(e.frame, e.last_frame, e.kind, e.spot) for e in statistics.events.listed]
    assert listed == [
        (3, 5, "undecided", "1"), (3, 3, "dropped", "2"), (4, 4, "dropped", "2"), (5, 5, "dropped", "2"),
        (9, 9, "undecided", "1"), (9, 9, "dropped", "2"),
    ]  # fmt: skip
    assert statistics.events.kinds == {"undecided": 4, "dropped": 4}
    assert statistics.labels_left_open == 4
    assert statistics.cameras["left"].missing_reasons == {"dropped": 4}


# -- complete or absent -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("error", [RunError("the disk is full"), KeyboardInterrupt(), RuntimeError("a bug")])
def test_a_run_that_fails_in_the_middle_leaves_nothing(tmp_path, monkeypatch, error):
    folder = points_run(tmp_path / "run")
    write = process.TableWriter.write

    def break_at_frame_6(self, record, causal):
        if record.frame == 6:
            raise error
        write(self, record, causal)

    monkeypatch.setattr(process.TableWriter, "write", break_at_frame_6)
    with pytest.raises(type(error)):
        process_run(folder, tmp_path / "out")
    assert names(tmp_path) == ["run"]


@pytest.mark.parametrize("stage", [TRACKING, SMOOTHING, WRITING])
def test_a_run_that_is_stopped_in_any_stage_leaves_nothing(tmp_path, stage):
    folder = points_run(tmp_path / "run")

    def stop(done, total, now):
        if now == stage and done in (0, 4):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        process_run(folder, tmp_path / "out", progress=stop)
    assert names(tmp_path) == ["run"]


def test_a_run_that_fails_leaves_earlier_results_unchanged(tmp_path, monkeypatch):
    folder = points_run(tmp_path / "run", frames=4)
    out = tmp_path / "out"
    process_run(folder, out)
    before = {p.name: p.read_bytes() for p in out.iterdir()}

    def fail(*_):
        raise RunError("the disk is full")

    monkeypatch.setattr(processed, "write_json", fail)
    with pytest.raises(RunError):
        process_run(folder, out)
    assert {p.name: p.read_bytes() for p in out.iterdir()} == before
    assert names(tmp_path) == ["out", "run"]


def test_earlier_results_are_replaced_as_a_whole(tmp_path):
    out = tmp_path / "out"
    process_run(points_run(tmp_path / "long", frames=6), out)
    (out / "left-over.txt").write_text("from an older version")
    process_run(points_run(tmp_path / "short", frames=4), out)
    assert names(out) == sorted(FILES)
    assert len(rows_of(out / "attitude.csv")) == 4


def test_a_folder_with_other_content_is_not_deleted(tmp_path):
    folder = points_run(tmp_path / "run", frames=3)
    foreign = tmp_path / "photos"
    foreign.mkdir()
    (foreign / "summary.json").write_text('{"schema": "another program"}')
    with pytest.raises(InputError, match="something other than earlier results"):
        process_run(folder, foreign)
    assert names(foreign) == ["summary.json"]
    with pytest.raises(InputError, match="something other than earlier results"):
        process_run(folder, folder)  # the run folder itself
    assert (folder / "run.yaml").is_file()


@pytest.mark.parametrize("content", [None, "", "[]", "3", "{}", '{"schema": "beampose/run/1"}', "\xff"])
def test_a_folder_without_a_summary_of_this_program_has_no_results(tmp_path, content):
    if content is not None:
        (tmp_path / "summary.json").write_bytes(content.encode("latin-1"))
    assert not are_results(tmp_path)


def test_the_results_of_a_run_are_recognised(results):
    assert are_results(results)


@pytest.mark.parametrize("causal", [True, False])
def test_progress_counts_every_frame_of_every_pass(tmp_path, causal):
    calls = []
    process_run(
        points_run(tmp_path / "run", frames=7),
        tmp_path / "out",
        causal=causal,
        progress=lambda *what: calls.append(what),
    )
    tracked = [(done, 7, TRACKING) for done in range(1, 8)]
    assert [(done, total or 7, stage) for done, total, stage in calls[:7]] == tracked
    assert calls[7:] == ([] if causal else [(0, None, SMOOTHING), *((done, 7, WRITING) for done in range(1, 8))])


def test_a_batch_of_one_run_gives_the_tables_of_that_run(tmp_path):
    folder = points_run(tmp_path / "run", frames=4)
    process_run(folder, tmp_path / "one")
    process_batch([folder], tmp_path / "many")
    for name in HEADERS:
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "many/run" / name).read_bytes()


@pytest.fixture(scope="module")
def three_cameras(tmp_path_factory) -> Path:
    """Points of a rig whose third camera sees what the left one sees, with errors of its own."""
    run_folder = simulate("huo2015", tmp_path_factory.mktemp("three") / "run", seed=3, frames=60, points=True)
    for name, key in (("rig.yaml", "cameras"), ("run.yaml", "cameras")):
        content = yaml.safe_load((run_folder / name).read_text("utf-8"))
        content[key]["third"] = dict(content[key]["left"])
        (run_folder / name).write_text(yaml.safe_dump(content), "utf-8")
    points = pd.read_csv(run_folder / "detections.csv")
    third = points[points.camera == "left"].assign(camera="third")
    third["u_px"] += np.random.default_rng(3).normal(0, third["sigma_u_px"])
    pd.concat([points, third]).to_csv(run_folder / "detections.csv", index=False)
    return run_folder


@pytest.mark.parametrize(("seen", "text"), [("shifted", "third: in 30 frames (30 to 59)"), ("hidden", None)])
def test_a_camera_that_moves_so_far_that_its_spots_lose_their_labels_is_named(three_cameras, tmp_path, seen, text):
    """A knock during the recording. Where its spots are hidden, only false points remain, and it has not moved."""
    run_folder = shutil.copytree(three_cameras, tmp_path / "run")
    points = pd.read_csv(run_folder / "detections.csv")
    late = (points.camera == "third") & (points.frame >= 30)
    if seen == "shifted":
        points.loc[late, "v_px"] += 70.0
    else:
        points = points[~late]
    points.to_csv(run_folder / "detections.csv", index=False)
    outcome = process_run(run_folder, tmp_path / "out")
    assert outcome.result.measured == 60
    moved = [f.what for f in outcome.verdict.findings if f.code == "BP-V19"]
    assert [w for w in moved if text is None or text not in w] == []
    assert len(moved) == (text is not None)


@pytest.mark.parametrize("shift_px", [0.0, 2.0, 25.0])
def test_poses_after_a_knock_of_one_of_two_cameras_do_not_use_its_pictures(shift_px, tmp_path):
    """The other camera and the motion give them; they were beyond 10 sigmas, at CHECK or even PASS."""
    run_folder = simulate("smooth", tmp_path / "run", seed=4, frames=90, points=True)
    points = pd.read_csv(run_folder / "detections.csv")
    points.loc[(points.camera == "right") & (points.frame >= 45), ["u_px", "v_px"]] += np.array([1.0, -0.6]) * shift_px
    points.to_csv(run_folder / "detections.csv", index=False)
    outcome = process_run(run_folder, tmp_path / "out")
    named = [(f.level.name, f.what) for f in outcome.verdict.findings if f.code == "BP-V19"]
    if not shift_px:
        assert outcome.result.moved is None
        assert named == []
        return
    assert outcome.result.moved == MovedCamera(45, "right", left_out=True)
    assert [
        level for level, what in named if "before frame 45: its pictures from that frame on are not used" in what
    ] == ["WARN"]
    # The movement is the reason for frames without a pose: it comes first, and nobody has to look for lost pictures.
    assert outcome.verdict.findings[0].code == "BP-V19"
    assert not any("dropped" in f.remedy for f in outcome.verdict.findings)
    truth = json.loads((tmp_path / "out" / "summary.json").read_text("utf-8"))["errors"]["pose"]["measured"]
    assert truth["rows"] >= 45
    assert truth["beyond_10_sigmas"] == 0


@pytest.mark.parametrize("shown", [True, False])
def test_a_vehicle_that_turns_away_faster_than_ever_before_has_no_predicted_poses(shown, tmp_path):
    """Two frames show its spots far from the prediction, then none do: the sigmas of a calm motion do not hold."""
    run_folder = simulate("smooth", tmp_path / "run", seed=4, frames=90, points=True)
    points = pd.read_csv(run_folder / "detections.csv")
    for camera, axis in (("left", "u_px"), ("right", "v_px")):
        for turned, frame in enumerate((40, 41), start=1):
            points.loc[(points.camera == camera) & (points.frame == frame), axis] += 70.0 * turned**2
    points = points[~points.frame.between(42 if shown else 40, 60)]
    points.to_csv(run_folder / "detections.csv", index=False)
    process_run(run_folder, tmp_path / "out")
    status = pd.read_csv(tmp_path / "out" / "attitude.csv")["status"].to_numpy()
    assert set(status[40:61]) == {"lost" if shown else "predicted"}
    assert set(np.delete(status, slice(40, 61))) == {"measured"}


def test_a_spot_that_never_hits_its_screen_is_a_point_to_check(tmp_path):
    """`beampose check` names it; the run was a PASS."""
    run_folder = simulate("smooth", tmp_path / "run", seed=4, frames=40, points=True)
    assert process_run(run_folder, tmp_path / "before").verdict.status == "pass"
    rig = yaml.safe_load((run_folder / "rig.yaml").read_text("utf-8"))
    beam, of = next(iter(rig["target"]["beams"].values())), next(iter(rig["target"]["spots"].values()))
    rig["target"]["beams"]["away"] = {**beam, "direction": [-x for x in beam["direction"]]}
    rig["target"]["spots"]["beyond"] = {**of, "beam": "away"}
    (run_folder / "rig.yaml").write_text(yaml.safe_dump(rig), "utf-8")
    found = process_run(run_folder, tmp_path / "out").verdict.findings
    assert [(f.code, f.level.name) for f in found] == [("BP-V24", "WARN")]
    assert "spot beyond hits its screen in no frame" in found[0].what


def test_the_point_of_two_spots_that_have_merged_does_not_shift_the_poses(tmp_path):
    """A second laser beside the first one: the table has one point between both, and states the sigma of a spot."""
    run_folder = simulate("huo2015", tmp_path / "run", seed=6, frames=60, points=True)
    rig = yaml.safe_load((run_folder / "rig.yaml").read_text("utf-8"))
    name, beam = next(iter(rig["target"]["beams"].items()))
    direction = np.add(beam["direction"], [0.0, 0.0, 0.0015])
    rig["target"]["beams"]["beside"] = {**beam, "direction": (direction / np.linalg.norm(direction)).tolist()}
    spot, of = next((s, of) for s, of in rig["target"]["spots"].items() if of["beam"] == name)
    rig["target"]["spots"]["beside"] = {**of, "beam": "beside"}
    (run_folder / "rig.yaml").write_text(yaml.safe_dump(rig), "utf-8")
    model = SpotModel.of(load_run(run_folder).rig)
    truth = read_true_poses(run_folder / "truth" / "pose.csv")
    uv, _ = model.project(Pose(matrix_from_quaternion(truth.quaternion_wxyz), truth.position_m))
    camera = next(c for c, s in model.views if s == spot)
    one, two = uv[:, model.views.index((camera, spot))], uv[:, model.views.index((camera, "beside"))]
    points = pd.read_csv(run_folder / "detections.csv")
    of_camera = points[points.camera == camera]
    off = np.linalg.norm(of_camera[["u_px", "v_px"]].to_numpy() - one[of_camera.frame], axis=1)
    merged = of_camera.index[off < 1.5]
    frames = points.loc[merged, "frame"]
    points.loc[merged, ["u_px", "v_px"]] += (two - one)[frames] / 2
    points.to_csv(run_folder / "detections.csv", index=False)
    assert len(merged) > 40
    assert np.median(np.linalg.norm(two - one, axis=1)) == pytest.approx(1.5, abs=1.2)
    outcome = process_run(run_folder, tmp_path / "out")
    assert outcome.result.measured > 50
    measured = json.loads((tmp_path / "out" / "summary.json").read_text("utf-8"))["errors"]["pose"]["measured"]
    print(measured)
    assert measured["nees_mean"] < 9  # of 6


def test_a_camera_whose_screen_gets_no_spot_is_used_without_a_warning(three_cameras, tmp_path, recwarn):
    """Its points are false ones; their density divided by no area at all (once `divide by zero` in log_density)."""
    run_folder = shutil.copytree(three_cameras, tmp_path / "run")
    content = yaml.safe_load((run_folder / "rig.yaml").read_text("utf-8"))
    content["screens"]["floor"] = content["screens"]["left"]
    content["cameras"]["third"] = content["cameras"]["third"] | {"screen": "floor"}
    (run_folder / "rig.yaml").write_text(yaml.safe_dump(content), "utf-8")
    assert process_run(run_folder, tmp_path / "out").result.measured == 60
    assert not recwarn.list
