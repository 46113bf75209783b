"""Spots as measurements: predictions against the forward model, derivatives against finite differences."""

from __future__ import annotations

import numpy as np
import pytest

from calibration.least_squares.adjustment import Poses
from calibration.terms.rig_blocks import SpotPixels, SpotTerm, named_errors, prior_of, rig_of, stacks_of
from geometry.arrays import numeric_jacobian
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.rig import Rig
from geometry.uncertainty.rig_uncertainty import RigCovariance, perturbed_rig, rig_names
from tests.geometry.scenes import random_pose, random_rig

POSITIONS = 4


def scene(seed: int, bent: bool = True) -> tuple[Rig, dict, SpotPixels]:
    """A random rig with bent screens, on a stand that is rotated in world, and its visible spots at four positions."""
    rng = np.random.default_rng(seed)
    rig = random_rig(rng)
    if bent:
        names = [f"screens.{s}.bow_{k}_per_m" for s in rig.screens for k in ("xx", "xy", "yy")]
        rig = perturbed_rig(rig, names, rng.normal(0, 0.01, len(names)))
    world_from_stand = random_pose(rng, 0.1)
    world_from_body = [random_pose(rng, 0.1, 0.1) for _ in range(POSITIONS)]
    poses = Poses.of([world_from_stand.inverse() @ p for p in world_from_body])
    values = {**stacks_of(rig), "stand": Poses.of([world_from_stand]), "poses": poses}
    pixels, _ = SpotModel.of(rig).project(world_from_stand @ poses.pose)
    position, view = np.nonzero(np.isfinite(pixels).all(-1))
    spread = rng.normal(size=(len(view), 2, 2)) * 0.3
    covariance = spread @ np.swapaxes(spread, 1, 2) + 0.04 * np.eye(2)
    return rig, values, SpotPixels(position, view, pixels[position, view], covariance)


@pytest.mark.parametrize("seed", range(5))
def test_spots_at_the_pixels_of_the_forward_model_have_no_residual(seed):
    rig, values, spots = scene(seed)
    assert len(spots) > 12
    np.testing.assert_allclose(SpotTerm(rig, spots).linearise(values).residuals, 0, atol=1e-9)


def test_a_residual_is_predicted_minus_measured_in_sigmas():
    rig, values, spots = scene(1)
    shift = np.array([0.3, -0.2])
    off = SpotPixels(spots.position, spots.view, spots.pixels - shift, spots.covariance)
    r = SpotTerm(rig, off).linearise(values).residuals
    expected = [shift @ np.linalg.solve(C, shift) for C in spots.covariance]
    np.testing.assert_allclose(np.sum(r**2, axis=1), expected, rtol=1e-6)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("stack", ["intrinsics", "cameras", "screens", "bow", "beams", "stand", "poses"])
def test_derivatives_equal_finite_differences_of_the_residuals(seed, stack):
    rig, values, spots = scene(seed)
    term = SpotTerm(rig, spots)
    (part,) = [p for p in term.linearise(values).parts if p.stack == stack]
    it = values[stack]
    used = np.ones((len(it), it.dof), dtype=bool)
    if stack == "intrinsics":  # a model of four coefficients has no fifth
        for i, c in enumerate(rig.cameras.values()):
            used[i, 4 + len(c.distortion) :] = False

    def residuals(delta: np.ndarray) -> np.ndarray:
        full = np.zeros(used.shape)
        full[used] = delta
        return term.linearise({**values, stack: it.plus(full)}).residuals

    expected = numeric_jacobian(residuals, np.zeros(int(used.sum())), 1e-6)
    got = np.zeros((len(spots), 2, len(it), it.dof))
    got[np.arange(len(spots)), :, part.index] = part.jacobian
    np.testing.assert_allclose(got[:, :, used], expected, rtol=2e-5, atol=2e-5 * np.abs(expected).max())


