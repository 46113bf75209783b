"""One target over time: consistent covariances, prediction through misses, honest statuses, re-acquisition."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.marks import further_slow
from tracking.detections import Detections
from tracking.single_target.blobs import BlobParameters, find_blobs
from tracking.single_target.point_tracker import PointParameters, PointTracker, track_point
from tracking.statuses import PoseStatus

SIGMA = 0.2
FIXED = PointParameters(learn_sigma_a=False, sigma_a_px=0.05, sigma_model_px=0.0)


def at(*places, flux=1000.0):
    uv = np.array(places, dtype=float).reshape(-1, 2)
    found = Detections.at(uv, np.tile(SIGMA**2 * np.eye(2), (len(uv), 1, 1)))
    return replace(found, flux=np.broadcast_to(np.asarray(flux, dtype=float), (len(uv),)).copy())


def motion(rng, frames, sigma_a=0.05, start=(200.0, 300.0), speed=(2.0, -1.0)):
    """Positions (T, 2) of a target with white acceleration that is constant within a frame, as the filter assumes."""
    a = sigma_a * rng.standard_normal((frames, 2))
    v = np.array(speed) + np.concatenate([np.zeros((1, 2)), np.cumsum(a[:-1], axis=0)])
    return np.array(start) + np.concatenate([np.zeros((1, 2)), np.cumsum(v[:-1] + 0.5 * a[:-1], axis=0)])


def seen(rng, path, hidden=()):
    noisy = path + SIGMA * rng.standard_normal(path.shape)
    return [at() if k in hidden else at(uv) for k, uv in enumerate(noisy)]


def steps(frames):
    return np.concatenate([[0.0], np.ones(frames - 1)])


def statuses(track):
    return [e.status.value for e in track]


def test_positions_and_covariances_agree_with_the_errors():
    rng = np.random.default_rng(1)
    nees, nis = [], []
    for _ in range(30):
        path = motion(rng, 40)
        track = track_point(steps(40), seen(rng, path), FIXED)
        e = track[-1].x[:2] - path[-1]
        nees.append(e @ np.linalg.solve(track[-1].P[:2, :2], e))
        nis += [t.nis for t in track[5:]]
    assert 0.6 < np.mean(nees) / 2 < 1.5  # 30 runs: sigma of the ratio is 0.18
    assert 0.9 < np.mean(nis) / 2 < 1.1


def test_the_first_vector_is_the_difference_of_the_first_two_positions():
    track = track_point(steps(3), [at((10, 20)), at((13, 18)), at((16, 16))], replace(FIXED, confirm=2))
    np.testing.assert_allclose(track[1].x, [13, 18, 3, -2])
    assert np.isnan(track[0].x[2:]).all()
    np.testing.assert_allclose(track[2].predicted_px, [16, 16])


def test_hidden_frames_are_predicted_with_sigmas_that_cover_the_error():
    rng = np.random.default_rng(2)
    errors = []
    for _ in range(20):
        path = motion(rng, 40)
        track = track_point(steps(40), seen(rng, path, hidden=range(25, 33)), FIXED)
        assert statuses(track)[25:33] == ["predicted"] * 8
        assert track[33].status is PoseStatus.MEASURED
        errors.append((track[32].x[:2] - path[32]) / np.sqrt(np.diagonal(track[32].P)[:2]))
        assert track[32].P[0, 0] > track[25].P[0, 0] > track[24].P[0, 0]
    assert np.mean(np.square(errors)) < 1.5
    assert np.abs(errors).max() < 4.5


def test_two_frames_in_one_step_are_two_steps():
    rng = np.random.default_rng(3)
    path = motion(rng, 12, sigma_a=0.0)
    found = seen(rng, path)
    all_frames = track_point(steps(12), [*found[:6], None, *found[7:]], FIXED)
    without = track_point(np.array([0, 1, 1, 1, 1, 1, 2, 1, 1, 1, 1.0]), [*found[:6], *found[7:]], FIXED)
    assert all_frames[6].status is PoseStatus.PREDICTED
    np.testing.assert_allclose(all_frames[-1].x, without[-1].x, atol=0.05)


@pytest.mark.parametrize("flux", [1000.0, np.nan])
def test_clutter_is_not_taken_for_the_target(flux):
    rng = np.random.default_rng(4)
    path = motion(rng, 100)
    noisy = path + SIGMA * rng.standard_normal(path.shape)
    found = [at(uv, *rng.uniform(0, 800, (10, 2)), flux=[flux] + 10 * [0.5 * flux]) for uv in noisy]
    track = track_point(steps(100), found, FIXED)
    assert np.mean([e.row == 0 for e in track]) >= 0.98


def test_before_the_target_appears_and_after_it_is_lost_there_is_no_position():
    rng = np.random.default_rng(5)
    path = motion(rng, 20)
    found = [*[at()] * 5, *seen(rng, path), *[at()] * 60]
    track = track_point(steps(85), found, FIXED)
    words = statuses(track)
    assert words[:5] == ["lost"] * 5
    assert words[5:25] == ["measured"] * 20  # the frames that confirmed it too
    predicted = words[25:].count("predicted")
    assert 10 <= predicted <= 50
    assert words[25:] == ["predicted"] * predicted + ["lost"] * (60 - predicted)
    assert all(np.isnan(e.x).all() for e in track if e.status is PoseStatus.LOST)


def test_a_lost_target_is_found_again_by_its_brightness():
    rng = np.random.default_rng(6)
    path = motion(rng, 150, sigma_a=0.0)
    other = at((350.0, 100.0), flux=20.0)  # stands still, 50 times fainter
    found = [at(uv) if k < 30 or k >= 100 else other for k, uv in enumerate(path)]
    track = track_point(steps(150), found, FIXED)
    words = statuses(track)
    assert words[95] == "lost"
    assert words[100:] == ["measured"] * 50
    np.testing.assert_allclose(track[-1].x[:2], path[-1], atol=0.5)


def test_only_noise_gives_no_track():
    rng = np.random.default_rng(7)
    found = [at(*rng.uniform(0, 2000, (2, 2))) for _ in range(100)]
    assert statuses(track_point(steps(100), found, FIXED)).count("measured") <= 5


def test_the_start_place_chooses_among_several_targets():
    rng = np.random.default_rng(8)
    one, other = motion(rng, 30), motion(rng, 30, start=(600.0, 500.0))
    found = [at(a, b, flux=[2000.0, 1000.0]) for a, b in zip(one, other, strict=True)]
    for start, path in (((195.0, 305.0), one), ((610.0, 495.0), other)):
        track = track_point(steps(30), found, replace(FIXED, start_px=start))
        np.testing.assert_allclose(track[-1].x[:2], path[-1], atol=0.5)
    assert track_point(steps(30), found, FIXED)[-1].row == 0, "the brightest"
    nowhere = track_point(steps(30), found, replace(FIXED, start_px=(1000.0, 1000.0)))
    assert set(statuses(nowhere)) == {"lost"}


def test_of_two_motions_that_of_the_foremost_detections_is_followed():
    rng = np.random.default_rng(10)
    one, other = motion(rng, 30), motion(rng, 30, start=(600.0, 500.0))
    found = [at(a, b, flux=[1000.0, 2000.0]) for a, b in zip(one, other, strict=True)]  # a detector's own order
    assert track_point(steps(30), found, FIXED)[-1].row == 0


def before_a_scene(rng, path, drift=(0.0, 0.0), frames=40):
    """A target, the last of each picture, before six objects that drift; detections scatter by their sigma."""
    scene = rng.uniform(100, 700, (6, 2)) + np.arange(frames)[:, None, None] * np.array(drift)
    places = np.concatenate([scene, path[:, None]], axis=1)
    return [at(*uv) for uv in places + SIGMA * rng.standard_normal(places.shape)]


@pytest.mark.parametrize(
    ("speed", "drift"), [((1.0, -0.4), (0, 0)), ((0.0, 0.0), (0.8, 0.5)), ((2.5, 0.3), (0.8, 0.5))]
)
def test_before_a_scene_the_target_is_what_moves_otherwise(speed, drift):
    rng = np.random.default_rng(11)
    path = np.array([300.0, 300.0]) + np.arange(40)[:, None] * np.array(speed)
    track = track_point(steps(40), before_a_scene(rng, path, drift), FIXED)
    assert [e.row for e in track] == [6] * 40, "from its first picture on"


def test_where_nothing_moves_before_the_scene_there_is_no_position():
    track = track_point(steps(40), before_a_scene(np.random.default_rng(12), np.full((40, 2), 300.0)), FIXED)
    assert set(statuses(track)) == {"lost"}
    assert all(e.several for e in track[3:])


def test_what_jumps_once_is_no_target_that_moves():
    """As the centroid of an object does that is joined with its neighbour from some picture on."""
    path = np.array([300.0, 300.0]) + 2.0 * (np.arange(40) >= 20)[:, None]
    track = track_point(steps(40), before_a_scene(np.random.default_rng(13), path), FIXED)
    assert set(statuses(track)) == {"lost"}


def test_of_several_objects_near_the_stated_place_the_nearest_is_followed():
    found = [at((320.0, 300.0), (305.0, 300.0), (300.0, 330.0), flux=[9.0, 5.0, 7.0]) for _ in range(20)]
    track = track_point(steps(20), found, replace(FIXED, start_px=(303.0, 301.0)))
    assert [e.row for e in track] == [1] * 20


@pytest.mark.parametrize("true", [0.02, 2.0])
def test_the_process_noise_is_estimated(true):
    rng = np.random.default_rng(9)
    path = motion(rng, 400, sigma_a=true)
    track = track_point(steps(400), seen(rng, path), PointParameters(sigma_model_px=0.0))
    assert true / 3 < track[-1].sigma_a_px < true * 3
    assert statuses(track).count("measured") >= 390


def test_without_a_picture_nothing_is_measured():
    tracker = PointTracker(FIXED)
    assert tracker.step(0.0, None).status is PoseStatus.LOST


@pytest.mark.parametrize("wrong", [{"confirm": 1}, {"p_gate": 0.0}, {"sigma_a_px": -1.0}, {"max_size_ratio": 1.0}])
def test_a_parameter_without_meaning_is_refused(wrong):
    with pytest.raises(ValueError, match="expected"):
        PointParameters(**wrong)


def disc_behind_an_edge(centre, radius, edge, background=150.0):
    """Picture (120, 160) of a black disc; what is within `edge` px, along u + v, of a bright object is hidden by it."""
    fine = (np.arange(4 * 160) + 0.5) / 4 - 0.5
    u, v = np.meshgrid(fine, fine[: 4 * 120])
    along = (u - centre[0] + v - centre[1]) / np.sqrt(2)
    black = (np.hypot(u - centre[0], v - centre[1]) < radius) & ~((edge[0] < along) & (along < edge[1]))
    share = black.reshape(120, 4, 160, 4).mean(axis=(1, 3))
    return background - 130 * share


@pytest.mark.parametrize("radius", further_slow([9.0, 5.0]))
@pytest.mark.parametrize("steps_of_the_edge", further_slow([6, 25]))
def test_a_centre_is_uncertain_while_an_edge_hides_a_part_of_the_target(radius, steps_of_the_edge):
    rng, tracker, ratios, sigmas = np.random.default_rng(4), PointTracker(), [], []
    for k in range(90):
        centre = np.array([60.0, 50.0]) + k * np.array([0.3, 0.2])
        begin = radius * (1 - 3 * (k - 30) / steps_of_the_edge)  # far beyond the disc until frame 30
        picture = disc_behind_an_edge(centre, radius, (begin, begin + 3 * radius))
        noisy = np.clip(np.round(picture + 2 * rng.standard_normal(picture.shape)), 0, 255).astype(np.uint8)
        estimate = tracker.step(1.0, find_blobs(noisy, BlobParameters("darker")))
        if estimate.status is PoseStatus.MEASURED:
            away = estimate.x[:2] - centre
            ratios.append(np.sqrt(away @ np.linalg.solve(estimate.P[:2, :2], away)))
            sigmas.append(np.sqrt(estimate.P[0, 0]))
    assert len(ratios) > 60
    # The first and the last frames of an occlusion are off by less than the area shows: a few hundredths of the radius.
    assert max(ratios) < 20
    assert np.sqrt(np.mean(np.square(ratios))) < 3
    assert np.mean(sigmas[:25]) < 0.1
    assert min(sigmas[-5:]) < 0.1


@pytest.mark.parametrize("hidden_frames", further_slow([60, 0]))
@pytest.mark.parametrize("px_per_frame", further_slow([4.0, 0.8]))
def test_no_frame_of_an_occlusion_is_off_by_more_than_its_sigmas_say(px_per_frame, hidden_frames):
    """Neither the first and the last ones, which hide less than the area shows, nor those of a target found again."""
    rng, radius, found, centres = np.random.default_rng(6), 7.0, [], []
    half = (2 * radius + px_per_frame * hidden_frames) / 2
    for k in range(round(60 + 2 * (half + 2 * radius) / px_per_frame)):
        centres.append(np.array([70.0 + 18 * np.sin(k / 11), 60.0 + 12 * np.sin(k / 14)]))
        middle = 2 * radius + half - px_per_frame * (k - 25)
        picture = disc_behind_an_edge(centres[-1], radius, (middle - half, middle + half))
        noisy = np.clip(np.round(picture + 2 * rng.standard_normal(picture.shape)), 0, 255).astype(np.uint8)
        found.append(find_blobs(noisy, BlobParameters("darker")))
    track, ratios = track_point(steps(len(found)), found), []
    for estimate, centre in zip(track, centres, strict=True):
        if estimate.status is PoseStatus.MEASURED:
            away = estimate.x[:2] - centre
            ratios.append(np.sqrt(away @ np.linalg.solve(estimate.P[:2, :2], away)))
    assert len(ratios) > 45
    assert max(ratios) < 6


@pytest.mark.parametrize("slow", further_slow([25, 50]))
def test_a_target_that_grows_while_an_edge_slowly_hides_a_part_of_it_is_off_by_no_more_than_its_sigmas_say(slow):
    """Its area stays as usual; what is left of it is flatter. A part that stays hidden shifts all pictures alike."""
    rng, found, centres = np.random.default_rng(8), [], []
    for k in range(80 + 2 * slow):
        centres.append(np.array([75.0 + 12 * np.sin(k / 11), 60.0 + 8 * np.sin(k / 14)]))
        radius, part = 6.0 * (1 + 0.003 * k), min(max(k - 35, 0) / slow, max(2 * slow + 55 - k, 0) / slow, 1.0)
        begin = radius * (1 - 0.8 * part)
        picture = disc_behind_an_edge(centres[-1], radius, (begin, begin + 100))
        noisy = np.clip(np.round(picture + 2 * rng.standard_normal(picture.shape)), 0, 255).astype(np.uint8)
        found.append(find_blobs(noisy, BlobParameters("darker")))
    ratios = []
    for estimate, centre in zip(track_point(steps(len(found)), found), centres, strict=True):
        if estimate.status is PoseStatus.MEASURED:
            away = estimate.x[:2] - centre
            ratios.append(np.sqrt(away @ np.linalg.solve(estimate.P[:2, :2], away)))
    assert len(ratios) > 45
    assert max(ratios) < 6
    assert np.sqrt(np.mean(np.square(ratios)) / 2) < 1.5


@pytest.mark.parametrize("fastest", [4.0, 15.0])
def test_a_target_whose_area_changes_as_it_starts_to_move_is_followed(fastest):
    rng, tracker, u, statuses = np.random.default_rng(3), PointTracker(), 100.0, []
    for k in range(100):
        u += min(0.2 * max(k - 60, 0), fastest)
        area = (230.0 if k > 60 else 200.0) * np.exp(0.02 * rng.standard_normal())
        found = replace(at((u + 0.006 * rng.standard_normal(), 200.0), flux=100.0 * area), peak=np.array([100.0]))
        statuses.append(tracker.step(1.0, found).status)
    assert set(statuses[60:]) == {PoseStatus.MEASURED}


def test_of_a_target_that_is_whole_one_area_in_twenty_is_unusual_and_the_others_have_the_sigmas_of_their_noise():
    rng, in_part, widths = np.random.default_rng(4), [], []
    for _ in range(15):
        tracker, path = PointTracker(FIXED), motion(rng, 150)
        for k, found in enumerate(seen(rng, path)):
            area = 200.0 * np.exp(0.02 * rng.standard_normal())
            estimate = tracker.step(1.0, replace(found, flux=np.array([100.0 * area]), peak=np.array([100.0])))
            if k >= 50:
                in_part.append(tracker.in_part)
                widths.append(np.sqrt(estimate.P[0, 0]))
    assert 0.03 < np.mean(in_part) < 0.065  # more than two sigmas of a normal distribution: .046
    assert np.mean(np.array(widths) > 1.1 * np.median(widths)) < 0.15


def test_a_target_that_came_nearer_while_it_was_hidden_is_soon_as_certain_as_before():
    tracker, sigmas = PointTracker(FIXED), []
    for k in range(120):
        found = replace(at((100.0 + k, 200.0), flux=100.0 * 200.0 * np.exp(0.006 * k)), peak=np.array([100.0]))
        sigmas.append(np.sqrt(tracker.step(1.0, at() if 50 <= k < 70 else found).P[0, 0]))
    assert max(sigmas[95:]) < 1.2 * max(sigmas[40:50])
