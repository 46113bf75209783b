"""The report of a calibration of screens."""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from calibration.findings import Finding, verdict
from calibration.screens.network_sigmas import camera_sigmas, pointing_sigmas_m, spot_sigmas
from calibration.screens.screens import ScreensResult
from geometry.camera import pinhole_numbers
from lab.calibrate.screens.screen_inputs import ScreenInputs
from lab.files.project.project_types import Project
from lab.files.rig.rig_covariance import blocks_of
from lab.number_format import short
from lab.report.calibration.calibration_drawings import corners_overlay
from lab.report.calibration.calibration_maps import correlation_matrix, flatness_map
from lab.report.calibration.calibration_page import (
    CalibrationReport,
    PageDrawing,
    PageTable,
    Section,
    provenance,
    write_calibration_report,
)
from lab.report.calibration.calibration_scene import LAB_VIEWS, Dot, Frustum, Rectangle, Thing, frustum_of, scene_views

_MOST_DOTS = 400  # rows of the table of dots; dots.csv has all


def write_page(
    result: ScreensResult,
    findings: Sequence[Finding],
    project: Project,
    inputs: ScreenInputs,
    day: datetime.date,
    folder: Path,
) -> Path:
    """Write report.html."""
    sections = [
        _places(result),
        *(_screen(result, project, k) for k in range(len(result.screens))),
        _pixels(result),
        _dots(result),
        Section("The lab", "Cameras, screens and surveyed dots in the world's frame.", _scene(result)),
        _correlations(result),
    ]
    if inputs.remarks:
        sections.append(Section("Scans", inputs.remarks))
    report = CalibrationReport(
        kind="Screens",
        name=project.name,
        verdict=verdict(findings),
        findings=findings,
        key_figures=_key_figures(result),
        sections=sections,
        made=provenance(project.inputs, day),
    )
    return write_calibration_report(report, folder)


def _key_figures(result: ScreensResult) -> list[tuple[str, str, str]]:
    fit = result.fit
    out = []
    for k, name in enumerate(fit.rig.screens):
        sigma = 1e3 * float(np.max(spot_sigmas(result, k)))
        flatness = result.screens[k].flatness
        note = "1 sigma along its normal, worst place"
        if flatness is not None:
            shape = "bent" if flatness.chosen.bent else "flat"
            note += f"; {shape}, misses {short(1e3 * flatness.chosen.rms_m, 2)} mm RMS"
        out.append((f"Surface of screen {name}", f"{short(sigma, 2)} mm", note))
    for name, sigma_m in pointing_sigmas_m(result).items():
        px = sigma_m * float(pinhole_numbers(fit.rig.cameras[name])[0]) / _distance(result, name)
        note = f"1 sigma at its screen's middle; {short(px, 2)} px"
        out.append((f"Place of camera {name}", f"{short(1e3 * sigma_m, 2)} mm", note))
    used = fit.sighting_errors_px[fit.used]
    if len(used):
        rms = float(np.sqrt(np.mean(used**2)))
        out.append(
            (
                "Dots' pixels",
                f"{short(rms, 3)} px",
                f"RMS per axis of {len(used)}, {len(fit.used) - len(used)} left out",
            )
        )
    if len(fit.corner_errors_px):
        rms = float(np.sqrt(np.mean(fit.corner_errors_px**2)))
        out.append(("Corners of boards", f"{short(rms, 3)} px", f"RMS per axis of {len(fit.corner_errors_px)}"))
    factor = float(np.sqrt(fit.variance_factor))
    note = "times the sigmas that were given; " + ("they hold" if factor == 1 else "all sigmas here are widened by it")
    out.append(("Misfit", short(factor, 3), f"{note} ({fit.dof} redundant numbers)"))
    return out


def _distance(result: ScreensResult, camera: str) -> float:
    c = result.fit.rig.cameras[camera]
    screen = result.fit.rig.screens[c.screen].world_from_screen
    return float(np.linalg.norm(c.camera_from_world.apply(screen.translation)))


