"""The forward model against other means and against finite differences."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from geometry.arrays import numeric_jacobian
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.rig import Beam, Rig, Screen
from tests.geometry.scenes import LENSES, paper_rig, random_pose, random_rig, uncommon_rig

seeds = st.integers(0, 2**32 - 1)
ROUNDING_PX = 1e-8  # rounding of pixels of some thousands after a few dozen operations


def plain_hit(rig: Rig, spot_name: str, turn: Rotation, shift: np.ndarray) -> np.ndarray:
    """The lit point of one spot by other means: scipy's rotations and a linear system, of a bent screen a quadratic.

    nan where the beam misses the screen.
    """
    spot = rig.spots[spot_name]
    beam, screen = rig.beams[spot.beam], rig.screens[spot.screen]
    start = turn.apply(beam.point) + shift
    along = spot.sign * turn.apply(beam.direction)
    R = screen.world_from_screen.rotation
    origin = screen.world_from_screen.translation
    # start + t along = origin + x e_x + y e_y
    t, x, y = np.linalg.solve(np.column_stack([along, -R[:, 0], -R[:, 1]]), origin - start)
    if any(screen.bow):
        # p + t q lies on z = a x^2 + b x y + c y^2, in the screen's frame.
        (p, q), (a, b, c) = ((start - origin) @ R, along @ R), screen.bow
        B = np.array([[2 * a, b], [b, 2 * c]]) / 2
        roots = np.roots([q[:2] @ B @ q[:2], 2 * q[:2] @ B @ p[:2] - q[2], p[:2] @ B @ p[:2] - p[2]])
        t = roots[np.argmin(np.abs(roots - t))].real
        x, y = p[:2] + t * q[:2]
    beside = screen.size_m is not None and (abs(x) > screen.size_m[0] / 2 or abs(y) > screen.size_m[1] / 2)
    return np.full(3, np.nan) if t <= 0 or beside else start + t * along


def plain_pixel(rig: Rig, camera_name: str, spot_name: str, turn: Rotation, shift: np.ndarray) -> np.ndarray:
    """The pixel of one spot by other means: the lit point, and OpenCV's projection.

    nan where the beam misses the screen or the spot is behind the camera. Lenses that fold are not considered.
    """
    camera, lit = rig.cameras[camera_name], plain_hit(rig, spot_name, turn, shift)
    if not camera.camera_from_world.apply(lit)[2] > 0:
        return np.full(2, np.nan)
    rotvec = Rotation.from_matrix(camera.camera_from_world.rotation).as_rotvec()
    numbers = np.array(camera.distortion) if camera.distortion else None
    pixel, _ = cv2.projectPoints(lit[None], rotvec, camera.camera_from_world.translation, camera.matrix, numbers)
    return pixel.ravel()


@settings(max_examples=150)
@given(seed=seeds)
def test_the_model_agrees_with_a_plain_computation_by_other_means(seed):
    rng = np.random.default_rng(seed)
    rig, pose = random_rig(rng), random_pose(rng, 0.8, 0.7)
    model = SpotModel.of(rig)
    turn = Rotation.from_matrix(pose.rotation)
    pixels, _ = model.project(pose)
    hits = model.hits(pose)
    for (camera, spot), pixel, hit in zip(model.views, pixels, hits, strict=True):
        expected = plain_pixel(rig, camera, spot, turn, pose.translation)
        np.testing.assert_allclose(hit, plain_hit(rig, spot, turn, pose.translation), rtol=1e-9, atol=1e-9)
        in_camera = rig.cameras[camera].camera_from_world.apply(hit)
        radius2 = np.sum((in_camera[:2] / in_camera[2]) ** 2)
        if radius2 > 0.8**2:  # beyond the range in which LENSES are one to one nan is correct too
            assert np.isnan(pixel).all() or np.allclose(pixel, expected, rtol=1e-11, atol=ROUNDING_PX)
        else:
            np.testing.assert_allclose(pixel, expected, rtol=0, atol=ROUNDING_PX)


@settings(max_examples=20, deadline=None)
@given(seed=seeds)
def test_pixels_and_their_jacobian_are_the_same_with_and_without_other_derivatives(seed):
    rng = np.random.default_rng(seed)
    rig, pose = uncommon_rig(rng), random_pose(rng, 0.3, 0.3)
    model = SpotModel.of(rig)
    pixels, J = model.project(pose)
    found = model.derivatives(pose)
    np.testing.assert_allclose(found.pixels, pixels, rtol=0, atol=1e-9)
    good = np.isfinite(pixels[:, 0])
    np.testing.assert_allclose(found.pose[good], J[good], rtol=1e-9, atol=1e-9)


@settings(max_examples=10, deadline=None)
@given(seed=seeds)
def test_derivatives_without_those_of_the_lens_are_the_others_unchanged(seed):
    rng = np.random.default_rng(seed)
    model, pose = SpotModel.of(uncommon_rig(rng)), random_pose(rng, 0.3, 0.3)
    every, others = model.derivatives(pose), model.derivatives(pose, of_lens=False)
    for name in ("pixels", "pose", "camera", "screen", "bow", "direction", "point"):
        np.testing.assert_array_equal(getattr(others, name), getattr(every, name))
    assert not others.pinhole.any()
    assert not others.distortion.any()
    assert every.pinhole.any()


def test_most_spots_of_the_random_scenes_have_a_projection():
    """Otherwise the tests of this file would compare nan with nan."""
    rng = np.random.default_rng(7)
    found = [SpotModel.of(random_rig(rng)).project(random_pose(rng, 0.8, 0.7))[0] for _ in range(100)]
    assert np.mean(np.isfinite(found)) > 0.7


def test_the_spots_of_the_papers_rig_lie_where_trigonometry_puts_them():
    # 2.5 m from the middle to a screen, beams at 0 and +-30 degrees, cameras 3.5 m behind the screens.
    side = 1180.0 * 2.5 * np.tan(np.radians(30)) / 3.5
    pixels, _ = SpotModel.of(paper_rig()).project(Pose.identity())
    np.testing.assert_allclose(np.abs(pixels[:, 0] - 639.5), [0, side, side, 0, side, side], atol=ROUNDING_PX)
    np.testing.assert_allclose(pixels[:, 1], 511.5, atol=ROUNDING_PX)


@settings(max_examples=60)
@given(seed=seeds)
def test_the_jacobian_of_the_pixels_equals_finite_differences(seed):
    rng = np.random.default_rng(seed)
    model, pose = SpotModel.of(random_rig(rng)), random_pose(rng, 0.6, 0.5)
    pixels, J = model.project(pose)
    differences = numeric_jacobian(lambda delta: model.project(pose.plus(delta))[0], np.zeros(6))
    seen = model.in_picture(pixels, 500.0)
    # Central differences with a step of 1e-6: truncation about 1e-12 of the third derivative, rounding 1e-10 px / 1e-6.
    scale = np.abs(J[seen]).max(axis=(-1, -2), keepdims=True, initial=1.0)
    np.testing.assert_allclose(J[seen] / scale, differences[seen] / scale, rtol=0, atol=2e-6)


@settings(max_examples=30)
@given(seed=seeds)
def test_a_stack_of_poses_gives_the_same_as_each_pose_alone(seed):
    rng = np.random.default_rng(seed)
    model = SpotModel.of(random_rig(rng))
    poses = [random_pose(rng, 0.8, 0.7) for _ in range(6)]
    stack = Pose(
        np.array([p.rotation for p in poses]).reshape(2, 3, 3, 3),
        np.array([p.translation for p in poses]).reshape(2, 3, 3),
    )
    pixels, J = model.project(stack)
    assert pixels.shape == (2, 3, len(model), 2)
    assert J.shape == (2, 3, len(model), 2, 6)
    for i, pose in enumerate(poses):
        alone, J_alone = model.project(pose)
        exists = np.isfinite(alone).all(axis=-1)
        np.testing.assert_allclose(pixels[divmod(i, 3)], alone, atol=ROUNDING_PX)
        np.testing.assert_allclose(J[divmod(i, 3)][exists], J_alone[exists], rtol=1e-9, atol=1e-6)


@settings(max_examples=60)
@given(seed=seeds)
def test_pixels_do_not_depend_on_the_choice_of_the_world_frame(seed):
    rng = np.random.default_rng(seed)
    rig, pose = random_rig(rng), random_pose(rng, 0.6, 0.5)
    new_from_world = random_pose(rng, 10.0)
    moved = dataclasses.replace(
        rig,
        screens={
            n: dataclasses.replace(s, world_from_screen=new_from_world @ s.world_from_screen)
            for n, s in rig.screens.items()
        },
        cameras={
            n: dataclasses.replace(c, camera_from_world=c.camera_from_world @ new_from_world.inverse())
            for n, c in rig.cameras.items()
        },
    )
    before, J_before = SpotModel.of(rig).project(pose)
    after, J_after = SpotModel.of(moved).project(new_from_world @ pose)
    near = SpotModel.of(rig).in_picture(before, 2000.0)
    np.testing.assert_allclose(after[near], before[near], rtol=0, atol=1e-7)
    # A pose error in world rotates with the world frame; one in body does not.
    J_expected = np.concatenate([J_before[..., :3] @ new_from_world.rotation.T, J_before[..., 3:]], axis=-1)
    np.testing.assert_allclose(J_after[near], J_expected[near], rtol=1e-7, atol=1e-5)


@settings(max_examples=30)
@given(seed=seeds)
def test_a_subset_gives_those_rows_of_the_whole_model(seed):
    rng = np.random.default_rng(seed)
    model, pose = SpotModel.of(random_rig(rng)), random_pose(rng, 0.6, 0.5)
    pixels, J = model.project(pose)
    order = rng.permutation(len(model))[:5]
    some = model.subset(order)
    assert some.views == tuple(model.views[i] for i in order)
    np.testing.assert_array_equal(some.project(pose)[0], pixels[order])
    np.testing.assert_array_equal(some.project(pose)[1], J[order])
    chosen = np.isin(np.arange(len(model)), order)
    np.testing.assert_array_equal(model.subset(chosen).project(pose)[0], pixels[chosen])


def test_a_subset_may_be_empty():
    model = SpotModel.of(paper_rig(LENSES[5])).subset(np.zeros(6, dtype=bool))
    pixels, J = model.project(Pose.identity())
    assert (len(model), pixels.shape, J.shape) == (0, (0, 2), (0, 2, 6))


def test_a_motion_along_a_beam_moves_neither_of_its_spots():
    _, J = SpotModel.of(paper_rig(LENSES[5])).project(Pose.identity())
    np.testing.assert_allclose(J[[0, 3], :, 0], 0.0, atol=1e-9)  # A runs along the world's x
    np.testing.assert_allclose(J[[0, 3], :, 3], 0.0, atol=1e-9)  # the same for a turn about it
    assert (np.abs(J[[1, 2, 4, 5], :, 0]).max(axis=1) > 50).all()


def _only_beam(direction, size_m=None, point=(0.0, 0.0, 0.0)) -> SpotModel:
    rig = paper_rig(LENSES[5], size_m)
    beam = {"A": Beam("A", np.array(direction), np.array(point))}
    spots = {n: s for n, s in rig.spots.items() if s.beam == "A"}
    return SpotModel.of(dataclasses.replace(rig, beams=beam, spots=spots))


def test_a_beam_that_points_away_from_its_screen_gives_nan():
    model = _only_beam([-1.0, 0, 0])  # each end points at the other screen
    assert np.isnan(model.hits(Pose.identity())).all()
    assert np.isnan(model.project(Pose.identity())[0]).all()


def test_a_beam_parallel_to_its_screen_gives_nan_and_no_warning(recwarn):
    model = _only_beam([0.0, 1, 0])
    pixels, J = model.project(Pose.identity())
    assert np.isnan(pixels).all()
    assert np.isfinite(J).all()
    assert not recwarn.list


def test_a_beam_that_starts_beyond_its_screen_gives_nan_there():
    model = _only_beam([1.0, 0, 0])
    pixels, _ = model.project(Pose(np.eye(3), np.array([2.6, 0, 0])))  # 0.1 m behind the right screen
    assert np.isfinite(pixels).all(axis=-1).tolist() == [True, False]


@pytest.mark.parametrize(("axis", "half"), [(1, 2.0), (2, 1.5)])
@pytest.mark.parametrize("side", [-1, 1])
def test_a_spot_exists_up_to_the_edge_of_the_screen_and_not_beyond(axis, half, side):
    model = _only_beam([1.0, 0, 0], size_m=(4.0, 3.0))
    shift = np.zeros(3)
    shift[axis] = side * half * (1 - 1e-9)
    assert np.isfinite(model.hits(Pose(np.eye(3), shift))).all()
    shift[axis] = side * half * (1 + 1e-9)
    assert np.isnan(model.hits(Pose(np.eye(3), shift))).all()
    assert np.isnan(model.project(Pose(np.eye(3), shift))[0]).all()


def test_a_screen_without_extent_has_no_edge():
    hit = _only_beam([1.0, 0, 0]).hits(Pose(np.eye(3), np.array([0, 1e4, 0])))
    np.testing.assert_allclose(hit, [[-2.5, 1e4, 0], [2.5, 1e4, 0]])


def test_a_spot_behind_the_camera_gives_nan():
    rig = paper_rig()
    left = rig.cameras["left"]
    backwards = Pose(Rotation.from_euler("y", 180, degrees=True).as_matrix(), np.zeros(3))
    turned = dataclasses.replace(left, camera_from_world=backwards @ left.camera_from_world)
    model = SpotModel.of(dataclasses.replace(rig, cameras=dict(rig.cameras, left=turned)))
    pixels, _ = model.project(Pose.identity())
    assert [camera for (camera, _), uv in zip(model.views, pixels, strict=True) if np.isnan(uv).all()] == ["left"] * 3
    assert np.isfinite(model.hits(Pose.identity())).all()


def test_views_are_ordered_by_camera_then_by_spot():
    rig = random_rig(np.random.default_rng(1))
    model = SpotModel.of(rig)
    assert list(model.views) == rig.views()
    assert [model.camera_names[i] for i in model.camera_of] == [c for c, _ in model.views]
    assert [model.spot_names[i] for i in model.spot_of] == [s for _, s in model.views]
    assert [list(rig.beams)[i] for i in model.beam_of] == [rig.spots[s].beam for _, s in model.views]


def test_a_ray_hits_a_tilted_screen_on_its_plane():
    tilt = Rotation.from_euler("z", 40, degrees=True).as_matrix()
    rig = paper_rig()
    right = rig.screens["right"].world_from_screen
    screens = dict(rig.screens, right=Screen("right", Pose(tilt @ right.rotation, right.translation)))
    model = SpotModel.of(dataclasses.replace(rig, screens=screens))
    hit = model.hits(Pose(np.eye(3), np.array([0, 0.3, 0])))
    # Beam A at y = 0.3 meets the plane x cos 40 + y sin 40 = 2.5 cos 40.
    expected = 2.5 - 0.3 * np.tan(np.radians(40))
    np.testing.assert_allclose(hit[model.views.index(("right", "4"))], [expected, 0.3, 0], atol=1e-12)


@settings(max_examples=50)
@given(seed=seeds)
def test_rays_hit_a_bent_screen_on_its_surface(seed):
    rng = np.random.default_rng(seed)
    flat = random_rig(rng)
    bows = {n: tuple(rng.normal(0, 0.01, 3)) for n in flat.screens}
    rig = dataclasses.replace(flat, screens={n: dataclasses.replace(s, bow=bows[n]) for n, s in flat.screens.items()})
    pose = random_pose(rng, 0.3, 0.3)
    model = SpotModel.of(rig)
    hits, (pixels, J) = model.hits(pose), model.project(pose)
    for i, (_, spot) in enumerate(model.views):
        if np.isnan(hits[i, 0]):
            continue
        screen = rig.screens[rig.spots[spot].screen]
        x, y, z = screen.world_from_screen.inverse().apply(hits[i])
        a, b, c = screen.bow
        assert z == pytest.approx(a * x * x + b * x * y + c * y * y, abs=1e-9)
        beam = rig.beams[rig.spots[spot].beam]
        off = np.cross(hits[i] - pose.apply(beam.point), pose.turn(beam.direction))
        np.testing.assert_allclose(off, 0, atol=1e-9)
    good = model.in_picture(pixels)
    expected = numeric_jacobian(lambda d: model.project(pose.plus(d))[0], np.zeros(6))
    np.testing.assert_allclose(J[good], expected[good], rtol=1e-4, atol=1e-2)  # px per m and rad, of some thousand


@settings(max_examples=15)
@given(seed=seeds)
def test_the_pixels_of_a_strongly_bent_screen_are_those_of_its_surface(seed):
    """Against the roots of the ray's quadratic: a wrong slope converges too slowly."""
    rng = np.random.default_rng(seed)
    flat = random_rig(rng)
    screens = {n: dataclasses.replace(s, bow=tuple(rng.normal(0, 0.03, 3))) for n, s in flat.screens.items()}
    rig, pose = dataclasses.replace(flat, screens=screens), random_pose(rng, 0.3, 0.3)
    model = SpotModel.of(rig)
    pixels, turn = model.project(pose)[0], Rotation.from_matrix(pose.rotation)
    for i, (camera, spot) in enumerate(model.views):
        if np.isfinite(pixels[i]).all():
            lit = plain_hit(rig, spot, turn, pose.translation)
            np.testing.assert_allclose(pixels[i], rig.cameras[camera].project(lit), atol=1e-9)
