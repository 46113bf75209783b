"""`beampose plan`: visibility and expected uncertainty of a rig before it is built."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from calibration.budget.expected_errors import expected_errors
from calibration.budget.pose_grid import plan_grid
from lab.errors import QUALITY_GATE_FAILED
from lab.files.rig.rig_file import TARGET, joint_covariance, load_rig_file
from lab.files.text.atomic_write import atomic_folder, check_output_folder
from lab.findings.finding import Level, verdict
from lab.number_format import format_angle, format_length, format_percent
from lab.setup.plan_findings import Plan, PlanOptions, findings, median_sigma
from lab.setup.plan_page import write_effects, write_plan, write_plan_page

TABLE, EFFECTS, REPORT = "plan.csv", "effects.csv", "report.html"


@dataclass(frozen=True, slots=True)
class PlanOutcome:
    """Result of a plan."""

    verdict: Level
    poses: int
    measured: float  # share of the poses that can be measured
    sigma_m: float  # position, along the worst direction, median over the observable poses
    sigma_deg: float  # attitude, likewise
    out: Path

    @property
    def exit_status(self) -> int:
        """0, or 4 if the rig does not suit the range of poses (as the quality gate of a run)."""
        return QUALITY_GATE_FAILED if self.verdict is Level.FAIL else 0

    def line(self) -> str:
        """One line for the terminal."""
        sizes = f"{format_angle(self.sigma_deg)} and {format_length(self.sigma_m)}"
        sigmas = f"sigma {sizes} (worst direction, median of the poses)"
        return (
            f"plan: {self.verdict.name}, {format_percent(self.measured)} of {self.poses} poses can be"
            f" measured, {sigmas};"
            f" {self.out / REPORT}"
        )


def plan_rig(rig_path: Path, out: Path, options: PlanOptions | None = None) -> PlanOutcome:
    """Plan a rig; write plan.csv, effects.csv and report.html into the folder `out`.

    Calibration errors come from the rig file's covariance, or from the options where the file states none.

    Raises:
        InputError: for a rig that cannot be read, invalid options, or a folder with other files in it.
    """
    options = PlanOptions() if options is None else options
    check_output_folder(out, _is_ours)
    plan = plan_of(rig_path, options)
    found = findings(plan)
    with atomic_folder(Path(out), may_replace=_is_ours) as work:
        write_plan(plan, work / TABLE)
        write_effects(plan, work / EFFECTS)
        write_plan_page(plan, found, Path(rig_path), work)
    sigma_m, sigma_deg = median_sigma(plan)
    return PlanOutcome(verdict(found), len(plan.status), float(plan.measured.mean()), sigma_m, sigma_deg, Path(out))


def _is_ours(folder: Path) -> bool:
    return (folder / TABLE).is_file()


def plan_of(rig_path: Path, options: PlanOptions) -> Plan:
    """The plan of a rig file. Raises InputError if the file cannot be read."""
    file = load_rig_file(Path(rig_path))
    stated = joint_covariance(file.rig, file.covariances, rig_path)
    target = file.covariances.get(TARGET)
    is_joint = target is not None and any(n.startswith(("cameras.", "screens.")) for n in target.parameters)
    errors, sources = expected_errors(file.rig, options.expected, stated, is_joint)
    return plan_grid(file.rig, errors, sources, options)
