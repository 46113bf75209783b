"""The verdict on a tracked circle: pass, check or fail, with the reasons and what to do."""

from __future__ import annotations

import numpy as np

from calibration.findings import Finding, Level
from lab.drogue_circle.series import CircleSeries
from tracking.drogue_circle.frames import Cause
from tracking.statuses import PoseStatus

# With fewer frames, the tracker may not have followed the target in the others either.
LEAST_MEASURED = 0.5
GOOD_MEASURED = 0.95  # a smaller share is reported with its causes
_LARGEST_STEP = 0.5  # of the radius: a reacquisition farther from the prediction is reported
_REMEDIES = {
    Cause.NO_IMAGE.value: "Check the camera and the file: pictures are missing or damaged.",
    Cause.OCCLUDED.value: "Keep the target free, or use the predicted positions with their sigmas.",
    Cause.NOT_FOUND.value: "Look at the overlay (--video): is the rim sharp, and are the radii in the searched range"
    " (--min-radius, --max-radius)?",
    Cause.AMBIGUOUS.value: "State the place of the circle in the first picture (--near), or its range of radii.",
    Cause.OUT_OF_VIEW.value: "Keep the target inside the picture.",
}


def findings_of(series: CircleSeries) -> list[Finding]:
    """The findings, failures first."""
    found = [*_measured(series), *_ambiguous(series), *_jumps(series)]
    if series.missing:
        count = sum(series.missing.values())
        reason = series.missing.most_common(1)[0][0]
        found.append(
            Finding(
                Level.WARN,
                f"{count} of {len(series.frames)} frames have no usable picture (most frequent: {reason})",
                "The circle is predicted there.",
                _REMEDIES[Cause.NO_IMAGE.value],
                code="BP-T03",
            )
        )
    return sorted(found, key=lambda f: -f.level)


def _measured(series: CircleSeries) -> list[Finding]:
    measured = int(series.has_status(PoseStatus.MEASURED).sum())
    causes = series.causes()
    share = measured / max(len(series.frames), 1)
    remedy = _REMEDIES[next(iter(causes))] if causes else ""
    of_others = ", ".join(f"{count} {Cause(cause).value}" for cause, count in list(causes.items())[:3])
    if measured == 0:
        what = f"no circle was found in {len(series.frames)} frames ({of_others})"
        why = "There is no target in view, or its rim is not a circle of the searched radii, or several are alike."
        return [Finding(Level.FAIL, what, why, remedy, code="BP-T01")]
    what = f"{measured} of {len(series.frames)} frames ({share:.1%}) have a measured circle"
    if share >= GOOD_MEASURED:
        return [Finding(Level.PASS, what)]
    what += f" (gate: {LEAST_MEASURED:.0%}; usual: {GOOD_MEASURED:.0%} and more); of the others {of_others}"
    why = "Predicted positions have growing sigmas; lost frames have none."
    return [Finding(Level.FAIL if share < LEAST_MEASURED else Level.WARN, what, why, remedy, code="BP-T02")]


def _ambiguous(series: CircleSeries) -> list[Finding]:
    frames = [n for n, f in zip(series.numbers, series.frames, strict=True) if f.cause is Cause.AMBIGUOUS]
    if not frames:
        return []
    most = max(f.circles for f in series.frames if f.cause is Cause.AMBIGUOUS)
    return [
        Finding(
            Level.WARN,
            f"{len(frames)} frames show several circles that fit equally well (first: frame {frames[0]}; up to {most}"
            " circles)",
            "None of them is reported, since the choice would be a guess.",
            _REMEDIES[Cause.AMBIGUOUS.value],
            code="BP-T04",
        )
    ]


def _jumps(series: CircleSeries) -> list[Finding]:
    """Reacquisitions far from the last known place: it may be another circle."""
    known, far = np.full(3, np.nan), []
    for number, frame in zip(series.numbers, series.frames, strict=True):
        now = frame.state[:3]
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
            f"{len(far)} reacquisitions lie more than half a radius from the last known place (frame {some})",
            "The circle found there may be another one.",
            "Compare these frames in the overlay (--video).",
            code="BP-T05",
        )
    ]
