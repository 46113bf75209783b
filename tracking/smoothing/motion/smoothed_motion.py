"""A run whose motion is estimated, and the estimate: what whole_run.py takes and returns."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from geometry.arrays import Array, Bools
from geometry.compiled_projection import Views
from tracking.smoothing.motion.delayed_spots import Delays
from tracking.smoothing.motion.reference import Reference
from tracking.smoothing.motion.run_detections import RunDetections


@dataclass(frozen=True, slots=True)
class WholeRun:
    """What stays the same while the motion is estimated: T frames, n views."""

    views: Views
    detections: RunDetections
    calibration_cov: Array  # (n, 2, 2) px^2: covariance of the expected pixels due to calibration errors
    dt: Array  # (T,) s
    exposure_s: float
    adapt_jerk: bool  # estimate the strength of the jerk; else it is kept
    delays: Delays | None = None  # of the detections; None: all are of the instants of their frames


@dataclass(frozen=True, slots=True)
class SmoothedMotion:
    """The estimate, T frames."""

    ref: Reference
    log_density: Array | None  # (T, 6) logarithms of the jerk's spectral densities; None: not estimated yet
    interpolation_offset: float  # to be added to them for the interpolation between frames
    jumped: Bools  # (T,) the velocities jumped in the step before
    pose_P: Array  # (T, 6, 6)
    motion_P: Array  # (T, 6, 6) of the velocities
    known: Bools  # (T,) the pose is not lost
    weight: Array  # (T,) of the information of each frame's spots in the motion; 0: not used

    @staticmethod
    def begin(ref: Reference, jumped: Bools, log_density: Array | None) -> SmoothedMotion:
        """The motion before the first estimate."""
        frames = len(ref.t)
        zero = np.zeros((frames, 6, 6))
        known = np.zeros(frames, dtype=bool)
        return SmoothedMotion(ref, log_density, 0.0, jumped, zero, zero, known, np.zeros(frames))

    def without_covariances(self) -> SmoothedMotion:
        """What the next estimate starts from: less memory."""
        zero = np.zeros_like(self.pose_P)
        return replace(self, pose_P=zero, motion_P=zero)
