"""Tests whether a rig fits a recording: statistics of the residuals, suspected faults and their effects.

Measured on simulated points (0.1 px noise, true labels; scenes smooth, sharp-turns, huo2015, two-cameras-per-screen,
four-skew-beams): no suspected fault in 200 correct recordings of 250 frames, with uniform p-values. Of 8 recordings
each of 600 frames, these are found in all: 0.05 deg of a beam, 3 ms of a camera, 2 mm of a screen; and 0.02 deg of a
camera sideways or about its axis. Up or down, 0.02 deg are found in 38 of 40. In one of 280 recordings the true fault
was not among the (at most three) suspected ones; no recording had a wrong one alone. With one camera per screen, a
camera turned about its axis is mostly reported together with the opposite one, and a raised beam of a fan together with
the other beams: only marked points distinguish these.

The sigmas are those that the detections state. Sigmas that are too small are distinguished from faults: with a factor
of 3 or 20 in all cameras, the noise scale is reported; with a factor of 4 in one camera of two or four, it is 3.8 for
that camera and 1.0 for the others, and p stays above 1e-4.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from calibration.model_check.fault_identification import (
    Effect,
    EffectContext,
    FaultDiagnosis,
    WeightedDiagnosis,
    diagnose_with_noise_of_cameras,
    effect_of,
)
from calibration.model_check.faults import FaultParameters, possible_faults
from calibration.model_check.linearised_frames import (
    LinearisedFrames,
    ModelCheckRecording,
    UnseenView,
    evenly_spaced,
    linearise,
    unseen_views,
)
from calibration.model_check.statistics import Statistics, calibration_sigmas_px, statistics
from geometry.arrays import Ints
from geometry.forward_model import SpotModel
from geometry.rig import Rig
from geometry.uncertainty.rig_uncertainty import RigCovariance

MOST_FRAMES = 2000  # for the statistics: four times as many would only halve their sigmas
MOST_FRAMES_FOR_DIAGNOSIS = 400  # for the normal equations; enough to find 0.02 deg of a camera
_LARGEST_ARRAY = 12_000_000  # numbers in one array of derivatives, 96 MB: large rigs use fewer frames ...
FEWEST_FRAMES = 30  # ... but at least this many; a shorter recording is not tested
_EVENTS = 0.2  # share of the frames that may show something else than the rest
FEWEST_SPOTS = 3  # per frame: with fewer the pose absorbs all residuals


class NotTested(StrEnum):
    """Why a recording was not tested."""

    NO_FRAMES = "no_frames"
    FEW_FRAMES = "few_frames"  # fewer than FEWEST_FRAMES with FEWEST_SPOTS
    NO_REDUNDANCY = "no_redundancy"  # the poses absorb all residuals


@dataclass(frozen=True, slots=True)
class ModelCheckResult:
    """The result of the test of a rig against a recording."""

    frames_used: int = 0  # for the statistics
    frames_for_diagnosis: int = 0
    not_tested: NotTested | None = None  # None: tested
    statistics: Statistics | None = None  # None where too few frames have enough spots
    diagnosis: FaultDiagnosis | None = None  # None where not tested
    effects: tuple[tuple[Effect, ...], ...] = ()  # per suspected fault: of each of its explanations, in order
    unseen: tuple[UnseenView, ...] = ()
    noise_of_cameras: Mapping[str, float] = field(default_factory=dict)  # ratio of their errors to the stated sigmas
    stated_residual_scale: float = float("nan")  # residual scale before these ratios are applied
    frame_interval_s: float = float("nan")  # median


def evaluate_model(
    rig: Rig, recording: ModelCheckRecording, calibration: RigCovariance | None = None
) -> ModelCheckResult:
    """Test whether a recording fits the rig, and identify the likely fault where it does not.

    calibration: covariance of the rig's parameters; deviations that it allows are no faults. Run time and memory are
    bounded whatever the length of the recording: its frames are thinned evenly.

    Raises:
        ValueError: the recording has other views than the rig.
        KeyError: `calibration` names a parameter that the rig does not have.
    """
    model, beams = SpotModel.of(rig), tuple(rig.beams)
    if recording.seen.shape[1] != len(model):
        raise ValueError(f"recording: expected {len(model)} views as the rig has, got {recording.seen.shape[1]}")
    testable = np.flatnonzero(recording.usable.sum(axis=1) >= FEWEST_SPOTS)
    parameters = FaultParameters.of(rig, model, calibration)
    if len(testable) < FEWEST_FRAMES:
        return ModelCheckResult(frames_used=len(testable), not_tested=NotTested.FEW_FRAMES)
    numbers_per_frame = 2 * len(model) * len(parameters.names)
    most = min(MOST_FRAMES_FOR_DIAGNOSIS, max(FEWEST_FRAMES, _LARGEST_ARRAY // max(numbers_per_frame, 1)))
    lin = linearise(model, recording, evenly_spaced(testable, most))
    jacobian = parameters.jacobian(recording, lin)
    calibration_px = calibration_sigmas_px(lin, jacobian, parameters.covariance, model, beams)
    all_frames = linearise(model, recording, evenly_spaced(testable, MOST_FRAMES))
    groups = statistics(model, beams, recording, all_frames, calibration_px)
    unseen = unseen_views(model, recording, all_frames.frames)
    counts = len(all_frames.frames), len(lin.frames)
    if lin.dof <= 0:
        return ModelCheckResult(*counts, NotTested.NO_REDUNDANCY, statistics=groups, unseen=unseen)
    faults = possible_faults(rig, parameters)
    weighted = diagnose_with_noise_of_cameras(parameters, recording, lin, jacobian, faults)
    if weighted.diagnosis.unexplained:
        usual = _usual_frames(lin)
        few = linearise(model, recording, usual)
        of_few = parameters.jacobian(recording, few)
        without = diagnose_with_noise_of_cameras(parameters, recording, few, of_few, faults)
        if not without.diagnosis.suspected_faults and not without.diagnosis.unexplained:
            weighted, counts = without, (len(all_frames.frames), len(usual))
    return ModelCheckResult(
        *counts,
        statistics=groups,
        diagnosis=weighted.diagnosis,
        effects=_effects(weighted, parameters, recording),
        unseen=unseen,
        noise_of_cameras=dict(zip(model.camera_names, weighted.noise_of_cameras, strict=True)),
        stated_residual_scale=weighted.stated_residual_scale,
        frame_interval_s=float(np.median(np.diff(recording.t_s))),
    )


def _usual_frames(lin: LinearisedFrames) -> Ints:
    """The frames without the fifth that has the largest residuals for its degrees of freedom.

    What no fault explains, and what is not in these frames, is an event: a person in front of a spot, a reflection.
    """
    chi2 = np.sum(lin.residual_part(lin.residual) ** 2, axis=(1, 2))
    dof = np.maximum(2 * lin.used.sum(axis=1) - lin.rank, 1)
    kept = np.argsort(chi2 / dof, kind="stable")[: len(chi2) - int(_EVENTS * len(chi2))]
    return np.asarray(np.sort(lin.frames[kept]))


def _effects(
    weighted: WeightedDiagnosis, parameters: FaultParameters, recording: ModelCheckRecording
) -> tuple[tuple[Effect, ...], ...]:
    lin, diagnosis = weighted.lin, weighted.diagnosis
    stated = None if recording.pose_covariance is None else recording.pose_covariance[lin.frames]
    context = EffectContext(lin, weighted.jacobian, parameters.covariance, stated, diagnosis.excess_noise)
    return tuple(
        tuple(effect_of(context, e.fault.directions @ e.change.delta, e.fault.views) for e in suspected.explanations)
        for suspected in diagnosis.suspected_faults
    )
