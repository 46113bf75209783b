"""Findings and report of a screen calibration: the survey, exchanged points, residuals, flatness and sigmas."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from calibration.screens.network import classify_outliers
from calibration.screens.screens import (
    ApproximatePosition,
    FittedScreens,
    camera_covariance,
    camera_sigmas,
    pointing_sigmas_m,
    spot_sigmas,
)
from geometry.arrays import Array
from geometry.camera import pinhole_numbers
from lab.files.project.project import Project
from lab.findings.finding import Finding, Level, finding, level_above, passed
from lab.number_format import format_count, format_number, format_vector
from lab.report.calibration.calibration_drawings import corners_overlay, correlation_matrix, flatness_map
from lab.report.calibration.calibration_scene import LAB_VIEWS, Marker, Rectangle, SceneObject, frustum_of, scene_views
from lab.report.page import KeyFigure, PageDrawing, PageTable, Section


@dataclass(frozen=True, slots=True)
class ScreenLimits:
    """Thresholds of the findings."""

    sigma_spot_warn_m: float = 0.5e-3  # of the surface along its normal, at the spots: the goal for a pose
    sigma_spot_fail_m: float = 3e-3
    scatter_warn_m: float = 0.5e-3  # of the surface about its shape: displaces a spot by about as much at 45 deg
    scatter_fail_m: float = 3e-3
    factor_warn: float = 1.3  # residuals over their sigmas
    factor_fail: float = 4.0
    outliers_fail: float = 0.25  # share of a camera's dots


def network_findings(
    result: FittedScreens, limits: ScreenLimits = ScreenLimits(), *, names_doubted: bool = False
) -> list[Finding]:
    """All findings of the adjustment; of equal level, causes before their effects.

    names_doubted: cameras are far from their approximate positions; the pass finding about dots is then omitted.
    """
    out = [_agreement(result, limits)]
    out += [f for f in _dots(result, limits) if not (names_doubted and f.level == Level.PASS)]
    out += _surfaces(result, limits)
    out += _sigmas(result, limits)
    out += _second_poses(result)
    return out


def _agreement(result: FittedScreens, limits: ScreenLimits) -> Finding:
    fit = result.fit
    factor = float(np.sqrt(fit.variance_factor))
    if fit.dof <= 0:
        return finding("BP-S01", Level.WARN, "no measurement is redundant")
    if factor == 1.0:
        return passed(f"the residuals are consistent with their sigmas (redundancy {fit.dof})")
    what = f"the residuals are {factor:.2g} times larger than their sigmas (redundancy {fit.dof})"
    remedy = f"check the sigmas of survey and pixels and the dots' names{_doubtful_lens(result)}"
    return finding("BP-S02", level_above(factor, limits.factor_warn, limits.factor_fail), what, remedy=remedy)


def _doubtful_lens(result: FittedScreens) -> str:
    """The camera with the largest residuals, whose lens calibration may be another camera's."""
    s, fit = result.network.point_observations, result.fit
    if not len(s):
        return ""
    names = list(result.network.rig.cameras)
    misfit = {
        name: float(np.sqrt(np.mean(fit.normalised_residuals[rows] ** 2)))
        for c, name in enumerate(names)
        for rows in [(s.camera_of == c) & fit.used]
        if rows.any()
    }
    worst = max(misfit, key=lambda n: misfit[n], default="")
    return f"; camera {worst!r} has the largest residuals: its lens may be that of another camera" if worst else ""


def _dots(result: FittedScreens, limits: ScreenLimits) -> list[Finding]:
    network, out = result.network, []
    wrong = classify_outliers(network, result.fit)
    reported: set[tuple[str, str]] = set()
    excluded = Counter(m.dot for m in wrong)
    for m in wrong:
        if (m.camera, m.dot) in reported:
            continue
        reported.add((m.camera, m.dot))
        what = f"camera {m.camera!r}: dot {m.dot!r} is {m.error_px:.1f} px from its predicted position"
        if np.isfinite(m.error_m).all():
            what += f" ({1e3 * m.error_m[0]:+.1f}, {1e3 * m.error_m[1]:+.1f} mm along x, y of its screen)"
        seen = int(np.sum(network.point_observations.point_of == network.control_points.names.index(m.dot)))
        variant = "in one camera"
        if m.swapped:
            reported.add((m.camera, m.at_place_of))
            what = f"camera {m.camera!r}: dots {m.dot!r} and {m.at_place_of!r} are exchanged ({m.error_px:.1f} px)"
            variant = "exchanged"
        elif m.at_place_of:
            what, variant = f"{what}, where dot {m.at_place_of!r} is", "at another dot"
        elif excluded[m.dot] == seen and seen > 1:
            what, variant = f"{what}; the same holds for all {seen} cameras that see it", "in all cameras"
        out.append(finding("BP-S03", Level.WARN, what, variant=variant))
    for c, name in enumerate(network.rig.cameras):
        mine = network.point_observations.camera_of == c
        if mine.any() and np.mean(~result.fit.used[mine]) > limits.outliers_fail:
            n, bad = int(mine.sum()), int(np.sum(~result.fit.used[mine]))
            out.append(finding("BP-S04", Level.FAIL, f"camera {name!r}: {bad} of {n} dots do not fit its pose"))
    count = len(network.point_observations)
    if count and not wrong:
        out.append(passed(f"all {count} pixels of dots are consistent with their names"))
    return out


