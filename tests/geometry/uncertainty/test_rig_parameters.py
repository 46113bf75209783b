"""The parameters of a rig: names, perturbations, derivatives against finite differences, covariance of the pixels."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from geometry.arrays import numeric_jacobian
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.uncertainty.rig_uncertainty import (
    RigCovariance,
    RigUncertainty,
    Sensitivity,
    is_known,
    perturbed_rig,
    rig_names,
    split_name,
    with_variances,
)
from tests.geometry.scenes import LENSES, paper_rig, random_pose, uncommon_rig

seeds = st.integers(0, 2**32 - 1)


@settings(max_examples=3, deadline=None)
@given(seed=seeds)
def test_every_derivative_equals_the_finite_difference(seed):
    rng = np.random.default_rng(seed)
    rig, pose = uncommon_rig(rng), random_pose(rng, 0.3, 0.3)
    names = rig_names(rig, bow=True)
    model = SpotModel.of(rig)
    found = Sensitivity(rig, model, names).of(model.derivatives(pose))
    expected = numeric_jacobian(
        lambda q: SpotModel.of(perturbed_rig(rig, names, q)).project(pose)[0], np.zeros(len(names))
    )
    # Spots far outside the picture, where the distortion is largest, have derivatives of thousands of px.
    good = np.isfinite(model.project(pose)[0][:, 0])
    np.testing.assert_allclose(found[good], expected[good], rtol=2e-5, atol=2e-3)


def test_a_stack_of_poses_gives_the_derivatives_of_each():
    rng = np.random.default_rng(3)
    rig = uncommon_rig(rng)
    model = SpotModel.of(rig)
    poses = Pose.from_ypr(rng.normal(0, 0.1, (4, 3)), rng.normal(0, 0.1, (4, 3)))
    together = Sensitivity(rig, model, rig_names(rig)).of(model.derivatives(poses))
    for k in range(4):
        one = Sensitivity(rig, model, rig_names(rig)).of(model.derivatives(poses[k]))
        np.testing.assert_allclose(together[k], one, rtol=1e-12, atol=1e-9)


def test_every_name_is_known_and_splits_into_kind_item_and_parameter():
    rig = paper_rig(LENSES[5])
    for name in rig_names(rig, bow=True):
        assert is_known(rig, name)
        assert ".".join(split_name(name)) == name
    assert split_name("cameras.left.upper.fx") == ("cameras", "left.upper", "fx")


@pytest.mark.parametrize(
    "name", ["fx", "cameras.left.k4", "cameras.middle.fx", "screens.left.fx", "beams.A.length", "lights.a.b"]
)
def test_a_name_that_the_rig_does_not_have_is_refused(name):
    rig = paper_rig(LENSES[5])
    assert not is_known(rig, name)
    with pytest.raises(KeyError):
        perturbed_rig(rig, [name], np.ones(1))
    with pytest.raises(KeyError):
        Sensitivity(rig, SpotModel.of(rig), [name])


def test_a_perturbation_of_zero_changes_nothing():
    rig = uncommon_rig(np.random.default_rng(4))
    names = rig_names(rig, bow=True)
    same = SpotModel.of(perturbed_rig(rig, names, np.zeros(len(names))))
    model = SpotModel.of(rig)
    np.testing.assert_allclose(same.pinhole, model.pinhole, rtol=0)
    np.testing.assert_allclose(same.screen_rotation, model.screen_rotation, rtol=0)
    np.testing.assert_allclose(same.ray, model.ray, rtol=0, atol=1e-15)


def test_the_covariance_of_the_pixels_equals_the_scatter_over_drawn_rigs():
    rng = np.random.default_rng(5)
    rig, pose = paper_rig(LENSES[5]), Pose.identity()
    names = rig_names(rig)
    A = rng.normal(size=(len(names), len(names))) * 1e-4
    A[[i for i, n in enumerate(names) if n.endswith((".fx", ".cy"))]] *= 3000
    spread = RigUncertainty(rig, SpotModel.of(rig), RigCovariance(names, A @ A.T)).at(pose)
    draws = [
        SpotModel.of(perturbed_rig(rig, names, A @ rng.normal(size=len(names)))).project(pose)[0].ravel()
        for _ in range(1500)
    ]
    claimed, seen = np.sqrt(np.diagonal(spread)), np.std(draws, axis=0)
    np.testing.assert_allclose(seen, claimed, rtol=0.08)  # 1500 draws scatter by 2 %
    np.testing.assert_allclose(np.corrcoef(np.transpose(draws)), spread / np.outer(claimed, claimed), atol=0.12)


def test_the_covariance_of_the_pixels_does_not_depend_on_earlier_calls():
    rng = np.random.default_rng(6)
    rig = paper_rig(LENSES[5])
    names = rig_names(rig)
    known = RigCovariance(names, np.eye(len(names)) * 1e-6)

    def fresh() -> RigUncertainty:
        return RigUncertainty(rig, SpotModel.of(rig), known)

    # A slow motion, with successive poses 20 mm apart.
    poses = [
        Pose.identity().plus(0.02 * k * np.array([1, 0.5, 0, 0, 0.3, 1]) + 1e-3 * rng.normal(size=6)) for k in range(20)
    ]
    forwards, backwards = fresh(), fresh()
    in_turn = [forwards.at(p) for p in poses]
    in_reverse = [backwards.at(p) for p in poses[::-1]][::-1]
    for pose, one, other in zip(poses, in_turn, in_reverse, strict=True):
        np.testing.assert_array_equal(one, other)
        np.testing.assert_array_equal(one, fresh().at(pose))


def test_a_stack_of_poses_gives_the_covariance_of_each():
    rng = np.random.default_rng(7)
    rig = paper_rig(LENSES[5])
    names = rig_names(rig)
    spread = RigUncertainty(rig, SpotModel.of(rig), RigCovariance(names, np.eye(len(names)) * 1e-6))
    poses = Pose.from_ypr(rng.normal(0, 0.1, (4, 3)), rng.normal(0, 0.1, (4, 3)))
    together = spread.at(poses)
    for k in range(4):
        np.testing.assert_allclose(together[k], spread.at(poses[k]), rtol=1e-9, atol=1e-9)


def test_views_without_a_projection_have_no_covariance():
    rig = paper_rig(LENSES[5], size_m=(1.0, 1.0))
    model = SpotModel.of(rig)
    pose = Pose.from_ypr(np.array([0.5, 0, 0]), np.zeros(3))
    gone = np.isnan(model.project(pose)[0][:, 0])
    assert gone.any()
    names = rig_names(rig)
    joint = RigUncertainty(rig, model, RigCovariance(names, np.eye(len(names)) * 1e-8)).at(pose)
    assert np.all(np.isfinite(joint))
    assert np.all(np.diagonal(joint).reshape(-1, 2)[gone] == 0)


def test_more_variance_of_some_parameters_leaves_the_others_as_they_are():
    known = RigCovariance(("cameras.left.cx", "cameras.left.cy"), np.array([[0.04, 0.01], [0.01, 0.09]]))
    more = with_variances(known, {"cameras.left.cx": 0.02, "cameras.right.cy": 0.03})
    assert more.names == ("cameras.left.cx", "cameras.left.cy", "cameras.right.cy")
    np.testing.assert_allclose(more.matrix, [[0.06, 0.01, 0], [0.01, 0.09, 0], [0, 0, 0.03]])
    exact = with_variances(None, {"cameras.left.cx": 0.02})
    assert exact.names == ("cameras.left.cx",)
    assert exact.matrix.tolist() == [[0.02]]
