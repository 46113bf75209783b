"""No frame is written with an invalid covariance, or with a pose that contradicts its spots or the causal pass."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.uncertainty.rig_uncertainty import RigCovariance
from lab.runs.frames.pipeline import FrameRecord
from lab.runs.verdict.run_statistics import CONTRADICTION, NOT_A_COVARIANCE, FrameChecks
from tests.geometry.scenes import paper_rig
from tracking.detections import Detections
from tracking.statuses import MotionEstimate, PoseStatus, SpotStatus, TrackedFrame

RIG = paper_rig()
MODEL = SpotModel.of(RIG)
N = len(MODEL)
P = np.diag([1e-4**2] * 3 + [5e-5**2] * 3)


def a_record(frame: int = 0, off: float = 0.0, spots: int = N, sigma_px: float = 0.1) -> FrameRecord:
    """A measured frame whose reported pose differs by `off` sigmas in every axis from the pose by its spots."""
    rng = np.random.default_rng(frame)
    true = Pose.identity()
    uv, _ = MODEL.project(true)
    measured = np.arange(N) < spots
    uv = uv + sigma_px * rng.standard_normal(uv.shape)
    tracked = TrackedFrame(
        uv_px=uv,
        cov_px2=np.broadcast_to(sigma_px**2 * np.eye(2), (N, 2, 2)).copy(),
        status=tuple(SpotStatus.MATCHED if m else SpotStatus.OCCLUDED for m in measured),
        predicted_px=uv,
        gain=np.full(N, np.nan),
        point=np.where(measured, 0, -1),
        pose_status=PoseStatus.MEASURED,
        pose=true.plus(off * np.sqrt(np.diagonal(P))),
        pose_covariance=P.copy(),
        spots_used=spots,
        rms_px=0.01,
        events=(),
        motion=MotionEstimate(np.zeros(3), np.zeros(3), np.eye(6)),
    )
    return FrameRecord(frame, 0.01 * frame, 0.01, (Detections.none(),) * 2, ("", ""), tracked)


def changed(record: FrameRecord, **fields: object) -> FrameRecord:
    # mypy cannot know which field each keyword is for.
    return replace(record, tracked=replace(record.tracked, **fields))  # type: ignore[arg-type]


def test_a_correct_frame_changes_only_in_its_residual():
    record = a_record()
    checks = FrameChecks(RIG)
    ((kept, nothing),) = checks.passed([(record, None)])
    assert nothing is None
    assert replace(kept.tracked, rms_px=0.01) == record.tracked
    residual = record.tracked.uv_px - MODEL.project(record.tracked.pose)[0]
    assert kept.tracked.rms_px == pytest.approx(np.sqrt(np.mean(residual**2)))
    assert (len(checks.own_spots), len(checks.causal), len(checks.invalid)) == (0, 0, 0)


def test_all_frames_are_returned_in_order():
    records = [(a_record(k), a_record(k)) for k in range(150)]
    out = list(FrameChecks(RIG).passed(iter(records)))
    assert [(now.frame, then.frame) for now, then in out if then is not None] == [(k, k) for k in range(150)]
    assert list(FrameChecks(RIG).passed([])) == []


def distance(pose: Pose, of: Pose, covariance: np.ndarray) -> float:
    gap = pose.minus(of)
    return float(np.sqrt(gap @ np.linalg.solve(covariance, gap)))


def test_a_pose_that_contradicts_its_spots_is_predicted_with_sigmas_that_cover_the_pose_by_the_spots():
    record = a_record(off=200.0)
    checks = FrameChecks(RIG)
    (_, (kept, _)) = checks.passed([(a_record(3), None), (replace(record, frame=4), None)])
    t = kept.tracked
    assert distance(Pose.identity(), record.tracked.pose, P) > 400
    assert t.pose_status is PoseStatus.PREDICTED
    assert distance(Pose.identity(), t.pose, t.pose_covariance) < 2
    assert t.motion is None
    assert np.isnan(t.rms_px)
    assert t.spots_used == 0
    assert [e.kind for e in t.events] == [CONTRADICTION]
    assert checks.own_spots.ranges == [[4, 4]]


def test_the_sigmas_cover_the_causal_pose_too_since_the_spots_may_be_wrongly_labelled():
    """The pose by the spots is 200 sigmas from the reported one, and the causal pose is on the other side."""
    record, causal = a_record(off=200.0, spots=4), a_record(off=400.0)
    uv, _ = MODEL.project(causal.tracked.pose)
    causal = changed(causal, uv_px=uv)
    ((kept, _),) = FrameChecks(RIG).passed([(record, causal)])
    t = kept.tracked
    for pose in (Pose.identity(), causal.tracked.pose):
        assert distance(pose, t.pose, t.pose_covariance) < 2
    _, J = MODEL.project(t.pose)
    hidden = J[5] @ t.pose_covariance @ J[5].T
    np.testing.assert_allclose(t.cov_px2[5] - record.tracked.cov_px2[5], hidden - J[5] @ P @ J[5].T, rtol=1e-6)
    np.testing.assert_allclose(t.cov_px2[0], record.tracked.cov_px2[0])


def test_a_pose_that_two_spots_contradict_is_widened_by_their_chi_square():
    record = a_record(off=200.0, spots=2)
    checks = FrameChecks(RIG)
    ((kept, _),) = checks.passed([(record, None)])
    assert len(checks.own_spots) == 1
    assert np.all(np.diagonal(kept.tracked.pose_covariance) > 100 * np.diagonal(P))


def test_a_smoothed_pose_without_spots_covers_the_causal_pose_that_it_contradicts():
    smoothed = changed(
        a_record(off=200.0), status=(SpotStatus.OCCLUDED,) * N, point=np.full(N, -1), pose_status=PoseStatus.PREDICTED
    )
    causal = a_record(spots=3)
    checks = FrameChecks(RIG)
    ((kept, then),) = checks.passed([(smoothed, causal)])
    assert checks.causal.ranges == [[0, 0]]
    assert kept.tracked.pose_status is PoseStatus.PREDICTED
    assert distance(causal.tracked.pose, kept.tracked.pose, kept.tracked.pose_covariance) < 1
    assert then is not None
    assert then.tracked.pose_status is PoseStatus.MEASURED  # the causal tables are unchanged
    agreeing = changed(smoothed, pose=causal.tracked.pose)
    assert [len(c.causal) for c in [checked(agreeing, causal)]] == [0]


def checked(now: FrameRecord, then: FrameRecord | None = None) -> FrameChecks:
    checks = FrameChecks(RIG)
    list(checks.passed([(now, then)]))
    return checks


def test_a_spot_that_is_excluded_from_the_pose_does_not_contradict_it():
    record = a_record()
    uv = record.tracked.uv_px.copy()
    uv[2] += 3.0
    assert len(checked(changed(record, uv_px=uv)).own_spots) == 1
    assert len(checked(changed(record, uv_px=uv, used_in_pose=np.arange(N) != 2)).own_spots) == 0


def test_a_deviation_within_the_calibrations_covariance_is_no_contradiction():
    """A camera whose principal point has a sigma of 4 px: all its spots may deviate by 4 px."""
    record = a_record()
    uv = record.tracked.uv_px + np.where((MODEL.camera_of == 1)[:, None], 4.0, 0.0)
    off = changed(record, uv_px=uv)
    assert len(checked(off).own_spots) == 1
    checks = FrameChecks(RIG, RigCovariance(("cameras.right.cx", "cameras.right.cy"), 4.0**2 * np.eye(2)))
    list(checks.passed([(off, None)]))
    assert len(checks.own_spots) == 0


NOT_POSITIVE = np.diag([1.0, 1.0, 1.0, 1.0, 1.0, -1e-9])


def test_a_pose_with_an_invalid_covariance_is_lost_and_its_measured_spots_stay():
    checks = FrameChecks(RIG)
    record = changed(a_record(spots=4), pose_covariance=NOT_POSITIVE)
    ((kept, _),) = checks.passed([(record, None)])
    t = kept.tracked
    assert t.pose_status is PoseStatus.LOST
    assert (t.pose, t.pose_covariance, t.motion, t.spots_used) == (None, None, None, 0)
    assert t.status == (SpotStatus.MATCHED,) * 4 + (SpotStatus.LOST,) * 2
    assert np.isfinite(t.uv_px[:4]).all()
    assert np.isnan(t.uv_px[4:]).all()
    assert [e.kind for e in t.events] == [NOT_A_COVARIANCE]
    assert "internal error" in t.events[0].text
    assert checks.invalid.ranges == [[0, 0]]


def test_velocities_with_an_invalid_covariance_are_omitted_and_the_pose_stays():
    checks = FrameChecks(RIG)
    record = changed(a_record(), motion=MotionEstimate(np.zeros(3), np.zeros(3), NOT_POSITIVE))
    ((kept, _),) = checks.passed([(record, None)])
    assert kept.tracked.motion is None
    assert kept.tracked.pose_status is PoseStatus.MEASURED
    assert len(checks.invalid) == 1


def test_a_spot_with_an_invalid_covariance_has_no_sigmas():
    record = a_record(spots=4)
    cov = record.tracked.cov_px2.copy()
    cov[5] = np.diag([1.0, -1.0])
    checks = FrameChecks(RIG)
    ((kept, _),) = checks.passed([(changed(record, cov_px2=cov), None)])
    assert np.isnan(kept.tracked.cov_px2[5]).all()
    assert np.isfinite(kept.tracked.uv_px[5]).all()
    assert len(checks.invalid) == 1


def test_an_invalid_covariance_of_the_causal_tables_is_omitted_and_counted_once():
    bad = changed(a_record(), pose_covariance=NOT_POSITIVE)
    for now in (bad, a_record()):
        checks = FrameChecks(RIG)
        ((_, then),) = checks.passed([(now, bad)])
        assert then is not None
        assert then.tracked.pose is None
        assert len(checks.invalid) == 1
