"""The noise model of a camera, and its correction where nothing is detected."""

import cv2
import numpy as np
import pytest

from geometry.camera import SensorNoise
from lab.runs.frames.sensor_noise import CameraNoise, noise_estimation_frames, share_texture
from tests.tracking.background.test_static_background import Recording, path
from tests.tracking.rendering import Scene, Spot, photograph
from tracking.parameters import DetectParameters

SPOTS = [Spot(60.0 + 90 * i, 80.0 + 40 * i, 120.0, 2.0, 2.0) for i in range(3)]
SCENE = Scene(SPOTS, (400, 300), 15.0, gain=30.0, read=1.5)
TRUE = SensorNoise(gain_e_per_dn=30.0, read_noise_e=45.0)
PARAMETERS = DetectParameters()


def pictures(count, scene=SCENE):
    rng = np.random.default_rng(1)
    return [photograph(scene, rng) for _ in range(count)]


def test_a_stated_noise_is_used_and_compared():
    noise = CameraNoise("left", TRUE)
    noise.estimate_from(pictures(6))
    assert noise.notes == []
    assert noise.model.slope_dn == pytest.approx(1 / 30)
    mapping = noise.as_mapping()
    assert mapping["source"] == "rig"
    assert mapping["estimated"]["floor_dn2"] == pytest.approx(noise.model.variance(15.0), rel=0.3)


def test_a_stated_noise_that_contradicts_the_pictures_is_noted():
    noise = CameraNoise("left", SensorNoise(gain_e_per_dn=30.0, read_noise_e=450.0))
    noise.estimate_from(pictures(6))
    assert len(noise.notes) == 1
    assert "rig.yaml states noise of 15 DN" in noise.notes[0]
    assert "correct `noise` in rig.yaml" in noise.notes[0]


def test_a_stated_noise_with_which_no_spot_is_found_is_replaced():
    noise = CameraNoise("left", SensorNoise(gain_e_per_dn=0.02, read_noise_e=6.0))
    found = [len(noise.detect(p, PARAMETERS)) for p in pictures(5)]
    assert found == [0, 0, 3, 3, 3]
    assert noise.as_mapping()["source"] == "pictures"
    assert "no point was found in 3 pictures that show light" in noise.notes[-1]


def test_spots_that_appear_later_are_found():
    """The model of an unlit start fits the lit frames as well, or is estimated again from them."""
    unlit = Scene([], (400, 300), 2.0, gain=30.0, read=0.3)
    noise = CameraNoise("left")
    noise.estimate_from(pictures(6, unlit))
    assert [len(noise.detect(p, PARAMETERS)) for p in pictures(2)][-1] == 3


def test_a_camera_without_light_finds_no_spots():
    unlit = Scene([], (400, 300), 15.0, gain=30.0, read=1.5)
    noise = CameraNoise("left", TRUE)
    assert sum(len(noise.detect(p, PARAMETERS)) for p in pictures(8, unlit)) == 0
    assert noise.notes == []


def test_the_noise_model_is_built_once_and_not_for_every_picture():
    noise = CameraNoise("left", TRUE)
    noise.estimate_from(pictures(6))
    model = noise.model
    for picture in pictures(2):
        noise.detect(picture, PARAMETERS)
        assert noise.model is model


@pytest.mark.parametrize("count", [1, 2, 3, 7, 500])
def test_the_noise_is_estimated_from_pairs_of_neighbours(count):
    chosen = noise_estimation_frames(count)
    assert chosen == sorted(set(chosen))
    assert chosen[0] == 0
    assert chosen[-1] == count - 1
    if count > 6:
        assert all(b - a == 1 for a, b in zip(chosen[::2], chosen[1::2], strict=True))


@pytest.mark.parametrize("stated", [TRUE, None])
def test_a_colour_mosaic_is_found_whether_or_not_the_noise_is_stated(stated):
    filters = np.tile([[0.8, 1.0], [1.0, 0.6]], (150, 200))
    noise = CameraNoise("left", stated)
    noise.estimate_from([np.rint(10 * p * filters).astype(np.uint16) for p in pictures(2)])
    assert noise.mosaic > 0.1
    noise.estimate_from(pictures(2))
    assert noise.mosaic == 0.0


def test_a_camera_with_a_background_too_faint_for_texture_takes_that_of_another_camera():
    rng = np.random.default_rng(4)
    grain = cv2.GaussianBlur(rng.standard_normal((320, 400)), (0, 0), 1.0)
    screen = 1 + 0.04 * grain / grain.std()

    def seen(name: str, level: float, noise_dn: float) -> CameraNoise:
        camera = CameraNoise(name)
        expected = level * screen
        camera.estimate_from(
            [np.rint(expected + noise_dn * rng.standard_normal(expected.shape)).astype(np.uint8) for _ in range(4)]
        )
        return camera

    bright, faint, alone = seen("bright", 60.0, 1.0), seen("faint", 4.0, 0.1), seen("alone", 4.0, 0.1)
    assert not faint.estimate.texture_shift.known
    share_texture([bright, faint])
    assert faint.estimate.texture_shift == bright.estimate.texture_shift.of_light
    assert max(faint.estimate.texture_shift.light_px) > 0.02
    share_texture([alone])
    assert not alone.estimate.texture_shift.known


def test_faint_spots_on_texture_are_detected_once_the_pictures_have_shown_their_background():
    recording = Recording.of(path(45, 6, 4.0, 1), 4.5)
    noise = CameraNoise("left")
    noise.estimate_from(recording.pictures[:2] + recording.pictures[-2:])

    def found() -> int:
        hits = 0
        for picture, centres in zip(recording.pictures, recording.centres, strict=True):
            points = noise.detect(picture, DetectParameters())
            hits += sum(np.min(np.hypot(*(points.uv_px - c).T), initial=9) < 1.5 for c in centres)
        return hits

    before = found()
    noise.make_background(recording.pictures[::3], DetectParameters())
    assert noise.as_mapping()["background_pictures"] == 15
    assert found() > 0.97 * recording.centres[..., 0].size > 1.3 * before
