"""The rational start for a lens that a fisheye model does not describe out to the picture's corners."""

from dataclasses import replace

import numpy as np

from calibration.lens.fit.lens_adjustment import BRIEF, term_of
from calibration.lens.fit.lens_fit import robust_fit
from calibration.lens.fit.lens_models import LensModel
from calibration.lens.fit.lens_parameters import AS_STATED
from calibration.lens.fit.lens_start import start
from calibration.lens.fit.model_selection import as_rational
from geometry.camera import FISHEYE
from tests.calibration.lens.lens_scenes import WIDE, Scene, photographs


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
