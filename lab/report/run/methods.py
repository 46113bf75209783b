"""The methods of a run in sentences with citations, to paste into a paper."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from geometry.arrays import Array
from lab.findings.finding import first_sentence
from lab.number_format import format_angle, format_length, format_number, format_percent
from lab.report.run.report_data import ReportData
from lab.report.run.trust import ModelFit
from tracking.statuses import PoseStatus

HUO = (
    "Huo J, Yang N, Yang M (2015). Tracking and recognition of projective spots for cooperation targets in vehicle"
    " simulation test. Optics and Precision Engineering 23(8), 2134\u20132142. doi:10.3788/OPE.20152308.2134"
)
BIERMAN = (
    "Bierman GJ (1973). Fixed interval smoothing with discrete measurements. International Journal of Control 18(1),"
    " 65\u201375."
)
BAR_SHALOM = (
    "Bar-Shalom Y, Li XR, Kirubarajan T (2001). Estimation with Applications to Tracking and Navigation."
    " Wiley, New York."
)
BAARDA = (
    "Baarda W (1968). A testing procedure for use in geodetic networks. Netherlands Geodetic Commission,"
    " Publications on Geodesy 2(5), Delft."
)


@dataclass(frozen=True, slots=True)
class Methods:
    """The text and its list of references."""

    paragraphs: tuple[str, ...]
    references: tuple[str, ...]


def methods(m: ReportData, fit: ModelFit | None) -> Methods:
    """The text with the run's own numbers; numbers in brackets refer to the references."""
    references: list[str] = []

    def cite(reference: str) -> str:
        if reference not in references:
            references.append(reference)
        return f"[{references.index(reference) + 1}]"

    return Methods((_recording(m) + _tracking(m, cite), _results(m, fit)), tuple(references))


def _recording(m: ReportData) -> str:
    sizes, cameras, frames = m.picture_sizes, m.spots.cameras, len(m.spots.frames)
    named = [f"{c}, {sizes[c][0]} \u00d7 {sizes[c][1]} px" if c in sizes else c for c in cameras]
    spots = len(dict.fromkeys(spot for _, spot in m.spots.views))
    span = float(m.t_s[-1] - m.t_s[0]) if len(m.t_s) and m.time_name != "frame" else 0.0
    beams = f"{len(m.run.rig.beams)} laser" if m.run is not None else "the laser"
    out = f"The {spots} spots of {beams} beams of the vehicle were recorded by {len(cameras)}"
    out += f" camera{'s' if len(cameras) != 1 else ''}" + (f" ({', '.join(named)})" if named else "")
    out += f" at {m.run.frame_rate_hz:g} Hz" if m.run is not None else ""
    out += f": {frames} frames" + (f" in {span:.4g} s" if span > 0 else "") + "."
    state = m.summary.calibration
    return out + (f" The rig was calibrated on {state['date']}." if state and "date" in state else "")


def _tracking(m: ReportData, cite: Callable[[str], str]) -> str:
    program = f"beampose {dict(m.summary.details['versions']).get('beampose', '')}".strip()
    if m.summary.method == "spots":
        out = (
            f" Spots were detected and tracked with {program}, by prediction and matching in three steps with"
            f" curve switching {cite(HUO)}. The pose of the vehicle was estimated in each frame from the labelled spots"
            " of all cameras by weighted least squares on their pixels."
        )
    else:
        out = (
            f" Spots were detected and tracked with {program}: one filter estimates the motion of the rigid vehicle,"
            " the detections of each frame are assigned to the spots jointly, several hypotheses are kept until one is"
            f" clearly the most likely {cite(BAR_SHALOM)}, and labels must be confirmed by the other spots of the frame"
            f" {cite(BAARDA)}. The measurement principle and the treatment of spots out of view follow {cite(HUO)}."
        )
    if m.causal is not None:
        out += (
            " Poses and labels were then smoothed over the whole recording (fixed-interval smoothing"
            f" {cite(BIERMAN)}), with the intensity of the jerk estimated from the recording."
        )
    return out


def _results(m: ReportData, fit: ModelFit | None) -> str:
    p, measured = m.poses, m.poses.has(PoseStatus.MEASURED)

    def medians(values: Array, written: Callable[[float | None], str]) -> str:
        return ", ".join(written(float(np.nanmedian(values[measured, i]))) for i in range(3))

    share = format_percent(float(measured.mean()) if len(measured) else 0.0)
    out = f"The pose was measured in {share} of the frames"
    others = [f"{n} {s}" for s in (PoseStatus.PREDICTED, PoseStatus.LOST) if (n := int(p.has(s).sum()))]
    out += f" (frames otherwise: {', '.join(others)})." if others else "."
    if measured.any():
        out += (
            " Median standard uncertainties of the measured poses (k = 1) are"
            f" {medians(p.sigma_ypr_deg, format_angle)} in yaw, pitch and roll and"
            f" {medians(p.sigma_position_m, format_length)} in x, y and z"
        )
        with_calibration = bool(np.isfinite(p.systematic).any())
        out += ", with the calibration's contribution." if with_calibration else ", without the calibration's."
    rms = p.rms_px[measured & np.isfinite(p.rms_px)]
    if len(rms):
        out += f" The median residual of a pose is {format_number(float(np.median(rms)))} px (RMS over its spots)."
    if fit is not None and fit.tested:
        found = "; ".join(first_sentence(f.what) for f in fit.findings)
        out += (
            f" Deviations from the calibrated rig found in the residuals: {found}."
            if found
            else " No deviation of a camera, screen, beam or clock from the calibrated rig was found in the residuals."
        )
    out += f" The program's verdict on the recording is {m.summary.verdict.word}."
    return out + " Attitude is R = Rz(yaw) Ry(pitch) Rx(roll), from body to world."
