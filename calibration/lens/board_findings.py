"""What a camera's calibration says of the board that it was made with, and of its lens model as such."""

from __future__ import annotations

import numpy as np

from calibration.findings import Finding, Level, unless_pass
from calibration.lens.intrinsics_result import Intrinsics

DOUBTFUL = 2.0  # factor on the sigmas, from what lens models disagree on and residuals that go together
OUT_OF_SCALE = 0.001  # share by which a board's rows and columns may be out of scale: printers reach .1 %
UNDETERMINED = 0.002  # of that share, and of the pixels' shape: beyond it the two cannot be distinguished
OTHER_CIRCLE = 0.03  # share by which circles may differ from what was stated


def _two(value: float) -> str:
    """Two significant digits."""
    return f"{value:.2g}"


def doubt_finding(c: Intrinsics) -> Finding | None:
    """What the lens model may be wrong by beyond its numbers' sigmas; None where nothing tells of it."""
    d = c.doubt
    parts = []
    if d.left_px > 0:
        parts.append(f"residuals that go together over the picture by {d.left_px:.2g} px (p = {d.p_value:.1g})")
    if d.other is not None and d.between_px > 0:
        parts.append(f"{_two(d.between_px)} px to the {d.other.words}, which predicts held-out views nearly as well")
    if not parts:
        return None
    return unless_pass(
        Level.WARN if d.factor > DOUBTFUL or d.left_px > 0 else Level.PASS,
        f"Doubt about the lens model: {' and '.join(parts)}; all sigmas have been multiplied by {d.factor:.2f} for it.",
        "The lens bends light in a way that no model here follows, or the photographs do not tell which one does.",
        "Take more photographs with the board near the border of the picture, where lens models differ; name the lens"
        " model if you know it (--lens).",
    )


def stretch_finding(c: Intrinsics) -> Finding | None:
    """Whether the board's rows and columns are to scale; None where the photographs do not tell."""
    s = None if c.board is None else c.board.stretch
    if s is None:
        return None
    text = (
        f"The board's rows are {100 * s.stretch:+.3f} ± {100 * s.sigma[0]:.1g} % longer than was said, if its columns"
        f" are right, and lean by {np.degrees(s.lean_rad):+.3f} ± {np.degrees(s.sigma[1]):.1g} deg"
        f" (p = {s.p_value:.1g}): {s.why}"
    )
    if not s.corrected:
        fx, fy = c.fit.lens[:2]
        open_question = s.sigma[0] > UNDETERMINED and abs(fx / fy - 1) > UNDETERMINED
        return unless_pass(
            Level.WARN if open_question else Level.PASS,
            text + "; taken as stated.",
            f"The photographs cannot tell a board that is out of scale from pixels that are not square, and fx / fy is"
            f" {fx / fy:.4f}: one of the two is so.",
            "Photograph the board turned by 90 deg in its plane as well; measure it along both directions.",
        )
    off = max(abs(s.stretch), abs(s.lean_rad))
    return unless_pass(
        Level.WARN if off > OUT_OF_SCALE else Level.PASS,
        text + "; corrected.",
        "The lens is right with that. Which of the two directions is right, and the board's size as a whole, no"
        " photograph of it shows: distances from this board are wrong by up to as much.",
        "Measure the board over its whole length in both directions (printers stretch along the paper's feed), print it"
        " again at 100 %, or state what it measures.",
    )


def points_finding(c: Intrinsics) -> Finding | None:
    """Whether single points of the board lie off; None where they do not."""
    p = None if c.board is None else c.board.points
    if p is None or not (p.corrected or np.any(p.off_m)):
        return None
    worst = int(np.argmax(np.linalg.norm(p.off_m[:, :2], axis=1)))
    off = 1000 * float(np.linalg.norm(p.off_m[worst, :2]))
    where = 1000 * c.table.board_points[worst, :2]
    return Finding(
        Level.WARN if p.corrected else Level.PASS,
        f"Points of the board lie off by {1000 * p.rms_m:.2g} mm RMS, the worst, at {where[0]:.0f}, {where[1]:.0f} mm,"
        f" by {off:.2g} mm (p = {p.p_value:.1g} if all lay right): {p.why}"
        + ("; each was solved for." if p.corrected else "; taken as stated."),
        "A board whose points do not lie as stated: printed unevenly, joined of several sheets, wavy, or damaged."
        if p.corrected
        else "",
        "Print it on one stiff sheet, or use a machined board." if p.corrected else "",
    )


def circles_finding(c: Intrinsics) -> Finding | None:
    """How large the board's circles are; None for other boards."""
    if c.table.circles is None:
        return None
    found = 2000 * c.fit.radius_m
    sigma = 2000 * c.fit.radius_sigma_m
    text = f"The circles measure {found:.3f} ± {_two(sigma)} mm across"
    stated = c.table.circles.diameter_m
    if c.table.circles.areas_px2 is None and stated is None:
        return Finding(Level.PASS, text + ", as their centres show: nothing else tells of it.")
    if stated is None:
        return Finding(Level.PASS, text + ".")
    share = found / (1000 * stated) - 1
    return unless_pass(
        Level.WARN if abs(share) > OTHER_CIRCLE else Level.PASS,
        f"{text}, {100 * share:+.1f} % against the {1000 * stated:.4g} mm stated.",
        "The measured size was used. Ink that spreads makes circles larger; else spacing and diameter do not belong to"
        " the same board, or one of them was mistaken.",
        "Measure a circle and the distance of circles on the board, and state what they are.",
    )
