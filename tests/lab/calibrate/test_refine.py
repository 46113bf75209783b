"""`beampose refine`: recordings correct a rig that is off by its stated sigmas, and nothing else."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml

from bench import refine as bench
from bench.random_scenes.write_folder import write_run_folder
from calibration.least_squares.adjustment import AdjustmentError
from calibration.rig.refinement import MOTIONS, further_motions
from calibration.terms.rig_blocks import prior_of, stacks_of
from geometry.rig import Rig
from geometry.uncertainty.chi_square import chi2_limit
from geometry.uncertainty.rig_uncertainty import covariance_root, perturbed_rig
from lab.calibrate.refine import refine as refinement
from lab.calibrate.refine.recordings import labelled, stated_covariance, tolerant, with_rig
from lab.calibrate.refine.refine import refine_findings, refine_rig
from lab.errors import CalibrationError
from lab.files.rig.rig_file import RigFile, covariance_blocks, joint_covariance, load_rig_file, save_rig
from lab.files.run.run_file import load_run
from lab.findings.finding import Level
from lab.simulate.write import simulate
from tests.lab.command import typed
from tests.lab.tables import rows_of
from tests.marks import further_slow
from tracking.setup_mistakes import evidence

SIGMAS = {
    "cameras.position_m": 0.003, "cameras.rotation_deg": 0.1, "screens.position_m": 0.002, "screens.rotation_deg": 0.05,
    "beams.point_m": 0.001, "beams.direction_deg": 0.05,
}  # fmt: skip
FRAMES = 60


def recordings(
    folder: Path, scenario: str = "two-cameras-per-screen", count: int = 2, frames: int = FRAMES
) -> list[Path]:
    return [
        simulate(scenario, folder / f"run{i}", seed=i, frames=frames, points=True, clutter=0.0) for i in range(count)
    ]


def write_known(true: Rig, path: Path, seed: int = 0) -> None:
    """A rig.yaml that is off by a draw of its covariance."""
    covariance = stated_covariance(true, None, SIGMAS, path)
    root = covariance_root(covariance.matrix)
    off = root @ np.random.default_rng(seed).normal(size=root.shape[1])
    known = perturbed_rig(true, list(covariance.names), off)
    covariance = stated_covariance(known, None, SIGMAS, path)
    save_rig(RigFile(known, covariance_blocks(covariance)), path)


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    """Two runs, the true rig, a rig.yaml that is off, and the folder and outcome of its refinement."""
    folder = tmp_path_factory.mktemp("refine")
    runs = recordings(folder)
    true = load_rig_file(runs[0] / "rig.yaml").rig
    write_known(true, folder / "rig.yaml")
    return folder, runs, true, refine_rig(runs, folder / "rig.yaml", folder / "new")


@pytest.fixture(scope="module")
def short(tmp_path_factory) -> Path:
    """The first half of the first run: what a mistake leaves of it shows in few frames."""
    return recordings(tmp_path_factory.mktemp("short"), count=1, frames=FRAMES // 2)[0]


def test_a_rig_that_is_off_by_its_sigmas_is_corrected_as_its_covariance_says(lab):
    folder, _, true, outcome = lab
    assert outcome.level is Level.PASS, outcome.line()
    given, new = load_rig_file(folder / "rig.yaml"), load_rig_file(folder / "new" / "rig.yaml")
    covariance = joint_covariance(new.rig, new.covariances, "new")
    spread = np.trace(covariance.matrix) / np.trace(joint_covariance(given.rig, given.covariances, "old").matrix)
    assert spread < 0.9
    error = error_of(new.rig, true)
    named = [list(covariance.names).index(n) for n in error]
    root = covariance_root(covariance.matrix[np.ix_(named, named)])
    white = np.linalg.lstsq(root, np.array(list(error.values())), rcond=1e-9)[0]
    assert chi2_limit(0.999, len(white)) < np.sum(white**2) < chi2_limit(0.001, len(white))


def error_of(rig: Rig, true: Rig) -> dict[str, float]:
    """The errors of the poses of cameras and screens, by the names of rig.yaml."""
    out = {}
    for kind in ("cameras", "screens"):
        e = stacks_of(true)[kind].minus(stacks_of(rig)[kind])
        for i, name in enumerate(getattr(rig, kind)):
            axes = ("x_m", "y_m", "z_m", "rot_x_rad", "rot_y_rad", "rot_z_rad")
            out |= {f"{kind}.{name}.{axis}": float(v) for axis, v in zip(axes, e[i], strict=True)}
    return out


def test_the_new_rig_names_its_parent_and_recordings_with_their_checksums(lab):
    folder, runs, _, _ = lab
    made_from = load_rig_file(folder / "new" / "rig.yaml").calibration.made_from
    for path in (folder / "rig.yaml", runs[0] / "run.yaml", runs[1] / "detections.csv"):
        assert [line for line in made_from if line.startswith(f"{path} sha256 ")] != []


def test_the_table_of_residuals_shows_the_noise_that_is_left(lab):
    folder, _, _, _ = lab
    rows = rows_of(folder / "new" / "residuals.csv")
    given, refined = (
        np.array([[float(r[f"d{axis}_{name}_px"]) for axis in "uv"] for r in rows]) for name in ("given", "refined")
    )
    assert len(rows) > 8 * FRAMES
    assert np.std(refined) < 0.1 < np.std(given) / 2  # of 0.1 px, less what the poses absorb


def test_the_report_has_the_change_of_each_number_and_held_out(lab):
    text = (lab[0] / "new" / "report.html").read_text()
    for words in ("Change of each number", "What the recordings determine", "Held-out recordings", "Correlations"):
        assert f"{words}</h2>" in text
    assert "cameras.left-a.x_m" in text
    assert "motion that would help" in text
    assert "Arrows are the changes" in text


def test_a_further_motion_determines_more_but_no_convention(lab):
    result = lab[3].result
    r = result.refined
    motions = further_motions(r, prior_of(r.given, result.prior)[1])
    assert set(motions) == set(MOTIONS)
    inverse = np.linalg.pinv(r.directions)
    before = np.sqrt(np.diagonal(inverse @ r.after.covariance @ inverse.T))
    conventions = np.argsort(r.gain)[: r.conventions]
    for _, after in motions.values():
        assert np.all(after < before + 1e-6)
        assert np.all(after[conventions] > 0.99)
        assert np.min(after / before) < 0.75  # as many frames again


@pytest.fixture(scope="module")
def cameras_alone(lab, tmp_path_factory):
    """The folder and outcome of one recording that refines the cameras' poses only."""
    folder, runs, _, _ = lab
    out = tmp_path_factory.mktemp("cameras") / "new"
    return out, refine_rig(runs[:1], folder / "rig.yaml", out, free=["cameras"])


