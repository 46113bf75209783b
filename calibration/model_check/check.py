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

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from calibration.model_check.fault_identification import (
    Effect,
    FaultDiagnosis,
    WeightedDiagnosis,
    diagnose_with_noise_of_cameras,
    effect_of,
    movement_of_a_camera,
    pose_variances,
)
from calibration.model_check.faults import FaultParameters, possible_faults
from calibration.model_check.linearised_frames import (
    LinearisedFrames,
    ModelCheckRecording,
    UnseenView,
    correlation_time,
    linearise,
    unseen_views,
    whitening,
)
from geometry.arrays import Array, Ints, evenly_spaced, finite
from geometry.forward_model import SpotModel
from geometry.rig import Rig
from geometry.uncertainty.chi_square import gamma_quantile
from geometry.uncertainty.rig_uncertainty import RigCovariance

_FEWEST_FRAMES = 8  # with fewer, a scatter or an autocorrelation is meaningless


@dataclass(frozen=True, slots=True)
class NisMean:
    """Mean of the normalised innovations squared over 2: 1 if the covariances of the predictions are correct."""

    mean: float
    low: float  # bounds of the central 95 % for a correct model and this number of independent frames
    high: float


@dataclass(frozen=True, slots=True)
class GroupStatistics:
    """Residuals of one view, or of all views of a camera or a beam, against the pose of all other views."""

    name: str  # "right/5", "right", "B"
    frames: int  # with such a residual: the other views determine a pose
    mean_px: Array  # (2,) u, v, weighted by the stated variances; nan without frames
    sigma_of_mean_px: Array  # (2,) from the residuals' own scatter and their correlation in time
    mean_sigmas: Array  # (2,) the mean in stated sigmas of one measurement
    calibration_px: Array  # (2,) 1 sigma of the mean by the calibration's stated errors; 0 where it states none
    scatter: float  # mean squared residual about the mean / 2, in stated variances: 1 if the sigmas are correct
    nis: NisMean | None  # None without predictions and their covariances
    outliers: float  # share of the measurements that are gross outliers
    place_px: Array  # (2,) of one view: mean position of its spot; nan for groups of views


@dataclass(frozen=True, slots=True)
class Statistics:
    """The statistics of all groups."""

    views: tuple[GroupStatistics, ...]
    cameras: tuple[GroupStatistics, ...]
    beams: tuple[GroupStatistics, ...]


def nis_band(frames: float) -> tuple[float, float]:
    """Central 95 % interval of the mean of NIS / 2 over independent frames: a gamma distribution of mean 1."""
    shape = max(frames, 1.0)
    return gamma_quantile(0.975, shape) / shape, gamma_quantile(0.025, shape) / shape


def groups_of(model: SpotModel, beam_names: Sequence[str]) -> dict[str, dict[str, Ints]]:
    """The views of each group, by the fields of `Statistics` and by name."""
    return {
        "views": {f"{c}/{s}": np.array([i]) for i, (c, s) in enumerate(model.views)},
        "cameras": {c: np.flatnonzero(model.camera_of == i) for i, c in enumerate(model.camera_names)},
        "beams": {b: np.flatnonzero(model.beam_of == i) for i, b in enumerate(beam_names)},
    }


def calibration_sigmas_px(
    lin: LinearisedFrames, jacobian: Array, covariance: Array, groups: Mapping[str, Mapping[str, Ints]]
) -> dict[tuple[str, str], Array]:
    """By kind and name, 1 sigma (2,), px, of a group's mean residual that the calibration's stated errors cause.

    jacobian (K, n, 2, p), whitened; covariance (p, p), as the calibration states it. Empty where it states nothing.
    """
    known = np.flatnonzero(np.diagonal(covariance) > 0)
    if not known.size:
        return {}
    C = covariance[np.ix_(known, known)]

    def sigma(views: Ints) -> Array:
        off, spread = lin.leave_group_out(views, jacobian[..., known])
        weight = _weights(spread)  # the same as in the mean residuals
        total = weight.sum(axis=(0, 1))
        if not (total > 0).all():
            return np.full(2, np.nan)
        mean = np.sum(weight[..., None] * np.where(weight[..., None] > 0, off, 0.0), axis=(0, 1)) / total[:, None]
        return np.sqrt(np.maximum(np.einsum("ip,pq,iq->i", mean, C, mean), 0.0))

    return {(kind, name): sigma(views) for kind, named in groups.items() for name, views in named.items()}


