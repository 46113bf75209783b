"""`beampose calibrate screen`: poses of screens and cameras and flatness of the screens, with their covariance.

Tables of `calibrate screen`: residuals of pixels and control points.
"""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from calibration.screens.screens import FittedScreens, pointing_sigmas_m, spot_sigmas
from geometry.rig import Rig
from lab.calibrate.screens.screen_inputs import adjusted_screens, screen_inputs
from lab.calibrate.screens.screen_page import near_findings, network_findings, page_of, survey_findings
from lab.calibrate.step import Solved, Step, calibration_date, expiry_date, expiry_findings, run_step, state_of
from lab.files.project.project import Project, load_project
from lab.files.rig.rig_file import TARGET, RigFile, covariance_blocks, save_rig, save_screens
from lab.files.text.csv_text import write_table
from lab.findings.finding import Finding, Level, Outcome, finding, verdict
from lab.number_format import format_count
from lab.progress import Progress

RESIDUALS, DOTS = "residuals.csv", "dots.csv"
RESIDUAL_COLUMNS = ("camera", "point", "u_px", "v_px", "residual_u_px", "residual_v_px", "sigmas", "used")
DOT_COLUMNS = ("point", "screen", "x_m", "y_m", "z_m", "shift_x_m", "shift_y_m", "shift_z_m", "height_m", "used")


def write_tables(result: FittedScreens, folder: Path) -> None:
    """Write residuals.csv (a row per observation and per board corner) and dots.csv (a row per control point).

    Residuals are measured minus predicted; the `point` of a corner is the name of its board placement. Shifts are
    adjusted minus surveyed; height_m is the height above the screen's surface, `used` whether the row was used.
    """
    network, fit = result.network, result.fit
    cameras, screens = list(fit.rig.cameras), list(fit.rig.screens)
    s = network.point_observations
    rows: list[list[object]] = []
    for i in range(len(s)):
        names = [cameras[s.camera_of[i]], network.control_points.names[s.point_of[i]]]
        sigmas = round(float(fit.normalised_residuals[i]), 3)
        rows.append(
            [*names, *s.pixels[i].round(4), *fit.observation_residuals_px[i].round(4), sigmas, int(fit.used[i])]
        )
    if fit.corners is not None:
        c = fit.corners
        in_sigmas = np.linalg.norm(fit.corner_errors_px, axis=1) / c.sigma_px
        for i in range(len(c)):
            names = [cameras[c.camera[i]], network.placements[c.placement[i]]]
            rows.append(
                [*names, *c.pixels[i].round(4), *fit.corner_errors_px[i].round(4), round(float(in_sigmas[i]), 3), 1]
            )
    write_table(folder / RESIDUALS, RESIDUAL_COLUMNS, rows)
    height = np.full(len(network.control_points), np.nan)
    used = np.ones(len(network.control_points), dtype=bool)
    for screen in result.screens:
        if screen.control_points and screen.flatness is not None:
            height[list(screen.control_points)] = screen.flatness.chosen.heights_m
            used[list(screen.control_points)] = screen.used
    xyz = network.control_points.xyz + fit.control_point_shifts_m
    points: list[list[object]] = []
    for i, (name, k) in enumerate(zip(network.control_points.names, network.control_points.screen_of, strict=True)):
        height_m = "" if np.isnan(height[i]) else round(float(height[i]), 7)
        screen_name = "" if k < 0 else screens[k]
        points.append(
            [name, screen_name, *xyz[i].round(7), *fit.control_point_shifts_m[i].round(7), height_m, int(used[i])]
        )
    write_table(folder / DOTS, DOT_COLUMNS, points)


SCREENS, RIG = "screens.yaml", "rig.yaml"


_STEP = Step("screens", (DOTS, RESIDUALS), SCREENS)


def calibrate_screen(
    project_path: Path, out: Path, today: datetime.date | None = None, *, progress: Progress | None = None
) -> Outcome[FittedScreens]:
    """Calibrate the screens and the poses of the cameras of a project.

    Writes into `out`: screens.yaml; rig.yaml with the nominal beams, if the project has a target; residuals.csv,
    dots.csv and report.html. If the verdict is FAIL, no YAML file is written. progress: of the search for a mistake in
    a survey that does not fit. Raises InputError: for errors in the files; CalibrationError: if the measurements do not
    determine a calibration.
    """
    return run_step(_STEP, out, lambda: _solve(Path(project_path), today, progress))


def _solve(project_path: Path, today: datetime.date | None, progress: Progress | None) -> Solved[FittedScreens]:
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


def _figures(result: FittedScreens) -> str:
    rig = result.fit.rig
    surface = 1e3 * max(float(np.max(spot_sigmas(result, k))) for k in range(len(rig.screens)))
    place = 1e3 * max(pointing_sigmas_m(result).values())
    counted = ", ".join(
        format_count(n, what) for n, what in ((len(rig.cameras), "camera"), (len(rig.screens), "screen"))
    )
    return f"{counted}, surfaces to {surface:.2g} mm, cameras to {place:.2g} mm on them"


def _save(
    project: Project, result: FittedScreens, findings: Sequence[Finding], day: datetime.date, folder: Path
) -> None:
    fit = result.fit
    state = state_of(findings, day, expiry_date(project, day), project.notes)
    rig = fit.rig
    for k, (name, screen) in enumerate(rig.screens.items()):
        scan = None if project.screens[name].cloud is None else result.screens[k]
        if screen.size_m is None and scan is not None:
            width, height = (2 * np.abs(scan.xyz[:, :2]).max(axis=0)).tolist()
            rig = replace(rig, screens={**rig.screens, name: replace(screen, size_m=(width, height))})
    save_screens(project.name, RigFile(rig, {TARGET: fit.covariance}, state), folder / SCREENS)
    if project.beams:
        note = "the beams are nominal, not calibrated: run `beampose calibrate beams`"
        level = max(verdict(findings), Level.WARN)
        state = state.model_copy(update={"verdict": level.name, "reasons": (note, *state.reasons)})
        whole = Rig(rig.screens, rig.cameras, project.beams, project.spots)
        save_rig(RigFile(whole, covariance_blocks(fit.covariance), state), folder / RIG)
