"""The model check's result as plain values for summary.json."""

from __future__ import annotations

from typing import Any

import numpy as np

from calibration.model_check.check import ModelCheckResult
from calibration.model_check.effect import Effect
from calibration.model_check.fault_identification import FittedFault, SuspectedFault
from calibration.model_check.statistics import GroupStatistics, Statistics


def result_mapping(result: ModelCheckResult) -> dict[str, Any]:
    """Counts, diagnosis and statistics; the keys are described in lab.runs.model_check.check."""
    out: dict[str, Any] = {
        "frames_used": result.frames_used,
        "frames_for_diagnosis": result.frames_for_diagnosis,
    }
    diagnosis = result.diagnosis
    if diagnosis is not None:
        out |= {
            "residual_scale": diagnosis.residual_scale,
            "noise_scale": diagnosis.noise_scale,
            "noise_of_cameras": dict(result.noise_of_cameras),
            "correlation_frames": diagnosis.correlation_frames,
            "p_before": diagnosis.p_before,
            "p_after": diagnosis.p_after,
            "suspected_faults": [
                _suspected_fault(suspected, effects)
                for suspected, effects in zip(diagnosis.suspected_faults, result.effects, strict=True)
            ],
        }
    if result.statistics is not None:
        out |= _statistics(result.statistics)
    return out


def _statistics(statistics: Statistics) -> dict[str, Any]:
    groups = {"views": statistics.views, "cameras": statistics.cameras, "beams": statistics.beams}
    return {kind: [_group(g) for g in of_kind] for kind, of_kind in groups.items()}


def _group(group: GroupStatistics) -> dict[str, Any]:
    nis = None if group.nis is None else {"mean": group.nis.mean, "low": group.nis.low, "high": group.nis.high}
    return {
        "name": group.name,
        "frames": group.frames,
        "mean_px": group.mean_px.tolist(),
        "sigma_of_mean_px": group.sigma_of_mean_px.tolist(),
        "mean_sigmas": group.mean_sigmas.tolist(),
        "calibration_px": group.calibration_px.tolist(),
        "scatter": group.scatter,
        "nis": nis,
        "outliers": group.outliers,
        "place_px": group.place_px.tolist(),
    }


def _suspected_fault(suspected: SuspectedFault, effects: tuple[Effect, ...]) -> dict[str, Any]:
    best, *others = (_fitted_fault(e, effect) for e, effect in zip(suspected.explanations, effects, strict=True))
    return {**best, "alternatives": others}


def _fitted_fault(fitted: FittedFault, effect: Effect) -> dict[str, Any]:
    change, fault = fitted.change, fitted.fault
    return {
        "component": fault.component,
        "name": fault.name,
        "kind": fault.kind,
        "delta": change.delta.tolist(),
        "sigma": np.sqrt(np.maximum(np.diagonal(change.covariance), 0.0)).tolist(),
        "explained": change.explained,
        "p": change.p_value,
        "off_px": effect.off_px,
        "off_sigmas": effect.off_sigmas,
        "attitude_deg": effect.attitude_deg,
        "position_mm": effect.position_mm,
        "pose_sigmas": effect.pose_sigmas,
    }
