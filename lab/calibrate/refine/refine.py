"""`beampose refine`: a rig refined by recordings, written only if it predicts held-out recordings better.

residuals.csv: the residual of every spot that was used, with the rig as given and as refined.
"""

from __future__ import annotations

import datetime
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from calibration.least_squares.adjustment import AdjustmentError
from calibration.model_check.fault_identification import FittedFault, SuspectedFault
from calibration.model_check.faults import BEAM, CAMERA, ZOOMED
from calibration.rig.recordings import Reduced
from calibration.rig.refinement import FEWEST_FRAMES, MOTIONS, Refinement, further_motions, refine
from calibration.terms.rig_blocks import BEAMS, BOWS, CAMERAS, INTRINSICS, OFFSETS, ROW_TIMES, SCREENS, prior_of
from geometry.arrays import Array, finite
from geometry.forward_model import SpotModel
from geometry.rig import Rig
from geometry.uncertainty.chi_square import chi2_limit
from geometry.uncertainty.rig_uncertainty import CLOCK, POSE, ROW_TIME, RigCovariance, split_name
from lab.calibrate.camera.camera_page import LIMITS
from lab.calibrate.refine.recordings import (
    CLOCKS,
    GROUPS,
    LENS,
    SHUTTER,
    LabelledRun,
    free_group,
    hidden_mistakes,
    labelled,
    refuse_mistakes,
    stated_covariance,
    tolerant,
    with_rig,
)
from lab.calibrate.step import Solved, Step, run_step, state_of
from lab.errors import CalibrationError, InputError
from lab.files.rig.camera_file import require_valid_calibration
from lab.files.rig.rig_file import RigFile, covariance_blocks, joint_covariance, load_rig_file, save_rig
from lab.files.run.fingerprints import fingerprints
from lab.files.run.results import REFINED
from lab.files.run.run_file import Run, load_run
from lab.files.text.csv_text import csv_word, write_table
from lab.files.text.error_text import suggest_name
from lab.findings.finding import Finding, Level, Outcome, clause, finding, passed, verdict
from lab.number_format import format_count, format_number, format_p, format_with_sigma
from lab.progress import Progress
from lab.report.calibration.calibration_drawings import correlation_matrix, residual_field
from lab.report.calibration.calibration_scene import SceneObject, Trail, frustum_length, rig_things, scene_views
from lab.report.page import KeyFigure, PageDrawing, PageTable, Section, cell
from lab.runs.model_check.check import ModelCheck, with_place_errors
from lab.runs.process import process_run

RIG, RESIDUALS = "rig.yaml", "residuals.csv"
COLUMNS = (
    "run", "t_s", "camera", "spot", "u_px", "v_px", "du_given_px", "dv_given_px", "du_refined_px", "dv_refined_px",
    "sigma_u_px", "sigma_v_px",
)  # fmt: skip
_STEP = Step("refinement by recordings", (RESIDUALS,), RIG)
# Frames of each run for the first solutions, at most and with a pose: each solution only has to be good enough to label
# the frames of the next. While the rig is off by 10 px, half of the spots get no label and a frame takes 0.1 s.
_FIRST_FRAMES = ((40, 20), (100, 50))
# Times the usual residuals that the tracker expects after a run with too few labels: a pose that fits the spots of one
# camera leaves those of the others farther off than one that fits all. After ten times as much it labels nothing.
_WIDER = 3.0
_STACKS_OF = {
    CAMERAS: (CAMERAS,), SCREENS: (SCREENS, BOWS), BEAMS: (BEAMS,),
    LENS: (INTRINSICS,), CLOCKS: (OFFSETS,), SHUTTER: (ROW_TIMES,),
}  # fmt: skip


