"""The search for first labels without a prior: completeness, independence of scale, ties, and false points."""

from __future__ import annotations

import time
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from geometry import rotations
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.pose_prior import PosePrior
from geometry.rig import Rig
from lab.simulate.scenarios import RIGS
from tests.geometry.scenes import random_pose, random_rig
from tests.marks import further_slow
from tests.tracking.labelling.test_first_labels import (
    NOISE_PX,
    Picture,
    photograph,
    pose_within,
    without_beam,
    wrong_labels,
)
from tracking.detections import Detections
from tracking.labelling.first_labels import NO_POINT, candidate_labellings, find_labels
from tracking.labelling.points import points_of
from tracking.labelling.search import TIMES, RigPlan, VisiblePoses, covering, plan_of
from tracking.parameters import LabelParameters

WIDE = PosePrior(Pose.identity(), 1.0, np.deg2rad(30))


def rates(rig: Rig, count: int, seed: int) -> tuple[float, float, float]:
    """Shares of right and wrong labellings, and of ties with the truth among the candidates, without a prior.

    20 % clutter, 5 false points per picture, 2 % misses, poses of 1 m and 30 deg, at least four spots found.
    """
    model, rng = SpotModel.of(rig), np.random.default_rng(seed)
    right = wrong = tied = done = 0
    while done < count:
        picture = photograph(model, pose_within(WIDE, rng), rng, found=0.98, clutter=0.2, false_points=5)
        if sum(np.count_nonzero(of >= 0) for of in picture.origin.values()) < 4:
            continue
        done += 1
        result = find_labels(rig, model, picture.detections)
        if result.chosen is not None:
            good = not wrong_labels(result, model, picture)
            right, wrong = right + good, wrong + (not good)
        tied += any(
            not wrong_labels(replace(result, chosen=c), model, picture) for c in result.candidates if result.tie
        )
    return right / count, wrong / count, tied / count


# -- without a prior --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", further_slow(["unequal-fan", "four-skew-beams"]))
def test_labels_are_right_without_a_prior_among_clutter(name):
    """30 poses: two may stay unlabelled (four spots of two beams are a tie), none may be wrong."""
    right, wrong, _ = rates(RIGS[name](), 30, seed=1)
    assert right >= 28 / 30
    assert wrong == 0


@pytest.mark.slow
@pytest.mark.parametrize("name", ["unequal-fan", "four-skew-beams"])
def test_labels_are_right_without_a_prior_among_clutter_over_hundreds_of_poses(name):
    """Two beams of the fan coincide after half a turn: without the third beam the labels are a tie."""
    right, wrong, tied = rates(RIGS[name](), 600, seed=2)
    assert right >= (0.955 if name == "unequal-fan" else 0.98)
    assert right + tied >= 0.985
    assert wrong <= 0.005


def test_random_arrangements_of_screens_cameras_and_lenses_need_no_prior():
    """Tilted screens, two cameras on one of them, half of the cameras behind their screens (rear projection)."""
    done = 0
    for seed in range(8):
        rng = np.random.default_rng(seed)
        rig = random_rig(rng)
        model = SpotModel.of(rig)
        for _ in range(50):
            pose = random_pose(rng, 0.5, 0.4)
            seen = model.in_picture(model.project(pose)[0])
            if len(set(model.spot_of[seen])) >= 5:
                break
        else:
            continue
        picture = photograph(model, pose, rng, false_points=2)
        result = find_labels(rig, model, picture.detections)
        assert result.chosen is not None
        assert wrong_labels(result, model, picture) == []
        assert np.abs(result.chosen.fit.world_from_body.minus(pose)).max() < 0.1
        done += 1
    assert done >= 6


def test_a_prior_that_allows_all_poses_has_no_effect():
    rig = RIGS["four-skew-beams"]()
    model, rng = SpotModel.of(rig), np.random.default_rng(3)
    picture = photograph(model, pose_within(WIDE, rng), rng, false_points=4)
    without = candidate_labellings(rig, model, picture.detections)
    everywhere = candidate_labellings(rig, model, picture.detections, PosePrior.everywhere(rig))
    wider = replace(PosePrior.everywhere(rig), within_m=8.0)
    widest = candidate_labellings(rig, model, picture.detections, wider)
    for other in (everywhere, widest):
        np.testing.assert_array_equal(without[0].point_of, other[0].point_of)
        assert other[0].score == pytest.approx(without[0].score, abs=1e-6)


