"""The reasons of a verdict: what was found, with its figures, and what to do about it. The words of all remedies."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

from lab.runs.verdict.run_facts import Cause


class Kind(StrEnum):
    """What a piece of evidence is about."""

    NO_FRAMES = "no_frames"
    NEVER_FOUND = "never_found"
    FEW_MEASURED = "few_measured"
    NO_PICTURES = "no_pictures"  # a camera without any
    CAMERA_LATE = "camera_late"
    CAMERA_STOPPED = "camera_stopped"
    MISSING_PICTURES = "missing_pictures"
    NOTHING_DETECTED = "nothing_detected"
    FEW_POINTS = "few_points"
    NOT_ACQUIRED = "not_acquired"
    NOT_CONFIRMED = "not_confirmed"  # measured in the causal pass, and not in the smoothed one
    AMBIGUOUS = "ambiguous"
    LOST = "lost"
    CONTRADICTION = "contradiction"
    INTERNAL = "internal"
    MISFIT = "misfit"
    MODEL = "model"  # a finding of the model check


REMEDIES = {
    Kind.NO_FRAMES: "Check the folders of pictures, or the detections, that run.yaml names (`beampose check`).",
    Kind.NEVER_FOUND: "See the reasons below.",
    Kind.NO_PICTURES: "Check the camera, its cable and the path that run.yaml names; or leave the camera out.",
    Kind.CAMERA_LATE: "Start all cameras before the motion; the poses before that moment have wider sigmas.",
    Kind.CAMERA_STOPPED: "Check the camera's disk, cable and trigger; the poses after that moment have wider sigmas.",
    Kind.MISSING_PICTURES: "Check the camera's disk, cable and trigger for dropped or damaged frames.",
    Kind.NOTHING_DETECTED: "Look at its pictures: are the lasers on, the lens uncovered, the spots on that screen and"
    " bright enough? If spots can be seen, lower the detection threshold or state the camera's noise.",
    Kind.FEW_POINTS: "Make more spots visible: light, exposure and the cameras' fields of view; or record while the"
    " vehicle is where they are.",
    Kind.NOT_ACQUIRED: "Check the prior (position, attitude, within_m, within_deg), that each camera's pictures are in"
    " its own folder, and that rig.yaml is the rig of this recording (`beampose calibrate check`).",
    Kind.NOT_CONFIRMED: "Use attitude_causal.csv with care, and report this run: the two passes disagree.",
    Kind.AMBIGUOUS: "Make the prior narrower around the right candidate, start where another spot can be seen, or"
    " use a fan with unequal angles.",
    Kind.LOST: "Look at the first of these frames: hide fewer spots, or hide them for a shorter time.",
    Kind.CONTRADICTION: "Look at these frames: reflections near the spots, a rig that has moved. Their sigmas cover the"
    " difference.",
    Kind.INTERNAL: "These numbers are left out. Please report this run as an error of the program.",
    Kind.MISFIT: "Check the calibration (`beampose calibrate check`) and the light (speckle).",
}
REMEDIES_BY_CAUSE = {
    Cause.NO_PICTURE: "Check the cameras for dropped frames.",
    Cause.CONTRADICTION: REMEDIES[Kind.CONTRADICTION],
    Cause.UNEXPLAINED: "Look at these frames: reflections, another light, or a rig that has moved.",
    Cause.LABELS_OPEN: "Use a fan with unequal angles, or keep four spots in view.",
    Cause.FEW_POINTS: REMEDIES[Kind.FEW_POINTS],
    Cause.OUT_OF_VIEW: "Use a wider field of view, more cameras or more beams (`beampose plan` tells what is seen).",
    Cause.NOT_DETERMINED: "Keep spots of two screens in view: those of one screen alone do not determine the pose.",
    Cause.HIDDEN: "Keep what hides the spots out of the beams, or add beams.",
}


@dataclass(frozen=True, slots=True)
class VerdictReason:
    """One reason of a verdict."""

    kind: Kind
    fails: bool  # a gate; else a doubt
    what: str
    remedy: str
    numbers: Mapping[str, Any] = field(default_factory=dict)  # plain values

    def as_mapping(self) -> dict[str, Any]:
        """For summary.json."""
        return {
            "kind": self.kind.value,
            "level": "fail" if self.fails else "check",
            "what": self.what,
            "remedy": self.remedy,
            "numbers": dict(self.numbers),
        }
