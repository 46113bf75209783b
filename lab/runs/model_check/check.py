"""The model check of a run: whether its rig file fits what was recorded, as findings and for summary.json."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from calibration.model_check.check import ModelCheckResult, NotTested, evaluate_model
from calibration.model_check.recording import ModelCheckRecording
from geometry.forward_model import SpotModel
from geometry.rig import Rig
from geometry.uncertainty.rig_uncertainty import RigCovariance
from lab.findings.finding import Finding, Level, verdict
from lab.runs.model_check.frame_sampler import FrameSampler
from lab.runs.model_check.messages import findings_of, why_not_tested
from lab.runs.model_check.place import with_place_errors
from lab.runs.model_check.summary import result_mapping


@dataclass(frozen=True, slots=True)
class ModelCheck:
    """The result of the model check with its findings."""

    result: ModelCheckResult
    findings: tuple[Finding, ...]  # the most severe first; empty where nothing was found
    image_sizes_px: Mapping[str, tuple[int, int]]  # of each camera: width, height

    @property
    def level(self) -> Level:
        """The level of the most severe finding."""
        return verdict(self.findings)

    @property
    def why_not(self) -> str:
        """Why the run was not tested; empty where it was."""
        return why_not_tested(self.result)

    def as_mapping(self) -> dict[str, Any]:
        """Plain values for summary.json.

        tested, why_not; frames_used, frames_for_diagnosis; findings: level (PASS, WARN, FAIL), code, what, why, remedy;
        residual_scale, noise_scale, correlation_frames, p_before, p_after: see FaultDiagnosis (under the covariances
        scaled by noise_of_cameras); suspected_faults: component, name, kind, delta and sigma (in rad, m, px, s, or
        relative), explained (chi-square), p; off_px, off_sigmas, attitude_deg, position_mm, pose_sigmas: see Effect;
        and alternatives, each with the same; views, cameras, beams: see GroupStatistics; image_sizes_px.
        """
        findings = [
            {"level": f.level.name, "code": f.code, "what": f.what, "why": f.why, "remedy": f.remedy}
            for f in self.findings
        ]
        out = {"tested": self.result.diagnosis is not None, "why_not": self.why_not, "findings": findings}
        out |= result_mapping(self.result)
        if self.result.statistics is not None:
            out["image_sizes_px"] = {camera: list(size) for camera, size in self.image_sizes_px.items()}
        return out


def check_model(rig: Rig, recording: ModelCheckRecording, calibration: RigCovariance | None = None) -> ModelCheck:
    """Test whether a recording fits the rig. calibration: covariance of the rig's parameters.

    Raises:
        ValueError: the recording has other views than the rig.
    """
    model = SpotModel.of(rig)
    if recording.seen.shape[1] == len(model):
        recording = with_place_errors(recording, model)
    result = evaluate_model(rig, recording, calibration)
    sizes = {name: camera.image_size_px for name, camera in rig.cameras.items()}
    return ModelCheck(result, findings_of(result, model), sizes)


def check_sampled_frames(rig: Rig, frames: FrameSampler, calibration: RigCovariance | None = None) -> ModelCheck:
    """`check_model` on the frames that were sampled from a run."""
    recording = frames.recording()
    if recording is None:
        return ModelCheck(ModelCheckResult(not_tested=NotTested.NO_FRAMES), (), {})
    return check_model(rig, recording, calibration)
