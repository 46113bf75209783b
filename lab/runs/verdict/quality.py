"""The verdict on a run: whether its results can be trusted, the reasons, and what to do. It sets the exit status.

A gate fails (exit status 4) where the results must not be used as they are: nothing was measured; the tracker missed
most of what the pictures show; the rig file does not describe the set-up. A recording that shows little (long
occlusions, few spots in view, a camera that stopped) has wide sigmas and does not fail, since its results are correct.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Literal

from lab.errors import QUALITY_GATE_FAILED
from lab.findings.finding import Finding, Level
from lab.runs.verdict.run_statistics import MISSED, CameraStatistics, Cause, RunStatistics
from lab.runs.verdict.verdict_reasons import REMEDIES, REMEDIES_BY_CAUSE, ReasonKind, VerdictReason

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
LONG_EMPTY = (
    0.05  # duration, as a share of the run, of an empty end of a camera's recording, above which it is reported
)
MOST_WRONG = 0.005  # share of the measured poses beyond 10 sigmas from the truth, up to which the run does not fail
LEAST_DISPLACED = 5  # frames in which none of a camera's spots fits the others' pose, from which on it is reported
_FEW_FOUND = 0.2  # measured share of the expected spots, below which a mostly empty camera is reported


@dataclass(frozen=True, slots=True)
class Verdict:
    """pass; check: usable, but something needs a check by the user; fail: a quality gate failed."""

    status: Literal["pass", "check", "fail"]
    texts: tuple[str, ...]
    reasons: tuple[VerdictReason, ...] = ()  # in the order of the texts; a run that passes has none

    @property
    def exit_status(self) -> int:
        """The command's exit status, section 5 of the files' contract."""
        return QUALITY_GATE_FAILED if self.status == "fail" else 0

    @property
    def remedy(self) -> str:
        """The remedy of the first failure; empty where nothing failed."""
        remedies = [r.remedy for r in self.reasons if r.fails and r.kind is not ReasonKind.NEVER_FOUND and r.remedy]
        return remedies[0] if remedies else ""


def judge(
    statistics: RunStatistics,
    findings: Sequence[Finding] = (),
    noise_scale: float | None = None,
    mosaics: Mapping[str, float] = MappingProxyType({}),
) -> Verdict:
    """The verdict on a run.

    findings: of the model check (lab.runs.model_check.check.check_model): a warning leads to "check", a failure to
    "fail". noise_scale: ratio of the residuals to the detections' sigmas; None where the model check has tested that.
    mosaics: contrast of the colour mosaic by camera, of cameras whose pictures show one.
    """
    if statistics.frames == 0:
        nothing = VerdictReason(ReasonKind.NO_FRAMES, True, "there is no frame at all", REMEDIES[ReasonKind.NO_FRAMES])
        return Verdict("fail", (nothing.what,), (nothing,))
    found = _measured(statistics)
    if statistics.measured:
        found += _cameras(statistics)
    if noise_scale is not None:
        found += _noise_scale(noise_scale)
    for finding in findings:
        if finding.level > Level.PASS:
            fails = finding.level == Level.FAIL
            what = f"{finding.what}; {finding.why}"
            found.append(VerdictReason(ReasonKind.MODEL, fails, what, finding.remedy, code=finding.code))
    found += _mosaics(mosaics)
    found += _interruptions(statistics)
    found.sort(key=lambda e: not e.fails)  # stable: failures first
    if found:
        status: Literal["check", "fail"] = "fail" if found[0].fails else "check"
        return Verdict(status, tuple(e.what for e in found), tuple(found))
    share = statistics.measured / statistics.frames
    return Verdict(
        "pass", (f"{share:.1%} of the frames have a measured pose, and the residuals agree with the stated sigmas",)
    )


def against_truth(verdict: Verdict, errors: Mapping[str, Any] | None) -> Verdict:
    """The verdict with what the truth of the run says; errors: as lab.runs.score.score gives them."""
    measured: Mapping[str, Any] = ((errors or {}).get("pose") or {}).get("measured") or {}
    wrong = measured.get("beyond_10_sigmas", 0)
    if not wrong:
        return verdict
    what = (
        f"{wrong} of {measured['rows']} measured poses contradict the truth of the run by more than 10 of their sigmas"
        f" (median distance {measured['position_m']['median']:.3g} m, {measured['rotation_deg']['median']:.3g} deg)"
    )
    fails = wrong > MOST_WRONG * measured["rows"]
    numbers = {"wrong": wrong, "rows": measured["rows"]}
    reason = VerdictReason(ReasonKind.TRUTH, fails, what, REMEDIES[ReasonKind.TRUTH], numbers)
    reasons = sorted((reason, *verdict.reasons), key=lambda e: not e.fails)
    return Verdict("fail" if reasons[0].fails else "check", tuple(e.what for e in reasons), tuple(reasons))


def _mosaics(mosaics: Mapping[str, float]) -> list[VerdictReason]:
    """Cameras with raw pictures of a colour sensor. No residual shows their errors, since all spots have them."""
    if not mosaics:
        return []
    names = " and ".join(mosaics)
    shown = f"camera {names} shows" if len(mosaics) == 1 else f"cameras {names} show"
    what = (
        f"{shown} a colour mosaic (neighbouring pixels differ by {max(mosaics.values()):.0%}): raw pictures of a colour"
        " camera move a spot's centroid by up to some tenths of a pixel"
    )
    return [VerdictReason(ReasonKind.COLOUR_MOSAIC, False, what, REMEDIES[ReasonKind.COLOUR_MOSAIC], dict(mosaics))]


def _measured(statistics: RunStatistics) -> list[VerdictReason]:
    """How many frames have a measured pose, and why the others do not; without any, the cameras' reasons come first."""
    measured, frames, causes = statistics.measured, statistics.frames, statistics.causes
    numbers = {"measured": measured, "frames": frames, "causes": {c.value: n for c, n in causes.items()}}
    if measured == 0:
        what = "the vehicle was never found: no frame has a measured pose"
        never = VerdictReason(ReasonKind.NEVER_FOUND, True, what, REMEDIES[ReasonKind.NEVER_FOUND], numbers)
        return [never, *_cameras(statistics), *_why_never(statistics)]
    share, shown = measured / frames, measured / (measured + statistics.missed)
    remedy = REMEDIES_BY_CAUSE[next(iter(causes))] if causes else ""
    why = f": of the others, {_causes_text(causes)}" if causes else ""
    if shown < LEAST_MEASURED_OF_SHOWN:
        worst = max((c for c in causes if c in MISSED), key=lambda c: causes[c])
        what = (
            f"only {shown:.0%} of the frames that show enough spots have a measured pose"
            f" (gate: {LEAST_MEASURED_OF_SHOWN:.0%}){why}"
        )
        return [VerdictReason(ReasonKind.FEW_MEASURED, True, what, REMEDIES_BY_CAUSE[worst], numbers)]
    if share < LEAST_MEASURED:
        what = f"only {share:.1%} of the frames have a measured pose (gate: {LEAST_MEASURED:.0%}){why}"
        return [VerdictReason(ReasonKind.FEW_MEASURED, True, what, remedy, numbers)]
    if share < GOOD_MEASURED:
        what = f"{share:.1%} of the frames have a measured pose (usual: {GOOD_MEASURED:.0%} and more){why}"
        return [VerdictReason(ReasonKind.FEW_MEASURED, False, what, remedy, numbers)]
    return []