def _places(result: ScreensResult) -> Section:
    fit, network = result.fit, result.network
    sigmas = camera_sigmas(result)
    pointing = pointing_sigmas_m(result)
    rows = []
    for i, (name, c) in enumerate(fit.rig.cameras.items()):
        x, y, z = c.camera_from_world.inverse().translation.tolist()
        mine = network.sightings.camera_of == i
        boards = 0 if fit.corners is None else len(set(fit.corners.placement[fit.corners.camera == i].tolist()))
        position, attitude = sigmas[name]
        place = [name, c.screen, f"{x:.4f}, {y:.4f}, {z:.4f}", 1e3 * position, float(np.degrees(attitude))]
        rows.append([*place, 1e3 * pointing[name], f"{int(np.sum(fit.used & mine))} of {int(mine.sum())}", boards])
    words = (
        "A camera's position and attitude err together: what counts is how far both shift what it sees on its screen."
        " The joint covariance in screens.yaml has that; the two sigmas alone would overstate it."
    )
    heads = [
        "camera", "screen", "position in world (m)", "sigma of position (mm)", "sigma of attitude (°)",
        "on its screen (mm)", "dots used", "boards",
    ]  # fmt: skip
    return Section("Cameras", words, table=PageTable(heads, rows))


def _screen(result: ScreensResult, project: Project, k: int) -> Section:
    name, screen = list(result.fit.rig.screens.items())[k]
    about = result.screens[k]
    normal, origin = screen.world_from_screen.rotation[:, 2], screen.world_from_screen.translation
    x_axis = screen.world_from_screen.rotation[:, 0]
    words = [
        f"Origin at {_vector(origin, 4)} m of world, normal (z) along {_vector(normal, 5)},"
        f" x along {_vector(x_axis, 5)}."
        " Within the plane the axes are a choice"
        + (", fixed by the named dots." if project.screens[name].frame else ": the middle of what was measured on it.")
    ]
    drawings = []
    if about.flatness is None:
        words.append("Known from a board fixed to it alone: nothing tells how flat it is.")
    else:
        f = about.flatness
        sigma = float(np.median(np.sqrt(np.maximum(f.flat.sigma_m**2 - f.flat.scatter_m**2, 0))))  # the points' own
        on = f.chosen.used
        if not on.all():
            words.append(f"{int(np.sum(~on))} of {len(on)} points lie far off it and are not drawn: see the warnings.")
        over = "its dots" if about.dots else "patches of the scan (medians of their points)"
        words.append(
            f"As a plane it misses {over} by {short(1e3 * f.flat.rms_m, 3)} mm RMS"
            + (
                "; too few to tell whether it is bent."
                if f.bent is None
                else f", as a bent surface by {short(1e3 * f.bent.rms_m, 3)} mm; were it flat, chance alone would make"
                f" it look so bent with a probability of {f.p_flat:.2g}."
            )
        )
        a, b, c = screen.bow
        drawings.append(
            PageDrawing(
                flatness_map(
                    about.xyz[on, :2],
                    f.flat.heights_m[on],
                    f"Screen {name}: height over the best plane",
                    size_m=screen.size_m,
                    bow=(a, b, c) if f.chosen.bent else None,
                    sigma_m=sigma,
                ),
                "Height along the normal. A smooth pattern is a bow; one without order, a rough screen or survey.",
            )
        )
        if f.chosen.bent:
            drawings.append(
                PageDrawing(
                    flatness_map(about.xyz[on, :2], f.chosen.heights_m[on], f"Screen {name}: what the bow leaves",
                                 size_m=screen.size_m, sigma_m=sigma),
                    "The same after the bow: this should be noise.",
                )
            )  # fmt: skip
    return Section(f"Screen {name}", words, drawings)


def _vector(v: np.ndarray, digits: int) -> str:
    return "(" + ", ".join(f"{round(float(x), digits) + 0.0:.{digits}f}" for x in v) + ")"


