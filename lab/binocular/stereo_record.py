"""What processing keeps of each frame of a stereo run; tables, findings and the report are made from it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from geometry.arrays import Array
from geometry.pose import Pose
from lab.binocular.stereo_run import StereoRun
from tracking.binocular.clock_offset import ClockOffset
from tracking.binocular.marker_model import MarkerImages
from tracking.binocular.pose_tracker import BinocularFrame
from tracking.statuses import PoseStatus


@dataclass(frozen=True, slots=True)
class StereoRecord:
    """One frame."""

    frame: int
    t_s: float
    candidates: tuple[MarkerImages | None, MarkerImages | None]  # None: no picture
    missing: tuple[str, str]  # why there is no picture; empty where there is one
    tracked: BinocularFrame

    @property
    def measured(self) -> bool:
        """Whether the pose is a measurement."""
        return self.tracked.status is PoseStatus.MEASURED


@dataclass(frozen=True, slots=True)
class TruthErrors:
    """Errors of the measured poses against truth/pose.csv, n frames."""

    frames: Array  # (n,)
    deltas: Array  # (n, 6): truth minus estimate, section 1 of the file contract
    nees: Array  # (n,)
    range_m: Array  # (n,): estimated minus true distance of the body origin from the left camera
    true_range_m: Array  # (n,)

    def as_mapping(self) -> dict[str, float | int]:
        """Figures for summary.json."""
        return {
            "frames": len(self.frames),
            "position_rms_m": _rms(np.linalg.norm(self.deltas[:, :3], axis=1)),
            "rotation_rms_deg": float(np.rad2deg(_rms(np.linalg.norm(self.deltas[:, 3:], axis=1)))),
            "range_bias_m": float(self.range_m.mean()),
            "range_rms_m": _rms(self.range_m),
            "nees_mean": float(self.nees.mean()),
        }


@dataclass(slots=True)
class StereoResults:
    """A whole run."""

    run: StereoRun
    records: list[StereoRecord] = field(default_factory=list)
    clock: ClockOffset | None = None
    errors: TruthErrors | None = None
    notes: list[str] = field(default_factory=list)

    @property
    def measured(self) -> list[StereoRecord]:
        """The frames with a measured pose."""
        return [r for r in self.records if r.measured]

    @property
    def noise_scale(self) -> float:
        """Root of chi-square over degrees of freedom of all measured frames: 1 if the stated sigmas are right."""
        fits = [r.tracked.fit for r in self.measured if r.tracked.fit is not None]
        dof = sum(f.dof for f in fits)
        return float(np.sqrt(sum(f.chi2 for f in fits) / dof)) if dof else float("nan")


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def truth_errors(records: Sequence[StereoRecord], run: StereoRun, frames: Array, poses: Pose) -> TruthErrors | None:
    """Errors of the measured poses against true ones at some frames; None where none is shared."""
    place = {int(f): i for i, f in enumerate(frames)}
    shared = [r for r in records if r.measured and r.frame in place]
    if not shared:
        return None
    eye = run.pair.cameras[0].camera_from_world.inverse().translation
    deltas, nees, apart, far = [], [], [], []
    for r in shared:
        assert r.tracked.pose is not None
        assert r.tracked.covariance is not None
        true = poses[place[r.frame]]
        delta = true.minus(r.tracked.pose)
        deltas.append(delta)
        nees.append(float(delta @ np.linalg.solve(r.tracked.covariance, delta)))
        far.append(float(np.linalg.norm(true.translation - eye)))
        apart.append(float(np.linalg.norm(r.tracked.pose.translation - eye)) - far[-1])
    numbers = np.array([r.frame for r in shared])
    return TruthErrors(numbers, np.array(deltas), np.array(nees), np.array(apart), np.array(far))