def test_one_recording_is_held_out_by_blocks_of_time(cameras_alone):
    out, outcome = cameras_alone
    assert len(outcome.result.refined.held_out) == 2  # of at least 30 frames each
    assert (out / "rig.yaml").exists() == (outcome.level < 2)


def test_only_the_named_groups_change_and_the_others_stay_uncertain(lab, cameras_alone):
    r, given = cameras_alone[1].result.refined, load_rig_file(lab[0] / "rig.yaml")
    assert stacks_of(r.rig)["screens"].minus(stacks_of(given.rig)["screens"]).any().item() is False
    assert stacks_of(r.rig)["cameras"].minus(stacks_of(given.rig)["cameras"]).all()
    old = joint_covariance(given.rig, given.covariances, "old")
    for name in ("screens.left.x_m", "screens.right.rot_z_rad"):
        sigmas = [np.sqrt(c.matrix[c.names.index(name), c.names.index(name)]) for c in (old, r.covariance)]
        assert sigmas[1] == pytest.approx(sigmas[0], rel=1e-6)


@pytest.mark.parametrize(
    ("part", "change"),
    further_slow(
        [
            ("screens.right", {"z_m": 0.006, "rot_y_rad": 0.002}),  # 3 sigmas: errors of all parts explain it as well
            ("cameras.left-b", {"rot_x_rad": 0.01, "rot_y_rad": -0.01}),
            ("screens.right", {"z_m": 0.03, "rot_x_rad": 0.01}),
        ]
    ),
)
def test_a_part_that_moved_by_more_than_stated_is_named_and_an_earlier_rig_stays(lab, short, tmp_path, part, change):
    folder, _, true, _ = lab
    out = tmp_path / "new"
    out.mkdir()
    for name in ("rig.yaml", "residuals.csv"):
        (out / name).write_bytes((folder / "new" / name).read_bytes())
    moved = perturbed_rig(true, [f"{part}.{name}" for name in change], np.array(list(change.values())))
    save_rig(RigFile(moved, covariance_blocks(stated_covariance(moved, None, SIGMAS, out))), tmp_path / "rig.yaml")
    done = typed("refine", short, "--rig", tmp_path / "rig.yaml", "--out", out)
    kind, name = part.split(".")
    assert (done.exit_code, f"{kind.removesuffix('s')} `{name}` has moved by" in done.output) == (3, True), done.output
    assert (out / "rig.yaml").read_bytes() == (folder / "new" / "rig.yaml").read_bytes()
    assert (tmp_path / "new-failed" / "report.html").exists()
    assert not (tmp_path / "new-failed" / "rig.yaml").exists()


