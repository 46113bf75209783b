"""Findings of a network adjustment: exchanged control points, flatness of the screens, and residuals."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from calibration.findings import Finding, Level
from calibration.screens.network import Network, NetworkFit
from calibration.screens.network_sigmas import pointing_sigmas_m, spot_sigmas
from calibration.screens.screens import ApproximatePosition, ScreensResult
from geometry.arrays import Array
from geometry.camera import Camera
from geometry.planes import intersect_plane
from geometry.rig import Screen

_SAME_POSITION = 0.15  # tolerance of another dot's position, as a share of the distance of neighbouring dots


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


@dataclass(frozen=True, slots=True)
class Outlier:
    """An outlier among the observations, with its probable cause."""

    observation: int
    camera: str
    dot: str
    error_px: float
    error_m: Array  # (2,), on the dot's screen along its x, y; nan if the dot is not on a screen
    at_place_of: str  # the dot at this position; empty: none
    swapped: bool  # whether that dot's pixel is at this dot's position


def classify_outliers(network: Network, fit: NetworkFit) -> tuple[Outlier, ...]:
    """The observations that the adjustment excluded, with their probable cause."""
    s, control_points = network.point_observations, network.control_points
    cameras, screens = list(fit.rig.cameras.values()), list(fit.rig.screens.values())
    out: list[Outlier] = []
    for i in np.flatnonzero(~fit.used):
        camera, dot = cameras[s.camera_of[i]], int(s.point_of[i])
        everywhere = camera.project(control_points.xyz)
        distances = np.linalg.norm(everywhere - s.pixels[i], axis=1)
        distances[~np.isfinite(distances)] = np.inf
        distances[dot] = np.inf
        nearest = int(np.argmin(distances))
        spacing = np.linalg.norm(everywhere - everywhere[nearest], axis=1)
        spacing[nearest] = np.inf
        limit = max(_SAME_POSITION * float(np.nanmin(spacing)), 5 * float(s.sigma_px[i]))
        at_place_of = control_points.names[nearest] if distances[nearest] < limit else ""
        back = np.flatnonzero((s.camera_of == s.camera_of[i]) & (s.point_of == nearest) & ~fit.used)
        swapped = bool(at_place_of) and any(
            np.linalg.norm(everywhere[dot] - s.pixels[b]) < limit for b in back.tolist()
        )
        error_m = np.full(2, np.nan)
        if control_points.screen_of[dot] >= 0:
            error_m = _on_screen(camera, screens[control_points.screen_of[dot]], s.pixels[i], control_points.xyz[dot])
        error_px = float(np.linalg.norm(fit.observation_residuals_px[i]))
        out.append(Outlier(int(i), camera.name, control_points.names[dot], error_px, error_m, at_place_of, swapped))
    return tuple(out)


def _on_screen(camera: Camera, screen: Screen, pixel: Array, dot: Array) -> Array:
    origin, ray = camera.rays(pixel)
    return intersect_plane(origin, ray, screen.world_from_screen) - screen.world_from_screen.inverse().apply(dot)[:2]


def findings(
    result: ScreensResult, limits: ScreenLimits = ScreenLimits(), *, names_doubted: bool = False
) -> list[Finding]:
    """All findings; of equal level, causes before their effects.

    names_doubted: cameras are far from their approximate positions; the pass finding about dots is then omitted.
    """
    out = [_agreement(result, limits)]
    out += [f for f in _dots(result, limits) if not (names_doubted and f.level == Level.PASS)]
    out += _surfaces(result, limits)
    out += _sigmas(result, limits)
    out += _second_poses(result)
    return out


def _agreement(result: ScreensResult, limits: ScreenLimits) -> Finding:
    fit = result.fit
    factor = float(np.sqrt(fit.variance_factor))
    if fit.dof <= 0:
        return Finding(
            Level.WARN,
            "no measurement is redundant",
            "a wrong dot or a wrong coordinate cannot be detected",
            "survey more dots: eight or more per screen, all of them seen by its camera",
            code="BP-S01",
        )
    if factor == 1.0:
        return Finding(Level.PASS, f"the residuals are consistent with their sigmas (redundancy {fit.dof})")
    level = Level.FAIL if factor > limits.factor_fail else Level.WARN if factor > limits.factor_warn else Level.PASS
    return Finding(
        level,
        f"the residuals are {factor:.2g} times larger than their sigmas (redundancy {fit.dof})",
        "all sigmas of the result were multiplied by this factor; the cause may also bias the result",
        ""
        if level is Level.PASS
        else f"check the sigmas of survey and pixels and the dots' names{_doubtful_lens(result)}",
        code="BP-S02",
    )


def _doubtful_lens(result: ScreensResult) -> str:
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


def _dots(result: ScreensResult, limits: ScreenLimits) -> list[Finding]:
    network, out = result.network, []
    wrong = classify_outliers(network, result.fit)
    reported: set[tuple[str, str]] = set()
    by_dot = {m.dot: [n for n in wrong if n.dot == m.dot] for m in wrong}
    for m in wrong:
        if (m.camera, m.dot) in reported:
            continue
        reported.add((m.camera, m.dot))
        where = f"camera {m.camera!r}: dot {m.dot!r} is {m.error_px:.1f} px from its predicted position"
        if np.isfinite(m.error_m).all():
            where += f" ({1e3 * m.error_m[0]:+.1f}, {1e3 * m.error_m[1]:+.1f} mm along x, y of its screen)"
        seen = int(np.sum(network.point_observations.point_of == network.control_points.names.index(m.dot)))
        if m.swapped:
            reported.add((m.camera, m.at_place_of))
            what = f"camera {m.camera!r}: dots {m.dot!r} and {m.at_place_of!r} are exchanged ({m.error_px:.1f} px)"
            remedy = "exchange the two names in the table of points, or in the survey"
        elif m.at_place_of:
            what, remedy = f"{where}, where dot {m.at_place_of!r} is", "correct the name in the table of points"
        elif len(by_dot[m.dot]) == seen and seen > 1:
            what = f"{where}; the same holds for all {seen} cameras that see it"
            remedy = "survey it again: its coordinates are wrong, or it has moved"
        else:
            what, remedy = (
                where,
                "inspect the picture: another point of light was measured, or the survey of the dot is wrong",
            )
        out.append(Finding(Level.WARN, what, "it was excluded", remedy, code="BP-S03"))
    for c, name in enumerate(network.rig.cameras):
        mine = network.point_observations.camera_of == c
        if mine.any() and np.mean(~result.fit.used[mine]) > limits.outliers_fail:
            n, bad = int(mine.sum()), int(np.sum(~result.fit.used[mine]))
            out.append(
                Finding(
                    Level.FAIL,
                    f"camera {name!r}: {bad} of {n} dots do not fit its pose",
                    "with so many outliers the others may fit by chance",
                    "check names and coordinates, and that the lens belongs to this camera at this focus",
                    code="BP-S04",
                )
            )
    count = len(network.point_observations)
    if count and not wrong:
        out.append(Finding(Level.PASS, f"all {count} pixels of dots are consistent with their names"))
    return out


def _surfaces(result: ScreensResult, limits: ScreenLimits) -> list[Finding]:
    out = []
    for name, screen in zip(result.network.rig.screens, result.screens, strict=True):
        if screen.flatness is None:
            continue
        chosen, flat = screen.flatness.chosen, screen.flatness.flat
        for k in np.flatnonzero(~screen.used):
            if screen.control_points:
                dot = result.network.control_points.names[screen.control_points[k]]
                out.append(
                    Finding(
                        Level.WARN,
                        f"screen {name!r}: dot {dot!r} is {1e3 * chosen.heights_m[k]:+.1f} mm off its surface",
                        "it was excluded from the surface",
                        "survey it again, or correct the column `screen`",
                        code="BP-S05",
                    )
                )
        n = int(np.sum(screen.used))
        if screen.control_points and n < 6:
            out.append(
                Finding(
                    Level.WARN,
                    f"screen {name!r}: {n} dots",
                    "too few to distinguish a bent screen from a wrong dot",
                    "survey eight or more, spread to the screen's edges",
                    code="BP-S06",
                )
            )
        rms, largest = 1e3 * chosen.rms_m, 1e3 * chosen.largest_m
        if chosen.bent:
            bulge = 1e3 * _bulge(chosen.coefficients[3:], screen.xyz)
            out.append(
                Finding(
                    Level.WARN,
                    f"screen {name!r} is bent by {bulge:.2g} mm over its dots: residuals of the dots"
                    f" {1e3 * flat.rms_m:.2g} mm RMS for a plane, {rms:.2g} mm for the bent surface",
                    "spots are computed on the bent surface, which is extrapolated beyond the dots",
                    "flatten the screen, or survey dots to its edges",
                    code="BP-S07",
                )
            )
        if chosen.scatter_m > limits.scatter_warn_m:
            level = Level.FAIL if chosen.scatter_m > limits.scatter_fail_m else Level.WARN
            out.append(
                Finding(
                    level,
                    f"screen {name!r}: the surface scatters by {1e3 * chosen.scatter_m:.2g} mm (1 sigma) about its"
                    f" {'bent shape' if chosen.bent else 'plane'}, up to {largest:.2g} mm",
                    "spots at oblique incidence are displaced by about as much; no smooth shape describes it",
                    "flatten the screen, or survey more dots so that a bow can be fitted",
                    code="BP-S08",
                )
            )
        elif not chosen.bent:
            out.append(
                Finding(
                    Level.PASS, f"screen {name!r} is flat to {rms:.2g} mm RMS, {largest:.2g} mm at most ({n} points)"
                )
            )
    return out


def _bulge(bow: Array, xyz: Array) -> float:
    """Peak-to-valley height, m, of a bent surface over the points (n, 3) of the screen."""
    x, y = xyz[:, 0], xyz[:, 1]
    z = bow[0] * x * x + bow[1] * x * y + bow[2] * y * y
    return float(np.ptp(z))


def _sigmas(result: ScreensResult, limits: ScreenLimits) -> list[Finding]:
    out = []
    for k, name in enumerate(result.network.rig.screens):
        known = f"screen {name!r}: its surface is known to {{}} (1 sigma, worst place)"
        out.append(_sigma_finding(known, float(np.max(spot_sigmas(result, k))), limits))
    for name, sigma in pointing_sigmas_m(result).items():
        good = f"camera {name!r}: its pose is known to {{}} at the centre of its screen (1 sigma)"
        out.append(_sigma_finding(good, sigma, limits))
    return out


def _sigma_finding(words: str, sigma_m: float, limits: ScreenLimits) -> Finding:
    what = words.format(f"{1e3 * sigma_m:.2g} mm")
    if sigma_m <= limits.sigma_spot_warn_m:
        return Finding(Level.PASS, what)
    return Finding(
        Level.FAIL if sigma_m > limits.sigma_spot_fail_m else Level.WARN,
        what,
        "every pose measured with it has this error",
        "survey more dots, farther apart, with smaller sigmas; let the camera see all of them",
        code="BP-S09",
    )


def _second_poses(result: ScreensResult) -> list[Finding]:
    names = list(result.network.rig.cameras)
    return [
        Finding(
            Level.WARN,
            f"camera {names[c]!r}: a second pose fits its dots nearly as well ({second.rms_px:.2g} px RMS)",
            "coplanar dots that appear small in the picture allow two poses; the better one was used",
            "add `near_m` (its position by tape measure) to this camera, or dots off the screen's plane",
            code="BP-S10",
        )
        for c, second in result.second_poses.items()
    ]


def near_findings(result: ScreensResult, near: Mapping[int, ApproximatePosition]) -> list[Finding]:
    """Whether cameras are at their approximate positions, measured by tape."""
    out = []
    for c, n in near.items():
        name, camera = list(result.fit.rig.cameras.items())[c]
        distance = float(np.linalg.norm(camera.camera_from_world.inverse().translation - n.position_m))
        what = f"camera {name!r} is {distance:.2f} m from its `near_m`, {n.within_m:g} m were allowed"
        if distance <= n.within_m:
            out.append(Finding(Level.PASS, what))
        else:
            remedy = "check near_m, the survey's columns, the pixels' u and v, and the cameras' names"
            why = "the survey may have exchanged axes or another unit, pixels may be mirrored, or cameras exchanged"
            out.append(Finding(Level.FAIL, what, why, remedy, code="BP-S11"))
    return out
