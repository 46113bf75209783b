"""The model check's findings in words: which thing, by how much, what it does to the pose, what to do."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from calibration.findings import Finding, Level
from geometry.forward_model import SpotModel
from lab.number_format import plus_minus, short
from lab.runs.model_check import faults as f
from lab.runs.model_check.effect import Effect
from lab.runs.model_check.fault_identification import Explained, FaultDiagnosis, SuspectedFault

MATTERS_SIGMAS = 0.5  # of a pose's claimed sigmas, or of a spot's: a bias below it is lost in what is claimed anyway
WRONG_SIGMAS = (
    5.0  # beyond it the run's claims are untrue; the misfit gate's limit is the same (lab/runs/verdict/quality.py)
)
NOISY = 1.5  # factor on the claimed sigmas from which it is reported; the limit of lab/runs/verdict/quality.py
UNEVEN = 1.5  # the largest over the smallest factor of the cameras, from which each is named
# Of the squared misfit: what a linear fit may leave of a fault in one camera. Measured: a camera 10 and 30 ms late in a
# motion with bends leaves 0.5 and 0.9 %.
_NOT_LINEAR = 0.02
_ONE_FRAME = 0.1  # of a frame interval: as near as this to a whole number of them, frames are counted wrong

_REMEDIES = {
    f.CAMERA: "Look for a knocked or loose mount, focus or zoom ring of that camera; fix it, run `calibrate check` to"
    " make sure, then find its place again (`calibrate rig`).",
    f.SCREEN: "Measure where that screen is (`calibrate screen`), then calibrate the rig again.",
    f.BEAM: "Check that laser's mount on the vehicle, then calibrate the beams again (`calibrate beams`).",
    f.VIEW: "Look at that spot in the pictures: a reflection, an edge of the screen or a wrong label; then at its"
    " laser.",
    f.CLOCK: "Check trigger cable, exposure settings and frame numbers of the cameras: one number must be one instant.",
}


def level_of(inquest: FaultDiagnosis, effects: Sequence[Effect]) -> Level:
    """How grave a significant fault is; effects: of everything that it may be.

    What cannot be told apart fails only if each of it would, and is small only if each of it is.
    """

    def worst(sigmas: float) -> list[bool]:
        return [e.pose_sigmas > sigmas or e.off_sigmas > sigmas for e in effects]

    if _misfit_of_faults(inquest) > WRONG_SIGMAS or all(worst(WRONG_SIGMAS)):
        return Level.FAIL
    return Level.WARN if any(worst(MATTERS_SIGMAS)) else Level.PASS


def culprit_finding(
    culprit: SuspectedFault, effects: Sequence[Effect], inquest: FaultDiagnosis, model: SpotModel, frame_s: float
) -> Finding:
    """One finding for one culprit. effects: of its explanations, in order; frame_s: the usual time between frames."""
    level, effect = level_of(inquest, effects), effects[0]
    told = [_told(e, model, frame_s) for e in culprit.explanations]
    says = told[0]
    if len(told) > 1:
        count = culprit.more_rivals
        also = f"; or one of {count} more" if count > 1 else "; or one more" if count else ""
        says = f"{'; or '.join(told)}{also}: this recording cannot tell which"
    where = ""
    if effect.axis >= 0:
        camera, spot = model.views[effect.view]
        where = (
            f"spot {spot} in camera `{camera}` lies {short(effect.off_sigmas, 2)} sigma ({short(effect.off_px, 2)} px)"
            f" off in {'uv'[effect.axis]} against the other spots: "
        )
    what = f"{where}{says}, p {p_text(culprit.best.change.p_value)}"
    things = list(dict.fromkeys(e.fault.thing for e in culprit.explanations))
    remedy = " ".join(_REMEDIES[t] for t in things) if level > Level.PASS else ""
    if culprit.rivals and level > Level.PASS:
        way = "A new calibration of the beams" if things == [f.BEAM] else "A `calibrate check` with marked points"
        remedy += f" {way} tells the candidates apart."
    return Finding(level, what, _consequence(effects, level), remedy)


def unexplained_finding(inquest: FaultDiagnosis) -> Finding:
    """What no single fault explains."""
    level = Level.FAIL if _misfit_of_faults(inquest) > WRONG_SIGMAS else Level.WARN
    alone = "" if not inquest.culprits else " beyond what is named above"
    return Finding(
        level,
        f"the residuals do not fit the rig file{alone}, and no single camera, screen, beam or clock explains it,"
        f" p {p_text(inquest.p_after)}",
        f"they are {short(inquest.misfit, 2)} times what the spots' sigmas allow; the stated sigmas of the poses leave"
        " this out",
        "Calibrate the rig again; if that does not help, check lens models and the flatness of the screens.",
    )


def is_noisy(factor: float, misfit: float) -> bool:
    """Whether errors are so much larger than claimed that it is reported.

    misfit: with all faults included. Of a large fault the linear model leaves some in one camera, which is no noise.
    """
    return factor > NOISY and factor**2 - 1 > _NOT_LINEAR * misfit**2


def noise_finding(inquest: FaultDiagnosis, of_cameras: Mapping[str, float], misfit: float) -> Finding | None:
    """Errors larger than claimed that no fault of the rig explains; None where the claims hold well enough.

    Noise changes from frame to frame; the poses' covariances are widened by it and stay right, so it is a warning
    whatever its size. What lasts over frames is not averaged away as noise is, so it fails beyond WRONG_SIGMAS.
    of_cameras: how much larger than claimed the errors of each are; misfit: of the claims, faults included.
    """
    factor = max(of_cameras.values())
    if not is_noisy(factor, misfit):
        return None
    size = f"{short(factor, 2)} times as large as the sigmas of the detections"
    uneven = factor > UNEVEN * min(of_cameras.values())
    each = ", ".join(f"camera `{name}` {short(value, 2)}" for name, value in of_cameras.items())
    where = f" ({each})" if uneven else ""
    if inquest.lasts:
        return Finding(
            Level.FAIL if factor > WRONG_SIGMAS else Level.WARN,
            f"the spots' residuals are {size}{where}, last over about {inquest.correlation_frames:.0f} of the frames"
            " used, and no constant change of a camera, screen, beam or clock explains them",
            "errors that last do not average out over frames: the stated sigmas of the poses are too small",
            "Check lens models, the flatness of the screens and the light (reflections, clipped spots); then calibrate"
            " the rig again.",
        )
    return Finding(
        Level.WARN,
        f"the spots' residuals are {size}{where}; they are random, and no fault of the rig explains them",
        "the sigmas of the detections are too small (speckle, vibration within an exposure, or sigmas of another"
        " program); the covariances of the poses are widened by this factor",
        "State larger sigmas with the detections, or improve the light: larger or brighter spots, a shorter exposure,"
        " a matt screen.",
    )


def _misfit_of_faults(inquest: FaultDiagnosis) -> float:
    """The misfit in units of the recording's own noise: what the rig, not the detections, is responsible for."""
    return inquest.misfit / inquest.excess_noise


