"""Position and shape of rendered spots, checked by methods independent of the renderer."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.stats import norm

from geometry.camera import FISHEYE, Camera
from geometry.forward_model import SpotModel
from geometry.light_centroid import map_curvature
from geometry.planes import intersect_plane
from geometry.pose import Pose, look_at
from geometry.rig import Rig
from lab.simulate.picture import expected_light, laser_powers, make_sensor
from lab.simulate.points import exposure_instants, on_screen_covariance, spot_images, spot_patch
from lab.simulate.scenarios import LIGHTS, SCENARIOS, Clutter, fan
from lab.simulate.scene import compose

RIG = fan()
MODEL = SpotModel.of(RIG)


def fitted_centre(picture, near_px, half):
    """The centre of an elliptical Gaussian on a constant by least squares, independent of the renderer."""
    u0, v0 = np.round(near_px).astype(int)
    v, u = np.mgrid[v0 - half : v0 + half + 1, u0 - half : u0 + half + 1]
    data = picture[v0 - half : v0 + half + 1, u0 - half : u0 + half + 1].astype(float)

    def residual(p):
        du, dv = u - p[0], v - p[1]
        return (p[2] * np.exp(-(p[3] * du**2 + p[4] * du * dv + p[5] * dv**2)) + p[6] - data).ravel()

    start = [u0, v0, np.ptp(data), 0.05, 0.0, 0.05, data.min()]
    return least_squares(
        residual, start, x_scale=[1, 1, 100, 0.1, 0.1, 0.1, 10], method="lm", xtol=1e-12, ftol=1e-12
    ).x[:2]


def recording(**light):
    """Three frames with only spots on a uniform background."""
    even = replace(LIGHTS["clean"], gradient_dn=0.0, **light)
    return compose(replace(SCENARIOS["very-fast"], clutter=Clutter(per_spot=0.0), light=even), seed=3, frames=3)


def errors_px(scene, half, expected_px=None):
    """Fitted centre minus `expected_px` (T, n, 2), by default the truth, of all spots well inside the pictures."""
    powers = laser_powers(scene)
    expected = scene.uv_px if expected_px is None else expected_px
    out = []
    for camera, name in enumerate(scene.model.camera_names):
        sensor = make_sensor(scene, camera)
        for k in scene.frame:
            picture = expected_light(scene, sensor, powers, k)[0]
            inside = scene.rig.cameras[name].sees(scene.uv_px[k], -half - 1.0) & (scene.model.camera_of == camera)
            out.extend(fitted_centre(picture, scene.uv_px[k, i], half) - expected[k, i] for i in np.flatnonzero(inside))
    return np.array(out)


def test_spots_are_rendered_at_their_true_positions():
    """Of narrow ones, sigma 1 px, the skew is negligible."""
    errors = errors_px(recording(beam_radius_m=0.004, exposure_s=1e-9), 6)
    assert len(errors) >= 15
    assert np.abs(errors).max() < 1e-3


def test_the_centre_of_a_streak_is_the_mean_position_over_the_exposure():
    """The mean is the position at mid-exposure plus acceleration * exposure^2 / 24: 0.004 px at 100 px per frame and 1
    ms.
    """
    scene = recording(exposure_s=1e-3)
    instants = (np.arange(1000) + 0.5) / 1000 - 0.5
    mean = np.array([scene.model.project(scene.motion.pose(t + 1e-3 * instants))[0].mean(axis=0) for t in scene.t_s])
    moved = scene.model.project(scene.motion.pose(scene.t_s + 0.5e-3))[0]
    assert np.linalg.norm(moved - scene.uv_px, axis=-1).max() > 3.0  # half a streak
    # A streak with changing speed is slightly skewed, which moves the fit of a Gaussian by another 0.002 px.
    assert np.abs(errors_px(scene, 22, mean)).max() < 3e-3
    assert np.abs(mean - scene.uv_px).max() < 6e-3


def test_a_streak_has_the_length_of_the_path():
    instants, weights = exposure_instants(12.0, 1.5)
    path = np.array([40.0, 30.0]) + instants[:, None] * np.array([12.0, 0.0])
    patch = spot_patch(path, weights, 1.5**2 * np.eye(2), (80, 60))
    u = patch.column + np.arange(patch.values.shape[1])
    along = patch.values.sum(axis=0)
    variance = (along * (u - 40.0) ** 2).sum() / along.sum()
    # A uniform streak adds length^2 / 12, a pixel 1 / 12.
    assert variance == pytest.approx(1.5**2 + 12.0**2 / 12 + 1 / 12, rel=1e-4)
    assert patch.values.max() / np.median(along[np.abs(u - 40) < 4] / 1.5 / np.sqrt(2 * np.pi)) == pytest.approx(
        1.0, rel=0.03
    )


@pytest.mark.parametrize("sigma_px", [0.5, 1.0, 4.0])
def test_light_is_integrated_over_pixels(sigma_px):
    centre = np.array([20.3, 17.8])
    patch = spot_patch(centre[None], np.ones(1), sigma_px**2 * np.eye(2), (48, 40))
    u = patch.column + np.arange(patch.values.shape[1])
    v = patch.row + np.arange(patch.values.shape[0])
    exact_u, exact_v = (
        norm.cdf(x + 0.5, c, sigma_px) - norm.cdf(x - 0.5, c, sigma_px) for x, c in ((u, centre[0]), (v, centre[1]))
    )
    np.testing.assert_allclose(patch.values, np.outer(exact_v, exact_u), atol=3e-6)


def test_only_the_edge_of_a_spot_beside_the_picture_is_in_it():
    whole = spot_patch(np.array([[50.0, 50.0]]), np.ones(1), 4 * np.eye(2), (100, 100)).values.sum()
    rim = spot_patch(np.array([[-1.5, 50.0]]), np.ones(1), 4 * np.eye(2), (100, 100)).values.sum()
    assert whole == pytest.approx(1.0, abs=1e-5)
    assert rim == pytest.approx(0.3085, abs=1e-3)  # the normal distribution beyond half a sigma
    assert spot_patch(np.array([[-40.0, 50.0]]), np.ones(1), 4 * np.eye(2), (100, 100)) is None


def test_a_beam_with_60_degrees_of_incidence_gives_an_ellipse_with_axes_in_the_ratio_2():
    direction = np.array([np.sin(np.pi / 3), 0.0, np.cos(np.pi / 3)])
    axes = np.eye(3)[:, :2]
    C = on_screen_covariance(direction, axes, 0.01)
    np.testing.assert_allclose(np.sqrt(np.diagonal(C)), [0.02, 0.01], rtol=1e-9)


def traced(view, pose, sigma_m):
    """A spot traced through OpenCV's camera on a grid of rays across the beam.

    Returns its centroid without and with the variation of light over the spot (cosine and squared distance), (2,) each,
    and its covariance (2, 2), px.
    """
    camera = RIG.cameras[MODEL.views[view][0]]
    camera_from_world = camera.camera_from_world
    direction = pose.rotation @ MODEL.ray[view]
    hit = MODEL.hits(pose)[view]
    a, b = (g.ravel() for g in np.meshgrid(*2 * [np.linspace(-5, 5, 81)]))
    weight = np.exp(-(a**2 + b**2) / 2)
    across = np.linalg.svd(direction[None])[2][1:]
    lit = hit + sigma_m * np.stack([a, b], -1) @ across
    normal = MODEL.screen_rotation[view][:, 2]
    lit += np.outer((hit - lit) @ normal / (direction @ normal), direction)
    in_camera = camera_from_world.apply(lit)
    falling = weight * np.abs(in_camera @ camera_from_world.turn(normal)) / np.linalg.norm(in_camera, axis=1) ** 3
    rvec = cv2.Rodrigues(camera_from_world.rotation)[0]
    uv = cv2.projectPoints(lit, rvec, camera_from_world.translation, camera.matrix, np.array(camera.distortion))[0]
    uv = uv[:, 0]
    return weight @ uv / weight.sum(), falling @ uv / falling.sum(), np.cov(uv.T, aweights=weight, ddof=0)


POSES = [
    Pose.from_ypr(np.deg2rad(a), np.array(t))
    for a, t in (((0.0, 0, 0), (0.0, 0, 0)), ((25, 12, -20), (0.7, 0.4, -0.3)), ((-12, -16, 24), (-0.8, -0.5, 0.3)))
]


@pytest.mark.parametrize("pose", POSES)
@pytest.mark.parametrize("view", [0, 1, 3, 4])
def test_the_ellipse_in_the_picture_agrees_with_rays_traced_through_opencv(pose, view):
    covariance = traced(view, pose, 0.0055)[2]
    found = spot_images(MODEL, pose, 0.0055, 0.0).covariance_px2[view]
    np.testing.assert_allclose(found, covariance, atol=1e-3 * np.trace(covariance))
    # Not a circle, for which the angle would not be tested.
    assert np.linalg.eigvalsh(found)[1] > 1.05 * np.linalg.eigvalsh(found)[0]


def test_the_ellipse_in_the_picture_of_a_fisheye_lens_agrees_with_points_of_the_screen_through_opencv():
    numbers = (0.03, -0.01, 0.002, -5e-4)
    wide = {n: replace(c, lens=FISHEYE, distortion=numbers) for n, c in RIG.cameras.items()}
    model = SpotModel.of(replace(RIG, cameras=wide))
    pose, sigma_m, step = POSES[1], 0.0055, 1e-4
    hits, found = model.hits(pose), spot_images(model, pose, sigma_m, 0.0)
    for view in (0, 1, 3, 4):
        camera, axes = wide[model.views[view][0]], model.screen_rotation[view][:, :2]
        beside = hits[view] + step * np.concatenate([axes, -axes], axis=1).T
        at = (cv2.Rodrigues(camera.camera_from_world.rotation)[0], camera.camera_from_world.translation)
        uv = cv2.fisheye.projectPoints(beside[:, None], *at, camera.matrix, np.array(numbers))[0][:, 0]
        by_screen = (uv[:2] - uv[2:]).T / (2 * step)
        on_screen = on_screen_covariance(pose.rotation @ model.ray[view], axes, sigma_m)
        expected = by_screen @ on_screen @ by_screen.T
        np.testing.assert_allclose(found.covariance_px2[view], expected, rtol=1e-4, atol=1e-4 * np.trace(expected))


@pytest.mark.parametrize("pose", POSES)
@pytest.mark.parametrize("view", [0, 1, 3, 4])
def test_effects_beyond_the_affine_spot_move_its_centroid_by_thousandths_of_a_pixel(pose, view):
    """Perspective and distortion across the spot: below 1e-3 px for the default beam (sigma 5.5 mm, 2 px in the
    picture). With the variation of light by distance and obliquity: 0.003 px, at most 0.006. Both are proportional to
    the square of the beam radius (sigma 30 mm: 0.02 and 0.16 px)."""
    perspective, with_light, _ = traced(view, pose, 0.0055)
    uv = MODEL.project(pose)[0][view]
    assert np.linalg.norm(perspective - uv) < 1e-3
    assert 5e-4 < np.linalg.norm(with_light - uv) < 6e-3
    four_times, _, _ = traced(view, pose, 0.011)
    assert np.linalg.norm(four_times - uv) == pytest.approx(4 * np.linalg.norm(perspective - uv), rel=0.02)


@pytest.mark.parametrize("blur_px", [0.0, 0.6, 2.0])
@pytest.mark.parametrize(
    ("sigma_m", "pose", "parts"), [(0.015, POSES[0], 8), (0.011, POSES[1], 8), (0.03, POSES[2], 4)]
)
def test_a_spot_is_skewed_as_rays_from_the_screen_show_it(sigma_m, pose, parts, blur_px):
    """The light on the screen where the ray of each sample of the picture meets it, blurred, and averaged by pixel.

    parts: samples of a pixel along each axis; fewer for the largest spot.
    """
    view = 4
    camera = RIG.cameras[MODEL.views[view][0]]
    screen = RIG.screens[camera.screen]
    spots = spot_images(MODEL, pose, sigma_m, blur_px)
    curvature = map_curvature(camera, screen, spots.uv_px[view])
    whole = spots.uv_px[view][None], np.ones(1), spots.covariance_px2[view], camera.image_size_px
    patch, symmetric = spot_patch(*whole, curvature, blur_px), spot_patch(*whole)
    rows, columns = patch.values.shape
    fine_u, fine_v = (first - 0.5 + (np.arange(count * parts) + 0.5) / parts
                      for first, count in ((patch.column, columns), (patch.row, rows)))  # fmt: skip
    origin, ray = camera.rays(np.stack(np.meshgrid(fine_u, fine_v), axis=-1))
    on_screen = intersect_plane(origin, ray, screen.world_from_screen)
    lit = screen.world_from_screen.apply(np.concatenate([on_screen, 0 * on_screen[..., :1]], axis=-1))
    beam, start = pose.rotation @ MODEL.ray[view], pose.apply(MODEL.point[view])
    light = np.exp(-0.5 * np.sum(np.cross(lit - start, beam) ** 2, axis=-1) / sigma_m**2)
    if blur_px:
        light = cv2.GaussianBlur(light, (0, 0), blur_px * parts, borderType=cv2.BORDER_CONSTANT)
    exact = light.reshape(rows, parts, columns, parts).mean(axis=(1, 3))
    exact *= patch.values.sum() / exact.sum()
    skew = np.abs(symmetric.values - exact).max()
    assert np.abs(patch.values - exact).max() < 0.15 * skew + 1e-4 * exact.max()
    assert skew > 1e-3 * exact.max()


def test_the_light_of_a_spot_at_twice_the_distance_is_a_quarter():
    def light_at(distance_m):
        camera = replace_pose(
            RIG.cameras["left"], look_at(np.array([-2.5 + distance_m, 0, 0.0]), np.array([-2.5, 0, 0.0]))
        )
        rig = Rig(RIG.screens, {"left": camera}, RIG.beams, RIG.spots)
        return spot_images(SpotModel.of(rig), Pose.identity(), 0.005, 0.5).light[1]

    assert light_at(2.0) / light_at(4.0) == pytest.approx(4.0)


def replace_pose(camera, pose):
    return Camera(camera.name, camera.screen, camera.image_size_px, camera.matrix, camera.distortion, pose)
