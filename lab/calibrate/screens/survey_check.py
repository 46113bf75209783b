"""Checks of a survey: swapped axes, wrong units, cameras far from their `near_m`, points that are not on their screen.

The pixels alone cannot detect a rotated or mirrored world frame; `calibrate screen` and `calibrate rig` start here.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeAlias

import numpy as np

from calibration.findings import Finding, Level
from calibration.least_squares.adjustment import AdjustmentError
from calibration.screens.network_start import NotConnectedError
from calibration.screens.screens import ScreensResult, calibrate
from calibration.screens.survey_diagnosis import SurveyError, diagnose_survey, misfit_of
from lab.calibrate.screens.screen_inputs import ScreenInputs
from lab.errors import CalibrationError, InputError
from lab.files.project.project_types import Project

SearchProgress: TypeAlias = Callable[[int, int], None]
_SUSPICIOUS_MISFIT = 4.0  # misfit (see survey_diagnosis.py) above which swapped axes and wrong units are tested
_ACCEPTED_MISFIT = 2.0  # misfit below which a change to the survey is accepted as the explanation


def adjusted_screens(project: Project, inputs: ScreenInputs, progress: SearchProgress | None = None) -> ScreensResult:
    """Adjust cameras and screens to the survey; if they do not fit, find the mistake in the survey.

    progress: called with the number of changes to the survey that have been tried, and of all.

    Raises:
        InputError: for a survey that fits with other axes, signs or units, or parts without common measurements.
        CalibrationError: if the measurements do not determine a calibration.
    """
    where = ", ".join(str(p) for p in project.survey) or str(project.path)
    problem: Exception | None = None
    misfit = float("inf")
    try:
        result = calibrate(inputs.network, inputs.setups, inputs.near, inputs.held_screen)
        misfit = misfit_of(result, inputs.near)
    except (NotConnectedError, AdjustmentError, ValueError) as error:
        problem = error
    enough = len(inputs.network.point_observations) >= 4
    if enough and misfit > _SUSPICIOUS_MISFIT and not _too_few_points(problem):
        changes = diagnose_survey(inputs.network, inputs.setups, inputs.near, inputs.held_screen, misfit, progress)
        explanations = [c for c in changes if c.factor < _ACCEPTED_MISFIT]
        if explanations:
            raise InputError(_explained(where, explanations))
    if isinstance(problem, AdjustmentError):
        raise CalibrationError(f"{project.path}: the measurements do not determine a calibration: {problem}") from None
    if problem is not None:
        raise InputError(f"{where}: {problem}") from None
    return result


def _too_few_points(problem: Exception | None) -> bool:
    """Whether a camera or a screen has too few control points, which no change of axes or unit can correct."""
    text = str(problem or "")
    return any(words in text for words in ("expected 4 or more", "expected 3 or more", "on one line", "found none"))


def _explained(where: str, explanations: Sequence[SurveyError]) -> str:
    """The message that names the change with which the survey fits."""
    best = explanations[0]
    others = [c for c in explanations[1:] if c.factor < 1.2 * best.factor]
    text = f"{where}: does not fit the pixels as it is, but {best.words} does"
    if others:
        text += (
            f" (so do {len(others)} other changes, such as {others[0].words}: a mirrored survey fits the same with any"
            " two axes swapped; give a camera's position as `near_m` to distinguish them)"
        )
    return f"{text}; correct the file"


def survey_findings(project: Project, result: ScreensResult) -> list[Finding]:
    """Findings on shared lens files, and on control points that are off their screens or cover too little of them."""
    return [*_shared_lenses(project), *_coverage(project, result)]


def _shared_lenses(project: Project) -> list[Finding]:
    """Warnings for two cameras with the same lens calibration: two lenses are never identical."""
    out = []
    names = list(project.cameras)
    for i, first in enumerate(names):
        for second in names[i + 1 :]:
            a, b = project.cameras[first], project.cameras[second]
            # A file may hold several cameras, each with its own numbers.
            if a.lens_path == b.lens_path and np.array_equal(a.lens.camera_matrix, b.lens.camera_matrix):
                out.append(
                    Finding(
                        Level.WARN,
                        f"cameras {first!r} and {second!r} share the lens calibration {a.lens_path.name}",
                        "two lenses of one type differ by much more than the errors of a calibration",
                        "give each camera its own lens calibration",
                        code="BP-S12",
                    )
                )
    return out


def _coverage(project: Project, result: ScreensResult) -> list[Finding]:
    """Warnings for control points outside of their screen, and for screens that the points cover only partly."""
    out = []
    for (name, entry), screen in zip(project.screens.items(), result.screens, strict=True):
        if entry.size_m is None or not screen.control_points:
            continue
        half = np.array(entry.size_m) / 2
        reach = np.abs(screen.xyz[:, :2])
        beyond = np.flatnonzero((reach > half + 0.01).any(axis=1))
        if beyond.size:
            point = result.network.control_points.names[screen.control_points[int(beyond[0])]]
            count = "1 point" if len(beyond) == 1 else f"{len(beyond)} points"
            out.append(
                Finding(
                    Level.WARN,
                    f"screen {name!r}: control point {point!r} is outside of size_m ({count} in all)",
                    "spots outside of size_m count as off the screen",
                    "correct size_m, or define the screen's frame by three named points (`frame`)",
                    code="BP-S13",
                )
            )
        share = np.ptp(screen.xyz[screen.used, :2], axis=0) / np.array(entry.size_m)
        if share.min() < 0.6:
            out.append(
                Finding(
                    Level.WARN,
                    f"screen {name!r}: the control points cover {100 * share[0]:.0f} % of its width and"
                    f" {100 * share[1]:.0f} % of its height",
                    "outside of the control points its shape is extrapolated"
                    + ("" if entry.frame else ", and the centre of the points is taken as the centre of the screen"),
                    "survey points near its corners" + ("" if entry.frame else ", or name three points in `frame`"),
                    code="BP-S14",
                )
            )
    return out
