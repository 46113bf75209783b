"""`beampose calibrate screen`: poses of screens and cameras and flatness of the screens, with their covariance."""

from __future__ import annotations

import datetime
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from calibration.findings import Finding, Level, verdict
from calibration.screens.network_findings import findings as network_findings
from calibration.screens.network_findings import near_findings
from calibration.screens.network_sigmas import pointing_sigmas_m, spot_sigmas
from calibration.screens.screens import ScreensResult
from geometry.rig import Rig
from lab.calibrate.calibration_date import calibration_date, expiry_date, expiry_findings
from lab.calibrate.screens.screen_inputs import SearchProgress, adjusted_screens, screen_inputs, survey_findings
from lab.calibrate.screens.screen_tables import DOTS, RESIDUALS, write_tables
from lab.errors import CalibrationError
from lab.files.project.project import load_project
from lab.files.project.project_blocks import Project
from lab.files.rig.calibration_state import CalibrationState
from lab.files.rig.rig_file import RigFile, covariance_blocks, save_rig
from lab.files.rig.screens_file import ScreensFile, save_screens
from lab.files.text.atomic_write import atomic_folder, check_output_folder, keep_good_results

SCREENS, RIG = "screens.yaml", "rig.yaml"


@dataclass(frozen=True, slots=True)
class ScreensOutcome:
    """Result of a screen calibration."""

    name: str
    out: Path
    level: Level
    findings: tuple[Finding, ...]
    result: ScreensResult

    @property
    def exit_status(self) -> int:
        """0, or 3 if the calibration must not be used."""
        return CalibrationError.exit_status if self.level == Level.FAIL else 0

    def line(self) -> str:
        """One line for the terminal."""
        rig = self.result.fit.rig
        surface = 1e3 * max(float(np.max(spot_sigmas(self.result, k))) for k in range(len(rig.screens)))
        place = 1e3 * max(pointing_sigmas_m(self.result).values())
        worst = max(self.findings, key=lambda f: f.level)
        reason = "" if self.level == Level.PASS else f": {worst.what}"
        return (
            f"{self.name}: {self.level.name}: {_counted(len(rig.cameras), 'camera')}, "
            f"{_counted(len(rig.screens), 'screen')}, surfaces to {surface:.2g} mm, cameras to {place:.2g} mm on them"
            f"{reason} -> {self.out}"
        )


def _counted(n: int, what: str) -> str:
    return f"{n} {what}{'' if n == 1 else 's'}"


def calibrate_screen(
    project_path: Path, out: Path, today: datetime.date | None = None, *, progress: SearchProgress | None = None
) -> ScreensOutcome:
    """Calibrate the screens and the poses of the cameras of a project.

    Writes into `out`: screens.yaml; rig.yaml with the nominal beams, if the project has a target; residuals.csv,
    dots.csv and report.html. If the verdict is FAIL, no YAML file is written and an earlier calibration is kept: the
    results go to `OUT-failed`. progress: of the search for a mistake in a survey that does not fit.

    Raises:
        InputError: for errors in the files.
        CalibrationError: if the measurements do not determine a calibration. `out` is left unchanged.
    """
    check_output_folder(out, _is_ours)
    project = load_project(Path(project_path))
    day = calibration_date(project, today)
    inputs = screen_inputs(project)
    result = adjusted_screens(project, inputs, progress)
    placed = near_findings(result, inputs.near)
    found = [
        *placed,
        *network_findings(result, names_doubted=verdict(placed) > Level.PASS),
        *survey_findings(project, result),
        *expiry_findings(project, day, today),
        *(Finding(Level.WARN, note, code="BP-K08") for note in inputs.notes),
    ]
    level = verdict(found)
    folder = keep_good_results(out, level == Level.FAIL, SCREENS)
    outcome = ScreensOutcome(project.name, folder, level, tuple(found), result)
    with atomic_folder(folder, may_replace=_is_ours) as work:
        if level != Level.FAIL:
            _save(project, outcome, day, work)
        write_tables(result, work)
        from lab.calibrate.screens.screen_page import write_page  # imports the template engine

        write_page(result, found, project, inputs, day, work)
    return outcome


def _is_ours(folder: Path) -> bool:
    return (folder / DOTS).is_file() and (folder / RESIDUALS).is_file()


# Files ------------------------------------------------------------------------------------------------------------


def _save(project: Project, outcome: ScreensOutcome, day: datetime.date, folder: Path) -> None:
    until = expiry_date(project, day)
    reasons = tuple(f.what for f in outcome.findings if f.level > Level.PASS)
    state = CalibrationState(day, outcome.level.name, until, reasons, project.notes)
    fit = outcome.result.fit
    rig = fit.rig
    for k, (name, screen) in enumerate(rig.screens.items()):
        scan = None if project.screens[name].cloud is None else outcome.result.screens[k]
        if screen.size_m is None and scan is not None:
            width, height = (2 * np.abs(scan.xyz[:, :2]).max(axis=0)).tolist()
            rig = replace(rig, screens={**rig.screens, name: replace(screen, size_m=(width, height))})
    save_screens(ScreensFile(project.name, rig, fit.covariance, state), folder / SCREENS)
    if project.beams:
        note = "the beams are nominal, not calibrated: run `beampose calibrate beams`"
        state = replace(state, verdict=max(outcome.level, Level.WARN).name, reasons=(note, *reasons))
        whole = Rig(rig.screens, rig.cameras, project.beams, project.spots)
        save_rig(RigFile(whole, covariance_blocks(fit.covariance), state), folder / RIG)
