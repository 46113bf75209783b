"""The reasons of a verdict, with their figures, and the texts of all remedies."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

from lab.runs.verdict.run_statistics import Cause


class ReasonKind(StrEnum):
    """The subject of a reason."""

    NO_FRAMES = "no_frames"
    NEVER_FOUND = "never_found"
    FEW_MEASURED = "few_measured"
    NO_PICTURES = "no_pictures"  # a camera has none
    CAMERA_LATE = "camera_late"
    CAMERA_STOPPED = "camera_stopped"
    MISSING_PICTURES = "missing_pictures"
    NOTHING_DETECTED = "nothing_detected"
    FEW_POINTS = "few_points"
    NOT_ACQUIRED = "not_acquired"
    NOT_CONFIRMED = "not_confirmed"  # measured in the causal pass, but not in the smoothed one
    AMBIGUOUS = "ambiguous"
    LOST = "lost"
    CONTRADICTION = "contradiction"
    INTERNAL = "internal"
    NOISE_SCALE = "noise_scale"
    MODEL = "model"  # a finding of the model check
    COLOUR_MOSAIC = "colour_mosaic"
    CAMERA_MOVED = "camera_moved"  # during the recording
    TRUTH = "truth"  # the poses contradict the truth of the run


# For `beampose explain`; stable: new kinds get new codes.
CODES = {
    ReasonKind.NO_FRAMES: "BP-V01",
    ReasonKind.NEVER_FOUND: "BP-V02",
    ReasonKind.FEW_MEASURED: "BP-V03",
    ReasonKind.NO_PICTURES: "BP-V04",
    ReasonKind.CAMERA_LATE: "BP-V05",
    ReasonKind.CAMERA_STOPPED: "BP-V06",
    ReasonKind.MISSING_PICTURES: "BP-V07",
    ReasonKind.NOTHING_DETECTED: "BP-V08",
    ReasonKind.FEW_POINTS: "BP-V09",
    ReasonKind.NOT_ACQUIRED: "BP-V10",
    ReasonKind.NOT_CONFIRMED: "BP-V11",
    ReasonKind.AMBIGUOUS: "BP-V12",
    ReasonKind.LOST: "BP-V13",
    ReasonKind.CONTRADICTION: "BP-V14",
    ReasonKind.INTERNAL: "BP-V15",
    ReasonKind.NOISE_SCALE: "BP-V16",
    ReasonKind.MODEL: "BP-V17",
    ReasonKind.COLOUR_MOSAIC: "BP-V18",
    ReasonKind.CAMERA_MOVED: "BP-V19",
    ReasonKind.TRUTH: "BP-V20",
}
REMEDIES = {
    ReasonKind.NO_FRAMES: "Check the folders of pictures, or the detections, that run.yaml names (`beampose check`).",
    ReasonKind.NEVER_FOUND: "See the reasons below.",
    ReasonKind.NO_PICTURES: "Check the camera, its cable and the path that run.yaml names; or leave the camera out.",
    ReasonKind.CAMERA_LATE: "Start all cameras before the motion; the poses before that moment have wider sigmas.",
    ReasonKind.CAMERA_STOPPED: "Check the camera's disk, cable and trigger; the poses after that moment have wider"
    " sigmas.",
    ReasonKind.MISSING_PICTURES: "Check the camera's disk, cable and trigger for dropped or damaged frames.",
    ReasonKind.NOTHING_DETECTED: "Check its pictures: are the lasers on, the lens uncovered, the spots on that screen"
    " and bright enough? If spots are visible, lower the detection threshold or state the camera's noise.",
    ReasonKind.FEW_POINTS: "Make more spots visible: check light, exposure and the cameras' fields of view, or keep the"
    " vehicle where the cameras see its spots.",
    ReasonKind.NOT_ACQUIRED: "Check the prior (position, attitude, within_m, within_deg), that each camera's pictures"
    " are in its own folder, and that rig.yaml is the rig of this recording (`beampose calibrate check`).",
    ReasonKind.NOT_CONFIRMED: "Use attitude_causal.csv with care, and report this run: the two passes disagree.",
    ReasonKind.AMBIGUOUS: "Make the prior narrower around the right candidate, start where another spot can be seen, or"
    " use a fan with unequal angles.",
    ReasonKind.LOST: "Check the first of these frames: occlude fewer spots, or for a shorter time.",
    ReasonKind.CONTRADICTION: "Check these frames for reflections near the spots and for a rig that has moved. Their"
    " sigmas cover the difference.",
    ReasonKind.INTERNAL: "These values are omitted. Please report this run as an error of the program.",
    ReasonKind.COLOUR_MOSAIC: "Convert the pictures to colour or grey before the run (demosaicing), or let the camera"
    " do so; a camera without colour filters is more accurate.",
    ReasonKind.CAMERA_MOVED: "Check the mounts of this camera and its screen, and calibrate again. The poses of these"
    " frames are computed without this camera.",
    ReasonKind.TRUTH: "Check that truth/pose.csv belongs to this recording and to the world of rig.yaml; then the rig"
    " and the names of the cameras (`beampose check`).",
    ReasonKind.NOISE_SCALE: "Check the calibration (`beampose calibrate check`) and the light (speckle).",
}
REMEDIES_BY_CAUSE = {
    Cause.NO_PICTURE: "Check the cameras for dropped frames.",
    Cause.CONTRADICTION: REMEDIES[ReasonKind.CONTRADICTION],
    Cause.UNEXPLAINED: "Check these frames for reflections, another light source, or a rig that has moved.",
    Cause.LABELS_OPEN: "Use a fan with unequal angles, or keep four spots in view.",
    Cause.FEW_POINTS: REMEDIES[ReasonKind.FEW_POINTS],
    Cause.OUT_OF_VIEW: "Use a wider field of view, more cameras or more beams (`beampose plan` shows what is seen).",
    Cause.NOT_DETERMINED: "Keep spots of two screens in view: those of one screen alone do not determine the pose.",
    Cause.HIDDEN: "Keep objects out of the beams and of the cameras' views, or add beams.",
}


@dataclass(frozen=True, slots=True)
class VerdictReason:
    """One reason of a verdict."""

    kind: ReasonKind
    fails: bool  # a quality gate failed; else a point to check
    what: str
    remedy: str
    numbers: Mapping[str, Any] = field(default_factory=dict)  # plain values
    code: str = ""  # of the finding of the model check; empty: that of the kind

    def as_mapping(self) -> dict[str, Any]:
        """For summary.json."""
        return {
            "kind": self.kind.value,
            "code": self.code or CODES[self.kind],
            "level": "fail" if self.fails else "check",
            "what": self.what,
            "remedy": self.remedy,
            "numbers": dict(self.numbers),
        }