def refine_rig(
    runs: Sequence[Path],
    rig_path: Path,
    out: Path,
    *,
    free: Sequence[str] = (),
    sigmas: Mapping[str, Any] | None = None,
    today: datetime.date | None = None,
    progress: Progress | None = None,
) -> Outcome[RefinedRig]:
    """Refine a rig by recordings; write rig.yaml, residuals.csv and report.html into the folder `out`.

    The runs are tracked and smoothed with the given rig, and a second time with the first solution, which corrects
    labels. If the verdict is FAIL, there is no rig.yaml. free: groups of parameters that are changed (GROUPS); empty:
    all of which a covariance is known. sigmas: see `stated_covariance`. Raises InputError: for errors in the files or
    options; CalibrationError: the given rig must not be used, a recording shows a mistake in the set-up, or the
    recordings determine no result.
    """
    day = today or datetime.date.today()
    return run_step(_STEP, out, lambda: _solve(list(runs), Path(rig_path), list(free), sigmas or {}, day, progress))


def run_with_refined_rig(
    run_folder: Path, out: Path, *, more: Mapping[str, Any] | None = None, **options: Any
) -> Outcome[Any]:
    """Refine the rig of a run by this run, into `OUT-refined`, and process the run with the result, into `out`.

    If the refinement is a FAIL, its outcome is returned, and `out` stays as it was. more, options: as of `process_run`;
    the report and summary.json have the changes of the rig's numbers, too.
    """
    folder = Path(out).with_name(Path(out).name + "-refined")
    found = refine_rig([run_folder], load_run(run_folder).rig_path, folder, progress=options.get("progress"))
    if found.level is Level.FAIL:
        return found
    table = changes_of_numbers(found.result).table
    assert table is not None
    rows = [[cell(value) for value in row] for row in table.rows]
    content = {"line": found.line(), "report": str(folder.resolve() / "report.html"), "heads": table.heads}
    block = {REFINED: {**content, "rows": rows}}
    return process_run(run_folder, out, rig_path=folder / RIG, more={**(more or {}), **block}, **options)


def _solve(
    folders: Sequence[Path],
    rig_path: Path,
    free: Sequence[str],
    sigmas: Mapping[str, Any],
    day: datetime.date,
    progress: Progress | None,
) -> Solved[RefinedRig]:
    file = load_rig_file(rig_path)
    if file.calibration is not None:  # one that has expired may be refined
        require_valid_calibration(file.calibration, rig_path, file.calibration.date)
    prior = stated_covariance(file.rig, joint_covariance(file.rig, file.covariances, rig_path), sigmas, rig_path)
    stacks = _stacks(free, prior, rig_path)
    runs = [with_rig(load_run(folder, rig_path), file.rig, prior) for folder in folders]
    names = [str(r.folder.resolve()) for r in runs]
    twice = next((n for n in names if names.count(n) > 1), None)
    if twice is not None:
        raise InputError(f"{twice}: expected each run once, got it {names.count(twice)} times")
    result = _refined(runs, file.rig, prior, stacks, progress)
    refined, findings = result.refined, refine_findings(result)
    failed = verdict(findings) is Level.FAIL
    if failed and not refined.moved:
        for given, used in zip(runs, result.runs, strict=True):
            refuse_mistakes(used, given)
    inputs = [rig_path, *(r.path for r in runs)]

    def write(folder: Path) -> None:
        if not failed:
            save_rig(_rig_file(refined, findings, file, runs, day), folder / RIG)
        _write_residuals(result, folder / RESIDUALS)

    return Solved(
        name=rig_path.stem if rig_path.stem != "rig" else rig_path.resolve().parent.name,
        result=result,
        findings=findings,
        figures=_figures(refined),
        write=write,
        page=lambda: page_of(result),
        day=day,
        inputs=inputs,
    )


