"""What a network says of itself: dots that were mixed up, how flat its screens are, how well it fits."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from calibration.findings import Finding, Level
from calibration.screens.network import Network, NetworkFit
from calibration.screens.network_sigmas import pointing_sigmas_m, spot_sigmas
from calibration.screens.screens import Near, ScreensResult
from geometry.arrays import Array
from geometry.camera import Camera
from geometry.planes import meet_plane
from geometry.rig import Screen

_LIKE_ANOTHER_DOT = 0.15  # of the distance of neighbouring dots: nearer than this a pixel is taken for another dot's


@dataclass(frozen=True, slots=True)
class ScreenLimits:
    """When a network is called poor."""

    sigma_spot_warn_m: float = 0.5e-3  # of the surface along its normal, where a spot lands: the goal for a pose
    sigma_spot_fail_m: float = 3e-3
    scatter_warn_m: float = 0.5e-3  # of the surface about its shape: a spot is displaced by about as much at 45 deg
    scatter_fail_m: float = 3e-3
    factor_warn: float = 1.3  # times that measurements miss by more than their sigmas
    factor_fail: float = 4.0
    outliers_fail: float = 0.25  # share of a camera's dots


@dataclass(frozen=True, slots=True)
class Misplaced:
    """One sighting that lies far off what the others say."""

    sighting: int
    camera: str
    dot: str
    away_px: float
    away_m: Array  # (2,), on the dot's screen along its x, y; nan where the dot is on none
    instead: str  # the dot whose place it is at; empty: none's
    swapped: bool  # and that dot's pixel is at this one's place


def misplaced(network: Network, fit: NetworkFit) -> tuple[Misplaced, ...]:
    """The sightings that the adjustment left out, and what they may be."""
    s, dots = network.sightings, network.dots
    cameras, screens = list(fit.rig.cameras.values()), list(fit.rig.screens.values())
    out: list[Misplaced] = []
    for i in np.flatnonzero(~fit.used):
        camera, dot = cameras[s.camera_of[i]], int(s.dot_of[i])
        everywhere = camera.project(dots.xyz)
        apart = np.linalg.norm(everywhere - s.pixels[i], axis=1)
        apart[~np.isfinite(apart)] = np.inf
        apart[dot] = np.inf
        nearest = int(np.argmin(apart))
        spacing = np.linalg.norm(everywhere - everywhere[nearest], axis=1)
        spacing[nearest] = np.inf
        limit = max(_LIKE_ANOTHER_DOT * float(np.nanmin(spacing)), 5 * float(s.sigma_px[i]))
        instead = dots.names[nearest] if apart[nearest] < limit else ""
        back = np.flatnonzero((s.camera_of == s.camera_of[i]) & (s.dot_of == nearest) & ~fit.used)
        swapped = bool(instead) and any(np.linalg.norm(everywhere[dot] - s.pixels[b]) < limit for b in back.tolist())
        away_m = np.full(2, np.nan)
        if dots.screen_of[dot] >= 0:
            away_m = _on_screen(camera, screens[dots.screen_of[dot]], s.pixels[i], dots.xyz[dot])
        away_px = float(np.linalg.norm(fit.sighting_errors_px[i]))
        out.append(Misplaced(int(i), camera.name, dots.names[dot], away_px, away_m, instead, swapped))
    return tuple(out)


def _on_screen(camera: Camera, screen: Screen, pixel: Array, dot: Array) -> Array:
    origin, ray = camera.rays(pixel)
    return meet_plane(origin, ray, screen.world_from_screen) - screen.world_from_screen.inverse().apply(dot)[:2]


def findings(
    result: ScreensResult, limits: ScreenLimits = ScreenLimits(), *, names_doubted: bool = False
) -> list[Finding]:
    """Everything that was tested; of equal level, causes before what they cause.

    names_doubted: cameras stand far from where they should; that pixels fit their names is then not claimed.
    """
    out = [_agreement(result, limits)]
    out += [f for f in _dots(result, limits) if not (names_doubted and f.level == Level.PASS)]
    out += _surfaces(result, limits)
    out += _sigmas(result, limits)
    out += _rivals(result)
    return out


def _agreement(result: ScreensResult, limits: ScreenLimits) -> Finding:
    fit = result.fit
    factor = float(np.sqrt(fit.variance_factor))
    if fit.dof <= 0:
        return Finding(
            Level.WARN,
            "no measurement is redundant",
            "a wrong dot or a wrong coordinate cannot be noticed",
            "survey more dots: eight or more per screen, all of them seen by its camera",
        )
    if factor == 1.0:
        return Finding(Level.PASS, f"the measurements agree within their sigmas ({fit.dof} redundant numbers)")
    level = Level.FAIL if factor > limits.factor_fail else Level.WARN if factor > limits.factor_warn else Level.PASS
    return Finding(
        level,
        f"the measurements agree {factor:.2g} times worse than their sigmas say ({fit.dof} redundant numbers)",
        "all sigmas of the result were widened by that; what causes it may also shift the result",
        ""
        if level is Level.PASS
        else f"check the sigmas of survey and pixels and the dots' names{_lens_to_doubt(result)}",
    )


def _lens_to_doubt(result: ScreensResult) -> str:
    """Of which camera the lens calibration may be another's: the one whose dots misfit most."""
    s, fit = result.network.sightings, result.fit
    if not len(s):
        return ""
    names = list(result.network.rig.cameras)
    misfit = {
        name: float(np.sqrt(np.mean(fit.sighting_sigmas[rows] ** 2)))
        for c, name in enumerate(names)
        for rows in [(s.camera_of == c) & fit.used]
        if rows.any()
    }
    worst = max(misfit, key=lambda n: misfit[n], default="")
    return f"; the dots of camera {worst!r} misfit most: its lens calibration may be another camera's" if worst else ""