def _causes_text(causes: Mapping[Cause, int], most: int = 3) -> str:
    """`30 with hidden spots, 4 without a picture of some camera`."""
    return ", ".join(f"{count} {cause.meaning}" for cause, count in list(causes.items())[:most])


def _why_never(statistics: RunStatistics) -> list[VerdictReason]:
    """Why the vehicle was never found, where all cameras show points of light (see `_cameras` for the others)."""
    if statistics.causal_measured:
        what = (
            f"the causal pass has a measured pose in {statistics.causal_measured} of {statistics.frames} frames, and"
            " the smoothing pass confirms none of them"
        )
        numbers = {"causal_measured": statistics.causal_measured}
        return [VerdictReason(ReasonKind.NOT_CONFIRMED, True, what, REMEDIES[ReasonKind.NOT_CONFIRMED], numbers)]
    if statistics.tie_text:
        what = f"the spots fit more than one pose: {statistics.tie_text}"
        return [
            VerdictReason(
                ReasonKind.AMBIGUOUS,
                True,
                what,
                REMEDIES[ReasonKind.AMBIGUOUS],
                {"frames": [list(r) for r in statistics.ties]},
            )
        ]
    causes = statistics.causes
    unexplained, few = causes.get(Cause.UNEXPLAINED, 0), causes.get(Cause.FEW_POINTS, 0)
    per_frame = ", ".join(
        f"{f.points / f.pictures:.1f} per picture in camera {name}"
        for name, f in statistics.cameras.items()
        if f.pictures
    )
    points = {name: f.points for name, f in statistics.cameras.items()}
    if not all(f.points for f in statistics.cameras.values()):
        return []
    if unexplained > FEW_SHOWN * statistics.frames:
        what = (
            f"{unexplained} of {statistics.frames} frames show enough points of light ({per_frame}), but no pose within"
            " the prior explains them"
        )
        return [
            VerdictReason(ReasonKind.NOT_ACQUIRED, True, what, REMEDIES[ReasonKind.NOT_ACQUIRED], {"points": points})
        ]
    if few or unexplained:
        what = (
            f"{_frames(few)} of {statistics.frames} show fewer than the {statistics.min_spots} points of light that a"
            f" first pose needs ({per_frame})"
        )
        return [VerdictReason(ReasonKind.FEW_POINTS, True, what, REMEDIES[ReasonKind.FEW_POINTS], {"points": points})]
    if causes:
        what = f"of {_frames(statistics.frames)}, {_causes_text(causes)}"
        return [
            VerdictReason(
                ReasonKind.FEW_MEASURED, True, what, REMEDIES_BY_CAUSE[next(iter(causes))], {"points": points}
            )
        ]
    return []


