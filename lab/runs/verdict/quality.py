"""The verdict on a run: whether its results can be trusted, the reasons, and what to do. It sets the exit status.

A gate fails (exit status 4) where the results must not be used as they are: nothing was measured; the tracker missed
most of what the pictures show; the rig file does not describe the set-up. A recording that shows little (long
occlusions, few spots in view, a camera that stopped) has wide sigmas and does not fail, since its results are correct.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import permutations
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from lab.findings.finding import Finding, Level, Verdict, finding, level_above, sentence, verdict, worst_first
from lab.number_format import format_count, format_with_sigma
from lab.runs.verdict.run_statistics import (
    MISSED,
    CameraStatistics,
    FrameCause,
    FrameRanges,
    RunStatistics,
)
from tracking.detection.detect import limit_that_admits
from tracking.noise_estimation.averaging import LEAST_KEPT, OPEN_SHUTTER
from tracking.statuses import SpotStatus

if TYPE_CHECKING:
    from lab.runs.frames.sensor_noise import CameraNoise

# Share of the frames with enough visible spots: where the tracker missed more than half of them, it may not have
# followed the vehicle in the others either. Frames with too few spots do not count.
LEAST_MEASURED_OF_SHOWN = 0.5
# Share of all frames, whatever the reason: with fewer the run does not measure a motion. The limit is low because
# occlusions and spots outside the pictures are usual: some random solvable scenes show the pose in a third of their
# frames.
LEAST_MEASURED = 0.1
GOOD_MEASURED = 0.95  # share of all frames: a smaller one is reported with its causes
# Ratio of the residuals to the detections' sigmas (1: as stated). Used only where the model check, which distinguishes
# noise from faults, has too few frames. A sigma that is wrong by more than 5 is rarer than a wrong rig file.
LARGEST_NOISE_SCALE, GOOD_NOISE_SCALE = 5.0, 1.5
GOOD_PICTURES = 0.95  # share of frames with a usable picture, per camera
MOSTLY_EMPTY = 0.5  # share of a camera's pictures without any point of light, above which it is reported
FEW_SHOWN = 0.1  # share of the frames with enough points, below which too few points are the reason, not the prior
LONG_EMPTY = 0.05  # share of the run of an empty end of a camera's recording, above which it is reported
MOST_WRONG = 0.005  # share of the measured poses beyond 10 sigmas from the truth, up to which the run does not fail
TOO_WIDE = "BP-V21"  # a light that max_sigma_px excludes, and a spot that is never found
# Sigmas; least growth of the spots by the share of the picture before: 0.2 gives 0.15 to 0.25, 0.5 gives 0.4 to 1.2.
_SURE_SIGMAS, _OF_GROWTH = 4.0, 0.6
_SET_UP = "BP-M06"  # a mistake in the files that describe the set-up
_FEW_FOUND = 0.2  # measured share of the expected spots, below which a mostly empty camera is reported


def judge(
    statistics: RunStatistics,
    findings: Sequence[Finding] = (),
    noise_scale: float | None = None,
    noise: Mapping[str, CameraNoise] = MappingProxyType({}),
    stretch: Mapping[str, tuple[float, float]] = MappingProxyType({}),
) -> Verdict:
    """The verdict on a run.

    findings: of the model check (lab.runs.model_check.check.check_model). noise_scale: ratio of the residuals to the
    detections' sigmas; None where the model check has tested that. noise: what pictures show besides spots, by camera.
    stretch: how much longer spots are along their motion, by camera (tracking.noise_estimation.averaging).
    """
    if statistics.frames == 0:
        return _of([finding("BP-V01", Level.FAIL, "there is no frame at all")])
    given = [
        replace(f, what=f"{f.what}. {sentence(f.why).rstrip('.')}", why="") for f in findings if f.level > Level.PASS
    ]
    # A mistake of the set-up explains why nothing was found, or why the prior does not fit, and a colour mosaic why the
    # residuals do not fit the rig, and a light that is too wide why a spot is not found: they come first.
    found = [f for f in given if f.code == _SET_UP]
    found += _mosaics({name: own.mosaic for name, own in noise.items() if own.mosaic}, verdict(given))
    found += _too_wide({name: own.too_wide_px for name, own in noise.items() if own.too_wide_px}, statistics)
    found += _moved(noise)
    found += _averaging({name: own.kept for name, own in noise.items()}, stretch)
    for name in (name for name, own in noise.items() if own.interlaced):
        what = f"even and odd rows of the pictures of camera {name} show the moving spots at two places: interlaced"
        found.append(finding("BP-V23", Level.WARN, what, numbers={"camera": name}))
    if statistics.measured:
        found += _movement(statistics) + _measured(statistics) + _cameras(statistics) + _numbering(statistics)
        found += _never_on_screen(statistics)
    else:
        found += _measured(statistics)
    if noise_scale is not None:
        found += _noise_scale(noise_scale)
    found += [f for f in given if f.code != _SET_UP]
    found += _interruptions(statistics)
    if found:
        return _of(found)
    share = statistics.measured / statistics.frames
    return Verdict(
        (), f"{share:.1%} of the frames have a measured pose, and the residuals agree with the stated sigmas"
    )


def _of(found: Iterable[Finding]) -> Verdict:
    return Verdict(worst_first(found))


def against_truth(verdict: Verdict, errors: Mapping[str, Any] | None) -> Verdict:
    """The verdict with what the truth of the run says; errors: as lab.runs.verdict.score gives them."""
    measured: Mapping[str, Any] = ((errors or {}).get("pose") or {}).get("measured") or {}
    wrong = measured.get("beyond_10_sigmas", 0)
    if not wrong:
        return verdict
    what = (
        f"{wrong} of {measured['rows']} measured poses contradict the truth of the run by more than 10 of their sigmas"
        f" (median distance {measured['position_m']['median']:.3g} m, {measured['rotation_deg']['median']:.3g} deg)"
    )
    level = Level.FAIL if wrong > MOST_WRONG * measured["rows"] else Level.WARN
    numbers = {"wrong": wrong, "rows": measured["rows"]}
    return _of((finding("BP-V20", level, what, numbers=numbers), *verdict.findings))


def _mosaics(mosaics: Mapping[str, float], fit: Level) -> list[Finding]:
    """Cameras with raw pictures of a colour sensor; fit: the level of the model check, whose residuals they explain."""
    if not mosaics:
        return []
    names = " and ".join(mosaics)
    shown = f"camera {names} shows" if len(mosaics) == 1 else f"cameras {names} show"
    what = (
        f"{shown} a colour mosaic (neighbouring pixels differ by {max(mosaics.values()):.0%}): raw pictures of a colour"
        " camera move a spot's centroid by up to some tenths of a pixel"
    )
    return [finding("BP-V18", max(Level.WARN, fit), what, numbers=mosaics)]


def _moved(noise: Mapping[str, CameraNoise]) -> list[Finding]:
    """Cameras that were moved, as what stands still in their pictures shows."""
    out = []
    for name, own in noise.items():
        if not own.moved_px:
            continue
        between = None if own.motion is None else own.motion.moved_between
        when = "during the recording" if between is None else f"between frames {between[0]} and {between[1]}"
        what = f"what stands still in the pictures of camera {name} has moved by {own.moved_px:.2g} px {when}"
        numbers = {"camera": name, "moved_px": own.moved_px, "moved_between": between}
        out.append(finding("BP-V19", Level.WARN, what, variant="pictures", numbers=numbers))
    return out


def _averaging(kept: Mapping[str, float], stretch: Mapping[str, tuple[float, float]]) -> list[Finding]:
    """Cameras whose pictures are averages of successive ones."""
    shown, numbers = [], {}
    for name in dict.fromkeys((*kept, *stretch)):
        share, (growth, sigma) = kept.get(name, float("nan")), stretch.get(name, (0.0, float("inf")))
        # Texture deforms a slow spot in many pictures alike: where the noise shows no average, there is none.
        if growth - OPEN_SHUTTER > _SURE_SIGMAS * sigma and not share < LEAST_KEPT:
            sign = (
                f"spots longer along their motion by {format_with_sigma(growth, sigma)} of its square, where a shutter"
                f" that is always open gives {OPEN_SHUTTER:.2g}"
            )
        elif share > LEAST_KEPT and growth + _SURE_SIGMAS * sigma > _OF_GROWTH * min(share, 0.5):
            sign = f"neighbouring pictures differ in noise by {1 / (1 + share):.0%} of what pictures two apart do"
        else:
            continue
        shown.append(f"{name}: {sign}")
        numbers[name] = {"correlation": share, "growth": growth, "growth_sigma": sigma}
    if not shown:
        return []
    who = "the camera averages" if len(shown) == 1 else "cameras average"
    what = f"{who} successive pictures, and the spots lag behind the vehicle ({'; '.join(shown)})"
    return [finding("BP-V22", Level.WARN, what, numbers=numbers)]


def _too_wide(sigma_px: Mapping[str, float], statistics: RunStatistics) -> list[Finding]:
    """Cameras with a light that is wider than spots may be, and a spot that is labelled in no picture.

    Without any pose no spot is labelled: where another camera shows nothing, that is the reason.
    """
    out = []
    for name, sigma in sigma_px.items():
        if not statistics.measured and any(not c.points for n, c in statistics.cameras.items() if n != name):
            continue
        status = {spot: counts for (camera, spot), counts in statistics.spot_status.items() if camera == name}
        never = [spot for spot, counts in status.items() if not any(counts[s.value] for s in SpotStatus if s.measured)]
        if never:
            spots = f"spot {never[0]} is" if len(never) == 1 else f"spots {', '.join(never)} are"
            what = (
                f"camera {name} shows a light with a sigma of {sigma:.0f} px, which is wider than detect.max_sigma_px"
                f" admits and is not used, and {spots} labelled in none of its pictures;"
                f" --set detect.max_sigma_px={limit_that_admits(sigma)} admits it"
            )
            level = Level.WARN if statistics.measured else Level.FAIL
            out.append(finding(TOO_WIDE, level, what, numbers={"camera": name, "sigma_px": sigma}))
    return out


def _measured(statistics: RunStatistics) -> list[Finding]:
    """How many frames have a measured pose, and why the others do not; without any, the cameras' reasons come first."""
    measured, frames, causes = statistics.measured, statistics.frames, statistics.causes
    numbers = {"measured": measured, "frames": frames, "causes": {c.value: n for c, n in causes.items()}}
    if measured == 0:
        what = "the vehicle was never found: no frame has a measured pose"
        return [
            finding("BP-V02", Level.FAIL, what, numbers=numbers),
            *_movement(statistics),
            *_cameras(statistics),
            *_why_never(statistics),
        ]
    share, shown = measured / frames, measured / (measured + statistics.missed)
    cause = next(iter(causes), None)
    level = Level.FAIL
    if shown < LEAST_MEASURED_OF_SHOWN:
        cause = max((c for c in causes if c in MISSED), key=lambda c: causes[c])
        what = (
            f"only {shown:.0%} of the frames that show enough spots have a measured pose"
            f" (gate: {LEAST_MEASURED_OF_SHOWN:.0%})"
        )
    elif share < LEAST_MEASURED:
        what = f"only {share:.1%} of the frames have a measured pose (gate: {LEAST_MEASURED:.0%})"
    elif share < GOOD_MEASURED:
        level = Level.WARN
        what = f"{share:.1%} of the frames have a measured pose (usual: {GOOD_MEASURED:.0%} and more)"
    else:
        return []
    what += f": of the others, {_causes_text(causes)}" if causes else ""
    return [finding("BP-V03", level, what, variant="" if cause is None else cause.value, numbers=numbers)]


