"""What a calibration of beams concludes about itself, in words for the person who can act on it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibration.beams.beam_figures import OneLine
from calibration.beams.beams import BeamCalibration
from calibration.beams.label_swaps import exchanged_pairs
from calibration.findings import Finding, Level
from geometry.arrays import Array
from geometry.rig import Rig

ARCSEC = np.deg2rad(1 / 3600)
_P_TWO_LINES = 1e-3  # of a straight pair to be told to be two lines
_WORST_NAMED = 6
UNDETERMINED = "the positions leave undetermined"  # how that finding begins
# Positions below which nothing can be trusted: a fifth of them held out leaves six, as many as a pose has numbers; with
# fewer, a single wrong record or label moves the beams as much as it misfits, and no residual shows it.
FEWEST_POSITIONS = 8


@dataclass(frozen=True, slots=True)
class BeamGoals:
    """When beams count as well known."""

    direction: float = 15 * ARCSEC  # rad, RMS over both axes and all beams: beyond, a warning
    direction_unusable: float = 200 * ARCSEC  # rad, of one beam: 2.4 mm on a screen 2.5 m away
    drawing: float = np.deg2rad(2.0)  # rad that a beam may differ from its drawing before labels are doubted
    wrong_share: float = 0.1  # of the spots left out
    noise_scale: float = 1.5  # times the told sigmas that the spots may scatter


def beam_findings(
    c: BeamCalibration, drawing: Rig | None, positions: Sequence[str], goals: BeamGoals = BeamGoals()
) -> list[Finding]:
    """All findings; drawing: the nominal rig, None where there is none. positions: a name for each."""
    out = [*_determined(c, positions), *_wrong_spots(c, positions, goals), _noise(c, goals)]
    if not c.undetermined:
        out.append(_sigmas(c, goals))
    if drawing is not None:
        out += _against_the_drawing(c, drawing, goals)
    out += [_one_line(pair) for pair in c.one_line]
    return out


def direction_sigmas(c: BeamCalibration) -> Array:
    """Of each beam (k,), rad: RMS of the two axes across it."""
    return _across(c, 0)


def offset_sigmas(c: BeamCalibration) -> Array:
    """Of each beam (k,), m: RMS of the two axes across it, at the point nearest to the body's origin."""
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
                f"{len(c.dropped)} positions left out: {names}{' …' if len(c.dropped) > _WORST_NAMED else ''}",
                "too few of their spots were seen to find the vehicle's pose, which no record gives",
                "keep spots of both screens in view",
            )
        )
    if count < FEWEST_POSITIONS:
        out.append(
            Finding(
                Level.FAIL,
                f"only {count} position{'' if count == 1 else 's'}, expected {FEWEST_POSITIONS} or more",
                "so few cannot show a wrong record or label: it would move the beams unseen",
                "record 20 positions or more, turned about all axes",
            )
        )
    known = c.world_from_stand is not None
    if c.undetermined:
        out.append(
            Finding(
                Level.FAIL,
                f"{UNDETERMINED}: {'; '.join(c.undetermined)} ({c.motion})",
                "along these motions no spot moves: what is written of them would be the start value",
                c.motion.remedy() + (", or give world_from_stand with its sigmas" if known else ""),
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
                f"no position of the stand is known: {c.frame_free} numbers stay undetermined, the place (3) and the"
                " attitude (3) of the body frame; the body frame was laid so that all beams together are nearest to"
                " the drawing",
                "angles between beams and the shape of the rig are measured; the attitude of the vehicle is one"
                " against this chosen frame, not against its own axes",
                "for the vehicle's own axes record some positions at known attitudes",
            )
        )
    return out


def _wrong_spots(c: BeamCalibration, positions: Sequence[str], goals: BeamGoals) -> list[Finding]:
    wrong = np.flatnonzero(~c.fit.kept)
    if not len(wrong):
        return [Finding(Level.PASS, f"all {len(c.spots)} spots agree with each other")]
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
            f"{len(wrong)} of {len(c.spots)} spots left out as wrong ({named})",
            "reflections, wrong labels or blinded spots; they take no part in the result" if share else "",
            "look at these pictures; mend the labels or the light" if share > goals.wrong_share else "",
        )
    ]
    cameras = list(c.rig.cameras)
    camera_of = np.array([cameras.index(views[v][0]) for v in c.spots.view])
    for i, j in exchanged_pairs(c.spots, c.fit.kept, c.fit.residuals_px, camera_of)[:_WORST_NAMED]:
        (camera, first), (_, second) = views[c.spots.view[i]], views[c.spots.view[j]]
        out.append(
            Finding(
                Level.WARN,
                f"position {used[c.spots.position[i]]}: spots {first} and {second} of camera {camera!r} are exchanged",
                "each lies where the other should be; both were left out",
                "exchange the two names at this position in the table of spots",
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
                f"most spots of {'position' if len(bad) == 1 else 'positions'} {names} were left out",
                "when all spots of a position are off together, its recorded pose or its labels are wrong",
                "check the stand's record there",
            )
        )
    return out


