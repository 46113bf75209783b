"""A batch of runs: a run that fails does not stop the others, and batch.csv has the outcome of each."""

from __future__ import annotations

import html
import json
from pathlib import Path

import click
import pytest

from cli import main
from lab.commands.common import command_line
from lab.errors import CalibrationError, InputError, RunError
from lab.files.text.csv_text import write_table
from lab.findings.finding import entries
from lab.runs import process
from lab.runs.batch import task as module
from lab.runs.batch.batch import BatchOptions, process_batch, read_rows
from lab.runs.batch.task import COLUMNS
from lab.simulate.write import simulate
from tests.lab.command import typed
from tests.lab.run_folders import write_run
from tests.lab.tables import rows_of


def points_run(folder: Path, seed: int = 5) -> Path:
    return simulate("smooth", folder, seed=seed, frames=4, points=True)


@pytest.fixture(scope="module")
def mixed(tmp_path_factory):
    """A good run, a folder that does not exist, a run without spots, another good run."""
    folder = tmp_path_factory.mktemp("batch")
    runs = [points_run(folder / "good"), folder / "nothing", write_run(folder / "grey"), points_run(folder / "last", 6)]
    lines: list[str] = []
    return process_batch(runs, folder / "out", report=lines.append), lines


def test_the_batch_continues_after_a_bad_run_and_every_run_has_a_row(mixed):
    outcome, _ = mixed
    rows = rows_of(outcome.table)
    assert tuple(rows[0]) == COLUMNS
    assert [r["exit_status"] for r in rows] == ["0", "2", "4", "0"]
    assert [r["status"] for r in rows] == ["pass", "error", "fail", "pass"]
    assert [r["measured_frames"] for r in rows] == ["4", "", "0", "4"]
    assert "expected a run folder, found nothing" in rows[1]["message"]


def test_the_good_runs_have_their_results_and_the_bad_one_has_none(mixed):
    outcome, _ = mixed
    out = outcome.table.parent
    for row in rows_of(outcome.table):
        if row["results"]:
            assert (out / row["results"] / "attitude.csv").is_file()
    seen = [p.name for p in out.iterdir() if not p.name.startswith(".")]
    assert sorted(seen) == ["batch.csv", "errors", "good", "grey", "index.html", "last"]


def test_a_line_is_reported_for_every_run_when_it_ends(mixed):
    _, lines = mixed
    assert [line.split(":")[:2] for line in lines] == [
        ["good", " PASS"], ["nothing", " ERROR"], ["grey", " FAIL"], ["last", " PASS"],
    ]  # fmt: skip


def test_the_index_names_every_run_and_links_the_reports(mixed):
    outcome, _ = mixed
    page = outcome.index.read_text("utf-8")
    for name in ("good", "grey", "last"):
        assert f"{name}/report.html" in page
    assert "nothing" in page


def test_the_exit_status_is_that_of_the_worst(mixed, tmp_path):
    outcome, _ = mixed
    assert outcome.exit_status == 1
    good, grey = points_run(tmp_path / "good"), write_run(tmp_path / "grey")
    assert process_batch([good], tmp_path / "a").exit_status == 0
    assert process_batch([good, grey], tmp_path / "b").exit_status == 4


@pytest.mark.parametrize("error", [RunError("gone\nhalf-way"), InputError("wrong"), CalibrationError("out of date")])
def test_any_error_of_a_run_becomes_its_row(tmp_path, monkeypatch, error):
    def fail(*_, **__):
        raise error

    monkeypatch.setattr(module, "process_run", fail)
    outcome = process_batch([points_run(tmp_path / "a")], tmp_path / "out")
    (row,) = rows_of(outcome.table)
    assert row["exit_status"] == str(error.exit_status)
    assert row["message"] == str(error).replace("\n", " | ")
    # Contract, section 5: 1 if a run could not be processed; 3 if the calibration is the only cause.
    assert outcome.exit_status == (3 if isinstance(error, CalibrationError) else 1)


