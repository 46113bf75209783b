"""Self-calibration of beams from unknown positions, with the body frame as a free gauge."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from calibration.beams.beams import at_feet, calibrate_beams, self_calibrate
from calibration.beams.excitation import BodyGauge, body_motion, without_frame
from calibration.least_squares.adjustment import AdjustmentError, Lines
from calibration.terms.rig_blocks import lines_in, stacks_of
from geometry.arrays import numeric_jacobian
from geometry.pose import Pose
from geometry.rig import Beam, Rig
from lab.simulate.scenarios import RIGS
from tests.calibration.beams.bench import ARCSEC, drawn, errors, exact, opposed, positions, recorded


def angles(rig: Rig) -> np.ndarray:
    d = [b.direction for b in rig.beams.values()]
    return np.array([np.arccos(d[i] @ d[j]) for i in range(len(d)) for j in range(i + 1, len(d))])


@pytest.mark.parametrize("name", RIGS)
def test_exactly_the_six_parameters_of_the_body_frame_are_undetermined(name):
    rng = np.random.default_rng(1)
    rig = RIGS[name]()
    poses = positions(rng, 20)
    found = self_calibrate(drawn(rig, rng), recorded(rng, rig, poses), 20)
    assert found.frame_free == 6
    assert found.undetermined == []
    assert found.world_from_stand is None
    sigma = np.array([a.sigma for a in found.angles])
    assert np.all(np.abs(angles(found.rig) - angles(rig)) < 4 * sigma)


def test_the_frame_is_chosen_nearest_to_the_drawing():
    rng = np.random.default_rng(2)
    rig = RIGS["four-skew-beams"]()
    nominal = drawn(rig, rng)
    found = self_calibrate(nominal, recorded(rng, rig, positions(rng, 20)), 20)
    as_drawn = at_feet(lines_in(stacks_of(nominal)))[0]
    G = body_motion(as_drawn)
    difference = lines_in(stacks_of(found.rig)).minus(as_drawn).ravel()
    assert np.linalg.norm(difference) > 1e-3  # the drawing differs
    np.testing.assert_allclose(np.linalg.qr(G)[0].T @ difference, 0, atol=1e-6)


def test_the_position_of_the_nominal_point_along_the_beam_does_not_change_frame_or_sigmas():
    rng = np.random.default_rng(10)
    rig = RIGS["four-skew-beams"]()
    spots = recorded(rng, rig, positions(rng, 20))
    slid = replace(rig, beams={n: replace(b, point=b.point + 2.0 * b.direction) for n, b in rig.beams.items()})
    one, other = (self_calibrate(r, spots, 20) for r in (rig, slid))
    np.testing.assert_allclose(one.lines.points, other.lines.points, atol=1e-6)
    sigmas = [np.sqrt(np.diagonal(c.lines_covariance)) for c in (one, other)]
    np.testing.assert_allclose(sigmas[0], sigmas[1], rtol=1e-3)


def test_motions_of_the_chosen_frame_have_no_variance():
    rng = np.random.default_rng(7)
    rig = RIGS["four-skew-beams"]()
    found = self_calibrate(rig, recorded(rng, rig, positions(rng, 20)), 20)
    frame = np.linalg.qr(body_motion(at_feet(lines_in(stacks_of(rig)))[0]))[0]
    variances = np.diagonal(frame.T @ found.lines_covariance @ frame)
    assert variances.max() < 1e-6 * np.diagonal(found.lines_covariance).max()


def test_derivatives_of_the_gauge_agree_with_finite_differences_for_any_points_of_the_beams():
    rng = np.random.default_rng(8)
    nominal = lines_in(stacks_of(RIGS["four-skew-beams"]()))
    turned = nominal.plus(rng.normal(0, 1e-5, (4, 4)))
    lines = Lines(turned.points + 0.6 * turned.directions, turned.directions)
    gauge = BodyGauge(nominal)
    parts = gauge.linearise({"beams": lines}).parts
    got = np.concatenate([p.jacobian[0] for p in parts], axis=1)
    expected = numeric_jacobian(
        lambda d: gauge.linearise({"beams": lines.plus(d.reshape(4, 4))}).residuals[0], np.zeros(16), 1e-6
    )
    np.testing.assert_allclose(got, expected, rtol=1e-3, atol=1e-4 * np.abs(expected).max())


def test_other_undetermined_motions_are_separated_from_those_of_the_frame():
    rng = np.random.default_rng(9)
    lines = lines_in(stacks_of(RIGS["four-skew-beams"]()))
    loose = np.zeros(16)
    loose[6] = 1.0  # an offset of beam B
    mixed = rng.normal(size=(7, 7)) @ np.vstack([body_motion(lines).T, loose])
    (rest,) = without_frame(mixed, lines)
    frame = np.linalg.qr(body_motion(lines))[0]
    expected = loose - frame @ (frame.T @ loose)
    assert abs(rest @ expected) / np.linalg.norm(expected) > 1 - 1e-9


def test_a_drawing_in_another_frame_does_not_change_angles():
    rng = np.random.default_rng(3)
    rig = RIGS["four-skew-beams"]()
    spots = recorded(rng, rig, positions(rng, 20))
    turn = Pose.from_ypr(np.array([0.2, -0.1, 0.15]), np.array([0.05, -0.02, 0.03]))
    other = replace(rig, beams={n: Beam(n, turn.turn(b.direction), turn.apply(b.point)) for n, b in rig.beams.items()})
    one, two = (self_calibrate(r, spots, 20) for r in (rig, other))
    np.testing.assert_allclose(angles(one.rig), angles(two.rig), atol=0.02 * ARCSEC)
    sigmas = [np.array([a.sigma for a in c.angles]) for c in (one, two)]
    np.testing.assert_allclose(sigmas[0], sigmas[1], rtol=1e-3)  # independent of the frame


def test_positions_with_too_few_spots_are_excluded():
    rng = np.random.default_rng(4)
    rig = RIGS["fan"]()
    spots = recorded(rng, rig, positions(rng, 12))
    left_only = np.array([rig.views()[v][0] == "left" for v in spots.view])
    some = spots.pick(~((spots.position == 5) & left_only))  # three coplanar beams on one screen give no pose
    found = self_calibrate(rig, some, 12)
    assert list(found.dropped) == [5]


def test_one_position_is_not_enough():
    rng = np.random.default_rng(5)
    rig = RIGS["fan"]()
    with pytest.raises(AdjustmentError, match="at 1 of 1 positions, two or more are needed"):
        self_calibrate(rig, recorded(rng, rig, Pose(np.eye(3)[None], np.zeros((1, 3)))), 1)


def test_known_positions_never_increase_the_sigmas_of_angles():
    rng = np.random.default_rng(6)
    rig = opposed(RIGS["unequal-fan"](), rng)
    poses = positions(rng)
    spots = recorded(rng, rig, poses)
    alone, stood = self_calibrate(rig, spots, 40), calibrate_beams(rig, spots, exact(poses))
    assert all(s.sigma < a.sigma * 1.01 for a, s in zip(alone.angles, stood.angles, strict=True))


def shape_scatter(seeds: range) -> tuple[float, float, float]:
    """Share of angles within 1 sigma, the mean NEES per parameter of the shape, the RMS error of the angles (rad)."""
    within, nees, sizes = [], [], []
    for seed in seeds:
        rng = np.random.default_rng(1000 + seed)
        rig = RIGS["four-skew-beams"]()
        spots = recorded(rng, rig, positions(rng))
        found = self_calibrate(drawn(rig, rng), spots, 40)
        off = angles(found.rig) - angles(rig)
        within.append(np.abs(off) < [a.sigma for a in found.angles])
        sizes.append(np.mean(off**2))
        # Errors and covariance without the six motions of the frame.
        G = body_motion(found.lines)
        shape = np.linalg.svd(G)[0][:, 6:]
        e = shape.T @ errors(rig, found.rig).ravel()
        # The frame is that of an inexact drawing; its rotation, which affects the shape to second order, is removed.
        nees.append(_nees_in_shape(rig, found, shape, e))
    return float(np.mean(within)), float(np.mean(nees)), float(np.sqrt(np.mean(sizes)))


def _nees_in_shape(rig: Rig, found, shape: np.ndarray, e: np.ndarray) -> float:
    lines, truth = found.lines, lines_in(stacks_of(rig))
    frame = Pose.identity()
    for _ in range(4):
        moved = type(truth)(frame.apply(truth.points), frame.turn(truth.directions))
        step = np.linalg.lstsq(body_motion(moved), lines.minus(moved).ravel(), rcond=None)[0]
        frame = Pose.from_ypr(np.array([step[5], step[4], step[3]]), step[:3]) @ frame
    moved = type(truth)(frame.apply(truth.points), frame.turn(truth.directions))
    e = shape.T @ -moved.minus(lines).ravel()
    return float(e @ np.linalg.solve(shape.T @ found.lines_covariance @ shape, e)) / len(e)


def test_errors_of_the_shape_agree_with_the_covariance():
    within, nees, size = shape_scatter(range(3))
    lo, hi = chi2.ppf([0.001, 0.999], 3 * 10) / (3 * 10)
    assert lo < nees < hi
    assert 0.4 < within < 0.95
    assert size < 60 * ARCSEC


@pytest.mark.slow
def test_errors_of_200_shapes_agree_with_the_covariance():
    within, nees, size = shape_scatter(range(200))
    lo, hi = chi2.ppf([0.025, 0.975], 200 * 10) / (200 * 10)
    print(f"within 1 sigma {within:.3f}, NEES {nees:.3f} ({lo:.3f} to {hi:.3f}), {size / ARCSEC:.1f} arcsec RMS")
    assert lo < nees < hi
    assert 0.62 < within < 0.75
