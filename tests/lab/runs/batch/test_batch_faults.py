"""No fault of one run, foreseen or not, stops the other runs of a batch."""

from __future__ import annotations

import errno
import os
import resource
import shutil
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from lab.errors import InputError
from lab.runs.batch import task
from lab.runs.batch.batch import BatchOptions, BatchTable, process_batch
from lab.simulate.write import simulate
from tests.lab.run_folders import edit
from tests.lab.runs.batch.test_batch import points_run, rows_of

FAULTS = [
    ZeroDivisionError("division by zero"),
    RecursionError("too deep"),
    MemoryError(),
    PermissionError(errno.EACCES, "Permission denied", "data/run"),
    OSError(errno.ENOSPC, "No space left on device"),
    OSError(errno.EBADF, "Bad file", 7),
    UnicodeEncodeError("utf-8", "\udce9", 0, 1, "surrogates not allowed"),
    Exception("lines\nand \udce9"),
]


def test_unforeseen_errors_are_rows_with_the_places_of_their_tracebacks(tmp_path, monkeypatch):
    original = task.process_run
    good = points_run(tmp_path / "good")
    bad = {tmp_path / f"bad{n}": fault for n, fault in enumerate(FAULTS)}
    for folder in bad:
        shutil.copytree(good, folder)

    def process(run, *args, **kwargs):
        if run.folder in bad:
            raise bad[run.folder]
        return original(run, *args, **kwargs)

    monkeypatch.setattr(task, "process_run", process)
    outcome = process_batch([*bad, good], tmp_path / "out")
    *rows, last = rows_of(outcome.table)
    assert (last["status"], outcome.exit_status) == ("pass", 1)
    for row, (folder, fault) in zip(rows, bad.items(), strict=True):
        assert (row["status"], row["exit_status"], row["results"]) == ("error", "1", "")
        saved = tmp_path / "out/errors" / f"{folder.name}.txt"
        assert str(saved) in row["message"]
        assert type(fault).__name__ in saved.read_text("utf-8")

    first, *others = bad
    monkeypatch.setattr(task, "process_run", original)
    for folder in others:
        for suffix in (".txt", ".html"):
            (tmp_path / "out/errors" / f"{folder.name}{suffix}").unlink()
    assert process_batch([first], tmp_path / "out").exit_status == 0
    assert not (tmp_path / "out/errors").exists()


def test_a_full_disk_in_a_table_stops_its_own_run_only(tmp_path):
    """A limit of the size of files has the same effect as a full disk: the write fails in the middle."""
    small = points_run(tmp_path / "small")
    large = simulate("smooth", tmp_path / "large", seed=5, frames=400, points=True)
    process_batch([small], tmp_path / "first")
    most = max(file.stat().st_size for file in (tmp_path / "first").rglob("*") if file.is_file())
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2 * most, before[1]))
    try:
        outcome = process_batch([large, small], tmp_path / "out")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    rows = rows_of(outcome.table)
    assert [r["status"] for r in rows] == ["error", "pass"]
    assert "File too large" in rows[0]["message"]
    assert not (tmp_path / "out/large").exists()


def test_an_absurd_rate_a_loop_of_links_and_a_folder_without_a_run_do_not_stop_the_batch(tmp_path):
    rate, good = points_run(tmp_path / "rate"), points_run(tmp_path / "good")
    (line,) = [x for x in (rate / "run.yaml").read_text().splitlines() if x.startswith("frame_rate_hz")]
    edit(rate / "run.yaml", line, "frame_rate_hz: 1e300")
    (tmp_path / "loop").symlink_to("loop")
    (tmp_path / "linked").mkdir()
    (tmp_path / "linked/run.yaml").symlink_to("run.yaml")
    (tmp_path / "nested/run.yaml").mkdir(parents=True)
    runs = [rate, tmp_path / "loop", tmp_path / "linked", tmp_path / "nested", good]
    rows = rows_of(process_batch(runs, tmp_path / "out").table)
    assert [r["status"] for r in rows] == ["error"] * 4 + ["pass"]


