"""summary.json of a run."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from geometry.pose import Pose
from geometry.rotations import log
from lab.files.run.fingerprints import fingerprints
from lab.files.run.results import SUMMARY_SCHEMA
from lab.files.run.run_file import Run
from lab.findings.outcome import Verdict
from lab.runs.frames.pipeline import Pipeline
from lab.runs.processed import Processed
from lab.runs.smoothing_pass import SmoothingSummary
from lab.runs.verdict.run_statistics import MOST_EVENTS, RunStatistics

if TYPE_CHECKING:
    from lab.runs.model_check.check import ModelCheck


def processed_run(
    pipeline: Pipeline,
    statistics: RunStatistics,
    model_check: ModelCheck,
    verdict: Verdict,
    smoothing: SmoothingSummary | None,
    errors: Mapping[str, Any] | None,
    page: Callable[[Path, Mapping[str, Any]], object],
    full_hash: bool = False,
) -> Processed[RunStatistics]:
    """A run whose tables are written. smoothing: None: causal only. errors: against truth; None without truth."""
    run, timings = pipeline.run, pipeline.timings
    return Processed(
        schema=SUMMARY_SCHEMA,
        name=run.name,
        result=statistics,
        verdict=verdict,
        frames=statistics.frames,
        measured=statistics.measured,
        frame_rate_hz=run.frame_rate_hz,
        parameters={
            "tracker": dataclasses.asdict(run.tracker),
            "noise": {name: noise.as_mapping() for name, noise in pipeline.noise.items()},
            "prior": _prior_numbers(run),
            **({"clocks": _clock_numbers(run)} if run.clocks else {}),
        },
        inputs=fingerprints(run, full_hash),
        notes=_notes(pipeline, statistics),
        blocks={
            "run_folder": str(run.folder.resolve()),
            "rig": str(run.rig_path.resolve()),
            "calibration": None if run.calibration is None else run.calibration.as_mapping(),
            "notes_of_run": run.notes,
            "attitude": "causal" if smoothing is None else "smoothed",
            "smoother": None if smoothing is None else dataclasses.asdict(smoothing),
            "counts": _counts(statistics),
            "rates": {"noise_scale": pipeline.tracker.noise_scale},
            "model_check": model_check.as_mapping(),
            "errors": errors,
            "timings": {
                "waiting_for_pictures_s": timings.waiting,
                "detection_s": timings.detection,
                "tracking_s": timings.tracking,
                "smoothing_s": timings.smoothing,
            },
            "events": [dataclasses.asdict(event) for event in statistics.events.listed],
        },
        page=page,
    )


def _counts(statistics: RunStatistics) -> dict[str, Any]:
    frames, cameras = max(statistics.frames, 1), statistics.cameras
    return {
        "spot_status": {"/".join(view): dict(c) for view, c in statistics.spot_status.items()},
        "pose_status": dict(statistics.pose),
        "detections_per_frame": {name: c.points / frames for name, c in cameras.items()},
        "no_image": {name: c.missing.ranges for name, c in cameras.items() if len(c.missing)},
        "no_image_reasons": {name: dict(c.missing_reasons) for name, c in cameras.items() if len(c.missing)},
        "events": dict(statistics.events.kinds),
        "labels_left_open": statistics.labels_left_open,
        "causal_measured": statistics.causal_measured,
        "not_measured": {cause.value: count for cause, count in statistics.causes.items()},
        "found_again": statistics.found_again,
        "contradictions": {"own_spots": len(statistics.own_spots), "causal": len(statistics.causal)},
        "invalid_covariances": len(statistics.invalid),
        "cameras": {name: c.as_mapping() for name, c in cameras.items()},
    }


def _notes(pipeline: Pipeline, statistics: RunStatistics) -> list[str]:
    notes = pipeline.notes
    if pipeline.run.left_out:
        notes.append(f"cameras of the rig without data in this run: {', '.join(pipeline.run.left_out)}")
    if unlisted := statistics.events.unlisted:
        notes.append(f"events: the first {MOST_EVENTS} of {MOST_EVENTS + unlisted} are listed")
    at_start = statistics.first_measured == statistics.first_frame
    if away := _away_from_prior(pipeline.run, statistics.first_pose if at_start else None):
        notes.append(away)
    if outside := pipeline.run.paths_outside:
        notes.append(f"read from outside the run folder: {', '.join(map(str, outside))}")
    return notes


def _away_from_prior(run: Run, pose: Pose | None) -> str:
    """A note where the measured pose of the first frame is outside the prior that run.yaml states; otherwise empty."""
    if run.prior is None or pose is None or run.prior.contains(pose):
        return ""
    away_m = float(np.abs(pose.translation - run.prior.centre.translation).max())
    turned_deg = np.rad2deg(np.linalg.norm(log(run.prior.centre.rotation.T @ pose.rotation)))
    return (
        f"the first frame's pose is outside the prior of run.yaml: a coordinate is {away_m:.3g} m from position_m"
        f" (within_m: {run.prior.within_m:g}), the attitude {turned_deg:.3g} deg from that of the prior (within_deg:"
        f" {np.rad2deg(run.prior.within_rad):g}); correct the prior"
    )


def _prior_numbers(run: Run) -> dict[str, Any] | None:
    if run.prior is None:
        return None
    return {
        "position_m": run.prior.centre.translation.tolist(),
        "yaw_pitch_roll_deg": np.rad2deg(run.prior.centre.ypr).tolist(),
        "within_m": run.prior.within_m,
        "within_deg": float(np.rad2deg(run.prior.within_rad)),
    }


def _clock_numbers(run: Run) -> dict[str, Any]:
    """By camera: the clocks that run.yaml states, and those that were estimated, with their sigmas."""
    out: dict[str, Any] = {}
    for name, clock in run.clocks.items():
        out[name] = {
            "time_offset_s": clock.offset_s,
            "row_time_s": clock.row_time_s,
            "timestamps": None if clock.times_path is None else str(clock.times_path),
        }
        if clock.offset_prior_s:
            out[name] |= {
                "time_offset_sigma_s": clock.offset_sigma_s,
                "time_offset_prior_sigma_s": clock.offset_prior_s,
            }
        if clock.row_time_prior_s:
            out[name] |= {"row_time_sigma_s": clock.row_time_sigma_s, "row_time_prior_sigma_s": clock.row_time_prior_s}
    return out