def _consequence(effects: Sequence[Effect], level: Level) -> str:
    known = [e for e in effects if np.isfinite(e.attitude_deg)]
    if not known:
        return "no frame alone has a pose, so what it does to them cannot be told"
    bias = f"{_range([e.attitude_deg for e in known])} deg and {_range([e.position_mm for e in known])} mm"
    sigmas = [e.pose_sigmas for e in known if np.isfinite(e.pose_sigmas)]
    of = f", {_range(sigmas)} of its claimed sigmas" if sigmas else ""
    if level == Level.PASS:
        return f"it is sure but small: it turns and moves the pose by {bias}{of}"
    return f"it turns and moves the pose by about {bias}{of}; averaging over frames does not lessen it"


def _range(values: Sequence[float]) -> str:
    """`0.31`, or `0.31 to 0.64` where they differ by more than a tenth."""
    low, high = min(values), max(values)
    return short(high, 2) if high <= 1.1 * low else f"{short(low, 2)} to {short(high, 2)}"


def _told(e: Explained, model: SpotModel, frame_s: float) -> str:
    """`camera `right` may have turned, by 0.35 ± 0.02 mrad`."""
    fault, delta = e.fault, e.change.delta
    sigma = np.sqrt(np.maximum(np.diagonal(e.change.covariance), 0.0))

    def size(part: slice, unit: str, factor: float) -> str:
        length = float(np.linalg.norm(delta[part]))
        along = delta[part] / max(length, 1e-300)
        of = float(np.sqrt(along**2 @ sigma[part] ** 2))
        return f"{plus_minus(factor * length, factor * of)} {unit}"

    every = slice(None)
    thing = f"{fault.thing} `{fault.name}`"
    match fault.kind:
        case f.TURNED:
            return f"{thing} may have turned, by {size(every, 'mrad', 1e3)}"
        case f.SHIFTED:
            return f"{thing} may have moved: its picture is shifted by {size(every, 'px', 1.0)}"
        case f.ZOOMED:
            return f"the focal length of {thing} may have changed, by {size(every, '%', 100.0)}"
        case f.MOVED:
            turn, move = size(slice(3), "mrad", 1e3), size(slice(3, 6), "mm", 1e3)
            return f"{thing} may have moved, by {move} and {turn}"
        case f.ALONG_NORMAL:
            return f"{thing} may have moved, by {size(every, 'mm', 1e3)} along its normal"
        case f.TILTED:
            turn, move = size(slice(1, 3), "mrad", 1e3), size(slice(1), "mm", 1e3)
            return f"{thing} may have moved, by {move} along its normal and tilted by {turn}"
        case f.POINTS_ELSEWHERE:
            return f"{thing} may point elsewhere, by {size(every, 'deg', float(np.rad2deg(1.0)))}"
        case f.POINT_OFF:
            return f"{thing} may have moved beside itself, by {size(every, 'mm', 1e3)}"
        case f.LASER_MOVED:
            turn, move = size(slice(2), "deg", float(np.rad2deg(1.0))), size(slice(2, 4), "mm", 1e3)
            return f"{thing} may have moved, by {move} and {turn}"
        case f.LATE:
            return _late(fault.name, float(delta[0]), float(sigma[0]), model, frame_s)
        case _:
            camera, spot = fault.name.rsplit("/", 1)
            return f"spot {spot} is seen beside its place in camera `{camera}`, by {size(every, 'px', 1.0)}"


def _late(name: str, late_s: float, sigma_s: float, model: SpotModel, frame_s: float) -> str:
    """Of two cameras the one whose pictures are the later; of more, late or early against the others."""
    filming = [c for i, c in enumerate(model.camera_names) if (model.camera_of == i).any()]
    others, word = "the others", "late" if late_s > 0 else "early"
    if len(filming) == 2:
        other = next(c for c in filming if c != name)
        name, others, word = (name, f"camera `{other}`", "late") if late_s > 0 else (other, f"camera `{name}`", "late")
    size = f"{plus_minus(1e3 * abs(late_s), 1e3 * sigma_s)} ms"
    says = f"camera `{name}` is about {size} {word} against {others}"
    count = round(abs(late_s) / frame_s) if frame_s > 0 else 0
    if count and abs(abs(late_s) / frame_s - count) < _ONE_FRAME:
        says += f" (that is {count} frame{'s' if count != 1 else ''}: its pictures may be numbered wrong)"
    return says


def p_text(p: float) -> str:
    """`= 3e-09`, `below 1e-12`."""
    return "below 1e-12" if p < 1e-12 else f"= {p:.0e}"
