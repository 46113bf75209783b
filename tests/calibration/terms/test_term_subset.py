"""Some rows of a term, or wider sigmas: the residuals of those rows, and smaller residuals."""

from __future__ import annotations

import numpy as np
import pytest

from calibration.least_squares.adjustment import Cauchy, Poses
from calibration.terms.rig_blocks import SpotTerm
from calibration.terms.surveyed import RecordTerm, picked, rows_of, widened
from geometry.pose import Pose
from tests.calibration.terms import test_corners, test_spot_term, test_surveyed


def terms() -> dict:
    """Each kind of term with values at which its residuals are not zero."""
    rng = np.random.default_rng(3)
    rig, values, spots = test_spot_term.scene(1)
    values["poses"] = values["poses"].plus(np.full((test_spot_term.POSITIONS, 6), 1e-3))
    recorded = Pose.from_ypr(rng.normal(size=(4, 3)), rng.normal(size=(4, 3)))
    records = RecordTerm("poses", np.arange(4), recorded, rng.uniform(0.01, 0.1, (4, 6)))
    surveyed = {n: (term, test_surveyed.scene()) for n, term in test_surveyed.terms().items() if n != "frame"}
    return {
        "spots": (SpotTerm(rig, spots), values),
        "corners": test_corners.scene(rng, (0.006, 0.0)),
        "records": (records, {"poses": Poses(recorded.plus(rng.normal(0, 0.1, (4, 6))))}),
        **surveyed,
    }


@pytest.mark.parametrize("kind", ["spots", "corners", "records", "point"])
def test_some_rows_of_a_term_have_the_residuals_and_derivatives_of_those_rows(kind):
    term, values = terms()[kind]
    whole = term.linearise(values)
    assert rows_of(term) == len(whole.residuals)
    rows = np.arange(rows_of(term)) % 2 == 0
    some = picked(term, rows, Cauchy(2.0))
    assert (rows_of(some), some.loss, picked(some, rows[rows]).loss) == (rows.sum(), Cauchy(2.0), None)
    line = some.linearise(values)
    np.testing.assert_allclose(line.residuals, whole.residuals[rows], rtol=1e-12, atol=1e-12)
    for part, part_of_whole in zip(line.parts, whole.parts, strict=True):
        np.testing.assert_array_equal(part.index, part_of_whole.index[rows])
        np.testing.assert_allclose(part.jacobian, part_of_whole.jacobian[rows], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("kind", ["spots", "corners", "records", "point", "surface", "survey"])
def test_sigmas_twice_as_wide_halve_the_residuals(kind):
    term, values = terms()[kind]
    wide = widened(term, 2.0)
    assert np.abs(term.linearise(values).residuals).max() > 1e-3
    np.testing.assert_allclose(
        2 * wide.linearise(values).residuals, term.linearise(values).residuals, rtol=1e-9, atol=1e-12
    )


def test_a_scale_of_one_leaves_any_term_alone():
    frame = test_surveyed.terms()["frame"]
    assert widened(frame, 1.0) is frame
