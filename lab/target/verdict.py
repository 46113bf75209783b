"""Findings that the verdicts of all trackers of one target share; their words and codes are the tracker's own."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from calibration.findings import Finding, Level
from geometry.arrays import Array
from lab.target.frame_series import F, FrameSeries
from tracking.statuses import PoseStatus

# With a smaller measured share, the tracker may have followed something else in the other frames.
LEAST_MEASURED = 0.5
GOOD_MEASURED = 0.95  # a smaller share is reported with its causes


def measured_finding(
    series: FrameSeries[F], subject: str, why_none: str, remedies: Mapping[str, str], codes: tuple[str, str]
) -> Finding:
    """The measured share.

    why_none: why no frame may be measured. remedies: by cause. codes: where no frame is measured, where few are.
    """
    measured = int(series.has_status(PoseStatus.MEASURED).sum())
    causes = series.causes()
    share = measured / max(len(series.frames), 1)
    remedy = remedies[next(iter(causes))] if causes else ""
    of_others = ", ".join(f"{count} {cause}" for cause, count in list(causes.items())[:3])
    if measured == 0:
        what = f"no {subject} was found in {len(series.frames)} frames ({of_others})"
        return Finding(Level.FAIL, what, why_none, remedy, code=codes[0])
    what = f"{measured} of {len(series.frames)} frames ({share:.1%}) have a measured {subject}"
    if share >= GOOD_MEASURED:
        return Finding(Level.PASS, what)
    what += f" (gate: {LEAST_MEASURED:.0%}; usual: {GOOD_MEASURED:.0%} and more); of the others {of_others}"
    why = "Predicted positions have growing sigmas; lost frames have none."
    return Finding(Level.FAIL if share < LEAST_MEASURED else Level.WARN, what, why, remedy, code=codes[1])


def missing_pictures(series: FrameSeries[F], subject: str, remedy: str, code: str) -> list[Finding]:
    """A finding where frames have no usable picture."""
    if not series.missing:
        return []
    reason, _ = series.missing.most_common(1)[0]
    what = f"{series.missing.total()} of {len(series.frames)} frames have no usable picture (most frequent: {reason})"
    return [Finding(Level.WARN, what, f"The {subject} is predicted there.", remedy, code=code)]


def far_reacquisitions(series: FrameSeries[F], circles: Iterable[Array], limit: float) -> list[int]:
    """Frames that are found again far from the last known place.

    circles: u, v and size (3,) of each frame, px; nan where unknown. limit: in sizes.
    """
    known, far = np.full(3, np.nan), []
    for number, frame, now in zip(series.numbers, series.frames, circles, strict=True):
        if frame.event == "reacquired" and np.hypot(*(now[:2] - known[:2])) > limit * known[2]:
            far.append(number)
        if np.isfinite(now).all():
            known = now
    return far


def some_frames(frames: list[int]) -> str:
    """The first five numbers."""
    return ", ".join(map(str, frames[:5])) + (", ..." if len(frames) > 5 else "")
