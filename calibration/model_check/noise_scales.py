"""Ratios of the spots' random errors to their stated sigmas: one for the recording, or one per camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibration.model_check.fault_identification import FaultDiagnosis, diagnose
from calibration.model_check.faults import FaultParameters, PossibleFault
from calibration.model_check.linearised_frames import LinearisedFrames, linearise
from calibration.model_check.recording import ModelCheckRecording
from geometry.arrays import Array
from geometry.forward_model import SpotModel

NOISY = 1.5  # noise scale from which it is reported; the limit of lab/runs/verdict/quality.py
UNEVEN = 1.5  # ratio of the cameras' largest to smallest noise scale from which each is reported
# Share of the squared residual scale that linearisation may leave of a fault in one camera. Measured: a camera 10 and
# 30 ms late in a motion with sharp turns leaves 0.5 and 0.9 %.
_LINEARISATION_SHARE = 0.02
_MOST_ITERATIONS, _CONVERGED = 5, 1.1  # converged: no noise scale changes by more than this factor


@dataclass(frozen=True, slots=True)
class WeightedDiagnosis:
    """A diagnosis with covariances that are scaled by the noise of each camera."""

    diagnosis: FaultDiagnosis
    lin: LinearisedFrames
    jacobian: Array  # (K, n, 2, p), whitened
    noise_of_cameras: tuple[float, ...]  # at least 1, in the order of SpotModel.camera_names
    stated_residual_scale: float  # residual scale under the covariances as stated


def is_noisy(noise_scale: float, residual_scale: float) -> bool:
    """Whether errors are so much larger than stated that it is reported.

    residual_scale includes all faults: linearisation leaves some of a large fault as apparent noise of one camera.
    """
    return noise_scale > NOISY and noise_scale**2 - 1 > _LINEARISATION_SHARE * residual_scale**2


def diagnose_with_noise_of_cameras(
    parameters: FaultParameters,
    recording: ModelCheckRecording,
    lin: LinearisedFrames,
    jacobian: Array,
    faults: Sequence[PossibleFault],
) -> WeightedDiagnosis:
    """Diagnose linearised frames, with one noise scale per camera where these differ much. jacobian: of `lin`.

    Sigmas that are wrong by different factors would invalidate all tests, which weight by them. The factors are
    variance components (Helmert): estimated, applied, and estimated again until they converge.
    """
    model = parameters.model
    diagnosis = diagnose(lin, jacobian, parameters.covariance, faults)
    factor = [max(f, 1.0) for f in _noise_of_cameras(diagnosis, model)]
    stated = diagnosis.residual_scale
    uneven = max(factor) > UNEVEN * min(factor) and is_noisy(max(factor), stated)
    for _ in range(_MOST_ITERATIONS if uneven else 0):
        wider = np.array(factor)[model.camera_of][:, None, None] ** 2
        lin = linearise(model, replace(recording, cov_px2=recording.cov_px2 * wider), lin.frames)
        jacobian = parameters.jacobian(recording, lin)
        diagnosis = diagnose(lin, jacobian, parameters.covariance, faults)
        before, factor = factor, [f * m for f, m in zip(factor, _noise_of_cameras(diagnosis, model), strict=True)]
        factor = [max(f, 1.0) for f in factor]
        if all(1 / _CONVERGED < f / b < _CONVERGED for f, b in zip(factor, before, strict=True)):
            break
    return WeightedDiagnosis(diagnosis, lin, jacobian, tuple(factor), stated)


def _noise_of_cameras(diagnosis: FaultDiagnosis, model: SpotModel) -> list[float]:
    """The noise scale of each camera; 1 where it is unknown.

    The median of its views: a single faulty view does not raise the scale of its camera.
    """
    out = []
    for c in range(len(model.camera_names)):
        known = diagnosis.noise_of_views[(model.camera_of == c) & np.isfinite(diagnosis.noise_of_views)]
        out.append(float(np.median(known)) if len(known) else 1.0)
    return out
