"""Findings of a camera's calibration about its board and about the choice of lens model."""

from __future__ import annotations

import numpy as np

from calibration.findings import Finding, Level, unless_pass
from calibration.lens.intrinsics_result import Intrinsics

SLIGHT_MODEL_ERROR = 1.02  # that factor below which it is not worth a remark
UNCERTAIN_MODEL = 2.0  # factor on the sigmas, from rival models and correlated residuals, above which to warn
UNNOTICED_PX = 0.1  # change of directions by an unsolved deviation of the board above which to warn
OUT_OF_SCALE = 0.001  # relative scale difference of rows and columns above which to warn: printers reach .1 %
UNDETERMINED = 0.002  # relative, of that difference and of fx / fy: above it the two cannot be distinguished
OTHER_CIRCLE = 0.03  # relative difference from the stated diameter above which to warn


def _two(value: float) -> str:
    """Two significant digits."""
    return f"{value:.2g}"


def model_uncertainty_finding(c: Intrinsics) -> Finding | None:
    """Model error beyond the covariance of the parameters; None if there is no evidence of it."""
    d = c.model_uncertainty
    parts = []
    if d.left_px > 0:
        parts.append(f"correlated residuals over the picture of {d.left_px:.2g} px (p = {d.p_value:.1g})")
    if d.between_px > 0:
        parts.append(f"{_two(d.between_px)} px to the other models, by their probabilities")
    if d.factor < SLIGHT_MODEL_ERROR:
        return None
    return unless_pass(
        Level.WARN if d.factor > UNCERTAIN_MODEL or d.left_px > 0 else Level.PASS,
        f"Uncertainty of the lens model: {' and '.join(parts)}; all sigmas have been multiplied by {d.factor:.2f}.",
        "The lens distorts in a way that no available model describes, or the photographs cannot distinguish between"
        " the models.",
        "Take more photographs with the board near the border of the picture, where lens models differ; name the lens"
        " model if you know it (--lens).",
        code="BP-L01",
    )


def stretch_finding(c: Intrinsics) -> Finding | None:
    """Whether the board's rows and columns are to scale; None if the photographs do not determine it."""
    s = None if c.board is None else c.board.stretch
    if s is None:
        return None
    text = (
        f"The board's rows are {100 * s.stretch:+.3f} ± {100 * s.sigma[0]:.1g} % longer than stated, if its columns"
        f" are right, and deviate from the right angle by"
        f" {np.degrees(s.lean_rad):+.3f} ± {np.degrees(s.sigma[1]):.1g} deg"
        f" (p = {s.p_value:.1g}): {s.why}"
    )
    if not s.corrected:
        fx, fy = c.fit.lens[:2]
        open_question = s.sigma[0] > UNDETERMINED and abs(fx / fy - 1) > UNDETERMINED
        if s.change_px > 0 and not open_question:
            return unless_pass(
                Level.WARN if s.change_px > UNNOTICED_PX else Level.PASS,
                f"{text}; taken as stated. Solving for it would change directions by {_two(s.change_px)} px RMS.",
                "The photographs do not show whether the board, the lens model or the corners cause this.",
                "Measure the board along both directions and state the sizes, or solve for them (--stretch on).",
                code="BP-L03",
            )
        return unless_pass(
            Level.WARN if open_question else Level.PASS,
            text + "; taken as stated.",
            "The photographs cannot distinguish a board that is out of scale from pixels that are not square; one of"
            f" the two is the case: fx / fy is {fx / fy:.4f}.",
            "Photograph the board turned by 90 deg in its plane as well; measure it along both directions.",
            code="BP-L02",
        )
    off = max(abs(s.stretch), abs(s.lean_rad))
    return unless_pass(
        Level.WARN if off > OUT_OF_SCALE else Level.PASS,
        text + "; corrected.",
        "The lens is correct with this correction. The photographs do not show which of the two directions is right,"
        " nor the board's absolute size: distances measured from this board may be wrong by the same share.",
        "Measure the board over its whole length in both directions (printers stretch along the paper feed), print it"
        " again at 100 %, or state the measured sizes.",
        code="BP-L03",
    )


def points_finding(c: Intrinsics) -> Finding | None:
    """Whether single points of the board are displaced; None if not."""
    p = None if c.board is None else c.board.points
    if p is None or not (p.corrected or np.any(p.off_m)):
        return None
    worst = int(np.argmax(np.linalg.norm(p.off_m[:, :2], axis=1)))
    off = 1000 * float(np.linalg.norm(p.off_m[worst, :2]))
    where = 1000 * c.table.board_points[worst, :2]
    return Finding(
        Level.WARN if p.corrected else Level.PASS,
        f"Points of the board are displaced by {1000 * p.rms_m:.2g} mm RMS, the worst, at {where[0]:.0f},"
        f" {where[1]:.0f} mm, by {off:.2g} mm (p = {p.p_value:.1g} for a correct board): {p.why}"
        + (
            "; each was solved for."
            if p.corrected
            else f"; taken as stated. Solving for them would change directions by {_two(p.change_px)} px RMS."
        ),
        "The board's points are not where they were stated to be: it is printed unevenly, joined from several sheets,"
        " wavy or damaged."
        if p.corrected
        else "",
        "Print it on one stiff sheet, or use a machined board." if p.corrected else "",
        code="BP-L04",
    )


def circles_finding(c: Intrinsics) -> Finding | None:
    """Size of the board's circles; None for other boards."""
    if c.table.circles is None:
        return None
    found = 2000 * c.fit.radius_m
    sigma = 2000 * c.fit.radius_sigma_m
    text = f"The circles have a diameter of {found:.3f} ± {_two(sigma)} mm"
    stated = c.table.circles.diameter_m
    if c.table.circles.areas_px2 is None and stated is None:
        return Finding(Level.PASS, text + ", from the shift of their centroids alone.")
    if stated is None:
        return Finding(Level.PASS, text + ".")
    share = found / (1000 * stated) - 1
    return unless_pass(
        Level.WARN if abs(share) > OTHER_CIRCLE else Level.PASS,
        f"{text}, {100 * share:+.1f} % against the {1000 * stated:.4g} mm stated.",
        "The measured size was used. Ink that spreads makes circles larger; otherwise spacing and diameter are not of"
        " the same board, or one of them is wrong.",
        "Measure the diameter and the spacing of the circles on the board, and state both.",
        code="BP-L05",
    )