def _causes_text(causes: Mapping[FrameCause, int]) -> str:
    """`30 with hidden spots, 4 without a picture of some camera`."""
    return ", ".join(f"{count} {cause.meaning}" for cause, count in list(causes.items())[:3])


def _why_never(statistics: RunStatistics) -> list[Finding]:
    """Why the vehicle was never found, where all cameras show points of light (see `_cameras` for the others)."""
    if statistics.causal_measured:
        what = (
            f"the causal pass has a measured pose in {statistics.causal_measured} of {statistics.frames} frames, and"
            " the smoothing pass confirms none of them"
        )
        return [finding("BP-V11", Level.FAIL, what, numbers={"causal_measured": statistics.causal_measured})]
    if statistics.tie_text:
        what = f"the spots fit more than one pose. {sentence(statistics.tie_text).rstrip('.')}"
        return [finding("BP-V12", Level.FAIL, what, numbers=_frame_numbers(statistics.ties))]
    causes = statistics.causes
    unexplained, few = causes.get(FrameCause.UNEXPLAINED, 0), causes.get(FrameCause.FEW_POINTS, 0)
    per_frame = ", ".join(
        f"{f.points / f.pictures:.1f} per picture in camera {name}"
        for name, f in statistics.cameras.items()
        if f.pictures
    )
    numbers = {"points": {name: f.points for name, f in statistics.cameras.items()}}
    if not all(f.points for f in statistics.cameras.values()):
        return []
    if unexplained > FEW_SHOWN * statistics.frames:
        what = (
            f"{unexplained} of {statistics.frames} frames show enough points of light ({per_frame}), but no pose within"
            " the prior explains them better than false points do by chance"
        )
        return [finding("BP-V10", Level.FAIL, what, numbers=numbers)]
    if few or unexplained:
        what = (
            f"{format_count(few, 'frame')} of {statistics.frames} show fewer than the {statistics.min_spots} points of"
            f" light that a first pose needs ({per_frame})"
        )
        return [finding("BP-V09", Level.FAIL, what, numbers=numbers)]
    if causes:
        what = f"of {format_count(statistics.frames, 'frame')}, {_causes_text(causes)}"
        return [finding("BP-V03", Level.FAIL, what, variant=next(iter(causes)).value, numbers=numbers)]
    return []


