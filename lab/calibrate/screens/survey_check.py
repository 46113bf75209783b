"""Whether a survey can be right: swapped axes, other units, cameras far from their `near_m`, dots off their screens.

Pixels alone let a turned or mirrored world pass; so both `calibrate screen` and `calibrate rig` begin here.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calibration.findings import Finding, Level
from calibration.least_squares.adjustment import AdjustmentError
from calibration.screens.network_start import NotConnectedError
from calibration.screens.screens import ScreensResult, calibrate
from calibration.screens.survey_suspects import SurveySuspect, misfit_of, suspects
from lab.calibrate.screens.screen_inputs import ScreenInputs
from lab.errors import CalibrationError, InputError
from lab.files.project.project_types import Project

_SUSPICIOUS = 4.0  # misfit (see survey_suspects.py) from which swapped axes and wrong units are looked for
_CURED = 2.0  # misfit up to which a change to the survey counts as what was wrong


def adjusted_screens(project: Project, inputs: ScreenInputs) -> ScreensResult:
    """The adjustment of cameras and screens by the survey; where nothing fits, what about the survey may be wrong.

    Raises InputError for a survey that fits with other axes, signs or units and for parts that share nothing,
    CalibrationError where the measurements give no calibration.
    """
    where = ", ".join(str(p) for p in project.survey) or str(project.path)
    problem: Exception | None = None
    miss = float("inf")
    try:
        result = calibrate(inputs.network, inputs.setups, inputs.near, inputs.held_screen)
        miss = misfit_of(result, inputs.near)
    except (NotConnectedError, AdjustmentError, ValueError) as error:
        problem = error
    enough = len(inputs.network.sightings) >= 4
    if enough and miss > _SUSPICIOUS and not _plainly_missing(inputs, problem):
        changes = suspects(inputs.network, inputs.setups, inputs.near, inputs.held_screen, miss)
        remedies = [c for c in changes if c.factor < _CURED]
        if remedies:
            raise InputError(_suspicion(where, remedies))
    if isinstance(problem, AdjustmentError):
        raise CalibrationError(f"{project.path}: the measurements give no calibration: {problem}") from None
    if problem is not None:
        raise InputError(f"{where}: {problem}") from None
    return result


def _plainly_missing(inputs: ScreenInputs, problem: Exception | None) -> bool:
    """Whether a camera has too few dots, or a screen: no other axes or unit would mend that."""
    text = str(problem or "")
    return any(words in text for words in ("expected 4 or more", "expected 3 or more", "on one line", "found none"))


def _suspicion(where: str, remedies: Sequence[SurveySuspect]) -> str:
    """What the survey's columns seem to hold."""
    best = remedies[0]
    others = [c for c in remedies[1:] if c.factor < 1.2 * best.factor]
    text = f"{where}: does not fit the pixels as it is, but {best.words} does"
    if others:
        text += (
            f" (so do {len(others)} other changes, such as {others[0].words}: a mirrored survey looks the same"
            " whichever axes are swapped; give a camera's place as `near_m` to tell)"
        )
    return f"{text}; mend the file"


def survey_findings(project: Project, result: ScreensResult) -> list[Finding]:
    """Whether the dots lie on their screens and reach over them, and every camera has a lens calibration of its own."""
    return [*_shared_lenses(project), *_coverage(project, result)]


def _shared_lenses(project: Project) -> list[Finding]:
    """Two cameras with one file of a lens: their lenses are never the same."""
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
                        "lenses of one type differ by far more than their calibrations' errors",
                        "give each camera the file of its own calibration",
                    )
                )
    return out


def _coverage(project: Project, result: ScreensResult) -> list[Finding]:
    """Whether the dots reach over the screens, and lie on them."""
    out = []
    for (name, entry), screen in zip(project.screens.items(), result.screens, strict=True):
        if entry.size_m is None or not screen.dots:
            continue
        half = np.array(entry.size_m) / 2
        reach = np.abs(screen.xyz[:, :2])
        beyond = np.flatnonzero((reach > half + 0.01).any(axis=1))
        if beyond.size:
            dot = result.network.dots.names[screen.dots[int(beyond[0])]]
            out.append(
                Finding(
                    Level.WARN,
                    f"screen {name!r}: dot {dot!r} lies outside its size_m "
                    f"({len(beyond)} dot{' does' if len(beyond) == 1 else 's do'})",
                    "spots beyond size_m count as off the screen",
                    "correct size_m, or fix the screen's frame by named dots (`frame`)",
                )
            )
        share = np.ptp(screen.xyz[screen.used, :2], axis=0) / np.array(entry.size_m)
        if share.min() < 0.6:
            out.append(
                Finding(
                    Level.WARN,
                    f"screen {name!r}: its dots reach over {100 * share[0]:.0f} % of its width and"
                    f" {100 * share[1]:.0f} % of its height",
                    "beyond the dots its shape is a guess"
                    + ("" if entry.frame else ", and the middle of the dots is taken for the screen's middle"),
                    "survey dots near its corners" + ("" if entry.frame else ", or name three dots in `frame`"),
                )
            )
    return out
