"""Scenarios meet their conditions, and simulated points have the stated noise and clutter."""

import time
from dataclasses import replace

import numpy as np
import pytest

from geometry import rotations
from geometry.pose import Pose
from lab.errors import InputError
from lab.simulate.points import CLUTTER, simulate_points
from lab.simulate.scenarios import SCENARIOS, Motion, Occlusion, RecordingFault, Wave
from lab.simulate.scene import VISIBLE, compose

HIDDEN = 2


def speeds_px(run):
    """Motion of each view per frame (T - 1, n), px, while it is in the picture; 0 elsewhere."""
    moved = np.linalg.norm(np.diff(run.uv_px, axis=0), axis=-1)
    return np.where((run.in_view[1:] > 0) & (run.in_view[:-1] > 0), moved, 0.0)


@pytest.mark.parametrize("name", SCENARIOS)
@pytest.mark.parametrize("seed", [0, 1])
def test_the_vehicle_starts_within_the_prior_with_all_spots_in_view(name, seed):
    scene = compose(name, seed, frames=2)
    prior = scene.scenario.prior
    guess = Pose.from_ypr(np.deg2rad(prior.yaw_pitch_roll_deg), np.array(prior.position_m))
    assert np.all(np.abs(scene.poses.translation[0] - prior.position_m) <= prior.within_m)
    assert rotations.angle(guess.rotation.T @ scene.poses.rotation[0]) <= np.deg2rad(prior.within_deg)
    assert np.all(scene.in_view[0] == VISIBLE)


@pytest.mark.parametrize("seed", range(8))
def test_the_scenario_huo2015_has_the_properties_of_the_paper(seed):
    run = simulate_points("huo2015", seed)
    spot = np.array([s for _, s in run.model.views])
    assert len(run.frame) == 600
    assert run.t_s[1] == pytest.approx(0.010)
    assert [c.image_size_px for c in run.rig.cameras.values()] == [(1280, 1024)] * 2
    assert np.abs(run.poses.translation).max() <= 1.0
    assert np.abs(np.rad2deg(run.poses.ypr)).max() <= 30.0
    # Two pairs never leave, the third leaves and returns.
    assert np.all(run.in_view[:, np.isin(spot, ("1", "2", "4", "5"))] == VISIBLE)
    for name in ("3", "6"):
        seen = run.in_view[:, spot == name][:, 0] == VISIBLE
        out = np.flatnonzero(~seen)
        assert out.size >= 5
        assert seen[0]
        assert seen[out[0] :].any()
    # Three beams through one point, 20 deg apart.
    directions = np.array([b.direction for b in run.rig.beams.values()])
    np.testing.assert_allclose(np.rad2deg(np.arccos(np.diagonal(directions @ directions.T, 1))), 20.0)


def test_clutter_has_its_probability_and_its_distance_from_spots_in_the_picture():
    run = simulate_points("huo2015", 0, noise_px=0.0)
    false = [
        (k, c, uv)
        for k, pictures in enumerate(run.detections)
        for c, found in enumerate(pictures)
        for uv in found.uv_px[run.origin[k][c] == CLUTTER]
    ]
    in_picture = int((run.in_view == VISIBLE).sum())
    # 5 binomial sigmas
    assert len(false) == pytest.approx(0.2 * in_picture, abs=5 * np.sqrt(0.16 * in_picture))
    for k, c, uv in false:
        own = (run.model.camera_of == c) & (run.in_view[k] == VISIBLE)
        assert np.linalg.norm(run.uv_px[k, own] - uv, axis=-1).min() <= 15.0


def test_less_clutter_is_a_subset_of_more_clutter_with_the_same_motion():
    few, many = (
        simulate_points("huo2015", 4, clutter=0.2, frames=50),
        simulate_points("huo2015", 4, clutter=1.0, frames=50),
    )
    np.testing.assert_array_equal(few.uv_px, many.uv_px)
    few_scene, many_scene = (
        compose(replace(few_s, clutter=replace(few_s.clutter, per_spot=p)), 4, 50)
        for few_s, p in ((SCENARIOS["huo2015"], 0.2), (SCENARIOS["huo2015"], 1.0))
    )
    few_set = {tuple(uv) for uv in few_scene.clutter_points.uv_px}
    many_set = {tuple(uv) for uv in many_scene.clutter_points.uv_px}
    assert few_set < many_set


