"""What a recording shows of the errors of its rig agrees with the errors that it was made with."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest

from geometry.arrays import Array, Bools, Ints
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.uncertainty.rig_uncertainty import RigCovariance, RigUncertainty, covariance_root, perturbed_rig
from lab.simulate.scenarios import RIGS
from tracking.rigid_body.association.frame_detections import BLENDED
from tracking.smoothing.motion.run_detections import Reference, RunDetections
from tracking.smoothing.rig_errors import RigErrors

RIG = RIGS["two-cameras-per-screen"]()
MODEL = SpotModel.of(RIG)
NAMES = tuple(f"cameras.{camera}.{p}" for camera in RIG.cameras for p in ("cx", "cy"))
COVARIANCE = RigCovariance(NAMES, np.diag(np.full(len(NAMES), 0.5**2)))  # px^2: ten times the noise
UNCERTAINTY = RigUncertainty(RIG, MODEL, COVARIANCE)
NOISE_PX = 0.05
FRAMES = 40


class Recording(NamedTuple):
    """A recording with a rig that is wrong by known errors."""

    run: RunDetections
    assigned: Ints
    ref: Reference
    measured: Bools
    errors: Array  # (r,) in the order of RigErrors


def recording(seed: int, noise_px: float = NOISE_PX, frames: int = FRAMES, moving: float = 1.0) -> Recording:
    rng = np.random.default_rng([28, seed])
    root = covariance_root(COVARIANCE.matrix)
    errors = rng.standard_normal(root.shape[1])
    true = SpotModel.of(perturbed_rig(RIG, NAMES, root @ errors))
    moved = moving * rng.normal(size=(frames, 6)) * ([0.05] * 3 + [0.08] * 3)
    poses = Pose(np.tile(np.eye(3), (frames, 1, 1)), np.zeros((frames, 3))).plus(moved)
    pixels = true.project(poses)[0]
    uv = pixels + noise_px * rng.standard_normal(pixels.shape)
    n = len(MODEL)
    begin = n * np.arange(frames + 1)
    cov = np.tile(NOISE_PX**2 * np.eye(2), (frames * n, 1, 1))
    first = np.searchsorted(MODEL.camera_of, np.arange(len(RIG.cameras) + 1))
    run = RunDetections(
        uv.reshape(-1, 2), cov, np.zeros(frames * n), begin, np.tile(first, (frames, 1)),
        np.ones((frames, len(RIG.cameras)), dtype=bool), np.full(frames * n, 2.0), np.full(n, 2.0),
    )  # fmt: skip
    near = poses.plus(rng.normal(size=(frames, 6)) * 1e-3)  # poses are fitted: those of the motion need not be right
    assigned = np.where(np.isfinite(uv).all(axis=-1) & MODEL.in_picture(uv), np.arange(n), -1)
    ref = Reference(near.rotation, near.translation, np.zeros((frames, 12)))
    return Recording(run, assigned, ref, np.ones(frames, dtype=bool), errors)


def shown(r: Recording, place_px2: Array | None = None) -> RigErrors:
    place = np.zeros(len(r.run.uv)) if place_px2 is None else place_px2
    return RigErrors.shown(UNCERTAINTY, MODEL.numbers, r.run, r.assigned, place, r.ref, r.measured)


def misfit(r: Recording, run: RunDetections) -> float:
    """Root mean square residual, px, of the labelled points to the pose of each frame that fits them best."""
    pixels, J = MODEL.project(Pose(r.ref.R, r.ref.t))
    left = []
    for k, labelled in enumerate(r.assigned >= 0):
        apart = (run.uv[run.begin[k] : run.begin[k + 1]] - pixels[k])[labelled].ravel()
        A = J[k, labelled].reshape(-1, 6)
        left.append(apart - A @ np.linalg.lstsq(A, apart, rcond=None)[0])
    return float(np.sqrt(np.mean(np.concatenate(left) ** 2)))


def test_the_errors_scatter_about_their_mean_as_its_covariance_says():
    nees, known = [], []
    for seed in range(25):
        r = recording(seed)
        found = shown(r)
        off = r.errors - found.mean
        nees.append(off @ np.linalg.solve(found.covariance, off) / len(off))
        known.append(np.trace(found.covariance) / len(off))
    assert 0.75 < np.mean(nees) < 1.25  # 25 x 8 squared normal errors: 1 with a standard deviation of 0.1
    assert np.max(known) < 0.05  # variances, of 1 before the recording


def test_what_is_taken_from_the_points_is_what_the_rig_has_added():
    r = recording(1, noise_px=0.0)
    less, unknown = shown(r).taken_from(MODEL.numbers, r.run, r.assigned, r.ref)
    assert misfit(r, r.run) > 3 * NOISE_PX
    assert misfit(r, less) < 0.1 * NOISE_PX
    assert unknown.shape == (len(MODEL), 2, 2)
    np.testing.assert_array_equal(less.cov, r.run.cov)


def test_what_stays_in_the_residuals_scatters_as_stated():
    left, stated = [], []
    for seed in range(25):
        r = recording(seed)
        found, frames = shown(r), np.arange(FRAMES)
        nothing = np.zeros((len(MODEL), 2, 2))
        shift, unknown = found.in_residuals(MODEL.numbers, r.run, r.assigned, frames, r.ref, nothing)
        truth = RigErrors(UNCERTAINTY, r.errors, found.covariance)
        true_shift = truth.in_residuals(MODEL.numbers, r.run, r.assigned, frames, r.ref, nothing)[0]
        left.append(np.mean((true_shift - shift) ** 2))
        stated.append(np.mean(np.trace(unknown, axis1=2, axis2=3)) / 2)
    assert np.mean(left) == pytest.approx(np.mean(stated), rel=0.3)
    assert np.mean(stated) < 0.1 * NOISE_PX**2


def test_more_covariance_of_the_points_changes_the_poses_and_not_the_errors():
    r = recording(3)
    found, frames = shown(r), np.arange(7)
    nothing = np.zeros((len(MODEL), 2, 2))
    same = found.in_residuals(MODEL.numbers, r.run, r.assigned, frames, r.ref, nothing + NOISE_PX**2 * np.eye(2))[0]
    one = nothing.copy()
    one[0] = 100 * np.eye(2)  # its residual is then the whole error of its view
    usual = found.in_residuals(MODEL.numbers, r.run, r.assigned, frames, r.ref, nothing)[0]
    other = found.in_residuals(MODEL.numbers, r.run, r.assigned, frames, r.ref, one)[0]
    np.testing.assert_allclose(same, usual, atol=1e-9)
    assert np.abs(other[:, 0]).mean() > np.abs(usual[:, 0]).mean()


def test_wrong_labels_and_blended_points_say_nothing_about_the_rig():
    r = recording(2)
    usual, uv, assigned = shown(r), r.run.uv.copy(), r.assigned.copy()
    uv[r.run.begin[5] + 1] += 30.0  # a wrong label
    assigned[9, 0] += BLENDED  # shifted by a neighbour
    uv[r.run.begin[9]] += 3.0
    found = shown(r._replace(run=r.run._replace(uv=uv), assigned=assigned))
    assert np.all(np.abs(found.mean - usual.mean) < 0.7 * np.sqrt(np.diagonal(usual.covariance)))
    np.testing.assert_allclose(np.trace(found.covariance), np.trace(usual.covariance), rtol=0.05)


def test_frames_that_are_not_measured_are_not_used():
    r = recording(4)
    measured = np.arange(FRAMES) % 2 == 0
    uv = r.run.uv.reshape(FRAMES, -1, 2).copy()
    uv[~measured] += 100.0
    found = shown(r._replace(run=r.run._replace(uv=uv.reshape(-1, 2)), measured=measured))
    np.testing.assert_allclose(found.mean, shown(r._replace(measured=measured)).mean)


def test_errors_of_places_count_once_for_a_vehicle_at_rest():
    resting = recording(6, moving=0.0)
    variance = np.full(len(resting.run.uv), NOISE_PX**2)
    every, one = shown(resting, variance), resting.measured & (np.arange(FRAMES) == 3)
    alone = shown(resting._replace(measured=one), variance)
    np.testing.assert_allclose(np.trace(every.covariance), np.trace(alone.covariance), rtol=0.02)
    assert np.trace(shown(resting).covariance) < 0.98 * np.trace(alone.covariance)
    # Where the spots move by many widths, nearly each frame shows another place: as for noise.
    moving = recording(6)
    of_places, of_noise = np.trace(shown(moving, variance).covariance), np.trace(shown(moving).covariance)
    np.testing.assert_allclose(of_places, of_noise, rtol=0.2)
