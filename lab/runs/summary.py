"""summary.json of a run."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from geometry.pose import Pose
from geometry.rotations import log
from lab.files.rig.calibration_state import state_mapping
from lab.files.run.fingerprints import fingerprints
from lab.files.run.run_file import Run
from lab.runs.frames.pipeline import Pipeline
from lab.runs.run_tally import MOST_EVENTS, RunTally
from lab.runs.smoothing_pass import SmoothingSummary
from lab.runs.verdict.quality import Verdict
from lab.runs.verdict.run_statistics import RunStatistics
from lab.versions import versions

if TYPE_CHECKING:
    from lab.runs.model_check.check import ModelCheck

SUMMARY_SCHEMA = "beampose/summary/1"


@dataclass(frozen=True, slots=True)
class RunResults:
    """The results of a run beside its tables."""

    tally: RunTally
    statistics: RunStatistics
    model_check: ModelCheck
    verdict: Verdict
    smoothing: SmoothingSummary | None  # None: causal only
    errors: Mapping[str, Any] | None  # against truth; None without truth


def summary_of(pipeline: Pipeline, results: RunResults, wall_s: float) -> dict[str, Any]:
    """The content of summary.json, plain values. wall_s: duration of the processing."""
    run = pipeline.run
    smoothing, timings = results.smoothing, pipeline.timings
    return {
        "schema": SUMMARY_SCHEMA,
        "name": run.name,
        "run_folder": str(run.folder.resolve()),
        "rig": str(run.rig_path.resolve()),
        "calibration": None if run.calibration is None else state_mapping(run.calibration),
        "notes_of_run": run.notes,
        "attitude": "causal" if smoothing is None else "smoothed",
        "smoother": None if smoothing is None else dataclasses.asdict(smoothing),
        "verdict": _verdict(results.verdict),
        "counts": _counts(results.tally, results.statistics),
        "rates": {
            "measured_share": results.statistics.measured / max(results.statistics.frames, 1),
            "frame_rate_hz": run.frame_rate_hz,
            "processed_frames_per_s": results.statistics.frames / wall_s if wall_s > 0 else None,
            "noise_scale": pipeline.tracker.noise_scale,
        },
        "model_check": results.model_check.as_mapping(),
        "errors": results.errors,
        "timings": {
            "waiting_for_pictures_s": timings.waiting,
            "detection_s": timings.detection,
            "tracking_s": timings.tracking,
            "smoothing_s": timings.smoothing,
            "wall_s": wall_s,
        },
        "versions": versions(),
        "parameters": {
            "tracker": dataclasses.asdict(run.tracker),
            "noise": {name: noise.as_mapping() for name, noise in pipeline.noise.items()},
            "prior": _prior_numbers(run),
            **({"clocks": _clock_numbers(run)} if run.clocks else {}),
        },
        "inputs": fingerprints(run),
        "notes": _notes(pipeline, results.tally),
        "events": [dataclasses.asdict(event) for event in results.tally.events],
    }


def _verdict(verdict: Verdict) -> dict[str, Any]:
    return {
        "status": verdict.status,
        "reasons": list(verdict.texts),
        "exit_status": verdict.exit_status,
        "evidence": [r.as_mapping() for r in verdict.reasons],
    }


def _counts(tally: RunTally, statistics: RunStatistics) -> dict[str, Any]:
    frames, cameras = max(statistics.frames, 1), statistics.cameras
    return {
        "frames": statistics.frames,
        "spot_status": {v: dict(c) for v, c in zip(tally.views, tally.spot_status, strict=False)},
        "pose_status": dict(statistics.pose),
        "detections_per_frame": {c: tally.detections[c] / frames for c in tally.cameras},
        "no_image": {name: c.missing.ranges for name, c in cameras.items() if len(c.missing)},
        "no_image_reasons": {name: dict(reasons) for name, reasons in tally.missing_reasons.items()},
        "events": dict(tally.event_kinds),
        "labels_left_open": tally.labels_left_open,
        "causal_measured": statistics.causal_measured,
        "not_measured": {cause.value: count for cause, count in statistics.causes.items()},
        "found_again": statistics.found_again,
        "contradictions": {"own_spots": len(statistics.own_spots), "causal": len(statistics.causal)},
        "invalid_covariances": len(statistics.invalid),
        "cameras": {name: c.as_mapping() for name, c in cameras.items()},
    }


def _notes(pipeline: Pipeline, tally: RunTally) -> list[str]:
    notes = pipeline.notes
    if pipeline.run.left_out:
        notes.append(f"cameras of the rig without data in this run: {', '.join(pipeline.run.left_out)}")
    if tally.unlisted:
        notes.append(f"events: the first {MOST_EVENTS} of {MOST_EVENTS + tally.unlisted} are listed")
    if away := _away_from_prior(pipeline.run, tally.first_pose):
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
    """By camera: the clocks that run.yaml states."""
    return {
        name: {
            "time_offset_s": clock.offset_s,
            "row_time_s": clock.row_time_s,
            "timestamps": None if clock.times_path is None else str(clock.times_path),
        }
        for name, clock in run.clocks.items()
    }