def _pixels(result: ScreensResult) -> Section:
    fit, network = result.fit, result.network
    drawings = []
    for i, (name, c) in enumerate(fit.rig.cameras.items()):
        mine = network.sightings.camera_of == i
        found, error = network.sightings.pixels[mine], fit.sighting_errors_px[mine]
        rejected = ~fit.used[mine]
        if fit.corners is not None:
            its = fit.corners.camera == i
            found = np.concatenate([found, fit.corners.pixels[its]])
            error = np.concatenate([error, fit.corner_errors_px[its]])
            rejected = np.concatenate([rejected, np.zeros(int(its.sum()), dtype=bool)])
        if len(found):
            title = f"Camera {name}: measured less predicted"
            drawings.append(PageDrawing(corners_overlay(c.image_size_px, found, error, title, rejected=rejected)))
    words = "Arrows that all point one way in a part of a picture show a lens that changed since its calibration."
    return Section("Pixels", words, drawings)


def _dots(result: ScreensResult) -> Section:
    network, fit = result.network, result.fit
    screens = list(fit.rig.screens)
    s = network.sightings
    rows: list[list[object]] = []
    for i in range(len(s)):
        d = int(s.dot_of[i])
        k = int(network.dots.screen_of[d])
        names = [list(fit.rig.cameras)[s.camera_of[i]], network.dots.names[d], screens[k] if k >= 0 else ""]
        pixel, miss = [f"{v:.2f}" for v in s.pixels[i]], [f"{v:+.3f}" for v in fit.sighting_errors_px[i]]
        rows.append([*names, *pixel, *miss, f"{fit.sighting_sigmas[i]:.2f}", bool(fit.used[i])])
    rows = [rows[int(i)] for i in np.argsort(-fit.sighting_sigmas, kind="stable")]
    heads = ["camera", "dot", "screen", "u (px)", "v (px)", "misses u (px)", "misses v (px)", "in sigmas", "used"]
    words = "The worst first. Sigmas hold the pixel's and the survey's errors together; beyond 5 a pixel is left out."
    return Section("Dots", words, table=PageTable(heads, rows[:_MOST_DOTS]))


def _scene(result: ScreensResult) -> list[PageDrawing]:
    fit, network = result.fit, result.network
    things: list[Thing] = []
    for k, (name, screen) in enumerate(fit.rig.screens.items()):
        size = screen.size_m
        if size is None:
            half = np.abs(result.screens[k].xyz[:, :2]).max(axis=0, initial=0.4) * 1.1
            size = (2 * float(half[0]), 2 * float(half[1]))
        things.append(Rectangle(f"screen {name}", screen.world_from_screen, size))
    for c in fit.rig.cameras.values():
        f: Frustum = frustum_of(c)
        things.append(f)
    things += [Dot("", p) for p in network.dots.xyz[: 5 * _MOST_DOTS]]
    return [PageDrawing(view) for view in scene_views(things, "Cameras, screens and dots", LAB_VIEWS)]


def _correlations(result: ScreensResult) -> Section:
    blocks = blocks_of(result.fit.covariance)
    first = next(iter(result.fit.rig.cameras))
    block = blocks[f"cameras.{first}"]
    screen = result.fit.rig.cameras[first].screen
    names = result.fit.covariance.names
    rows = [i for i, n in enumerate(names) if n.startswith((f"cameras.{first}.", f"screens.{screen}."))]
    rows = [i for i in rows if not names[i].endswith(("fx", "fy", "cx", "cy")) and ".k" not in names[i]]
    labels = [names[i].split(".", 1)[1] for i in rows]
    drawing = correlation_matrix(labels, result.fit.covariance.matrix[np.ix_(rows, rows)])
    words = (
        f"Of camera {first} ({len(block.parameters)} numbers) and its screen. Errors that are so tied must be carried"
        " together; screens.yaml holds the whole matrix."
    )
    return Section("What errs together", words, [PageDrawing(drawing)])
