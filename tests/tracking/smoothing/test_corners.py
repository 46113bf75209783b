"""Corners of the motion between two frames, hard and soft: labels are kept, and the covariances are right."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from geometry.arrays import Array, Bools
from geometry.pose import Pose
from lab.simulate.points import PointRun
from lab.simulate.scenarios import RIGS, PriorRegion
from tests.marks import further_slow
from tests.tracking.rigid_runs import (
    RIGID,
    Assessment,
    assess,
    dt_of,
    found_in,
    recording_of,
    smoothed_frames,
    tracked,
    zig_zag,
)
from tracking.smoothing.recording import TrackedRecording
from tracking.smoothing.smoother import smooth

NOISE_PX = 0.01
START = Pose.from_ypr(np.deg2rad([7.0, 0.0, 0.0]), np.zeros(3))
PRIOR = PriorRegion((0.0, 0.0, 0.0), (7.0, 0.0, 0.0), 0.3, 15.0)
# Angular rates, 1 sigma, rad/s. A spot moves by some 1200 px per rad: 12 px per frame, and 0.2 px.
HARD, SOFT = 1.0, 0.02
FRAMES, EVERY = 160, 23
COVERED = 12.592  # 95 % quantile of chi-square with 6 degrees of freedom


@cache
def both(rate: float, seed: int) -> tuple[PointRun, Assessment, Assessment]:
    poses, t_s, turned = zig_zag(seed, FRAMES, 100.0, EVERY, rate, START)
    run = recording_of(RIGS["four-skew-beams"](), poses, t_s, NOISE_PX, seed, turned, prior=PRIOR)
    causal = tracked(run)
    again, _ = smoothed_frames(run, causal)
    return run, assess(run, causal), assess(run, again)


@pytest.mark.parametrize("rate", further_slow([HARD, SOFT]), ids=["hard", "soft"])
def test_corners_between_frames_keep_all_labels(rate):
    for seed in (1, 2):
        run, causal, smoothed = both(rate, seed)
        assert run.turned.sum() >= 5
        for of in (causal, smoothed):
            assert of.wrong == 0
        assert smoothed.missed() == 0


@pytest.mark.parametrize("rate", [HARD, SOFT], ids=["hard", "soft"])
def test_covariances_near_corners_between_frames_are_right(rate):
    nees = np.concatenate([both(rate, seed)[2].nees for seed in (1, 2)])
    near = np.concatenate([np.convolve(both(rate, seed)[0].turned, np.ones(5), "same") > 0 for seed in (1, 2)])
    assert 0.7 < np.mean(nees) / 6 < 1.4
    assert np.mean(nees < COVERED) >= 0.9
    assert np.mean(nees[near]) / 6 < 1.6
    assert np.max(nees) < 60


@cache
def cached_zig_zag(seed: int, frames: int, rate_hz: float, every: int) -> tuple[Pose, Array, Bools]:
    return zig_zag(seed, frames, rate_hz, every, HARD, START)


@pytest.mark.parametrize("share", further_slow([0.5, 0.05, 0.2]))
def test_a_corner_within_an_exposure_does_not_shift_the_pose_beyond_its_sigma(share):
    """A spot's mean over the exposure lies beside the corner, by up to an eighth of the exposure times the jump."""
    parts, frames, rate_hz = 100, 120, 100.0
    inside, others = [], []
    for seed in (1, 2, 3):
        # The corners are from 3 % of a frame before the middle of an exposure to 6 % after it.
        every = 11 * parts + 1
        fine, fine_t, turned = cached_zig_zag(seed, frames * parts, rate_hz * parts, every)
        middle, half = np.arange(parts + 4, (frames - 2) * parts, parts), round(share * parts / 2)
        during = [fine[middle + i].minus(fine[middle]) for i in range(-half, half + 1)]
        mean = fine[middle].plus(np.mean(during, axis=0))
        run = recording_of(RIGS["four-skew-beams"](), mean, fine_t[middle], NOISE_PX, seed, prior=PRIOR)
        recording = TrackedRecording(run.rig, RIGID, exposure_s=share / rate_hz)
        for k, frame in enumerate(tracked(run)):
            recording.append(dt_of(run, k), found_in(run, k), frame)
        result = smooth(recording)
        assert result.measured.all()
        error = result.poses.minus(fine[middle])
        nees = np.einsum("ki,kij,kj->k", error, np.linalg.inv(result.covariance), error)
        corner = np.array([turned[k - half : k + half + 1].any() for k in middle])
        inside.append(nees[corner])
        others.append(nees[~corner])
    assert np.mean(np.concatenate(inside)) / 6 < 2.5  # these are nearly the largest errors
    assert 0.75 < np.mean(np.concatenate(others)) / 6 < 1.25
    assert max(np.max(n) for n in (*inside, *others)) < 60
    assert len(np.concatenate(inside)) >= 3


