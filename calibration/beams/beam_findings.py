"""Findings of a beam calibration."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibration.beams.beam_figures import CollinearityTest
from calibration.beams.beams import BeamCalibration
from calibration.beams.label_swaps import swapped_pairs
from calibration.findings import Finding, Level
from geometry.arrays import Array
from geometry.rig import Rig

ARCSEC = np.deg2rad(1 / 3600)
_P_NOT_COLLINEAR = 1e-3  # p-value below which opposed beams are not collinear
_WORST_NAMED = 6
UNDETERMINED = "the positions leave undetermined"  # start of that finding's text
# Positions required for a trustworthy result. Without a fifth of eight, six remain, the number of parameters of a pose;
# with fewer, a single wrong record or label moves the beams without increasing the residuals.
FEWEST_POSITIONS = 8


@dataclass(frozen=True, slots=True)
class BeamGoals:
    """Thresholds of the findings."""

    direction: float = 15 * ARCSEC  # rad, RMS over both axes and all beams: above it a warning
    direction_unusable: float = 200 * ARCSEC  # rad, of one beam: 2.4 mm on a screen 2.5 m away
    drawing: float = np.deg2rad(2.0)  # rad, deviation of a beam from its drawing, above which its label is doubtful
    wrong_share: float = 0.1  # of excluded spots
    noise_scale: float = 1.5  # scatter of the spots over their stated sigmas


def beam_findings(
    c: BeamCalibration, drawing: Rig | None, positions: Sequence[str], goals: BeamGoals = BeamGoals()
) -> list[Finding]:
    """All findings; drawing: the nominal rig, None if there is none. positions: their names."""
    out = [*_determined(c, positions), *_wrong_spots(c, positions, goals), _noise(c, goals)]
    if not c.undetermined:
        out.append(_sigmas(c, goals))
    if drawing is not None:
        out += _against_the_drawing(c, drawing, goals)
    out += [_collinearity(pair) for pair in c.collinearity]
    return out


def direction_sigmas(c: BeamCalibration) -> Array:
    """Sigma of each beam's direction (k,), rad: RMS of the two axes across it."""
    return _across(c, 0)


def offset_sigmas(c: BeamCalibration) -> Array:
    """Sigma of each beam's offset (k,), m: RMS of the two axes across it, at the point nearest to the body's origin."""
    return _across(c, 2)


def _across(c: BeamCalibration, first: int) -> Array:
    variances = np.diagonal(c.lines_covariance).reshape(-1, 4)[:, first : first + 2]
    return np.sqrt(np.mean(variances, axis=1))


def _determined(c: BeamCalibration, positions: Sequence[str]) -> list[Finding]:
    out = []
    count = len(c.world_from_body.translation)
    if c.dropped:
        names = ", ".join(positions[i] for i in c.dropped[:_WORST_NAMED])
        out.append(
            Finding(
                Level.WARN,
                f"{len(c.dropped)} positions excluded: {names}{' …' if len(c.dropped) > _WORST_NAMED else ''}",
                "too few of their spots were detected to determine the vehicle's pose, which is not recorded either",
                "keep spots of both screens in view",
                code="BP-B01",
            )
        )
    if count < FEWEST_POSITIONS:
        out.append(
            Finding(
                Level.FAIL,
                f"only {count} position{'' if count == 1 else 's'}, expected {FEWEST_POSITIONS} or more",
                "with so few, a wrong record or label cannot be detected and biases the beams",
                "record 20 positions or more, turned about all axes",
                code="BP-B02",
            )
        )
    known = c.world_from_stand is not None
    if c.undetermined:
        out.append(
            Finding(
                Level.FAIL,
                f"{UNDETERMINED}: {'; '.join(c.undetermined)} ({c.motion})",
                "along these motions no spot moves: their values would be those of the start",
                c.motion.remedy() + (", or give world_from_stand with its sigmas" if known else ""),
                code="BP-B03",
            )
        )
    elif known:
        out.append(
            Finding(Level.PASS, f"the {count} positions determine all directions and offsets of the beams ({c.motion})")
        )
    if not known:
        out.append(
            Finding(
                Level.WARN,
                f"no position of the stand is known: {c.frame_free} parameters remain undetermined, the position (3)"
                " and the attitude (3) of the body frame; the body frame is the one in which all beams together are"
                " nearest to the drawing",
                "angles between beams and the shape of the rig are measured; attitudes of the vehicle refer to this"
                " body frame, not to the vehicle's own axes",
                "record some positions at known attitudes to determine the vehicle's own axes",
                code="BP-B04",
            )
        )
    return out