def _stacks(free: Sequence[str], prior: RigCovariance, rig_path: Path) -> set[str]:
    """The stacks of unknowns that the groups name; all without groups."""
    stated = {free_group(n) for n in prior.names}
    for group in free:
        if group not in GROUPS:
            raise InputError(f"--free: expected some of {','.join(GROUPS)}, got {group!r}{suggest_name(group, GROUPS)}")
        if group not in stated:
            raise InputError(
                f"--free {group}: expected its covariance in {rig_path}, or its sigmas, got none; nothing is refined of"
                " which nothing is stated"
            )
    return {stack for group in free or GROUPS for stack in _STACKS_OF[group]}


def _refined(
    runs: Sequence[Run], rig: Rig, prior: RigCovariance, stacks: set[str], progress: Progress | None
) -> RefinedRig:
    stages: tuple[tuple[int, ...], ...] = (*_FIRST_FRAMES, ())

    search = True

    def of_stage(run: Run, i: int, stage: int) -> LabelledRun:
        nonlocal search
        if progress is not None:
            progress(stage * len(runs) + i, len(stages) * len(runs), run.name)
        found = labelled(run, *stages[stage], given=runs[i] if search else None)
        search &= not found.searched  # all mistakes take 15 s: once
        return found

    latest: dict[int, LabelledRun] = {}  # of each run
    try:
        now, times = (rig, prior), 1.0
        for stage, i in product(range(len(_FIRST_FRAMES)), range(len(runs))):
            # Each run is labelled with what those before it have shown.
            latest[i] = of_stage(tolerant(with_rig(runs[i], *now), times), i, stage)
            try:
                known = [r.in_views_of(rig) for r in latest.values()]
                start = refine(rig, prior, known, stacks=stacks, for_labels=True)
            except AdjustmentError:
                if stage > 0 and i == len(runs) - 1:
                    raise
                times = _WIDER if times == 1.0 else 1.0  # the first few frames have too few labels
                continue
            now, times = (start.rig, start.covariance), 1.0
        second = [of_stage(with_rig(run, *now), i, len(_FIRST_FRAMES)) for i, run in enumerate(runs)]
        model = SpotModel.of(start.rig)
        recordings = [with_place_errors(r.in_views_of(rig), model) for r in second]
        refined = refine(rig, prior, recordings, start, stacks)
    except AdjustmentError as error:
        for i, one in latest.items():
            refuse_mistakes(one, runs[i])
        raise CalibrationError(f"the rig cannot be refined by these recordings: {error}") from None
    checks = tuple(r.check(refined.rig, refined.covariance) for r in second)
    hidden = hidden_mistakes(rig, prior, second, stacks)
    return RefinedRig(refined, prior, tuple(second), checks, hidden)


def _figures(r: Refinement) -> str:
    frames = sum(len(x.seen) for x in r.recordings)
    determined = int(np.sum(r.gain > 1))
    return (
        f"{frames} frames of {format_count(len(r.recordings), 'recording')} determine {determined}"
        f" of {len(r.gain)} directions"
    )


def _rig_file(
    r: Refinement, findings: Sequence[Finding], given: RigFile, runs: Sequence[Run], day: datetime.date
) -> RigFile:
    """The refined rig with its covariance, and what it was made from."""
    prints = [p for run in runs for p in fingerprints(run)]
    lines = dict.fromkeys(f"{p['path']} sha256 {p['sha256']}" for p in prints)
    old = given.calibration
    until, notes = (None, "") if old is None else (old.valid_until, old.notes)
    state = state_of(findings, day, until, notes, tuple(lines))
    return replace(given, rig=r.rig, covariances=covariance_blocks(r.covariance), calibration=state, measured_as={})