@pytest.mark.parametrize("noise_px", [0.05, 0.3])
def test_detections_scatter_about_the_truth_by_their_stated_noise(noise_px):
    run = simulate_points("smooth", 5, noise_px=noise_px)
    errors = []
    for k, pictures in enumerate(run.detections):
        for c, found in enumerate(pictures):
            true = run.origin[k][c] != CLUTTER
            errors.append((found.uv_px - run.uv_px[k, run.origin[k][c]])[true])
            assert np.all(run.model.camera_of[run.origin[k][c][true]] == c)
            np.testing.assert_allclose(found.cov_px2, np.broadcast_to(noise_px**2 * np.eye(2), found.cov_px2.shape))
    rms = np.sqrt(np.mean(np.concatenate(errors) ** 2))
    assert rms == pytest.approx(noise_px, rel=0.05)


def test_the_order_of_detections_is_independent_of_identity():
    run = simulate_points("static", 0, frames=300, clutter=0.0)
    first = np.array([run.origin[k][0][0] for k in range(300)])
    assert {0, 1, 2} == set(first)
    assert np.bincount(first).max() < 150


@pytest.mark.parametrize("name", ["huo2015", "sharp-turns"])
def test_only_frames_after_a_bend_are_flagged(name):
    run = simulate_points(name, 2)
    # The error of a constant-velocity prediction without noise: between bends the acceleration, below a pixel.
    missed = np.linalg.norm(np.diff(run.uv_px, 2, axis=0), axis=-1).max(axis=1)
    missed = np.concatenate([[0, 0], missed])
    assert run.turned.sum() >= 5
    assert missed[run.turned & (run.frame >= 2)].min() > 4 * missed[~run.turned].max()


@pytest.mark.parametrize(
    ("name", "least", "most"),
    [("smooth", 8, 18), ("sharp-turns", 18, 28), ("fast", 45, 80), ("very-fast", 90, 160), ("static", 0, 0)],
)
def test_spots_have_the_speed_of_the_scenario(name, least, most):
    fastest = [speeds_px(simulate_points(name, seed, frames=400)).max() for seed in range(3)]
    assert least <= min(fastest)
    assert max(fastest) <= most


def test_a_turntable_moves_and_stops():
    still = speeds_px(simulate_points("turntable", 0)).max(axis=1) < 1e-9
    starts = np.flatnonzero(np.diff(still.astype(int)) == -1)
    assert 0.4 < still.mean() < 0.8
    assert len(starts) >= 5


def test_a_long_exit_lasts_for_hundreds_of_frames():
    run = simulate_points("long-out", 0)
    out = (run.in_view[:, [2, 5]] == 0).all(axis=1)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], out.astype(int), [0]])))
    assert (edges[1::2] - edges[::2]).max() >= 200


def test_an_occluded_spot_is_in_view_but_not_detected():
    run = simulate_points("hidden-in-turn", 1, clutter=0.0)
    assert (run.in_view == HIDDEN).any()
    for k, pictures in enumerate(run.origin):
        assert sorted(np.concatenate(pictures)) == list(np.flatnonzero(run.in_view[k] == VISIBLE))
    # Around each bend: one spot for ten frames, five before and five from the bent frame on.
    for k in np.flatnonzero(run.turned):
        if 20 < k < 590:
            assert np.all((run.in_view[k - 5 : k + 5] != VISIBLE).any(axis=1) | (run.in_view[k] == 0).any())


def test_a_blackout_has_no_detections_and_ends_for_all_spots():
    run = simulate_points("blackout", 0, clutter=0.0)
    assert all(len(d) == 0 for k in range(150, 160) for d in run.detections[k])
    assert not (run.in_view[160] == HIDDEN).any()


