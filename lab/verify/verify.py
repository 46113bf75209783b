"""Computes a result again and compares all its tables byte by byte."""

from __future__ import annotations

import dataclasses
import tempfile
from dataclasses import dataclass
from pathlib import Path

from lab.errors import QUALITY_GATE_FAILED, InputError
from lab.files.run.run_file import LiveDevice, load_run
from lab.runs.frames.pipeline import Pipeline
from lab.runs.process import write_tables
from lab.runs.smoothing_pass import Progress, TrackingAndSmoothing
from lab.verify.differences import Difference, difference_of
from lab.verify.recorded import InputsNow, compare_inputs, other_versions, read_recorded

# Tables that a run writes under some conditions only: in the results but not computed, they are a difference.
_OPTIONAL = ("systematic.csv", "attitude_causal.csv", "covariance_causal.csv")


@dataclass(frozen=True, slots=True)
class Verification:
    """The outcome of a verification."""

    results: Path
    inputs: InputsNow
    versions: tuple[str, ...]  # those that differ
    tables: tuple[str, ...]  # compared
    differences: tuple[Difference, ...]

    @property
    def identical(self) -> bool:
        """Whether inputs and tables are the recorded ones."""
        return not self.differences and not self.inputs.changed

    @property
    def exit_status(self) -> int:
        """0 if all is the same, else that of a failed quality gate."""
        return 0 if self.identical else QUALITY_GATE_FAILED

    def lines(self) -> list[str]:
        """The outcome for the terminal."""
        same = len(self.tables) - len(self.differences)
        word = "SAME" if self.identical else "DIFFERENT"
        out = [
            f"{word}: {same} of {len(self.tables)} tables of {self.results} are identical; {self.inputs.same} inputs"
            " unchanged"
        ]
        out += [f"  input changed: {text}" for text in self.inputs.changed]
        out += [f"  {difference}" for difference in self.differences]
        out += [f"  not compared: {text}" for text in self.inputs.not_compared]
        out += [f"  other version: {text}" for text in self.versions]
        return out


def verify(results: Path, run_folder: Path | None = None, progress: Progress | None = None) -> Verification:
    """Compute the tables of a result folder again, from its recorded run folder, settings and parameters.

    run_folder: where the run is now, if it has moved. The expiry of the calibration plays no part, since the result was
    made while it was valid.

    Raises:
        InputError: the results or their inputs cannot be read.
    """
    results = Path(results)
    recorded = read_recorded(results)
    folder = recorded.run_folder if run_folder is None else Path(run_folder)
    if run_folder is None and not folder.is_dir():
        raise InputError(f"{results}: its run folder {folder} does not exist; name its new place with --run")
    run = dataclasses.replace(load_run(folder), tracker=recorded.tracker)
    if any(isinstance(source, LiveDevice) for source in run.cameras.values()):
        raise InputError(f"{run.path}: expected recorded pictures or points, found a live camera: nothing to verify")
    inputs = compare_inputs(recorded, run)
    with tempfile.TemporaryDirectory(prefix="beampose-verify-") as name:
        work = Path(name)
        pipeline = Pipeline.of(run)
        passes = TrackingAndSmoothing(pipeline, work, progress)
        write_tables(pipeline, passes, work, causal=recorded.causal, on_frame=lambda record, causal: None)
        tables = sorted({p.name for p in work.glob("*.csv")} | {n for n in _OPTIONAL if (results / n).is_file()})
        found = [difference_of(results / table, work / table) for table in tables]
    differences = tuple(d for d in found if d is not None)
    return Verification(results, inputs, tuple(other_versions(recorded)), tuple(tables), differences)