def _surfaces(result: FittedScreens, limits: ScreenLimits) -> list[Finding]:
    out = []
    for name, screen in zip(result.network.rig.screens, result.screens, strict=True):
        if screen.flatness is None:
            continue
        chosen, flat = screen.flatness.chosen, screen.flatness.flat
        for k in np.flatnonzero(~screen.used) if screen.control_points else ():
            dot = result.network.control_points.names[screen.control_points[k]]
            what = f"screen {name!r}: dot {dot!r} is {1e3 * chosen.heights_m[k]:+.1f} mm off its surface"
            out.append(finding("BP-S05", Level.WARN, what))
        n = int(np.sum(screen.used))
        if screen.control_points and n < 6:
            out.append(finding("BP-S06", Level.WARN, f"screen {name!r}: {n} dots"))
        rms, largest = 1e3 * chosen.rms_m, 1e3 * chosen.largest_m
        if chosen.bent:
            bulge = 1e3 * _bulge(chosen.coefficients[3:], screen.xyz)
            what = (
                f"screen {name!r} is bent by {bulge:.2g} mm over its dots: residuals of the dots"
                f" {1e3 * flat.rms_m:.2g} mm RMS for a plane, {rms:.2g} mm for the bent surface"
            )
            out.append(finding("BP-S07", Level.WARN, what))
        if chosen.scatter_m > limits.scatter_warn_m:
            what = (
                f"screen {name!r}: the surface scatters by {1e3 * chosen.scatter_m:.2g} mm (1 sigma) about its"
                f" {'bent shape' if chosen.bent else 'plane'}, up to {largest:.2g} mm"
            )
            out.append(finding("BP-S08", level_above(chosen.scatter_m, 0, limits.scatter_fail_m), what))
        elif not chosen.bent:
            out.append(passed(f"screen {name!r} is flat to {rms:.2g} mm RMS, {largest:.2g} mm at most ({n} points)"))
    return out


def _bulge(bow: Array, xyz: Array) -> float:
    """Peak-to-valley height, m, of a bent surface over the points (n, 3) of the screen."""
    x, y = xyz[:, 0], xyz[:, 1]
    z = bow[0] * x * x + bow[1] * x * y + bow[2] * y * y
    return float(np.ptp(z))


def _sigmas(result: FittedScreens, limits: ScreenLimits) -> list[Finding]:
    known = {
        f"screen {name!r}: its surface is known to {{}} (1 sigma, worst place)": float(np.max(spot_sigmas(result, k)))
        for k, name in enumerate(result.network.rig.screens)
    }
    known |= {
        f"camera {name!r}: its pose is known to {{}} at the centre of its screen (1 sigma)": sigma
        for name, sigma in pointing_sigmas_m(result).items()
    }
    limits_m = limits.sigma_spot_warn_m, limits.sigma_spot_fail_m
    return [
        finding("BP-S09", level_above(sigma, *limits_m), what.replace("{}", f"{1e3 * sigma:.2g} mm"))
        for what, sigma in known.items()
    ]


def _second_poses(result: FittedScreens) -> list[Finding]:
    names = list(result.network.rig.cameras)
    out = []
    for c, second in result.second_poses.items():
        what = f"camera {names[c]!r}: a second pose fits its dots nearly as well ({second.rms_px:.2g} px RMS)"
        out.append(finding("BP-S10", Level.WARN, what))
    return out


def near_findings(result: FittedScreens, near: Mapping[int, ApproximatePosition]) -> list[Finding]:
    """Whether cameras are at their approximate positions, measured by tape."""
    out = []
    for c, n in near.items():
        name, camera = list(result.fit.rig.cameras.items())[c]
        distance = float(np.linalg.norm(camera.camera_from_world.inverse().translation - n.position_m))
        what = f"camera {name!r} is {distance:.2f} m from its `near_m`, {n.within_m:g} m were allowed"
        out.append(finding("BP-S11", Level.PASS if distance <= n.within_m else Level.FAIL, what))
    return out


def survey_findings(project: Project, result: FittedScreens) -> list[Finding]:
    """Findings on shared lens files, and on control points that are off their screens or cover too little of them."""
    return [*_shared_lenses(project), *_coverage(project, result)]


