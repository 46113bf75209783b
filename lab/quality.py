"""The verdict on a run: whether its numbers can be trusted. Exit status and report both follow from it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from calibration.findings import Finding, Level
from lab.errors import QUALITY_GATE_FAILED

LEAST_MEASURED = 0.5  # share of frames with a measured pose, below which the run fails ...
GOOD_MEASURED = 0.95  # ... and above which it passes
MOST_MISFIT, GOOD_MISFIT = 5.0, 1.5  # residuals against what the spots' own sigmas allow (1: just that)
GOOD_PICTURES = 0.95  # share of frames with a usable picture, per camera


@dataclass(frozen=True, slots=True)
class Verdict:
    """pass; check: usable, but something wants looking at; fail: a quality gate failed."""

    status: Literal["pass", "check", "fail"]
    reasons: tuple[str, ...]

    @property
    def exit_status(self) -> int:
        """The command's exit status, section 5 of the files' contract."""
        return QUALITY_GATE_FAILED if self.status == "fail" else 0


def judge(
    frames: int,
    measured: int,
    lost: int,
    misfit: float,
    no_image: Mapping[str, int],
    ties: int,
    measured_before_lost_again: int,
    findings: Sequence[Finding] = (),
) -> Verdict:
    """The verdict from counts of frames, the misfit of the pose fits, frames without a picture by camera, and ties.

    measured_before_lost_again: how often the vehicle was lost after it had been found. findings: of the model check
    (lab.model_check.check.check_model): what it warns of is a doubt, what it fails is a failure.
    """
    failures: list[str] = []
    doubts: list[str] = []
    share = measured / frames if frames else 0.0
    if frames == 0:
        failures.append("there is no frame at all")
    elif measured == 0:
        failures.append("the vehicle was never found: no frame has a measured pose")
    elif share < LEAST_MEASURED:
        failures.append(f"only {share:.0%} of the frames have a measured pose (gate: {LEAST_MEASURED:.0%})")
    elif share < GOOD_MEASURED:
        doubts.append(f"{share:.1%} of the frames have a measured pose (usual: {GOOD_MEASURED:.0%} and more)")
    if misfit > MOST_MISFIT:
        failures.append(
            f"the spots lie {misfit:.1f} times as far from the fitted pose as their sigmas allow (gate:"
            f" {MOST_MISFIT:g}): the rig file does not describe this set-up"
        )
    elif misfit > GOOD_MISFIT:
        doubts.append(
            f"the spots lie {misfit:.1f} times as far from the fitted pose as their sigmas allow: check the calibration"
            " and the light (speckle); the sigmas of the poses are widened by it"
        )
    failures += [f"{f.what}; {f.why}" for f in findings if f.level == Level.FAIL]
    doubts += [f"{f.what}; {f.why}" for f in findings if f.level == Level.WARN]
    for camera, count in no_image.items():
        if frames and count > (1 - GOOD_PICTURES) * frames:
            doubts.append(f"camera {camera} has no usable picture in {count} of {frames} frames")
    if ties:
        doubts.append("some frames could be explained in two ways and were left without labels (see the events)")
    if lost and measured:
        doubts.append(f"nothing is known of the vehicle in {lost} frames")
    if measured_before_lost_again:
        doubts.append(
            f"the vehicle was found again {measured_before_lost_again} times after it was lost (see the events)"
        )
    if failures:
        return Verdict("fail", (*failures, *doubts))
    if doubts:
        return Verdict("check", tuple(doubts))
    return Verdict(
        "pass", (f"{share:.1%} of the frames have a measured pose, and the residuals are what the sigmas allow",)
    )