def _cameras(statistics: RunStatistics) -> list[VerdictReason]:
    """Cameras without pictures, or without points of light in them."""
    out = []
    for name, camera in statistics.cameras.items():
        out += _pictures(name, camera, statistics)
        if len(camera.displaced) >= LEAST_DISPLACED:
            what = (
                f"camera {name}: in {_frames(len(camera.displaced))} ({camera.displaced.as_text()}) none of its spots"
                " is where the other cameras put it: the camera or its screen has moved during the recording"
            )
            numbers = {"camera": name, **camera.as_mapping()}
            out.append(VerdictReason(ReasonKind.CAMERA_MOVED, False, what, REMEDIES[ReasonKind.CAMERA_MOVED], numbers))
        if not camera.pictures:
            continue
        empty = camera.empty / camera.pictures
        never = statistics.measured == 0 and empty > MOSTLY_EMPTY
        unlit = empty > MOSTLY_EMPTY and camera.expected > 0 and camera.found < _FEW_FOUND * camera.expected
        if never or unlit:
            which = "any" if camera.empty == camera.pictures else f"{camera.empty}"
            what = f"camera {name}: nothing was detected in {which} of its {camera.pictures} pictures"
            numbers = {"camera": name, **camera.as_mapping()}
            out.append(
                VerdictReason(
                    ReasonKind.NOTHING_DETECTED,
                    statistics.measured == 0,
                    what,
                    REMEDIES[ReasonKind.NOTHING_DETECTED],
                    numbers,
                )
            )
        elif camera.expected_at_end and camera.empty_at_end > LONG_EMPTY * statistics.frames:
            what = (
                f"camera {name}: nothing was detected in its last {camera.empty_at_end} pictures, where the pose puts"
                " spots inside them"
            )
            numbers = {"camera": name, **camera.as_mapping()}
            out.append(
                VerdictReason(ReasonKind.NOTHING_DETECTED, False, what, REMEDIES[ReasonKind.NOTHING_DETECTED], numbers)
            )
    return out


