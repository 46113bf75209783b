"""The rational start for a lens that a fisheye model does not describe out to the picture's corners."""

from dataclasses import replace

import numpy as np
import pytest

from bench.lenses.rendered import BOARDS, rendered_set
from calibration.lens.fit.lens_adjustment import BRIEF, term_of
from calibration.lens.fit.lens_fit import robust_fit
from calibration.lens.fit.lens_models import LensModel
from calibration.lens.fit.lens_parameters import AS_STATED
from calibration.lens.fit.lens_start import start
from calibration.lens.fit.model_selection import as_rational
from calibration.lens.intrinsics import calibrate_intrinsics
from geometry.camera import FISHEYE
from tests.calibration.lens.lens_scenes import WIDE, Scene, photographs

RATIONAL = (496.1, 496.06, 633.6, 453.0, 1.03382742, 0.219551451, -3.08894325e-4, -1.26761097e-4, 4.99145126e-3)
RATIONAL += (1.36690629, 0.470252068, 0.0327271282)


def test_every_corner_is_predicted_also_those_that_the_fisheye_rejects():
    lens = (330.0, 330.0, 640.0, 505.0, *WIDE[4:])
    table = photographs(Scene(lens=lens, fisheye=True, views=12, distance_m=(0.1, 0.25)), 1)
    model, values = start(table, True)
    found = robust_fit(table, model, values, AS_STATED, BRIEF)
    rejected = np.linalg.norm(table.pixels - found.lens[2:4], axis=1) > 400
    made = as_rational(table, replace(found, used=found.used & ~rejected))
    assert model == LensModel(4, FISHEYE)
    assert rejected.sum() > 20
    every = np.ones(len(table), dtype=bool)
    away = term_of(table, every, False).project(made) - term_of(table, every, True).project(found.values)
    assert np.max(np.abs(away)) < 3  # px; nan where the approximation folds before a corner


@pytest.mark.slow
def test_few_rendered_photographs_of_a_wide_rational_lens_give_that_lens():
    """No start of a perspective lens converged within 40 steps, and no rational fit from the fisheye."""
    found = calibrate_intrinsics(rendered_set("rational", BOARDS["charuco"], 78100, 7).table)
    assert found.model == LensModel(8)
    assert abs(found.fit.lens[0] - 496.099) < 2 * found.sigmas[0]
    assert found.sigmas[0] < 1  # px; of the fisheye 9


def test_few_photographs_of_a_wide_rational_lens_give_that_lens():
    """The rational fit did not converge, and a fisheye was chosen, known to .8 px."""
    scene = Scene(lens=RATIONAL, views=8, sigma_px=0.03, columns=8, tilt_rad=0.6, roll_rad=0.5, size_px=(1280, 960))
    found = calibrate_intrinsics(photographs(replace(scene, distance_m=(0.12, 0.25), at_most=0.55), 14))
    assert found.model == LensModel(8)
    assert abs(found.fit.lens[0] - RATIONAL[0]) < 2 * found.sigmas[0]
    assert found.sigmas[0] < 0.2  # px


def test_corners_that_the_start_cannot_predict_are_found_again():
    """The start of the plain lens folds before the outermost corner of a wide rational one."""
    table = photographs(Scene(lens=RATIONAL, views=6, distance_m=(0.08, 0.2)), 17)
    model, values = start(table, False)
    with np.errstate(invalid="ignore"):
        away = term_of(table, np.ones(len(table), dtype=bool), False).project(values) - table.pixels
    assert not np.isfinite(away).all()
    found = robust_fit(table, model, values, AS_STATED, BRIEF)
    assert found.used.mean() > 0.97
