"""The verdict on a tracked drogue: pass, check or fail, with the reasons and what to do."""

from __future__ import annotations

import numpy as np

from calibration.findings import Finding, Level
from lab.light_tracker.series import DrogueSeries
from lab.number_format import format_percent
from tracking.light_tracker.frames import Cause
from tracking.statuses import PoseStatus

LEAST_MEASURED = 0.5  # share of the frames; with less, the tracker may have followed something else in the others
GOOD_MEASURED = 0.95  # a smaller share is reported with its causes
GOOD_CONFIDENCE = 0.8  # mean of the measured frames
LEAST_CONFIRMED, _LEAST_CHECKS = (
    0.5,
    5,
)  # share of the checks in which the detector finds the drogue; fewer checks: none
_LARGEST_STEP = 1.0  # of the diameter: a reacquisition farther from the last known place is reported
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
    found = [*_measured(series), *_ambiguous(series), *_jumps(series), *_doubts(series)]
    if series.missing:
        count = sum(series.missing.values())
        reason = series.missing.most_common(1)[0][0]
        found.append(
            Finding(
                Level.WARN,
                f"{count} of {len(series.frames)} frames have no usable picture (most frequent: {reason})",
                "The drogue is predicted there.",
                _REMEDIES[Cause.NO_IMAGE.value],
                code="BP-G03",
            )
        )
    return sorted(found, key=lambda f: -f.level)


def _measured(series: DrogueSeries) -> list[Finding]:
    measured = int(series.has_status(PoseStatus.MEASURED).sum())
    causes = series.causes()
    share = measured / max(len(series.frames), 1)
    remedy = _REMEDIES[next(iter(causes))] if causes else ""
    of_others = ", ".join(f"{count} {Cause(cause).value}" for cause, count in list(causes.items())[:3])
    if measured == 0:
        what = f"no drogue was found in {len(series.frames)} frames ({of_others})"
        why = "There is no drogue in view, it is larger than the picture, or several are alike."
        return [Finding(Level.FAIL, what, why, remedy, code="BP-G01")]
    what = f"{measured} of {len(series.frames)} frames ({share:.1%}) have a measured drogue"
    if share >= GOOD_MEASURED:
        return [Finding(Level.PASS, what)]
    what += f" (gate: {LEAST_MEASURED:.0%}; usual: {GOOD_MEASURED:.0%} and more); of the others {of_others}"
    why = "Predicted positions have growing sigmas; lost frames have none."
    return [Finding(Level.FAIL if share < LEAST_MEASURED else Level.WARN, what, why, remedy, code="BP-G02")]


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
    known, far = np.full(3, np.nan), []
    for number, frame, now in zip(series.numbers, series.frames, series.circles, strict=True):
        if frame.event == "reacquired" and np.hypot(*(now[:2] - known[:2])) > _LARGEST_STEP * known[2]:
            far.append(number)
        if np.isfinite(now).all():
            known = now
    if not far:
        return []
    some = ", ".join(map(str, far[:5])) + (", ..." if len(far) > 5 else "")
    return [
        Finding(
            Level.WARN,
            f"{len(far)} reacquisition{' lies' if len(far) == 1 else 's lie'} more than a diameter from the last known"
            f" place (frame {some})",
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
