"""Which noise model a camera's pictures are searched with, and what becomes of one that finds nothing."""

import numpy as np
import pytest

from geometry.camera import SensorNoise
from lab.runs.frames.sensor_noise import CameraNoise, noise_estimation_frames
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
    noise.learn(pictures(6))
    assert noise.notes == []
    assert noise.model.slope_dn == pytest.approx(1 / 30)
    said = noise.as_mapping()
    assert said["source"] == "rig"
    assert said["estimated"]["floor_dn2"] == pytest.approx(noise.model.variance(15.0), rel=0.3)


def test_a_stated_noise_that_the_pictures_contradict_is_a_note():
    noise = CameraNoise("left", SensorNoise(gain_e_per_dn=30.0, read_noise_e=450.0))
    noise.learn(pictures(6))
    assert len(noise.notes) == 1
    assert "rig.yaml states noise of 15 DN" in noise.notes[0]
    assert "correct `noise` in rig.yaml" in noise.notes[0]


def test_a_stated_noise_that_blinds_the_camera_gives_way():
    noise = CameraNoise("left", SensorNoise(gain_e_per_dn=0.02, read_noise_e=6.0))
    found = [len(noise.detect(p, PARAMETERS)) for p in pictures(5)]
    assert found == [0, 0, 3, 3, 3]
    assert noise.as_mapping()["source"] == "pictures"
    assert "no point was found in 3 pictures that show light" in noise.notes[-1]


def test_a_recording_whose_light_comes_later_is_not_blind():
    """The model of a dark start fits the lit frames as well, or is learnt again from them."""
    dark = Scene([], (400, 300), 2.0, gain=30.0, read=0.3)
    noise = CameraNoise("left")
    noise.learn(pictures(6, dark))
    assert [len(noise.detect(p, PARAMETERS)) for p in pictures(8)][-1] == 3


def test_a_dark_camera_stays_dark():
    dark = Scene([], (400, 300), 15.0, gain=30.0, read=1.5)
    noise = CameraNoise("left", TRUE)
    assert sum(len(noise.detect(p, PARAMETERS)) for p in pictures(8, dark)) == 0
    assert noise.notes == []


@pytest.mark.parametrize("count", [1, 2, 3, 7, 500])
def test_pictures_to_learn_from_are_pairs_of_neighbours(count):
    chosen = noise_estimation_frames(count)
    assert chosen == sorted(set(chosen))
    assert chosen[0] == 0
    assert chosen[-1] == count - 1
    if count > 6:
        assert all(b - a == 1 for a, b in zip(chosen[::2], chosen[1::2], strict=True))