def _movement(statistics: RunStatistics) -> list[Finding]:
    """Cameras that have moved during the recording: the reason for what the other findings on them say."""
    movement = statistics.moved
    if movement is not None and not movement.left_out:
        what = (
            f"from frame {movement.frame} on, spots are not where the poses put them, and the pictures show as many"
            " points elsewhere: a camera, a screen or a laser has moved, or these poses are wrong"
        )
        numbers: dict[str, Any] = {"frame": movement.frame, "camera": movement.camera}
        return [finding("BP-V19", Level.FAIL, what, numbers=numbers)]
    out = []
    for name, camera in statistics.cameras.items():
        if movement is not None and movement.camera == name:
            what = (
                f"camera {name} or its screen has moved during the recording, before frame {movement.frame}: its"
                " pictures from that frame on are not used"
            )
        elif movement is None and len(moved := camera.moved):
            where = f"{format_count(len(moved), 'frame')} ({moved.as_text()})"
            what = (
                f"camera {name}: in {where} its spots are not where the poses put them: the camera or its screen has"
                " moved during the recording"
            )
        else:
            continue
        out.append(finding("BP-V19", Level.WARN, what, numbers={"camera": name, **camera.as_mapping()}))
    return out


def _cameras(statistics: RunStatistics) -> list[Finding]:
    """Cameras without pictures, or without points of light in them."""
    out: list[Finding] = []
    left_out = statistics.moved.camera if statistics.moved is not None and statistics.moved.left_out else ""
    for name, camera in statistics.cameras.items():
        numbers = {"camera": name, **camera.as_mapping()}
        if name != left_out:
            out += _pictures(name, camera, statistics)
        if not camera.pictures:
            continue
        empty = camera.empty / camera.pictures
        never = statistics.measured == 0 and empty > MOSTLY_EMPTY
        unlit = empty > MOSTLY_EMPTY and camera.expected > 0 and camera.found < _FEW_FOUND * camera.expected
        if never or unlit:
            which = "any" if camera.empty == camera.pictures else f"{camera.empty}"
            what = f"camera {name}: nothing was detected in {which} of its {camera.pictures} pictures"
            level = Level.FAIL if statistics.measured == 0 else Level.WARN
            out.append(finding("BP-V08", level, what, numbers=numbers))
        elif camera.expected_at_end and camera.empty_at_end > LONG_EMPTY * statistics.frames:
            what = (
                f"camera {name}: nothing was detected in its last {camera.empty_at_end} pictures, where the pose puts"
                " spots inside them"
            )
            out.append(finding("BP-V08", Level.WARN, what, numbers=numbers))
    return out


