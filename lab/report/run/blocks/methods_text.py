"""The methods of a run in sentences with citations, to paste into a paper."""

from __future__ import annotations

from dataclasses import dataclass

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
class MethodsFacts:
    """What the text states. Empty texts and None are left out."""

    version: str
    method: str  # of the tracker: rigid or spots
    smoothed: bool
    cameras: tuple[str, ...]  # each with its picture size where it is known
    spots: int
    beams: int | None
    frames: int
    rate_hz: float | None
    duration_s: float | None
    calibration: str  # a clause such as "was calibrated on 2026-03-14"
    calibration_sigmas: bool  # their contribution is part of the stated uncertainty
    measured: str  # share of the frames with a measured pose
    predicted: int  # frames with a predicted pose
    lost: int
    sigma_angles: str  # median standard uncertainties of yaw, pitch and roll
    sigma_position: str  # of x, y and z
    residual: str  # median RMS
    model_check: str  # a sentence
    verdict: str


@dataclass(frozen=True, slots=True)
class Methods:
    """The text and its list of references."""

    paragraphs: tuple[str, ...]
    references: tuple[str, ...]


def methods_text(f: MethodsFacts) -> Methods:
    """The text; numbers in brackets refer to the references."""
    references: list[str] = []

    def cite(reference: str) -> str:
        if reference not in references:
            references.append(reference)
        return f"[{references.index(reference) + 1}]"

    count = len(f.cameras)
    lasers = f"{f.beams} laser beams of the vehicle" if f.beams else "the laser beams of the vehicle"
    recording = f"The {f.spots} spots of {lasers} were recorded by {count} camera{'s' if count != 1 else ''}"
    recording += f" ({', '.join(f.cameras)})" if f.cameras else ""
    recording += f" at {f.rate_hz:g} Hz" if f.rate_hz else ""
    recording += f": {f.frames} frames" + (f" in {f.duration_s:.4g} s" if f.duration_s else "") + "."
    recording += f" The rig {f.calibration}." if f.calibration else ""
    program = f"beampose {f.version}".strip()
    if f.method == "spots":
        tracking = (
            f" Spots were detected and tracked with {program}, by prediction and matching in three steps with"
            f" curve switching {cite(HUO)}. The pose of the vehicle was estimated in each frame from the labelled spots"
            " of all cameras by weighted least squares on their pixels."
        )
    else:
        tracking = (
            f" Spots were detected and tracked with {program}: one filter estimates the motion of the rigid vehicle,"
            " the detections of each frame are assigned to the spots jointly, several hypotheses are kept until one is"
            f" clearly the most likely {cite(BAR_SHALOM)}, and labels must be confirmed by the other spots of the frame"
            f" {cite(BAARDA)}. The measurement principle and the treatment of spots out of view follow {cite(HUO)}."
        )
    if f.smoothed:
        tracking += (
            " Poses and labels were then smoothed over the whole recording (fixed-interval smoothing"
            f" {cite(BIERMAN)}), with the intensity of the jerk estimated from the recording."
        )
    results = f"The pose was measured in {f.measured} of the frames"
    others = [f"{n} {word}" for n, word in ((f.predicted, "predicted"), (f.lost, "lost")) if n]
    results += f" (frames otherwise: {', '.join(others)})." if others else "."
    if f.sigma_angles:
        results += (
            f" Median standard uncertainties of the measured poses (k = 1) are {f.sigma_angles} in yaw, pitch and roll"
            f" and {f.sigma_position} in x, y and z"
        )
        results += ", with the calibration's contribution." if f.calibration_sigmas else ", without the calibration's."
    results += f" The median residual of a pose is {f.residual} (RMS over its spots)." if f.residual else ""
    results += f" {f.model_check}" if f.model_check else ""
    results += f" The program's verdict on the recording is {f.verdict}."
    results += " Attitude is R = Rz(yaw) Ry(pitch) Rx(roll), from body to world."
    return Methods((recording + tracking, results), tuple(references))