def test_the_table_is_written_after_every_run(tmp_path, monkeypatch):
    """A batch that is killed in its second run keeps the first one's row."""
    runs = [points_run(tmp_path / "a"), points_run(tmp_path / "b")]
    process_run = module.process_run

    def stop_at_b(run, *args, **kwargs):
        if run.folder.name == "b":
            raise KeyboardInterrupt
        return process_run(run, *args, **kwargs)

    monkeypatch.setattr(module, "process_run", stop_at_b)
    with pytest.raises(KeyboardInterrupt):
        process_batch(runs, tmp_path / "out")
    assert [r["run"] for r in rows_of(tmp_path / "out/batch.csv")] == [str(runs[0])]


def test_runs_of_the_same_name_get_separate_folders(tmp_path):
    for day in ("monday", "tuesday"):
        (tmp_path / day).mkdir()
    runs = [points_run(tmp_path / "monday/run"), points_run(tmp_path / "tuesday/run", 6)]
    rows = rows_of(process_batch(runs, tmp_path / "out").table)
    assert len({r["results"] for r in rows}) == 2
    assert all((tmp_path / "out" / r["results"] / "report.html").is_file() for r in rows)
    assert [r["results"].split("-")[0] for r in rows] == ["monday", "tuesday"]


def test_giving_the_same_run_twice_is_an_error(tmp_path):
    run = points_run(tmp_path / "a")
    with pytest.raises(InputError, match="given more than once"):
        process_batch([run, tmp_path / "x" / ".." / "a"], tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_giving_no_run_is_an_error(tmp_path):
    with pytest.raises(InputError, match="expected one or more run folders"):
        process_batch([], tmp_path / "out")


def test_a_file_in_place_of_the_out_folder_is_an_error(tmp_path):
    (tmp_path / "out").write_text("")
    with pytest.raises(InputError, match="expected a folder for the results, found a file"):
        process_batch([points_run(tmp_path / "a")], tmp_path / "out")


def test_a_batch_can_be_repeated_into_the_same_folder(tmp_path):
    run = points_run(tmp_path / "a")
    first, second = process_batch([run], tmp_path / "out"), process_batch([run], tmp_path / "out")
    keep = [n for n in COLUMNS if n != "seconds"]
    assert [[r[n] for n in keep] for r in first.rows] == [[r[n] for n in keep] for r in second.rows]


def test_names_with_commas_are_unchanged_in_the_table(tmp_path):
    run = points_run(tmp_path / "a, b")
    (row,) = rows_of(process_batch([run], tmp_path / "out").table)
    assert row["run"] == str(run)
    assert (tmp_path / "out" / row["results"] / "summary.json").is_file()


# Runs that end with an error ------------------------------------------------------------------------------------------


def test_the_report_of_a_failed_run_has_message_status_and_explained_code_and_the_index_links_it(mixed):
    outcome, _ = mixed
    row = rows_of(outcome.table)[1]
    assert (row["results"], row["report"]) == ("", "errors/nothing.html")
    page = (outcome.table.parent / row["report"]).read_text("utf-8")
    assert html.escape(row["message"]) in page
    assert "BP-E02" in page
    assert entries()["BP-E02"].meaning in page
    assert "exit status 2" in page
    assert 'href="./errors/nothing.html"' in outcome.index.read_text("utf-8")


def test_a_failed_run_keeps_its_earlier_results_and_a_later_success_removes_the_failure(tmp_path):
    run, out = points_run(tmp_path / "a"), tmp_path / "out"
    process_batch([run], out)
    before = (out / "a/report.html").read_bytes()
    (run / "rig.yaml").rename(run / "rig.away")
    (row,) = rows_of(process_batch([run], out).table)
    assert (row["status"], row["results"], row["report"]) == ("error", "", "errors/a.html")
    assert "earlier processing were kept" in (out / "errors/a.html").read_text("utf-8")
    assert (out / "a/report.html").read_bytes() == before
    (run / "rig.away").rename(run / "rig.yaml")
    (row,) = rows_of(process_batch([run], out).table)
    assert (row["status"], row["report"]) == ("pass", "a/report.html")
    assert not (out / "errors").exists()


def test_the_report_of_a_failure_in_the_middle_has_the_lines_of_the_log_until_then(tmp_path, monkeypatch):
    def ended(*_, **__):
        raise RunError("the pictures ended")

    monkeypatch.setattr(process, "write_tables", ended)
    lines: list[str] = []
    (row,) = rows_of(process_batch([points_run(tmp_path / "a")], tmp_path / "out", log=lines.append).table)
    page = (tmp_path / "out" / row["report"]).read_text("utf-8")
    assert [" start: " in line for line in lines] == [True, False]
    assert all(html.escape(line.removeprefix("a: ")) in page for line in lines)


def test_the_summary_has_the_command_and_quiet_shows_nothing_but_errors(tmp_path):
    run, out = points_run(tmp_path / "a"), tmp_path / "out"
    done = typed("batch", run, "--out", out, "--quiet", "--set", "r1_px=9")
    assert (done.stdout, done.stderr, done.exit_code) == ("", "", 0)
    summary = json.loads((out / "a/summary.json").read_text("utf-8"))
    assert summary["command"] == f"beampose batch {run} --out {out} --quiet --set r1_px=9"
    done = typed("batch", tmp_path / "none", "--out", out, "--quiet")
    assert (done.stdout, done.stderr.count("\n"), done.exit_code) == ("", 1, 1)
    assert done.stderr.startswith("beampose: none: ERROR: ")


def test_a_long_list_of_runs_is_shortened_in_the_recorded_command():
    runs = [f"run-{i}" for i in range(2000)]
    context = main.commands["batch"].make_context(
        "batch", [*runs, "--out", "x"], parent=click.Context(main, info_name="beampose")
    )
    line = command_line(context)
    assert line.startswith("beampose batch run-0 run-1 ")
    assert "(2000 in all)" in line
    assert len(line) < 400


def test_verbose_shows_the_log_of_each_run_and_excludes_quiet(tmp_path):
    run, out = points_run(tmp_path / "a"), str(tmp_path / "out")
    done = typed("batch", run, "--out", out, "-v")
    log = (tmp_path / "out/a/run.log").read_text("utf-8").splitlines()
    assert done.stderr.splitlines() == [f"a: {line}" for line in log]
    assert typed("batch", run, "--out", out, "-v", "-q").exit_code == 2


def fields(value: object, place: str = "") -> dict[str, object]:
    """All numbers and words of a JSON value, by their place in it."""
    if isinstance(value, dict):
        return {k: v for key, inner in value.items() for k, v in fields(inner, f"{place}.{key}").items()}
    if isinstance(value, list):
        return {k: v for i, inner in enumerate(value) for k, v in fields(inner, f"{place}.{i}").items()}
    return {place: value}


@pytest.mark.slow
def test_a_summary_depends_on_the_number_of_processes_only_in_times_and_the_command(tmp_path):
    runs = [points_run(tmp_path / "a"), points_run(tmp_path / "b", 6)]
    found = []
    for jobs in (None, 2):
        options = BatchOptions(jobs=jobs, provenance={"command": f"--jobs {jobs}"})
        process_batch(runs, tmp_path / f"out-{jobs}", options)
        found.append(fields(json.loads((tmp_path / f"out-{jobs}/a/summary.json").read_text("utf-8"))))
    differ = {place for place in found[0].keys() | found[1].keys() if found[0].get(place) != found[1].get(place)}
    assert len(found[0]) > 100
    assert ".command" in differ
    times = {".command", ".rates.processed_frames_per_s", ".smoother.seconds"}
    assert {place for place in differ if not place.startswith(".timings.")} <= times


def test_results_whose_names_look_like_formulas_are_found_again_in_the_table(tmp_path):
    """A spreadsheet sees an apostrophe in front; the program, and its index with links to them, the name."""
    rows = [{"run": "=a", "folder": "/runs/=a", "status": "PASS", "results": "=a"}]
    path = tmp_path / "batch.csv"
    write_table(path, list(rows[0]), [list(rows[0].values())])
    assert "'=a" in path.read_text("utf-8")
    assert read_rows(path) == rows