@pytest.mark.slow
def test_a_camera_without_a_spot_where_it_may_be_is_named_after_one_search_for_mistakes(
    lab, short, tmp_path, monkeypatch
):
    _, _, true, _ = lab
    searches, every = [], evidence.possible_mistakes
    monkeypatch.setattr(evidence, "possible_mistakes", lambda *a: searches.append(a) or every(*a))
    moved = perturbed_rig(true, ["cameras.left-b.rot_x_rad", "cameras.left-b.rot_y_rad"], np.array([0.05, -0.05]))
    save_rig(RigFile(moved, covariance_blocks(stated_covariance(moved, None, SIGMAS, tmp_path))), tmp_path / "rig.yaml")
    with pytest.raises(CalibrationError, match="camera `left-b`: none of its 90 points in 30 pictures is the spot"):
        refine_rig([short], tmp_path / "rig.yaml", tmp_path / "new")
    assert len(searches) == 1


@pytest.mark.slow
def test_a_camera_whose_points_may_be_its_spots_is_left_out_and_the_recording_used(tmp_path):
    seed, sigmas = 821, bench.Sigmas()  # the camera `third` sees one spot, whose place is uncertain by 100 px
    drawn, scenes, _ = bench.campaign(seed, 75, clocks_s=sigmas.clocks)
    known = bench.drawn_rig(np.random.default_rng([seed, bench.RIG]), drawn.rig, sigmas)
    write_run_folder(replace(scenes[1], known_rig=known, covariance=bench.rig_covariance(known, sigmas)), tmp_path)
    found = labelled(load_run(tmp_path))
    third = [camera == "third" for camera, _ in known.views()]
    assert (found.unlabelled, found.recording.seen[:, third].any()) == (("third",), False)
    assert np.isfinite(found.recording.poses.translation[:, 0]).sum() > 10


def test_after_a_recording_with_too_few_labels_the_tracker_expects_larger_residuals_in_the_next(
    lab, tmp_path, monkeypatch
):
    folder, runs, _, _ = lab
    expected = []

    def few_labels(run, *_, **__):
        expected.append((run.folder, run.tracker.sigma_model_px))
        return SimpleNamespace(searched=True, in_views_of=lambda _: None)

    def too_few(*_, **__):
        raise AdjustmentError("no recording has 10 frames")

    monkeypatch.setattr(refinement, "labelled", few_labels)
    monkeypatch.setattr(refinement, "refine", too_few)
    with pytest.raises(CalibrationError, match="cannot be refined by these recordings: no recording has 10 frames"):
        refine_rig(runs, folder / "rig.yaml", tmp_path / "new")
    known = load_rig_file(folder / "rig.yaml")
    prior = joint_covariance(known.rig, known.covariances, folder / "rig.yaml")
    usual = [tolerant(with_rig(load_run(run), known.rig, prior)).tracker.sigma_model_px for run in runs]
    times = [px / usual[runs.index(run)] for run, px in expected]
    np.testing.assert_allclose(times, [1, 3, 1, 3], rtol=1e-9)


def test_a_recording_of_which_no_frame_has_a_pose_contradicts_the_rig(lab):
    result = lab[3].result
    first = result.runs[0].recording
    poses = replace(first.poses, translation=np.full_like(first.poses.translation, np.nan))
    lost = replace(result.runs[0], recording=replace(first, poses=poses))
    found = refine_findings(replace(result, runs=(lost, *result.runs[1:])))
    assert [(f.level, f.what) for f in found if f.code == "BP-F07"] == [
        (Level.FAIL, "two-cameras-per-screen-0: 0 of 60 frames have a measured pose")
    ]


