"""Where a run's uncertainty comes from: what differs from frame to frame, and what the calibration leaves."""

from __future__ import annotations

import numpy as np

from geometry.arrays import Array
from geometry.rotations import ypr_jacobian
from lab.number_format import angle, length
from lab.report.run.report_data import ReportData
from tracking.statuses import PoseStatus

AVERAGED = 100  # frames of the example
HEADS = ("", "one frame", "of it noise", "of it calibration", f"mean of {AVERAGED} frames", "mean of endless frames")


def budget_rows(m: ReportData) -> list[tuple[str, ...]]:
    """A row per number of the pose: medians over the measured frames of 1-sigma; empty where nothing is stated.

    Noise is taken for independent from frame to frame, as the frames' own covariances claim it.
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
        shown = length if i < 3 else angle
        rows.append((name, *(shown(float(s[i])) for s in sigmas)))
    return rows


def _variances(R: Array, covariance: Array) -> Array:
    """Of x, y, z (m^2) and yaw, pitch, roll (deg^2), (F, 6), of rotations (F, 3, 3) and covariances (F, 6, 6)."""
    J = np.rad2deg(ypr_jacobian(R))
    angles = J @ covariance[:, 3:, 3:] @ np.swapaxes(J, -1, -2)
    both = [np.diagonal(c, axis1=-2, axis2=-1) for c in (covariance[:, :3, :3], angles)]
    return np.concatenate(both, axis=1)


def words(m: ReportData) -> str:
    """What the reader must know of the calibration's share."""
    if m.run is None or m.run.covariance is not None:
        return (
            "Noise differs from frame to frame, and a mean over frames lessens it. Errors of the calibration are the"
            " same in every frame at a pose: no mean lessens them, only a better calibration does. In differences"
            " between two near poses most of them cancel. The table covariance.csv holds both together,"
            " systematic.csv the calibration's part."
        )
    return (
        "The rig file states no covariance of its calibration: the sigmas hold the noise of the pictures alone. What"
        " the calibration is off comes on top, is the same in every frame, and no mean over frames lessens it."
        " `beampose calibrate rig` writes the covariance."
    )
