"""The findings that all kinds of tracked targets share."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lab.findings.catalogue import ENTRIES
from lab.findings.finding import Finding, Level, finding, worst_first
from lab.targets.target import F, Target, Track
from tracking.statuses import Cause

GOOD_MEASURED = 0.95  # a smaller share is reported with its causes


def findings_of(target: Target[F], track: Track[F]) -> tuple[Finding, ...]:
    """All findings, failures first."""
    found = [
        _measured(target, track),
        *_ambiguous(target, track),
        *_far_away(target, track),
        *target.findings(track),
        *_missing(target, track),
    ]
    return worst_first(found)


def _measured(target: Target[F], track: Track[F]) -> Finding:
    measured, n, causes = int(track.measured.sum()), len(track.frames), track.causes()
    share, least = measured / n, target.least_measured
    cause = next(iter(causes)).value if causes else ""
    of_others = ", ".join(f"{count} {cause}" for cause, count in list(causes.items())[:3])
    if not measured:
        what = f"no {target.subject} was found in {n} frames ({of_others})"
        remedy = ENTRIES[target.codes.few].variant(cause).remedy
        return finding(target.codes.none, Level.FAIL, what, remedy=remedy)
    what = f"{measured} of {n} frames ({share:.1%}) have a measured {target.subject}"
    level = Level.FAIL if share < least else Level.WARN if share < GOOD_MEASURED else Level.PASS
    if level > Level.PASS:
        gate = f"gate: {100 * least:.3g}%; usual: {GOOD_MEASURED:.0%} and more"
        what += f" ({gate})" + (f"; of the others {of_others}" if of_others else "")
    return finding(target.codes.few, level, what, variant=cause)


def _ambiguous(target: Target[F], track: Track[F]) -> list[Finding]:
    numbered = zip(track.recording.numbers.tolist(), track.frames, strict=True)
    frames = [(number, f.found) for number, f in numbered if f.cause is Cause.AMBIGUOUS]
    if not frames:
        return []
    most = max(found for _, found in frames)
    what = f"{len(frames)} frames show {target.several} (first: frame {frames[0][0]}; up to {most})"
    return [finding(target.codes.ambiguous, Level.WARN, what)]


def _far_away(target: Target[F], track: Track[F]) -> list[Finding]:
    """Reacquisitions far from the last known place: it may be another object."""
    known, far = np.full(3, np.nan), []
    for number, frame, now in zip(track.recording.numbers.tolist(), track.frames, track.places, strict=True):
        if frame.event == "reacquired" and np.hypot(*(now[:2] - known[:2])) > target.far_sizes * known[2]:
            far.append(number)
        if np.isfinite(now).all():
            known = now
    if not far:
        return []
    what = (
        f"{len(far)} reacquisition{' lies' if len(far) == 1 else 's lie'} more than {target.far_words} from the last"
        f" known place (frame {some_frames(far)})"
    )
    return [finding(target.codes.far, Level.WARN, what)]


def _missing(target: Target[F], track: Track[F]) -> list[Finding]:
    missing, n = track.recording.missing, len(track.frames)
    if sum(missing.values()) <= target.usual_missing * n:
        return []
    reason = max(missing, key=lambda r: missing[r])
    what = f"{sum(missing.values())} of {n} frames have no usable picture (most frequent: {reason})"
    return [finding(target.codes.missing, Level.WARN, what)]


def some_frames(frames: Sequence[int]) -> str:
    """The first five numbers."""
    return ", ".join(map(str, frames[:5])) + (", ..." if len(frames) > 5 else "")
