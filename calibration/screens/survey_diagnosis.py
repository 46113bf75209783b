"""Diagnosis of surveys with exchanged axes or a wrong unit, by trying changes to the survey.

Pixels alone do not determine everything. Coplanar dots look like their mirror image from the other side; the scale of a
survey is determined only by boards, a screen's size or a camera's approximate position. All mirrored surveys differ by
a rotation only: which axes were exchanged is determined only if the world is known otherwise.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibration.least_squares.adjustment import AdjustmentError
from calibration.screens.network import Network
from calibration.screens.network_start import NotConnectedError
from calibration.screens.screens import ApproximatePosition, ScreenSetup, ScreensResult, calibrate
from geometry.arrays import Array, Bools

UNITS: Mapping[float, str] = {
    1e-3: "metres were expected and millimetres written",
    1e-2: "metres were expected and centimetres written",
    0.0254: "metres were expected and inches written",
    0.3048: "metres were expected and feet written",
    1e3: "the numbers were divided by 1000 too often (kilometres, or metres taken for millimetres)",
}
_UNIT_MATCH = 0.2  # tolerance of the logarithm of a ratio of sizes


def wrong_unit(extent_m: float, expected_m: float) -> str:
    """The wrong unit that explains an extent other than the expected one; empty if there is none."""
    ratio = expected_m / extent_m
    for factor, words in UNITS.items():
        if abs(np.log(ratio / factor)) < _UNIT_MATCH:
            return words
    return ""


@dataclass(frozen=True, slots=True)
class SurveyError:
    """A change to the survey that makes the measurements consistent."""

    words: str  # the correction of the survey
    factor: float  # residuals over their sigmas after the correction


def diagnose_survey(
    network: Network,
    setups: Sequence[ScreenSetup],
    near: Mapping[int, ApproximatePosition],
    held_screen: int | None,
    current: float,
    progress: Callable[[int, int], None] | None = None,
) -> list[SurveyError]:
    """Changes with which the measurements fit much better than with the survey as it is, the best first.

    current: present misfit (inf if there is no solution). progress: called with the changes tried and their number.
    """
    out = []
    changes = _changes(network)
    for done, (words, change) in enumerate(changes):
        if progress is not None:
            progress(done, len(changes))
        trial = replace(network, control_points=replace(network.control_points, xyz=change(network.control_points.xyz)))
        misfit_now = misfit(trial, setups, near, held_screen)
        if misfit_now < 0.3 * current:
            out.append(SurveyError(words, misfit_now))
    return sorted(out, key=lambda s: s.factor)


def misfit(
    network: Network, setups: Sequence[ScreenSetup], near: Mapping[int, ApproximatePosition], held_screen: int | None
) -> float:
    """Misfit of a network: residuals over sigmas, outliers and distances from approximate positions; inf on failure."""
    try:
        result = calibrate(network, setups, near, held_screen)
    except (AdjustmentError, NotConnectedError, ValueError):
        return float("inf")
    return misfit_of(result, near)


def misfit_of(result: ScreensResult, near: Mapping[int, ApproximatePosition]) -> float:
    """Misfit of a result, as in `misfit`."""
    out = float(np.sqrt(result.fit.variance_factor))
    if len(result.fit.used):
        out += 20.0 * float(np.mean(~result.fit.used))
    for c, n in near.items():
        centre = list(result.fit.rig.cameras.values())[c].camera_from_world.inverse().translation
        out += 10.0 * max(float(np.linalg.norm(centre - n.position_m)) / n.within_m - 1.0, 0.0)
    return out


def _changes(network: Network) -> list[tuple[str, Callable[[Array], Array]]]:
    """Common mistakes in a survey's columns, for the whole survey and for the dots of one screen."""
    axes = "xyz"
    out: list[tuple[str, Callable[[Array], Array]]] = []
    screens = list(network.rig.screens)
    wholes: list[tuple[str, Bools]] = [("the survey", np.ones(len(network.control_points), dtype=bool))]
    if len(screens) > 1:
        wholes += [(f"the dots of screen {n!r}", network.control_points.screen_of == k) for k, n in enumerate(screens)]
    for whose, some in wholes:
        if not some.any():
            continue
        for order in itertools.permutations(range(3)):
            if order == (0, 1, 2):
                continue
            words = f"{whose} with its columns in the order {', '.join(axes[o] for o in order)}"
            if sum(a == b for a, b in enumerate(order)) == 1:
                i, j = (k for k, o in enumerate(order) if k != o)
                words = f"{whose} with its columns {axes[i]} and {axes[j]} exchanged"
            out.append((words, _changed(some, np.eye(3)[list(order)])))
        for k in range(3):
            turned = np.diag(np.where(np.arange(3) == k, -1.0, 1.0))
            out.append((f"{whose} with the sign of {axes[k]} reversed", _changed(some, turned)))
        for factor, unit in UNITS.items():
            out.append((f"{whose} times {factor:g} ({unit})", _changed(some, factor * np.eye(3))))
    return out


def _changed(some: Bools, matrix: Array) -> Callable[[Array], Array]:
    return lambda xyz: np.where(some[:, None], xyz @ matrix.T, xyz)
