"""Motions of the vehicle in the scenes: smooth sums of sines, or straight segments with abrupt reversals."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from geometry.arrays import Array

RATE_HZ = 100.0
AMPLITUDE = np.array([1.0, 1.0, 0.6, *np.deg2rad([30.0, 20.0, 30.0])])  # x, y, z (m), yaw, pitch, roll (rad)
YAW_MIDDLE = np.deg2rad(7.0)  # yaw runs from -16 to 30 deg: beam C leaves the pictures, A and B stay
YAW_REACH = np.deg2rad(23.0)
FASTEST = np.array([2.5, 2.5, 1.5, *np.deg2rad([110.0, 70.0, 110.0])])  # m/s and rad/s between reversals


def smooth(
    frames: int, rng: np.random.Generator, speed: float = 1.0, stay_out: bool = False
) -> tuple[Array, list[int]]:
    """Two sines per coordinate, the second with a random phase.

    speed: factor on the frequencies. stay_out: yaw stays near its extremes, so that a pair of spots is out of view for
    hundreds of frames. Returns x, y, z (m), yaw, pitch, roll (rad) as (frames, 6), and the frames where yaw reverses.
    """
    t = np.arange(frames) / RATE_HZ
    slow_hz = np.array([0.11, 0.17, 0.13, 0.29, 0.23, 0.15]) * speed
    quick_hz = np.array([0.31, 0.41, 0.37, 0.61, 0.53, 0.29]) * speed
    slow_phase = np.array([0, 0.4, 1.0, 0.2, 2.0, 0.7])
    quick_phase = rng.uniform(0, 2 * np.pi, 6)
    q = AMPLITUDE * (
        0.72 * np.sin(2 * np.pi * t[:, None] * slow_hz + slow_phase)
        + 0.28 * np.sin(2 * np.pi * t[:, None] * quick_hz + quick_phase)
    )
    if stay_out:
        swing = np.tanh(2.5 * np.sin(2 * np.pi * 0.12 * t - 0.5)) / np.tanh(2.5)
        q[:, 3] = YAW_MIDDLE + YAW_REACH * swing
    else:
        q[:, 3] = YAW_MIDDLE + q[:, 3] * (YAW_REACH / AMPLITUDE[3])
    rate = np.diff(q[:, 3])
    return q, [k for k in range(2, frames - 2) if rate[k - 1] * rate[k] < 0]


def reversals(frames: int, rng: np.random.Generator) -> tuple[Array, list[int]]:
    """Straight segments of 18 to 59 frames, each towards the other side: the velocity reverses within one frame.

    Returns as `smooth`; the frames are those of the reversals.
    """
    flips = [0]
    while flips[-1] < frames:
        flips.append(flips[-1] + int(rng.integers(18, 60)))
    middle = np.array([0, 0, 0, YAW_MIDDLE, 0, 0])
    corner = np.array([0, 0, 0, *np.deg2rad([-5.0, 3.0, 5.0])])
    corners = [corner]
    for before, after in pairwise(flips):
        target = AMPLITUDE * rng.uniform(0.25, 1.0, 6) * np.where(corner > middle, -1, 1)
        target[3] = YAW_MIDDLE + target[3] * (YAW_REACH / AMPLITUDE[3])
        most = FASTEST / RATE_HZ * (after - before)
        corner = corner + np.clip(target - corner, -most, most)
        corners.append(corner)
    q = np.stack([np.interp(np.arange(frames), flips, column) for column in np.transpose(corners)], axis=-1)
    return q, [k for k in flips if 2 < k < frames - 2]
