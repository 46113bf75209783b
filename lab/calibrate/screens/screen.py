"""`beampose calibrate screen`: poses of screens and cameras and flatness of the screens, with their covariance."""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from calibration.screens.network_sigmas import pointing_sigmas_m, spot_sigmas
from calibration.screens.screens import ScreensResult
from geometry.rig import Rig
from lab.calibrate.screens.screen_findings import near_findings, network_findings, survey_findings
from lab.calibrate.screens.screen_inputs import adjusted_screens, screen_inputs
from lab.calibrate.screens.screen_page import page_of
from lab.calibrate.screens.screen_tables import DOTS, RESIDUALS, write_tables
from lab.calibrate.step import Solved, Step, calibration_date, expiry_date, expiry_findings, run_step
from lab.files.project.project import Project, load_project
from lab.files.rig.calibration_state import CalibrationState
from lab.files.rig.rig_file import RigFile, covariance_blocks, save_rig
from lab.files.rig.screens_file import ScreensFile, save_screens
from lab.findings.finding import Finding, Level, finding, reasons, verdict
from lab.findings.outcome import Outcome
from lab.progress import Progress

SCREENS, RIG = "screens.yaml", "rig.yaml"


_STEP = Step("Screens", (DOTS, RESIDUALS), SCREENS)


def calibrate_screen(
    project_path: Path, out: Path, today: datetime.date | None = None, *, progress: Progress | None = None
) -> Outcome[ScreensResult]:
    """Calibrate the screens and the poses of the cameras of a project.

    Writes into `out`: screens.yaml; rig.yaml with the nominal beams, if the project has a target; residuals.csv,
    dots.csv and report.html. If the verdict is FAIL, no YAML file is written. progress: of the search for a mistake in
    a survey that does not fit.

    Raises:
        InputError: for errors in the files.
        CalibrationError: if the measurements do not determine a calibration.
    """
    return run_step(_STEP, out, lambda: _solve(Path(project_path), today, progress))


def _solve(project_path: Path, today: datetime.date | None, progress: Progress | None) -> Solved[ScreensResult]:
    project = load_project(project_path)
    day = calibration_date(project, today)
    inputs = screen_inputs(project)
    result = adjusted_screens(project, inputs, progress)
    placed = near_findings(result, inputs.near)
    findings = (
        *placed,
        *network_findings(result, names_doubted=verdict(placed) > Level.PASS),
        *survey_findings(project, result),
        *expiry_findings(project, day, today),
        *(finding("BP-K08", Level.WARN, note) for note in inputs.notes),
    )

    def write(folder: Path) -> None:
        if verdict(findings) < Level.FAIL:
            _save(project, result, findings, day, folder)
        write_tables(result, folder)

    return Solved(
        name=project.name,
        result=result,
        findings=findings,
        figures=_figures(result),
        write=write,
        page=lambda: page_of(result, project, inputs.remarks),
        day=day,
        inputs=project.inputs,
    )


def _figures(result: ScreensResult) -> str:
    rig = result.fit.rig
    surface = 1e3 * max(float(np.max(spot_sigmas(result, k))) for k in range(len(rig.screens)))
    place = 1e3 * max(pointing_sigmas_m(result).values())
    counted = ", ".join(
        f"{n} {what}{'' if n == 1 else 's'}" for n, what in ((len(rig.cameras), "camera"), (len(rig.screens), "screen"))
    )
    return f"{counted}, surfaces to {surface:.2g} mm, cameras to {place:.2g} mm on them"


def _save(
    project: Project, result: ScreensResult, findings: Sequence[Finding], day: datetime.date, folder: Path
) -> None:
    level, why, fit = verdict(findings), reasons(findings), result.fit
    state = CalibrationState(day, level.name, expiry_date(project, day), why, project.notes)
    rig = fit.rig
    for k, (name, screen) in enumerate(rig.screens.items()):
        scan = None if project.screens[name].cloud is None else result.screens[k]
        if screen.size_m is None and scan is not None:
            width, height = (2 * np.abs(scan.xyz[:, :2]).max(axis=0)).tolist()
            rig = replace(rig, screens={**rig.screens, name: replace(screen, size_m=(width, height))})
    save_screens(ScreensFile(project.name, rig, fit.covariance, state), folder / SCREENS)
    if project.beams:
        note = "the beams are nominal, not calibrated: run `beampose calibrate beams`"
        state = replace(state, verdict=max(level, Level.WARN).name, reasons=(note, *why))
        whole = Rig(rig.screens, rig.cameras, project.beams, project.spots)
        save_rig(RigFile(whole, covariance_blocks(fit.covariance), state), folder / RIG)
