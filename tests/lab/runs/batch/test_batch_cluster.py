"""A batch on a Dask cluster has the results of a local one, whatever happens to the workers."""

from __future__ import annotations

import dataclasses
import json
import os
import re
import signal
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from lab.errors import InputError, RunError
from lab.files.output.part_folder import FolderInUseError
from lab.runs.batch import cluster as module
from lab.runs.batch import task as task_module
from lab.runs.batch.batch import BatchOptions, process_batch
from lab.runs.batch.task import Task, perform
from lab.simulate.write import simulate
from tests.lab.runs.batch.test_batch import points_run, rows_of

distributed = pytest.importorskip("distributed")


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    """A cluster of one worker in this process."""
    with distributed.LocalCluster(1, processes=False, threads_per_worker=1, dashboard_address=None) as cluster:
        yield cluster.scheduler_address


def tables(folder: Path) -> dict[str, bytes]:
    """The tables of all result folders."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.glob("*/*.csv"))}


def without_times(rows: list[dict[str, str]]) -> list[dict[str, str]]:
    return [{**row, "seconds": ""} for row in rows]


def test_results_are_those_of_a_local_batch_also_of_runs_named_from_here(address, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, seed in (("a", 5), ("b", 6)):
        points_run(Path(name), seed)
    runs = ["a", "missing", "b"]
    local = process_batch(runs, Path("local"))
    lines: list[str] = []
    there = process_batch(runs, Path("there"), BatchOptions(dask=address), report=lines.append)
    assert tables(tmp_path / "there") == tables(tmp_path / "local")
    assert len(tables(tmp_path / "local")) > 10
    assert without_times(rows_of(there.table)) == without_times(rows_of(local.table))
    assert there.exit_status == local.exit_status == 1
    assert len(lines) == 3
    assert process_batch(runs, Path("there"), BatchOptions(dask=address)).skipped == 2
    assert not list((tmp_path / "there").glob(".batch-*.shared"))


def test_a_worker_that_does_not_see_the_folder_is_named(address, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "atomic_write_text", lambda text, path: None)  # the disk is another one
    with pytest.raises(InputError, match=rf"worker inproc.*: expected the folder {tmp_path / 'out'} of this computer"):
        process_batch([points_run(tmp_path / "a")], tmp_path / "out", BatchOptions(dask=address))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"program": "0"}, "found other program files"),
        ({"versions": {"numpy": "1.0"}}, r"expected numpy 1\.0, found 2"),
        ({"token": "0"}, "found none or another"),
        ({}, "expected the run folder /nowhere/run, found nothing there"),
    ],
)
def test_a_worker_that_differs_says_in_what(tmp_path, change, message):
    (tmp_path / "probe").write_text("1")
    here = module._Shared(str(tmp_path / "probe"), "1", module.program_digest(), module.versions())
    assert here.problem([str(tmp_path)]) == ""
    folders = [] if change else ["/nowhere/run"]
    assert re.search(message, dataclasses.replace(here, **change).problem(folders))


@pytest.mark.parametrize(("address", "reason"), [("tcp://127.0.0.1:1", "no answer"), ("", "empty"), ("x://y", "x")])
def test_an_address_that_does_not_answer_is_a_line(tmp_path, monkeypatch, address, reason):
    monkeypatch.setattr(module, "CONNECT_S", 0.5)
    with pytest.raises(InputError, match=rf"^--dask {address}: expected the address of a Dask scheduler, .*{reason}"):
        process_batch([points_run(tmp_path / "a")], tmp_path / "out", BatchOptions(dask=address))
    assert [p.name for p in (tmp_path / "out").iterdir() if not p.name.startswith(".")] == []


def test_a_file_of_a_scheduler_stands_for_its_address(address, tmp_path):
    (tmp_path / "scheduler.json").write_text(json.dumps({"type": "Scheduler", "address": address}))
    (tmp_path / "other.json").write_text("[]")
    with module.connected(str(tmp_path / "scheduler.json"), tmp_path) as cluster:
        assert cluster.check([]) == ""
    with (
        pytest.raises(InputError, match="not one of `dask scheduler"),
        module.connected(str(tmp_path / "other.json"), tmp_path),
    ):
        pass


def test_without_the_package_a_line_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError, match=r"distributed, .* pip install 'beampose\[cluster\]'"):
        process_batch([points_run(tmp_path / "a")], tmp_path / "out", BatchOptions(dask="tcp://127.0.0.1:8786"))


def test_a_task_waits_for_a_lost_worker_that_still_writes_and_uses_its_results(tmp_path, monkeypatch):
    """The scheduler gives a task to another worker when it loses the first one from sight."""
    monkeypatch.setattr(task_module, "_WAITING_S", 0.01)
    original, calls = task_module.process_run, []
    task = Task(points_run(tmp_path / "a"), tmp_path, "results", patience_s=0.02)

    def busy(*args, **kwargs):
        calls.append(1)
        if len(calls) == 1:
            monkeypatch.setattr(task_module, "process_run", original)
            assert not perform(task).skipped  # the other worker ends
            monkeypatch.setattr(task_module, "process_run", busy)
            raise FolderInUseError("in use")
        return original(*args, **kwargs)

    monkeypatch.setattr(task_module, "process_run", busy)
    assert perform(task).skipped
    monkeypatch.setattr(task_module, "process_run", _in_use)
    assert perform(dataclasses.replace(task, patience_s=0.0)).row["status"] == "error"


def _in_use(*_: object, **__: object) -> None:
    raise FolderInUseError("in use")


@pytest.mark.slow
def test_a_cluster_that_goes_in_the_middle_ends_the_batch_with_a_line_and_keeps_the_rows(tmp_path, monkeypatch):
    runs = [points_run(tmp_path / name) for name in "abc"]
    monkeypatch.setattr(module, "_CHECK_S", 0.1)
    cluster = distributed.LocalCluster(1, processes=False, threads_per_worker=1, dashboard_address=None)
    with pytest.raises(RunError, match=r"the cluster has gone; . runs? (is|are) left; the same command continues"):
        process_batch(
            runs,
            tmp_path / "out",
            BatchOptions(dask=cluster.scheduler_address),
            report=lambda line: cluster.close(timeout=5),
        )
    assert 1 <= len(rows_of(tmp_path / "out/batch.csv")) < 3
    assert (tmp_path / "out/index.html").is_file()


@pytest.mark.slow
def test_a_worker_that_is_killed_in_the_middle_changes_no_byte(tmp_path):
    """Two processes; the one that works on the longest run is killed twice while it writes."""
    runs = [
        simulate("smooth", tmp_path / f"run-{seed}", seed=seed, frames=600 if seed == 1 else 60, detections_only=True)
        for seed in range(1, 7)
    ]
    process_batch(runs, tmp_path / "local")
    killed: list[int] = []
    with distributed.LocalCluster(2, threads_per_worker=1, dashboard_address=None) as cluster:
        stop = threading.Event()

        def kill() -> None:
            while len(killed) < 2 and not stop.wait(0.02):
                for lock in (tmp_path / "there").glob(".run-1.beampose-lock"):
                    words = lock.read_text().split()  # "process NUMBER on ..."
                    time.sleep(0.3)
                    if len(words) > 1 and int(words[1]) not in killed:
                        os.kill(int(words[1]), signal.SIGKILL)
                        killed.append(int(words[1]))

        thread = threading.Thread(target=kill)
        thread.start()
        try:
            there = process_batch(runs, tmp_path / "there", BatchOptions(dask=cluster.scheduler_address))
        finally:
            stop.set()
            thread.join()
    assert len(killed) == 2
    assert there.exit_status == 0
    assert tables(tmp_path / "there") == tables(tmp_path / "local")
    assert not [p for p in (tmp_path / "there").iterdir() if ".part-" in p.name or p.name.endswith("-lock")]
