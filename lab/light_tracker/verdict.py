"""The verdict on a tracked drogue: pass, check or fail, with the reasons and what to do."""

from __future__ import annotations

from calibration.findings import Finding, Level, unless_pass
from lab.light_tracker.series import DrogueSeries
from lab.number_format import format_percent
from lab.target.verdict import WHY_MEASURED_MATTERS, far_reacquisitions, measured_share, missing_pictures, some_frames
from tracking.light_tracker.frames import Cause
from tracking.statuses import PoseStatus

GOOD_CONFIDENCE = 0.8  # mean of the measured frames
LEAST_CONFIRMED = 0.5  # share of the checks in which the detector finds the drogue
_LEAST_CHECKS = 5  # with fewer, that share is not judged
_LARGEST_STEP = 1.0  # of the diameter: a reacquisition farther from the last known place is reported
_NONE_FOUND = "There is no drogue in view, it is larger than the picture, or several are alike."
_REMEDIES = {
    Cause.NO_IMAGE.value: "Check the camera and the file: pictures are missing or damaged.",
    Cause.NOT_FOUND.value: "Look at the pictures: is the drogue in view, and its diameter in the searched range"
    " (--min-diameter, --max-diameter)?",
    Cause.NO_MATCH.value: "Keep the drogue free, or use the predicted positions with their sigmas.",
    Cause.UNCERTAIN.value: "Improve light and contrast, or let the detector check more often (--every).",
    Cause.AMBIGUOUS.value: "State the place of the drogue in the first picture (--near), or its range of diameters.",
    Cause.OUT_OF_VIEW.value: "Keep the drogue inside the picture.",
}


def findings_of(series: DrogueSeries) -> list[Finding]:
    """The findings, failures first."""
    found = [
        _measured(series),
        *_ambiguous(series),
        *_jumps(series),
        *_doubts(series),
        *_missing(series),
    ]
    return sorted(found, key=lambda f: -f.level)


def _measured(series: DrogueSeries) -> Finding:
    share = measured_share(series, "drogue", _REMEDIES)
    if share.none:
        return Finding(Level.FAIL, share.what, _NONE_FOUND, share.remedy, code="BP-G01")
    return unless_pass(share.level, share.what, WHY_MEASURED_MATTERS, share.remedy, code="BP-G02")


def _ambiguous(series: DrogueSeries) -> list[Finding]:
    frames = [n for n, f in zip(series.numbers, series.frames, strict=True) if f.cause is Cause.AMBIGUOUS]
    if not frames:
        return []
    most = max(f.found for f in series.frames if f.cause is Cause.AMBIGUOUS)
    return [
        Finding(
            Level.WARN,
            f"{len(frames)} frames show several drogues (first: frame {frames[0]}; up to {most})",
            "None of them is reported, since the choice would be a guess.",
            _REMEDIES[Cause.AMBIGUOUS.value],
            code="BP-G04",
        )
    ]


def _jumps(series: DrogueSeries) -> list[Finding]:
    """Reacquisitions far from the last known place: it may be another object."""
    far = far_reacquisitions(series, series.circles, _LARGEST_STEP)
    if not far:
        return []
    return [
        Finding(
            Level.WARN,
            f"{len(far)} reacquisition{' lies' if len(far) == 1 else 's lie'} more than a diameter from the last known"
            f" place (frame {some_frames(far)})",
            "What was found there, or what was followed before, may be another object.",
            "Compare these frames in the overlay (--video).",
            code="BP-G05",
        )
    ]


def _doubts(series: DrogueSeries) -> list[Finding]:
    """A low confidence, or checks in which the detector does not find the drogue."""
    out = []
    measured = series.has_status(PoseStatus.MEASURED)
    if measured.any() and (mean := float(series.confidences[measured].mean())) < GOOD_CONFIDENCE:
        out.append(
            Finding(
                Level.WARN,
                f"the mean confidence of the measured frames is {mean:.2f} (usual: {GOOD_CONFIDENCE} and more)",
                "That share of the frames is expected to be right.",
                "Use frames with a high confidence only, or let the detector check more often (--every).",
                code="BP-G06",
            )
        )
    checks, confirmed = series.checks()
    if checks >= _LEAST_CHECKS and confirmed < LEAST_CONFIRMED * checks:
        out.append(
            Finding(
                Level.WARN,
                f"the detector finds the drogue in {format_percent(confirmed / checks)} of its {checks} checks",
                "What is followed may be another object.",
                "Look at the overlay (--video).",
                code="BP-G07",
            )
        )
    return out


def _missing(series: DrogueSeries) -> list[Finding]:
    if not (what := missing_pictures(series)):
        return []
    why = "The drogue is predicted there."
    return [Finding(Level.WARN, what, why, _REMEDIES[Cause.NO_IMAGE.value], code="BP-G03")]