def _weights(covariance: Array) -> Array:
    """Weights (..., 2) of the u and v residuals from their covariances (..., 2, 2): 1 / variance, 0 for nan."""
    variance = np.diagonal(covariance, axis1=-2, axis2=-1)
    good = finite(variance, -1)[..., None]
    return np.where(good, 1.0 / np.where(good, variance, 1.0), 0.0)


def _nis(recording: ModelCheckRecording, lin: LinearisedFrames) -> Array | None:
    """(K, n) normalised innovations squared; nan where there is none."""
    if recording.predicted_px is None or recording.predicted_cov_px2 is None:
        return None
    innovation = recording.uv_px[lin.frames] - recording.predicted_px[lin.frames]
    covariance = recording.cov_px2[lin.frames] + recording.predicted_cov_px2[lin.frames]
    known = lin.used & finite(innovation, -1) & finite(covariance, (-1, -2))
    z = whitening(covariance, known) @ np.where(known[..., None], innovation, 0.0)[..., None]
    return np.where(known, np.sum(z[..., 0] ** 2, axis=-1), np.nan)


def _nis_mean(nis: Array) -> NisMean | None:
    """The mean over K frames and v views, nis (K, v); None if all values are nan."""
    values = nis[np.isfinite(nis)] / 2
    if not values.size:
        return None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # the mean of a frame without values is nan, as intended
        series = np.asarray(np.nanmean(nis, axis=1)) / 2
    level = float(values.mean())
    return NisMean(level, *nis_band(len(values) / correlation_time((series - np.nanmean(series))[:, None])))


def _group(
    name: str, views: Ints, lin: LinearisedFrames, uv_px: Array, nis: Array | None, calibration_px: Array
) -> GroupStatistics:
    """uv_px (K, n, 2): measured; nis (K, n)."""
    r, spread = lin.leave_group_out(views, lin.residual)
    known = finite(r, -1)
    frames = known.any(axis=1)
    count = int(frames.sum())
    none = np.full(2, np.nan)
    mean, sigma_of_mean, mean_sigmas, scatter = none, none, none, float("nan")
    if count:
        # Weighted: sigmas differ tenfold where spots are smeared, and a few of those would dominate a plain mean.
        weight = _weights(spread)
        mean = np.sum(np.where(known[..., None], weight * r, 0.0), axis=(0, 1)) / weight.sum(axis=(0, 1))
        gap = np.where(known[..., None], r - mean, 0.0)
        # (K, 2): residuals of one frame are correlated, so they are summed before they are squared.
        pull = np.sum(weight * gap, axis=1)
        squares = np.sum(pull**2, axis=0) if count >= _FEWEST_FRAMES else weight.sum(axis=(0, 1))
        correlated = [correlation_time(np.where(frames, pull[:, i], np.nan)[:, None]) for i in (0, 1)]
        sigma_of_mean = np.sqrt(squares * correlated) / weight.sum(axis=(0, 1))
        # In stated sigmas of one measurement, not of its residual, which also contains the noise of the others.
        W = lin.W[:, views][known]
        information = np.diagonal(np.swapaxes(W, -1, -2) @ W, axis1=-2, axis2=-1)
        mean_sigmas = mean * np.sqrt(information.mean(axis=0))
        z = (whitening(spread, known) @ gap[..., None])[known]
        scatter = float(np.sum(z**2) / (2 * len(z)))
    place = uv_px[:, views[0]][lin.used[:, views[0]]] if len(views) == 1 else np.empty((0, 2))
    seen = int((lin.used | lin.outlier)[:, views].sum())
    return GroupStatistics(
        name=name,
        frames=count,
        mean_px=mean,
        sigma_of_mean_px=sigma_of_mean,
        mean_sigmas=mean_sigmas,
        calibration_px=calibration_px,
        scatter=scatter,
        nis=None if nis is None else _nis_mean(nis[:, views]),
        place_px=place.mean(axis=0) if len(place) else none,
        outliers=float(lin.outlier[:, views].sum() / seen) if seen else 0.0,
    )


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
    usual_views: int = 0  # views that are measured in at least half of the frames used
    noise_of_cameras: Mapping[str, float] = field(default_factory=dict)  # ratio of their errors to the stated sigmas
    stated_residual_scale: float = float("nan")  # residual scale before these ratios are applied
    frame_interval_s: float = float("nan")  # median
    moved_at_s: float | None = None  # time of the first frame after a camera has moved, as the residuals show it


