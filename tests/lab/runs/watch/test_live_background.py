"""The static background of a camera that is recording."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lab.runs.frames.sensor_noise import VIDEO_FRAMES, CameraNoise
from lab.runs.watch.background import FunctionProcess, LiveBackground
from tests.tracking.background.test_static_background import USUAL, Recording, path
from tracking.noise import Picture


def at_once(function: Callable, *given: Any) -> Any:
    return function(*given)


def live(recording: Recording, call: Callable = at_once) -> tuple[CameraNoise, LiveBackground]:
    noise = CameraNoise("left")
    noise.estimate_from(recording.pictures[:6])
    return noise, LiveBackground(noise, USUAL, call)


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


def test_a_process_makes_the_same_background_until_it_is_ended():
    recording = Recording.of(path(90, 6, 2.0, 1), 4.5)
    own, background = live(recording)
    with FunctionProcess() as process:
        others, made_elsewhere = live(recording, process.call)
        for picture in recording.pictures[: VIDEO_FRAMES + 1]:
            background.add(picture)
            made_elsewhere.add(picture)
        background.finish()
        made_elsewhere.finish()
    for name in ("uv_px", "cov_px2", "flux"):
        one, other = (getattr(noise.detect(recording.pictures[70], USUAL), name) for noise in (own, others))
        np.testing.assert_array_equal(one, other)
    assert own.background is not None
    kept = others.background
    assert kept is not None
    for picture in recording.pictures:
        made_elsewhere.add(picture)
    made_elsewhere.finish()
    assert others.background is kept


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="reads the process time of another process")
def test_the_process_gives_way_to_the_watch_before_it_loads_the_program():
    """Its imports take a second of a core, in which poses would be late."""
    with FunctionProcess() as process:
        process.start()
        assert process._process is not None
        number = process._process.pid
        for _ in range(2000):
            low = os.getpriority(os.PRIO_PROCESS, number) > os.getpriority(os.PRIO_PROCESS, 0)
            used = Path(f"/proc/{number}/stat").read_text("utf-8").rpartition(")")[2].split()
            if low:
                break
            time.sleep(0.01)
        assert low
        assert (int(used[11]) + int(used[12])) / os.sysconf("SC_CLK_TCK") < 0.3


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
