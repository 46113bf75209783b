"""`beampose refine`: a rig refined by recordings, written only if it predicts held-out recordings better.

residuals.csv: the residual of every spot that was used, with the rig as given and as refined.
"""

from __future__ import annotations

import datetime
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from calibration.least_squares.adjustment import AdjustmentError
from calibration.model_check.linearised_frames import ModelCheckRecording
from calibration.rig.refinement import Refinement, refine
from calibration.terms.rig_blocks import BEAMS, BOWS, CAMERAS, INTRINSICS, OFFSETS, ROW_TIMES, SCREENS
from geometry.forward_model import SpotModel
from geometry.rig import Rig
from geometry.uncertainty.rig_uncertainty import RigCovariance
from lab.calibrate.refine import prior_sigmas
from lab.calibrate.refine.prior_sigmas import GROUPS, free_group, stated_covariance
from lab.calibrate.refine.recordings import LabelledRun, labelled, tolerant, with_rig
from lab.calibrate.refine.refine_page import RefinedRig, changes_of_numbers, page_of, pixel_residuals, refine_findings
from lab.calibrate.step import Solved, Step, run_step, state_of
from lab.errors import CalibrationError, InputError
from lab.files.rig.calibration_state import require_valid_calibration
from lab.files.rig.rig_file import RigFile, covariance_blocks, joint_covariance, load_rig_file, save_rig
from lab.files.run.fingerprints import fingerprints
from lab.files.run.results import REFINED
from lab.files.run.run_file import Run, load_run
from lab.files.text.csv_text import csv_word, write_table
from lab.files.text.error_text import suggest_name
from lab.findings.finding import Finding, Level, verdict
from lab.findings.outcome import Outcome
from lab.progress import Progress
from lab.report.page import cell
from lab.runs.model_check.check import with_place_errors
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
_STACKS_OF = {
    prior_sigmas.CAMERAS: (CAMERAS,), prior_sigmas.SCREENS: (SCREENS, BOWS), prior_sigmas.BEAMS: (BEAMS,),
    prior_sigmas.LENS: (INTRINSICS,), prior_sigmas.CLOCKS: (OFFSETS,), prior_sigmas.SHUTTER: (ROW_TIMES,),
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
    run_folder: Path, out: Path, *, more: Callable[[Run], Mapping[str, Any]] | None = None, **options: Any
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
    content = {"line": found.line(), "report": str(folder.resolve() / "report.html"), "heads": table.heads}

    def with_changes(run: Run) -> dict[str, Any]:
        rows = [[cell(value) for value in row] for row in table.rows]
        return {**({} if more is None else more(run)), REFINED: {**content, "rows": rows}}

    return process_run(run_folder, out, rig_path=folder / RIG, more=with_changes, **options)


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
        found = labelled(run, *stages[stage], search=search)
        search &= not found.searched  # all mistakes take 15 s: once
        return found

    try:
        now = rig, prior
        latest: dict[int, ModelCheckRecording] = {}  # of each run
        for stage, i in product(range(len(_FIRST_FRAMES)), range(len(runs))):
            # Each run is labelled with what those before it have shown.
            latest[i] = of_stage(tolerant(with_rig(runs[i], *now)), i, stage).in_views_of(rig)
            try:
                start = refine(rig, prior, list(latest.values()), stacks=stacks, for_labels=True)
            except AdjustmentError:
                if stage > 0 and i == len(runs) - 1:
                    raise
                continue  # the first few frames have too few labels
            now = start.rig, start.covariance
        second = [of_stage(with_rig(run, *now), i, len(_FIRST_FRAMES)) for i, run in enumerate(runs)]
        model = SpotModel.of(start.rig)
        recordings = [with_place_errors(r.in_views_of(rig), model) for r in second]
        refined = refine(rig, prior, recordings, start, stacks)
    except AdjustmentError as error:
        raise CalibrationError(f"the rig cannot be refined by these recordings: {error}") from None
    checks = tuple(r.check(refined.rig, refined.covariance) for r in second)
    return RefinedRig(refined, prior, tuple(second), checks)


def _figures(r: Refinement) -> str:
    frames = sum(len(x.seen) for x in r.recordings)
    determined = int(np.sum(r.gain > 1))
    return (
        f"{frames} frames of {len(r.recordings)} recording{'s' if len(r.recordings) > 1 else ''} determine {determined}"
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
