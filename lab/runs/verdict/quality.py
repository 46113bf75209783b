"""The verdict on a run: whether its numbers can be trusted, why not, and what to do. Exit status and report follow it.

A gate fails (exit status 4) where the results must not be used as they are: nothing was measured; the tracker missed
most of what the pictures show; the rig file does not describe the set-up. A recording that shows little (long
occlusions, few spots in view, a camera that stopped) is reported with wide sigmas and does not fail: its numbers hold.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from calibration.findings import Finding, Level
from lab.errors import QUALITY_GATE_FAILED
from lab.runs.verdict.evidence import REMEDIES, REMEDIES_BY_CAUSE, Kind, VerdictReason
from lab.runs.verdict.run_facts import MISSED, CameraFacts, Cause, RunFacts

# Of the frames that show enough to be measured: where the tracker missed more than half of them, it is not known
# whether it followed the vehicle in the others. Frames that do not show enough do not count.
LEAST_MEASURED_OF_SHOWN = 0.5
# Of all frames, whatever the reason: with fewer the run is no measurement of a motion. Not more, since hiding and
# leaving the pictures are usual: of random solvable scenes some show the pose in a third of their frames.
LEAST_MEASURED = 0.1
GOOD_MEASURED = 0.95  # of all frames: fewer are mentioned with their causes
# Residuals against what the detections' sigmas allow (1: just that); only where the model check, which tells noise from
# faults, has too few frames. 5: a sigma misjudged by more is rarer than a wrong rig file.
MOST_MISFIT, GOOD_MISFIT = 5.0, 1.5
GOOD_PICTURES = 0.95  # share of frames with a usable picture, per camera
MOSTLY_EMPTY = 0.5  # share of a camera's pictures without any point of light, from which it is mentioned
FEW_SHOWN = 0.1  # share of the frames with enough points, below which too few points are the reason, not the prior
LONG_EMPTY = 0.05  # share of the run at whose end a camera shows nothing where it should, from which it is mentioned
_FEW_FOUND = 0.2  # of the spots expected in a camera that is mostly empty: a camera that should see and does not


@dataclass(frozen=True, slots=True)
class Verdict:
    """pass; check: usable, but something wants looking at; fail: a quality gate failed."""

    status: Literal["pass", "check", "fail"]
    reasons: tuple[str, ...]
    evidence: tuple[VerdictReason, ...] = ()  # in the order of the reasons; a run that passes has none

    @property
    def exit_status(self) -> int:
        """The command's exit status, section 5 of the files' contract."""
        return QUALITY_GATE_FAILED if self.status == "fail" else 0

    @property
    def remedy(self) -> str:
        """What to do about the first failure; empty where nothing failed."""
        said = [e.remedy for e in self.evidence if e.fails and e.kind is not Kind.NEVER_FOUND and e.remedy]
        return said[0] if said else ""


def judge(facts: RunFacts, findings: Sequence[Finding] = (), misfit: float | None = None) -> Verdict:
    """The verdict on a run.

    findings: of the model check (lab.runs.model_check.check.check_model): what it warns of is a doubt, what it fails is
    a failure. misfit: the residuals over what the detections' sigmas allow; None where the model check has tested that.
    """
    if facts.frames == 0:
        nothing = VerdictReason(Kind.NO_FRAMES, True, "there is no frame at all", REMEDIES[Kind.NO_FRAMES])
        return Verdict("fail", (nothing.what,), (nothing,))
    found = _measured(facts)
    if facts.measured:
        found += _cameras(facts)
    if misfit is not None:
        found += _misfit(misfit)
    for finding in findings:
        if finding.level > Level.PASS:
            fails = finding.level == Level.FAIL
            found.append(VerdictReason(Kind.MODEL, fails, f"{finding.what}; {finding.why}", finding.remedy))
    found += _interruptions(facts)
    found.sort(key=lambda e: not e.fails)  # stable: failures first
    if found:
        status: Literal["check", "fail"] = "fail" if found[0].fails else "check"
        return Verdict(status, tuple(e.what for e in found), tuple(found))
    share = facts.measured / facts.frames
    return Verdict(
        "pass", (f"{share:.1%} of the frames have a measured pose, and the residuals are what the sigmas allow",)
    )


def _measured(facts: RunFacts) -> list[VerdictReason]:
    """How many frames have a measured pose, and why the others do not; of no frame the cameras come first."""
    measured, frames, causes = facts.measured, facts.frames, facts.causes
    numbers = {"measured": measured, "frames": frames, "causes": {c.value: n for c, n in causes.items()}}
    if measured == 0:
        what = "the vehicle was never found: no frame has a measured pose"
        never = VerdictReason(Kind.NEVER_FOUND, True, what, REMEDIES[Kind.NEVER_FOUND], numbers)
        return [never, *_cameras(facts), *_why_never(facts)]
    share, shown = measured / frames, measured / (measured + facts.missed)
    remedy = REMEDIES_BY_CAUSE[next(iter(causes))] if causes else ""
    why = f": of the others, {_in_words(causes)}" if causes else ""
    if shown < LEAST_MEASURED_OF_SHOWN:
        worst = max((c for c in causes if c in MISSED), key=lambda c: causes[c])
        what = (
            f"only {shown:.0%} of the frames that show enough spots have a measured pose"
            f" (gate: {LEAST_MEASURED_OF_SHOWN:.0%}){why}"
        )
        return [VerdictReason(Kind.FEW_MEASURED, True, what, REMEDIES_BY_CAUSE[worst], numbers)]
    if share < LEAST_MEASURED:
        what = f"only {share:.1%} of the frames have a measured pose (gate: {LEAST_MEASURED:.0%}){why}"
        return [VerdictReason(Kind.FEW_MEASURED, True, what, remedy, numbers)]
    if share < GOOD_MEASURED:
        what = f"{share:.1%} of the frames have a measured pose (usual: {GOOD_MEASURED:.0%} and more){why}"
        return [VerdictReason(Kind.FEW_MEASURED, False, what, remedy, numbers)]
    return []


def _in_words(causes: Mapping[Cause, int], most: int = 3) -> str:
    """`30 with hidden spots, 4 without a picture of some camera`."""
    return ", ".join(f"{count} {cause.meaning}" for cause, count in list(causes.items())[:most])


def _why_never(facts: RunFacts) -> list[VerdictReason]:
    """Why the vehicle was never found, beyond cameras that show nothing (`_cameras`), which are reason enough."""
    if facts.causal_measured:
        what = (
            f"the causal pass has a measured pose in {facts.causal_measured} of {facts.frames} frames, and the"
            " smoothing pass confirms none of them"
        )
        numbers = {"causal_measured": facts.causal_measured}
        return [VerdictReason(Kind.NOT_CONFIRMED, True, what, REMEDIES[Kind.NOT_CONFIRMED], numbers)]
    if facts.tie_text:
        what = f"the spots fit more than one pose: {facts.tie_text}"
        return [
            VerdictReason(
                Kind.AMBIGUOUS, True, what, REMEDIES[Kind.AMBIGUOUS], {"frames": [list(r) for r in facts.ties]}
            )
        ]
    causes = facts.causes
    unexplained, few = causes.get(Cause.UNEXPLAINED, 0), causes.get(Cause.FEW_POINTS, 0)
    per_frame = ", ".join(
        f"{f.points / f.pictures:.1f} per picture in camera {name}" for name, f in facts.cameras.items() if f.pictures
    )
    points = {name: f.points for name, f in facts.cameras.items()}
    if not all(f.points for f in facts.cameras.values()):
        return []
    if unexplained > FEW_SHOWN * facts.frames:
        what = (
            f"{unexplained} of {facts.frames} frames show enough points of light ({per_frame}), but no pose within the"
            " prior explains them"
        )
        return [VerdictReason(Kind.NOT_ACQUIRED, True, what, REMEDIES[Kind.NOT_ACQUIRED], {"points": points})]
    if few or unexplained:
        what = (
            f"{_frames(few)} of {facts.frames} show fewer than the {facts.min_spots} points of light that a first pose"
            f" needs ({per_frame})"
        )
        return [VerdictReason(Kind.FEW_POINTS, True, what, REMEDIES[Kind.FEW_POINTS], {"points": points})]
    if causes:
        what = f"of {_frames(facts.frames)}, {_in_words(causes)}"
        return [VerdictReason(Kind.FEW_MEASURED, True, what, REMEDIES_BY_CAUSE[next(iter(causes))], {"points": points})]
    return []


def _cameras(facts: RunFacts) -> list[VerdictReason]:
    """Cameras without pictures, or without points of light in them."""
    out = []
    for name, camera in facts.cameras.items():
        out += _pictures(name, camera, facts)
        if not camera.pictures:
            continue
        empty = camera.empty / camera.pictures
        never = facts.measured == 0 and empty > MOSTLY_EMPTY
        dark = empty > MOSTLY_EMPTY and camera.expected > 0 and camera.found < _FEW_FOUND * camera.expected
        if never or dark:
            which = "any" if camera.empty == camera.pictures else f"{camera.empty}"
            what = f"camera {name}: nothing was detected in {which} of its {camera.pictures} pictures"
            numbers = {"camera": name, **camera.as_mapping()}
            out.append(
                VerdictReason(
                    Kind.NOTHING_DETECTED, facts.measured == 0, what, REMEDIES[Kind.NOTHING_DETECTED], numbers
                )
            )
        elif camera.expected_at_end and camera.empty_at_end > LONG_EMPTY * facts.frames:
            what = (
                f"camera {name}: nothing was detected in its last {camera.empty_at_end} pictures, where the pose puts"
                " spots inside them"
            )
            numbers = {"camera": name, **camera.as_mapping()}
            out.append(VerdictReason(Kind.NOTHING_DETECTED, False, what, REMEDIES[Kind.NOTHING_DETECTED], numbers))
    return out


def _pictures(name: str, camera: CameraFacts, facts: RunFacts) -> list[VerdictReason]:
    """A camera without pictures: none at all, at the start, to the end, or here and there."""
    missing, numbers = camera.missing, {"camera": name, "missing": [list(r) for r in camera.missing]}
    if not len(missing):
        return []

    def evidence(kind: Kind, what: str, fails: bool = False) -> VerdictReason:
        return VerdictReason(kind, fails, f"camera {name} {what}", REMEDIES[kind], numbers)

    if not camera.pictures:
        return [evidence(Kind.NO_PICTURES, "has no usable picture at all", facts.measured == 0)]
    out = []
    first, last = missing.ranges[0], missing.ranges[-1]
    here_and_there = len(missing)
    if first[0] == facts.first_frame:
        count = first[1] - first[0] + 1
        here_and_there -= count
        out.append(evidence(Kind.CAMERA_LATE, f"starts late: it has no picture of the first {_frames(count)}"))
    if last[1] == facts.last_frame:
        count = last[1] - last[0] + 1
        here_and_there -= count
        out.append(
            evidence(
                Kind.CAMERA_STOPPED,
                f"stopped before the end: it has no picture from frame {last[0]} on ({_frames(count)})",
            )
        )
    if here_and_there > (1 - GOOD_PICTURES) * facts.frames:
        out.append(
            evidence(Kind.MISSING_PICTURES, f"has no usable picture in {here_and_there} of {facts.frames} frames")
        )
    return out


def _misfit(misfit: float) -> list[VerdictReason]:
    numbers = {"misfit": misfit}
    if misfit > MOST_MISFIT:
        what = (
            f"the spots lie {misfit:.1f} times as far from the fitted pose as their sigmas allow (gate:"
            f" {MOST_MISFIT:g}): the rig file does not describe this set-up"
        )
        return [VerdictReason(Kind.MISFIT, True, what, REMEDIES[Kind.MISFIT], numbers)]
    if misfit > GOOD_MISFIT:
        what = (
            f"the spots lie {misfit:.1f} times as far from the fitted pose as their sigmas allow; the sigmas of the"
            " poses are widened by it"
        )
        return [VerdictReason(Kind.MISFIT, False, what, REMEDIES[Kind.MISFIT], numbers)]
    return []


def _interruptions(facts: RunFacts) -> list[VerdictReason]:
    """What happened in the midst of a run in which the vehicle was found."""
    out = []
    if facts.measured and facts.ties:
        which = "frame" if len(facts.ties) == 1 else "frames"
        what = f"{which} {facts.ties.in_words()} could be explained in more than one way: {facts.tie_text}"
        numbers: dict[str, Any] = {"frames": [list(r) for r in facts.ties]}
        out.append(VerdictReason(Kind.AMBIGUOUS, False, what, REMEDIES[Kind.AMBIGUOUS], numbers))
    if facts.measured and len(facts.lost):
        never = facts.lost.ranges[-1][1] == facts.last_frame
        after = "it was not found again" if never else "it was found again each time"
        what = f"nothing is known of the vehicle in {_frames(len(facts.lost))} ({facts.lost.in_words()}); {after}"
        numbers = {"frames": [list(r) for r in facts.lost], "found_again": facts.found_again}
        out.append(VerdictReason(Kind.LOST, False, what, REMEDIES[Kind.LOST], numbers))
    for ranges, against in ((facts.own_spots, "their own spots"), (facts.causal, "the causal pass")):
        if len(ranges):
            what = (
                f"the poses of {_frames(len(ranges))} ({ranges.in_words()}) contradict {against}: they are reported as"
                " predicted, with wider sigmas"
            )
            numbers = {"frames": [list(r) for r in ranges]}
            out.append(VerdictReason(Kind.CONTRADICTION, False, what, REMEDIES[Kind.CONTRADICTION], numbers))
    if len(facts.invalid):
        what = f"covariances of {_frames(len(facts.invalid))} ({facts.invalid.in_words()}) are not positive definite"
        numbers = {"frames": [list(r) for r in facts.invalid]}
        out.append(VerdictReason(Kind.INTERNAL, False, what, REMEDIES[Kind.INTERNAL], numbers))
    return out


def _frames(count: int) -> str:
    return f"{count} frame{'s' if count != 1 else ''}"
