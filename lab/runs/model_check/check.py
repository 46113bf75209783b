"""Does the rig file fit the recording? Statistics, culprits and findings of one run.

Measured on simulated points (0.1 px noise, true labels; scenes smooth, sharp-turns, huo2015, two-cameras-per-screen,
four-skew-beams): no finding in 200 right recordings of 250 frames, and p-values as uniform as they should be. Of 8
recordings each of 600 frames: 0.05 deg of a beam, 3 ms of a camera and 2 mm of a screen are found in all; 0.02 deg of a
camera in all sideways and rolled, in 38 of 40 up or down. In one of 280 the true culprit was not among the (at most
three) accused; alone and wrongly accused was nothing. With one camera per screen, a camera that rolls is mostly named
together with the opposite one, and a beam of a fan raised with the other beams: only marked points tell these apart.

The sigmas are those that the detections claim. Claims too small are distinguished from faults: by 3 or 20 in all
cameras, a warning with the factor; by 4 in one camera of two or four, 3.8 and 1.0 for the others, p stays above 1e-4.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from calibration.findings import Finding, Level
from geometry.arrays import Array, Ints
from geometry.forward_model import SpotModel
from geometry.rig import Rig
from geometry.uncertainty.rig_parameters import RigCovariance
from lab.runs.model_check.effect import Effect, effect_of
from lab.runs.model_check.fault_identification import Explained, FaultDiagnosis, SuspectedFault, diagnose
from lab.runs.model_check.faults import FaultColumns, possible_faults
from lab.runs.model_check.frame_sampler import FrameSampler
from lab.runs.model_check.linear import LinearisedFrames, linearise
from lab.runs.model_check.messages import UNEVEN, culprit_finding, is_noisy, noise_finding, unexplained_finding
from lab.runs.model_check.place import with_place_errors
from lab.runs.model_check.recording import ModelCheckRecording, evenly
from lab.runs.model_check.statistics import Statistics, group_key, residual_weights, statistics
from lab.runs.model_check.unseen import unseen_finding, unseen_views

MOST_FRAMES = 2000  # for the statistics: their sigmas halve for four times as many only
MOST_FRAMES_FOR_CULPRITS = 400  # for the normal equations; 0.02 deg of a camera show in these
_MOST_NUMBERS = 12_000_000  # of one array of derivatives, 96 MB: large rigs make do with fewer frames ...
_FEWEST_FRAMES = 30  # ... but not with fewer than these; and a recording of fewer is not tested
_ROUNDS_OF_NOISE, _SETTLED = 5, 1.1  # of estimating the cameras' noise; a factor that changes it no more
_FEWEST_SPOTS = 3  # of a frame: fewer leave nothing for a test, whatever the pose


@dataclass(frozen=True, slots=True)
class ModelCheck:
    """What a recording says of its rig file."""

    frames_used: int  # for the statistics
    frames_for_culprits: int
    statistics: Statistics | None  # None where no frame has enough spots
    inquest: FaultDiagnosis | None  # None where there is too little to test
    effects: tuple[tuple[Effect, ...], ...]  # of each culprit: of its best explanation and of the rivals, in order
    findings: tuple[Finding, ...]  # the gravest things first; empty where nothing was found
    why_not: str = ""  # why nothing was tested; empty where it was
    noise_of_cameras: Mapping[str, float] = field(default_factory=dict)  # their errors over what the detections claim
    image_sizes_px: Mapping[str, tuple[int, int]] = field(default_factory=dict)  # of each camera: width, height

    @property
    def level(self) -> Level:
        """The gravest finding's."""
        return max((f.level for f in self.findings), default=Level.PASS)

    def as_mapping(self) -> dict[str, Any]:
        """For summary.json, plain values.

        tested, why_not; frames_used, frames_for_culprits; findings: level (PASS, WARN, FAIL), what, why, remedy;
        misfit, noise, correlation_frames, p_before, p_after: see Inquest (with the claims widened where the cameras'
        noise is uneven); noise_of_cameras; culprits: thing, name, kind, delta and sigma
        (in rad, m, px, s, or relative), explained (chi-square), p, off_px, off_sigmas, attitude_deg, position_mm,
        pose_sigmas: see Effect; and rivals, each with the same; views, cameras, beams: see GroupStatistics;
        image_sizes_px.
        """
        out: dict[str, Any] = {
            "tested": self.inquest is not None,
            "why_not": self.why_not,
            "frames_used": self.frames_used,
            "frames_for_culprits": self.frames_for_culprits,
            "findings": [
                {"level": f.level.name, "what": f.what, "why": f.why, "remedy": f.remedy} for f in self.findings
            ],
        }
        if self.inquest is not None:
            q = self.inquest
            out |= {
                "misfit": q.misfit,
                "noise": q.noise,
                "noise_of_cameras": dict(self.noise_of_cameras),
                "correlation_frames": q.correlation_frames,
                "p_before": q.p_before,
                "p_after": q.p_after,
                "culprits": [_mapping(c, e) for c, e in zip(q.culprits, self.effects, strict=True)],
            }
        if self.statistics is not None:
            out |= self.statistics.as_mapping()
            out["image_sizes_px"] = {camera: list(size) for camera, size in self.image_sizes_px.items()}
        return out


