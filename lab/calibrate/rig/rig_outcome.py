"""Result of a rig calibration."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calibration.findings import Finding, Level
from calibration.rig.joint import SPOTS
from calibration.rig.joint_findings import in_degrees, in_mm
from calibration.rig.rig_figures import ExpectedPose, HoldOut
from calibration.rig.rig_steps import RigCalibration
from lab.errors import CalibrationError


@dataclass(frozen=True, slots=True)
class RigOutcome:
    """Result of a rig calibration."""

    name: str
    out: Path  # folder of the results: `OUT-failed` if a FAIL would have replaced a valid calibration
    level: Level
    findings: tuple[Finding, ...]
    steps: RigCalibration
    expected: ExpectedPose | None
    held_out: HoldOut | None

    @property
    def exit_status(self) -> int:
        """0, or 3 if the calibration must not be used."""
        return CalibrationError.exit_status if self.level == Level.FAIL else 0

    def line(self) -> str:
        """One line for the terminal."""
        rig = self.steps.joint.rig
        what = f"{len(rig.cameras)} cameras, {len(rig.screens)} screens, {len(rig.beams)} beams"
        if self.expected is not None:
            what += f"; one frame: {in_degrees(self.expected.total):.2g} deg, {in_mm(self.expected.total):.2g} mm"
        if self.held_out is not None:
            deg, mm = np.rad2deg(self.held_out.attitude_rms), 1e3 * self.held_out.position_rms
            what += f"; held out: {deg:.2g} deg, {mm:.2g} mm"
        kept = self.steps.joint.kept[SPOTS]
        if not kept.all():
            what += f"; {int(np.sum(~kept))} of {len(kept)} spots excluded"
        worst = max(self.findings, key=lambda f: f.level)
        reason = "" if self.level == Level.PASS else f": {worst.what}"
        return f"{self.name}: {self.level.name}: {what}{reason} -> {self.out}"
