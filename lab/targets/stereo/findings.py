"""The verdict on a stereo run: findings with reason and remedy. A FAIL sets the exit status 4."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

import numpy as np

from lab.findings.finding import Finding, Level
from lab.number_format import format_number
from lab.targets.stereo.run import StereoResults
from tracking.binocular.marker_model import MarkerImages
from tracking.binocular.pose_tracker import AMBIGUOUS

LEAST_MEASURED, GOOD_MEASURED = 0.1, 0.95  # shares of the frames, as for runs of laser spots
GOOD_PICTURES = 0.95  # share of frames with a usable picture, per camera
LARGEST_NOISE_SCALE, GOOD_NOISE_SCALE = 5.0, 1.5  # residuals over their sigmas
_ENOUGH, _FEWEST_SEEN = 4, 3  # markers of a picture that determine a pose, and frames with as many in both
MOVED_SIGMAS, MOVED_PX = 6.0, 0.1  # rotation of the right camera since the calibration


def findings_of(results: StereoResults) -> tuple[Finding, ...]:
    """All findings, the most severe first."""
    found = [
        *_measured(results),
        *_cameras(results),
        *_together(results),
        *_clock(results),
        *_moved(results),
        *_noise(results),
        *_ambiguous(results),
    ]
    return tuple(sorted(found, key=lambda f: -f.level))


def _measured(results: StereoResults) -> Iterator[Finding]:
    total, measured = len(results.records), len(results.measured)
    share = measured / max(total, 1)
    reasons = Counter(r.tracked.reason for r in results.records if not r.measured)
    most = "; ".join(f"{reason}: {n}" for reason, n in reasons.most_common(3))
    what = f"{measured} of {total} frames have a measured pose" + (f" ({most})" if most else "")
    if not measured:
        yield Finding(
            Level.FAIL,
            what,
            "There is no result.",
            "Look at the annotated pictures: are the markers found in both? If not, adapt the colours in run.yaml. If"
            " they are, check the positions of the markers and the order of the cameras.",
            code="BP-W01",
        )
    elif share < GOOD_MEASURED:
        level = Level.FAIL if share < LEAST_MEASURED else Level.WARN
        why = "The other frames are predicted or lost; measured ones are not affected."
        yield Finding(level, what, why, "Treat the most frequent reason first.", code="BP-W02")
    else:
        yield Finding(Level.PASS, what)


def _cameras(results: StereoResults) -> Iterator[Finding]:
    total = max(len(results.records), 1)
    for c, camera in enumerate(results.run.pair.cameras):
        missing = [r.missing[c] for r in results.records if r.missing[c]]
        if len(missing) > (1 - GOOD_PICTURES) * total:
            reason, count = Counter(missing).most_common(1)[0]
            yield Finding(
                Level.WARN,
                f"camera {camera.name}: {len(missing)} of {total} frames have no picture ({reason}: {count})",
                "Poses of these frames rest on the other camera alone, with larger sigmas.",
                "Check the camera's disk, cable and trigger.",
                code="BP-W03",
            )
        with_picture = [r.candidates[c] for r in results.records if r.candidates[c] is not None]
        empty = sum(1 for found in with_picture if found is not None and len(found) < 3)
        if with_picture and empty > 0.5 * len(with_picture):
            yield Finding(
                Level.WARN,
                f"camera {camera.name}: fewer than three markers in {empty} of {len(with_picture)} pictures",
                "This camera hardly contributes: the distance is that of a single camera.",
                "Look at its pictures: exposure, focus, colours in run.yaml, view not blocked.",
                code="BP-W04",
            )


def _together(results: StereoResults) -> Iterator[Finding]:
    """Whether the two cameras see the same moments: poses of one camera alone do not show it."""
    if not results.measured:
        return
    sees = [[r for r in results.records if _has_markers(r.candidates[c])] for c in range(2)]
    seen = [r for r in sees[0] if _has_markers(r.candidates[1])]
    if not seen and all(sees):
        names = [camera.name for camera in results.run.pair.cameras]
        spans = "; ".join(f"{n}: {own[0].frame} to {own[-1].frame}" for n, own in zip(names, sees, strict=True))
        yield Finding(
            Level.FAIL,
            f"no frame has markers in both cameras ({spans})",
            "All poses are those of a single camera.",
            "Give pictures that are taken at the same time the same number.",
            code="BP-W09",
        )
        return
    joint = sum(1 for r in seen if r.measured)
    if len(seen) >= _FEWEST_SEEN and joint < LEAST_MEASURED * len(seen):
        yield Finding(
            Level.FAIL,
            f"{joint} of {len(seen)} frames with markers in both pictures have a measured pose; the others are those of"
            " a single camera",
            "The two cameras contradict each other.",
            "Check that pictures of the same time have the same number, which camera is which, and the calibration.",
            code="BP-W09",
        )


def _has_markers(found: MarkerImages | None) -> bool:
    return found is not None and len(found) >= _ENOUGH


def _clock(results: StereoResults) -> Iterator[Finding]:
    clock = results.clock
    if clock is None:
        return
    offset = f"{1000 * clock.offset_s:.2f} ± {1000 * clock.sigma_s:.2f} ms"
    if not clock.significant:
        yield Finding(Level.PASS, f"the right pictures are taken {offset} after the left ones: synchronised")
        return
    scattered = abs(clock.offset_s) <= 5 * clock.sigma_s
    what = (
        f"the offset between the two exposures scatters by {1000 * clock.jitter_s:.2f} ms"
        if scattered
        else f"the right pictures are taken {offset} after the left ones"
    )
    yield Finding(
        Level.FAIL,
        f"{what}: the residuals grow with the velocity in the picture ({clock.shift_px:.2f} px RMS)",
        "The distance is wrong by more than its sigma where the target moves sideways.",
        "Trigger both cameras with one signal, or repair dropped frames in one of them.",
        code="BP-W05",
    )


def _moved(results: StereoResults) -> Iterator[Finding]:
    clock = results.clock
    if clock is None or clock.significant:
        return
    angle = float(np.linalg.norm(clock.rotation_rad))
    sigmas = float(np.max(np.abs(clock.rotation_rad) / clock.rotation_sigma_rad))
    covered = results.run.pair.covariance
    shift = angle * float(results.run.pair.cameras[1].matrix[0, 0])
    if sigmas < MOVED_SIGMAS or shift < MOVED_PX:
        return
    yield Finding(
        Level.WARN,
        f"the right camera appears turned by {np.rad2deg(angle):.3f} deg ({shift:.2f} px) against the calibration",
        "Distances have a systematic error" + (" beyond the stated sigmas." if covered is None else "."),
        "Check the mounts, and calibrate the pair again with `beampose calibrate pair`.",
        code="BP-W06",
    )


def _noise(results: StereoResults) -> Iterator[Finding]:
    scale = results.noise_scale
    if not np.isfinite(scale):
        return
    what = f"residuals are {format_number(scale)} times as large as the stated sigmas of the markers"
    if scale <= GOOD_NOISE_SCALE:
        yield Finding(Level.PASS, what)
        return
    yield Finding(
        Level.FAIL if scale > LARGEST_NOISE_SCALE else Level.WARN,
        what,
        "The calibration, the positions of the markers or the stated sigmas are wrong; poses are less accurate than"
        " stated.",
        "Check the marker positions in run.yaml (and state their `sigma_m`), then the calibration of the pair.",
        code="BP-W07",
    )


def _ambiguous(results: StereoResults) -> Iterator[Finding]:
    count = sum(1 for r in results.records if r.tracked.reason == AMBIGUOUS)
    if count > 0.05 * len(results.records):
        yield Finding(
            Level.WARN,
            f"{count} frames have two attitudes that explain the markers",
            "A flat target far away looks the same with its normal reflected at the line of sight.",
            "Mount some markers in front of the others, or use the frames from a shorter distance.",
            code="BP-W08",
        )
