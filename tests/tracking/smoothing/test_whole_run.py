"""The estimate of a whole run's motion converges, also where the motion is nearly rigid."""

from __future__ import annotations

import numpy as np
import pytest

from geometry.arrays import Array, Bools
from geometry.pose import Pose
from lab.simulate.scenarios import RIGS
from tests.tracking.rigid_runs import RIGID, dt_of, found_in, recording_of, tracked
from tracking.smoothing.motion import whole_run
from tracking.smoothing.motion.fixed_interval import Interval
from tracking.smoothing.motion.interpolation import Interpolation
from tracking.smoothing.motion.run_detections import SmoothedMotion, WholeRun, spot_information, straight_between
from tracking.smoothing.motion.whole_run import MAX_PASSES, _Estimator, estimate
from tracking.smoothing.recording import TrackedRecording

AT_REST = Pose.from_ypr(np.deg2rad([7.0, 0.0, 0.0]), np.zeros(3))
FRAMES, GAP = 50, slice(26, 28)  # frames that the first estimate does not use


@pytest.mark.parametrize("step", [26, 27])
@pytest.mark.parametrize("seed", [0, 6, 11])
def test_a_step_of_a_vehicle_at_rest_is_fitted_after_an_estimate_without_its_frames(seed, step):
    """The jerk is close to zero then: a linear Gauss-Newton step costs more than it gains, at any damping."""
    rng = np.random.default_rng(seed)
    turn = np.deg2rad(rng.uniform(0.1, 1.5, 3) * rng.choice([-1, 1], 3))
    after = AT_REST.plus(np.concatenate([rng.normal(0, 0.002, 3), turn]))
    turned = np.arange(FRAMES) >= step
    poses = Pose(
        np.where(turned[:, None, None], after.rotation, AT_REST.rotation),
        np.where(turned[:, None], after.translation, AT_REST.translation),
    )
    run = recording_of(RIGS["four-skew-beams"](), poses, np.arange(FRAMES) / 80, 0.05, seed)
    recording = TrackedRecording(run.rig, RIGID)
    for k, frame in enumerate(tracked(run)):
        recording.append(dt_of(run, k), found_in(run, k), frame)
    detections, assigned, n = recording.run_detections(), recording.assigned, len(run.model)
    whole = WholeRun(run.model.numbers, detections, np.zeros((n, 2, 2)), recording.dt_s, 0.0, True)
    used = np.ones(FRAMES, dtype=bool)
    used[GAP] = False
    straight = np.concatenate([poses.rotation, poses.translation[:, None]], axis=1)
    jumped = np.arange(FRAMES) == GAP.stop  # as the tracker sees it after the gap
    motion = SmoothedMotion.begin(straight_between(straight, used, np.cumsum(recording.dt_s)), jumped, None)
    motion = estimate(whole, assigned, used, motion, 0, used)
    every = np.ones(FRAMES, dtype=bool)
    motion = estimate(whole, assigned, every, motion, 12, every)
    chi2 = spot_information(whole.views, detections, assigned, whole.calibration_cov, motion.ref, 0)[2]
    labels = (assigned >= 0).sum(axis=1)
    assert chi2.sum() / (2 * labels.sum()) < 1.2
    assert np.max(chi2 / np.maximum(2 * labels, 1)) < 4


@pytest.mark.parametrize("last", [True, False])
def test_a_vehicle_that_rests_at_the_end_of_the_spots_may_go_on_as_it_moved_before(last):
    """A turntable that turns, rests, and turns again in the frame of the last spots, or of the first."""
    t_s, rate_rad_s, rest = np.arange(FRAMES) / 80, 1.0, slice(30, 40)
    angle = rate_rad_s * (np.minimum(t_s, t_s[rest.start]) + np.maximum(t_s - t_s[rest.stop - 1], 0.0))
    seen = np.arange(FRAMES) < rest.stop
    if not last:
        angle, seen = angle[::-1].copy(), seen[::-1].copy()
    poses = AT_REST.plus(np.stack([0 * t_s] * 3 + [angle, 0 * t_s, 0 * t_s], axis=-1))
    run = recording_of(RIGS["four-skew-beams"](), poses, t_s, 0.02, 3)
    recording = TrackedRecording(run.rig, RIGID)
    for k, frame in enumerate(tracked(run)):
        recording.append(dt_of(run, k), found_in(run, k), frame)
    whole = WholeRun(
        run.model.numbers, recording.run_detections(), np.zeros((len(run.model), 2, 2)), recording.dt_s, 0.0, True
    )
    straight = np.concatenate([poses.rotation, poses.translation[:, None]], axis=1)
    begin = SmoothedMotion.begin(straight_between(straight, seen, t_s), np.zeros(FRAMES, dtype=bool), None)
    motion = estimate(whole, recording.assigned, seen, begin, 0, seen)
    beyond = np.flatnonzero(~seen)
    off = poses[beyond].minus(Pose(motion.ref.R[beyond], motion.ref.t[beyond]))
    nees = np.sum(off * np.linalg.solve(motion.pose_P[beyond], off[..., None])[..., 0], axis=1) / 6
    assert np.abs(off[:, 3]).max() > 0.1
    assert nees.max() < 8