def test_folders_of_any_name_have_a_row_and_do_not_stop_the_batch(tmp_path):
    lines: list[str] = []
    names = (b"caf\xe9", b"line\nbreak", b"red\x1b[31m", b"index.html", b"errors", b"=1+1")
    strange = [Path(os.fsdecode(os.path.join(os.fsencode(tmp_path), name))) for name in names]
    for folder in strange:
        points_run(tmp_path / "plain").rename(folder)
    good = points_run(tmp_path / "good")
    outcome = process_batch([*strange, good], tmp_path / "out", report=lines.append)
    *rows, last = rows_of(outcome.table)
    assert len(rows) == len(names)
    assert last["status"] == "pass"
    assert all(line.isprintable() for line in lines)
    assert (tmp_path / "out/index.html").is_file()
    for row in rows:
        if row["status"] != "error":
            results = row["results"].removeprefix("'")  # before what a spreadsheet would read as a formula
            assert (tmp_path / "out" / results / "report.html").is_file()


def test_a_run_whose_process_dies_is_a_row(tmp_path, monkeypatch):
    """The pool's part is in test_batch_workers; here a task without a result."""
    from lab.runs.batch import batch

    def died(tasks, perform, jobs):
        assert jobs == 2
        yield tasks[0], None
        yield tasks[1], perform(tasks[1])

    monkeypatch.setattr(batch, "performed", died)
    runs = [points_run(tmp_path / "a"), points_run(tmp_path / "b")]
    rows = rows_of(process_batch(runs, tmp_path / "out", BatchOptions(jobs=2)).table)
    assert [r["status"] for r in rows] == ["error", "pass"]
    assert "killed, or ran out of memory" in rows[0]["message"]


# One folder, several batches -----------------------------------------------------------------------------------------


def row_of(name: str, status: str = "pass") -> dict[str, str]:
    return {**dict.fromkeys(task.COLUMNS, ""), "folder": f"/{name}", "run": name, "status": status, "results": name}


def test_batches_at_the_same_time_lose_no_row(tmp_path):
    def batch(number: int) -> None:
        names = [f"{number}-{i}" for i in range(6)]
        table = BatchTable(tmp_path, [f"/{n}" for n in names])
        for name in names:
            table.add(row_of(name))
            table.write()

    with ThreadPoolExecutor(6) as pool:
        list(pool.map(batch, range(6)))
    assert len({r["folder"] for r in rows_of(tmp_path / "batch.csv")}) == 36


def test_rows_are_in_the_order_of_the_batch_whatever_ends_first_and_others_stay(tmp_path):
    other = BatchTable(tmp_path, ["/x", "/y"])
    for name in ("x", "y"):
        other.add(row_of(name))
    other.write()
    table = BatchTable(tmp_path, ["/a", "/y", "/c"])
    for name in ("c", "y", "a"):
        table.add(row_of(name, "fail"))
        table.write()
    rows = rows_of(tmp_path / "batch.csv")
    assert [(r["run"], r["status"]) for r in rows] == [("x", "pass"), ("a", "fail"), ("y", "fail"), ("c", "fail")]


def test_a_row_that_could_not_be_written_is_written_with_the_next(tmp_path, monkeypatch):
    from lab.runs.batch import batch as module

    def full(*_):
        raise InputError("No space left on device")

    table = BatchTable(tmp_path, ["/a", "/b"])
    table.add(row_of("a"))
    with monkeypatch.context() as patched:
        patched.setattr(module, "write_table", full)
        with pytest.raises(InputError):
            table.write()
    table.add(row_of("b"))
    table.write()
    assert [r["run"] for r in rows_of(tmp_path / "batch.csv")] == ["a", "b"]


@pytest.mark.parametrize("content", [b"\xff\xfe", b"a,b\n1,2\n", b'run,status,results\n"a'])
def test_another_table_of_that_name_is_not_overwritten(tmp_path, content):
    (tmp_path / "batch.csv").write_bytes(content)
    with pytest.raises(InputError, match="expected the table of a batch, found another file"):
        process_batch([tmp_path / "run"], tmp_path)
    assert (tmp_path / "batch.csv").read_bytes() == content


def test_the_table_of_an_older_version_keeps_its_rows(tmp_path):
    run = points_run(tmp_path / "a")
    (tmp_path / "out").mkdir()
    (tmp_path / "out/batch.csv").write_text("run,name,status,results,message\n/data/b,b,pass,b,good\n")
    rows = rows_of(process_batch([run], tmp_path / "out").table)
    assert [(r["run"], r["folder"]) for r in rows] == [("/data/b", "/data/b"), (str(run), str(run))]