def evaluate_model(
    rig: Rig, recording: ModelCheckRecording, calibration: RigCovariance | None = None
) -> ModelCheckResult:
    """Test whether a recording fits the rig, and identify the likely fault where it does not.

    calibration: covariance of the rig's parameters; deviations that it allows are no faults. Run time and memory are
    bounded whatever the length of the recording: its frames are thinned evenly. Raises ValueError: the recording has
    other views than the rig; KeyError: `calibration` names a parameter that the rig does not have.
    """
    model = SpotModel.of(rig)
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
    groups = groups_of(model, tuple(rig.beams))
    calibration_px = calibration_sigmas_px(lin, jacobian, parameters.covariance, groups)
    all_frames = linearise(model, recording, evenly_spaced(testable, MOST_FRAMES))
    uv, nis = recording.uv_px[all_frames.frames], _nis(recording, all_frames)
    statistics = Statistics(
        **{
            kind: tuple(
                _group(name, views, all_frames, uv, nis, calibration_px.get((kind, name), np.zeros(2)))
                for name, views in named.items()
            )
            for kind, named in groups.items()
        }
    )
    unseen = unseen_views(model, recording, all_frames.frames)
    usual = int(np.count_nonzero(recording.seen[all_frames.frames].mean(axis=0) >= 0.5))
    counts = len(all_frames.frames), len(lin.frames)
    if lin.dof <= 0:
        return ModelCheckResult(*counts, NotTested.NO_REDUNDANCY, statistics, unseen=unseen, usual_views=usual)
    faults = possible_faults(rig, parameters)
    weighted = diagnose_with_noise_of_cameras(parameters, recording, lin, jacobian, faults)
    moved_at = movement_of_a_camera(weighted, faults)
    if weighted.diagnosis.unexplained:
        usual_frames = _usual_frames(lin)
        few = linearise(model, recording, usual_frames)
        of_few = parameters.jacobian(recording, few)
        without = diagnose_with_noise_of_cameras(parameters, recording, few, of_few, faults)
        if not without.diagnosis.suspected_faults and not without.diagnosis.unexplained:
            weighted, counts = without, (len(all_frames.frames), len(usual_frames))
    return ModelCheckResult(
        *counts,
        statistics=statistics,
        diagnosis=weighted.diagnosis,
        effects=_effects(weighted, parameters, recording),
        unseen=unseen,
        usual_views=usual,
        noise_of_cameras=dict(zip(model.camera_names, weighted.noise_of_cameras, strict=True)),
        stated_residual_scale=weighted.stated_residual_scale,
        frame_interval_s=float(np.median(np.diff(recording.t_s))),
        moved_at_s=float(recording.t_s[lin.frames[moved_at]]) if moved_at >= 0 else None,
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
    stated = None if recording.pose_covariance is None else recording.pose_covariance[weighted.lin.frames]
    variances = pose_variances(weighted, parameters.covariance, stated)
    return tuple(
        tuple(effect_of(weighted, variances, e) for e in suspected.explanations)
        for suspected in weighted.diagnosis.suspected_faults
    )