def passes_over_a_corner(rate_rad_s: float, monkeypatch: pytest.MonkeyPatch) -> int:
    """Most passes of an estimate of a vehicle whose pitch rate jumps by twice a rate within an exposure.

    With the jump, and without it: they are compared.
    """
    t_s, corner_s, exposure_s = np.arange(FRAMES) / 100, 0.25, 5e-4
    angle = -rate_rad_s * np.abs(t_s - corner_s)
    poses = AT_REST.plus(np.stack([0 * t_s] * 4 + [angle, 0 * t_s], axis=-1))
    run = recording_of(RIGS["four-skew-beams"](), poses, t_s, 0.02, 3)
    recording = TrackedRecording(run.rig, RIGID)
    for k, frame in enumerate(tracked(run)):
        recording.append(dt_of(run, k), found_in(run, k), frame)
    detections, assigned, n = recording.run_detections(), recording.assigned, len(run.model)
    whole = WholeRun(run.model.numbers, detections, np.zeros((n, 2, 2)), recording.dt_s, exposure_s, True)
    every = np.ones(FRAMES, dtype=bool)
    straight = np.concatenate([poses.rotation, poses.translation[:, None]], axis=1)
    passes = []
    monkeypatch.setattr(_Estimator, "_step", lambda *a, step=_Estimator._step: passes.append(a[0]) or step(*a))
    motion = SmoothedMotion.begin(straight_between(straight, every, t_s), recording.jumped.copy(), None)
    estimate(whole, assigned, every, motion, 0, every)
    assert len(set(passes)) >= 2
    return max(map(passes.count, passes))


@pytest.mark.parametrize("rate_rad_s", np.geomspace(0.3, 3.0, 12))
def test_the_passes_end_where_the_corner_of_an_exposure_hides_how_the_vehicle_is_turned(rate_rad_s, monkeypatch):
    """The error of such an exposure grows with the jump of the rate, and with it the frame may become weak. The jump is
    then allowed in two steps, becomes smaller, and the frame would not be weak in the next pass.
    """
    assert passes_over_a_corner(rate_rad_s, monkeypatch) < MAX_PASSES


def test_the_passes_end_where_a_frame_is_at_the_limit_of_weak_ones(monkeypatch):
    """Each pass changes the information of a frame a little. Here the frame beside the corner is weak in every second
    one.
    """
    calls = []

    def alternating(information: Array, measured: Bools) -> Bools:
        calls.append(1)
        return (np.arange(len(measured)) == 24) & (len(calls) % 2 == 0)

    monkeypatch.setattr(whole_run, "weak_frames", alternating)
    assert passes_over_a_corner(1.0, monkeypatch) < MAX_PASSES
    assert len(calls) > 2


def test_the_passes_end_where_the_memory_lies_between_two_numbers_of_frames(monkeypatch):
    """A frame that leaves the interior makes the memory shorter, and would be in it again after the next pass."""
    calls, interior = [], _Estimator._interior

    def alternating(estimator: _Estimator, out: Interval) -> Bools:
        found = interior(estimator, out)
        found[15:18] = len(calls) % 2 == 0
        calls.append(1)
        return found

    monkeypatch.setattr(_Estimator, "_interior", alternating)
    monkeypatch.setattr(Interpolation, "best_offset", lambda *_: -4.0)
    assert passes_over_a_corner(1.0, monkeypatch) < MAX_PASSES