@pytest.mark.parametrize("scale", [0.25, 5.0])
def test_the_size_of_the_pixels_does_not_change_the_labels(scale):
    """A lens of 300 or 6000 px, with noise and picture in proportion: the same labels with the same evidence."""
    rig = RIGS["unequal-fan"]()
    rng = np.random.default_rng(4)
    model = SpotModel.of(rig)
    picture = photograph(model, pose_within(WIDE, rng), rng, false_points=3)
    cameras = {}
    for name, c in rig.cameras.items():
        matrix = np.array(c.matrix)
        matrix[:2] *= scale
        matrix[:2, 2] += 0.5 * scale - 0.5
        cameras[name] = replace(c, matrix=matrix, image_size_px=tuple(int(scale * n) for n in c.image_size_px))
    other = replace(rig, cameras=cameras)
    found = {
        n: Detections.at(scale * (d.uv_px + 0.5) - 0.5, scale**2 * d.cov_px2) for n, d in picture.detections.items()
    }
    p = LabelParameters()
    q = replace(p, model_sigma_px=scale * p.model_sigma_px, clutter_per_px2=p.clutter_per_px2 / scale**2)
    one = candidate_labellings(rig, model, picture.detections, None, p)[0]
    same = candidate_labellings(other, SpotModel.of(other), found, None, q)[0]
    np.testing.assert_array_equal(one.point_of, same.point_of)
    assert same.score == pytest.approx(one.score, abs=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("name", RIGS)
def test_a_search_without_a_prior_takes_less_than_three_seconds(name):
    rig = RIGS[name]()
    model, rng = SpotModel.of(rig), np.random.default_rng(5)
    find_labels(rig, model, photograph(model, Pose.identity(), rng).detections)
    for _ in range(5):
        picture = photograph(model, pose_within(WIDE, rng), rng, clutter=0.2, false_points=5)
        before = time.process_time()
        find_labels(rig, model, picture.detections)
        assert time.process_time() - before < 3.0


# -- ties and candidates ----------------------------------------------------------------------------------------------


def test_half_a_turn_of_a_fan_of_equal_angles_is_a_tie_that_no_spot_resolves():
    rig = RIGS["fan"]()
    model, rng = SpotModel.of(rig), np.random.default_rng(6)
    picture = photograph(model, Pose.identity(), rng)
    result = find_labels(rig, model, picture.detections)
    assert result.tie
    assert any(np.abs(c.fit.world_from_body.minus(Pose.identity())).max() < 0.01 for c in result.candidates)
    text = result.in_words(model)
    assert "no spot of this rig" in text
    assert "0.000 m and 180.0 deg apart, so within_deg below 90.0" in text
    assert find_labels(rig, model, picture.detections, WIDE).chosen is not None  # a prior below 90 deg resolves it


def test_a_tie_names_the_spots_that_would_resolve_it():
    """Beams A and B of a fan of equal angles coincide with B and C in another pose: the third beam decides."""
    rig = RIGS["fan"]()
    model, rng = SpotModel.of(rig), np.random.default_rng(7)
    pose = Pose.from_ypr(np.deg2rad([12.0, 0, 0]), np.zeros(3))
    picture = photograph(model, pose, rng, hidden=("3", "6"))
    result = find_labels(rig, model, picture.detections, WIDE)
    assert result.tie
    text = result.in_words(model)
    assert text.count(" at x ") == len(result.candidates) == 2
    assert "where only the first expects one" in text
    assert "where only the second expects one" in text
    assert "spot 3 at (" in text  # hidden, of the true pose
    assert "within_deg below 10.0" in text


def test_candidates_are_sorted_by_score_and_include_the_truth():
    rig = without_beam(RIGS["fan"](), "B")
    model, rng = SpotModel.of(rig), np.random.default_rng(8)
    picture = photograph(model, Pose.identity(), rng, false_points=2)
    candidates = candidate_labellings(rig, model, picture.detections)
    scores = [c.score for c in candidates]
    assert scores == sorted(scores, reverse=True)
    assert scores[0] - scores[1] < 0.1  # two beams swapped
    near = [np.abs(c.fit.world_from_body.minus(Pose.identity())).max() < 0.02 for c in candidates[:2]]
    assert sum(near) == 1
    assert len(candidate_labellings(rig, model, picture.detections, most=1)) == 1
    for c in candidates:
        np.testing.assert_array_equal(np.flatnonzero(c.point_of != NO_POINT), c.fit.rows)


def test_pictures_without_any_point_have_no_labelling():
    rig = RIGS["unequal-fan"]()
    assert candidate_labellings(rig, SpotModel.of(rig), dict.fromkeys(rig.cameras, Detections.none())) == []


def test_no_two_spots_share_a_point():
    rig = RIGS["four-skew-beams"]()
    model, rng = SpotModel.of(rig), np.random.default_rng(9)
    for _ in range(3):
        picture = photograph(model, pose_within(WIDE, rng), rng, found=0.7, clutter=0.3, false_points=3)
        for one in candidate_labellings(rig, model, picture.detections):
            for c in range(2):
                taken = one.point_of[(model.camera_of == c) & (one.point_of != NO_POINT)]
                assert len(set(taken)) == len(taken)


@pytest.mark.parametrize("shift_px", [0.8, 1.4, 4.0])
def test_a_merged_spot_gets_no_label_and_the_others_are_right(shift_px):
    """Points of 0.01 px, one of which, merged with a neighbour, is off by many times its sigma of 0.1 px."""
    rig = RIGS["fan"]()
    model, rng = SpotModel.of(rig), np.random.default_rng(18)
    for _ in range(5):
        pose = pose_within(PosePrior(Pose.identity(), 0.3, 0.2), rng)
        picture = photograph(model, pose, rng)
        uv, merged = model.project(pose)[0], 1
        for name in model.camera_names:
            views = picture.origin[name]
            points = uv[views] + rng.normal(0, 0.01, (len(views), 2))
            sigma = np.where(views == merged, 0.1, 0.01)
            points[views == merged] += shift_px * np.array([0.6, -0.8])
            picture.detections[name] = Detections.at(points, sigma[:, None, None] ** 2 * np.eye(2))
        result = find_labels(rig, model, picture.detections, WIDE)
        assert result.chosen is not None
        assert wrong_labels(result, model, picture) == []
        others = np.array([v != merged for v in range(6)]) & model.in_picture(uv)
        assert (result.chosen.point_of[others] != NO_POINT).all()
        assert result.chosen.point_of[merged] == NO_POINT


# -- false points -----------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_false_points_alone_hardly_ever_give_a_pose_without_a_prior():
    """Eight false points per picture, 300 frames: the threshold allows exp(-2), 0.5 % were measured."""
    rig = RIGS["unequal-fan"]()
    model, rng = SpotModel.of(rig), np.random.default_rng(10)
    chosen = 0
    for _ in range(300):
        picture = photograph(model, Pose.identity(), rng, hidden=tuple(rig.spots), false_points=8)
        chosen += find_labels(rig, model, picture.detections).chosen is not None
    assert chosen <= 5


def test_a_second_camera_that_sees_the_same_false_lights_adds_no_evidence():
    """Lights on the screens that fit four spots by chance, seen by two cameras each."""
    rig = RIGS["two-cameras-per-screen"]()
    model, rng = SpotModel.of(rig), np.random.default_rng(11)
    uv = model.project(Pose.identity())[0]
    four = {"1", "2", "4", "5"}
    found = {}
    for c, name in enumerate(model.camera_names):
        rows = [v for v in np.flatnonzero(model.camera_of == c) if model.views[v][1] in four]
        points = uv[rows] + rng.normal(0, NOISE_PX, (len(rows), 2))
        found[name] = Detections.at(points, np.tile(NOISE_PX**2 * np.eye(2), (len(rows), 1, 1)))
    one_each = {n: d for n, d in found.items() if n.endswith("-a")}
    both = candidate_labellings(rig, model, found, WIDE)[0]
    one = candidate_labellings(rig, model, one_each, WIDE)[0]
    # Four more points at 10 nats each would add 40; only the more accurate pose adds evidence.
    assert both.score < one.score + 8.0


def test_the_covariance_of_the_best_candidate_is_correct():
    rig = RIGS["unequal-fan"]()
    model, rng = SpotModel.of(rig), np.random.default_rng(12)
    squares = []
    for _ in range(40):
        pose = pose_within(PosePrior(Pose.identity(), 0.3, 0.3), rng)
        picture = photograph(model, pose, rng)
        best = candidate_labellings(rig, model, picture.detections)[0]
        error = pose.minus(best.fit.world_from_body)
        squares.append(error @ np.linalg.solve(best.fit.covariance, error) / 6)
    assert 0.6 < np.mean(squares) < 1.4  # the mean of 40 has a sigma of 0.09; the evidence may add 0.03 px


# -- the steps --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", RIGS)
def test_the_widest_prior_contains_all_poses_in_the_lab(name):
    rig = RIGS[name]()
    everywhere, rng = PosePrior.everywhere(rig), np.random.default_rng(13)
    poses = Pose(rotations.exp(rng.normal(0, 2, (500, 3))), rng.uniform([-2.5, -2, -2], [2.5, 2, 2], (500, 3)))
    assert everywhere.contains(poses).all()


def test_the_volume_of_the_visible_poses_agrees_with_a_count():
    """Two methods: weighted poses from random pixels, and the share of uniformly drawn poses that show enough spots."""
    rig = RIGS["four-skew-beams"]()
    model, everywhere, rng = SpotModel.of(rig), PosePrior.everywhere(rig), np.random.default_rng(14)
    count = 60_000
    axis = rng.normal(size=(count, 4))  # a uniform quaternion
    shift = rng.uniform(-1, 1, (count, 3)) * everywhere.within_m
    poses = Pose.from_quaternion(
        axis / np.linalg.norm(axis, axis=1, keepdims=True), everywhere.centre.translation + shift
    )
    share = np.mean(model.in_picture(model.project(poses)[0]).sum(axis=1) >= 4)
    visible = VisiblePoses.of(rig, model, everywhere, 4)
    expected = 3 * np.log(2 * everywhere.within_m) + np.log(8 * np.pi**2) + np.log(share)
    assert visible.log_volume == pytest.approx(expected, abs=0.25)  # 5 % from the count, 10 to 20 % from the sample
    assert model.in_picture(model.project(visible.typical)[0]).all()


def test_further_cameras_at_the_same_places_show_no_further_poses():
    """Neither of both screens, nor of one of them, whose spots are then seen twice."""
    rig = RIGS["four-skew-beams"]()
    everywhere, first = PosePrior.everywhere(rig), next(iter(rig.cameras))
    volumes = []
    for again in ((), (first,), tuple(rig.cameras)):
        cameras = {**rig.cameras, **{f"{n} 2": replace(rig.cameras[n], name=f"{n} 2") for n in again}}
        several = replace(rig, cameras=cameras)
        volumes.append(VisiblePoses.of(several, SpotModel.of(several), everywhere, 4).log_volume)
    assert volumes == pytest.approx(volumes[:1] * 3, abs=1.2)  # samples scatter by .4; views not counted: 2 and more


@pytest.mark.parametrize("name", ["unequal-fan", "four-skew-beams"])
def test_any_four_spots_contain_triples_and_larger_sets_are_covered_first(name):
    rig = RIGS[name]()
    model = SpotModel.of(rig)
    plan = RigPlan.of(rig, model, 4)
    good = VisiblePoses.of(rig, model, plan.everywhere, 4).triples
    spots = range(len(rig.spots))
    for size, end in plan.stages.items():
        triples = [frozenset(t) for t in plan.triples[:end].tolist()]
        for visible in combinations(spots, size):
            possible = sum(set(t) <= set(visible) for t in good)
            assert sum(t <= set(visible) for t in triples) >= min(TIMES, possible)
    assert list(plan.stages) == sorted(plan.stages, reverse=True)
    assert len(plan.triples) <= len(list(combinations(spots, 3)))


def test_collinear_spots_of_a_fan_are_not_a_triple():
    rig = RIGS["fan"]()
    visible = VisiblePoses.of(rig, SpotModel.of(rig), PosePrior.everywhere(rig), 4)
    assert (0, 1, 2) not in visible.triples
    assert (3, 4, 5) not in visible.triples
    assert len(visible.triples) == 18
    assert len(covering({}, range(6), 4)[0]) == 0


def test_a_ray_reaches_every_place_that_it_lights_from_some_pose_of_the_prior():
    rng = np.random.default_rng(15)
    for _ in range(200):
        prior = PosePrior(random_pose(rng), rng.uniform(0, 1), rng.uniform(0.01, np.pi))
        point, ray = rng.normal(0, 0.3, 3), rotations.exp(rng.normal(0, 2, 3))[0]
        axis = rng.normal(size=3)
        turn = rotations.exp(axis / np.linalg.norm(axis) * prior.within_rad * rng.random())
        pose = Pose(prior.centre.rotation @ turn, prior.centre.translation + rng.uniform(-1, 1, 3) * prior.within_m)
        place = pose.apply(point + rng.uniform(0.1, 5) * ray)
        assert prior.reaches(point, ray, place[None]).all()
    narrow = PosePrior(Pose.identity(), 0.1, 0.05)
    assert not narrow.reaches(np.zeros(3), np.array([1.0, 0, 0]), np.array([[2.5, 1.0, 0]])).any()


def test_points_on_a_curved_screen_agree_with_the_forward_model():
    flat = RIGS["unequal-fan"]()
    rig = replace(flat, screens={n: replace(s, bow=(0.01, 0.004, -0.008)) for n, s in flat.screens.items()})
    model = SpotModel.of(rig)
    pose = Pose.from_ypr(np.array([0.05, 0.02, 0.0]), np.array([0.1, 0.1, 0.0]))
    uv, hits = model.project(pose)[0], model.hits(pose)
    found = {n: Detections.at(uv[model.camera_of == c], np.tile(0.01 * np.eye(2), (3, 1, 1)))
             for c, n in enumerate(model.camera_names)}  # fmt: skip
    points = points_of(rig, model, found, LabelParameters(), lambda _, places: np.isfinite(places[:, 0]))
    np.testing.assert_allclose(points.world, hits, atol=1e-6)
    picture = Picture(found, {n: np.flatnonzero(model.camera_of == c) for c, n in enumerate(model.camera_names)})

    result = find_labels(rig, model, picture.detections)
    assert result.chosen is not None
    assert wrong_labels(result, model, picture) == []


def test_a_crowd_without_known_brightness_is_searched_within_the_budget():
    rig = RIGS["four-skew-beams"]()
    model, rng = SpotModel.of(rig), np.random.default_rng(17)
    picture = photograph(model, Pose.identity(), rng, false_points=25)
    few = LabelParameters(max_triples=2000)
    before = time.process_time()
    find_labels(rig, model, picture.detections, WIDE, few)
    assert time.process_time() - before < 2.0
    # The spots are brighter than all false points.
    for name, d in picture.detections.items():
        flux = np.where(picture.origin[name] >= 0, 1000.0, 10.0) * rng.uniform(0.8, 1.2, len(d))
        picture.detections[name] = replace(d, flux=flux)
    result = find_labels(rig, model, picture.detections, WIDE, few)
    assert result.chosen is not None
    assert wrong_labels(result, model, picture) == []


def test_a_narrow_prior_finds_the_vehicle_among_hundreds_of_points_of_unknown_brightness():
    """Only points that a spot may light under the prior count, and few of the false points do."""
    rig = RIGS["four-skew-beams"]()
    model, rng = SpotModel.of(rig), np.random.default_rng(19)
    for _ in range(3):
        picture = photograph(model, Pose.identity(), rng, false_points=200)
        result = find_labels(rig, model, picture.detections, PosePrior(Pose.identity(), 0.05, np.deg2rad(2)))
        assert result.chosen is not None
        assert wrong_labels(result, model, picture) == []
    result = find_labels(rig, model, picture.detections, WIDE)
    assert result.chosen is None
    assert "without a flux that shows which may be spots" in result.reason


def test_spots_that_are_fainter_than_all_false_points_are_found():
    """Bright reflections in number: the brightest points alone contain no spot of the vehicle."""
    rig = RIGS["four-skew-beams"]()
    model, rng = SpotModel.of(rig), np.random.default_rng(21)
    for _ in range(6):
        picture = photograph(model, pose_within(WIDE, rng), rng, false_points=18)
        detections = {
            name: replace(found, flux=np.where(picture.origin[name] >= 0, 1e3, rng.uniform(1e4, 1e6, len(found))))
            for name, found in picture.detections.items()
        }
        if sum(np.count_nonzero(of >= 0) for of in picture.origin.values()) < 6:
            continue
        result = find_labels(rig, model, detections, WIDE)
        assert result.chosen is not None
        assert wrong_labels(result, model, picture) == []
        assert np.count_nonzero(result.chosen.point_of != NO_POINT) >= 6


def test_equal_rigs_share_their_plan_and_a_rig_that_differs_in_a_digit_has_its_own():
    rig = RIGS["fan"]()
    camera = next(iter(rig.cameras.values()))
    other = replace(rig, cameras={**rig.cameras, camera.name: replace(camera, matrix=camera.matrix * (1 + 1e-15))})
    plan, same, own = (plan_of(r, SpotModel.of(r), 3) for r in (rig, RIGS["fan"](), other))
    assert same is plan
    assert own is not plan
    assert plan_of(rig, SpotModel.of(rig), 4) is not plan
