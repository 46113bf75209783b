"""Errors of velocity and angular rate against finite differences of the true poses, since a truth file has poses only.

A five-point difference has the error h^4/30 times the fifth derivative: 1e-6 m/s on a path of 0.3 m at 1 Hz and 100
frames per second, where a three-point difference has 1e-3. At a sharp turn neither is a velocity, and such rows are
excluded.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from geometry.arrays import Array, Bools
from geometry.pose import Pose
from lab.files.run.results import PoseTrack

# At a sharp turn, three-point and five-point differences disagree by more than BEND_TIMES times the run's median
# disagreement, and by more than BEND_LEAST (m/s and rad/s).
BEND_TIMES = 20.0
BEND_LEAST = 1e-3
EVEN = 0.01  # largest relative deviation of a frame interval from the mean over one difference


def motion_scores(poses: PoseTrack, truth: Pose) -> dict[str, Any] | None:
    """Errors of velocity and rate as plain JSON values; None without anything to compare. truth: (F,)."""
    true, bent = differenced(truth, poses.t_s)
    error = np.concatenate([poses.velocity_m_s, poses.rate_rad_s], axis=1) - true
    sigma = np.concatenate([poses.sigma_velocity_m_s, poses.sigma_rate_rad_s], axis=1)
    compared = np.all(np.isfinite(error), axis=1)
    if not compared.any():
        return None
    known = np.all(np.isfinite(poses.velocity_m_s), axis=1)
    error, share = error[compared], (error[compared] / sigma[compared]) ** 2
    out: dict[str, Any] = {
        "against": "five-frame differences of the true poses",
        "rows": int(compared.sum()),
        "rows_at_bends_left_out": int((bent & known).sum()),
    }
    for name, part in (("velocity_m_s", slice(0, 3)), ("rate_rad_s", slice(3, 6))):
        distance = np.linalg.norm(error[:, part], axis=1)
        squares = share[:, part][np.isfinite(share[:, part])]
        out[name] = {
            "rms_axes": dict(zip("xyz", np.sqrt(np.mean(error[:, part] ** 2, axis=0)).tolist(), strict=True)),
            "rms": float(np.sqrt(np.mean(distance**2))),
            "median": float(np.median(distance)),
            "p99": float(np.percentile(distance, 99)),
            "max": float(distance.max()),
            # Mean over axes and rows; 1 if the sigmas are correct.
            "square_over_claimed_mean": float(squares.mean()) if len(squares) else None,
        }
    return out


def differenced(truth: Pose, t_s: Array) -> tuple[Array, Bools]:
    """Velocity in world (m/s) and rate about the body's axes (rad/s), (F, 6), of poses (F,) at times (F,).

    nan in the first and last two frames, next to missing or unevenly spaced frames, and at sharp turns. Also returns
    which frames (F,) are excluded as sharp turns.
    """
    frames = len(t_s)
    out, bent = np.full((frames, 6), np.nan), np.zeros(frames, dtype=bool)
    if frames < 5:
        return out, bent
    middle = truth[slice(2, frames - 2)]
    # The pose differences are [dt, dtheta] with dtheta in the body frame of the middle frame; their slope is the rate.
    step = [truth[slice(k, frames - 4 + k)].minus(middle) for k in (0, 1, 3, 4)]
    gap = np.stack([t_s[k + 1 : frames - 3 + k] - t_s[k : frames - 4 + k] for k in range(4)])
    h = gap.mean(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        even = np.all(np.abs(gap - h) <= EVEN * h, axis=0) & (h > 0)
        three = (step[2] - step[1]) / (2 * h[:, None])
        five = (8 * (step[2] - step[1]) - (step[3] - step[0])) / (12 * h[:, None])
    # An unknown pose has a translation of nan and an identity rotation, which must not count as a rotation.
    good = even & np.all([np.all(np.isfinite(s[:, :3]), axis=1) for s in step], axis=0)
    if not good.any():
        return out, bent
    gaps = np.stack([np.linalg.norm((five - three)[:, part], axis=1) for part in (slice(0, 3), slice(3, 6))])
    usual = np.median(gaps[:, good], axis=1, keepdims=True)
    broken = good & np.any(gaps > np.maximum(BEND_TIMES * usual, BEND_LEAST), axis=0)
    # Exactly at a corner both differences are the mean of before and after, and agree; its neighbours reveal it.
    near_turn = broken.copy()
    near_turn[1:] |= broken[:-1]
    near_turn[:-1] |= broken[1:]
    out[2:-2] = np.where((good & ~near_turn)[:, None], five, np.nan)
    bent[2:-2] = good & near_turn
    return out, bent
