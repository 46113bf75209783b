"""The uncertainty budget of a run: noise of the frames, and the systematic part from the calibration."""

from __future__ import annotations

import numpy as np

from geometry.arrays import Array
from geometry.rotations import ypr_jacobian
from lab.number_format import format_angle, format_length
from lab.report.run.report_data import ReportData
from tracking.statuses import PoseStatus

AVERAGED = 100  # frames of the example
HEADS = ("", "one frame", "noise part", "calibration part", f"mean of {AVERAGED} frames", "mean of infinitely many")


def budget_rows(m: ReportData) -> list[tuple[str, ...]]:
    """A row per component of the pose: medians of the 1-sigma uncertainty over the measured frames.

    Empty where the results state no systematic part. Noise is assumed independent from frame to frame, as stated by the
    covariances of the frames.
    """
    measured = m.poses.has(PoseStatus.MEASURED) & np.all(np.isfinite(m.poses.systematic), axis=(-2, -1))
    if not measured.any():
        return []
    R = m.poses.world_from_body.rotation[measured]
    total = _variances(R, m.poses.covariance[measured])
    systematic = _variances(R, m.poses.systematic[measured])
    noise = np.maximum(total - systematic, 0.0)
    columns = [total, noise, systematic, noise / AVERAGED + systematic, systematic]
    sigmas = [np.sqrt(np.median(c, axis=0)) for c in columns]
    rows = []
    for i, name in enumerate(("x", "y", "z", "yaw", "pitch", "roll")):
        shown = format_length if i < 3 else format_angle
        rows.append((name, *(shown(float(s[i])) for s in sigmas)))
    return rows


def _variances(R: Array, covariance: Array) -> Array:
    """Variances (F, 6), m^2 and deg^2, of x, y, z, yaw, pitch, roll from R (F, 3, 3) and covariances (F, 6, 6)."""
    J = np.rad2deg(ypr_jacobian(R))
    angles = J @ covariance[:, 3:, 3:] @ np.swapaxes(J, -1, -2)
    both = [np.diagonal(c, axis1=-2, axis2=-1) for c in (covariance[:, :3, :3], angles)]
    return np.concatenate(both, axis=1)


def words(m: ReportData) -> str:
    """How to read the systematic part."""
    if m.run is None or m.run.covariance is not None:
        return (
            "Noise differs from frame to frame, so averaging over frames reduces it. Errors of the calibration are the"
            " same in every frame at the same pose: averaging does not reduce them, only a better calibration does. In"
            " differences between two similar poses most of them cancel. covariance.csv contains the sum of both,"
            " systematic.csv the calibration part."
        )
    return (
        "The rig file states no covariance of its calibration: the sigmas contain the noise of the pictures only."
        " Errors of the calibration are additional and the same in every frame, so averaging over frames does not"
        " reduce them. `beampose calibrate rig` writes the covariance."
    )