def _shared_lenses(project: Project) -> list[Finding]:
    """Warnings for two cameras with the same lens calibration: two lenses are never identical."""
    out = []
    for first, second in combinations(project.cameras, 2):
        a, b = project.cameras[first], project.cameras[second]
        # A file may hold several cameras, each with its own numbers.
        if a.lens_path == b.lens_path and np.array_equal(a.lens.camera_matrix, b.lens.camera_matrix):
            what = f"cameras {first!r} and {second!r} share the lens calibration {a.lens_path.name}"
            out.append(finding("BP-S12", Level.WARN, what))
    return out


def _coverage(project: Project, result: FittedScreens) -> list[Finding]:
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
            count = format_count(len(beyond), "point")
            what = f"screen {name!r}: control point {point!r} is outside of size_m ({count} in all)"
            out.append(finding("BP-S13", Level.WARN, what))
        share = np.ptp(screen.xyz[screen.used, :2], axis=0) / np.array(entry.size_m)
        if share.min() < 0.6:
            what = (
                f"screen {name!r}: the control points cover {100 * share[0]:.0f} % of its width and"
                f" {100 * share[1]:.0f} % of its height"
            )
            out.append(finding("BP-S14", Level.WARN, what, variant="" if entry.frame else "without frame"))
    return out


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
    points = f"{len(used)} observations, {len(fit.used) - len(used)} excluded"
    corners = fit.corner_errors_px
    for what, errors, of in (("Control points", used, points), ("Corners of boards", corners, f"{len(corners)}")):
        if len(errors):
            out.append((what, f"{format_number(float(np.sqrt(np.mean(errors**2))))} px", f"RMS per axis of {of}"))
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
    pointing = pointing_sigmas_m(result)
    rows = []
    for i, (name, c) in enumerate(fit.rig.cameras.items()):
        mine = network.point_observations.camera_of == i
        boards = 0 if fit.corners is None else len(set(fit.corners.placement[fit.corners.camera == i].tolist()))
        position, attitude = camera_sigmas(c, camera_covariance(result, name))
        place = format_vector(c.camera_from_world.inverse().translation, 4)
        known = [name, c.screen, place, 1e3 * position, float(np.degrees(attitude))]
        rows.append([*known, 1e3 * pointing[name], f"{int(np.sum(fit.used & mine))} of {int(mine.sum())}", boards])
    words = (
        "Sigmas are RMS per axis. Errors of a camera's position and attitude are correlated and partly cancel on its"
        " screen. The column “on its screen” is the combined effect, from the joint covariance in screens.yaml."
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
        f"Origin at ({format_vector(origin, 4)}) m in the world, normal (z) along ({format_vector(normal, 5)}),"
        f" x along ({format_vector(x_axis, 5)}). The axes within the plane are a convention"
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
        bow, xy, size_m = (screen.bow if f.chosen.bent else None), about.xyz[on, :2], screen.size_m
        title = f"Screen {name}: height over the best plane"
        drawing = flatness_map(xy, f.flat.heights_m[on], title, size_m=size_m, bow=bow, sigma_m=sigma)
        caption = "Height along the normal. A smooth pattern is a bow; a random pattern is roughness or survey noise."
        drawings.append(PageDrawing(drawing, caption))
        if f.chosen.bent:
            title = f"Screen {name}: residuals after the bow"
            drawing = flatness_map(xy, f.chosen.heights_m[on], title, size_m=size_m, sigma_m=sigma)
            drawings.append(PageDrawing(drawing, "Height above the curved surface: only noise should remain."))
    return Section(f"Screen {name}", words, drawings)


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
            drawings.append(corners_overlay(c.image_size_px, pixels, error, title, rejected=rejected))
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


def _scene(result: FittedScreens) -> list[str]:
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
    return scene_views(things, "Cameras, screens and control points", LAB_VIEWS)


def _correlations(result: FittedScreens) -> Section:
    first, camera = next(iter(result.fit.rig.cameras.items()))
    names = result.fit.covariance.names
    of_camera = [n for n in names if n.startswith(f"cameras.{first}.")]
    rows = [i for i, n in enumerate(names) if n.startswith((f"cameras.{first}.", f"screens.{camera.screen}."))]
    rows = [i for i in rows if not names[i].endswith(("fx", "fy", "cx", "cy")) and ".k" not in names[i]]
    labels = [names[i].split(".", 1)[1] for i in rows]
    words = (
        f"Parameters of camera {first} ({len(of_camera)}) and its screen. Use the joint covariance in"
        " screens.yaml, which has these correlations for the whole lab."
    )
    drawing = correlation_matrix(labels, result.fit.covariance.matrix[np.ix_(rows, rows)])
    return Section("Correlations", words, [drawing])