def _numbering(statistics: RunStatistics) -> list[Finding]:
    """Two cameras of which one shows nothing in its first pictures, the other nothing in as many of its last ones."""
    out = []
    for (a, late), (b, early) in permutations(statistics.cameras.items(), 2):
        shift = late.empty_at_start
        if not (late.expected_at_start and early.expected_at_end) or late.empty_at_end or early.empty_at_start:
            continue
        if shift == early.empty_at_end:
            what = (
                f"camera {a} shows nothing in its first {format_count(shift, 'frame')}, and camera {b} nothing in its"
                f" last {format_count(shift, 'frame')}, where the poses put spots inside: their frames may be numbered"
                f" from {shift} and from 0"
            )
            numbers = {"cameras": [a, b], "frames": shift}
            out.append(finding("BP-V05", Level.WARN, what, variant="numbers", numbers=numbers))
    return out


def _never_on_screen(statistics: RunStatistics) -> list[Finding]:
    """Spots whose beams miss their screens in all frames with a pose."""
    status: dict[str, set[str]] = {}
    for (_, spot), counts in statistics.spot_status.items():
        status.setdefault(spot, set()).update(word for word, count in counts.items() if count)
    never = [spot for spot, words in status.items() if words - {SpotStatus.LOST.value} == {SpotStatus.OFF_SCREEN.value}]
    if not never:
        return []
    which = f"spot {never[0]} hits its" if len(never) == 1 else f"spots {', '.join(never)} hit their"
    what = f"{which} screen in no frame: the rig is wrong in this, or the spot is none of this recording"
    return [finding("BP-V24", Level.WARN, what, numbers={"spots": never})]