def test_a_wrong_focal_length_of_which_nothing_is_stated_is_named_and_not_absorbed(lab, tmp_path):
    _, runs, true, _ = lab
    camera = true.cameras["left-b"]
    longer = replace(camera, matrix=camera.matrix * np.array([[1.02, 1.0, 1.0], [1.0, 1.02, 1.0], [1.0, 1.0, 1.0]]))
    write_known(replace(true, cameras={**true.cameras, "left-b": longer}), tmp_path / "rig.yaml")
    done = typed("refine", runs[0], "--rig", tmp_path / "rig.yaml", "--out", tmp_path / "new")
    assert (done.exit_code, "the focal length of camera `left-b` is wrong by −" in done.output) == (3, True), (
        done.output
    )
    assert not (tmp_path / "new" / "rig.yaml").exists()


def test_recordings_whose_spots_are_all_outliers_or_needed_by_their_poses_are_refused():
    seed, sigmas = 6505, bench.Sigmas(clocks=0.0)
    drawn, scenes, _ = bench.campaign(seed, 100, case=bench.MIRRORED)
    rng = np.random.default_rng([seed, bench.RIG])
    known, scenes = bench.changed(bench.MIRRORED, bench.drawn_rig(rng, drawn.rig, sigmas), scenes, rng)
    with pytest.raises(AdjustmentError, match="so many spots are outliers"):
        bench.refined_with_true_labels(known, bench.rig_covariance(known, sigmas), scenes[:3])


def test_a_vehicle_at_rest_gives_no_confident_rig(lab, tmp_path):
    runs = recordings(tmp_path, "static", count=1)
    true = load_rig_file(runs[0] / "rig.yaml").rig
    write_known(true, tmp_path / "rig.yaml")
    outcome = refine_rig(runs, tmp_path / "rig.yaml", tmp_path / "new")
    r = outcome.result.refined
    error = np.concatenate(
        [stacks_of(true)[s].pick(np.array([i])).minus(r.values[s].pick(np.array([i])))[0] for s, i in r.at]
    )
    white = np.linalg.lstsq(r.after.root, error, rcond=1e-9)[0]
    assert outcome.level == 2 or np.sum(white**2) < chi2_limit(0.001, len(white))
    assert np.sum(r.gain > 1) < np.sum(lab[3].result.refined.gain > 1)
    unchecked = [f for f in outcome.findings if f.what.startswith("nothing is stated of the focal lengths")]
    assert [(f.level, "cameras.left, cameras.right" in f.what) for f in unchecked] == [(Level.WARN, True)]
    assert not any("focal lengths" in f.what for f in lab[3].findings)  # motion checks them


@pytest.mark.slow
def test_exchanged_cameras_are_refused_and_nothing_is_written(lab, short, tmp_path, try_only):
    """Of the mistakes that are tried only these: that others explain it less is tested with the search itself."""
    _, _, true, _ = lab
    try_only("^exchanged", always=True)
    a, b = "left-a", "right-a"  # with the others in place, no pose of the symmetric rig explains them
    swapped = {
        x: replace(true.cameras[x], camera_from_world=true.cameras[y].camera_from_world, screen=true.cameras[y].screen)
        for x, y in ((a, b), (b, a))
    }
    write_known(replace(true, cameras={**true.cameras, **swapped}), tmp_path / "rig.yaml")
    done = typed("refine", short, "--rig", tmp_path / "rig.yaml", "--out", tmp_path / "new")
    assert done.exit_code == 3, done.output
    assert not (tmp_path / "new" / "rig.yaml").exists()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--free", "camera"], "expected some of cameras,screens,beams,lens,clocks,shutter, got 'camera'"),
        (["--free", "clocks"], "--free clocks: expected its covariance"),
        (["--sigma", "cameras.time_offset=1"], "did you mean 'cameras.time_offset_s'?"),
        (["--free", "lens"], "nothing is refined of which nothing is stated"),
        (["--sigma", "cameras.left-a.position=1"], "expected one of cameras.position_m"),
        (["--sigma", "cameras.middle.position_m=0.1"], "expected one of the rig's cameras, got 'middle'"),
        (["--sigma", "cameras.left-a.position_m=0.1"], "expected cameras.rotation_deg beside cameras.position_m"),
        (["--sigma", "beams.point_m=-1"], "expected a number above 0"),
    ],
)
def test_an_option_that_cannot_be_meant_is_refused_with_what_was_expected(lab, tmp_path, options, words):
    folder, runs, _, _ = lab
    done = typed("refine", *runs, "--rig", folder / "rig.yaml", "--out", tmp_path / "new", *options)
    assert (done.exit_code, words in done.output) == (2, True), done.output


