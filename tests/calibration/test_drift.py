"""Changes since a calibration: the rate of false alarms, and the identification of changes."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import binom

from calibration.changes import (
    LASER_MOVED,
    MOVED,
    TURNED,
    TURNED_ZOOMED,
    WRONG_POINT,
    ZOOMED,
    ChangeCandidate,
    ExcessResidual,
    camera_columns,
    find_changes,
)
from geometry.camera import pinhole_numbers, project_points_full
from geometry.lens import padded
from geometry.rotations import exp
from tests.geometry.scenes import LENSES, paper_rig

CAMERA = paper_rig(LENSES[5]).cameras["left"]
# Dots at several depths, in the camera frame: on one plane a shift along the axis has the effect of a zoom.
PLACES = np.array(
    [[-1.2, -0.9, 3.5], [1.2, -0.9, 3.2], [1.2, 0.9, 3.5], [-1.2, 0.9, 3.0], [0.1, 0, 3.5], [0.4, 0.5, 3.1]]
)
N = len(PLACES)


def seen(places: np.ndarray, zoom: float = 0.0) -> np.ndarray:
    pinhole = pinhole_numbers(CAMERA) * [1 + zoom, 1 + zoom, 1, 1]
    return project_points_full(
        places, pinhole, padded(CAMERA.distortion), np.asarray(CAMERA.fold_r2), np.asarray(False)
    ).pixels


def columns():
    lens = project_points_full(
        PLACES, pinhole_numbers(CAMERA), padded(CAMERA.distortion), np.asarray(CAMERA.fold_r2), np.asarray(False)
    )
    return camera_columns(PLACES, lens.d_point, lens.d_pinhole, pinhole_numbers(CAMERA)[:2])


def points() -> dict[tuple[str, str], ChangeCandidate]:
    one = np.eye(2 * N)
    return {(WRONG_POINT, str(i)): ChangeCandidate(one[:, 2 * i : 2 * i + 2], np.full(2, 3.0)) for i in range(N)}


def covariance(rng: np.random.Generator) -> np.ndarray:
    """Noise of 0.1 px, and errors of a calibration, which move all pixels jointly."""
    J = rng.normal(0, 0.1, (2 * N, 3))
    return 0.1**2 * np.eye(2 * N) + J @ J.T


def found(residual: np.ndarray, C: np.ndarray, p_false_alarm: float = 0.002):
    return find_changes(ExcessResidual.of(residual.ravel(), C), {"left": columns()}, points(), p_false_alarm)


def test_the_columns_equal_finite_differences_of_the_projection():
    c, step = columns(), 1e-6
    for k in range(3):
        e = np.eye(3)[k] * step
        turned = (seen(PLACES @ exp(e).T) - seen(PLACES @ exp(-e).T)).ravel() / (2 * step)
        moved = (seen(PLACES + e) - seen(PLACES - e)).ravel() / (2 * step)
        np.testing.assert_allclose(c.turn[:, k], turned, atol=1e-3)  # of some 1200 px/rad
        np.testing.assert_allclose(c.move[:, k], moved, atol=1e-3)
    zoomed = (seen(PLACES, step) - seen(PLACES, -step)).ravel() / (2 * step)
    np.testing.assert_allclose(c.zoom[:, 0], zoomed, atol=1e-3)


@pytest.mark.parametrize("p", [0.05, 0.01])
def test_false_alarms_have_the_stated_probability(p):
    rng = np.random.default_rng(7)
    C = covariance(rng)
    L = np.linalg.cholesky(C)
    trials = 400
    alarms = sum(
        bool(v.changes) or v.unexplained for v in (found(L @ rng.normal(size=2 * N), C, p) for _ in range(trials))
    )
    assert binom.ppf(0.001, trials, p) <= alarms <= binom.ppf(0.999, trials, p)


@pytest.mark.parametrize(
    ("kind", "residual"),
    [
        (TURNED, seen(PLACES @ exp(np.radians([0, 0.05, 0])).T) - seen(PLACES)),
        (TURNED, seen(PLACES @ exp(np.radians([0, 0, 0.1])).T) - seen(PLACES)),
        (ZOOMED, seen(PLACES, 3e-3) - seen(PLACES)),
        (MOVED, seen(PLACES + np.array([0.02, 0, 0])) - seen(PLACES)),
        (TURNED_ZOOMED, seen(PLACES @ exp(np.radians([0.1, 0, 0])).T, 3e-3) - seen(PLACES)),
    ],
    ids=["turned", "rolled", "zoomed", "moved", "turned and zoomed"],
)
def test_the_kind_of_a_cameras_change_is_identified(kind, residual):
    rng = np.random.default_rng(3)
    verdicts = found(residual + rng.normal(0, 0.1, residual.shape), 0.01 * np.eye(2 * N))
    assert [c.kind for c in verdicts.changes] == [kind]
    assert not verdicts.unexplained


def test_a_turn_is_estimated_with_a_correct_sigma():
    """For 100 noisy turns of 0.05 deg the normalised error has a standard deviation of 1."""
    rng, turn = np.random.default_rng(5), np.radians(0.05)
    residual = seen(PLACES @ exp(np.array([0, turn, 0])).T) - seen(PLACES)
    z = []
    for _ in range(100):
        change = found(residual + rng.normal(0, 0.1, residual.shape), 0.01 * np.eye(2 * N)).changes[0]
        z.append((change.delta[1] - turn) / np.sqrt(change.covariance[1, 1]))
    assert abs(np.mean(z)) < 0.25  # 2.5 sigma of a mean of 100
    assert 0.78 < np.std(z) < 1.22


def test_one_wrong_point_is_identified():
    rng = np.random.default_rng(11)
    for i in range(N):
        wrong = np.zeros((N, 2))
        wrong[i] = [2.0, -1.5]
        verdicts = found(wrong + rng.normal(0, 0.1, wrong.shape), 0.01 * np.eye(2 * N))
        assert [(c.kind, c.subject) for c in verdicts.changes] == [(WRONG_POINT, str(i))]


def test_a_wrong_point_and_a_turned_camera_are_usually_both_identified():
    """Measured: 90 of 100; in 3 the right point with a camera that also moved, in 7 another point."""
    rng = np.random.default_rng(11)
    residual = seen(PLACES @ exp(np.radians([0, 0.05, 0])).T) - seen(PLACES)
    residual[3] += [2.0, -1.5]
    right = 0
    for _ in range(30):
        changes = found(residual + rng.normal(0, 0.1, residual.shape), 0.01 * np.eye(2 * N)).changes
        right += {(c.kind, c.subject) for c in changes} == {(WRONG_POINT, "3"), (TURNED, "left")}
        assert {c.subject for c in changes} > {"left"}  # always the camera, and a point
    assert right >= binom.ppf(0.01, 30, 0.9)


def test_a_residual_that_no_change_explains_is_reported_as_unexplained():
    residual = np.random.default_rng(2).normal(0, 3.0, (N, 2))
    assert found(residual, 0.01 * np.eye(2 * N)).unexplained


def test_a_displacement_covered_by_a_free_nuisance_is_not_detectable():
    c = columns()
    shift = np.zeros((2 * N, 2))
    shift[::2, 0] = shift[1::2, 1] = 1.0
    unmodelled = ExcessResidual.of(np.zeros(2 * N), 0.01 * np.eye(2 * N))
    visible = unmodelled.detectable(shift, c.model, 0.001, 0.9)
    assert 0.1 < visible < 0.4
    assert unmodelled.with_free(shift).detectable(shift, c.model, 0.001, 0.9) > 1e6


def test_a_drift_of_the_detectable_size_is_found_with_the_stated_power():
    rng = np.random.default_rng(13)
    c, C = columns(), 0.01 * np.eye(2 * N)
    shift = np.zeros((2 * N, 2))
    shift[::2, 0] = shift[1::2, 1] = 1.0
    size = ExcessResidual.of(np.zeros(2 * N), C).detectable(shift, c.model, 0.001, 0.9)
    seen_in = sum(bool(found(size * shift[:, 0] + rng.normal(0, 0.1, 2 * N), C).changes) for _ in range(100))
    assert seen_in >= binom.ppf(0.001, 100, 0.9)


def test_a_moved_laser_is_preferred_to_two_moved_cameras():
    """Both spots of a laser moved, one in each camera: one laser is more probable than two cameras or two points."""
    rng = np.random.default_rng(17)
    n = 12
    spots = np.zeros((n, 2))
    spots[0], spots[6] = [1.5, 0.5], [-1.5, 0.5]
    c = columns()

    def columns_of(first: bool) -> object:
        def padded_columns(block: np.ndarray) -> np.ndarray:
            nothing = np.zeros_like(block)
            return np.concatenate([block, nothing] if first else [nothing, block])

        return type(c)(padded_columns(c.turn), padded_columns(c.move), padded_columns(c.zoom))

    laser = np.zeros((2 * n, 2))
    laser[[0, 1], [0, 1]] = 1000.0  # px/rad
    laser[[12, 13], [0, 1]] = -1000.0, 1000.0
    one = np.eye(2 * n)
    others = {(WRONG_POINT, str(i)): ChangeCandidate(one[:, 2 * i : 2 * i + 2], np.full(2, 3.0)) for i in range(n)}
    others[(LASER_MOVED, "A")] = ChangeCandidate(laser, np.full(2, 1e-3))
    misfit = ExcessResidual.of((spots + rng.normal(0, 0.1, (n, 2))).ravel(), 0.01 * np.eye(2 * n))
    verdicts = find_changes(misfit, {"left": columns_of(True), "right": columns_of(False)}, others, 0.002)
    assert [(c.kind, c.subject) for c in verdicts.changes] == [(LASER_MOVED, "A")]


def test_a_covariance_that_is_not_positive_definite_is_refused():
    with pytest.raises(ValueError, match="not positive definite"):
        ExcessResidual.of(np.zeros(2), np.array([[1.0, 2.0], [2.0, 1.0]]))


def test_a_residual_whitened_beforehand_gives_the_same_fit():
    rng = np.random.default_rng(4)
    root = np.tril(rng.standard_normal((12, 12))) + 5 * np.eye(12)
    columns, nuisance, residual = rng.standard_normal((12, 3)), rng.standard_normal((12, 2)), rng.standard_normal(12)
    plain = ExcessResidual.of(residual, root @ root.T).with_free(nuisance)
    white = ExcessResidual.of_white(np.linalg.solve(root, residual)).with_free(np.linalg.solve(root, nuisance))
    size = np.array([0.5, 1.0, 2.0])
    a = plain.fit("turned", "left", ChangeCandidate(columns, size))
    b = white.fit("turned", "left", ChangeCandidate(np.linalg.solve(root, columns), size))
    assert white.p_value == pytest.approx(plain.p_value)
    assert b.evidence == pytest.approx(a.evidence)
    np.testing.assert_allclose(b.delta, a.delta)
    np.testing.assert_allclose(b.covariance, a.covariance)
