"""Findings of a refinement."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.model_check.fault_identification import FittedFault, SuspectedFault
from calibration.model_check.faults import BEAM, CAMERA, ZOOMED
from calibration.rig.refinement import FEWEST_FRAMES, Refinement
from geometry.arrays import finite
from geometry.rig import Rig
from geometry.uncertainty.rig_uncertainty import RigCovariance, split_name
from lab.calibrate.camera.camera_findings import FindingLimits
from lab.calibrate.refine.prior_sigmas import BEAMS, CAMERAS, SCREENS, free_group
from lab.calibrate.refine.recordings import LabelledRun
from lab.findings.finding import Finding, Level, clause, finding, passed
from lab.number_format import format_number, format_with_sigma
from lab.runs.model_check.check import ModelCheck, p_text

P_CHANGE = 1e-4  # p-value below which the stated sigmas do not explain the changes
P_HELD_OUT = 1e-4  # p-value, of all held-out recordings together, below which they contradict the result
FEW_USED = 0.5  # share of a recording's frames that are used, below which it is reported
# Codes of the model check that no refined rig may have: a fault, unexplained or correlated residuals.
_CONTRADICTIONS = ("BP-M01", "BP-M02", "BP-M03")


@dataclass(frozen=True, slots=True)
class RefinedRig:
    """A refined rig with the recordings that it is from."""

    refined: Refinement
    prior: RigCovariance
    runs: tuple[LabelledRun, ...]
    checks: tuple[ModelCheck, ...]  # of each run with the refined rig


def refine_findings(result: RefinedRig) -> tuple[Finding, ...]:
    """All findings."""
    r = result.refined
    out = [*_changes(r), *_checks(result), *_held_out(r), *_used(result), *_held(r.given, result.prior), *_lenses(r)]
    noisy = {name: factor for name, factor in r.noise.items() if factor > NOISY}
    for name, factor in noisy.items():
        what = f"the spots of camera `{name}` scatter {format_number(factor, 2)} times as much as their sigmas state"
        out.append(finding("BP-M04", Level.WARN, what))
    return tuple(out)


NOISY = 1.5  # the limit of the model check


def _changes(r: Refinement) -> list[Finding]:
    if r.p_change >= P_CHANGE and not r.moved:
        what = f"the changes agree with the stated sigmas, p {p_text(r.p_change)}"
        return [passed(what)]
    if not r.moved:
        what = f"the changes are larger than the stated sigmas allow, p {p_text(r.p_change)}"
        return [finding("BP-F06", Level.FAIL, what)]
    return [finding("BP-F03", Level.FAIL, _moved(m)) for m in r.moved]


def _moved(suspected: SuspectedFault) -> str:
    words = "; or ".join(_part(e) for e in suspected.explanations)
    more = f"; or one of {suspected.more_alternatives} more" if suspected.more_alternatives else ""
    undecided = ": these recordings do not distinguish them" if suspected.alternatives else ""
    return f"{words}{more}{undecided}, p {p_text(suspected.best.change.p_value)}"


def _part(e: FittedFault) -> str:
    """`camera `left` has moved by 20.1 ± 0.3 mm and turned by 5.0 ± 0.1 mrad`, beyond what is stated."""
    if e.fault.kind == ZOOMED:
        percent = 100 * np.array([e.change.delta[0], np.sqrt(e.change.covariance[0, 0])])
        return f"the focal length of camera `{e.fault.name}` is wrong by {format_with_sigma(*percent.tolist())} %"
    delta, sigma = e.change.delta, np.sqrt(np.maximum(np.diagonal(e.change.covariance), 0.0))
    turn, move = (np.s_[:3], np.s_[3:]) if e.fault.component == CAMERA else (np.s_[1:], np.s_[:1])
    if e.fault.component == BEAM:
        turn, move = np.s_[:2], np.s_[2:]

    def size(part: slice) -> str:
        length = float(np.linalg.norm(delta[part]))
        along = delta[part] / max(length, 1e-300)
        return format_with_sigma(1e3 * length, 1e3 * float(np.sqrt(along**2 @ sigma[part] ** 2)))

    return f"{e.fault.component} `{e.fault.name}` has moved by {size(move)} mm and turned by {size(turn)} mrad"


def _checks(result: RefinedRig) -> list[Finding]:
    out = []
    for run, check in zip(result.runs, result.checks, strict=True):
        bad = [f for f in check.findings if f.level > Level.PASS and f.code in _CONTRADICTIONS]
        out += [finding("BP-F04", Level.FAIL, f"{run.run.name}: {clause(f.what)}", remedy=f.remedy) for f in bad]
        if check.why_not:
            out.append(finding("BP-F07", Level.WARN, f"{run.run.name} was not tested: {check.why_not}"))
    return out


def _held_out(r: Refinement) -> list[Finding]:
    held = r.held_out
    if not held:
        what = f"one recording of fewer than {2 * FEWEST_FRAMES} usable frames cannot be held out"
        return [finding("BP-F02", Level.FAIL, what)]
    before, after = (float(np.sqrt(sum(h.chi2[k] for h in held) / sum(h.dof for h in held))) for k in (0, 1))
    p = min(1.0, len(held) * min(h.p for h in held))
    words = f"held-out residuals {format_number(before)} sigmas with the given rig, {format_number(after)} refined"
    if p < P_HELD_OUT:
        return [finding("BP-F01", Level.FAIL, f"{words}; they contradict its covariance, p {p_text(p)}")]
    if sum(h.log_density[1] - h.log_density[0] for h in held) <= 0 or after > before:
        return [finding("BP-F02", Level.FAIL, words)]
    return [passed(f"{words}; they agree with its covariance, p {p_text(p)}")]


def _used(result: RefinedRig) -> list[Finding]:
    out = []
    for run in result.runs:
        kept = finite(run.recording.poses.translation, -1)
        if kept.mean() < FEW_USED:
            what = f"{run.run.name}: {kept.sum()} of {kept.size} frames have a measured pose"
            # Where the rig that the others gave explains no frame at all, it is wrong or not this recording's.
            out.append(finding("BP-F07", Level.WARN if kept.any() else Level.FAIL, what))
        for name in run.unlabelled:
            what = f"{run.run.name}: which points of camera `{name}` are its spots is open, and none has a label"
            out.append(finding("BP-F07", Level.WARN, what, variant="camera"))
    return out


def _held(rig: Rig, prior: RigCovariance) -> list[Finding]:
    """Cameras, screens and beams of which nothing is stated."""
    known = {split_name(n)[:2] for n in prior.names if free_group(n) == split_name(n)[0]}
    of = {CAMERAS: rig.cameras, SCREENS: rig.screens, BEAMS: rig.beams}
    held = [f"{kind}.{name}" for kind, parts in of.items() for name in parts if (kind, name) not in known]
    if not held:
        return []
    what = f"nothing is stated of {', '.join(held)}: they are held, and the result is relative to them"
    return [finding("BP-F05", Level.WARN, what)]


def _lenses(r: Refinement) -> list[Finding]:
    """Cameras whose focal length is neither stated with a sigma nor shown by the recordings."""
    most = FindingLimits().focal[0]
    unknown = [f"cameras.{name}" for name, sigma in r.lens_sigmas.items() if sigma > most]
    if not unknown or r.moved:
        return []
    what = (
        f"nothing is stated of the focal lengths of {', '.join(unknown)}, and the recordings would not show an error of"
        " 1 %: the result is as right as they are"
    )
    return [finding("BP-F05", Level.WARN, what, variant="lens")]