def check_model(rig: Rig, recording: ModelCheckRecording, calibration: RigCovariance | None = None) -> ModelCheck:
    """Test whether a recording fits the rig, and name the likely culprit where it does not.

    calibration: what is claimed of the rig's numbers; a misfit that it allows is no fault. Work and memory are bounded
    whatever the length: frames are thinned evenly. ValueError where the recording has other views than the rig.
    """
    model = SpotModel.of(rig)
    if recording.seen.shape[1] != len(model):
        raise ValueError(f"recording: expected {len(model)} views as the rig has, got {recording.seen.shape[1]}")
    recording = with_place_errors(recording, model)
    fit_for_it = np.flatnonzero(recording.usable.sum(axis=1) >= _FEWEST_SPOTS)
    columns = FaultColumns.of(rig, model, calibration)
    each = 2 * len(model) * len(columns.names)
    most = min(MOST_FRAMES_FOR_CULPRITS, max(_FEWEST_FRAMES, _MOST_NUMBERS // max(each, 1)))
    if len(fit_for_it) < _FEWEST_FRAMES:
        why = f"{len(fit_for_it)} frames have {_FEWEST_SPOTS} and more spots measured; the test needs {_FEWEST_FRAMES}"
        return ModelCheck(len(fit_for_it), 0, None, None, (), (), why)
    lin = linearise(model, recording, evenly(fit_for_it, most))
    moves = columns.at(recording, lin)
    expected = _calibration_px(lin, moves, columns.covariance, model, tuple(rig.beams))
    all_frames = linearise(model, recording, evenly(fit_for_it, MOST_FRAMES))
    sizes = {name: camera.image_size_px for name, camera in rig.cameras.items()}
    groups = statistics(model, tuple(rig.beams), recording, all_frames, expected)
    unseen = [unseen_finding(u, model) for u in unseen_views(model, recording, all_frames.frames)]
    if lin.dof <= 0:
        why = "in no frame are more spots measured than its pose takes"
        counts = len(all_frames.frames), len(lin.frames)
        return ModelCheck(*counts, groups, None, (), tuple(unseen), why, image_sizes_px=sizes)
    faults = possible_faults(rig, columns)
    inquest = diagnose(lin, moves, columns.covariance, faults)
    factor = [max(f, 1.0) for f in _noise_of_cameras(inquest, model)]
    # Cameras whose claims are wrong by different factors would break all tests, which weigh by the claims. The factors
    # are variance components (Helmert's): estimated, applied, and estimated again until they settle.
    misfit = inquest.misfit
    for _ in range(_ROUNDS_OF_NOISE if max(factor) > UNEVEN * min(factor) and is_noisy(max(factor), misfit) else 0):
        wider = np.array(factor)[model.camera_of][:, None, None] ** 2
        lin = linearise(model, replace(recording, cov_px2=recording.cov_px2 * wider), lin.frames)
        moves = columns.at(recording, lin)
        inquest = diagnose(lin, moves, columns.covariance, faults)
        before, factor = factor, [f * m for f, m in zip(factor, _noise_of_cameras(inquest, model), strict=True)]
        factor = [max(f, 1.0) for f in factor]
        if all(1 / _SETTLED < f / b < _SETTLED for f, b in zip(factor, before, strict=True)):
            break
    noise_of_cameras = dict(zip(model.camera_names, factor, strict=True))
    claimed = None if recording.pose_covariance is None else recording.pose_covariance[lin.frames]
    effects = tuple(
        tuple(
            effect_of(
                lin,
                moves,
                e.fault.numbers @ e.change.delta,
                e.fault.views,
                columns.covariance,
                claimed,
                inquest.excess_noise,
            )
            for e in c.explanations
        )
        for c in inquest.culprits
    )
    frame_s = float(np.median(np.diff(recording.t_s)))
    findings = [culprit_finding(c, e, inquest, model, frame_s) for c, e in zip(inquest.culprits, effects, strict=True)]
    if inquest.unexplained:
        findings.append(unexplained_finding(inquest))
    noisy = noise_finding(inquest, noise_of_cameras, misfit)
    if noisy is not None:
        findings.append(noisy)
    findings += unseen
    findings.sort(key=lambda f: -f.level)
    return ModelCheck(
        len(all_frames.frames),
        len(lin.frames),
        groups,
        inquest,
        effects,
        tuple(findings),
        noise_of_cameras=noise_of_cameras,
        image_sizes_px=sizes,
    )


def check_kept(rig: Rig, kept: FrameSampler, calibration: RigCovariance | None = None) -> ModelCheck:
    """As `check_model`, of the frames that a run has kept."""
    recording = kept.recording()
    if recording is None:
        return ModelCheck(0, 0, None, None, (), (), "there is no frame")
    return check_model(rig, recording, calibration)


def _noise_of_cameras(inquest: FaultDiagnosis, model: SpotModel) -> list[float]:
    """How much larger than claimed each camera's errors are that no fault makes; 1 where that is not known.

    The median of its views: one that is at fault by itself does not count for the camera.
    """
    out = []
    for c in range(len(model.camera_names)):
        known = inquest.noise_of_views[(model.camera_of == c) & np.isfinite(inquest.noise_of_views)]
        out.append(float(np.median(known)) if len(known) else 1.0)
    return out


def _calibration_px(
    lin: LinearisedFrames, moves: Array, covariance: Array, model: SpotModel, beams: tuple[str, ...]
) -> Mapping[str, Array]:
    """1 sigma (2,), px, that the calibration's errors make of each group's mean residual against the other spots."""
    known = np.flatnonzero(np.diagonal(covariance) > 0)
    if not known.size:
        return {}
    C = covariance[np.ix_(known, known)]

    def sigma(views: Ints) -> Array:
        off, spread = lin.against_the_rest(views, moves[..., known])
        weight = residual_weights(spread)  # as in the means that this is compared with
        total = weight.sum(axis=(0, 1))
        if not (total > 0).all():
            return np.full(2, np.nan)
        mean = np.sum(weight[..., None] * np.where(weight[..., None] > 0, off, 0.0), axis=(0, 1)) / total[:, None]
        return np.sqrt(np.maximum(np.einsum("ip,pq,iq->i", mean, C, mean), 0.0))

    out = {group_key("view", f"{c}/{s}"): sigma(np.array([i])) for i, (c, s) in enumerate(model.views)}
    for i, c in enumerate(model.camera_names):
        out[group_key("camera", c)] = sigma(np.flatnonzero(model.camera_of == i))
    for i, b in enumerate(beams):
        out[group_key("beam", b)] = sigma(np.flatnonzero(model.beam_of == i))
    return out


def _mapping(culprit: SuspectedFault, effects: tuple[Effect, ...]) -> dict[str, Any]:
    best, *rivals = (_explained(e, effect) for e, effect in zip(culprit.explanations, effects, strict=True))
    return {**best, "rivals": rivals}


def _explained(explained: Explained, effect: Effect) -> dict[str, Any]:
    change, fault = explained.change, explained.fault
    return {
        "thing": fault.thing,
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
