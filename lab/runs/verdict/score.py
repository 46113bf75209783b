"""Errors of a run's results against its truth, where the run folder has one (a simulation, or a turntable's record).

A truth file has poses only, so the true velocity and angular rate are their five-point differences. Their error is
h^4/30 times the fifth derivative: 1e-6 m/s on a path of 0.3 m at 1 Hz and 100 frames per second, where a three-point
difference has 1e-3. At a sharp turn neither is a velocity, and such rows are excluded.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.pose import Pose
from geometry.uncertainty.chi_square import gamma_quantile
from lab.files.run.results import (
    ABSENT,
    POSE_STATUSES,
    SPOT_STATUSES,
    PoseTrack,
    ResultFolder,
    SpotGrid,
    on_grid,
    pose_stack,
)
from lab.files.run.truth import load_truth
from tracking.statuses import PoseStatus, SpotStatus

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
        squares = share[:, part][np.isfinite(share[:, part])]
        out[name] = {
            "rms_axes": dict(zip("xyz", _rms(error[:, part]), strict=True)),
            **_norms(np.linalg.norm(error[:, part], axis=1)),
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


# A measured position within this distance of the true spot counts as that spot: several times the noise of a poor
# centroid, and a fraction of the usual distance to clutter or to another spot.
SAME_SPOT_PX = 3.0
LARGEST_SIGMA_PX = 1e6  # beyond any picture; a damaged table may hold numbers whose products overflow
SAME_SPOT_SIGMAS = 5.0
# A spot that returns must be found again within this number of frames with a picture.
RETURN_FRAMES = 5
# Deviation of the true path from a constant-velocity continuation of its last two positions above which it counts as a
# sharp turn, which no constant-velocity prediction can follow. About five times the prediction error on a smooth path.
BEND_PX = 2.0
HIDDEN, IN_VIEW, OUTSIDE = 2, 1, 0
WRONG_SIGMAS = 10.0  # Mahalanobis distance of a pose from the truth above which it is counted as wrong
KNOWN_TO = 1e-5  # m and rad: no truth is known better; it also covers its rounding in the file


@dataclass(frozen=True, slots=True)
class TruthArrays:
    """The truth on the grid of the results: F frames, V views. Spots or poses may be missing (None)."""

    uv_px: Array | None  # (F, V, 2), nan where no projection exists or the truth has no row
    in_view: Ints | None  # (F, V): 1 in the picture, 2 hidden, 0 outside it; -1 where the truth has no row
    world_from_body: Pose | None  # (F',), on the pose table's frames; nan translation where the truth has no row


def read_truth(run_folder: Path, spots: SpotGrid, poses: PoseTrack) -> TruthArrays | None:
    """The truth of a run folder at the frames and views of its results; None where it has none."""
    tables = load_truth(run_folder)
    if tables is None:
        return None
    uv = in_view = world_from_body = None
    if tables.spots is not None:
        true = tables.spots
        rows, i, j = on_grid(true.frame, true.camera, true.spot, spots.views, spots.frames)
        uv = np.full(spots.uv_px.shape, np.nan)
        in_view = np.full(spots.status.shape, -1, dtype=np.int64)
        uv[i, j] = true.uv_px[rows]
        in_view[i, j] = true.in_view[rows]
    if tables.pose is not None:
        at = np.searchsorted(poses.frames, tables.pose.frame)
        here = at < len(poses.frames)
        here[here] = poses.frames[at[here]] == tables.pose.frame[here]
        numbers = np.full((len(poses.frames), 7), np.nan)
        numbers[at[here]] = np.concatenate([tables.pose.position_m, tables.pose.quaternion_wxyz], axis=1)[here]
        world_from_body = pose_stack(numbers[:, :3], numbers[:, 3:])
    return TruthArrays(uv, in_view, world_from_body)


@dataclass(frozen=True, slots=True)
class ResultTables:
    """The tables of a results folder, with the truth of its run where it has one."""

    spots: SpotGrid
    poses: PoseTrack
    causal: PoseTrack | None  # of the causal pass, where `poses` are smoothed; of the same frames
    truth: TruthArrays | None = None
    errors: dict[str, Any] | None = None  # against the truth, as `score_against` gives them


def read_tables(results: ResultFolder) -> ResultTables:
    """The tables of a results folder, without truth. Raises InputError."""
    spots, poses, causal = results.spots, results.poses, results.causal
    same = causal is not None and np.array_equal(causal.frames, poses.frames)
    return ResultTables(spots, poses, causal if same else None)


def against_truth(tables: ResultTables, run_folder: Path) -> ResultTables:
    """The tables with the truth of their run, if it has one, and the errors against it. Raises InputError."""
    truth = read_truth(run_folder, tables.spots, tables.poses)
    if truth is None:
        return tables
    return replace(tables, truth=truth, errors=score_against(tables.spots, tables.poses, truth, tables.causal))


def score_against(
    spots: SpotGrid, poses: PoseTrack, truth: TruthArrays, causal: PoseTrack | None = None
) -> dict[str, Any]:
    """Errors of results against their truth, as plain JSON values.

    causal: poses of the causal pass, where `poses` are smoothed. Units are in the names; values without any row are
    None.
    """
    blocks = ("spots", "pose", "pose_causal", "motion_vs_differences", "motion_causal_vs_differences")
    out: dict[str, Any] = dict.fromkeys(blocks)
    if truth.uv_px is not None and truth.in_view is not None:
        out["spots"] = _spot_scores(spots, truth.uv_px, truth.in_view)
    if truth.world_from_body is not None:
        true = truth.world_from_body
        out["pose"], out["motion_vs_differences"] = _pose_scores(poses, true), motion_scores(poses, true)
        if causal is not None:
            out["pose_causal"] = _pose_scores(causal, true)
            out["motion_causal_vs_differences"] = motion_scores(causal, true)
    return out


def right_spot(spots: SpotGrid, true_uv: Array) -> Bools:
    """Whether each measured position (F, V) belongs to the true spot of its name.

    It lies within SAME_SPOT_PX, or SAME_SPOT_SIGMAS of its own sigma if that is more, and no other true spot of the
    camera is nearer by more than SAME_SPOT_SIGMAS. (Two spots that cross closer than the noise are indistinguishable.)
    """
    sigma_px = np.minimum(spots.sigma_px, LARGEST_SIGMA_PX)
    sigma = np.nan_to_num(np.hypot(sigma_px[..., 0], sigma_px[..., 1]) / np.sqrt(2))
    own = np.linalg.norm(spots.uv_px - true_uv, axis=-1)
    near = own <= np.maximum(SAME_SPOT_PX, SAME_SPOT_SIGMAS * sigma)  # nan is not near
    camera_of = np.array([spots.cameras.index(c) for c, _ in spots.views], dtype=np.int64)
    for j in range(len(spots.views)):
        others = np.flatnonzero((camera_of == camera_of[j]) & (np.arange(len(camera_of)) != j))
        if len(others):
            gaps = np.linalg.norm(spots.uv_px[:, j, None] - true_uv[:, others], axis=-1)
            nearest = np.min(np.where(np.isnan(gaps), np.inf, gaps), axis=1)
            near[:, j] &= ~(own[:, j] - nearest > SAME_SPOT_SIGMAS * sigma[:, j])
    return near


def _spot_scores(spots: SpotGrid, true_uv: Array, in_view: Ints) -> dict[str, Any]:
    measured, right = spots.measured, right_spot(spots, true_uv)
    has_truth = in_view >= 0
    # Frames without a picture are not counted.
    pictured = has_truth & ~spots.has(SpotStatus.NO_IMAGE)
    visible = pictured & (in_view == IN_VIEW)
    found = measured & right & visible
    wrong = measured & ~right & has_truth
    error = spots.uv_px - true_uv
    prediction_error = spots.predicted_px - true_uv
    bent = _bends(spots.frames, true_uv)
    starting = _starting(spots)
    close = np.linalg.norm(error, axis=-1) <= SAME_SPOT_PX
    reported_outside = spots.has(SpotStatus.OUT_OF_VIEW) & has_truth
    outside = reported_outside & (in_view == OUTSIDE)
    per_spot = [
        {
            "camera": camera,
            "spot": spot,
            "in_view_frames": int(visible[:, j].sum()),
            "identity": _share(found[:, j], visible[:, j]),
            "wrong_labels": int(wrong[:, j].sum()),
            "measured_error_px": _spread(error[:, j][found[:, j]]),
            "prediction_error_px": _spread(prediction_error[:, j][visible[:, j] & measured[:, j]]),
            "out_of_view_error_px": _spread(error[:, j][outside[:, j]]),
        }
        for j, (camera, spot) in enumerate(spots.views)
    ]
    return {
        "frames": int(has_truth.any(axis=1).sum()),
        "in_view_identity": _share(found, visible),
        "in_view_rows": int(visible.sum()),
        "wrong_labels": int(wrong.sum()),
        "wrong_label_share": _share(wrong, measured & has_truth),
        # `straight` excludes the rows of matching step 2, as the paper does; `smooth` excludes sharp turns of the true
        # path instead, whatever the spot's status. Both exclude a track's first frames, in which its velocity is
        # unknown; `all_measured` excludes nothing.
        "prediction_px": {
            "smooth": _spread(prediction_error[visible & measured & ~bent & ~starting]),
            "straight": _spread(prediction_error[visible & spots.has(SpotStatus.MATCHED) & ~starting]),
            "turned": _spread(prediction_error[visible & spots.has(SpotStatus.TURNED)]),
            "bends": _spread(prediction_error[visible & bent]),
            "start": _spread(prediction_error[visible & starting]),
            "all_measured": _spread(prediction_error[visible & measured]),
        },
        "measured_px": _spread(error[found]),
        "out_of_view_px": _spread(error[outside]),
        "out_of_view_but_visible_rows": int((reported_outside & (in_view == IN_VIEW)).sum()),
        "occluded_px": _spread(error[spots.has(SpotStatus.OCCLUDED) & np.isin(in_view, (IN_VIEW, HIDDEN))]),
        "visible_but_not_found_rows": int((visible & ~measured).sum()),
        "hidden_but_measured_rows": int((measured & pictured & (in_view == HIDDEN)).sum()),
        "re_entries": _returns(in_view, OUTSIDE, measured, right, pictured),
        "after_hiding": _returns(in_view, HIDDEN, measured, right, pictured),
        "recognition_rate_eq15": {
            # Huo (2015), eq. (15), S_correct / S_total. Its 65.97 % is about 4/6, as if every position computed
            # outside the picture counted as wrong. Therefore: correct detections over all rows; over those in view;
            # and over all rows with any position within SAME_SPOT_PX, measured or computed, counted as correct.
            "paper": _share(measured & right & has_truth, has_truth),
            "in_view": _share(found, visible),
            "all_within_tolerance": _share(close & has_truth, has_truth & np.isfinite(true_uv).all(axis=-1)),
        },
        "status_share": {str(s): _share(spots.status == i, spots.status >= 0) for i, s in enumerate(SPOT_STATUSES)},
        "tolerance_px": SAME_SPOT_PX,
        "per_spot": per_spot,
    }


def _bends(frames: Ints, true_uv: Array) -> Bools:
    """(F, V): sharp turns, where the true path deviates by more than BEND_PX from constant velocity."""
    out = np.zeros(true_uv.shape[:2], dtype=bool)
    if len(frames) > 2:
        step = true_uv[2:] - 2 * true_uv[1:-1] + true_uv[:-2]
        consecutive = (np.diff(frames)[1:] == 1) & (np.diff(frames)[:-1] == 1)
        out[2:] = consecutive[:, None] & (np.linalg.norm(step, axis=-1) > BEND_PX)
    return out


def _starting(spots: SpotGrid) -> Bools:
    """(F, V): the first two frames of each track."""
    known = (spots.status != ABSENT) & ~spots.has(SpotStatus.LOST)
    out = np.ones(known.shape, dtype=bool)
    out[2:] = ~(known[1:-1] & known[:-2])
    return out & known


def _returns(in_view: Ints, after: int, measured: Bools, right: Bools, pictured: Bools) -> dict[str, Any]:
    """Of the spots that come into view after state `after`: how many are found again under their own name.

    A return is kept if the first row measured within the following RETURN_FRAMES pictures is the correct spot. It
    counts only if there is such a picture with the spot in view. delay: pictures until that row (0: immediately).
    """
    total = kept = 0
    delays: list[int] = []
    for j in range(in_view.shape[1]):
        state = in_view[:, j]
        starts = np.flatnonzero((state[1:] == IN_VIEW) & (state[:-1] == after)) + 1
        for start in starts:
            ends = np.flatnonzero(state[start:] != IN_VIEW)
            stop = start + (ends[0] if len(ends) else len(state) - start)
            rows = np.arange(start, stop)
            rows = rows[pictured[rows, j]][: RETURN_FRAMES + 1]
            if not len(rows):
                continue
            total += 1
            hits = np.flatnonzero(measured[rows, j])
            if len(hits) and right[rows[hits[0]], j]:
                kept += 1
                delays.append(int(hits[0]))
    return {
        "total": total,
        "kept": kept,
        "median_delay_frames": float(np.median(delays)) if delays else None,
        "max_delay_frames": max(delays, default=None),
    }


def _pose_scores(poses: PoseTrack, truth: Pose) -> dict[str, Any]:
    known: Bools = poses.known & np.all(np.isfinite(truth.translation), axis=-1)
    delta = pose_errors(poses, truth)
    measured = known & poses.has(PoseStatus.MEASURED)
    predicted = known & poses.has(PoseStatus.PREDICTED)
    status = {str(s): _share(poses.status == i, poses.status >= 0) for i, s in enumerate(POSE_STATUSES)}
    return {
        "frames": int(known.sum()),
        "measured": _pose_spread(delta[measured], poses.covariance[measured]),
        "predicted": _pose_spread(delta[predicted], poses.covariance[predicted]),
        "status_share": status,
    }


def pose_errors(poses: PoseTrack, truth: Pose) -> Array:
    """(F, 6): truth minus estimate, [dt (m, world), dtheta (rad, body)]; nan where either is missing."""
    delta = truth.minus(poses.world_from_body)
    return np.where(np.isfinite(delta[:, :3]).all(axis=-1, keepdims=True), delta, np.nan)


def measured_errors(results: Path, folder: Path) -> tuple[Array, Array]:
    """Errors (n, 6), as of `pose_errors`, and covariances (n, 6, 6) of the measured poses of a results folder.

    folder: a run folder with the true poses.
    """
    tables = read_tables(ResultFolder(results))
    truth = read_truth(folder, tables.spots, tables.poses)
    if truth is None or truth.world_from_body is None:
        raise ValueError(f"{folder}: expected true poses, found none")
    delta = pose_errors(tables.poses, truth.world_from_body)
    use = np.isfinite(delta).all(axis=1) & tables.poses.has(PoseStatus.MEASURED)
    return delta[use], tables.poses.covariance[use]


def normalised_squares(delta: Array, covariance: Array) -> Array:
    """NEES (n,): delta^T C^-1 delta of errors (n, 6) and covariances (n, 6, 6); nan where C is singular.

    Its mean is 6 if the covariance is correct (Bar-Shalom, Li & Kirubarajan, 2001, section 5.4). Metres and radians
    differ in scale, so each C is scaled to unit diagonal first.
    """
    variance = np.diagonal(covariance, axis1=-2, axis2=-1)
    good: Bools = np.all(np.isfinite(covariance), axis=(-2, -1)) & np.all(variance > 0, axis=-1)
    scale = np.sqrt(np.where(good[:, None], variance, 1.0))
    C = np.where(good[:, None, None], covariance, np.eye(6)) / (scale[:, :, None] * scale[:, None, :])
    good = good & (np.linalg.eigvalsh(C)[:, 0] > 1e-12)
    C = np.where(good[:, None, None], C, np.eye(6))
    x = delta / scale
    return np.where(good, np.sum(x * np.linalg.solve(C, x[..., None])[..., 0], axis=-1), np.nan)


def _pose_spread(delta: Array, covariance: Array) -> dict[str, Any] | None:
    if not len(delta):
        return None
    position, angle = np.linalg.norm(delta[:, :3], axis=-1), np.degrees(np.linalg.norm(delta[:, 3:], axis=-1))
    nees = normalised_squares(delta, covariance)
    nees = nees[np.isfinite(nees)]
    n = len(nees)
    return {
        "rows": len(delta),
        "position_rms_m": dict(zip("xyz", _rms(delta[:, :3]), strict=True)),
        "position_m": _norms(position),
        "rotation_rms_deg": dict(zip("xyz", _rms(np.degrees(delta[:, 3:])), strict=True)),  # about the body's axes
        "rotation_deg": _norms(angle),
        "nees_mean": float(nees.mean()) if n else None,
        # Central 95 % interval of the mean of n independent rows; rows of a filter are not independent.
        "nees_mean_95": [2 * gamma_quantile(1 - p, 3 * n) / n for p in (0.025, 0.975)] if n else None,
        "nees_rows": n,
        # With the error of a truth: KNOWN_TO in each component.
        "beyond_10_sigmas": int(
            np.count_nonzero(normalised_squares(delta, covariance + KNOWN_TO**2 * np.eye(6)) > WRONG_SIGMAS**2)
        ),
    }


def _spread(error: Array) -> dict[str, Any] | None:
    """Of errors (n, 2), px: RMS per axis, and RMS, median, 99th percentile and maximum of their length."""
    error = error[np.isfinite(error).all(axis=-1)]
    if not len(error):
        return None
    u, v = _rms(error)
    return {"rms_u": u, "rms_v": v, **_norms(np.linalg.norm(error, axis=-1)), "rows": len(error)}


def _norms(distance: Array) -> dict[str, float]:
    return {
        "rms": float(np.sqrt(np.mean(distance**2))),
        "median": float(np.median(distance)),
        "p99": float(np.percentile(distance, 99)),
        "max": float(distance.max()),
    }


def _rms(error: Array) -> list[float]:
    return [float(x) for x in np.sqrt(np.mean(error**2, axis=0))]


def _share(part: Bools, whole: Bools) -> float | None:
    total = int(whole.sum())
    return int((part & whole).sum()) / total if total else None
