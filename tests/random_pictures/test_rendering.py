"""The bench's renderer does what its truth and its stated sensors say. Nothing here depends on the detector."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from bench.random_pictures.looks import FAMILIES, draw_look, mixed_look
from bench.random_pictures.optics import BeamShape, Patch
from bench.random_pictures.render import Renderer
from bench.random_pictures.scene import PictureScene, picture_scene
from bench.random_pictures.sensors import Sensor, draw_sensor, expose, true_noise
from bench.random_pictures.spots import BeamEnd, draw_speckle
from bench.random_scenes.scene import SHINING
from geometry.arrays import Array
from geometry.pose import Pose

px = 1.0


def scene_of(family: str | None, seed: int, frames: int = 16) -> PictureScene:
    return picture_scene(seed, family, frames)


def bare(end: BeamEnd, sigma_px: float, divergence: float) -> BeamEnd:
    """The same view with a round Gaussian beam of about this width, without speckle."""
    wide = replace(end, shape=BeamShape(1e-3, 0.0), blur_px=0.0, speckle=None)
    return replace(wide, shape=BeamShape(1e-3 * sigma_px, divergence), blur_px=0.4)


def whole_inside(patch: Patch, end: BeamEnd) -> bool:
    height, width = patch.light.shape
    size = end.camera.image_size_px
    return patch.u0 > 0 and patch.v0 > 0 and patch.u0 + width < size[0] and patch.v0 + height < size[1]


def moments(patch: Patch) -> tuple[float, Array, Array]:
    """Sum, centroid (2,) and second moments (2,) about it, px and px^2."""
    light = patch.light.astype(float)
    u = np.arange(light.shape[1]) + patch.u0
    v = np.arange(light.shape[0]) + patch.v0
    total = light.sum()
    middle = np.array([light.sum(axis=0) @ u, light.sum(axis=1) @ v]) / total
    second = np.array([light.sum(axis=0) @ (u - middle[0]) ** 2, light.sum(axis=1) @ (v - middle[1]) ** 2]) / total
    return float(total), middle, second


def integral(end: BeamEnd, pose: Pose) -> tuple[float, Array, Array]:
    """The same moments by a sum over the screen, projected by OpenCV; lens and pixel add their own second moments.

    A pixel's value is the screen's irradiance where it looks, so each piece of the screen counts by its area in the
    picture.
    """
    start = pose.apply(end.beam.point)
    along = pose.turn(end.spot.sign * end.beam.direction / np.linalg.norm(end.beam.direction))
    plane = end.screen.world_from_screen
    normal = plane.rotation[:, 2]
    hit = start + along * ((plane.translation - start) @ normal) / (along @ normal)
    s0, theta = end.shape.sigma_m, end.shape.divergence
    reach = 6 * np.hypot(s0, theta * np.linalg.norm(hit - start)) / abs(along @ normal)
    grid = np.linspace(-reach, reach, 101)
    gx, gy = (g.reshape(-1) for g in np.meshgrid(grid, grid))
    points = hit + gx[:, None] * plane.rotation[:, 0] + gy[:, None] * plane.rotation[:, 1]
    away = points - start
    z = away @ along
    sigma2 = s0**2 + (theta * z) ** 2
    beside = away - z[:, None] * along
    light = s0**2 / sigma2 * np.exp(-np.sum(beside**2, axis=1) / (2 * sigma2))
    light *= np.abs((along + beside * (theta**2 * z / sigma2)[:, None]) @ normal)

    def projected(world: Array) -> Array:
        camera = end.camera
        turn, _ = cv2.Rodrigues(camera.camera_from_world.rotation)
        lens = np.array(camera.distortion) if camera.distortion else np.zeros(5)
        uv, _ = cv2.projectPoints(world, turn, camera.camera_from_world.translation, camera.matrix, lens)
        return np.asarray(uv[:, 0])

    h = 1e-5
    across = [(projected(points + h * a) - projected(points - h * a)) / (2 * h) for a in plane.rotation[:, :2].T]
    area = np.abs(across[0][:, 0] * across[1][:, 1] - across[0][:, 1] * across[1][:, 0])
    weight, uv = light * area, projected(points)
    middle = weight @ uv / weight.sum()
    second = weight @ (uv - middle) ** 2 / weight.sum() + end.blur_px**2 + 1 / 12
    return float(weight.sum() * (grid[1] - grid[0]) ** 2), middle, second


@pytest.mark.parametrize("seed", [1, 2, 3, 5])
@pytest.mark.parametrize("divergence", [0.0, 1e-3])
def test_a_spot_has_the_moments_of_an_independent_integral(seed, divergence):
    ps = scene_of("saturated", seed)
    compared = 0
    for i in range(len(ps.ends)):
        end = bare(ps.ends[i], 4.0, divergence)
        pose = ps.scene.poses[3:4]
        patch = end.patch(pose) if np.isfinite(ps.scene.uv_px[3, i]).all() else None
        if patch is None or not whole_inside(patch, end):
            continue
        total, middle, second = moments(patch)
        if second.min() < 1.0:
            continue  # the moments of pixels are those of the light only where it covers several
        wanted = integral(end, ps.scene.poses[3])
        assert total == pytest.approx(wanted[0], rel=2e-3)
        np.testing.assert_allclose(middle, wanted[1], atol=1e-3 * px)
        np.testing.assert_allclose(second, wanted[2], rtol=0.01)
        compared += 1
        if compared == 3:
            break
    assert compared >= 2


def test_a_wide_divergent_oblique_spot_has_its_centroid_beside_the_axis():
    away = []
    for seed in range(1, 6):
        ps = scene_of("wide", seed)
        for i in range(len(ps.ends)):
            end = replace(ps.ends[i], speckle=None)
            patch = end.patch(ps.scene.poses[0:1]) if np.isfinite(ps.scene.uv_px[0, i]).all() else None
            if patch is not None and whole_inside(patch, end):
                away.append(float(np.linalg.norm(moments(patch)[1] - ps.scene.uv_px[0, i])))
    assert 0.01 * px < np.median(away) < 1 * px


@pytest.mark.parametrize("seed", [1, 4])
def test_the_middle_of_an_exposure_is_the_true_pose_of_its_frame(seed):
    ps = scene_of("streaks", seed)
    assert ps.parts >= 5
    for k in range(len(ps)):
        middle = ps.during(k)[ps.parts // 2]
        np.testing.assert_allclose(middle.translation, ps.scene.poses[k].translation, atol=1e-9)
        np.testing.assert_allclose(middle.rotation, ps.scene.poses[k].rotation, atol=1e-9)


def test_a_streak_of_uniform_motion_is_symmetric_about_mid_exposure_and_has_enough_parts():
    ps = scene_of("streaks", 2)
    end = bare(ps.ends[0], 3.0, 0.0)
    pose = ps.scene.poses[0]

    def during(parts: int) -> Pose:
        shift = 0.02 * ((np.arange(parts) + 0.5) / parts - 0.5)[:, None] * np.array([0.1, 1.0, 0.3])
        return Pose(np.repeat(pose.rotation[None], parts, axis=0), pose.translation + shift)

    still, streak, finer = (moments(p) for n in (1, 25, 75) if (p := end.patch(during(n), 3)) is not None)
    assert np.max(streak[2] / still[2]) > 1.5
    np.testing.assert_allclose(streak[1], still[1], atol=0.01 * px)  # the projection bends a streak by so much
    np.testing.assert_allclose(streak[2], finer[2], rtol=0.01)


def test_speckle_stays_at_its_place_and_another_place_has_another_pattern():
    ps = scene_of("speckled", 3)
    field = draw_speckle(np.random.default_rng(1), 0.3, 1.0)
    assert field is not None
    assert field.mean() == pytest.approx(1, abs=0.01)
    assert field.std() == pytest.approx(0.3, rel=0.05)
    end = replace(bare(ps.ends[0], 6.0, 0.0), speckle=field)
    plain = replace(end, speckle=None)
    pose = ps.scene.poses[0]

    def pattern(shift_m: float) -> Array:
        moved = Pose(pose.rotation[None], pose.translation[None] + [0.0, shift_m, 0.0])
        with_it, without = end.patch(moved, 2), plain.patch(moved, 2)
        assert with_it is not None
        assert without is not None
        inside = without.light > 0.2 * without.light.max()
        ratio = np.where(inside, with_it.light / np.maximum(without.light, 1e-9), np.nan)
        canvas = np.full((2048, 2048), np.nan)
        canvas[with_it.where] = ratio
        return canvas

    first, again, near = pattern(0.0), pattern(0.0), pattern(0.003)
    np.testing.assert_array_equal(first, again)
    both = np.isfinite(first) & np.isfinite(near)
    assert both.sum() > 20
    np.testing.assert_allclose(first[both], near[both], atol=0.1)  # where both shine, the grains are the same


@pytest.mark.parametrize("light_e", [3.0, 40.0, 5000.0])
@pytest.mark.parametrize(
    "sensor",
    [
        Sensor(8, 10_000, 3.0, 0.03),
        Sensor(12, 20_000, 5.0, 0.02, shift=4),
        Sensor(16, 40_000, 8.0, 0.01, row_e=4.0),
        Sensor(8, 8_000, 20.0, 0.04),
    ],
)
def test_a_flat_field_has_the_mean_and_variance_of_the_stated_sensor(sensor, light_e):
    level, variance = true_noise(sensor, light_e, np.random.default_rng(5))
    scale = 2**sensor.shift / sensor.gain_e_per_dn
    expected = float(sensor.variance_e2(np.array(light_e))) * scale**2
    off = 0.02 if expected > 0.3 * 4**sensor.shift else 0.5  # DN: where little scatters, the mean is rounded too
    assert level == pytest.approx(
        2**sensor.shift * sensor.black_dn + light_e * scale, abs=off * 2**sensor.shift, rel=2e-4
    )
    if expected > 0.3 * 4**sensor.shift:  # below that, rounding adds what depends on where the level lies
        assert variance == pytest.approx(expected, rel=0.05)


def test_few_electrons_scatter_with_the_skewness_of_poisson():
    sensor = Sensor(16, 2_000, 1.0, 0.01)
    light = np.full((400, 400), 9.0, dtype=np.float32)
    electrons = (expose(sensor, light, np.random.default_rng(2)).astype(float) - sensor.black_dn) * sensor.gain_e_per_dn
    centred = electrons - electrons.mean()
    assert np.mean(centred**3) == pytest.approx(9.0, rel=0.15)  # the third cumulant: that of the shot noise alone


def test_shifted_data_fill_the_upper_bits_and_saturate_at_the_top():
    sensor = Sensor(12, 10_000, 2.0, 0.02, shift=4)
    picture = expose(sensor, np.full((20, 20), 50_000, dtype=np.float32), np.random.default_rng(0))
    assert picture.dtype == np.uint16
    assert np.unique(picture).tolist() == [4095 << 4]


def test_snr_is_that_of_a_matched_filter():
    ps = scene_of("16-bit", 4)
    plain = replace(ps, look=replace(ps.look, texture=0.0, vignetting=0.0, gradient=0.0, speckle=0.0, hot_pixels=0,
                                     sensor=replace(ps.look.sensor, row_e=0.0)))  # fmt: skip
    renderer = Renderer(plain)
    found = 0
    for i in range(len(ps.ends)):
        c = int(ps.scene.camera_of[i])
        renderer.expected(0, c)
        patch = renderer.patch(0, i)
        if ps.scene.in_view[0, i] != SHINING or patch is None or not whole_inside(patch, ps.ends[i]):
            continue
        width = moments(patch)[2].prod() ** 0.25
        light = float(plain.look.background * plain.look.sensor.full_well_e)
        noise = np.sqrt(float(plain.look.sensor.variance_e2(np.array(light))))
        # Of a Gaussian of sigma s and sum F: sum of squares = F^2 / (4 pi s^2).
        wanted = patch.light.sum() / noise / np.sqrt(4 * np.pi) / width
        assert renderer.snr[0, i] == pytest.approx(wanted, rel=0.03)
        found += 1
    assert found >= 2


@pytest.mark.parametrize("family", [None, *FAMILIES])
def test_looks_stay_within_what_cameras_do(family):
    for seed in range(5):
        look = draw_look(np.random.default_rng(seed), family)
        assert 0.49 <= look.sigma_px <= 20.1
        assert look.blur_px <= look.sigma_px
        assert 0 <= look.background <= 0.32
        assert 5_000 <= look.sensor.full_well_e <= 60_000
        assert 0 <= look.speckle <= 0.3
        assert look.patterns in (0, 1, 2)
        assert 0 <= look.texture <= 0.06
        assert look.text


def test_sensors_of_every_kind_are_drawn():
    sensors = [draw_sensor(np.random.default_rng(s)) for s in range(200)]
    assert {s.bits for s in sensors} == {8, 10, 12, 16}
    assert {s.file_format for s in sensors} == {"png", "jpg", "mjpg"}
    assert {s.shift for s in sensors} == {0, 4, 6}
    assert any(s.black_dn == 0 for s in sensors)
    assert any(s.row_e > 0 for s in sensors)
    assert mixed_look(np.random.default_rng(1)) == mixed_look(np.random.default_rng(1))