def test_conversion_of_a_rig_to_stacks_and_back_is_exact():
    rig, values, _ = scene(2)
    back = rig_of(rig, values)
    for name, c in rig.cameras.items():
        assert back.cameras[name].distortion == c.distortion
        np.testing.assert_array_equal(back.cameras[name].matrix, c.matrix)
        np.testing.assert_array_equal(back.cameras[name].camera_from_world.rotation, c.camera_from_world.rotation)
    for name, s in rig.screens.items():
        assert back.screens[name].bow == s.bow
        np.testing.assert_array_equal(back.screens[name].world_from_screen.translation, s.world_from_screen.translation)
    np.testing.assert_allclose(back.beams["b1"].direction, rig.beams["b1"].direction, atol=1e-16)


def test_errors_of_stacks_equal_errors_of_the_named_numbers():
    rig, values, _ = scene(3)
    rng = np.random.default_rng(3)
    at = [(s, i) for s in ("beams", "screens", "intrinsics", "cameras", "bow") for i in range(len(values[s]))]
    names, T = named_errors(rig, values, at)
    assert set(names) == set(rig_names(rig, bow=True))
    delta = T.T @ rng.normal(0, 1e-5, len(names))
    changed, start = dict(values), 0
    for s, i in at:
        step = np.zeros((len(values[s]), values[s].dof))
        step[i] = delta[start : start + values[s].dof]
        start += values[s].dof
        changed[s] = changed[s].plus(step)
    one, other = rig_of(rig, changed), perturbed_rig(rig, names, T @ delta)
    poses = random_pose(rng, 0.1, 0.1)
    before = SpotModel.of(rig).project(poses)[0]
    moves = SpotModel.of(other).project(poses)[0] - before
    assert np.nanmax(np.abs(moves)) > 1e-3  # px: the errors do have an effect
    np.testing.assert_allclose(SpotModel.of(one).project(poses)[0] - before, moves, atol=1e-6)


def test_a_prior_from_a_covariance_weights_errors_by_it_and_fixes_unnamed_numbers():
    rig, values, _ = scene(4)
    names = ("beams.b0.direction_x", "screens.left.x_m", "screens.left.z_m", "cameras.left.fx")
    root = np.random.default_rng(4).normal(size=(4, 4))
    C = root @ root.T
    C[0, :] = C[:, 0] = 0
    prior, free = prior_of(rig, RigCovariance(names, C))
    assert prior is not None
    left = list(rig.screens).index("left")
    assert free["screens"][left].tolist() == [True, False, True, False, False, False]
    assert free["screens"].sum() == 2
    assert not free["beams"].any()
    assert free["intrinsics"].sum() == 1
    delta = np.array([1e-3, -2e-3, 4e-3])
    step = np.zeros((len(values["screens"]), 6))
    step[left, [0, 2]] = delta[:2]
    lens = np.zeros((len(values["intrinsics"]), 18))
    lens[list(rig.cameras).index("left"), 0] = delta[2]
    now = {**values, "screens": values["screens"].plus(step), "intrinsics": values["intrinsics"].plus(lens)}
    r = prior.linearise(now).residuals
    assert np.sum(r**2) == pytest.approx(delta @ np.linalg.solve(C[1:, 1:], delta), rel=1e-5)


def test_a_beam_that_misses_its_screen_gives_nan():
    rig, values, spots = scene(5)
    away = Pose.from_ypr(np.array([np.pi / 2, 0, 0]), np.zeros(3))
    turned = {**values, "stand": Poses.of([away @ values["stand"].pose[0]])}
    assert np.isnan(SpotTerm(rig, spots).linearise(turned).residuals).any()


def test_a_singular_covariance_constrains_its_null_directions():
    rig, values, _ = scene(6)
    together = np.array([1.0, 2.0])  # two fully correlated errors: y is twice x
    prior, _ = prior_of(
        rig, RigCovariance(("screens.left.x_m", "screens.left.y_m"), 1e-6 * np.outer(together, together))
    )
    left = list(rig.screens).index("left")

    def sigmas(dx: float, dy: float) -> float:
        step = np.zeros((len(values["screens"]), 6))
        step[left, :2] = dx, dy
        return float(np.linalg.norm(prior.linearise({**values, "screens": values["screens"].plus(step)}).residuals))

    assert sigmas(1e-3, 2e-3) == pytest.approx(1.0, rel=1e-3)
    assert sigmas(2e-3, -1e-3) > 1e3
