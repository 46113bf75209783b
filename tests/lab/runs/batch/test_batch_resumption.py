"""A batch is resumed: a run is skipped if its inputs, settings and version are the same, wherever it lies."""

from __future__ import annotations

import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from lab.runs.batch import task
from lab.runs.batch.batch import BatchOptions, process_batch
from lab.simulate.write import simulate
from tests.lab.run_folders import edit, write_run
from tests.lab.runs.batch.test_batch import points_run, rows_of
from tests.paths import ROOT

TABLES = ("attitude.csv", "spots.csv", "attitude_causal.csv")


@pytest.fixture
def done(tmp_path):
    """A batch of one run of pictures, processed."""
    run = write_run(tmp_path / "data/run")
    assert process_batch([run], tmp_path / "out").skipped == 0
    return run


def again(run: Path, **options) -> int:
    """How many runs are skipped when the batch is repeated."""
    return process_batch([run], run.parents[1] / "out", BatchOptions(**options)).skipped


def test_a_repeated_batch_skips_the_run_and_keeps_its_table(done, tmp_path):
    before = (tmp_path / "out/batch.csv").read_bytes()
    assert again(done) == 1
    assert (tmp_path / "out/batch.csv").read_bytes() == before


def test_new_times_of_files_and_a_moved_run_folder_are_no_reason_to_process_again(done, tmp_path):
    for file in done.rglob("*"):
        os.utime(file, (1e9, 1e9))
    moved = tmp_path / "elsewhere/run"
    moved.parent.mkdir()
    done.rename(moved)
    outcome = process_batch([moved], tmp_path / "out")
    assert outcome.skipped == 1
    assert [r["run"] for r in rows_of(outcome.table)] == [str(moved)]  # the old place has no row any more


@pytest.mark.parametrize("change", ["picture", "run.yaml", "rig.yaml", "results", "summary", "program", "library"])
def test_any_changed_input_or_version_is_a_reason_to_process_again(done, tmp_path, monkeypatch, change):
    match change:
        case "picture":
            other = sorted((done / "frames/left").iterdir())
            shutil.copyfile(other[1], other[0])
        case "run.yaml" | "rig.yaml":
            (done / change).write_text((done / change).read_text() + "# edited\n")
        case "results":
            (tmp_path / "out/run/report.html").unlink()
        case "summary":
            (tmp_path / "out/run/summary.json").write_text('{"schema": "beampose/summary/1"}')
        case "program":
            monkeypatch.setattr(task, "program_digest", lambda: "another version")
        case "library":
            monkeypatch.setattr(task, "versions", lambda: {"numpy": "0"})
    assert again(done) == 0
    assert again(done) == 1


@pytest.mark.parametrize(
    "options", [{"causal": True}, {"overrides": {"r1_px": 11}}, {"overrides": {"detect.threshold_sigma": 9}}]
)
def test_other_settings_are_a_reason_to_process_again(done, options):
    assert again(done, **options) == 0
    assert again(done, **options) == 1
    assert again(done) == 0


def test_a_default_that_is_stated_is_not_another_setting(done):
    from tracking.parameters import TrackerParameters

    assert again(done, overrides={"r1_px": TrackerParameters().r1_px}) == 1


def test_force_processes_all_runs_again(done):
    assert again(done, force=True) == 0


def test_a_failed_second_attempt_has_no_results_in_the_table_and_a_repaired_run_has_its_old_ones(done, tmp_path):
    edit(done / "run.yaml", "frame_rate_hz: 100.0", "frame_rate_hz: none")
    outcome = process_batch([done], tmp_path / "out")
    (row,) = rows_of(outcome.table)
    assert (row["status"], row["results"]) == ("error", "")
    edit(done / "run.yaml", "frame_rate_hz: none", "frame_rate_hz: 100.0")
    assert again(done) == 1
    (row,) = rows_of(outcome.table)
    assert row["results"] == "run"


def test_a_lost_table_is_written_again_from_the_results(done, tmp_path):
    table = tmp_path / "out/batch.csv"
    (before,) = rows_of(table)
    table.unlink()
    assert again(done) == 1
    (after,) = rows_of(table)
    assert {k: v for k, v in after.items() if k != "seconds"} == {k: v for k, v in before.items() if k != "seconds"}


# Interrupted by SIGKILL ----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    """Two runs of points and one of pictures, and their tables from one process."""
    folder = tmp_path_factory.mktemp("recordings")
    runs = [simulate("smooth", folder / f"p{i}", seed=i, frames=30, points=True) for i in range(2)]
    runs.append(simulate("smooth", folder / "pictures", seed=9, frames=6, scale=0.25))
    assert process_batch(runs, folder / "expected").exit_status in (0, 4)
    return runs, tables(folder / "expected")


def tables(out: Path) -> dict[str, bytes]:
    return {str(p.relative_to(out)): p.read_bytes() for p in sorted(out.glob("*/*.csv")) if p.name in TABLES}


def wait_until_the_group_has_ended(group: int) -> None:
    for _ in range(300):
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return
        time.sleep(0.1)
    os.killpg(group, signal.SIGKILL)
    pytest.fail("workers of a killed batch are still there after 30 s")


def killed_then_resumed(recordings, tmp_path: Path, seconds: float) -> None:
    runs, expected = recordings
    program = "import sys; from cli import main; main(sys.argv[1:])"
    command = [sys.executable, "-c", program, "batch", *map(str, runs), "--out", str(tmp_path / "out"), "--jobs", "2"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    first = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, start_new_session=True)
    time.sleep(seconds)
    first.send_signal(signal.SIGKILL)  # the parent only: its workers must end by themselves
    first.wait()
    wait_until_the_group_has_ended(first.pid)
    done = process_batch(runs, tmp_path / "out")  # a process less to start; the bytes are the same
    assert done.exit_status in (0, 4)
    assert tables(tmp_path / "out") == expected
    assert [r["run"] for r in rows_of(done.table)] == [str(r) for r in runs]
    assert "error" not in {r["status"] for r in rows_of(done.table)}


@pytest.mark.slow
def test_a_killed_batch_is_resumed_to_the_same_bytes(recordings, tmp_path):
    killed_then_resumed(recordings, tmp_path, 3.0)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(20))
def test_a_batch_killed_at_any_moment_is_resumed_to_the_same_bytes(recordings, tmp_path, seed):
    killed_then_resumed(recordings, tmp_path, random.Random(seed).uniform(0.5, 12.0))


def test_results_of_a_run_with_the_same_name_elsewhere_are_kept(tmp_path):
    for day in ("monday", "tuesday"):
        (tmp_path / day).mkdir()
    monday, tuesday = points_run(tmp_path / "monday/run"), points_run(tmp_path / "tuesday/run", 6)
    process_batch([monday], tmp_path / "out")
    before = (tmp_path / "out/run/attitude.csv").read_bytes()
    process_batch([tuesday], tmp_path / "out")
    assert (tmp_path / "out/run/attitude.csv").read_bytes() == before
    rows = rows_of(tmp_path / "out/batch.csv")
    assert [(r["run"], r["results"]) for r in rows] == [(str(monday), "run"), (str(tuesday), "tuesday-run")]
    assert process_batch([monday, tuesday], tmp_path / "out").skipped == 2