def _pictures(name: str, camera: CameraStatistics, statistics: RunStatistics) -> list[Finding]:
    """A camera without pictures: none at all, none at the start or the end, or some missing in between."""
    missing, numbers = camera.missing, {"camera": name, "missing": [list(r) for r in camera.missing]}
    if not len(missing):
        return []
    if not camera.pictures:
        level = Level.FAIL if statistics.measured == 0 else Level.WARN
        what = f"camera {name} has no usable picture at all{_why_missing(camera)}"
        return [finding("BP-V04", level, what, numbers=numbers)]
    out = {}
    first, last = missing.ranges[0], missing.ranges[-1]
    scattered = len(missing)
    if first[0] == statistics.first_frame:
        count = first[1] - first[0] + 1
        scattered -= count
        out["BP-V05"] = f"starts late: it has no picture of the first {format_count(count, 'frame')}"
    if last[1] == statistics.last_frame:
        count = last[1] - last[0] + 1
        scattered -= count
        out["BP-V06"] = (
            f"stopped before the end: it has no picture from frame {last[0]} on ({format_count(count, 'frame')})"
        )
    if scattered > (1 - GOOD_PICTURES) * statistics.frames:
        out["BP-V07"] = f"has no usable picture in {scattered} of {statistics.frames} frames{_why_missing(camera)}"
    return [finding(code, Level.WARN, f"camera {name} {what}", numbers=numbers) for code, what in out.items()]


def _why_missing(camera: CameraStatistics) -> str:
    """The most frequent reason for a missing picture, in brackets; empty where none is known."""
    return "".join(f" ({reason})" for reason, _ in camera.missing_reasons.most_common(1))


def _noise_scale(noise_scale: float) -> list[Finding]:
    level = level_above(noise_scale, GOOD_NOISE_SCALE, LARGEST_NOISE_SCALE)
    if level is Level.PASS:
        return []
    what = f"the spots lie {noise_scale:.1f} times as far from the fitted pose as their sigmas allow"
    if level is Level.FAIL:
        what += f" (gate: {LARGEST_NOISE_SCALE:g}): the rig file does not describe this set-up"
    else:
        what += "; the sigmas of the poses are widened by this factor"
    return [finding("BP-V16", level, what, numbers={"noise_scale": noise_scale})]


def _interruptions(statistics: RunStatistics) -> list[Finding]:
    """Ties, losses, contradictions and invalid covariances in a run in which the vehicle was found."""
    out = []
    if statistics.measured and statistics.ties:
        which = "frame" if len(statistics.ties) == 1 else "frames"
        candidates = sentence(statistics.tie_text).rstrip(".")
        what = f"{which} {statistics.ties.as_text()} could be explained in more than one way. {candidates}"
        out.append(finding("BP-V12", Level.WARN, what, numbers=_frame_numbers(statistics.ties)))
    if statistics.measured and len(statistics.lost):
        never = statistics.lost.ranges[-1][1] == statistics.last_frame
        after = "it was not found again" if never else "it was found again each time"
        which = f"{format_count(len(statistics.lost), 'frame')} ({statistics.lost.as_text()})"
        what = f"the vehicle was lost in {which}; {after}"
        numbers = {**_frame_numbers(statistics.lost), "found_again": statistics.found_again}
        out.append(finding("BP-V13", Level.WARN, what, numbers=numbers))
    for ranges, against in ((statistics.own_spots, "their own spots"), (statistics.causal, "the causal pass")):
        if len(ranges):
            what = (
                f"the poses of {format_count(len(ranges), 'frame')} ({ranges.as_text()}) contradict {against}: they are"
                " reported as predicted, with wider sigmas"
            )
            out.append(finding("BP-V14", Level.WARN, what, numbers=_frame_numbers(ranges)))
    if len(statistics.invalid):
        which = f"{format_count(len(statistics.invalid), 'frame')} ({statistics.invalid.as_text()})"
        what = f"covariances of {which} are not positive definite"
        out.append(finding("BP-V15", Level.WARN, what, numbers=_frame_numbers(statistics.invalid)))
    return out


def _frame_numbers(ranges: FrameRanges) -> dict[str, Any]:
    return {"frames": [list(r) for r in ranges]}