def errors_of_a_swing(seed: int, share: float, hz: float, rad: float) -> tuple[Array, Array]:
    """Pose errors (T, 6) and NEES / 6 (T,) of a vehicle whose components swing at about hz and 100 frames per second.

    rad: 1 sigma of the amplitudes of the angles. Spots are the means of their paths over a share of the frame.
    """
    rng = np.random.default_rng([seed, 9])
    t_s, rate_hz = np.arange(90) / 100.0, 100.0
    turn, phase = 2 * np.pi * hz * rng.uniform(0.8, 1.2, 6), rng.uniform(0, 2 * np.pi, 6)
    size = rad * np.repeat([1 / 3, 1.0], 3) * rng.normal(size=6)

    def at(moment: Array) -> Pose:
        return START.plus(size * np.sin(turn * moment[:, None] + phase))

    run = recording_of(RIGS["four-skew-beams"](), at(t_s), t_s, NOISE_PX, seed, prior=PRIOR)
    streak = -run.model.project(at(t_s))[0]
    for node, weight in zip(*np.polynomial.legendre.leggauss(6), strict=True):
        streak += 0.5 * weight * run.model.project(at(t_s + 0.5 * share / rate_hz * node))[0]
    measured = tuple(
        tuple(replace(d, uv_px=d.uv_px + of_frame[spots]) for d, spots in zip(detections, origin, strict=True))
        for detections, origin, of_frame in zip(run.detections, run.origin, streak, strict=True)
    )
    run = replace(run, detections=measured)
    recording = TrackedRecording(run.rig, RIGID, exposure_s=share / rate_hz)
    for k, frame in enumerate(tracked(run)):
        recording.append(dt_of(run, k), found_in(run, k), frame)
    result = smooth(recording)
    error = result.poses.minus(at(t_s))
    return error, np.einsum("ki,kij,kj->k", error, np.linalg.inv(result.covariance), error) / 6


@pytest.mark.parametrize(
    ("hz", "rad", "seed"), further_slow([(9.0, 0.03, 1), (6.0, 0.1, 1), (6.0, 0.1, 2), (6.0, 0.03, 1)], fast=2)
)
def test_a_fast_swing_is_no_series_of_corners(hz, rad, seed):
    """Of a corner within an exposure nothing shows where it is; a swing in long exposures is as exact as in short ones.

    The angles turn back every eight frames or so, and the spots move by up to 50 px from frame to frame.
    """
    instant, _ = errors_of_a_swing(seed, 0.0, hz, rad)
    long, nees = errors_of_a_swing(seed, 0.4, hz, rad)
    rms = [np.sqrt(np.mean(e[:, 3:] ** 2)) for e in (instant, long)]
    assert rms[1] < 1.25 * rms[0]
    assert 0.4 < np.mean(nees) < 1.5
    assert np.max(nees) < 7


def test_strong_accelerations_within_a_long_exposure_are_in_the_covariances():
    """A step of the vehicle within six frames: beside its start and end the acceleration is not that of any jump."""
    parts, share, rate_hz, frames = 20, 0.56, 100.0, 60
    nees = []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        moment, step = np.arange(frames * parts) / parts, rng.normal(0, [0.03] * 3 + [0.04] * 3, (2, 6))
        way = np.clip((moment[:, None] - rng.uniform([18, 38], [19, 39])) / 6, 0, 1)
        fine = START.plus((3 * way**2 - 2 * way**3) @ step)
        middle = np.arange(parts // 2, frames * parts - parts // 2, parts)
        half = int(share * parts / 2)
        during = [fine[middle + i].minus(fine[middle]) for i in range(-half, half + 1)]
        mean = fine[middle].plus(np.mean(during, axis=0))
        run = recording_of(RIGS["four-skew-beams"](), mean, moment[middle] / rate_hz, NOISE_PX, seed, prior=PRIOR)
        recording = TrackedRecording(run.rig, RIGID, exposure_s=share / rate_hz)
        for k, frame in enumerate(tracked(run)):
            recording.append(dt_of(run, k), found_in(run, k), frame)
        result = smooth(recording)
        error = result.poses.minus(fine[middle])
        nees.append(np.einsum("ki,kij,kj->k", error, np.linalg.inv(result.covariance), error))
    assert np.mean(nees) / 6 < 1.2
    assert np.max(nees) < 60
