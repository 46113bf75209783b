"""Findings, report and tables of a beam calibration: beams.csv, angles.csv, residuals.csv.

Findings on the stand and on the recordings (spots that do not fit, recordings listed twice) also for `calibrate rig`.
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
from geometry.arrays import Array, Bools, Ints
from geometry.forward_model import points_on_screens
from geometry.pose import ypr_sigmas
from geometry.rig import Rig
from geometry.uncertainty.rig_uncertainty import RigCovariance
from lab.calibrate.beams.recordings import Recordings, stand_of
from lab.errors import InputError
from lab.files.project.project import Project
from lab.files.text.csv_text import write_table
from lab.findings.finding import Finding, Level, entries, finding, passed
from lab.number_format import format_cell, format_count, format_number, format_some, format_vector
from lab.report.calibration.calibration_drawings import coverage_map, residual_field, residual_histogram
from lab.report.calibration.calibration_scene import rig_things, scene_views
from lab.report.page import KeyFigure, PageDrawing, PageTable, Section


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
WORST_NAMED = 6


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


def bad_positions(position: Ints, wrong: Sequence[int], names: Sequence[str]) -> list[str]:
    """Names of the positions of which most spots were excluded. position: of each spot; wrong: the excluded spots."""
    at, of_all = Counter(position[wrong].tolist()), Counter(position.tolist())
    return [names[k] for k in sorted(at) if at[k] >= 2 and 2 * at[k] > of_all[k]][:WORST_NAMED]


def _determined(c: BeamCalibration, positions: Sequence[str]) -> list[Finding]:
    out = []
    count = len(c.world_from_body.translation)
    if c.dropped:
        names = format_some([positions[i] for i in c.dropped], WORST_NAMED)
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
    used = used_positions(c, positions)
    size = np.linalg.norm(c.fit.residuals_px, axis=1)
    worst = [
        f"position {used[c.spots.position[i]]}, camera {views[c.spots.view[i]][0]}, spot {views[c.spots.view[i]][1]}:"
        f" {size[i]:.3g} px"
        for i in wrong[np.argsort(-size[wrong])]
    ]
    what = f"{len(wrong)} of {len(c.spots)} spots excluded as outliers ({format_some(worst, WORST_NAMED, '; ')})"
    level = Level.WARN if len(wrong) > goals.wrong_share * len(c.spots) else Level.PASS
    out = [finding("BP-B05", level, what)]
    cameras = list(c.rig.cameras)
    camera_of = np.array([cameras.index(views[v][0]) for v in c.spots.view])
    for i, j in swapped_pairs(c.spots, c.fit.kept, c.fit.residuals_px, camera_of)[:WORST_NAMED]:
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
    remedy = f"{entries()['BP-B09'].remedy} {times} times as many positions reach the goal."
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


BEAMS, ANGLES, RESIDUALS = "beams.csv", "angles.csv", "residuals.csv"
BEAM_COLUMNS = (
    "beam", "dx", "dy", "dz", "px_m", "py_m", "pz_m", "sigma_direction_arcsec", "sigma_offset_mm",
    "from_drawing_arcsec", "from_drawing_mm",
)  # fmt: skip
ANGLE_COLUMNS = ("first", "second", "angle_deg", "sigma_arcsec")
RESIDUAL_COLUMNS = (
    "position", "camera", "spot", "u_px", "v_px", "residual_u_px", "residual_v_px", "residual_mm", "sigmas", "used",
)  # fmt: skip


def write_tables(c: BeamCalibration, nominal: Rig, positions: Sequence[str], folder: Path) -> None:
    """Write the three tables. nominal: the rig with the beams as designed; positions: names of all positions."""
    write_table(folder / BEAMS, BEAM_COLUMNS, _beam_rows(c, nominal))
    angles = [[a.first, a.second, f"{np.rad2deg(a.angle):.9g}", format_cell(a.sigma / ARCSEC)] for a in c.angles]
    write_table(folder / ANGLES, ANGLE_COLUMNS, angles)
    write_table(folder / RESIDUALS, RESIDUAL_COLUMNS, _residual_rows(c, positions))


def _beam_rows(c: BeamCalibration, nominal: Rig) -> list[list[str]]:
    rows = []
    off = difference_from_nominal(c, nominal)
    for i, name in enumerate(c.rig.beams):
        numbers = [*c.lines.directions[i], *c.lines.points[i]]
        figures = [c.direction_sigmas[i] / ARCSEC, 1e3 * c.offset_sigmas[i], off[i, 0] / ARCSEC, 1e3 * off[i, 1]]
        if c.undetermined:
            figures[:2] = [np.nan, np.nan]
        rows.append([name, *(f"{v:.12g}" for v in numbers), *(format_cell(v) for v in figures)])
    return rows


def _residual_rows(c: BeamCalibration, positions: Sequence[str]) -> list[list[str]]:
    names = used_positions(c, positions)
    views = c.rig.views()
    mm = residuals_mm(c)
    rows = []
    for i in range(len(c.spots)):
        camera, spot = views[c.spots.view[i]]
        numbers = [*c.spots.pixels[i], *c.fit.residuals_px[i], mm[i], c.fit.sigmas[i]]
        words = [names[c.spots.position[i]], camera, spot]
        rows.append([*words, *(format_cell(v) for v in numbers), "yes" if c.fit.kept[i] else "no"])
    return rows


def used_positions(c: BeamCalibration, positions: Sequence[str]) -> list[str]:
    """Names of the positions that the calibration uses, in its order."""
    return [p for i, p in enumerate(positions) if i not in set(c.dropped)]


def residuals_mm(c: BeamCalibration) -> Array:
    """Distance (N,) on the screen between each measured spot and its prediction, mm."""
    both = (c.spots.pixels, c.spots.pixels - c.fit.residuals_px)
    measured, predicted = (points_on_screens(c.rig, c.spots.view, pixels) for pixels in both)
    return 1e3 * np.linalg.norm(measured - predicted, axis=1)


def difference_from_nominal(c: BeamCalibration, nominal: Rig) -> Array:
    """Difference (k, 2) of each beam from its design: angle (rad), and distance (m) across the beam at its point."""
    out = []
    for i, b in enumerate(nominal.beams.values()):
        d = c.lines.directions[i]
        gap = np.cross(c.lines.points[i] - b.point, b.direction)
        out.append((np.arctan2(np.linalg.norm(np.cross(d, b.direction)), d @ b.direction), np.linalg.norm(gap)))
    return np.array(out)


def page_of(c: BeamCalibration, nominal: Rig, positions: Sequence[str]) -> tuple[list[KeyFigure], list[Section]]:
    """Key figures and sections of the report. nominal: the rig with the beams as designed; positions: names of all."""
    scene = scene_views(rig_things(c.rig, c.world_from_body[0]))
    return _key_figures(c), [
        _beams(c, nominal),
        _between(c),
        _body_frame(c),
        _positions(c, positions),
        _residuals(c),
        Section("The lab", "The vehicle at the first position, with the calibrated beams.", scene),
    ]


def _key_figures(c: BeamCalibration) -> list[KeyFigure]:
    direction, offset = c.direction_sigmas, c.offset_sigmas
    kept = c.fit.kept
    rms_px = float(np.sqrt(np.mean(c.fit.residuals_px[kept] ** 2)))
    rms_mm = float(np.sqrt(np.nanmean(residuals_mm(c)[kept] ** 2) / 2))
    out = []
    if not c.undetermined:
        worst = list(c.rig.beams)[int(np.argmax(direction))]
        largest = format_number(float(direction.max()) / ARCSEC)
        note = f"1 sigma per axis, RMS over beams; worst: {worst} with {largest}"
        note += "; in the frame of the nominal beams" if c.world_from_stand is None else ""
        rms = float(np.sqrt(np.mean(direction**2))) / ARCSEC
        out.append(("sigma of directions", f"{format_number(rms)} arcsec", note))
        note = "per axis, at the point nearest to the body's origin"
        rms = 1e3 * float(np.sqrt(np.mean(offset**2)))
        out.append(("sigma of offsets", f"{format_number(rms)} mm", note))
    if c.angles:
        angles = float(np.sqrt(np.mean([a.sigma**2 for a in c.angles]))) / ARCSEC
        note = "RMS over pairs; independent of the body frame"
        out.append(("angles between beams", f"± {format_number(angles)} arcsec", note))
    size = f"{format_number(rms_px)} px · {format_number(rms_mm)} mm"
    out.append(("residuals", size, "RMS per axis, mm on the screens"))
    out.append(("spots", f"{int(kept.sum())} of {len(kept)}", "used; the others were rejected as outliers"))
    count = len(c.world_from_body.translation)
    out.append(("positions", str(count), "known poses" if c.world_from_stand is not None else "unknown poses"))
    return out


def _beams(c: BeamCalibration, nominal: Rig) -> Section:
    off = difference_from_nominal(c, nominal)
    direction, offset = c.direction_sigmas, c.offset_sigmas
    if c.undetermined:
        direction, offset = np.full_like(direction, np.nan), np.full_like(offset, np.nan)
    words = [
        "Each laser in the body frame. The offset is the point of the beam nearest to the body's origin; sigmas are the"
        " RMS over the two axes across the beam.",
        "Errors of direction and offset are correlated, since a beam is known best where its spots were: use the joint"
        " covariance in rig.yaml rather than the sigmas alone.",
    ]
    if c.undetermined:
        words[1] = "The recordings do not determine these numbers: no rig.yaml was written."
    return Section("Beams", words, (), beam_table(c.rig, direction, offset, off))


def beam_table(rig: Rig, direction: Array, offset: Array, off_nominal: Array) -> PageTable:
    """The beams of a rig with the sigmas of direction (k,), rad, and offset (k,), m.

    off_nominal: (k, 2) angle, rad, and distance, m, from the nominal beams.
    """
    ends = {
        b: "".join(sorted({"+" if s.sign > 0 else "−" for s in rig.spots.values() if s.beam == b})) for b in rig.beams
    }
    angle, distance = off_nominal.T
    sigmas = np.column_stack([direction / ARCSEC, 1e3 * offset, 60 * np.rad2deg(angle), 1e3 * distance])
    rows = [
        (name, ends[name], format_vector(beam.direction, 6), format_vector(1e3 * beam.point, 2), *figures)
        for (name, beam), figures in zip(rig.beams.items(), sigmas, strict=True)
    ]
    heads = (
        "beam", "ends", "direction", "offset (mm)", "sigma direction (arcsec)", "sigma offset (mm)",
        "off nominal (arcmin)", "off nominal (mm)",
    )  # fmt: skip
    return PageTable(heads, rows)


def _between(c: BeamCalibration) -> Section:
    rows = [(a.first, a.second, f"{np.rad2deg(a.angle):.5f}", a.sigma / ARCSEC) for a in c.angles]
    table = PageTable(("first", "second", "angle (deg)", "sigma (arcsec)"), rows)
    return Section("Angles between beams", "These angles do not depend on the choice of the body frame.", (), table)


def _body_frame(c: BeamCalibration) -> Section:
    if c.world_from_stand is None or c.stand_covariance is None:
        return Section(
            "The body frame",
            [
                "No pose of the stand was known. A change of the body frame that is compensated by the vehicle's poses"
                f" moves no spot: {c.frame_free} of the {4 * len(c.lines)} parameters of the beams cannot be estimated,"
                " the position (3) and the attitude (3) of the body frame.",
                "The body frame is the one in which the estimated beams are closest to the nominal ones (least squares,"
                " one radian weighted like one metre). The sigmas above refer to that frame. Angles and distances"
                " between beams do not depend on this choice.",
            ],
        )
    stand, C = c.world_from_stand, c.stand_covariance
    values = [*(1e3 * stand.translation), *np.rad2deg(stand.ypr)]
    sigmas = [*(1e3 * np.sqrt(np.maximum(np.diagonal(C)[:3], 0))), *np.rad2deg(ypr_sigmas(stand, C))]
    names = ("x (mm)", "y (mm)", "z (mm)", "yaw (deg)", "pitch (deg)", "roll (deg)")
    words = [
        "The body frame is the frame of the stand's carriage, as its poses were recorded. Pose of the stand in the"
        " world:",
    ]
    if c.undetermined:
        words.append(f"Not determined: {'; '.join(c.undetermined)}. {c.motion.remedy().capitalize()}.")
        sigmas = [np.nan] * 6
    rows = list(zip(names, values, sigmas, strict=True))
    return Section("The stand", words, (), PageTable(("world_from_stand", "value", "sigma"), rows))


def _positions(c: BeamCalibration, positions: Sequence[str]) -> Section:
    names = used_positions(c, positions)
    rows = []
    for k, name in enumerate(names):
        here = c.spots.position == k
        used = here & c.fit.kept
        rms = float(np.sqrt(np.mean(c.fit.residuals_px[used] ** 2))) if used.any() else float("nan")
        pose = c.world_from_body[k]
        numbers = (*np.rad2deg(pose.ypr), *(1e3 * pose.translation))
        rows.append((name, *numbers, here.sum(), here.sum() - used.sum(), rms))
    heads = (
        "position", "yaw (deg)", "pitch (deg)", "roll (deg)", "x (mm)", "y (mm)", "z (mm)", "spots", "excluded",
        "RMS (px)",
    )  # fmt: skip
    coverage = [
        coverage_map(c.rig.cameras[n].image_size_px, pixels, f"Camera {n}: coverage by spots", things="spots")
        for n, pixels in _by_camera(c, c.spots.pixels).items()
    ]
    words = [
        f"Pose of the vehicle in the world at each position. {str(c.motion)[0].upper()}{str(c.motion)[1:]}.",
        "Spots at different distances along a beam determine its direction: rotations, and translations towards the"
        " screens.",
    ]
    return Section("Positions", words, coverage, PageTable(heads, rows))


def _residuals(c: BeamCalibration) -> Section:
    kept = c.fit.kept
    drawings: list[PageDrawing] = []
    caption = (
        "Arrows that vary slowly over the picture indicate an error of the lens or the screen; equal arrows at all"
        " spots of one position indicate an error of the stand."
    )
    residuals = _by_camera(c, c.fit.residuals_px, kept)
    for n, pixels in _by_camera(c, c.spots.pixels, kept).items():
        title, size_px = f"Camera {n}: measured − predicted", c.rig.cameras[n].image_size_px
        field = residual_field(size_px, pixels, residuals[n], title, things="spots")
        drawings.append(PageDrawing(field, "" if drawings else caption))
    whitened = c.fit.adjusted.residuals[0]
    drawings.append(PageDrawing(residual_histogram(whitened, "Normalised residuals", "sigma", sigma=1.0)))
    views = c.rig.views()
    rows = []
    mm = residuals_mm(c)
    for v, (camera, spot) in enumerate(views):
        here = (c.spots.view == v) & kept
        if here.any():
            px = float(np.sqrt(np.mean(c.fit.residuals_px[here] ** 2)))
            on_screen = np.sqrt(np.nanmean(mm[here] ** 2) / 2)
            excluded = ((c.spots.view == v) & ~kept).sum()
            rows.append((camera, spot, c.rig.spots[spot].beam, here.sum(), excluded, px, on_screen))
    heads = ("camera", "spot", "beam", "spots used", "excluded", "RMS (px)", "RMS on the screen (mm)")
    words = "RMS is per axis. The curve is the normal distribution for the stated sigmas."
    if c.fit.scale > 1:
        words += f" The sigmas were multiplied by {c.fit.scale:.3g}, since the spots scatter more than stated."
    return Section("Residuals", words, drawings, PageTable(heads, rows))


def _by_camera(c: BeamCalibration, values: Array, rows: Bools | None = None) -> dict[str, Array]:
    """Rows of values (N, 2) by camera; cameras without rows are omitted."""
    camera = np.array([name for name, _ in c.rig.views()])[c.spots.view]
    used = np.ones(len(c.spots), dtype=bool) if rows is None else rows
    out = {n: values[(camera == n) & used] for n in c.rig.cameras}
    return {n: v for n, v in out.items() if len(v)}
