"""Detections are the images of the beams' axes, also where the sensor clips the tops of the spots."""

import cv2
import numpy as np
import pytest

from geometry.camera import Camera
from geometry.light_centroid import CentroidOffsets
from geometry.planes import intersect_plane
from geometry.pose import Pose
from geometry.rig import Screen
from tracking.detection.detect import find_spots
from tracking.detections import on_beam_axes
from tracking.noise import NoiseModel
from tracking.parameters import DetectParameters

SIZE = (320, 240)
CAMERA = Camera(
    "c", "s", SIZE, np.array([[400.0, 0, 160], [0, 400, 120], [0, 0, 1]]), (-0.1, 0.02, 0, 0), Pose.identity()
)
SCREEN = Screen("s", Pose(cv2.Rodrigues(np.radians([12.0, 48.0, 0.0]))[0], np.array([0.1, 0.0, 2.0])))
NOISE = NoiseModel(1.0, 0.02, 10.0)


PLACE, SPREAD_M = np.array([0.15, -0.1]), 0.03  # of the beam on its screen, m
REACH_PX = 48  # from the beam's axis, beyond which its light is below 1e-9


@pytest.fixture(scope="module")
def light() -> np.ndarray:
    """The mean light of the beam in each pixel, 1 at its axis, from sixteen rays per pixel; 0 far from the beam."""
    out = np.zeros((SIZE[1], SIZE[0]))
    first = np.rint(CAMERA.project(SCREEN.world_from_screen.apply(np.array([*PLACE, 0.0])))).astype(int) - REACH_PX
    fine = (4 * first[:, None] + np.arange(8 * REACH_PX) - 1.5) / 4
    origin, direction = CAMERA.rays(np.stack(np.meshgrid(*fine), axis=-1))
    away2 = np.sum((intersect_plane(origin, direction, SCREEN.world_from_screen) - PLACE) ** 2, axis=-1)
    near = np.exp(-0.5 * away2 / SPREAD_M**2).reshape(2 * REACH_PX, 4, 2 * REACH_PX, 4).mean(axis=(1, 3))
    out[first[1] : first[1] + 2 * REACH_PX, first[0] : first[0] + 2 * REACH_PX] = near
    return out


@pytest.fixture(scope="module")
def offsets() -> CentroidOffsets:
    return CentroidOffsets(CAMERA, SCREEN)


@pytest.mark.parametrize("exposure", [0.6, 1.5, 5.0])
@pytest.mark.parametrize("top", [255.0, 4095.0])
def test_a_wide_oblique_spot_is_where_its_axis_meets_the_screen(light, offsets, exposure, top):
    """exposure: height of the light over the range of the sensor. The centre of the light is 0.05 px away and more."""
    axis = CAMERA.project(SCREEN.world_from_screen.apply(np.array([*PLACE, 0.0])))
    expected = 10.0 + exposure * (top - 10.0) * light
    dtype = np.uint8 if top == 255 else np.uint16
    rng = np.random.default_rng(2)
    errors = []
    for _ in range(6):
        noisy = expected + rng.standard_normal(expected.shape)
        found = find_spots(np.clip(np.rint(noisy), 0, top).astype(dtype), DetectParameters(saturation_dn=top), NOISE)
        spot = int(np.argmax(found.flux))
        errors.append([points.uv_px[spot] - axis for points in (found, on_beam_axes(found, offsets, NOISE, top))])
    before, after = np.linalg.norm(np.mean(errors, axis=0), axis=-1)
    assert before > 0.05
    assert after < 0.15 * before
