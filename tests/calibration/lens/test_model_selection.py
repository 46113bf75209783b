"""Models of many coefficients are tried only where they can be of use, and derived once."""

from dataclasses import replace

import numpy as np
import pytest

from calibration.least_squares.adjustment import AdjustmentError
from calibration.lens.fit import model_selection
from calibration.lens.fit.lens_models import LensModel
from calibration.lens.fit.lens_start import start
from calibration.lens.fit.model_selection import RATIONAL, ModelCandidate, _futile, _Judged, inliers_of_rich_models
from calibration.lens.fit.projection_map import projection_map
from calibration.lens.intrinsics import IntrinsicsOptions, calibrate_intrinsics
from tests.calibration.lens.lens_scenes import Scene, photographs


@pytest.fixture(scope="module")
def bent():
    """Six photographs with errors of their own, up to a pixel, which no lens describes."""
    return with_own_errors(photographs(Scene(views=6, distance_m=(0.6, 0.9)), 3), 3, 1.0)


def with_own_errors(table, seed, most_px):
    rng = np.random.default_rng(seed)
    wave, phase = rng.uniform(0.006, 0.012, (table.views, 2, 2)), rng.uniform(0, 6, (table.views, 2))
    away = np.sin(np.einsum("nij,nj->ni", wave[table.view], table.pixels) + phase[table.view])
    return replace(table, pixels=table.pixels + most_px * away)


@pytest.mark.slow
def test_a_model_that_errs_alike_where_corners_were_seen_is_not_chosen_if_it_leaves_the_rest_of_the_picture_open():
    """Boards in the middle: with the rotation that fits there, rich models left 18 px open where four left 5."""
    lens = (800.0, 801.0, 639.5, 511.5, -0.25, 0.08, 3e-4, -2e-4)
    scene = Scene(lens, views=13, sigma_px=0.05, tilt_rad=0.6, distance_m=(0.4, 0.9), at_most=0.3)
    for seed in range(4):
        table = with_own_errors(photographs(scene, seed), seed, 0.3)
        chosen, four = (calibrate_intrinsics(table, IntrinsicsOptions(lens=m)) for m in (None, LensModel(4)))
        open_px, four_px = (np.nanquantile(c.map.sigma_px(c.covariance), 0.9) for c in (chosen, four))
        assert open_px < 2 * four_px


@pytest.mark.parametrize(("unknown_px", "scatter", "tried"), [(2.9, 0.7, True), (3.1, 0.7, False), (2.9, 1.2, False)])
def test_twelve_coefficients_are_not_tried_where_eight_leave_directions_unknown(bent, unknown_px, scatter, tried):
    fit = next(f for f in inliers_of_rich_models(bent, [start(bent, False)])[1] if f.model == RATIONAL)
    off = replace(fit, sigma_px=fit.sigma_px / 10)  # its residuals are not noise: more coefficients may help
    at = projection_map(fit.model, fit.lens, bent.image_size_px, 1.0)
    eight = _Judged(ModelCandidate(RATIONAL, off), at, scatter=scatter, unknown_px=unknown_px)
    assert (_futile(bent, LensModel(12), [eight]) == "") is tried
    assert _futile(bent, LensModel(5), [eight]) == ""
    noise = replace(eight, candidate=ModelCandidate(RATIONAL, replace(fit, sigma_px=10.0)))
    assert "no correlated residuals" in _futile(bent, LensModel(12), [noise])
    # Photographs that scatter show a wrong model, too.
    assert "no correlated residuals" not in _futile(bent, LensModel(12), [replace(noise, scatters=True)])


def test_a_rational_lens_that_is_a_start_is_not_derived_again(bent, monkeypatch):
    fits = inliers_of_rich_models(bent, [start(bent, False)])[1]
    assert any(f.model == RATIONAL for f in fits)
    monkeypatch.setattr(model_selection, "as_rational", lambda *_: pytest.fail("derived again"))
    again = inliers_of_rich_models(bent, [(f.model, f.values) for f in fits])[1]
    assert sorted(f.model.coefficients for f in again) == sorted(f.model.coefficients for f in fits)


def test_a_model_without_a_covariance_is_refused_and_does_not_end_the_calibration(monkeypatch):
    stated = model_selection.scattered

    def open_without_coefficients(found, *rest):
        if found.model == LensModel(0):
            raise AdjustmentError("one direction is open")
        return stated(found, *rest)

    monkeypatch.setattr(model_selection, "scattered", open_without_coefficients)
    found = calibrate_intrinsics(photographs(Scene(views=6), 1))
    assert "one direction is open" in found.selection.candidates[0].refused
    assert found.model != LensModel(0)
