"""Result of a camera calibration."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calibration.findings import Level
from calibration.lens.intrinsics_findings import next_photographs
from calibration.lens.intrinsics_result import Intrinsics
from lab.calibrate.camera.photos import PhotoSet
from lab.errors import CalibrationError
from lab.number_format import format_number


@dataclass(frozen=True, slots=True)
class CameraOutcome:
    """Result of a camera calibration."""

    name: str
    out: Path
    result: Intrinsics
    photos: PhotoSet

    @property
    def level(self) -> Level:
        """The verdict."""
        return self.result.verdict

    @property
    def exit_status(self) -> int:
        """0, or 3 if the calibration must not be used."""
        return CalibrationError.exit_status if self.level == Level.FAIL else 0

    def line(self) -> str:
        """One line for the terminal."""
        r = self.result
        worst = max(r.findings, key=lambda f: f.level)
        reason = "" if self.level == Level.PASS else f": {worst.what.rstrip('.')}"
        if self.level == Level.FAIL:
            reason += f". {next_photographs(r).rstrip('.')}"
        px, mm = (np.nanmedian(m) for m in (r.map.sigma_px(r.covariance), r.map.sigma_mm(r.covariance)))
        return (
            f"{self.name}: {self.level.name}: fx {r.fit.lens[0]:.2f} ± {format_number(r.sigmas[0], 2)} px,"
            f" {r.model.words}, RMS"
            f" {r.rms_px:.3f} px, directions to {format_number(px, 2)} px / {format_number(mm, 2)} mm at"
            f" {r.distance_m:.3g} m{reason} -> {self.out}"
        )
