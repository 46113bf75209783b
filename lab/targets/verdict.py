"""What the verdicts of all trackers of one target judge alike; the findings and their codes are the tracker's own."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np

from calibration.findings import Level
from geometry.arrays import Array
from lab.targets.series import F, FrameSeries
from tracking.statuses import PoseStatus

# With a smaller measured share, the tracker may have followed something else in the other frames.
LEAST_MEASURED = 0.5
GOOD_MEASURED = 0.95  # a smaller share is reported with its causes
WHY_MEASURED_MATTERS = "Predicted positions have growing sigmas; lost frames have none."


class MeasuredShare(NamedTuple):
    """What the measured frames say."""

    level: Level
    what: str
    remedy: str  # of the most frequent cause
    none: bool  # no frame is measured


def measured_share(series: FrameSeries[F], subject: str, remedies: Mapping[str, str]) -> MeasuredShare:
    """The share of measured frames against its limits. remedies: by cause."""
    measured = int(series.has_status(PoseStatus.MEASURED).sum())
    causes = series.causes()
    share = measured / max(len(series.frames), 1)
    remedy = remedies[next(iter(causes))] if causes else ""
    of_others = ", ".join(f"{count} {cause}" for cause, count in list(causes.items())[:3])
    if measured == 0:
        what = f"no {subject} was found in {len(series.frames)} frames ({of_others})"
        return MeasuredShare(Level.FAIL, what, remedy, none=True)
    what = f"{measured} of {len(series.frames)} frames ({share:.1%}) have a measured {subject}"
    if share >= GOOD_MEASURED:
        return MeasuredShare(Level.PASS, what, remedy, none=False)
    what += f" (gate: {LEAST_MEASURED:.0%}; usual: {GOOD_MEASURED:.0%} and more); of the others {of_others}"
    return MeasuredShare(Level.FAIL if share < LEAST_MEASURED else Level.WARN, what, remedy, none=False)


def missing_pictures(series: FrameSeries[F]) -> str:
    """Frames without a usable picture, in words; empty where each frame has one."""
    if not series.missing:
        return ""
    reason, _ = series.missing.most_common(1)[0]
    return f"{series.missing.total()} of {len(series.frames)} frames have no usable picture (most frequent: {reason})"


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