def test_a_rig_of_which_nothing_is_stated_is_refused_and_the_option_is_named(lab, tmp_path):
    _, runs, true, _ = lab
    save_rig(true, tmp_path / "rig.yaml")
    done = typed("refine", runs[0], "--rig", tmp_path / "rig.yaml", "--out", tmp_path / "new")
    assert done.exit_code == 2
    assert "--sigma cameras.position_m=0.005" in done.output


def test_a_run_of_another_rig_is_refused_with_the_name_of_the_rig_that_was_given(lab, tmp_path):
    folder, runs, _, _ = lab
    other = recordings(tmp_path, "clean", count=1, frames=5)[0]
    done = typed("refine", runs[0], other, "--rig", folder / "rig.yaml", "--out", tmp_path / "new")
    expected = f"{other / 'run.yaml'}: cameras.left: expected a camera of {folder / 'rig.yaml'}, got 'left'"
    assert (done.exit_code, expected in done.output) == (2, True), done.output


def test_a_run_that_is_named_twice_is_refused(lab, tmp_path):
    folder, runs, _, _ = lab
    done = typed("refine", runs[0], runs[0], "--rig", folder / "rig.yaml", "--out", tmp_path / "new")
    assert (done.exit_code, "expected each run once" in done.output) == (2, True)


def test_a_sigma_replaces_what_the_file_states_of_that_part_alone():
    from tests.geometry.scenes import random_rig

    rig = random_rig(np.random.default_rng(0))
    stated = stated_covariance(rig, None, SIGMAS, Path("rig.yaml"))
    camera = next(iter(rig.cameras))
    wider = {f"cameras.{camera}.position_m": 0.5, f"cameras.{camera}.rotation_deg": 1.0}
    new = stated_covariance(rig, stated, wider, Path("rig.yaml"))
    assert set(new.names) == set(stated.names)
    for name in stated.names:
        before, after = (c.matrix[c.names.index(name), c.names.index(name)] for c in (stated, new))
        assert (after > before) if name.startswith(f"cameras.{camera}.") else (after == before)


def test_parts_of_which_nothing_is_stated_are_held_and_named(lab, short, tmp_path):
    _, _, true, _ = lab
    save_rig(true, tmp_path / "rig.yaml")
    options = ["--sigma", "cameras.position_m=0.003", "--sigma", "cameras.rotation_deg=0.1"]
    done = typed("refine", short, "--rig", tmp_path / "rig.yaml", "--out", tmp_path / "new", *options)
    assert done.exit_code in (0, 3), done.output
    text = (tmp_path / "new" / "report.html").read_text()
    assert "nothing is stated of screens.left, screens.right, beams.A" in text


LATER_S = 0.002  # by which the clock of camera right differs from what run.yaml states


@pytest.fixture(scope="module")
def late(tmp_path_factory) -> Path:
    """A run whose run.yaml states a wrong offset."""
    (run,) = recordings(tmp_path_factory.mktemp("late"), "clocks", count=1, frames=80)
    path = run / "run.yaml"
    content = yaml.safe_load(path.read_text())
    content["cameras"]["right"]["time_offset_s"] -= LATER_S
    path.write_text(yaml.safe_dump(content))
    return run


@pytest.fixture(scope="module")
def on_time(late) -> Path:
    """The folder with the refined clocks."""
    options = ["--sigma", "cameras.time_offset_s=0.003", "--sigma", "cameras.row_time_s=2e-6", "--free", "clocks"]
    done = typed("refine", late, "--rig", late / "rig.yaml", "--out", late.parent / "new", *options)
    assert done.exit_code == 0, done.output
    return late.parent / "new"


