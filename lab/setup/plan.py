"""`beampose plan`: visibility and expected uncertainty of a rig before it is built."""

from __future__ import annotations

import datetime
from pathlib import Path

from calibration.budget import expected_errors, plan_grid
from geometry.pose_solver.visibility import assumed_range
from lab.calibrate.step import Solved, Step, run_step
from lab.errors import QUALITY_GATE_FAILED
from lab.files.rig.rig_file import TARGET, joint_covariance, load_rig_file
from lab.findings.outcome import Outcome
from lab.number_format import format_angle, format_length, format_percent
from lab.setup.plan_findings import Plan, PlanOptions, findings, median_sigma
from lab.setup.plan_page import page_of, write_effects, write_plan

TABLE, EFFECTS = "plan.csv", "effects.csv"


_SENTENCES = (
    "This rig suits the range of poses.",
    "This rig can be built; note the warnings below.",
    "This rig does not suit the range of poses.",
)
_STEP = Step("plan", (TABLE,), failed_status=QUALITY_GATE_FAILED, sentences=_SENTENCES)


def plan_rig(rig_path: Path, out: Path, options: PlanOptions | None = None) -> Outcome[Plan]:
    """Plan a rig; write plan.csv, effects.csv and report.html into the folder `out`.

    Calibration errors come from the rig file's covariance, or from the options where the file states none. A rig that
    does not suit the range of poses has the exit status of a run that fails its quality gate. Raises InputError: for a
    rig that cannot be read, invalid options, or a folder with other files in it.
    """
    return run_step(_STEP, out, lambda: _solve(Path(rig_path), PlanOptions() if options is None else options))


def _solve(rig_path: Path, options: PlanOptions) -> Solved[Plan]:
    plan = plan_of(rig_path, options)
    sigma_m, sigma_deg = median_sigma(plan)

    def write(folder: Path) -> None:
        write_plan(plan, folder / TABLE)
        write_effects(plan, folder / EFFECTS)

    return Solved(
        name="plan",
        result=plan,
        findings=tuple(findings(plan)),
        figures=f"{format_percent(float(plan.measured.mean()))} of {len(plan.status)} poses can be measured, sigma of"
        f" the attitude {format_angle(sigma_deg)}, of the position {format_length(sigma_m)} (worst direction, median)",
        write=write,
        page=lambda: page_of(plan),
        day=datetime.date.today(),
        inputs=[rig_path],
        title=rig_path.stem if rig_path.stem != "rig" else rig_path.resolve().parent.name,
    )


def plan_of(rig_path: Path, options: PlanOptions) -> Plan:
    """The plan of a rig file. Raises InputError if the file cannot be read."""
    file = load_rig_file(Path(rig_path))
    stated = joint_covariance(file.rig, file.covariances, rig_path)
    target = file.covariances.get(TARGET)
    is_joint = target is not None and any(n.startswith(("cameras.", "screens.")) for n in target.names)
    errors, sources = expected_errors(file.rig, options.expected, stated, is_joint)
    return plan_grid(file.rig, errors, sources, options.about(assumed_range(file.rig).centre))
