"""Simulated run folders agree with their scene."""

import itertools
from dataclasses import replace

import cv2
import numpy as np
import pytest
import yaml

from geometry.uncertainty.rig_uncertainty import perturbed_rig
from lab.errors import InputError
from lab.files.rig.rig_file import load_rig, save_rig
from lab.files.run.detections_file import read_detections
from lab.runs.input_check import check
from lab.simulate.picture import expected_light, laser_powers, make_sensor, render
from lab.simulate.points import simulate_points
from lab.simulate.scenarios import LIGHTS, SCENARIOS, Clutter, Light, Occlusion
from lab.simulate.scene import compose
from lab.simulate.write import simulate
from tests.lab.tables import rows_of
from tests.marks import further_slow

SMALL = {"scale": 0.25}


def files_of(folder):
    """Content by relative path."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def pictures_of(folder, camera):
    """All readable pictures of a camera, in order of name."""
    return [cv2.imread(str(p), cv2.IMREAD_UNCHANGED) for p in sorted((folder / "frames" / camera).glob("*.png"))]


@pytest.mark.parametrize("name", further_slow(sorted(SCENARIOS), fast=6))
def test_a_run_folder_is_complete_and_consistent(name, tmp_path):
    folder = simulate(name, tmp_path / "run", seed=1, frames=3 if name == "clocks" else 2, **SMALL)
    result = check(folder)
    assert result.exit_status == 0
    assert any("poses and spots agree through the rig" in line for line in result.lines)
    assert sorted(p.name for p in folder.iterdir()) == ["frames", "rig.yaml", "run.yaml", "truth"]


def test_the_same_seed_gives_the_same_bytes_with_any_number_of_threads(tmp_path):
    one = simulate("huo2015", tmp_path / "one", seed=7, frames=4, threads=1, **SMALL)
    two = simulate("huo2015", tmp_path / "two", seed=7, frames=4, threads=3, **SMALL)
    assert files_of(one) == files_of(two)
    other = simulate("huo2015", tmp_path / "other", seed=8, frames=4, **SMALL)
    same = {name for name, data in files_of(other).items() if files_of(one)[name] == data}
    assert same == {"rig.yaml"}


def test_the_first_pictures_do_not_depend_on_the_number_of_frames(tmp_path):
    few = files_of(simulate("damaged", tmp_path / "few", seed=2, frames=3, **SMALL))
    many = files_of(simulate("damaged", tmp_path / "many", seed=2, frames=9, **SMALL))
    for name in (f"frames/{c}/{k:06d}.png" for c in ("left", "right") for k in range(3)):
        assert few[name] == many[name]


def test_faults_are_in_the_frames_of_the_scenario(tmp_path):
    folder = simulate("damaged", tmp_path / "run", seed=0, frames=57, **SMALL)
    numbers = {c: {int(p.stem) for p in (folder / "frames" / c).iterdir()} for c in ("left", "right")}
    assert set(range(57)) - numbers["left"] == {20, 31, 32, 33}
    assert set(range(57)) - numbers["right"] == {20}
    cut, whole = ((folder / "frames" / "right" / f"{k:06d}.png").read_bytes() for k in (40, 39))
    assert cut[:8] == whole[:8]
    assert cut[-12:] != whole[-12:]  # a PNG ends with its IEND chunk
    assert len(cut) < 0.7 * len(whole)
    assert cv2.imread(str(folder / "frames" / "left" / "000055.png"), -1).shape == (128, 160)
    assert {int(row["frame"]) for row in rows_of(folder / "truth" / "spots.csv")} == set(range(57))


def test_a_video_contains_the_pictures_without_loss(tmp_path):
    files = simulate("turntable", tmp_path / "files", seed=3, frames=10, **SMALL)
    video = simulate("turntable", tmp_path / "video", seed=3, frames=10, video=True, **SMALL)
    assert check(video).exit_status == 0
    for camera in ("left", "right"):
        film = cv2.VideoCapture(str(video / f"{camera}.avi"))
        shown = [film.read()[1] for _ in range(10)]
        assert not film.read()[0]
        for a, b in zip(pictures_of(files, camera), shown, strict=True):
            np.testing.assert_array_equal(a, b[..., 0])


def test_written_detections_are_those_of_simulate_points(tmp_path):
    folder = simulate("huo2015", tmp_path / "run", seed=5, frames=20, points=True, noise_px=0.3)
    run = simulate_points("huo2015", 5, frames=20, noise_px=0.3)
    table = read_detections(folder / "detections.csv")
    for k, (c, name) in itertools.product(range(20), enumerate(run.model.camera_names)):
        found = table.cameras[name].at(k)
        assert len(found) == len(run.detections[k][c])
        order = [np.lexsort(d.uv_px.round(4).T) for d in (found, run.detections[k][c])]
        np.testing.assert_allclose(found.uv_px[order[0]], run.detections[k][c].uv_px[order[1]], atol=1e-5)
        np.testing.assert_allclose(found.cov_px2, np.broadcast_to(0.09 * np.eye(2), found.cov_px2.shape))


@pytest.mark.parametrize("bits", [8, 12])
def test_pixels_have_the_noise_of_the_rig_file(bits, tmp_path):
    bright = Light(
        bits=bits, background_dn=60.0, gradient_dn=100.0, hot_pixels=0, texture=0.0, reflections=0, read_noise_e=60.0
    )
    scenario = replace(SCENARIOS["static"], light=bright, clutter=Clutter(per_spot=0.0), name="bright")
    folder = simulate(scenario, tmp_path / "run", seed=0, frames=40, **SMALL)
    noise = load_rig(folder / "rig.yaml").cameras["left"].noise
    stack = np.array(pictures_of(folder, "left"), dtype=float)
    assert stack[0].max() > 255 or bits == 8
    mean, variance = stack.mean(axis=0), stack.var(axis=0, ddof=1)
    claimed = (mean - noise.black_dn) / noise.gain_e_per_dn + (noise.read_noise_e / noise.gain_e_per_dn) ** 2 + 1 / 12
    # In thirds of brightness, each of tens of thousands of pixels with 39 degrees of freedom: 0.2 %.
    edges = np.quantile(mean, [0, 1 / 3, 2 / 3, 0.98])
    for low, high in itertools.pairwise(edges):
        some = (mean >= low) & (mean < high)
        assert variance[some].mean() / claimed[some].mean() == pytest.approx(1.0, abs=0.02)


def test_a_12_bit_picture_is_the_same_scene_with_finer_grey_values(tmp_path):
    scenario = replace(SCENARIOS["static"], light=LIGHTS["clean"])
    deep = replace(scenario, light=replace(LIGHTS["clean"], bits=12))
    a, b = (
        pictures_of(simulate(s, tmp_path / str(s.light.bits), frames=1, noisy=False, **SMALL), "left")[0]
        for s in (scenario, deep)
    )
    assert (a.dtype, b.dtype) == (np.uint8, np.uint16)
    assert np.abs(b / 16.0 - a).max() <= 0.5 + 0.5 / 16


def test_a_saturated_spot_has_the_largest_grey_value():
    scene = compose(replace(SCENARIOS["static"], light=replace(LIGHTS["clean"], peak_dn=2000.0)), 0, 1)
    picture = render(scene, make_sensor(scene, 0), laser_powers(scene), 0)
    assert picture.max() == 255
    assert (picture == 255).sum() > 30


def test_only_visible_spots_give_light():
    occluded = replace(
        SCENARIOS["static"],
        light=LIGHTS["clean"],
        clutter=Clutter(per_spot=0.0),
        occlusion=Occlusion(blackout_every=1, blackout_frames=1, clean_start=1),
    )
    scene = compose(occluded, 0, 2)
    sensor, powers = make_sensor(scene, 0), laser_powers(scene)
    assert (scene.in_view[1] == 2).all()
    np.testing.assert_array_equal(expected_light(scene, sensor, powers, 1)[0], sensor.background)
    lit = expected_light(scene, sensor, powers, 0)[0] - sensor.background
    for view in np.flatnonzero(scene.model.camera_of == 0):
        u, v = np.round(scene.uv_px[0, view]).astype(int)
        assert lit[v, u] > 50


def test_speckle_has_the_given_contrast():
    grainy = replace(LIGHTS["clean"], speckle_contrast=0.2, beam_radius_m=0.1)
    even = replace(grainy, speckle_contrast=0.0)
    rough, smooth = (
        compose(replace(SCENARIOS["static"], light=light, clutter=Clutter(per_spot=0.0)), 0, 1)
        for light in (grainy, even)
    )
    a, b = (
        expected_light(s, make_sensor(s, 0), laser_powers(s), 0)[0] - make_sensor(s, 0).background
        for s in (rough, smooth)
    )
    ratio = (a / np.maximum(b, 1e-9))[b > 0.3 * b.max()]
    assert ratio.mean() == pytest.approx(1.0, abs=0.02)
    assert ratio.std() == pytest.approx(0.2, rel=0.1)


def test_a_wider_beam_has_a_lower_peak_and_the_same_power():
    scene = compose(replace(SCENARIOS["static"], light=LIGHTS["clean"], clutter=Clutter(per_spot=0.0)), 0, 1)
    sensor, powers = make_sensor(scene, 0), laser_powers(scene)
    wide = replace(scene, scenario=replace(scene.scenario, light=replace(LIGHTS["clean"], beam_radius_m=0.03)))
    sums, peaks = zip(
        *(
            (float(light.sum(dtype=np.float64)), float(light.max()))
            for light in (expected_light(s, sensor, powers, 0)[0] - sensor.background for s in (scene, wide))
        ),
        strict=True,
    )
    assert sums[1] == pytest.approx(sums[0], rel=1e-3)
    assert peaks[1] < 0.3 * peaks[0]


def test_an_interrupted_simulation_leaves_no_files(tmp_path):
    def stop(done, total):
        if done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulate("huo2015", tmp_path / "run", frames=5, progress=stop, **SMALL)
    assert list(tmp_path.iterdir()) == []


def test_progress_counts_every_picture(tmp_path):
    seen = []
    simulate("huo2015", tmp_path / "run", frames=4, progress=lambda done, total: seen.append((done, total)), **SMALL)
    assert seen == [(n, 8) for n in range(1, 9)]


def test_existing_files_are_never_overwritten(tmp_path):
    (tmp_path / "mine.txt").write_text("precious")
    with pytest.raises(InputError, match="choose another --out"):
        simulate("huo2015", tmp_path, frames=1)
    assert (tmp_path / "mine.txt").read_text() == "precious"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"light": "dim"}, r"light: expected one of lab, .*got 'dim'"),
        ({"video": True, "points": True}, "a video or points, not both"),
        ({"scenario": "damaged", "video": True}, "which a video cannot contain"),
        ({"light": "deep", "video": True}, "8-bit"),
        ({"scale": 0.0}, "scale: expected 0.05 to 4, got 0"),
    ],
)
def test_invalid_arguments_are_rejected_and_nothing_is_written(arguments, words, tmp_path):
    with pytest.raises(InputError, match=words):
        simulate(**{"scenario": "huo2015", "out": tmp_path / "run", "frames": 1, **arguments})
    assert list(tmp_path.iterdir()) == []


def test_the_run_file_contains_the_prior_and_the_summary(tmp_path):
    folder = simulate("huo2015", tmp_path / "run", seed=6, frames=1, **SMALL)
    content = yaml.safe_load((folder / "run.yaml").read_text())
    assert content["prior"]["within_m"] == 1.0
    assert content["prior"]["within_deg"] == 30.0
    assert content["exposure_s"] == 0.0005
    assert "seed 6" in content["notes"]
    assert "leaves the picture and returns" in content["notes"]


def test_the_run_folder_of_a_given_rig_contains_its_calibration(tmp_path):
    """The spots are those of the true rig; the run folder contains its calibration."""
    true = simulate("clean", tmp_path / "first", seed=1, frames=2, points=True) / "rig.yaml"
    rig = load_rig(true)
    off = perturbed_rig(rig, ["cameras.left.fx", "beams.A.direction_y"], np.array([3.0, 1e-3]))
    save_rig(off, tmp_path / "true.yaml")
    folder = simulate(
        "clean", tmp_path / "run", seed=1, frames=4, points=True, noise_px=0.0, clutter=0.0,
        rig=tmp_path / "true.yaml", known_rig=true,
    )  # fmt: skip
    assert load_rig(folder / "rig.yaml").cameras["left"].matrix[0, 0] == rig.cameras["left"].matrix[0, 0]
    (line,) = [line for line in check(folder).lines if "poses and spots agree" in line]
    assert float(line.split()[-2]) > 0.1  # px: the given rig is not the recorded one
    with pytest.raises(InputError, match="keep its size"):
        simulate("clean", tmp_path / "no", rig=true, scale=0.5)
    save_rig(load_rig(simulate("four-skew-beams", tmp_path / "x", frames=1) / "rig.yaml"), tmp_path / "four.yaml")
    with pytest.raises(InputError, match=r"four.yaml: expected the cameras and spots of the rig that is recorded"):
        simulate("clean", tmp_path / "no", rig=true, known_rig=tmp_path / "four.yaml")
    assert not (tmp_path / "no").exists()
