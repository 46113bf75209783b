"""The static background of a camera that is recording."""

from __future__ import annotations

import numpy as np

from lab.runs.frames.sensor_noise import VIDEO_FRAMES, CameraNoise
from lab.runs.watch.watch import LiveBackground
from tests.tracking.background.test_static_background import USUAL, Recording, path
from tracking.noise import Picture


def live(recording: Recording) -> tuple[CameraNoise, LiveBackground]:
    noise = CameraNoise("left")
    noise.estimate_from(recording.pictures[:6])
    return noise, LiveBackground(noise, USUAL)


def recall(noise: CameraNoise, picture: Picture, centres: np.ndarray) -> float:
    found = noise.detect(picture, USUAL).uv_px
    return float(np.mean([np.min(np.hypot(*(found - c).T), initial=9.0) < 1.5 for c in centres]))


def test_spots_that_the_texture_hides_are_found_once_the_background_has_been_seen():
    recording = Recording.of(path(120, 6, 2.0, 1), 4.5)
    noise, background = live(recording)
    before, after = [], []
    for k, picture in enumerate(recording.pictures):
        shown = recall(noise, picture, recording.centres[k])
        (before if noise.background is None else after).append(shown)
        background.add(picture)
        if k == VIDEO_FRAMES:
            background.finish()  # a busy machine takes its time
    assert VIDEO_FRAMES - 5 < len(before) <= VIDEO_FRAMES + 1
    assert np.mean(before) < 0.7
    assert np.mean(after) > 0.97


def test_a_knocked_camera_gets_another_background():
    recording = Recording.of(path(60, 6, 2.0, 1), 4.5)
    noise, background = live(recording)
    for picture in recording.pictures:
        noise.detect(picture, USUAL)
        background.add(picture)
    background.finish()
    first = noise.background
    assert first is not None
    moved = [np.roll(p, 3, axis=1) for p in recording.pictures]
    shift = np.array([3.0, 0.0])
    for _ in range(2):
        for picture in moved:
            noise.detect(picture, USUAL)
            background.add(picture)
    background.finish()
    assert noise.background is not None
    assert noise.background is not first
    assert np.mean([recall(noise, p, c + shift) for p, c in zip(moved, recording.centres, strict=True)]) > 0.97
