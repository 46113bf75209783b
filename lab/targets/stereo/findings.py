"""The verdict on a stereo run: findings with reason and remedy. A FAIL sets the exit status 4."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

import numpy as np

from lab.findings.finding import Finding, Level, finding, level_above, passed, worst_first
from lab.number_format import format_length, format_number
from lab.targets.stereo.run import StereoResults
from tracking.binocular.marker_model import MarkerImages
from tracking.binocular.pose_tracker import AMBIGUOUS

LEAST_MEASURED, GOOD_MEASURED = 0.1, 0.95  # shares of the frames, as for runs of laser spots
GOOD_PICTURES = 0.95  # share of frames with a usable picture, per camera
LARGEST_NOISE_SCALE, GOOD_NOISE_SCALE = 5.0, 1.5  # residuals over their sigmas
_ENOUGH, _FEWEST_SEEN = 4, 3  # markers of a picture that determine a pose, and frames with as many in both
LARGEST_NEES = 20.0  # per number, of poses with an error of the calibration: above, the sigmas are of no use
_MOST_NAMED = 4  # errors of the calibration in a message


def findings_of(results: StereoResults) -> tuple[Finding, ...]:
    """All findings, the most severe first."""
    found = [
        *_calibration(results),
        *_measured(results),
        *_cameras(results),
        *_together(results),
        *_clock(results),
        *_noise(results),
        *_ambiguous(results),
    ]
    return worst_first(found)


def _measured(results: StereoResults) -> Iterator[Finding]:
    total, measured = len(results.records), len(results.measured)
    share = measured / max(total, 1)
    reasons = Counter(r.tracked.reason for r in results.records if not r.measured)
    most = "; ".join(f"{reason}: {n}" for reason, n in reasons.most_common(3))
    what = f"{measured} of {total} frames have a measured pose" + (f" ({most})" if most else "")
    if not measured:
        yield finding("BP-W01", Level.FAIL, what)
    elif share < GOOD_MEASURED:
        yield finding("BP-W02", Level.FAIL if share < LEAST_MEASURED else Level.WARN, what)
    else:
        yield passed(what)


def _cameras(results: StereoResults) -> Iterator[Finding]:
    total = max(len(results.records), 1)
    for c, camera in enumerate(results.run.pair.cameras):
        missing = [r.missing[c] for r in results.records if r.missing[c]]
        if len(missing) > (1 - GOOD_PICTURES) * total:
            reason, count = Counter(missing).most_common(1)[0]
            what = f"camera {camera.name}: {len(missing)} of {total} frames have no picture ({reason}: {count})"
            yield finding("BP-W03", Level.WARN, what)
        with_picture = [r.candidates[c] for r in results.records if r.candidates[c] is not None]
        empty = sum(1 for found in with_picture if found is not None and len(found) < 3)
        if with_picture and empty > 0.5 * len(with_picture):
            what = f"camera {camera.name}: fewer than three markers in {empty} of {len(with_picture)} pictures"
            yield finding("BP-W04", Level.WARN, what)


def _together(results: StereoResults) -> Iterator[Finding]:
    """Whether the two cameras see the same moments: poses of one camera alone do not show it."""
    if not results.measured:
        return
    sees = [[r for r in results.records if _has_markers(r.candidates[c])] for c in range(2)]
    seen = [r for r in sees[0] if _has_markers(r.candidates[1])]
    if not seen and all(sees):
        names = [camera.name for camera in results.run.pair.cameras]
        spans = "; ".join(f"{n}: {own[0].frame} to {own[-1].frame}" for n, own in zip(names, sees, strict=True))
        yield finding("BP-W09", Level.FAIL, f"no frame has markers in both cameras ({spans})")
        return
    joint = sum(1 for r in seen if r.measured)
    if len(seen) >= _FEWEST_SEEN and joint < LEAST_MEASURED * len(seen):
        what = (
            f"{joint} of {len(seen)} frames with markers in both pictures have a measured pose; the others are those of"
            " a single camera"
        )
        yield finding("BP-W09", Level.FAIL, what)


def _has_markers(found: MarkerImages | None) -> bool:
    return found is not None and len(found) >= _ENOUGH


def _clock(results: StereoResults) -> Iterator[Finding]:
    clock = results.clock
    if clock is None:
        return
    offset = f"{1000 * clock.offset_s:.2f} ± {1000 * clock.sigma_s:.2f} ms"
    if clock.significant and not _is_clock(results):
        return
    if not clock.significant:
        yield passed(f"the right pictures are taken {offset} after the left ones: synchronised")
        return
    scattered = abs(clock.offset_s) <= 5 * clock.sigma_s
    what = (
        f"the offset between the two exposures scatters by {1000 * clock.jitter_s:.2f} ms"
        if scattered
        else f"the right pictures are taken {offset} after the left ones"
    )
    what += f": the residuals grow with the velocity in the picture ({clock.shift_px:.2f} px RMS)"
    yield finding("BP-W05", Level.FAIL, what)


def _calibration(results: StereoResults) -> Iterator[Finding]:
    """Errors of the pair's calibration; with a pair that states no covariance, the poses have no complete sigmas."""
    check = results.calibration
    if check is not None and check.significant and not _is_clock(results):
        several = " or ".join(
            f"{s.name} by {s.value:+.{_decimals(s.sigma)}f} ± {s.sigma:.{_decimals(s.sigma)}f} {s.unit}"
            for s in check.suspects[:_MOST_NAMED]
        )
        apart = "; this recording does not separate them" if len(check.suspects) > 1 else ""
        other = "" if check.left < GOOD_NOISE_SCALE**2 else "; it does not explain all: there is more than one error"
        what = (
            f"the markers contradict {results.run.pair_path.name}: to be corrected: {several}{apart}{other}; poses move"
            f" by {format_length(check.change_m)} RMS"
        )
        yield finding("BP-W06", Level.FAIL if check.change_sigmas**2 > LARGEST_NEES else Level.WARN, what)
    if results.run.pair.covariance is None:
        yield finding("BP-W10", Level.WARN, f"{results.run.pair_path.name} states no covariance of the calibration")


def _is_clock(results: StereoResults) -> bool:
    """Whether an offset of the clocks explains the residuals, and an error of the calibration does not."""
    clock, check = results.clock, results.calibration
    if clock is None or not clock.significant:
        return False
    return check is None or not check.significant or check.left > GOOD_NOISE_SCALE**2


def _decimals(sigma: float) -> int:
    """Decimals that show two digits of a sigma."""
    return int(np.clip(1 - np.floor(np.log10(max(sigma, 1e-9))), 0, 6))


def _noise(results: StereoResults) -> Iterator[Finding]:
    scale = results.noise_scale
    if not np.isfinite(scale):
        return
    what = f"residuals are {format_number(scale)} times as large as the stated sigmas of the markers"
    yield finding("BP-W07", level_above(scale, GOOD_NOISE_SCALE, LARGEST_NOISE_SCALE), what)


def _ambiguous(results: StereoResults) -> Iterator[Finding]:
    count = sum(1 for r in results.records if r.tracked.reason == AMBIGUOUS)
    if count > 0.05 * len(results.records):
        yield finding("BP-W08", Level.WARN, f"{count} frames have two attitudes that explain the markers")
