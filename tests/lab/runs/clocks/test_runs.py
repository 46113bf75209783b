"""A run whose cameras have clocks of their own: late pictures, rolling shutters, other frame rates."""

from __future__ import annotations

import csv
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bench.clocks.__main__ import Figures, figures
from bench.clocks.recording import Recording, random_recording, write_recording
from bench.random_scenes.write_folder import write_run_folder
from bench.refine import campaign
from geometry.arrays import Array
from geometry.pose import Pose
from lab.files.run.results import read_poses
from lab.runs.process import process_run
from lab.simulate.write import simulate
from tests.lab.tables import rows_of
from tests.marks import further_slow
from tracking.smoothing.motion.clocks import DETERMINED
from tracking.smoothing.motion.interpolation import Interpolation
from tracking.smoothing.smoother import _Smoother

pytestmark = pytest.mark.usefixtures("no_search")

FRAMES, SEED = 40, 3


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("clocks") / "run"
    return simulate("clocks", folder, seed=SEED, frames=FRAMES, points=True)


@pytest.fixture(scope="module")
def results(recording, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("results") / "out"
    process_run(recording, out)
    return out


def attitude_rms_deg(folder: Path) -> float:
    errors = json.loads((folder / "summary.json").read_text())["errors"]
    return float(errors["pose"]["measured"]["rotation_deg"]["rms"])


def test_the_attitude_is_as_accurate_as_with_one_clock(results, tmp_path):
    simulate("smooth", tmp_path / "run", seed=SEED, frames=FRAMES, points=True)
    process_run(tmp_path / "run", tmp_path / "out")
    assert attitude_rms_deg(results) < 1.3 * attitude_rms_deg(tmp_path / "out")


def test_every_row_is_measured_and_the_verdict_passes(results):
    content = json.loads((results / "summary.json").read_text())
    assert content["verdict"]["status"] == "pass"
    assert content["errors"]["spots"]["in_view_identity"] == 1.0
    assert len(read_poses(results).frames) == FRAMES
    assert content["parameters"]["clocks"]["right"]["time_offset_s"] == pytest.approx(0.013)


def test_the_report_has_no_residuals_of_pictures_at_other_instants_than_the_poses(results):
    """The motion in between would pass for a residual of pixels, a hundred times as large as expected."""
    page = (results / "report.html").read_text()
    assert "Residuals by camera" not in page
    assert "cameras with clocks of their own" in page


def test_without_the_clocks_the_same_recording_fails(recording, tmp_path):
    shutil.copytree(recording, tmp_path / "run")
    text = (recording / "run.yaml").read_text()
    for field in (", row_time_s: 8.0e-06", ", time_offset_s: 0.013000000000000001, row_time_s: 5.0e-06"):
        assert field in text
        text = text.replace(field, "")
    (tmp_path / "run" / "run.yaml").write_text(text)
    assert process_run(tmp_path / "run", tmp_path / "out").verdict.status != "pass"


def test_detections_have_the_pictures_own_numbers_and_instants(results):
    rows = rows_of(results / "detections.csv")
    assert list(rows[0])[-1] == "t_s"
    late = {int(r["frame"]): float(r["t_s"]) for r in rows if r["camera"] == "right"}
    assert sorted(late) == list(range(FRAMES))
    np.testing.assert_allclose([late[k] - k / 100 for k in range(FRAMES)], 0.013, atol=1e-9)


def test_a_camera_of_another_rate_needs_only_its_times(recording, tmp_path):
    """The right camera has lost two of three pictures; the numbers of those left are its own."""
    shutil.copytree(recording, tmp_path / "run")
    folder = tmp_path / "run"
    with (recording / "detections.csv").open(newline="") as file:
        rows = list(csv.reader(file))
    kept = [r for r in rows[1:] if r[1] == "left" or int(r[0]) % 3 == 0]
    own = [[str(int(r[0]) // 3), *r[1:]] if r[1] == "right" else r for r in kept]
    (folder / "detections.csv").write_text("\n".join(",".join(r) for r in [rows[0], *own]) + "\n")
    stamps = "\n".join(f"{k},{3 * k / 100:.9f}" for k in range((FRAMES + 2) // 3))
    (folder / "times.csv").write_text(f"frame,t_s\n{stamps}\n")
    text = (folder / "run.yaml").read_text()
    (folder / "run.yaml").write_text(text.replace("time_offset_s", "timestamps: times.csv, time_offset_s"))
    process_run(folder, tmp_path / "out")
    poses = read_poses(tmp_path / "out")
    assert len(poses.frames) == FRAMES
    assert attitude_rms_deg(tmp_path / "out") < 0.1


@pytest.mark.parametrize("scatter_s", further_slow([2e-4, 0.0]))
def test_the_errors_of_stamps_are_in_the_poses(scatter_s, tmp_path):
    """Fast motion at 413 Hz: one stamp off by half a step, or all by a twelfth: 4 and .7 px, of spots to .15 px."""
    r = random_recording(41061, frames=60)
    write_recording(r, tmp_path / "run")
    rng = np.random.default_rng(5)
    for table in sorted((tmp_path / "run").glob("times-*.csv")):
        rows = list(csv.reader(table.open()))
        for row in rows[1:]:
            row[1] = f"{float(row[1]) + rng.normal(0, scatter_s):.12g}"
        if not scatter_s and table.stem == "times-1":
            rows[41][1] = f"{float(rows[41][1]) + 0.5 / r.rate_hz:.12g}"
        with table.open("w", newline="") as file:
            csv.writer(file).writerows(rows)
    process_run(tmp_path / "run", tmp_path / "out")
    poses = read_poses(tmp_path / "out")
    known = ~poses.has("lost")
    delta = r.pose_at(r.rows_s)[poses.frames].minus(poses.world_from_body)[known]
    nees = np.sum(delta * np.linalg.solve(poses.covariance[known], delta[..., None])[..., 0], axis=1) / 6
    assert poses.has("measured").sum() > 35
    assert nees.mean() < 1.5
    assert nees.max() < 6
    notes = json.loads((tmp_path / "out" / "summary.json").read_text())["notes"]
    assert any(("scatter by 0.2" if scatter_s else "t_s of frame 40 is") in note for note in notes)


def test_four_spots_seen_by_free_running_cameras_are_found(tmp_path):
    """If the first search allowed for the fastest motion alone, no pose could be distinguished from false points."""
    write_recording(random_recording(1006, frames=12), tmp_path / "run")
    process_run(tmp_path / "run", tmp_path / "out")
    assert read_poses(tmp_path / "out").has("measured").sum() >= 8


@pytest.mark.slow
def test_smooth_motion_is_averaged_over_as_many_frames_as_with_one_clock(tmp_path):
    """Sines of 0.6 Hz at 205 Hz, with nothing hidden: between the spots they are much smoother than white jerk."""
    r = random_recording(52009, frames=300)
    own, one = figures(r, tmp_path / "own"), figures(r.with_one_clock(), tmp_path / "one")
    rms, rms_one = (np.sqrt(np.nanmean(f.attitude_deg[3:-3] ** 2)) for f in (own, one))
    assert rms < 1.1 * rms_one
    assert np.nanmean(own.nees) > 0.7


def test_cameras_whose_own_spots_leave_the_pose_open_do_not_end_the_averaging(tmp_path, monkeypatch):
    """Each instant has three spots of one camera: whether it counted as one of few spots was a matter of rounding."""
    inside = list[float]()
    monkeypatch.setattr(
        Interpolation, "best_offset", lambda i, f=Interpolation.best_offset: inside.append(i.interior.mean()) or f(i)
    )
    lab, (scene,), _ = campaign(9975, frames=120, recordings=1, clocks_s=2e-3)
    write_run_folder(replace(scene, known_rig=lab.rig), tmp_path / "run")
    process_run(tmp_path / "run", tmp_path / "out")
    assert inside
    assert min(inside) > 0.7


def test_a_gap_in_smooth_motion_does_not_make_the_frames_beside_it_vague(recording, tmp_path):
    """In a gap the velocities may jump unseen; here the frames around it exclude that."""
    shutil.copytree(recording, tmp_path / "run")
    path = tmp_path / "run" / "detections.csv"
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join(line for line in lines if line.split(",")[0] not in ("20", "21")))
    process_run(tmp_path / "run", tmp_path / "out")
    poses = read_poses(tmp_path / "out")
    sigma = np.linalg.norm(poses.sigma_ypr_deg, axis=1)
    assert np.max(sigma[17:25]) < 4 * np.median(sigma)


@pytest.mark.slow
def test_a_swing_that_begins_after_rest_leaves_no_frame_vague(tmp_path):
    """Its first accelerations appear as velocity jumps, far smaller than those that the fastest motion would allow."""
    write_recording(random_recording(3406, frames=60), tmp_path / "run")
    process_run(tmp_path / "run", tmp_path / "out")
    poses = read_poses(tmp_path / "out")
    sigma = np.linalg.norm(poses.sigma_ypr_deg, axis=1)[3:-3]
    assert np.max(sigma) < 20 * np.median(sigma)


@pytest.mark.parametrize("seed", further_slow([4000, 4033]))
def test_beside_corners_the_attitude_is_as_accurate_as_with_one_clock(seed, tmp_path):
    """The pictures around a corner are before or after it: each belongs to the motion on its side."""
    r = random_recording(seed, frames=80)
    own, one = figures(r, tmp_path / "own"), figures(r.with_one_clock(), tmp_path / "one")
    both = np.isfinite(own.attitude_deg) & np.isfinite(one.attitude_deg)
    both[:3] = both[-3:] = False
    assert np.count_nonzero((r.corners > 3) & (r.corners < 77)) >= 3
    assert both.sum() >= 70
    assert np.mean(own.attitude_deg[both] ** 2) < 1.5**2 * np.mean(one.attitude_deg[both] ** 2)
    assert np.nanmean(own.nees) < 1.5


def test_a_corner_at_the_instant_of_a_frame_keeps_its_moment_when_the_spots_beside_it_count(tmp_path):
    """The spots beside it contradict any moment that is farther off than a part of a step."""
    r = random_recording(8204, frames=80)
    assert r.corners[0] == pytest.approx(7.0, abs=1e-9)
    beside = figures(r, tmp_path).attitude_deg
    assert np.nanmax(beside[6:10]) < 5 * np.nanmedian(beside)
    assert np.isfinite(beside[6:10]).all()


def rounded(r: Recording, frames: float) -> Recording:
    """The recording of a motion whose corners take some frames: the mean over as many."""

    def pose_at(t_s: Array) -> Pose:
        here, around_s = r.pose_at(t_s), np.linspace(-0.5, 0.5, 9) * frames / r.rate_hz
        return here.plus(np.mean([r.pose_at(t_s + s).minus(here) for s in around_s], axis=0))

    return replace(r, pose_at=pose_at)


@pytest.mark.slow
@pytest.mark.parametrize(("turn", "frames"), [(1.0, 40), (3.0, 80)])
def test_turns_that_take_some_frames_are_not_taken_for_corners(turn, frames, tmp_path):
    own = figures(rounded(random_recording(4000, frames=frames), turn), tmp_path)
    assert np.nanmean(own.nees) < 1.5
    assert np.nanmax(own.nees) < 8


def compared(r: Recording, folder: Path) -> tuple[Figures, Figures, Array]:
    """The recording with its clocks and with one, and the frames (T,) that have measured poses in both."""
    own, one = figures(r, folder / "own"), figures(r.with_one_clock(), folder / "one")
    both = np.isfinite(own.attitude_deg) & np.isfinite(one.attitude_deg)
    both[:3] = both[-3:] = False
    return own, one, both


def rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


@pytest.mark.slow
def test_slow_cameras_lose_no_poses_where_nothing_jumps(tmp_path, monkeypatch):
    """One camera of full rate and two of 30 Hz: jumps could hide in every step, and there are some in a few steps.

    Residuals of spots that were moved to their frames by a motion that is known worse are not those of the spots.
    """
    smoothers = list[_Smoother]()
    monkeypatch.setattr(_Smoother, "result", lambda s, *a, f=_Smoother.result: smoothers.append(s) or f(s, *a))
    own, one, both = compared(random_recording(6007, frames=100), tmp_path)
    moved, seen = (np.sqrt(np.trace(d.cov, axis1=1, axis2=2)) for d in (smoothers[0].detections, smoothers[0].seen))
    assert np.median(moved / seen) < 1.5  # a jump that is excluded does not make the way to the frames uncertain
    measured = np.isfinite(one.attitude_deg).sum()
    assert measured > 40
    assert np.isfinite(own.attitude_deg).sum() > 0.85 * measured
    assert np.median(own.attitude_deg[both]) < 1.3 * np.median(one.attitude_deg[both])
    assert np.nanmean(own.nees) < 1.5


@pytest.mark.slow
def test_a_turn_that_takes_about_a_frame_is_as_long_as_it_is(tmp_path):
    """A turntable: one jump explains neither the rest before it and after it nor the spots in between."""
    r = random_recording(6005, frames=80)
    steps = np.diff(r.corners)[::2]
    assert np.allclose(steps, steps[0])
    assert 1.0 < steps[0] < 1.5
    own, one, both = compared(r, tmp_path)
    # Rows during a turn have fewer spots than those of one clock, since each camera sees another part of it.
    assert rms(own.attitude_deg[both]) < 3.0 * rms(one.attitude_deg[both])
    resting = both & (np.abs(np.arange(80)[:, None] - 0.5 * (r.corners[:-1:2] + r.corners[1::2])).min(axis=1) > 0.8)
    assert rms(own.attitude_deg[resting]) < 1.3 * rms(one.attitude_deg[resting])
    assert np.nanmean(own.nees) < 1.5


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "frames"), [(6003, 200), (6002, 200)])
def test_a_swing_after_a_long_rest_is_no_succession_of_jumps(seed, frames, tmp_path):
    r = random_recording(seed, frames=frames)
    assert len(r.corners) == 1
    own, one, both = compared(r, tmp_path)
    swings = both & (np.arange(frames) > r.corners[0] + 3)
    assert swings.sum() > 15
    assert rms(own.attitude_deg[swings]) < 1.3 * rms(one.attitude_deg[swings])
    assert np.nanmean(own.nees) < 1.6


@pytest.mark.slow
@pytest.mark.parametrize("gap", [slice(12, 26), slice(8, 22)])
def test_a_turn_in_a_gap_in_which_nothing_is_seen_is_covered(gap, tmp_path):
    """That it is in one half of the gap does not exclude it from the other."""
    r = random_recording(6005, frames=60)
    assert gap.start < r.corners[0] < r.corners[1] < gap.stop
    hidden = r.hidden.copy()
    hidden[gap] = True
    own = figures(replace(r, hidden=hidden), tmp_path)
    assert np.isfinite(own.attitude_deg[gap]).sum() <= 2
    assert np.nanmax(own.nees) < 8


@pytest.mark.slow
@pytest.mark.parametrize("seed", [6012, 6043])
def test_a_turn_that_the_spots_allow_to_be_short_is_in_the_sigmas(seed, tmp_path):
    """A turn that lasts for as long as they allow, or a jerk in its place, rounds the corners of a turntable."""
    own = figures(random_recording(seed, frames=60), tmp_path)
    assert np.isfinite(own.nees).sum() > 40
    assert np.nanmean(own.nees) < 1.5
    assert np.nanmax(own.nees) < 7


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "frames"),
    [
        pytest.param(6000, 300, id="gaps with spots of one camera, of which one has two corners"),
        pytest.param(6007, 300, id="smooth turns of two frames, which resemble two corners"),
        pytest.param(6015, 300, id="corners side by side that a stronger jerk would explain"),
        pytest.param(6015, 200, id="the same with more noise: corners much smaller than the fastest motion"),
        pytest.param(9304, 220, id="slow corners, which few frames do not show"),
        pytest.param(7111, 120, id="a corner before the first frame that has a pose"),
        pytest.param(21001, 300, id="a slow corner in a gap beside fast motion"),
        pytest.param(7321, 120, id="smooth turns of eight frames about one axis, which resemble six corners"),
        pytest.param(7331, 120, id="a swing that begins in a gap, with a slow camera"),
        pytest.param(22008, 120, id="false points about hidden spots, which make two frames in succession a pose"),
        pytest.param(31005, 300, id="smooth turns of seven frames and four spots, which five corners explain better"),
    ],
)
def test_no_pose_beside_a_turn_is_wrong_by_more_than_it_states(seed, frames, tmp_path):
    own = figures(random_recording(seed, frames=frames), tmp_path)
    assert np.isfinite(own.nees).sum() > 0.25 * frames
    assert np.nanmean(own.nees) < 1.5
    assert np.nanmax(own.nees) < 8


def test_labels_are_compared_with_the_picture_that_a_run_with_unknown_clocks_has_used(tmp_path):
    """Offsets of half a frame to 1.3: the pictures beside would have other spots at these places."""
    own = figures(random_recording(7318, frames=20), tmp_path, estimate=True)
    assert own.wrong == 0
    assert own.found > 0.9
    assert own.wrong_poses == 0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "frames", "known"),
    [
        pytest.param(7103, 60, 0, id="a turntable that turns four times: the steps of the clocks do not end"),
        pytest.param(7111, 120, 0, id="a strong jerk in gaps, and spots of one camera: a motion that is not finite"),
        pytest.param(7141, 120, 0, id="an offset that stays open by a frame, of swings that last for twelve"),
        pytest.param(7127, 120, 1, id="a turntable, whose turns alone show the clock"),
        pytest.param(7303, 120, 0, id="a turntable, whose turns follow the clock for many steps"),
        pytest.param(7327, 120, 0, id="two turns of clocks that stay at their priors, which a jerk would explain too"),
    ],
)
def test_clocks_are_estimated_with_turns_that_depend_on_them(seed, frames, known, tmp_path):
    own = figures(random_recording(seed, frames=frames), tmp_path, estimate=True)
    assert own.wrong_poses == 0
    found = [(error, sigma) for error, sigma, prior in own.clocks if sigma < DETERMINED * prior]
    assert len(found) >= known
    assert all(abs(error) < 3 * sigma for error, sigma in found)


@pytest.mark.slow
def test_the_errors_of_clocks_that_corners_show_agree_with_their_sigmas(tmp_path):
    """Corners that may be anywhere within the prior of an offset rounded the motion: .04 frames off, 2.4 sigmas."""
    recording = random_recording(7532, frames=120)
    own = figures(recording, tmp_path, estimate=True)
    offsets = np.array([(error, sigma) for error, sigma, prior in own.clocks if prior > 1e-3])
    assert len(offsets) == 3
    assert (np.abs(offsets[:, 0]) < 2 * offsets[:, 1]).all()
    assert (offsets[:, 1] * recording.rate_hz < 0.013).all()
