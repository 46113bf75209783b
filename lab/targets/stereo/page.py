"""report.html of a stereo run: verdict, key figures, poses, residuals by camera, annotated pictures."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from geometry.arrays import Array, Ints
from lab.findings.finding import Finding, verdict
from lab.number_format import format_angle, format_length, format_number
from lab.report.page import Page, PageDrawing, PageTable, Section, made_with, write_page
from lab.report.plot.series import Band, Line, time_panel, unwrapped
from lab.report.plot.svg import BLUE, GREEN, ORANGE, VERMILLION, padded_range
from lab.report.run.figures import nees_panel
from lab.runs.tables import pose_numbers
from lab.targets.page import TimeAxis
from lab.targets.stereo.frames import annotated_pictures
from lab.targets.stereo.run import StereoResults, TruthErrors
from tracking.binocular.pose_tracker import BinocularFrame
from tracking.statuses import PoseStatus

_SENTENCES = (
    "The poses may be used.",
    "The poses may be used; note the warnings below.",
    "The poses must not be used as they are.",
)
_AXES = ("x", "y", "z")
_POSES = "Position of the body origin and attitude (Rz(yaw) Ry(pitch) Rx(roll)) in the frame of the pair"


def write_stereo_page(results: StereoResults, findings: tuple[Finding, ...], folder: Path) -> Path:
    """Write report.html into a folder. Returns its path."""
    poses = pose_section(_axis(results), [r.tracked for r in results.records], _POSES)
    sections = [_pictures(results), poses, _residuals(results), _pair(results)]
    if results.errors is not None:
        sections.insert(1, _truth(results, results.errors))
    run = results.run
    notes = [*results.notes, *([run.notes] if run.notes else [])]
    made = [("method", _method(results)), made_with("numpy", "opencv-python-headless")]
    page = Page(
        "pose from two cameras",
        run.name,
        str(run.folder),
        sections,
        _key_figures(results),
        notes,
        made,
        findings,
        _SENTENCES[verdict(findings)],
    )
    return write_page(page, folder)


def _key_figures(results: StereoResults) -> list[tuple[str, str, str]]:
    measured = results.measured
    out = [("Measured", f"{len(measured)} of {len(results.records)}", "frames")]
    if not measured:
        return out
    covariances = np.array([r.tracked.covariance for r in measured])
    away = np.array([_distance(results, r.tracked.pose.translation) for r in measured if r.tracked.pose is not None])
    position = np.sqrt(np.trace(covariances[:, :3, :3], axis1=1, axis2=2))
    turn = np.sqrt(np.trace(covariances[:, 3:, 3:], axis1=1, axis2=2))
    rms = [fit.rms_px for fit in results.fits if fit is not None]
    out += [
        ("Distance", f"{format_number(away.min())} to {format_number(away.max())} m", "of the body origin"),
        ("Position sigma", format_length(float(np.median(position))), "median, all axes together"),
        ("Rotation sigma", format_angle(float(np.rad2deg(np.median(turn)))), "median, all axes together"),
        ("Residual", f"{format_number(float(np.median(rms)))} px", "RMS of a frame, median"),
        ("Markers", format_number(float(np.mean([r.tracked.markers for r in measured]))),
         f"of {len(results.run.target.model)} in a pose, mean"),
    ]  # fmt: skip
    if results.errors is not None:
        e = results.errors.as_mapping()
        out += [
            ("Position error", format_length(e["position_rms_m"]), "RMS against truth"),
            ("NEES", format_number(e["nees_mean"]), "mean; 6 if the covariance is right"),
        ]
    return out


def _distance(results: StereoResults, position: Array) -> float:
    eye = results.run.pair.cameras[0].camera_from_world.inverse().translation
    return float(np.linalg.norm(position - eye))


def _pictures(results: StereoResults) -> Section:
    drawings = [PageDrawing(p, caption, wide=True) for p, caption in annotated_pictures(results)]
    words = (
        "Green: markers with their labels; orange: candidates without a label; crosses: where the pose puts markers"
        " that are not found. Left and right camera side by side, cut to the target."
        if drawings
        else "The run has no pictures: the markers come from a table."
    )
    return Section("Annotated pictures", words, drawings)


def _axis(results: StereoResults) -> TimeAxis:
    return TimeAxis(results.t_s, "time (s)", [r.tracked.status for r in results.records])


def pose_section(axis: TimeAxis, frames: Sequence[BinocularFrame], frame_words: str) -> Section:
    """The poses of n frames over time. frame_words: in which frame they are, and which angles are meant."""
    value, sigma = np.full((len(frames), 6), np.nan), np.full((len(frames), 6), np.nan)
    for i, t in enumerate(frames):
        if t.pose is not None and t.covariance is not None:
            numbers = pose_numbers(t.pose, t.covariance)
            value[i], sigma[i] = numbers[[0, 1, 2, 7, 8, 9]], numbers[10:]
    value[:, 3:] = unwrapped(value[:, 3:])
    measured, drawings = np.array([t.status is PoseStatus.MEASURED for t in frames]), []
    for k in (0, 3, 1, 4, 2, 5):
        name, unit = (f"{_AXES[k]}", "m") if k < 3 else (("yaw", "pitch", "roll")[k - 3], "deg")
        shown = value[:, k]
        band = Band.about(shown, np.where(measured, sigma[:, k], np.nan), 3.0, BLUE, "3 sigma")
        line, y_range = Line(shown, BLUE, name), padded_range(shown)
        drawings.append(axis.panel(name, unit, line, bands=(band,), y_range=y_range, wide=False, height=118))
    return Section("Pose", f"{frame_words}, with 3 sigma. Shaded: not measured.", drawings)


def _truth(results: StereoResults, e: TruthErrors) -> Section:
    at: Ints = np.searchsorted([r.frame for r in results.records], e.frames)
    t = results.t_s[at]
    panels = [
        time_panel(
            t, f"error of {axis}", "mm",
            lines=(Line(1000 * e.deltas[:, k], BLUE, f"error of {axis}"),),
            bands=(Band.about(0.0, 1000 * _sigmas(results, at)[:, k], 2.0, GREEN, "2 sigma", 0.2),),
        )
        for k, axis in enumerate(_AXES)
    ]  # fmt: skip
    panels.append(nees_panel(e.nees, partial(time_panel, t)))
    m = e.as_mapping()
    rows = [
        ("position, RMS", format_length(m["position_rms_m"])),
        ("rotation, RMS", format_angle(m["rotation_rms_deg"])),
        ("distance, bias", format_length(m["range_bias_m"])),
        ("distance, RMS", format_length(m["range_rms_m"])),
        ("NEES, mean (6 expected)", format_number(m["nees_mean"])),
    ]
    words = f"Truth minus estimate in {m['frames']} measured frames."
    return Section(
        "Errors against truth", words, [PageDrawing(p) for p in panels], PageTable(("quantity", "value"), rows)
    )


def _sigmas(results: StereoResults, at: Ints) -> Array:
    covariances = [results.records[int(i)].tracked.covariance for i in at]
    return np.sqrt(np.array([np.diagonal(C)[:3] for C in covariances if C is not None]))


def _residuals(results: StereoResults) -> Section:
    n, K = len(results.records), len(results.run.target.model)
    residuals = np.full((n, 2, K, 2), np.nan)
    for i, fit in enumerate(results.fits):
        if fit is not None:
            residuals[i].reshape(-1, 2)[fit.rows] = fit.residuals_px
    drawings = []
    for c, camera in enumerate(results.run.pair.cameras):
        seen = np.isfinite(residuals[:, c]).any(axis=(1, 2))
        rms = np.full((n, 2), np.nan)
        rms[seen] = np.sqrt(np.nanmean(residuals[seen, c] ** 2, axis=1))
        drawings.append(
            _axis(results).panel(
                f"camera {camera.name}: RMS residual of a frame", "px", Line(rms[:, 0], BLUE, "u"),
                Line(rms[:, 1], VERMILLION, "v"), y_range=(0.0, max(float(np.nanmax(rms, initial=0.05)) * 1.1, 0.05)),
                wide=False, height=118, caption="u: blue, v: vermilion",
            )
        )  # fmt: skip
    rows: list[list[object]] = []
    for k, name in enumerate(results.run.target.model.names):
        row: list[object] = [name]
        for c in range(2):
            own = residuals[:, c, k]
            own = own[np.isfinite(own[:, 0])]
            row += [len(own), *(own.mean(axis=0) if len(own) else (np.nan, np.nan)),
                    float(np.sqrt(np.mean(own**2))) if len(own) else np.nan]  # fmt: skip
        rows.append(row)
    heads = ["marker"]
    for camera in results.run.pair.cameras:
        heads += [f"{camera.name}: frames", "mean u (px)", "mean v (px)", "RMS (px)"]
    words = (
        "Measured minus predicted pixels of the joint fit. A marker with a mean far from 0 in both cameras is not where"
        " run.yaml puts it; an even mean of all markers in one camera is an error of the calibration."
    )
    return Section("Residuals by camera", words, drawings, PageTable(heads, rows))


def _pair(results: StereoResults) -> Section:
    pair, clock = results.run.pair, results.clock
    rows: list[list[object]] = [["baseline", f"{pair.baseline_m:.4f} m"]]
    rows += [[f"focal length of {c.name}", f"{c.matrix[0, 0]:.2f} px"] for c in pair.cameras]
    if clock is not None:
        rows += [
            ["right exposure after the left one", f"{1000 * clock.offset_s:.3f} ± {1000 * clock.sigma_s:.3f} ms"],
            ["scatter of that offset between frames", f"{1000 * clock.jitter_s:.3f} ms"],
        ]
        angles = np.rad2deg(np.stack([clock.rotation_rad, clock.rotation_sigma_rad], axis=1)).tolist()
        for axis, (v, s) in zip(_AXES, angles, strict=True):
            rows.append(
                [f"rotation of the right camera about {axis}, against the calibration", f"{v:.4f} ± {s:.4f} deg"]
            )
    else:
        rows.append(["synchronisation", "not tested: too few moving frames"])
    check = results.calibration
    for s in () if check is None else check.suspects:
        rows.append([f"error that explains the residuals best: {s.name}", f"{s.value:.4f} ± {s.sigma:.4f} {s.unit}"])
    words = (
        "Synchronisation and rotation are estimated from the residuals of all frames: an offset in time shifts images"
        " in proportion to their velocity, a rotation shifts them equally in all frames. Each single error of the"
        " calibration is fitted with all poses; those that the recording does not separate are listed, also where none"
        " is significant."
    )
    drawings = []
    if len(results.measured) > 1:
        chi = np.full(len(results.records), np.nan)
        for i, fit in enumerate(results.fits):
            if fit is not None and fit.dof > 0:
                chi[i] = fit.chi2 / fit.dof
        top = max(float(np.nanpercentile(chi, 99)) * 1.2, 2.0)
        name, line = "misfit: chi-square over degrees of freedom; 1 expected", Line(chi, ORANGE, "misfit")
        drawings.append(_axis(results).panel(name, "", line, y_range=(0.0, top), height=130))
    return Section("The pair", words, drawings, PageTable(("quantity", "value"), rows))


def _method(results: StereoResults) -> str:
    p = results.run.parameters.segmentation
    histogram = "right picture with the histogram of the left" if p.specify_histogram else "no histogram specification"
    return (
        f"segmentation: gamma {p.gamma:g}, {histogram}, median {p.median_px}, opening {p.opening_px}, closing"
        f" {p.closing_px} px, {p.centroid} centroids"
    )