def test_a_dropped_picture_has_truth_but_no_detections():
    run = simulate_points("damaged", 0)
    assert not run.has_image[20].any()
    assert not run.has_image[31, 0]
    assert run.has_image[31, 1]
    assert len(run.detections[31][0]) == 0
    assert np.isfinite(run.uv_px[31]).all()


def test_the_first_frames_do_not_depend_on_the_number_of_frames():
    short, long = simulate_points("huo2015", 9, frames=20), simulate_points("huo2015", 9, frames=400)
    for k in range(20):
        for a, b in zip(short.detections[k], long.detections[k], strict=True):
            np.testing.assert_array_equal(a.uv_px, b.uv_px)


def test_another_seed_gives_another_recording():
    assert not np.allclose(simulate_points("smooth", 0, frames=5).uv_px, simulate_points("smooth", 1, frames=5).uv_px)


def test_six_hundred_frames_take_less_than_a_second():
    simulate_points("huo2015", 0, frames=5)
    start = time.process_time()
    simulate_points("huo2015", 1)
    assert time.process_time() - start < 0.6  # measured 0.08 s


def test_skew_beams_neither_intersect_nor_lie_in_one_plane():
    rig = simulate_points("four-skew-beams", 0, frames=2).rig
    beams = list(rig.beams.values())
    directions = np.array([b.direction for b in beams])
    assert np.linalg.svd(directions)[1][-1] > 0.1
    for i, a in enumerate(beams):
        for b in beams[:i]:
            n = np.cross(a.direction, b.direction)
            assert abs(n @ (a.point - b.point)) / np.linalg.norm(n) > 0.01
    assert [s.name for s in rig.spots.values() if s.beam == "D"] == ["7"]


def test_corners_of_triangles_fall_on_frames():
    motion = Motion((0, 0, 0, 0, 0, 0), (Wave("yaw", 10, 1.25, "triangle"),)).drawn(np.random.default_rng(3), 100.0)
    bends = motion.bends_s(4.0)
    assert len(bends) == 10
    np.testing.assert_allclose(bends * 100, np.round(bends * 100), atol=1e-6)
    yaw = np.rad2deg(motion.at(bends)[:, 3])
    np.testing.assert_allclose(np.abs(yaw), 10.0, atol=1e-6)


@pytest.mark.parametrize("shape", ["sine", "triangle", "plateau", "steps"])
def test_waves_range_from_minus_one_to_one_without_jumps(shape):
    t = np.linspace(0, 1, 20_001)
    values = Wave("x", 1.0, 1.0, shape).at(t)
    assert values.min() == pytest.approx(-1.0, abs=1e-6)
    assert values.max() == pytest.approx(1.0, abs=1e-6)
    assert np.abs(np.diff(values)).max() < 2e-3


def test_invalid_arguments_are_rejected_with_a_message():
    with pytest.raises(InputError, match=r"scenario: expected one of huo2015, .*got 'huo'"):
        simulate_points("huo", 0)
    with pytest.raises(InputError, match=r"clutter: expected a probability .* got 2"):
        simulate_points("huo2015", 0, clutter=2.0)
    with pytest.raises(InputError, match="frames: expected at least 1, got 0"):
        simulate_points("huo2015", 0, frames=0)
    with pytest.raises(ValueError, match="'dropped', 'truncated' or 'wrong size'"):
        RecordingFault(3, "lost")


def test_a_scenario_with_impossible_conditions_is_rejected(monkeypatch):
    monkeypatch.setattr("lab.simulate.scene._MAX_DRAWS", 20)
    impossible = replace(SCENARIOS["static"], leaves_and_returns=("3",))
    with pytest.raises(InputError, match="'static': none of 20 motions"):
        simulate_points(impossible, 0, frames=2)


def test_misses_occlude_single_spots():
    missing = replace(SCENARIOS["static"], occlusion=Occlusion(miss_probability=0.3))
    share = (simulate_points(missing, 0).in_view == HIDDEN).mean()
    assert share == pytest.approx(0.3, abs=0.05)