def _dots(result: ScreensResult, limits: ScreenLimits) -> list[Finding]:
    network, out = result.network, []
    wrong = misplaced(network, result.fit)
    told: set[tuple[str, str]] = set()
    by_dot = {m.dot: [n for n in wrong if n.dot == m.dot] for m in wrong}
    for m in wrong:
        if (m.camera, m.dot) in told:
            continue
        told.add((m.camera, m.dot))
        where = f"camera {m.camera!r}: dot {m.dot!r} is {m.away_px:.1f} px from where the others put it"
        if np.isfinite(m.away_m).all():
            where += f" ({1e3 * m.away_m[0]:+.1f}, {1e3 * m.away_m[1]:+.1f} mm along x, y of its screen)"
        seen = int(np.sum(network.sightings.dot_of == network.dots.names.index(m.dot)))
        if m.swapped:
            told.add((m.camera, m.instead))
            what = f"camera {m.camera!r}: dots {m.dot!r} and {m.instead!r} are swapped ({m.away_px:.1f} px)"
            remedy = "swap the two names in the table of points, or in the survey"
        elif m.instead:
            what, remedy = f"{where}, where dot {m.instead!r} is", "mend the name in the table of points"
        elif len(by_dot[m.dot]) == seen and seen > 1:
            what = f"{where}; all {seen} cameras that see it say so"
            remedy = "survey it again: its coordinates are wrong, or it has moved"
        else:
            what, remedy = (
                where,
                "look at the picture: another point of light was taken for it, or it was surveyed wrongly",
            )
        out.append(Finding(Level.WARN, what, "it was left out", remedy))
    for c, name in enumerate(network.rig.cameras):
        mine = network.sightings.camera_of == c
        if mine.any() and np.mean(~result.fit.used[mine]) > limits.outliers_fail:
            n, bad = int(mine.sum()), int(np.sum(~result.fit.used[mine]))
            out.append(
                Finding(
                    Level.FAIL,
                    f"camera {name!r}: {bad} of {n} dots do not fit its place",
                    "with so many wrong the others may be right by chance",
                    "check names and coordinates, and that the lens belongs to this camera at this focus",
                )
            )
    if len(network.sightings) and not wrong:
        out.append(Finding(Level.PASS, f"all {len(network.sightings)} pixels of dots fit their names"))
    return out


