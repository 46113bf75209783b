"""First labels: right with a wide prior or none, a tie if two poses fit equally well, none if no pose fits."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.pose_prior import PosePrior
from geometry.rig import Beam, Rig
from lab.simulate.scenarios import RIGS
from tracking.detections import Detections
from tracking.labelling.first_labels import NO_POINT, FirstLabels, find_labels
from tracking.parameters import LabelParameters

NOISE_PX = 0.1
FALSE = -1
WIDE = PosePrior(Pose.identity(), 1.0, np.deg2rad(30))


def pose_within(prior: PosePrior, rng: np.random.Generator) -> Pose:
    """A random pose, uniform in the cube of positions and in the ball of rotation vectors."""
    axis = rng.normal(size=3)
    rotation_vector = prior.within_rad * rng.random() ** (1 / 3) * axis / np.linalg.norm(axis)
    R = prior.centre.rotation @ Rotation.from_rotvec(rotation_vector).as_matrix()
    return Pose(R, prior.centre.translation + rng.uniform(-prior.within_m, prior.within_m, 3))


@dataclass(frozen=True)
class Picture:
    """The detections of one frame, and the view that each point comes from (FALSE: none)."""

    detections: dict[str, Detections]
    origin: dict[str, np.ndarray]


def photograph(
    model: SpotModel,
    pose: Pose,
    rng: np.random.Generator,
    *,
    found: float = 1.0,
    clutter: float = 0.0,
    false_points: int = 0,
    hidden: tuple[str, ...] = (),
) -> Picture:
    """The spots in the picture with noise; near each, with probability `clutter`, a false point within 15 px."""
    uv = model.project(pose)[0]
    visible = model.in_picture(uv)
    detections, origin = {}, {}
    for c, name in enumerate(model.camera_names):
        points, of = [], []
        for v in np.flatnonzero((model.camera_of == c) & visible):
            if rng.random() < found and model.views[v][1] not in hidden:
                points.append(uv[v] + rng.normal(0, NOISE_PX, 2))
                of.append(v)
            if rng.random() < clutter:
                angle, gap = rng.uniform(0, 2 * np.pi), 15 * np.sqrt(rng.random())
                points.append(uv[v] + gap * np.array([np.cos(angle), np.sin(angle)]))
                of.append(FALSE)
        size = model.image_size_px[model.camera_of == c][0]
        for _ in range(false_points):
            points.append(rng.uniform([0, 0], size - 1))
            of.append(FALSE)
        order = rng.permutation(len(points))
        covariance = np.tile(NOISE_PX**2 * np.eye(2), (len(points), 1, 1))
        detections[name] = Detections.at(np.array(points).reshape(-1, 2)[order], covariance)
        origin[name] = np.array(of, dtype=int)[order]
    return Picture(detections, origin)


def wrong_labels(result: FirstLabels, model: SpotModel, picture: Picture) -> list[str]:
    """The spots with a wrong label."""
    assert result.chosen is not None
    return [
        model.views[v][1]
        for v in np.flatnonzero(result.chosen.point_of != NO_POINT)
        if picture.origin[model.views[v][0]][result.chosen.point_of[v]] != v
    ]


def rates(rig: Rig, count: int, seed: int, least_visible: int = 4) -> tuple[float, float]:
    """Shares of right and wrong labellings.

    20 % clutter, 5 false points per picture, 2 % misses, prior of 1 m and 30 deg.
    """
    model, rng = SpotModel.of(rig), np.random.default_rng(seed)
    right = wrong = done = 0
    while done < count:
        pose = pose_within(WIDE, rng)
        if model.in_picture(model.project(pose)[0]).sum() < least_visible:
            continue
        done += 1
        picture = photograph(model, pose, rng, found=0.98, clutter=0.2, false_points=5)
        result = find_labels(rig, model, picture.detections, WIDE)
        if result.chosen is not None:
            good = not wrong_labels(result, model, picture)
            right, wrong = right + good, wrong + (not good)
    return right / count, wrong / count


@pytest.mark.parametrize("name", ["fan", "four-skew-beams"])
def test_labels_are_right_from_a_wide_prior_among_clutter(name):
    """20 poses: one may stay unlabelled, none may be wrong."""
    right, wrong = rates(RIGS[name](), 20, seed=1)
    assert right >= 0.95
    assert wrong == 0


@pytest.mark.slow
@pytest.mark.parametrize(("name", "poses"), [("fan", 400), ("four-skew-beams", 150)])
def test_labels_are_right_from_a_wide_prior_among_clutter_over_hundreds_of_poses(name, poses):
    right, wrong = rates(RIGS[name](), poses, seed=2)
    assert right >= 0.97
    assert wrong <= 0.01


@pytest.mark.parametrize("name", RIGS)
def test_without_clutter_all_spots_are_labelled_and_the_pose_is_found(name):
    rig = RIGS[name]()
    model, rng = SpotModel.of(rig), np.random.default_rng(3)
    prior = PosePrior(Pose.identity(), 0.3, np.deg2rad(15))
    for _ in range(4):
        pose = pose_within(prior, rng)
        picture = photograph(model, pose, rng)
        result = find_labels(rig, model, picture.detections, prior)
        assert result.chosen is not None
        assert result.reason == ""
        assert not result.tie
        assert wrong_labels(result, model, picture) == []
        visible = model.in_picture(model.project(pose)[0])
        np.testing.assert_array_equal(result.chosen.point_of != NO_POINT, visible)
        # The sigmas include the model error of 0.3 px, which this simulation does not have.
        assert np.all(np.abs(result.chosen.fit.world_from_body.minus(pose)) < 0.01)


def test_the_centre_of_the_prior_may_be_any_pose():
    """A prior rotated by 120 deg about a skew axis, and shifted."""
    rig = RIGS["fan"]()
    turn = Pose(Rotation.from_rotvec([1.2, 1.2, 1.2]).as_matrix(), np.array([0.4, -0.3, 0.2]))
    beams = {
        n: Beam(n, turn.rotation.T @ b.direction, -turn.rotation.T @ turn.translation) for n, b in rig.beams.items()
    }
    rig = replace(rig, beams=beams)
    model, rng = SpotModel.of(rig), np.random.default_rng(4)
    prior = PosePrior(turn, 0.3, np.deg2rad(15))
    for _ in range(3):
        pose = pose_within(prior, rng)
        picture = photograph(model, pose, rng, clutter=0.2)
        result = find_labels(rig, model, picture.detections, prior)
        assert result.chosen is not None
        assert wrong_labels(result, model, picture) == []


@pytest.mark.parametrize("hidden", ["1", "5", "6"])
def test_a_hidden_spot_gets_no_label(hidden):
    rig = RIGS["fan"]()
    model, rng = SpotModel.of(rig), np.random.default_rng(5)
    prior = PosePrior(Pose.identity(), 0.3, np.deg2rad(10))
    picture = photograph(model, pose_within(prior, rng), rng, hidden=(hidden,))
    result = find_labels(rig, model, picture.detections, prior)
    assert result.chosen is not None
    assert wrong_labels(result, model, picture) == []
    assert [s for (_, s), p in zip(model.views, result.chosen.point_of, strict=True) if p == NO_POINT] == [hidden]


def test_a_false_point_beside_a_hidden_spot_does_not_get_its_label():
    rig = RIGS["fan"]()
    model, rng = SpotModel.of(rig), np.random.default_rng(6)
    pose = Pose.identity()
    picture = photograph(model, pose, rng, hidden=("2",))
    beside = model.project(pose)[0][1] + [5.0, -4.0]
    left = picture.detections["left"]
    picture.detections["left"] = Detections.at(
        np.vstack([left.uv_px, beside]), np.tile(NOISE_PX**2 * np.eye(2), (len(left) + 1, 1, 1))
    )
    result = find_labels(rig, model, picture.detections, PosePrior(pose, 0.2, np.deg2rad(10)))
    assert result.chosen is not None
    assert result.chosen.point_of[1] == NO_POINT


def without_beam(rig: Rig, beam: str) -> Rig:
    return replace(rig, beams={n: b for n, b in rig.beams.items() if n != beam},
                   spots={n: s for n, s in rig.spots.items() if s.beam != beam})  # fmt: skip


def test_two_exchangeable_beams_give_a_tie_with_both_candidates():
    """A rig of two beams: half a turn about the line between them swaps their spots and fits equally well."""
    rig = without_beam(RIGS["fan"](), "B")
    model, rng = SpotModel.of(rig), np.random.default_rng(7)
    picture = photograph(model, Pose.identity(), rng)
    result = find_labels(rig, model, picture.detections, PosePrior(Pose.identity(), 0.5, np.pi))
    assert result.chosen is None
    assert result.tie
    assert len(result.candidates) >= 2
    assert "equally well" in result.reason
    one, other = result.candidates[:2]
    difference = one.fit.world_from_body.minus(other.fit.world_from_body)
    assert np.linalg.norm(difference[3:]) == pytest.approx(np.pi, abs=0.02)
    # The same four points with swapped labels.
    for camera in range(2):
        rows = model.camera_of == camera
        assert sorted(one.point_of[rows]) == sorted(other.point_of[rows])
        assert list(one.point_of[rows]) == list(other.point_of[rows])[::-1]


@pytest.mark.parametrize(
    ("rig_name", "yaw_deg", "p_detect", "hidden", "tie"),
    [
        ("fan", 24, 0.95, (), False),  # C is out of the picture; in the rotated pose A would be in it, but is not found
        ("fan", 24, 0.5, (), True),  # ... which is weak evidence if every second spot is missed
        ("fan", 12, 0.95, ("3", "6"), True),  # C is hidden: one beam is missing in both poses
        ("unequal-fan", 12, 0.95, ("3", "6"), False),  # 18 and 23 deg: the angle distinguishes the poses
    ],
)
def test_with_equal_angles_only_the_third_beam_distinguishes_the_other_two(rig_name, yaw_deg, p_detect, hidden, tie):
    """Rotated back by 20 deg, beams A and B coincide with beams B and C."""
    rig = RIGS[rig_name]()
    model = SpotModel.of(rig)
    pose = Pose.from_ypr(np.deg2rad([yaw_deg, 0, 0]), np.zeros(3))
    picture = photograph(model, pose, np.random.default_rng(8), hidden=hidden)
    assert sum(len(d) for d in picture.detections.values()) == 4
    prior = PosePrior(Pose.identity(), 0.5, np.deg2rad(30))
    result = find_labels(rig, model, picture.detections, prior, LabelParameters(p_detect=p_detect))
    assert result.tie == tie
    if tie:
        one, other = (c.fit.world_from_body.minus(pose) for c in result.candidates[:2])
        turns = sorted(np.rad2deg([np.linalg.norm(one[3:]), np.linalg.norm(other[3:])]))
        np.testing.assert_allclose(turns, [0, 20], atol=0.5)
    else:
        assert wrong_labels(result, model, picture) == []


def test_two_beams_of_unequal_angles_give_no_tie_within_the_prior():
    rig = without_beam(RIGS["fan"](), "B")
    model, rng = SpotModel.of(rig), np.random.default_rng(9)
    picture = photograph(model, Pose.identity(), rng)
    result = find_labels(rig, model, picture.detections, PosePrior(Pose.identity(), 0.5, np.deg2rad(30)))
    assert result.chosen is not None
    assert wrong_labels(result, model, picture) == []


@pytest.mark.parametrize("points", [0, 1, 3])
def test_too_few_points_are_reported(points):
    rig = RIGS["fan"]()
    model = SpotModel.of(rig)
    uv = model.project(Pose.identity())[0][:points]
    picture = {"left": Detections.at(uv, np.tile(0.01 * np.eye(2), (points, 1, 1))), "right": Detections.none()}
    result = find_labels(rig, model, picture, WIDE)
    assert result.chosen is None
    assert not result.tie
    assert result.reason == f"only {points} points of light, at least 4 needed"


def test_without_pictures_there_are_no_labels():
    rig = RIGS["fan"]()
    result = find_labels(rig, SpotModel.of(rig), {}, WIDE)
    assert result.chosen is None


@pytest.mark.parametrize("name", ["fan", "four-skew-beams"])
def test_false_points_alone_give_no_pose(name):
    """Six false points per picture, five frames."""
    rig = RIGS[name]()
    model, rng = SpotModel.of(rig), np.random.default_rng(10)
    everything = tuple(rig.spots)
    for _ in range(5):
        picture = photograph(model, Pose.identity(), rng, hidden=everything, false_points=6)
        assert find_labels(rig, model, picture.detections, WIDE).chosen is None


def with_shapes(picture: Picture, rng: np.random.Generator, clear_objects: float) -> dict[str, Detections]:
    """The detections with shapes: nine of ten spots are clear, and this share of the false points."""
    out = {}
    for name, found in picture.detections.items():
        clear = rng.random(len(found)) < np.where(picture.origin[name] == FALSE, clear_objects, 0.9)
        round_px = np.ones(len(found))
        shape = np.where(clear, 0.01, 0.2)
        out[name] = replace(found, unexplained=shape, major_px=round_px, minor_px=round_px)
    return out


def test_four_spots_that_anyone_distinguishes_from_objects_are_labelled():
    """Among 15 other points per picture: by their places alone, about half of such vehicles are found."""
    rig = RIGS["fan"]()
    model, rng = SpotModel.of(rig), np.random.default_rng(17)
    near, right = PosePrior(Pose.identity(), 0.5, np.deg2rad(25)), 0
    for _ in range(6):
        pose = pose_within(near, rng)
        while np.count_nonzero(seen := model.in_picture(model.project(pose)[0])) < 4:
            pose = pose_within(near, rng)
        others = tuple(model.views[v][1] for v in np.flatnonzero(seen)[4:])
        picture = photograph(model, pose, rng, false_points=15, hidden=others)
        result = find_labels(rig, model, with_shapes(picture, rng, 0.03), near, LabelParameters(max_points=60))
        right += result.chosen is not None and not wrong_labels(result, model, picture)
    assert right >= 5


@pytest.mark.parametrize("clear_objects", [0.1, 1.0])
def test_clear_points_alone_give_no_pose(clear_objects):
    """A lamp among objects, or nothing but lamps: twelve points per picture, five frames."""
    rig = RIGS["fan"]()
    model, rng = SpotModel.of(rig), np.random.default_rng(18)
    for _ in range(5):
        picture = photograph(model, Pose.identity(), rng, hidden=tuple(rig.spots), false_points=12)
        assert find_labels(rig, model, with_shapes(picture, rng, clear_objects), WIDE).chosen is None


@pytest.mark.slow
def test_false_points_alone_hardly_ever_give_a_pose():
    """Eight false points per picture, sixty frames."""
    rig = RIGS["fan"]()
    model, rng = SpotModel.of(rig), np.random.default_rng(16)
    chosen = 0
    for _ in range(60):
        picture = photograph(model, Pose.identity(), rng, hidden=tuple(rig.spots), false_points=8)
        chosen += find_labels(rig, model, picture.detections, WIDE).chosen is not None
    assert chosen <= 1


def test_a_vehicle_outside_the_prior_is_not_found():
    rig = RIGS["fan"]()
    model, rng = SpotModel.of(rig), np.random.default_rng(11)
    pose = Pose.from_ypr(np.deg2rad([8.0, 5.0, 0.0]), np.array([0.0, 0.3, 0.1]))
    picture = photograph(model, pose, rng)
    here = PosePrior(pose, 0.1, np.deg2rad(5))
    assert find_labels(rig, model, picture.detections, here).chosen is not None
    for prior in (
        PosePrior(Pose.identity(), 0.1, np.deg2rad(20)),
        PosePrior(pose.plus([0, 0, 0, 0, 0, 0.2]), 0.4, 0.1),
    ):
        result = find_labels(rig, model, picture.detections, prior)
        assert result.chosen is None
        assert result.reason


def test_the_prior_is_a_cube_and_a_cone():
    prior = PosePrior(Pose.from_ypr(np.array([0.3, 0, 0]), np.array([1.0, 2, 3])), 0.5, np.deg2rad(20))

    def at(shift, angle_deg):
        rotation_vector = np.deg2rad(angle_deg) * np.array([0.6, 0, 0.8])
        return prior.centre.plus(np.concatenate([shift, rotation_vector]))

    assert prior.contains(at([0.5, -0.5, 0.5], 20))
    assert not prior.contains(at([0.53, 0, 0], 0))
    assert not prior.contains(at([0, 0, -0.53], 0))
    assert not prior.contains(at([0, 0, 0], 21))
    everywhere = PosePrior(prior.centre, 0.5, np.pi)
    assert everywhere.contains(at([0, 0, 0], 180))
    invalid = Pose(np.full((3, 3), np.nan), np.zeros(3))
    assert not prior.contains(invalid)
    both = Pose(np.stack([prior.centre.rotation, invalid.rotation]), np.stack([prior.centre.translation] * 2))
    np.testing.assert_array_equal(prior.contains(both), [True, False])


def test_a_camera_without_a_picture_is_no_evidence_against_its_spots():
    """Three of four cameras give the labels; the views of the fourth stay unlabelled and are not expected."""
    rig = RIGS["two-cameras-per-screen"]()
    model, rng = SpotModel.of(rig), np.random.default_rng(12)
    picture = photograph(model, Pose.identity(), rng)
    del picture.detections["left-b"]
    result = find_labels(rig, model, picture.detections, PosePrior(Pose.identity(), 0.3, np.deg2rad(10)))
    assert result.chosen is not None
    assert wrong_labels(result, model, picture) == []
    without_picture = np.array([c == "left-b" for c, _ in model.views])
    assert np.all(result.chosen.point_of[without_picture] == NO_POINT)
    assert np.all(result.chosen.point_of[~without_picture] != NO_POINT)


@pytest.mark.parametrize("hidden", [(), ("1",), ("5",), ("3", "6"), ("1", "4"), ("2", "6")])
def test_opposed_lasers_that_are_not_collinear_are_labelled_from_three_spots(hidden):
    """Six beams with one spot each: no beam has two spots."""
    fan, rng = RIGS["fan"](), np.random.default_rng(13)
    beams, spots = {}, {}
    for name, spot in fan.spots.items():
        whole = fan.beams[spot.beam]
        beams[name] = Beam(name, spot.sign * whole.direction + rng.normal(0, 2e-3, 3), rng.normal(0, 2e-3, 3))
        spots[name] = replace(spot, beam=name, sign=1)
    rig = replace(fan, beams=beams, spots=spots)
    model = SpotModel.of(rig)
    prior = PosePrior(Pose.identity(), 0.3, np.deg2rad(10))
    for _ in range(5):
        picture = photograph(model, pose_within(prior, rng), rng, hidden=hidden, clutter=0.2, false_points=2)
        result = find_labels(rig, model, picture.detections, prior)
        assert result.chosen is not None
        assert wrong_labels(result, model, picture) == []


def test_the_order_of_the_points_does_not_change_the_labels():
    rig = RIGS["fan"]()
    model, rng = SpotModel.of(rig), np.random.default_rng(14)
    for _ in range(3):
        picture = photograph(
            model, pose_within(PosePrior(Pose.identity(), 0.3, 0.3), rng), rng, clutter=0.3, false_points=3
        )
        one = find_labels(rig, model, picture.detections, WIDE)
        orders = {n: rng.permutation(len(d)) for n, d in picture.detections.items()}
        other = find_labels(rig, model, {n: d[orders[n]] for n, d in picture.detections.items()}, WIDE)
        assert (one.chosen is None) == (other.chosen is None)
        if one.chosen is None or other.chosen is None:
            continue
        for v, (camera, _) in enumerate(model.views):
            a, b = one.chosen.point_of[v], other.chosen.point_of[v]
            assert a == (NO_POINT if b == NO_POINT else orders[camera][b])


def test_the_detections_are_not_modified():
    rig = RIGS["fan"]()
    model, rng = SpotModel.of(rig), np.random.default_rng(15)
    picture = photograph(model, Pose.identity(), rng, clutter=0.5)
    before = {n: (d.uv_px.copy(), d.cov_px2.copy()) for n, d in picture.detections.items()}
    find_labels(rig, model, picture.detections, WIDE)
    for n, (uv, cov) in before.items():
        np.testing.assert_array_equal(picture.detections[n].uv_px, uv)
        np.testing.assert_array_equal(picture.detections[n].cov_px2, cov)
