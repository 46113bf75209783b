"""What a daily check says of each camera, of points and lasers, and by which limits it is judged."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calibration.drift import Change
from calibration.findings import Finding, Level
from geometry.arrays import Array


@dataclass(frozen=True, slots=True)
class DailyLimits:
    """When a drift is one, and when it is too large."""

    p_false_alarm: float = 0.002  # per check that nothing has changed and it says so: once in two years of working days
    warn_mm: float = 0.2  # mm at the screen, RMS: what a good spot is known to; smaller drifts are lost in its noise
    fail_mm: float = 0.5  # mm at the screen: at 2.5 m from the vehicle 0.011 deg, more than the goal of 0.01 deg
    weak_mm: float = 2.0  # mm: a check that could miss such a shift (0.05 deg at 2.5 m) is no proof of anything
    fail_px: float = 1.0  # px, where no mm can be told as the camera's rays miss its screen
    point_sigma_px: float = 0.1  # px, of a known point whose file gives no sigma: a dot of some 10 px, centre fitted
    floor_px: float = 0.02  # px, of a mean spot: pixel-locking and speckle stand still when the vehicle does
    still_px: float = 0.3  # px that a spot may wander in a static run: more is a vehicle that moves
    pose_sigma_m: float = 5e-5  # m, of each coordinate of a stand's known pose: a good mechanical seat
    pose_sigma_deg: float = 0.003  # deg, about each axis: 11 arcsec, a good turntable
    power: float = 0.9  # with which a drift of the "detectable" size is found
    expiry_warning_days: int = 14  # days before the last valid one on which a new calibration should be planned

    def __post_init__(self) -> None:
        for name in ("p_false_alarm", "power"):
            if not 0 < getattr(self, name) < 1:
                raise ValueError(f"{name}: expected a number between 0 and 1, got {getattr(self, name):g}")
        for name in (
            "warn_mm",
            "weak_mm",
            "fail_px",
            "point_sigma_px",
            "floor_px",
            "still_px",
            "pose_sigma_m",
            "pose_sigma_deg",
        ):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name}: expected a number above 0, got {getattr(self, name):g}")
        if not self.fail_mm >= self.warn_mm:
            raise ValueError(f"fail_mm: expected at least warn_mm ({self.warn_mm:g}), got {self.fail_mm:g}")


@dataclass(frozen=True, slots=True)
class OtherChange:
    """A point that is wrong or a laser that moved."""

    change: Change
    px: float
    mm: float


@dataclass(frozen=True, slots=True)
class CameraDrift:
    """What a check says of one camera, n points."""

    camera: str
    pixels: Array  # (n, 2)
    residual_px: Array  # (n, 2), measured minus foretold
    explained_px: Array  # (n, 2), what the camera's own change makes of it (0 where it has none)
    drift_px: float  # RMS over the points of the fitted drift
    noise_px: float  # of what it would be if nothing had changed
    drift_mm: float  # at the camera's screen; nan where its rays miss it
    shift_px: Array  # (2,), mean of the fitted drift
    sigma_shift_px: Array  # (2,)
    turn_deg: Array  # (3,), about the camera's x, y, z, of what it sees
    sigma_turn_deg: Array  # (3,)
    scale_ppm: float
    sigma_scale_ppm: float
    p_value: float  # of so large a drift when nothing has changed
    detectable_px: float  # shift that the check finds nearly always
    detectable_mm: float
    change: Change | None  # the explanation, where there is something to explain
    unexplained_px: float  # RMS of what no explanation takes away; nan where that is not significant
    unexplained_mm: float
    level: Level


@dataclass(frozen=True, slots=True)
class DriftOutcome:
    """How a daily check ended."""

    out: Path
    level: Level
    cameras: tuple[CameraDrift, ...]
    findings: tuple[Finding, ...]
    unchecked: tuple[str, ...] = ()  # cameras of the rig of which nothing was measured

    def line(self) -> str:
        """One line for the terminal."""
        worst = max(self.findings, key=lambda f: f.level)
        drifts = ", ".join(f"{c.camera} {_number(c.drift_px)} px / {_number(c.drift_mm)} mm" for c in self.cameras)
        reason = f": {worst.what}" if worst.level > Level.PASS else ""
        left_out = ""
        if self.unchecked and worst.what != not_checked(self.unchecked):
            left_out = f"; WARN: {not_checked(self.unchecked)}"
        return f"{self.level.name}: drift {drifts}{reason}{left_out}; report in {self.out}"

    @property
    def exit_status(self) -> int:
        """0: may be used (PASS, WARN); 3: must not."""
        return 3 if self.level == Level.FAIL else 0


def not_checked(cameras: Sequence[str]) -> str:
    """That nothing is known of these cameras, as the line and the report say it."""
    return f"camera {', '.join(cameras)} not checked: nothing was measured in {'it' if len(cameras) == 1 else 'them'}"


def _number(value: float) -> str:
    return "?" if not np.isfinite(value) else f"{value:.2f}"


def is_weak(detectable_mm: float, limits: DailyLimits) -> bool:
    """Whether a check could miss so much that finding nothing proves nothing."""
    return not detectable_mm <= limits.weak_mm  # so that nan counts as weak


def level_of(px: float, mm: float, limits: DailyLimits) -> Level:
    """How grave a significant change of this size is. Where no mm can be told, pixels decide."""
    if np.isfinite(mm):
        return Level.FAIL if mm > limits.fail_mm else Level.WARN if mm > limits.warn_mm else Level.PASS
    return Level.FAIL if px > limits.fail_px else Level.WARN