def _surfaces(result: ScreensResult, limits: ScreenLimits) -> list[Finding]:
    out = []
    for name, screen in zip(result.network.rig.screens, result.screens, strict=True):
        if screen.flatness is None:
            continue
        chosen, flat = screen.flatness.chosen, screen.flatness.flat
        for k in np.flatnonzero(~screen.used):
            whose = f"dot {result.network.dots.names[screen.dots[k]]!r}" if screen.dots else "a scanned patch"
            if screen.dots:
                out.append(
                    Finding(
                        Level.WARN,
                        f"screen {name!r}: {whose} lies {1e3 * chosen.heights_m[k]:+.1f} mm off its surface",
                        "it was not used for the surface",
                        "survey it again, or correct the column `screen`",
                    )
                )
        n = int(np.sum(screen.used))
        if screen.dots and n < 6:
            out.append(
                Finding(
                    Level.WARN,
                    f"screen {name!r}: {n} dots",
                    "too few to tell a bent screen from a wrong dot",
                    "survey eight or more, spread to the screen's edges",
                )
            )
        rms, largest = 1e3 * chosen.rms_m, 1e3 * chosen.largest_m
        if chosen.bent:
            bulge = 1e3 * _bulge(chosen.coefficients[3:], screen.xyz)
            out.append(
                Finding(
                    Level.WARN,
                    f"screen {name!r} is bent by {bulge:.2g} mm over its dots: as a plane it misses them by"
                    f" {1e3 * flat.rms_m:.2g} mm RMS, bent by {rms:.2g} mm",
                    "spots are computed on the bent surface; outside of the dots it is a guess",
                    "flatten the screen, or survey dots to its edges",
                )
            )
        if chosen.scatter_m > limits.scatter_warn_m:
            level = Level.FAIL if chosen.scatter_m > limits.scatter_fail_m else Level.WARN
            out.append(
                Finding(
                    level,
                    f"screen {name!r}: the surface scatters by {1e3 * chosen.scatter_m:.2g} mm (1 sigma) about its"
                    f" {'bent shape' if chosen.bent else 'plane'}, up to {largest:.2g} mm",
                    "a spot that falls obliquely is displaced by about as much; no shape describes it",
                    "flatten the screen, or survey more dots so that a bow can be fitted",
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
    """Largest less least height, m, of a bent surface over the points (n, 3) of the screen."""
    x, y = xyz[:, 0], xyz[:, 1]
    z = bow[0] * x * x + bow[1] * x * y + bow[2] * y * y
    return float(np.ptp(z))


def _sigmas(result: ScreensResult, limits: ScreenLimits) -> list[Finding]:
    out = []
    for k, name in enumerate(result.network.rig.screens):
        known = f"screen {name!r}: its surface is known to {{}} (1 sigma, worst place)"
        out.append(_sigma_finding(known, float(np.max(spot_sigmas(result, k))), limits))
    for name, sigma in pointing_sigmas_m(result).items():
        good = f"camera {name!r}: its place is good for {{}} at its screen's middle (1 sigma)"
        out.append(_sigma_finding(good, sigma, limits))
    return out


def _sigma_finding(words: str, sigma_m: float, limits: ScreenLimits) -> Finding:
    what = words.format(f"{1e3 * sigma_m:.2g} mm")
    if sigma_m <= limits.sigma_spot_warn_m:
        return Finding(Level.PASS, what)
    return Finding(
        Level.FAIL if sigma_m > limits.sigma_spot_fail_m else Level.WARN,
        what,
        "every pose that is measured with it carries this error",
        "survey more dots, farther apart, with smaller sigmas; let the camera see all of them",
    )


def _rivals(result: ScreensResult) -> list[Finding]:
    names = list(result.network.rig.cameras)
    return [
        Finding(
            Level.WARN,
            f"camera {names[c]!r}: a second place fits its dots nearly as well ({rival.rms_px:.2g} px RMS)",
            "dots of one plane, seen small, leave two places; the better one was taken",
            "add `near_m` (its place by tape measure) to this camera, or dots off the screen's plane",
        )
        for c, rival in result.rivals.items()
    ]


def near_findings(result: ScreensResult, near: Mapping[int, Near]) -> list[Finding]:
    """Whether cameras stand where a tape measure says."""
    out = []
    for c, n in near.items():
        name, camera = list(result.fit.rig.cameras.items())[c]
        away = float(np.linalg.norm(camera.camera_from_world.inverse().translation - n.position_m))
        what = f"camera {name!r} stands {away:.2f} m from its `near_m`, {n.within_m:g} m were allowed"
        if away <= n.within_m:
            out.append(Finding(Level.PASS, what))
        else:
            remedy = "check near_m, the survey's columns, the pixels' u and v, and the cameras' names"
            why = "the survey may have swapped axes or another unit, pixels may be mirrored, or cameras exchanged"
            out.append(
                Finding(
                    Level.FAIL,
                    what,
                    why,
                    remedy,
                )
            )
    return out