def _noise(c: BeamCalibration, goals: BeamGoals) -> Finding:
    kept = c.fit.residuals_px[c.fit.kept]
    rms = float(np.sqrt(np.mean(kept**2)))
    if c.fit.scale > goals.noise_scale:
        return Finding(
            Level.WARN,
            f"the spots scatter {c.fit.scale:.2g} times as much as their sigmas say (RMS {rms:.3g} px per axis); all"
            " sigmas were widened by that",
            "something is not in the model: screens that are not flat, cameras that moved, a stand that is less exact"
            " than told, beams that wander while they warm up",
            "see the residuals by screen and position below; calibrate cameras and screens again, warm the lasers up",
        )
    words = f"the spots fit to {rms:.3g} px RMS per axis, as their sigmas say"
    if c.fit.scale > 1:
        words = f"the spots fit to {rms:.3g} px RMS per axis, {c.fit.scale:.2f} times their sigmas, which were widened"
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
        words += ", both against the body frame that was laid by the drawing"
    if rms <= 1.003 * goals.direction:  # as far as the figures in words go
        return Finding(Level.PASS, words)
    between = np.sqrt(np.mean([a.sigma**2 for a in c.angles])) if c.angles else rms
    times = int(np.ceil((rms / goals.direction) ** 2))
    why = "direction and offset errors that go together cancel near the distances of the calibration, no farther"
    remedy = (
        "a beam's direction is told by spots at different distances along it: shift the vehicle farther along its"
        f" beams, or record {times} times as many positions"
    )
    if c.world_from_stand is not None and between < 0.5 * rms:
        why = (
            f"the angles between beams are known to {between / ARCSEC:.3g} arcsec: it is the whole target against the"
            f" stand that is not; the stand's positions: {c.motion}"
        )
        remedy = "measure world_from_stand better"
        remedy = f"{c.motion.remedy()}, or {remedy}" if c.motion.flat else remedy
    return Finding(
        Level.FAIL if each[worst] > goals.direction_unusable else Level.WARN,
        f"{words} (goal {goals.direction / ARCSEC:.3g} arcsec)",
        why,
        remedy,
    )


def _against_the_drawing(c: BeamCalibration, drawing: Rig, goals: BeamGoals) -> list[Finding]:
    out = []
    names = list(c.rig.beams)
    found = np.array([c.rig.beams[n].direction for n in names])
    drawn = np.array([drawing.beams[n].direction for n in names])
    away = np.arccos(np.clip(found @ drawn.T, -1, 1))
    for i, n in enumerate(names):
        nearest = int(np.argmin(away[i]))
        if nearest != i and away[i, nearest] < 0.5 * away[i, i] and away[i, i] > goals.drawing:
            out.append(
                Finding(
                    Level.WARN,
                    f"beam {n} lies {np.rad2deg(away[i, i]):.1f} deg from its drawing and"
                    f" {np.rad2deg(away[i, nearest]):.1f} deg from that of beam {names[nearest]}",
                    "labels that are swapped everywhere agree with each other and are found only so",
                    f"check which laser is {n} and which {names[nearest]}: cover one",
                )
            )
        elif away[i, i] > goals.drawing:
            out.append(
                Finding(
                    Level.WARN,
                    f"beam {n} lies {np.rad2deg(away[i, i]):.1f} deg from its drawing",
                    "mounting errors are smaller; a wrong label, or a body frame other than the drawing's, looks so",
                    "check labels and the carriage's axes; if both are right, update the drawing",
                )
            )
    if not out:
        largest = float(np.max(np.diagonal(away)))
        out.append(Finding(Level.PASS, f"all beams lie within {np.rad2deg(largest):.2g} deg of their drawing"))
    return out


def _one_line(pair: OneLine) -> Finding:
    turn, turn_sigma = pair.turn / ARCSEC, pair.turn_sigma / ARCSEC
    words = (
        f"{pair.first} and {pair.second} are {turn:.0f} ± {turn_sigma:.0f} arcsec and {1e3 * pair.gap:.2f} ±"
        f" {1e3 * pair.gap_sigma:.2f} mm apart"
    )
    p = f"p = {pair.p:.2g}" if pair.p > 1e-6 else "p < 1e-6"
    if pair.p >= _P_TWO_LINES:
        return Finding(Level.PASS, f"{words}: one line fits both ({p})")
    if " end " in pair.first:
        return Finding(
            Level.WARN,
            f"{words}: the two ends are not one line ({p})",
            "as one beam, each end is wrong by half of that",
            "describe them in target.beams as two beams with one spot each, and calibrate again",
        )
    return Finding(Level.PASS, f"{words}: two beams, as described ({p})")
