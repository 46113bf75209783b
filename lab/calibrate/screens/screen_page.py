"""Report of a screen calibration."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calibration.screens.screens import FittedScreens, camera_sigmas, pointing_sigmas_m, spot_sigmas
from geometry.camera import pinhole_numbers
from lab.files.project.project import Project
from lab.files.rig.rig_file import covariance_blocks
from lab.number_format import format_number
from lab.report.calibration.calibration_charts import correlation_matrix, flatness_map
from lab.report.calibration.calibration_drawings import corners_overlay
from lab.report.calibration.calibration_scene import LAB_VIEWS, Marker, Rectangle, SceneObject, frustum_of, scene_views
from lab.report.page import (
    KeyFigure,
    PageDrawing,
    PageTable,
    Section,
)

_MAX_ROWS = 400  # rows in the table of observations; residuals.csv has all


def page_of(result: FittedScreens, project: Project, remarks: Sequence[str]) -> tuple[list[KeyFigure], list[Section]]:
    """Key figures and sections of the report. remarks: on the scans."""
    sections = [
        _places(result),
        *(_screen(result, project, k) for k in range(len(result.screens))),
        _pixels(result),
        _observations(result),
        Section("The lab", "Cameras, screens and surveyed control points in the world frame.", _scene(result)),
        _correlations(result),
    ]
    return _key_figures(result), [*sections, Section("Scans", remarks)] if remarks else sections


def _key_figures(result: FittedScreens) -> list[KeyFigure]:
    fit = result.fit
    out = []
    for k, name in enumerate(fit.rig.screens):
        sigma = 1e3 * float(np.max(spot_sigmas(result, k)))
        flatness = result.screens[k].flatness
        note = "1 sigma along its normal, maximum"
        if flatness is not None:
            shape = "curved" if flatness.chosen.bent else "flat"
            note += f"; {shape}, residual {format_number(1e3 * flatness.chosen.rms_m, 2)} mm RMS"
        out.append((f"Surface of screen {name}", f"{format_number(sigma, 2)} mm", note))
    for name, sigma_m in pointing_sigmas_m(result).items():
        px = sigma_m * float(pinhole_numbers(fit.rig.cameras[name])[0]) / _distance(result, name)
        note = f"1 sigma at the centre of its screen; {format_number(px, 2)} px"
        out.append((f"Pose of camera {name}", f"{format_number(1e3 * sigma_m, 2)} mm", note))
    used = fit.observation_residuals_px[fit.used]
    if len(used):
        rms = float(np.sqrt(np.mean(used**2)))
        out.append(
            (
                "Control points",
                f"{format_number(rms, 3)} px",
                f"RMS per axis of {len(used)} observations, {len(fit.used) - len(used)} excluded",
            )
        )
    if len(fit.corner_errors_px):
        rms = float(np.sqrt(np.mean(fit.corner_errors_px**2)))
        out.append(("Corners of boards", f"{format_number(rms, 3)} px", f"RMS per axis of {len(fit.corner_errors_px)}"))
    factor = float(np.sqrt(fit.variance_factor))
    note = (
        "the stated sigmas are correct" if factor == 1 else "times the stated sigmas; all sigmas are multiplied by it"
    )
    out.append(("Misfit", format_number(factor, 3), f"{note} ({fit.dof} degrees of freedom)"))
    return out


def _distance(result: FittedScreens, camera: str) -> float:
    """Distance of a camera from the origin of its screen, m."""
    c = result.fit.rig.cameras[camera]
    screen = result.fit.rig.screens[c.screen].world_from_screen
    return float(np.linalg.norm(c.camera_from_world.apply(screen.translation)))


def _places(result: FittedScreens) -> Section:
    fit, network = result.fit, result.network
    sigmas = camera_sigmas(result)
    pointing = pointing_sigmas_m(result)
    rows = []
    for i, (name, c) in enumerate(fit.rig.cameras.items()):
        x, y, z = c.camera_from_world.inverse().translation.tolist()
        mine = network.point_observations.camera_of == i
        boards = 0 if fit.corners is None else len(set(fit.corners.placement[fit.corners.camera == i].tolist()))
        position, attitude = sigmas[name]
        place = [name, c.screen, f"{x:.4f}, {y:.4f}, {z:.4f}", 1e3 * position, float(np.degrees(attitude))]
        rows.append([*place, 1e3 * pointing[name], f"{int(np.sum(fit.used & mine))} of {int(mine.sum())}", boards])
    words = (
        "Errors of a camera's position and attitude are correlated and partly cancel on its screen. The column “on its"
        " screen” is the combined effect, from the joint covariance in screens.yaml."
    )
    heads = [
        "camera", "screen", "position in world (m)", "sigma of position (mm)", "sigma of attitude (°)",
        "on its screen (mm)", "control points used", "boards",
    ]  # fmt: skip
    return Section("Cameras", words, table=PageTable(heads, rows))


def _screen(result: FittedScreens, project: Project, k: int) -> Section:
    name, screen = list(result.fit.rig.screens.items())[k]
    about = result.screens[k]
    normal, origin = screen.world_from_screen.rotation[:, 2], screen.world_from_screen.translation
    x_axis = screen.world_from_screen.rotation[:, 0]
    words = [
        f"Origin at {_vector(origin, 4)} m in the world, normal (z) along {_vector(normal, 5)},"
        f" x along {_vector(x_axis, 5)}. The axes within the plane are a convention"
        + (", defined by the named points." if project.screens[name].frame else ": the centre of its measurements.")
    ]
    drawings = []
    if about.flatness is None:
        words.append("Its pose comes from a fixed board alone: its flatness is not known.")
    else:
        f = about.flatness
        # The points' own sigma, without the scatter of the surface.
        sigma = float(np.median(np.sqrt(np.maximum(f.flat.sigma_m**2 - f.flat.scatter_m**2, 0))))
        on = f.chosen.used
        if not on.all():
            words.append(f"{int(np.sum(~on))} of {len(on)} points are far off it and are not drawn: see the warnings.")
        over = "the control points" if about.control_points else "patches of the scan (medians of their points)"
        words.append(
            f"The best plane has residuals of {format_number(1e3 * f.flat.rms_m, 3)} mm RMS at {over}"
            + (
                "; there are too few of them to test for a curvature."
                if f.bent is None
                else f", the best curved surface {format_number(1e3 * f.bent.rms_m, 3)} mm; the probability of so"
                " large an"
                f" improvement on a flat screen is {f.p_flat:.2g}."
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
                "Height along the normal. A smooth pattern is a bow; a random pattern is roughness or survey noise.",
            )
        )
        if f.chosen.bent:
            drawings.append(
                PageDrawing(
                    flatness_map(about.xyz[on, :2], f.chosen.heights_m[on], f"Screen {name}: residuals after the bow",
                                 size_m=screen.size_m, sigma_m=sigma),
                    "Height above the curved surface: only noise should remain.",
                )
            )  # fmt: skip
    return Section(f"Screen {name}", words, drawings)


def _vector(v: np.ndarray, digits: int) -> str:
    return "(" + ", ".join(f"{round(float(x), digits) + 0.0:.{digits}f}" for x in v) + ")"


def _pixels(result: FittedScreens) -> Section:
    fit, network = result.fit, result.network
    drawings = []
    for i, (name, c) in enumerate(fit.rig.cameras.items()):
        mine = network.point_observations.camera_of == i
        pixels, error = network.point_observations.pixels[mine], fit.observation_residuals_px[mine]
        rejected = ~fit.used[mine]
        if fit.corners is not None:
            its = fit.corners.camera == i
            pixels = np.concatenate([pixels, fit.corners.pixels[its]])
            error = np.concatenate([error, fit.corner_errors_px[its]])
            rejected = np.concatenate([rejected, np.zeros(int(its.sum()), dtype=bool)])
        if len(pixels):
            title = f"Camera {name}: measured − predicted"
            drawings.append(PageDrawing(corners_overlay(c.image_size_px, pixels, error, title, rejected=rejected)))
    words = "Arrows with a common direction in a part of a picture indicate a lens that changed since its calibration."
    return Section("Pixels", words, drawings)


def _observations(result: FittedScreens) -> Section:
    """Section with the table of the observations, the largest residuals first."""
    network, fit = result.network, result.fit
    screens = list(fit.rig.screens)
    s = network.point_observations
    rows: list[list[object]] = []
    for i in range(len(s)):
        d = int(s.point_of[i])
        k = int(network.control_points.screen_of[d])
        names = [list(fit.rig.cameras)[s.camera_of[i]], network.control_points.names[d], screens[k] if k >= 0 else ""]
        pixel, residual = [f"{v:.2f}" for v in s.pixels[i]], [f"{v:+.3f}" for v in fit.observation_residuals_px[i]]
        rows.append([*names, *pixel, *residual, f"{fit.normalised_residuals[i]:.2f}", bool(fit.used[i])])
    rows = [rows[int(i)] for i in np.argsort(-fit.normalised_residuals, kind="stable")]
    heads = [
        "camera", "point", "screen", "u (px)", "v (px)", "residual u (px)", "residual v (px)", "in sigmas", "used",
    ]  # fmt: skip
    words = (
        "Largest residuals first. Sigmas combine the errors of pixel and survey; beyond 5 sigma a pixel is excluded."
    )
    return Section("Observations of control points", words, table=PageTable(heads, rows[:_MAX_ROWS]))


def _scene(result: FittedScreens) -> list[PageDrawing]:
    fit, network = result.fit, result.network
    things: list[SceneObject] = []
    for k, (name, screen) in enumerate(fit.rig.screens.items()):
        size = screen.size_m
        if size is None:
            half = np.abs(result.screens[k].xyz[:, :2]).max(axis=0, initial=0.4) * 1.1
            size = (2 * float(half[0]), 2 * float(half[1]))
        things.append(Rectangle(f"screen {name}", screen.world_from_screen, size))
    things += [frustum_of(c) for c in fit.rig.cameras.values()]
    things += [Marker("", p) for p in network.control_points.xyz[: 5 * _MAX_ROWS]]
    return [PageDrawing(view) for view in scene_views(things, "Cameras, screens and control points", LAB_VIEWS)]


def _correlations(result: FittedScreens) -> Section:
    blocks = covariance_blocks(result.fit.covariance)
    first = next(iter(result.fit.rig.cameras))
    block = blocks[f"cameras.{first}"]
    screen = result.fit.rig.cameras[first].screen
    names = result.fit.covariance.names
    rows = [i for i, n in enumerate(names) if n.startswith((f"cameras.{first}.", f"screens.{screen}."))]
    rows = [i for i in rows if not names[i].endswith(("fx", "fy", "cx", "cy")) and ".k" not in names[i]]
    labels = [names[i].split(".", 1)[1] for i in rows]
    drawing = correlation_matrix(labels, result.fit.covariance.matrix[np.ix_(rows, rows)])
    words = (
        f"Parameters of camera {first} ({len(block.names)}) and its screen. Use the joint covariance in"
        " screens.yaml, which has these correlations for the whole lab."
    )
    return Section("Correlations", words, [PageDrawing(drawing)])
