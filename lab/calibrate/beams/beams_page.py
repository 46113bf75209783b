"""Report of a beam calibration.

Tables of a beam calibration: beams.csv, angles.csv, residuals.csv.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from calibration.beams.beams import BeamCalibration
from calibration.beams.spot_fit import world_points
from geometry.arrays import Array, Bools
from geometry.pose import ypr_sigmas
from geometry.rig import Rig
from lab.calibrate.beams.beam_findings import ARCSEC
from lab.files.text.atomic_write import atomic_write_text
from lab.files.text.csv_text import csv_text
from lab.number_format import format_number
from lab.report.calibration.calibration_charts import residual_histogram
from lab.report.calibration.calibration_drawings import coverage_map, residual_field
from lab.report.calibration.calibration_scene import rig_things, scene_views
from lab.report.page import (
    KeyFigure,
    PageDrawing,
    PageTable,
    Section,
)

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
    atomic_write_text(_beam_table(c, nominal), folder / BEAMS)
    atomic_write_text(_angle_table(c), folder / ANGLES)
    atomic_write_text(_residual_table(c, positions), folder / RESIDUALS)


def _beam_table(c: BeamCalibration, nominal: Rig) -> str:
    rows = []
    off = difference_from_nominal(c, nominal)
    for i, name in enumerate(c.rig.beams):
        numbers = [*c.lines.directions[i], *c.lines.points[i]]
        figures = [c.direction_sigmas[i] / ARCSEC, 1e3 * c.offset_sigmas[i], off[i, 0] / ARCSEC, 1e3 * off[i, 1]]
        if c.undetermined:
            figures[:2] = [np.nan, np.nan]
        rows.append([name, *(f"{v:.12g}" for v in numbers), *(_short(v) for v in figures)])
    return csv_text(BEAM_COLUMNS, rows)


def _angle_table(c: BeamCalibration) -> str:
    rows = [[a.first, a.second, f"{np.rad2deg(a.angle):.9g}", _short(a.sigma / ARCSEC)] for a in c.angles]
    return csv_text(ANGLE_COLUMNS, rows)


def _residual_table(c: BeamCalibration, positions: Sequence[str]) -> str:
    names = used_positions(c, positions)
    views = c.rig.views()
    mm = residuals_mm(c)
    rows = []
    for i in range(len(c.spots)):
        camera, spot = views[c.spots.view[i]]
        numbers = [*c.spots.pixels[i], *c.fit.residuals_px[i], mm[i], c.fit.sigmas[i]]
        words = [names[c.spots.position[i]], camera, spot]
        rows.append([*words, *(_short(v) for v in numbers), "yes" if c.fit.kept[i] else "no"])
    return csv_text(RESIDUAL_COLUMNS, rows)


def used_positions(c: BeamCalibration, positions: Sequence[str]) -> list[str]:
    """Names of the positions that the calibration uses, in its order."""
    return [p for i, p in enumerate(positions) if i not in set(c.dropped)]


def residuals_mm(c: BeamCalibration) -> Array:
    """Distance (N,) on the screen between each measured spot and its prediction, mm."""
    predicted = replace(c.spots, pixels=c.spots.pixels - c.fit.residuals_px)
    return 1e3 * np.linalg.norm(world_points(c.rig, c.spots) - world_points(c.rig, predicted), axis=1)


def difference_from_nominal(c: BeamCalibration, nominal: Rig) -> Array:
    """Difference (k, 2) of each beam from its design: angle (rad), and distance (m) across the beam at its point."""
    out = []
    for i, b in enumerate(nominal.beams.values()):
        d = c.lines.directions[i]
        gap = np.cross(c.lines.points[i] - b.point, b.direction)
        out.append((np.arctan2(np.linalg.norm(np.cross(d, b.direction)), d @ b.direction), np.linalg.norm(gap)))
    return np.array(out)


def _short(value: float) -> str:
    return f"{value:.6g}" if np.isfinite(value) else ""


def page_of(c: BeamCalibration, nominal: Rig, positions: Sequence[str]) -> tuple[list[KeyFigure], list[Section]]:
    """Key figures and sections of the report. nominal: the rig with the beams as designed; positions: names of all."""
    scene = [PageDrawing(view) for view in scene_views(rig_things(c.rig, c.world_from_body[0]))]
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
        rms = float(np.sqrt(np.mean(direction**2))) / ARCSEC
        note = (
            f"1 sigma per axis, RMS over beams; worst: {worst} with {format_number(float(direction.max()) / ARCSEC, 3)}"
        )
        note += "; in the frame of the nominal beams" if c.world_from_stand is None else ""
        out.append(("sigma of directions", f"{format_number(rms, 3)} arcsec", note))
        rms = 1e3 * float(np.sqrt(np.mean(offset**2)))
        out.append(
            ("sigma of offsets", f"{format_number(rms, 3)} mm", "per axis, at the point nearest to the body's origin")
        )
    if c.angles:
        angles = float(np.sqrt(np.mean([a.sigma**2 for a in c.angles]))) / ARCSEC
        note = "RMS over pairs; independent of the body frame"
        out.append(("angles between beams", f"± {format_number(angles, 3)} arcsec", note))
    out.append(
        (
            "residuals",
            f"{format_number(rms_px, 3)} px · {format_number(rms_mm, 3)} mm",
            "RMS per axis, mm on the screens",
        )
    )
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
    rows = [
        (
            name,
            ends[name],
            _three(beam.direction, 6),
            _three(1e3 * beam.point, 2),
            float(direction[i] / ARCSEC),
            float(1e3 * offset[i]),
            float(np.rad2deg(off_nominal[i, 0]) * 60),
            float(1e3 * off_nominal[i, 1]),
        )
        for i, (name, beam) in enumerate(rig.beams.items())
    ]
    heads = (
        "beam", "ends", "direction", "offset (mm)", "sigma direction (arcsec)", "sigma offset (mm)",
        "off nominal (arcmin)", "off nominal (mm)",
    )  # fmt: skip
    return PageTable(heads, rows)


def _three(vector: Array, digits: int) -> str:
    return ", ".join(f"{v:.{digits}f}".replace("-", "−") for v in vector)


def _between(c: BeamCalibration) -> Section:
    rows = [(a.first, a.second, f"{np.rad2deg(a.angle):.5f}", a.sigma / ARCSEC) for a in c.angles]
    words = ["These angles do not depend on the choice of the body frame."]
    return Section(
        "Angles between beams", words, (), PageTable(("first", "second", "angle (deg)", "sigma (arcsec)"), rows)
    )


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
    yaw, pitch, roll = np.rad2deg(c.world_from_stand.ypr)
    sigmas = np.sqrt(np.maximum(np.diagonal(c.stand_covariance), 0))
    turns = np.rad2deg(ypr_sigmas(c.world_from_stand, c.stand_covariance))
    place = 1e3 * c.world_from_stand.translation
    rows = [
        ("x (mm)", float(place[0]), float(1e3 * sigmas[0])),
        ("y (mm)", float(place[1]), float(1e3 * sigmas[1])),
        ("z (mm)", float(place[2]), float(1e3 * sigmas[2])),
        ("yaw (deg)", float(yaw), float(turns[0])),
        ("pitch (deg)", float(pitch), float(turns[1])),
        ("roll (deg)", float(roll), float(turns[2])),
    ]
    words = [
        "The body frame is the frame of the stand's carriage, as its poses were recorded. Pose of the stand in the"
        " world:",
    ]
    if c.undetermined:
        words.append(f"Not determined: {'; '.join(c.undetermined)}. {c.motion.remedy().capitalize()}.")
        rows = [(name, value, float("nan")) for name, value, _ in rows]
    return Section("The stand", words, (), PageTable(("world_from_stand", "value", "sigma"), rows))


def _positions(c: BeamCalibration, positions: Sequence[str]) -> Section:
    names = used_positions(c, positions)
    rows = []
    for k, name in enumerate(names):
        here = c.spots.position == k
        used = here & c.fit.kept
        rms = float(np.sqrt(np.mean(c.fit.residuals_px[used] ** 2))) if used.any() else float("nan")
        yaw, pitch, roll = np.rad2deg(c.world_from_body[k].ypr)
        x, y, z = 1e3 * c.world_from_body[k].translation
        rows.append(
            (name, float(yaw), float(pitch), float(roll), float(x), float(y), float(z), int(here.sum()),
             int(here.sum() - used.sum()), rms)
        )  # fmt: skip
    heads = (
        "position", "yaw (deg)", "pitch (deg)", "roll (deg)", "x (mm)", "y (mm)", "z (mm)", "spots", "excluded",
        "RMS (px)",
    )  # fmt: skip
    coverage = [
        PageDrawing(
            coverage_map(c.rig.cameras[n].image_size_px, pixels, f"Camera {n}: coverage by spots", things="spots")
        )
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
    drawings = [
        PageDrawing(
            residual_field(
                c.rig.cameras[n].image_size_px,
                pixels,
                _by_camera(c, c.fit.residuals_px, kept)[n],
                f"Camera {n}: measured − predicted",
                things="spots",
            ),
            "Arrows that vary slowly over the picture indicate an error of the lens or the screen; equal arrows at all"
            " spots of one position indicate an error of the stand."
            if i == 0
            else "",
        )
        for i, (n, pixels) in enumerate(_by_camera(c, c.spots.pixels, kept).items())
    ]
    whitened = c.fit.adjusted.residuals[0]
    drawings.append(PageDrawing(residual_histogram(whitened, "Normalised residuals", "sigma", sigma=1.0)))
    views = c.rig.views()
    rows = []
    mm = residuals_mm(c)
    for v, (camera, spot) in enumerate(views):
        here = (c.spots.view == v) & kept
        if here.any():
            px = float(np.sqrt(np.mean(c.fit.residuals_px[here] ** 2)))
            on_screen = float(np.sqrt(np.nanmean(mm[here] ** 2) / 2))
            excluded = int(((c.spots.view == v) & ~kept).sum())
            rows.append((camera, spot, c.rig.spots[spot].beam, int(here.sum()), excluded, px, on_screen))
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
