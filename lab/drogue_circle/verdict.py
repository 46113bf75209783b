"""The verdict on a tracked circle: pass, check or fail, with the reasons and what to do."""

from __future__ import annotations

from calibration.findings import Finding, Level, unless_pass
from lab.drogue_circle.series import CircleSeries
from lab.target.verdict import WHY_MEASURED_MATTERS, far_reacquisitions, measured_share, missing_pictures, some_frames
from tracking.drogue_circle.frames import Cause

_LARGEST_STEP = 0.5  # of the radius: a reacquisition farther from the prediction is reported
_NONE_FOUND = "There is no target in view, or its rim is not a circle of the searched radii, or several are alike."
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
    found = [
        _measured(series),
        *_ambiguous(series),
        *_jumps(series),
        *_missing(series),
    ]
    return sorted(found, key=lambda f: -f.level)


def _measured(series: CircleSeries) -> Finding:
    share = measured_share(series, "circle", _REMEDIES)
    if share.none:
        return Finding(Level.FAIL, share.what, _NONE_FOUND, share.remedy, code="BP-T01")
    return unless_pass(share.level, share.what, WHY_MEASURED_MATTERS, share.remedy, code="BP-T02")


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
    far = far_reacquisitions(series, series.states[:, :3], _LARGEST_STEP)
    if not far:
        return []
    return [
        Finding(
            Level.WARN,
            f"{len(far)} reacquisitions lie more than half a radius from the last known place"
            f" (frame {some_frames(far)})",
            "The circle found there may be another one.",
            "Compare these frames in the overlay (--video).",
            code="BP-T05",
        )
    ]


def _missing(series: CircleSeries) -> list[Finding]:
    if not (what := missing_pictures(series)):
        return []
    why = "The circle is predicted there."
    return [Finding(Level.WARN, what, why, _REMEDIES[Cause.NO_IMAGE.value], code="BP-T03")]
