"""Findings of a pair's calibration, and the uncertainty of distances that it leaves."""

from __future__ import annotations

import numpy as np

from calibration.findings import Finding, Level, unless_pass
from calibration.pair.pair_calibration import CalibratedPair
from geometry.arrays import Array
from lab.number_format import format_number
from tracking.binocular.marker_model import StereoPair, calibration_jacobian, project

GOOD_MISFIT, LARGEST_MISFIT = 1.3, 3.0  # joint residuals over those of the cameras by themselves
GOOD_PAIRS = 8
GOOD_RANGE_SHARE, LARGEST_RANGE_SHARE = 0.002, 0.02  # sigma of the distance over the distance, at 20 baselines
BASELINES = (5.0, 10.0, 20.0, 40.0)
_JUDGED = 20.0


def range_sigmas(pair: CalibratedPair) -> Array:
    """(n, 2): distances, m, and their sigmas, m, due to the calibration alone, of points ahead between both axes.

    nan where a distance is not in both pictures.
    """
    stereo = StereoPair(pair.cameras, pair.covariance)
    out = []
    for times in BASELINES:
        distance = times * pair.baseline_m
        eyes = [c.camera_from_world.inverse() for c in pair.cameras]
        ahead = eyes[0].rotation[:, 2] + eyes[1].rotation[:, 2]
        point = (eyes[0].translation + eyes[1].translation) / 2 + distance * ahead / np.linalg.norm(ahead)
        pixels, J = project(stereo, point[None])
        if not np.isfinite(pixels).all():
            out.append([distance, np.nan])
            continue
        by_point = J.reshape(4, 3)
        by_calibration = calibration_jacobian(stereo, point[None]).reshape(4, -1)
        gain = np.linalg.pinv(by_point) @ by_calibration
        C = gain @ pair.covariance.matrix @ gain.T
        sight = ahead / np.linalg.norm(ahead)
        out.append([distance, float(np.sqrt(sight @ C @ sight))])
    return np.array(out)


def findings_of(pair: CalibratedPair, names: tuple[str, str]) -> tuple[Finding, ...]:
    """All findings."""
    found = [_misfit(pair), _count(pair), _range(pair)]
    for name, single in zip(names, pair.single, strict=True):
        # Warnings at most: the lens in use is that of the joint adjustment, whose residuals BP-Q01 judges.
        found += [
            Finding(Level.WARN, f"camera {name} ({f.code}): {f.what}", f.why, f.remedy, code="BP-Q04")
            for f in single.findings
            if f.level > Level.PASS
        ]
    return tuple(found)


def _misfit(pair: CalibratedPair) -> Finding:
    m = pair.misfit
    level = Level.PASS if m < GOOD_MISFIT else Level.WARN if m < LARGEST_MISFIT else Level.FAIL
    apart = f"; in {len(pair.separated)} pairs the board moved between the exposures" if pair.separated else ""
    return unless_pass(
        level,
        f"joint residuals are {format_number(m)} times those of the cameras by themselves{apart}",
        "The photographs of one number do not show the board at one place.",
        "Hold the board still, or trigger both cameras together; check the numbers in the file names.",
        code="BP-Q01",
    )


def _count(pair: CalibratedPair) -> Finding:
    n = len(pair.keys) - len(pair.separated)
    return unless_pass(
        Level.PASS if n >= GOOD_PAIRS else Level.WARN,
        f"{n} pairs of photographs show the board in both cameras",
        "The relative pose has large sigmas.",
        "Take 15 pairs or more, near and far, in all parts of both pictures.",
        code="BP-Q02",
    )


def _range(pair: CalibratedPair) -> Finding:
    table = range_sigmas(pair)
    distance, sigma = table[BASELINES.index(_JUDGED)]
    share = sigma / distance
    good = np.isfinite(share) and share <= GOOD_RANGE_SHARE
    level = Level.PASS if good else Level.FAIL if np.isfinite(share) and share > LARGEST_RANGE_SHARE else Level.WARN
    what = (
        f"distances at {format_number(distance)} m (20 baselines) are uncertain by {100 * share:.2g} % due to the"
        " calibration"
        if np.isfinite(share)
        else f"a point {format_number(distance)} m ahead (20 baselines) is not in both pictures"
    )
    return unless_pass(
        level,
        what,
        "This error is the same in all frames; averaging does not reduce it.",
        "Take more pairs; let the board fill the pictures; use a longer baseline.",
        code="BP-Q03",
    )
