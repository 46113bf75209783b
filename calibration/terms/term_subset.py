"""Terms of measurements with some of their rows, or with wider sigmas."""

from __future__ import annotations

from dataclasses import replace

from calibration.least_squares.adjustment import Loss, Term
from calibration.terms.corners import CornerTerm
from calibration.terms.pose_records import RecordTerm
from calibration.terms.spot_term import SpotTerm
from calibration.terms.surveyed import PointTerm, SurfaceTerm, SurveyTerm
from geometry.arrays import Bools


def rows_of(term: Term) -> int:
    """How many measurements a term holds."""
    if isinstance(term, SpotTerm):
        return len(term.spots)
    if isinstance(term, CornerTerm):
        return len(term)
    if isinstance(term, PointTerm):
        return len(term.pixels)
    assert isinstance(term, RecordTerm)
    return len(term.index)


def picked(term: Term, rows: Bools, loss: Loss | None = None) -> Term:
    """Some rows of a term."""
    if isinstance(term, SpotTerm):
        return SpotTerm(term.rig, term.spots.pick(rows), loss)
    if isinstance(term, PointTerm):
        return PointTerm(
            term.camera_of[rows], term.point_of[rows], term.pixels[rows], term.whiten[rows], term.fisheye, loss
        )
    if isinstance(term, RecordTerm):
        return RecordTerm(term.stack, term.index[rows], term.recorded[rows], term.sigmas[rows], loss)
    assert isinstance(term, CornerTerm)
    per_row = ["pixels", "points", "from_middle", "camera", "placement", "board", "sigma_px"]
    per_row += [] if term.point is None else ["point"]
    return replace(term, **{n: getattr(term, n)[rows] for n in per_row}, loss=loss)


def widened(term: Term, scale: float) -> Term:
    """A term with all its sigmas multiplied."""
    if scale == 1.0:
        return term
    if isinstance(term, SpotTerm):
        return SpotTerm(term.rig, replace(term.spots, covariance=term.spots.covariance * scale**2), term.loss)
    if isinstance(term, PointTerm | SurveyTerm):
        return replace(term, whiten=term.whiten / scale)
    if isinstance(term, SurfaceTerm):
        return replace(term, sigma_m=term.sigma_m * scale)
    if isinstance(term, CornerTerm):
        return replace(term, sigma_px=term.sigma_px * scale)
    assert isinstance(term, RecordTerm)
    return replace(term, sigmas=term.sigmas * scale)