@pytest.mark.slow
def test_a_wrong_clock_is_corrected_to_its_sigma_and_the_first_camera_is_the_reference(on_time):
    new = load_rig_file(on_time / "rig.yaml")
    covariance = joint_covariance(new.rig, new.covariances, "new")
    assert "cameras.left.time_offset_s" not in covariance.names
    sigma = covariance.matrix[(covariance.names.index("cameras.right.time_offset_s"),) * 2] ** 0.5
    assert sigma < 0.1 * LATER_S
    assert abs(new.rig.cameras["right"].time_offset_s - LATER_S) < 4 * sigma
    assert [c.row_time_s for c in new.rig.cameras.values()] == [0.0, 0.0]  # stated, and not to be changed
    assert "cameras.right.row_time_s" in covariance.names
    assert "cameras.right.time_offset_s" in (on_time / "report.html").read_text()


CAMERA_OFF = [0.004, -0.004, 0.003, 0.002, -0.002, 0.001]  # m, rad


@pytest.fixture(scope="module")
def moved_camera(tmp_path_factory) -> tuple[Path, Path]:
    """A run of cameras with clocks of their own, and a rig.yaml of which camera right is off by about its sigmas."""
    folder = tmp_path_factory.mktemp("moved-camera")
    (run,) = recordings(folder, "clocks", count=1, frames=80)
    rig = load_rig_file(run / "rig.yaml").rig
    right = rig.cameras["right"]
    off = replace(right, camera_from_world=right.camera_from_world.plus(np.array(CAMERA_OFF)))
    save_rig(replace(rig, cameras={**rig.cameras, "right": off}), folder / "rig.yaml")
    return run, folder / "rig.yaml"


@pytest.mark.slow
def test_the_order_in_which_sigmas_are_given_changes_nothing(moved_camera, tmp_path):
    run, rig = moved_camera
    sigmas = ["cameras.row_time_s=2e-6", "cameras.position_m=0.005", "cameras.rotation_deg=0.15"]
    written = []
    for number, order in enumerate((sigmas, sigmas[::-1])):
        options = [word for sigma in order for word in ("--sigma", sigma)]
        done = typed("refine", run, "--rig", rig, "--out", tmp_path / str(number), *options)
        assert done.exit_code == 0, done.output
        new = load_rig_file(tmp_path / str(number) / "rig.yaml")
        covariance = joint_covariance(new.rig, new.covariances, "new")
        written.append(dict(zip(covariance.names, np.diagonal(covariance.matrix) ** 0.5, strict=True)))
    assert written[0] == pytest.approx(written[1], rel=1e-6)


@pytest.mark.slow
def test_what_is_held_is_named_where_it_explains_the_residuals_that_the_freed_numbers_leave(moved_camera, tmp_path):
    """A camera is off and only row times may change: nobody should keep the given rig."""
    run, rig = moved_camera
    sigmas = ["cameras.row_time_s=2e-6", "cameras.position_m=0.005", "cameras.rotation_deg=0.15"]
    options = [word for sigma in sigmas for word in ("--sigma", sigma)]
    done = typed("refine", run, "--rig", rig, "--out", tmp_path / "new", *options, "--free", "shutter")
    assert "if cameras may change as well" in done.output
    assert "Leave out --free" in (tmp_path / "new" / "report.html").read_text()


@pytest.mark.slow
def test_a_run_with_the_refined_rig_has_its_clocks_and_states_their_sigmas(late, on_time, tmp_path):
    run, errors = shutil.copytree(late, tmp_path / "run"), {}
    for name, rig in (("given", run / "rig.yaml"), ("refined", on_time / "rig.yaml")):
        content = yaml.safe_load((run / "run.yaml").read_text())
        (run / "run.yaml").write_text(yaml.safe_dump({**content, "rig": str(rig)}))
        typed("run", run, "--out", tmp_path / name, "--quiet")
        summary = json.loads((tmp_path / name / "summary.json").read_text())
        errors[name] = summary["errors"]["pose"]["measured"]["rotation_deg"]["rms"]
    clock = summary["parameters"]["clocks"]["right"]
    stated = yaml.safe_load((run / "run.yaml").read_text())["cameras"]["right"]["time_offset_s"]
    assert clock["time_offset_s"] == pytest.approx(stated + LATER_S, abs=4 * clock["time_offset_sigma_s"])
    assert 0 < clock["time_offset_sigma_s"] < 1.01 * clock["time_offset_prior_sigma_s"] < 0.1 * LATER_S
    assert errors["refined"] < 0.5 * errors["given"]


