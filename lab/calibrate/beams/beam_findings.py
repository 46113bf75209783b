"""Findings of a beam calibration, and of the stand that both `calibrate beams` and `calibrate rig` use.

Checks of recordings: spots that do not fit the poses or labels, and recordings listed twice.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calibration.beams.beams import BeamCalibration, CollinearityTest
from calibration.beams.error_diagnosis import diagnose_error
from calibration.beams.spot_fit import swapped_pairs
from calibration.rig.rig_figures import FEWEST_POSITIONS
from geometry.arrays import Ints
from geometry.rig import Rig
from geometry.uncertainty.rig_uncertainty import RigCovariance
from lab.calibrate.beams.recordings import Recordings, stand_of
from lab.errors import InputError
from lab.files.project.project import Project
from lab.findings.finding import ENTRIES, Finding, Level, finding, passed
from lab.number_format import format_count


def diagnose_failed_fit(
    project: Project, rig: Rig, recordings: Recordings, lab_covariance: RigCovariance | None = None
) -> None:
    """Look for a common mistake in poses or labels that explains why the calibration failed.

    rig: calibrated cameras and screens with nominal beams; lab_covariance: of cameras and screens. The stand positions
    must be known. Raises InputError: if a single known mistake explains the failure.
    """
    found = diagnose_error(rig, recordings.spots, stand_of(project, recordings), lab_covariance)
    if found is None:
        return
    files = [r.spots or r.run if found.in_labels else r.poses for r in project.recordings]
    where = ", ".join(str(f) for f in files if f is not None)
    subject = "the spots fit" if found.in_labels else "the spots fit these poses"
    raise InputError(f"{where}: {subject} only {found.words}; {found.remedy}")


def check_no_duplicates(project: Project) -> None:
    """Refuse a recording that is listed twice: its spots would count twice and all sigmas would be too small.

    Raises InputError: names both entries.
    """
    seen: dict[Path, int] = {}
    for k, recording in enumerate(project.recordings):
        path = recording.spots or recording.run
        if path is None:
            continue
        first = seen.setdefault(path.resolve(), k)
        if first != k:
            raise InputError(
                f"{project.path}: recordings.{k}: {path.name} is already listed as recordings.{first}; list each"
                " recording once, otherwise its spots count twice"
            )


ARCSEC = np.deg2rad(1 / 3600)
_P_NOT_COLLINEAR = 1e-3  # p-value below which opposed beams are not collinear
_WORST_NAMED = 6


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


def stand_findings(project: Project, recordings: Recordings) -> list[Finding]:
    """What is taken as exact about the stand."""
    out, stand = [], project.stand
    if recordings.stand_from_body is None:
        return []
    if stand is not None and stand.world_from_stand is not None and stand.sigma_m == 0 and stand.sigma_rad == 0:
        out.append(finding("BP-K03", Level.WARN, "stand.world_from_stand has no sigma: it is assumed exact"))
    if not np.any(recordings.pose_sigmas):
        what = (
            "the stand's positions are assumed exact; give stand.pose_sigma_m and pose_sigma_deg unless its encoders"
            " are much more precise than the spots"
        )
        out.append(passed(what))
    return out


def first_names(names: Sequence[str], separator: str = ", ") -> str:
    """The first names of a list, and an ellipsis where there are more."""
    return separator.join(names[:_WORST_NAMED]) + (" …" if len(names) > _WORST_NAMED else "")


def bad_positions(position: Ints, wrong: Sequence[int], names: Sequence[str]) -> list[str]:
    """Names of the positions of which most spots were excluded. position: of each spot; wrong: the excluded spots."""
    at, of_all = Counter(position[wrong].tolist()), Counter(position.tolist())
    return [names[k] for k in sorted(at) if at[k] >= 2 and 2 * at[k] > of_all[k]][:_WORST_NAMED]


def _determined(c: BeamCalibration, positions: Sequence[str]) -> list[Finding]:
    out = []
    count = len(c.world_from_body.translation)
    if c.dropped:
        names = first_names([positions[i] for i in c.dropped])
        out.append(finding("BP-B01", Level.WARN, f"{len(c.dropped)} positions excluded: {names}"))
    if count < FEWEST_POSITIONS:
        what = f"only {format_count(count, 'position')}, expected {FEWEST_POSITIONS} or more"
        out.append(finding("BP-B02", Level.FAIL, what))
    known = c.world_from_stand is not None
    if c.undetermined:
        what = f"the positions leave undetermined: {'; '.join(c.undetermined)} ({c.motion})"
        remedy = c.motion.remedy() + (", or give world_from_stand with its sigmas" if known else "")
        out.append(finding("BP-B03", Level.FAIL, what, remedy=remedy))
    elif known:
        out.append(passed(f"the {count} positions determine all directions and offsets of the beams ({c.motion})"))
    if not known:
        what = (
            f"no position of the stand is known: {c.frame_free} parameters remain undetermined, the position (3)"
            " and the attitude (3) of the body frame; the body frame is the one in which all beams together are"
            " nearest to the drawing"
        )
        out.append(finding("BP-B04", Level.WARN, what))
    return out


def _wrong_spots(c: BeamCalibration, positions: Sequence[str], goals: BeamGoals) -> list[Finding]:
    wrong = np.flatnonzero(~c.fit.kept)
    if not len(wrong):
        return [passed(f"all {len(c.spots)} spots are consistent")]
    views = c.rig.views()
    used = [p for i, p in enumerate(positions) if i not in set(c.dropped)]
    size = np.linalg.norm(c.fit.residuals_px, axis=1)
    worst = [
        f"position {used[c.spots.position[i]]}, camera {views[c.spots.view[i]][0]}, spot {views[c.spots.view[i]][1]}:"
        f" {size[i]:.3g} px"
        for i in wrong[np.argsort(-size[wrong])]
    ]
    what = f"{len(wrong)} of {len(c.spots)} spots excluded as outliers ({first_names(worst, '; ')})"
    level = Level.WARN if len(wrong) > goals.wrong_share * len(c.spots) else Level.PASS
    out = [finding("BP-B05", level, what)]
    cameras = list(c.rig.cameras)
    camera_of = np.array([cameras.index(views[v][0]) for v in c.spots.view])
    for i, j in swapped_pairs(c.spots, c.fit.kept, c.fit.residuals_px, camera_of)[:_WORST_NAMED]:
        (camera, first), (_, second) = views[c.spots.view[i]], views[c.spots.view[j]]
        what = f"position {used[c.spots.position[i]]}: spots {first} and {second} of camera {camera!r} are exchanged"
        out.append(finding("BP-B06", Level.WARN, what))
    if bad := bad_positions(c.spots.position, wrong.tolist(), used):
        what = f"most spots of {'position' if len(bad) == 1 else 'positions'} {', '.join(bad)} were excluded"
        out.append(finding("BP-B07", Level.WARN, what))
    return out


def _noise(c: BeamCalibration, goals: BeamGoals) -> Finding:
    kept = c.fit.residuals_px[c.fit.kept]
    rms = float(np.sqrt(np.mean(kept**2)))
    if c.fit.scale > goals.noise_scale:
        what = (
            f"the spots scatter by {c.fit.scale:.2g} times their sigmas (RMS {rms:.3g} px per axis); all sigmas were"
            " multiplied by this factor"
        )
        return finding("BP-B08", Level.WARN, what)
    if c.fit.scale > 1:
        what = f"residuals of the spots: {rms:.3g} px RMS per axis, {c.fit.scale:.2f} times their sigmas, which were"
        return passed(f"{what} increased accordingly")
    return passed(f"residuals of the spots: {rms:.3g} px RMS per axis, consistent with their sigmas")


def _sigmas(c: BeamCalibration, goals: BeamGoals) -> Finding:
    each = c.direction_sigmas
    rms, worst = float(np.sqrt(np.mean(each**2))), int(np.argmax(each))
    what = (
        f"directions known to {rms / ARCSEC:.3g} arcsec RMS per axis, the worst, beam {list(c.rig.beams)[worst]}, to"
        f" {each[worst] / ARCSEC:.3g} arcsec; offsets to {1e3 * float(np.sqrt(np.mean(c.offset_sigmas**2))):.2g} mm"
    )
    if c.world_from_stand is None:
        what += ", both relative to the body frame chosen by the drawing"
    if rms <= 1.003 * goals.direction:  # equal at the displayed precision
        return passed(what)
    what += f" (goal {goals.direction / ARCSEC:.3g} arcsec)"
    level = Level.FAIL if each[worst] > goals.direction_unusable else Level.WARN
    between = np.sqrt(np.mean([a.sigma**2 for a in c.angles])) if c.angles else rms
    if c.world_from_stand is not None and between < 0.5 * rms:
        why = (
            f"the angles between beams are known to {between / ARCSEC:.3g} arcsec: the orientation of the whole target"
            f" relative to the stand is uncertain; the stand's positions: {c.motion}"
        )
        remedy = "measure world_from_stand more accurately"
        remedy = f"{c.motion.remedy()}, or {remedy}" if c.motion.flat else remedy
        return finding("BP-B09", level, what, why=why, remedy=remedy)
    times = int(np.ceil((rms / goals.direction) ** 2))
    remedy = f"{ENTRIES['BP-B09'].remedy} {times} times as many positions reach the goal."
    return finding("BP-B09", level, what, remedy=remedy)


def _against_the_drawing(c: BeamCalibration, drawing: Rig, goals: BeamGoals) -> list[Finding]:
    out = []
    names = list(c.rig.beams)
    found = np.array([c.rig.beams[n].direction for n in names])
    drawn = np.array([drawing.beams[n].direction for n in names])
    angles = np.arccos(np.clip(found @ drawn.T, -1, 1))
    for i, n in enumerate(names):
        nearest = int(np.argmin(angles[i]))
        what = f"beam {n} is {np.rad2deg(angles[i, i]):.1f} deg from its drawing"
        if nearest != i and angles[i, nearest] < 0.5 * angles[i, i] and angles[i, i] > goals.drawing:
            what += f" and {np.rad2deg(angles[i, nearest]):.1f} deg from that of beam {names[nearest]}"
            remedy = f"check which laser is {n} and which is {names[nearest]}: cover one"
            out.append(finding("BP-B10", Level.WARN, what, remedy=remedy))
        elif angles[i, i] > goals.drawing:
            out.append(finding("BP-B11", Level.WARN, what))
    if not out:
        largest = float(np.max(np.diagonal(angles)))
        out.append(passed(f"all beams are within {np.rad2deg(largest):.2g} deg of their drawing"))
    return out


def _collinearity(pair: CollinearityTest) -> Finding:
    turn, turn_sigma = pair.turn / ARCSEC, pair.turn_sigma / ARCSEC
    what = (
        f"{pair.first} and {pair.second} are {turn:.0f} ± {turn_sigma:.0f} arcsec and {1e3 * pair.gap:.2f} ±"
        f" {1e3 * pair.gap_sigma:.2f} mm apart"
    )
    p = f"p = {pair.p:.2g}" if pair.p > 1e-6 else "p < 1e-6"
    if pair.p >= _P_NOT_COLLINEAR:
        return passed(f"{what}: consistent with one line ({p})")
    if " end " in pair.first:
        return finding("BP-B12", Level.WARN, f"{what}: the two ends are not collinear ({p})")
    return passed(f"{what}: two beams, as described ({p})")