def _write_residuals(result: RefinedRig, path: Path) -> None:
    r = result.refined
    views = r.rig.views()
    rows: list[list[object]] = []
    for i, d in enumerate(r.data):
        run = result.runs[i if len(r.recordings) > 1 else 0].run.name
        recording, before, after = r.of_data(i), pixel_residuals(r.given_data[i]), pixel_residuals(d)
        sigma = np.sqrt(np.diagonal(recording.cov_px2, axis1=-2, axis2=-1))
        used = d.lin.used
        numbers = np.concatenate([a[used] for a in (recording.uv_px, before, after, sigma)], axis=-1).tolist()
        frame, view = (i.tolist() for i in np.nonzero(used))
        times = [f"{t:.9g}" for t in recording.t_s]
        rows += [
            [csv_word(run), times[k], *views[v], *(f"{x:.6g}" for x in one)]
            for k, v, one in zip(frame, view, numbers, strict=True)
        ]
    write_table(path, COLUMNS, rows)


# Findings and report of a refinement.


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
    hidden: tuple[Finding, ...] = ()  # mistakes that the runs do not show


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
        *result.hidden,
    ]
    noisy = {name: factor for name, factor in r.noise.items() if factor > NOISY}
    for name, factor in noisy.items():
        what = f"the spots of camera `{name}` scatter {format_number(factor, 2)} times as much as their sigmas state"
        out.append(finding("BP-M04", Level.WARN, what))
    return tuple(out)


NOISY = 1.5  # the limit of the model check


def _changes(r: Refinement) -> list[Finding]:
    if r.p_change >= P_CHANGE and not r.moved:
        what = f"the changes agree with the stated sigmas, p {format_p(r.p_change)}"
        return [passed(what)]
    if not r.moved:
        what = f"the changes are larger than the stated sigmas allow, p {format_p(r.p_change)}"
        return [finding("BP-F06", Level.FAIL, what)]
    return [finding("BP-F03", Level.FAIL, _moved(m)) for m in r.moved]


def _moved(suspected: SuspectedFault) -> str:
    words = "; or ".join(_part(e) for e in suspected.explanations)
    more = f"; or one of {suspected.more_alternatives} more" if suspected.more_alternatives else ""
    undecided = ": these recordings do not distinguish them" if suspected.alternatives else ""
    return f"{words}{more}{undecided}, p {format_p(suspected.best.change.p_value)}"


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
        return [finding("BP-F01", Level.FAIL, f"{words}; they contradict its covariance, p {format_p(p)}")]
    worse = sum(h.log_density[1] - h.log_density[0] for h in held) <= 0 or after > before
    if others := _explained_by_others(r):
        return [finding("BP-F05", Level.FAIL if worse else Level.WARN, f"{words}; {others}", variant="free")]
    if worse:
        return [finding("BP-F02", Level.FAIL, words)]
    return [passed(f"{words}; they agree with its covariance, p {format_p(p)}")]


def _explained_by_others(r: Refinement) -> str:
    """How numbers that are held explain residuals that the changed ones leave; empty where they do not."""
    every, dof = (sum(values) for values in zip(*((d.rest + float(d.y @ d.y), d.dof) for d in r.data), strict=True))
    numbers = sum(r.values[stack].dof for stack, _ in r.at if stack in r.held)
    if not numbers or sum(h.chi2[1] for h in r.held_out) - every < chi2_limit(P_HELD_OUT, numbers):
        return ""
    groups = [group for group, stacks in _STACKS_OF.items() if set(stacks) & set(r.held)]
    return f"{format_number(float(np.sqrt(every / dof)))} if {', '.join(groups)} may change as well"


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
    most = LIMITS.focal[0]
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
    if parameter in ("fx", "fy", "cx", "cy"):
        return "px", 1.0
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
    rows = []
    for i, h in enumerate(r.held_out):
        name = result.runs[i].run.name if several else f"block {i + 1}"
        in_sigmas = (np.sqrt(chi2 / max(h.dof, 1)) for chi2 in h.chi2)
        rows.append((name, *in_sigmas, h.p, h.log_density[1] - h.log_density[0]))
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
                drawings.append(residual_field(c.image_size_px, at, np.concatenate(residuals), title, things="spots"))
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
    return Section("The refined rig", words, scene_views([*things, *arrows]))


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
