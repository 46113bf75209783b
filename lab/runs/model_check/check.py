"""The model check of a run: whether its rig file fits what was recorded, as values for summary.json and findings.

A finding says which component is wrong, by how much, the effect on the pose, and the remedy. Over a vehicle at rest,
errors that depend on the place on the screen would look like faults.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from calibration.model_check import faults as f
from calibration.model_check.check import FEWEST_FRAMES, FEWEST_SPOTS, ModelCheckResult, NotTested, evaluate_model
from calibration.model_check.fault_identification import (
    UNEVEN,
    Effect,
    FaultDiagnosis,
    FittedFault,
    SuspectedFault,
    is_noisy,
)
from calibration.model_check.linearised_frames import ModelCheckRecording, UnseenView
from geometry.forward_model import SpotModel
from geometry.rig import Rig
from geometry.uncertainty.rig_uncertainty import RigCovariance
from lab.files.text.json_text import plain_value
from lab.findings.finding import Finding, Level, entries, finding, verdict, worst_first
from lab.number_format import format_count, format_number, format_p, format_with_sigma
from lab.runs.model_check.frame_sampler import FrameSampler
from tracking.smoothing.error_scale import LARGEST_WIDTH_SHARE
from tracking.smoothing.place_errors import correlation, place_errors

_CHUNK = 500  # frames that are compared with each other at once


def with_place_errors(recording: ModelCheckRecording, model: SpotModel) -> ModelCheckRecording:
    """The recording with covariances that include such errors, for tests that sum over its frames.

    Frames in which a spot is at the same place share the same error. Adding to each covariance the place's variance
    times the number of such frames gives the correct uncertainty of a sum over them. Errors that are the same at all
    places of a spot are not included. Where the widths of the spots are unknown (points of another program), the stated
    covariances are used unchanged.
    """
    if recording.width_px is None or not np.isfinite(recording.width_px).any():
        return recording
    uv, _ = model.project(recording.poses)
    usable = recording.usable & np.isfinite(uv).all(axis=-1)
    size2 = 0.5 * np.trace(recording.cov_px2, axis1=-2, axis2=-1)
    residual = np.where(usable[..., None], (recording.uv_px - uv) / np.sqrt(size2)[..., None], np.nan)
    frames, n = usable.shape
    found = place_errors(residual, recording.uv_px, recording.width_px, np.ones(frames), np.zeros(n))
    share = max(found.share - found.elsewhere, 0.0)
    if share == 0.0:
        return recording
    added = np.zeros(usable.shape)
    for view in range(n):
        rows = np.flatnonzero(usable[:, view])
        if not len(rows):
            continue
        width = recording.width_px[view] if np.isfinite(recording.width_px[view]) else np.nanmedian(recording.width_px)
        square = np.mean(np.sum((recording.uv_px[rows, view] - uv[rows, view]) ** 2, axis=-1)) / 2
        # An error larger than texture and speckle can cause is a displacement.
        place = min(share * max(square, size2[rows, view].mean()), (LARGEST_WIDTH_SHARE * width) ** 2)
        for some in np.array_split(rows, len(rows) // _CHUNK + 1):
            at = recording.uv_px[some, view]
            rho = correlation(np.linalg.norm(at[:, None] - at[None], axis=-1), found.reach_px[view])
            # The other chunks are assumed to be like this one.
            added[some, view] = place * rho.sum(axis=1) * len(rows) / len(some)
    return replace(recording, cov_px2=recording.cov_px2 + added[..., None, None] * np.eye(2))


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
        out |= plain_value(asdict(result.statistics))
    return out


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
        **{name: value for name, value in asdict(effect).items() if name not in ("view", "axis")},
    }


MATTERS_SIGMAS = 0.5  # in stated sigmas of a pose or a spot: a smaller bias is negligible against the stated sigma
# A larger bias makes the stated sigmas wrong; the limit of the noise scale in lab/runs/verdict/quality.py is the same.
WRONG_SIGMAS = 5.0
_VIEWS_OF_A_POSE = 3  # spots that fit some pose whatever they are
_WHOLE_FRAME = 0.1  # of a frame interval: a delay this near to a whole number of frames suggests a wrong frame number


def findings_of(result: ModelCheckResult, model: SpotModel) -> tuple[Finding, ...]:
    """All findings, the most severe first."""
    findings = []
    diagnosis = result.diagnosis
    if diagnosis is not None:
        for suspected, effects in zip(diagnosis.suspected_faults, result.effects, strict=True):
            findings.append(fault_finding(suspected, effects, diagnosis, model, result.frame_interval_s))
        if diagnosis.unexplained:
            findings.append(unexplained_finding(diagnosis))
        noisy = noise_finding(result, diagnosis)
        if noisy is not None:
            findings.append(noisy)
    findings += [unseen_finding(u, model) for u in result.unseen]
    if result.usual_views <= _VIEWS_OF_A_POSE and len(result.unseen) > result.usual_views:
        what = (
            f"{result.usual_views} spots are measured in most frames, as many as a pose needs, and"
            f" {len(result.unseen)} others that the pose puts well inside the pictures are never found: nothing"
            " confirms the poses"
        )
        findings.append(finding("BP-M05", Level.FAIL, what, variant="unconfirmed"))
    return worst_first(findings)


def level_of(diagnosis: FaultDiagnosis, effects: Sequence[Effect]) -> Level:
    """How severe a significant fault is. effects: of all its possible explanations.

    Explanations that cannot be distinguished fail only if each of them would, and pass only if each of them would.
    """

    def above(sigmas: float) -> list[bool]:
        return [e.pose_sigmas > sigmas or e.off_sigmas > sigmas for e in effects]

    if _scale_of_faults(diagnosis) > WRONG_SIGMAS or all(above(WRONG_SIGMAS)):
        return Level.FAIL
    return Level.WARN if any(above(MATTERS_SIGMAS)) else Level.PASS


def fault_finding(
    suspected: SuspectedFault,
    effects: Sequence[Effect],
    diagnosis: FaultDiagnosis,
    model: SpotModel,
    frame_interval_s: float,
) -> Finding:
    """The finding for one suspected fault. effects: of its explanations, in order."""
    level, effect = level_of(diagnosis, effects), effects[0]
    descriptions = [_description(e, model, frame_interval_s) for e in suspected.explanations]
    what = descriptions[0]
    if len(descriptions) > 1:
        count = suspected.more_alternatives
        more = f"; or one of {count} more" if count > 1 else "; or one more" if count else ""
        what += f". Or {'; or '.join(descriptions[1:])}{more}: this recording does not distinguish them"
    p_value = format_p(suspected.best.change.p_value)
    if effect.axis >= 0:
        camera, spot = model.views[effect.view]
        what += (
            f". Spot {spot} in camera `{camera}` lies {format_number(effect.off_sigmas, 2)} sigma"
            f" ({format_number(effect.off_px, 2)} px) off in {'uv'[effect.axis]} against the other spots, p {p_value}"
        )
    else:
        what += f", p {p_value}"
    components = list(dict.fromkeys(e.fault.component for e in suspected.explanations))
    remedy = " ".join(entries()["BP-M01"].variant(c).remedy for c in components)
    if suspected.alternatives:
        way = "A new calibration of the beams" if components == [f.BEAM] else "A `calibrate check` with marked points"
        remedy += f" {way} distinguishes the candidates."
    return finding("BP-M01", level, what, why=_consequence(effects, level), remedy=remedy)


def unexplained_finding(diagnosis: FaultDiagnosis) -> Finding:
    """The finding for residuals that no single fault explains."""
    level = Level.FAIL if _scale_of_faults(diagnosis) > WRONG_SIGMAS else Level.WARN
    beyond = "" if not diagnosis.suspected_faults else " beyond what is named above"
    what = (
        f"the residuals do not fit the rig file{beyond}, and no single camera, screen, beam or clock explains it,"
        f" p {format_p(diagnosis.p_after)}"
    )
    why = (
        f"the residuals are {format_number(diagnosis.residual_scale, 2)} times as large as the spots' sigmas allow; the"
        " stated sigmas of the poses do not include this"
    )
    return finding("BP-M02", level, what, why=why)


def noise_finding(result: ModelCheckResult, diagnosis: FaultDiagnosis) -> Finding | None:
    """The finding for errors that are larger than stated and that no fault of the rig explains; None where none are.

    Random noise widens the poses' covariances, which stay correct, so it is a warning whatever its size. Errors that
    are correlated over frames do not average out as noise does, so they fail beyond WRONG_SIGMAS.
    """
    of_cameras = result.noise_of_cameras
    factor = max(of_cameras.values())
    if not is_noisy(factor, result.stated_residual_scale):
        return None
    size = f"{format_number(factor, 2)} times as large as the sigmas of the detections"
    uneven = factor > UNEVEN * min(of_cameras.values())
    each = ", ".join(f"camera `{name}` {format_number(value, 2)}" for name, value in of_cameras.items())
    where = f" ({each})" if uneven else ""
    if diagnosis.is_correlated:
        what = (
            f"the spots' residuals are {size}{where}, are correlated over about {diagnosis.correlation_frames:.0f} of"
            " the frames used, and no constant change of a camera, screen, beam or clock explains them"
        )
        return finding("BP-M03", Level.FAIL if factor > WRONG_SIGMAS else Level.WARN, what)
    what = f"the spots' residuals are {size}{where}; they are random, and no fault of the rig explains them"
    return finding("BP-M04", Level.WARN, what)


def unseen_finding(unseen: UnseenView, model: SpotModel) -> Finding:
    """The finding for a view that is hardly ever measured."""
    camera, spot = model.views[unseen.view]
    what = (
        f"spot {spot} in camera `{camera}` was measured in {unseen.measured} of {unseen.expected} frames in which the"
        " pose puts it well inside the picture"
    )
    return finding("BP-M05", Level.WARN, what)


def _scale_of_faults(diagnosis: FaultDiagnosis) -> float:
    """Residual scale over noise scale: the part that the rig, not the detections, is responsible for."""
    return diagnosis.residual_scale / diagnosis.excess_noise


def _consequence(effects: Sequence[Effect], level: Level) -> str:
    known = [e for e in effects if np.isfinite(e.attitude_deg)]
    if not known:
        return "no frame alone determines its pose, so the effect on the poses is unknown"
    bias = f"{_range([e.attitude_deg for e in known])} deg and {_range([e.position_mm for e in known])} mm"
    sigmas = [e.pose_sigmas for e in known if np.isfinite(e.pose_sigmas)]
    of = f", {_range(sigmas)} of its stated sigmas" if sigmas else ""
    if level == Level.PASS:
        return f"it is significant but small: it rotates and shifts the pose by {bias}{of}"
    return f"it rotates and shifts the pose by about {bias}{of}; averaging over frames does not reduce it"


def _range(values: Sequence[float]) -> str:
    """`0.31`, or `0.31 to 0.64` where they differ by more than a tenth."""
    low, high = min(values), max(values)
    return format_number(high, 2) if high <= 1.1 * low else f"{format_number(low, 2)} to {format_number(high, 2)}"


def _description(e: FittedFault, model: SpotModel, frame_interval_s: float) -> str:
    """`camera `right` may have turned, by 0.35 ± 0.02 mrad`."""
    fault, delta = e.fault, e.change.delta
    sigma = np.sqrt(np.maximum(np.diagonal(e.change.covariance), 0.0))

    def size(part: slice, unit: str, factor: float) -> str:
        length = float(np.linalg.norm(delta[part]))
        along = delta[part] / max(length, 1e-300)
        of = float(np.sqrt(along**2 @ sigma[part] ** 2))
        return f"{format_with_sigma(factor * length, factor * of)} {unit}"

    every = slice(None)
    subject = f"{fault.component} `{fault.name}`"
    match fault.kind:
        case f.TURNED:
            return f"{subject} may have turned, by {size(every, 'mrad', 1e3)}"
        case f.SHIFTED:
            return f"{subject} may have moved: its picture is shifted by {size(every, 'px', 1.0)}"
        case f.ZOOMED:
            return f"the focal length of {subject} may have changed, by {size(every, '%', 100.0)}"
        case f.MOVED:
            turn, move = size(slice(3), "mrad", 1e3), size(slice(3, 6), "mm", 1e3)
            return f"{subject} may have moved, by {move} and {turn}"
        case f.ALONG_NORMAL:
            return f"{subject} may have moved, by {size(every, 'mm', 1e3)} along its normal"
        case f.TILTED:
            turn, move = size(slice(1, 3), "mrad", 1e3), size(slice(1), "mm", 1e3)
            return f"{subject} may have moved, by {move} along its normal, and tilted by {turn}"
        case f.DIRECTION_WRONG:
            return f"the direction of {subject} may be wrong, by {size(every, 'deg', float(np.rad2deg(1.0)))}"
        case f.POINT_WRONG:
            return f"{subject} may have shifted sideways, by {size(every, 'mm', 1e3)}"
        case f.LASER_MOVED:
            turn, move = size(slice(2), "deg", float(np.rad2deg(1.0))), size(slice(2, 4), "mm", 1e3)
            return f"{subject} may have moved, by {move} and {turn}"
        case f.LATE:
            return _delay(fault.name, float(delta[0]), float(sigma[0]), model, frame_interval_s)
        case _:
            camera, spot = fault.name.rsplit("/", 1)
            return f"spot {spot} has a constant offset in camera `{camera}`, of {size(every, 'px', 1.0)}"


def _delay(name: str, late_s: float, sigma_s: float, model: SpotModel, frame_interval_s: float) -> str:
    """Of two cameras, names the later one; of more, the one that is late or early against the others."""
    filming = [c for i, c in enumerate(model.camera_names) if (model.camera_of == i).any()]
    others, word = "the others", "late" if late_s > 0 else "early"
    if len(filming) == 2:
        other = next(c for c in filming if c != name)
        name, others, word = (name, f"camera `{other}`", "late") if late_s > 0 else (other, f"camera `{name}`", "late")
    size = f"{format_with_sigma(1e3 * abs(late_s), 1e3 * sigma_s)} ms"
    text = f"camera `{name}` is about {size} {word} against {others}"
    count = round(abs(late_s) / frame_interval_s) if frame_interval_s > 0 else 0
    if count and abs(abs(late_s) / frame_interval_s - count) < _WHOLE_FRAME:
        text += f" (that is {format_count(count, 'frame')}: its pictures may be numbered wrongly)"
    return text


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
        match self.result.not_tested:
            case NotTested.NO_FRAMES:
                return "there is no frame"
            case NotTested.FEW_FRAMES:
                used = f"{self.result.frames_used} frames have {FEWEST_SPOTS} and more spots measured"
                return f"{used}; the test needs {FEWEST_FRAMES}"
            case NotTested.NO_REDUNDANCY:
                return "no frame has more spots measured than its pose needs"
            case None:
                return ""

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

    Raises ValueError: the recording has other views than the rig.
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
