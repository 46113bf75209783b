"""Model selection, lenses that fold, and the effect of lens errors over the picture."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calibration.lens.fit.hold_out import HeldOut, folds_of
from calibration.lens.fit.lens_fit import robust_fit
from calibration.lens.fit.lens_models import LENS_MODELS, LensModel, folds_in_picture, named
from calibration.lens.fit.lens_parameters import AS_STATED
from calibration.lens.fit.lens_start import start
from calibration.lens.fit.model_selection import ModelCandidate, choose
from calibration.lens.fit.projection_map import difference, projection_map
from geometry.arrays import Array
from geometry.rotations import exp
from tests.calibration.lens.lens_scenes import SIZE, TRUTH, WIDE, Scene, photographs


def lens_of(numbers: tuple[float, ...]) -> Array:
    return np.array([*numbers, *[0.0] * (18 - len(numbers))])


def candidate(title: str, errors_px2: list[float], refused: str = "") -> ModelCandidate:
    errors = np.array(errors_px2)
    return ModelCandidate(named(title), None, HeldOut(errors, (), float(np.sqrt(errors.mean()))), refused=refused)


def test_the_smaller_model_is_chosen_if_the_gain_is_within_its_standard_error():
    selection = choose([candidate("4", [1.0, 1.2, 0.9, 1.1]), candidate("5", [0.9, 1.25, 0.92, 1.1])])
    assert selection.chosen.model.title == "4"
    assert "within one standard error" in selection.why


def test_a_small_gain_in_every_view_is_significant():
    """The comparison is paired: views differ much more than the two models do."""
    selection = choose([candidate("4", [1.0, 5.2, 0.3, 9.1]), candidate("5", [0.9, 5.1, 0.2, 9.0])])
    assert selection.chosen.model.title == "5"
    assert "every smaller usable model errs more" in selection.why


def test_a_refused_model_is_never_chosen():
    selection = choose([candidate("4", [1.0, 1.2, 0.9]), candidate("8", [0.1, 0.1, 0.1], refused="it folds")])
    assert selection.chosen.model.title == "4"


def test_every_view_is_in_exactly_one_fold():
    for count in (5, 10, 23):
        views = np.arange(count) * 2
        folds = folds_of(views)
        assert sorted(np.concatenate(folds).tolist()) == views.tolist()
        assert len(folds) == (count if count <= 10 else 5)


def test_a_radial_mapping_that_decreases_before_the_corner_folds_in_the_picture():
    assert not folds_in_picture(lens_of(TRUTH), False, SIZE)
    assert folds_in_picture(lens_of((1000.0, 1000, 640, 512, -0.8)), False, SIZE)
    assert not folds_in_picture(lens_of(WIDE), True, SIZE)
    assert folds_in_picture(lens_of((500.0, 500, 640, 512, -0.3)), True, SIZE)


def test_only_the_coefficients_of_the_model_are_kept():
    everything = np.arange(1.0, 19.0)
    assert np.count_nonzero(LensModel(4).cut(everything)) == 8
    assert [int(m.free.sum()) for m in LENS_MODELS] == [4, 8, 9, 8, 12, 16]


def test_the_map_excludes_rotations_of_the_camera():
    """Near the centre of a long lens, a shift of the principal point has the effect of a rotation of the camera."""
    model, lens = LensModel(0), lens_of((20000.0, 20000, 640, 512))
    at = projection_map(model, lens, SIZE, 1.0)
    by_cx, by_fx = at.by_parameter[..., 2], at.by_parameter[..., 0]
    assert np.abs(by_cx).max() < 0.002  # of the 1 px that cx moves every pixel
    assert np.abs(by_fx).max() > 0.03  # a change of focal length is not a rotation
    # This rotation compensates for a shift of cx by 1 px.
    turn = exp(np.array([0.0, -1.0 / 20000, 0.0]))
    assert (turn @ [0, 0, 1])[0] * 20000 + 641 == pytest.approx(640, abs=1e-6)


def test_sigmas_on_the_screen_are_those_in_the_picture_times_the_distance_over_the_focal_length():
    model, lens = LensModel(0), lens_of((1000.0, 1000, 639.5, 511.5))
    at = projection_map(model, lens, SIZE, 2.5)
    C = np.diag([1.0, 1.0, 0.0, 0.0])
    np.testing.assert_allclose(at.sigma_mm(C), at.sigma_px(C) * 2.5, rtol=1e-9)


def test_the_map_predicts_the_scatter_of_pixels_between_calibrations():
    """Pixel differences of independent calibrations, after the best rotation, against the sigmas of the map."""
    fits = []
    for seed in range(6):
        table = photographs(Scene(views=8), 50 + seed)
        _, values = start(table, False)
        fits.append(robust_fit(table, LensModel(4), values, AS_STATED))
    at = projection_map(fits[0].model, lens_of(TRUTH), SIZE, 1.0, columns=8)
    ratios = [difference(at, a, b).ratio for a, b in zip(fits[::2], fits[1::2], strict=True)]
    assert 0.5 < np.sqrt(np.mean(np.square(ratios))) < 1.6
    same = difference(at, fits[0], replace(fits[0]))
    assert same.rms_px == 0
    assert same.p_value == 1