def _wrong_spots(c: BeamCalibration, positions: Sequence[str], goals: BeamGoals) -> list[Finding]:
    wrong = np.flatnonzero(~c.fit.kept)
    if not len(wrong):
        return [Finding(Level.PASS, f"all {len(c.spots)} spots are consistent")]
    views = c.rig.views()
    used = [p for i, p in enumerate(positions) if i not in set(c.dropped)]
    size = np.linalg.norm(c.fit.residuals_px, axis=1)
    worst = wrong[np.argsort(-size[wrong])][:_WORST_NAMED]
    named = "; ".join(
        f"position {used[c.spots.position[i]]}, camera {views[c.spots.view[i]][0]}, spot {views[c.spots.view[i]][1]}:"
        f" {size[i]:.3g} px"
        for i in worst
    )
    named += " …" if len(wrong) > len(worst) else ""
    share = len(wrong) / len(c.spots)
    out = [
        Finding(
            Level.WARN if share > goals.wrong_share else Level.PASS,
            f"{len(wrong)} of {len(c.spots)} spots excluded as outliers ({named})",
            "reflections, wrong labels or saturated spots; they do not affect the result" if share else "",
            "inspect these pictures; correct the labels or the light" if share > goals.wrong_share else "",
            code="BP-B05",
        )
    ]
    cameras = list(c.rig.cameras)
    camera_of = np.array([cameras.index(views[v][0]) for v in c.spots.view])
    for i, j in swapped_pairs(c.spots, c.fit.kept, c.fit.residuals_px, camera_of)[:_WORST_NAMED]:
        (camera, first), (_, second) = views[c.spots.view[i]], views[c.spots.view[j]]
        out.append(
            Finding(
                Level.WARN,
                f"position {used[c.spots.position[i]]}: spots {first} and {second} of camera {camera!r} are exchanged",
                "each is at the place of the other; both were excluded",
                "exchange the two names at this position in the table of spots",
                code="BP-B06",
            )
        )
    at = Counter(c.spots.position[wrong].tolist())
    in_all = Counter(c.spots.position.tolist())
    bad = [k for k, n in at.items() if n >= 2 and 2 * n > in_all[k]]
    if bad:
        names = ", ".join(used[k] for k in sorted(bad)[:_WORST_NAMED])
        out.append(
            Finding(
                Level.WARN,
                f"most spots of {'position' if len(bad) == 1 else 'positions'} {names} were excluded",
                "if all spots of a position have large residuals, its recorded pose or its labels are wrong",
                "check the stand's record there",
                code="BP-B07",
            )
        )
    return out


def _noise(c: BeamCalibration, goals: BeamGoals) -> Finding:
    kept = c.fit.residuals_px[c.fit.kept]
    rms = float(np.sqrt(np.mean(kept**2)))
    if c.fit.scale > goals.noise_scale:
        return Finding(
            Level.WARN,
            f"the spots scatter by {c.fit.scale:.2g} times their sigmas (RMS {rms:.3g} px per axis); all sigmas were"
            " multiplied by this factor",
            "an error that the model does not contain: screens that are not flat, cameras that moved, a stand less"
            " accurate than stated, beams that drift while they warm up",
            "see the residuals by screen and position below; calibrate cameras and screens again, warm up the lasers",
            code="BP-B08",
        )
    words = f"residuals of the spots: {rms:.3g} px RMS per axis, consistent with their sigmas"
    if c.fit.scale > 1:
        words = f"residuals of the spots: {rms:.3g} px RMS per axis, {c.fit.scale:.2f} times their sigmas, which were"
        words += " increased accordingly"
    return Finding(Level.PASS, words)


