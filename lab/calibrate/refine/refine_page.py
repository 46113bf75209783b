"""Findings and report of a refinement."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.model_check.fault_identification import FittedFault, SuspectedFault
from calibration.model_check.faults import BEAM, CAMERA, ZOOMED
from calibration.rig.recordings import Reduced
from calibration.rig.refinement import FEWEST_FRAMES, MOTIONS, Refinement, further_motions
from calibration.terms.rig_blocks import prior_of
from geometry.arrays import Array, finite
from geometry.rig import Rig
from geometry.uncertainty.rig_uncertainty import CLOCK, POSE, ROW_TIME, RigCovariance, split_name
from lab.calibrate.camera.camera_page import FindingLimits
from lab.calibrate.refine.prior_sigmas import BEAMS, CAMERAS, SCREENS, free_group
from lab.calibrate.refine.recordings import LabelledRun
from lab.findings.finding import Finding, Level, clause, finding, passed
from lab.number_format import format_number, format_with_sigma
from lab.report.calibration.calibration_drawings import correlation_matrix, residual_field
from lab.report.calibration.calibration_scene import SceneObject, Trail, frustum_length, rig_things, scene_views
from lab.report.page import KeyFigure, PageDrawing, PageTable, Section
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
    out = [
        *_changes(r),
        *_checks(result),
        *_held_out_finding(r),
        *_used(result),
        *_held(r.given, result.prior),
        *_lenses(r),
    ]
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


def _held_out_finding(r: Refinement) -> list[Finding]:
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


_MUCH_BETTER = 0.7  # of its sigma: what a further motion must at least leave to be named


def page_of(result: RefinedRig) -> tuple[list[KeyFigure], list[Section]]:
    """Key figures and sections of the report."""
    r = result.refined
    return _key_figures(r), [
        changes_of_numbers(result),
        _directions(result),
        _held_out(result),
        _residuals(r),
        _correlations(r),
        _scene(r),
    ]


def pixel_residuals(d: Reduced) -> Array:
    """(K, n, 2), px, measured minus predicted; 0 for spots that are not used."""
    back = np.linalg.inv(np.where(d.lin.used[..., None, None], d.lin.W, np.eye(2)))
    return np.asarray((back @ d.left[..., None])[..., 0])


def _key_figures(r: Refinement) -> list[KeyFigure]:
    out = []
    for name, data in (("residuals, given", r.given_data), ("residuals, refined", r.data)):
        rms = np.sqrt(sum(np.sum(pixel_residuals(d) ** 2) for d in data) / sum(2 * d.lin.used.sum() for d in data))
        out.append((name, f"{format_number(float(rms))} px", "RMS per axis, poses fitted"))
    out.append(("frames", str(sum(len(x.seen) for x in r.recordings)), f"{r.excluded} spots excluded"))
    out.append(("determined", f"{int(np.sum(r.gain > 1))} of {len(r.gain)}", "directions of the rig's parameters"))
    return out


def changes_of_numbers(result: RefinedRig) -> Section:
    """The section with the change of each number."""
    r = result.refined
    prior, after = result.prior, r.covariance
    before = dict(zip(prior.names, np.sqrt(np.diagonal(prior.matrix)), strict=True))
    sigma = dict(zip(after.names, np.sqrt(np.diagonal(after.matrix)), strict=True))
    rows = []
    for name, change in r.named_changes().items():
        if name in before and name in sigma:
            unit, factor = _unit(name)
            removed = np.sqrt(max(before[name] ** 2 - sigma[name] ** 2, 0.0))
            in_sigmas = change / removed if removed > 1e-3 * before[name] else float("nan")
            rows.append((name, unit, factor * before[name], factor * sigma[name], factor * change, float(in_sigmas)))
    heads = ("parameter", "unit", "sigma before", "sigma after", "change", "change / its sigma")
    words = [
        "Sigmas of each number before and after, and its change, also in sigmas of a correct prior: values beyond 3 are"
        " unusual. The sigmas after contain the errors that all parts share, which the recordings do not determine (see"
        " the next section); differences between parts are known better: rig.yaml holds the joint covariance.",
    ]
    return Section("Change of each number", words, (), PageTable(heads, rows))


def _unit(name: str) -> tuple[str, float]:
    """The unit in which a number is shown, and its factor."""
    parameter = split_name(name)[2]
    if parameter in CLOCK:
        return ("us", 1e6) if parameter == ROW_TIME else ("ms", 1e3)
    is_angle = parameter.endswith("_rad") or parameter.startswith("direction")
    return ("mm", 1e3) if parameter.endswith("_m") else ("mrad", 1e3) if is_angle else ("", 1.0)


def _directions(result: RefinedRig) -> Section:
    r = result.refined
    conventions = r.conventions
    free = len(r.gain) - int(np.sum(r.gain > 1))
    words = [
        f"The recordings determine {int(np.sum(r.gain > 1))} of {len(r.gain)} directions of the unknown numbers better"
        f" than what was stated. {conventions} directions are conventions: motions of all cameras and screens together,"
        " and of all beams in the body, change no residual. What is stated of all parts together decides them, and no"
        f" recording can. The other {max(free - conventions, 0)} stay near what was stated.",
        "The last column is the motion, along an axis of world or about one of the body, that would determine a"
        " direction best in as many frames again, and the sigma that it would leave over that before.",
    ]
    motions = further_motions(r, prior_of(r.given, result.prior)[1])
    rows: list[tuple[object, ...]] = []
    for i in np.argsort(r.gain):
        parts: dict[str, float] = {}
        for share, part in zip(r.shares[:, i], r.parts, strict=True):
            parts[part] = parts.get(part, 0.0) + share
        largest = sorted(parts.items(), key=lambda p: -p[1])[:3]
        ratio = 1 / np.sqrt(1 + r.gain[i])
        name = min(motions, key=lambda m: motions[m][1][i], default="")
        would = ""
        if name and motions[name][1][i] < _MUCH_BETTER * ratio:
            size, sigmas = motions[name]
            words_of = f"{format_number(1e3 * size, 2)} mm" if name in MOTIONS[:3] else f"{np.rad2deg(size):.2g} deg"
            would = f"{name} ± {words_of}: {format_number(float(sigmas[i]), 2)}"
        rows.append((len(rows) + 1, float(ratio), ", ".join(f"{n} {100 * s:.0f} %" for n, s in largest), would))
    heads = ("direction", "sigma after / before", "largest shares", "motion that would help")
    return Section("What the recordings determine", words, (), PageTable(heads, rows))


def _held_out(result: RefinedRig) -> Section:
    r = result.refined
    several = len(r.recordings) > 1
    rows = [
        (
            result.runs[i].run.name if several else f"block {i + 1}",
            *(float(np.sqrt(chi2 / max(h.dof, 1))) for chi2 in h.chi2), h.p,
            h.log_density[1] - h.log_density[0],
        )
        for i, h in enumerate(r.held_out)
    ]  # fmt: skip
    heads = ("held out", "residuals, given (sigmas)", "residuals, refined (sigmas)", "p", "gain of ln p")
    words = (
        f"Each {'recording' if several else 'block of time of the recording'} against the rig refined by the others:"
        " its residuals in sigmas, 1 if all sigmas are right; the p-value of its data with the refined rig and its"
        " covariance; and by how much the logarithm of their probability density grows."
    )
    return Section("Held-out recordings", words, (), PageTable(heads, rows))


def _residuals(r: Refinement) -> Section:
    drawings = []
    model_views = r.rig.views()
    for camera, c in r.rig.cameras.items():
        views = np.array([name == camera for name, _ in model_views])
        for words, data in (("given", r.given_data), ("refined", r.data)):
            places, residuals = [], []
            for i, d in enumerate(data):
                used = d.lin.used & views
                places.append(r.of_data(i).uv_px[used])
                residuals.append(pixel_residuals(d)[used])
            at = np.concatenate(places)
            if len(at):
                title = f"Camera {camera}, {words} rig"
                drawings.append(
                    PageDrawing(residual_field(c.image_size_px, at, np.concatenate(residuals), title, things="spots"))
                )
    words_ = "Mean residuals over each picture, after the pose of each frame was fitted; the scales differ."
    return Section("Residuals", words_, drawings)


def _correlations(r: Refinement) -> Section:
    keep = [i for i, n in enumerate(r.covariance.names) if split_name(n)[2] in POSE][:60]
    names = [r.covariance.names[i] for i in keep]
    picture = correlation_matrix(names, r.covariance.matrix[np.ix_(keep, keep)], "Correlations of cameras and screens")
    words = "Common motions of all parts are strongly correlated; the covariance in rig.yaml contains this."
    return Section("Correlations", words, [PageDrawing(picture, wide=True)])


def _scene(r: Refinement) -> Section:
    poses = r.data[0].lin.poses
    things = rig_things(r.rig, poses[len(poses.translation) // 2])
    arrows, times = _arrows(r, 1.5 * frustum_length(things))
    words = f"Arrows are the changes of cameras and screens, {format_number(times, 2)} times as long." if arrows else ""
    return Section("The refined rig", words, [PageDrawing(picture) for picture in scene_views([*things, *arrows])])


def _arrows(r: Refinement, longest_m: float) -> tuple[list[SceneObject], float]:
    """The changes of the places of cameras and screens, the largest of this length, and how much they are stretched."""

    def places(rig: Rig) -> dict[str, Array]:
        out = {f"camera {n}": c.camera_from_world.inverse().translation for n, c in rig.cameras.items()}
        return out | {f"screen {n}": s.world_from_screen.translation for n, s in rig.screens.items()}

    before, after = places(r.given), places(r.rig)
    moved = {name: after[name] - place for name, place in before.items()}
    largest = max(float(np.linalg.norm(m)) for m in moved.values())
    if not largest > 0:
        return [], 1.0
    out: list[SceneObject] = []
    for name, shift in moved.items():
        end = before[name] + shift * (longest_m / largest)
        back, across = -0.2 * (end - before[name]), 0.1 * np.cross(end - before[name], [0.3, 0.5, 0.8])
        head = [end, end + back + across, end, end + back - across]
        text = f"{name}: {format_number(1e3 * float(np.linalg.norm(shift)), 2)} mm"
        out.append(Trail(text, np.array([before[name], *head])))
    return out, longest_m / largest