def _pictures(name: str, camera: CameraStatistics, statistics: RunStatistics) -> list[VerdictReason]:
    """A camera without pictures: none at all, none at the start or the end, or some missing in between."""
    missing, numbers = camera.missing, {"camera": name, "missing": [list(r) for r in camera.missing]}
    if not len(missing):
        return []

    def reason(kind: ReasonKind, what: str, fails: bool = False) -> VerdictReason:
        return VerdictReason(kind, fails, f"camera {name} {what}", REMEDIES[kind], numbers)

    if not camera.pictures:
        return [reason(ReasonKind.NO_PICTURES, "has no usable picture at all", statistics.measured == 0)]
    out = []
    first, last = missing.ranges[0], missing.ranges[-1]
    scattered = len(missing)
    if first[0] == statistics.first_frame:
        count = first[1] - first[0] + 1
        scattered -= count
        out.append(reason(ReasonKind.CAMERA_LATE, f"starts late: it has no picture of the first {_frames(count)}"))
    if last[1] == statistics.last_frame:
        count = last[1] - last[0] + 1
        scattered -= count
        out.append(
            reason(
                ReasonKind.CAMERA_STOPPED,
                f"stopped before the end: it has no picture from frame {last[0]} on ({_frames(count)})",
            )
        )
    if scattered > (1 - GOOD_PICTURES) * statistics.frames:
        out.append(
            reason(ReasonKind.MISSING_PICTURES, f"has no usable picture in {scattered} of {statistics.frames} frames")
        )
    return out


def _noise_scale(noise_scale: float) -> list[VerdictReason]:
    numbers = {"noise_scale": noise_scale}
    if noise_scale > LARGEST_NOISE_SCALE:
        what = (
            f"the spots lie {noise_scale:.1f} times as far from the fitted pose as their sigmas allow (gate:"
            f" {LARGEST_NOISE_SCALE:g}): the rig file does not describe this set-up"
        )
        return [VerdictReason(ReasonKind.NOISE_SCALE, True, what, REMEDIES[ReasonKind.NOISE_SCALE], numbers)]
    if noise_scale > GOOD_NOISE_SCALE:
        what = (
            f"the spots lie {noise_scale:.1f} times as far from the fitted pose as their sigmas allow; the sigmas of"
            " the poses are widened by this factor"
        )
        return [VerdictReason(ReasonKind.NOISE_SCALE, False, what, REMEDIES[ReasonKind.NOISE_SCALE], numbers)]
    return []


def _interruptions(statistics: RunStatistics) -> list[VerdictReason]:
    """Ties, losses, contradictions and invalid covariances in a run in which the vehicle was found."""
    out = []
    if statistics.measured and statistics.ties:
        which = "frame" if len(statistics.ties) == 1 else "frames"
        what = f"{which} {statistics.ties.as_text()} could be explained in more than one way: {statistics.tie_text}"
        numbers: dict[str, Any] = {"frames": [list(r) for r in statistics.ties]}
        out.append(VerdictReason(ReasonKind.AMBIGUOUS, False, what, REMEDIES[ReasonKind.AMBIGUOUS], numbers))
    if statistics.measured and len(statistics.lost):
        never = statistics.lost.ranges[-1][1] == statistics.last_frame
        after = "it was not found again" if never else "it was found again each time"
        what = f"the vehicle was lost in {_frames(len(statistics.lost))} ({statistics.lost.as_text()}); {after}"
        numbers = {"frames": [list(r) for r in statistics.lost], "found_again": statistics.found_again}
        out.append(VerdictReason(ReasonKind.LOST, False, what, REMEDIES[ReasonKind.LOST], numbers))
    for ranges, against in ((statistics.own_spots, "their own spots"), (statistics.causal, "the causal pass")):
        if len(ranges):
            what = (
                f"the poses of {_frames(len(ranges))} ({ranges.as_text()}) contradict {against}: they are reported as"
                " predicted, with wider sigmas"
            )
            numbers = {"frames": [list(r) for r in ranges]}
            out.append(
                VerdictReason(ReasonKind.CONTRADICTION, False, what, REMEDIES[ReasonKind.CONTRADICTION], numbers)
            )
    if len(statistics.invalid):
        which = f"{_frames(len(statistics.invalid))} ({statistics.invalid.as_text()})"
        what = f"covariances of {which} are not positive definite"
        numbers = {"frames": [list(r) for r in statistics.invalid]}
        out.append(VerdictReason(ReasonKind.INTERNAL, False, what, REMEDIES[ReasonKind.INTERNAL], numbers))
    return out


def _frames(count: int) -> str:
    return f"{count} frame{'s' if count != 1 else ''}"