def with_clock_sigma(run: Path, folder: Path) -> Path:
    """The run with the sigma of its right camera's offset in its rig.yaml."""
    shutil.copytree(run, folder)
    rig = load_rig_file(folder / "rig.yaml").rig
    known = stated_covariance(rig, None, {"cameras.right.time_offset_s": 0.003}, folder)
    save_rig(RigFile(rig, covariance_blocks(known)), folder / "rig.yaml")
    content = yaml.safe_load((folder / "run.yaml").read_text())
    (folder / "run.yaml").write_text(yaml.safe_dump({**content, "rig": "rig.yaml"}))
    return folder


def test_a_run_refines_its_rig_first_and_its_results_know_that_rig(late, tmp_path):
    run = with_clock_sigma(late, tmp_path / "run")
    done = typed("run", run, "--refined", "--out", tmp_path / "out", "--quiet")
    assert done.exit_code in (0, 4), done.output
    new = load_rig_file(tmp_path / "out-refined" / "rig.yaml").rig.cameras["right"]
    assert new.time_offset_s == pytest.approx(LATER_S, abs=0.1 * LATER_S)
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["rig"] == str(tmp_path / "out-refined" / "rig.yaml")
    text = (tmp_path / "out" / "report.html").read_text()
    assert "Refined rig" in text
    assert "cameras.right.time_offset_s" in text
    again = typed("verify", tmp_path / "out")
    assert (again.exit_code, "SAME: " in again.output) == (0, True), again.output


def test_a_run_whose_rig_cannot_be_refined_is_not_processed(tmp_path):
    run = with_clock_sigma(recordings(tmp_path / "short", "clocks", count=1, frames=40)[0], tmp_path / "run")
    done = typed("run", run, "--refined", "--out", tmp_path / "out", "--quiet")
    assert done.exit_code == 3, done.output
    assert not (tmp_path / "out").exists()
    assert (tmp_path / "out-refined" / "report.html").exists()


def test_a_rig_with_clocks_is_read_back_as_it_was_written(tmp_path):
    from tests.geometry.scenes import random_rig

    rig = random_rig(np.random.default_rng(0))
    name, camera = next(iter(rig.cameras.items()))
    rig = replace(rig, cameras={**rig.cameras, name: replace(camera, time_offset_s=-0.0013, row_time_s=8e-6)})
    save_rig(rig, tmp_path / "rig.yaml")
    back = load_rig_file(tmp_path / "rig.yaml").rig.cameras[name]
    assert (back.time_offset_s, back.row_time_s) == (-0.0013, 8e-6)


def test_a_prior_whose_centre_shows_no_spot_expects_the_residuals_of_the_poses_in_it(lab):
    folder, runs, _, _ = lab
    run = load_run(runs[0], folder / "rig.yaml")
    aside = replace(run.prior, centre=run.prior.centre.plus(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1.2])), within_rad=1.5)
    usual, found = (tolerant(replace(run, prior=p)).tracker.sigma_model_px for p in (run.prior, aside))
    assert usual > 0.5
    assert found == pytest.approx(usual, rel=0.5)


def test_a_prior_whose_pose_absorbs_all_errors_leaves_the_tracker_as_it_is(lab):
    folder, runs, _, _ = lab
    run = load_run(runs[0], folder / "rig.yaml")
    spots = dict(list(run.rig.spots.items())[:3])
    beams, screens = {s.beam for s in spots.values()}, {s.screen for s in spots.values()}
    cameras = {n: c for n, c in run.rig.cameras.items() if c.screen in screens}
    few = Rig(
        {n: s for n, s in run.rig.screens.items() if n in screens},
        dict(list(cameras.items())[:1]),
        {n: b for n, b in run.rig.beams.items() if n in beams},
        spots,
    )
    known = with_rig(replace(run, rig=few), few, run.covariance)
    usual = known.tracker.sigma_model_px
    for seed in range(20):
        turn = 0.02 * np.random.default_rng(seed).normal(size=6)
        prior = replace(known.prior, centre=known.prior.centre.plus(turn))
        assert tolerant(replace(known, prior=prior)).tracker.sigma_model_px == pytest.approx(usual, abs=1e-3)