def _sigmas(c: BeamCalibration, goals: BeamGoals) -> Finding:
    each = direction_sigmas(c)
    rms, worst = float(np.sqrt(np.mean(each**2))), int(np.argmax(each))
    name = list(c.rig.beams)[worst]
    words = (
        f"directions known to {rms / ARCSEC:.3g} arcsec RMS per axis, the worst, beam {name}, to"
        f" {each[worst] / ARCSEC:.3g} arcsec; offsets to {1e3 * float(np.sqrt(np.mean(offset_sigmas(c) ** 2))):.2g} mm"
    )
    if c.world_from_stand is None:
        words += ", both relative to the body frame chosen by the drawing"
    if rms <= 1.003 * goals.direction:  # equal at the displayed precision
        return Finding(Level.PASS, words)
    between = np.sqrt(np.mean([a.sigma**2 for a in c.angles])) if c.angles else rms
    times = int(np.ceil((rms / goals.direction) ** 2))
    why = "correlated direction and offset errors cancel at the distances of the calibration, but not farther away"
    remedy = (
        "a beam's direction is determined by spots at different distances along it: shift the vehicle farther along its"
        f" beams, or record {times} times as many positions"
    )
    if c.world_from_stand is not None and between < 0.5 * rms:
        why = (
            f"the angles between beams are known to {between / ARCSEC:.3g} arcsec: the orientation of the whole target"
            f" relative to the stand is uncertain; the stand's positions: {c.motion}"
        )
        remedy = "measure world_from_stand more accurately"
        remedy = f"{c.motion.remedy()}, or {remedy}" if c.motion.flat else remedy
    return Finding(
        Level.FAIL if each[worst] > goals.direction_unusable else Level.WARN,
        f"{words} (goal {goals.direction / ARCSEC:.3g} arcsec)",
        why,
        remedy,
        code="BP-B09",
    )


def _against_the_drawing(c: BeamCalibration, drawing: Rig, goals: BeamGoals) -> list[Finding]:
    out = []
    names = list(c.rig.beams)
    found = np.array([c.rig.beams[n].direction for n in names])
    drawn = np.array([drawing.beams[n].direction for n in names])
    angles = np.arccos(np.clip(found @ drawn.T, -1, 1))
    for i, n in enumerate(names):
        nearest = int(np.argmin(angles[i]))
        if nearest != i and angles[i, nearest] < 0.5 * angles[i, i] and angles[i, i] > goals.drawing:
            out.append(
                Finding(
                    Level.WARN,
                    f"beam {n} is {np.rad2deg(angles[i, i]):.1f} deg from its drawing and"
                    f" {np.rad2deg(angles[i, nearest]):.1f} deg from that of beam {names[nearest]}",
                    "labels that are exchanged in all pictures are consistent; only the drawing reveals them",
                    f"check which laser is {n} and which is {names[nearest]}: cover one",
                    code="BP-B10",
                )
            )
        elif angles[i, i] > goals.drawing:
            out.append(
                Finding(
                    Level.WARN,
                    f"beam {n} is {np.rad2deg(angles[i, i]):.1f} deg from its drawing",
                    "mounting errors are smaller; the cause is a wrong label, or a body frame other than the drawing's",
                    "check the labels and the carriage's axes; if both are right, update the drawing",
                    code="BP-B11",
                )
            )
    if not out:
        largest = float(np.max(np.diagonal(angles)))
        out.append(Finding(Level.PASS, f"all beams are within {np.rad2deg(largest):.2g} deg of their drawing"))
    return out


def _collinearity(pair: CollinearityTest) -> Finding:
    turn, turn_sigma = pair.turn / ARCSEC, pair.turn_sigma / ARCSEC
    words = (
        f"{pair.first} and {pair.second} are {turn:.0f} ± {turn_sigma:.0f} arcsec and {1e3 * pair.gap:.2f} ±"
        f" {1e3 * pair.gap_sigma:.2f} mm apart"
    )
    p = f"p = {pair.p:.2g}" if pair.p > 1e-6 else "p < 1e-6"
    if pair.p >= _P_NOT_COLLINEAR:
        return Finding(Level.PASS, f"{words}: consistent with one line ({p})")
    if " end " in pair.first:
        return Finding(
            Level.WARN,
            f"{words}: the two ends are not collinear ({p})",
            "described as one beam, each end is wrong by half of that",
            "describe them in target.beams as two beams with one spot each, and calibrate again",
            code="BP-B12",
        )
    return Finding(Level.PASS, f"{words}: two beams, as described ({p})")
