"""The runs of a batch: folders, patterns, lists, shards; and the pace that the progress line shows."""

from __future__ import annotations

import io
import sys

import pytest

from lab.commands.run import pace
from lab.errors import InputError
from lab.runs.batch.batch import BatchOptions, process_batch
from lab.runs.batch.task import listed_runs, shard_of
from tests.lab.runs.batch.test_batch import points_run, rows_of


@pytest.fixture
def data(tmp_path, monkeypatch):
    """Folders data/b, data/a and data/deep/c with a run.yaml, and data/notes without one."""
    for name in ("b", "a", "deep/c", "notes"):
        (tmp_path / "data" / name).mkdir(parents=True)
        if name != "notes":
            (tmp_path / "data" / name / "run.yaml").touch()
    monkeypatch.chdir(tmp_path)
    return tmp_path


def as_text(runs) -> list[str]:
    return [run.as_posix() for run in runs]


def test_a_pattern_finds_run_folders_only_in_order(data):
    assert as_text(listed_runs(["data/*"])) == ["data/a", "data/b"]
    assert as_text(listed_runs(["data/**"])) == ["data/a", "data/b", "data/deep/c"]
    assert as_text(listed_runs(["data/b", "data/*"])) == ["data/b", "data/a"]


def test_a_loop_of_links_below_a_pattern_gives_every_run_once(data):
    (data / "data/deep/again").symlink_to(data / "data")
    assert len(listed_runs(["data/**"])) == 3


def test_a_folder_whose_name_looks_like_a_pattern_is_itself(data):
    (data / "data/[a]").mkdir()
    assert as_text(listed_runs(["data/[a]"])) == ["data/[a]"]


@pytest.mark.parametrize("ending", ["\n", "\r\n"])
def test_a_list_names_folders_and_patterns(data, monkeypatch, ending):
    content = ending.join(["# Monday", "data/deep/c", "", "  data/*  ", "data/a"]).encode()
    (data / "runs.txt").write_bytes(b"\xef\xbb\xbf" + content)
    expected = ["data/deep/c", "data/a", "data/b"]
    assert as_text(listed_runs(["@runs.txt"])) == expected
    assert as_text(listed_runs([], ["runs.txt"])) == expected
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(content)))
    assert as_text(listed_runs([], ["-"])) == expected


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ([], "expected one or more run folders, got none"),
        (["data/x*"], "no folder with a run.yaml matches this pattern"),
        (["@missing.txt"], "missing.txt: expected a text file with a run folder per line"),
        (["@data"], "data: expected a text file with a run folder per line"),
        (["@null.txt"], "null.txt: line 1: expected a run folder, got a line with a null byte"),
        (["data/a", "data/../data/a"], "given more than once"),
    ],
)
def test_a_wrong_list_is_one_plain_line(data, given, message):
    (data / "null.txt").write_bytes(b"a\0b")
    with pytest.raises(InputError, match=message) as error:
        listed_runs(given)
    assert len(str(error.value).splitlines()) == 1


@pytest.mark.parametrize(
    "text", ["", "1", "0/2", "3/2", "1/0", "a/b", "-1/2", "1/2/3", "1.0/2", "²/3", "1/" + "9" * 400]
)
def test_a_wrong_shard_is_one_plain_line(text):
    with pytest.raises(InputError, match="--shard: expected I/N"):
        shard_of(text)


def test_the_shards_of_a_batch_process_every_run_once_into_the_folders_of_the_whole(tmp_path):
    for day in ("monday", "tuesday"):
        (tmp_path / day).mkdir()
    runs = [points_run(tmp_path / "monday/run"), points_run(tmp_path / "tuesday/run", 6), points_run(tmp_path / "c", 7)]
    outcomes = [process_batch(runs, tmp_path / "out", BatchOptions(shard=shard_of(f"{i}/4"))) for i in (2, 4, 1, 3)]
    assert [len(o.rows) for o in outcomes] == [1, 0, 1, 1]
    rows = rows_of(tmp_path / "out/batch.csv")
    assert {r["run"]: r["results"] for r in rows} == dict(
        zip(map(str, runs), ["monday-run", "tuesday-run", "c"], strict=True)
    )
    assert process_batch(runs, tmp_path / "out").skipped == 3


def test_the_pace_counts_processed_runs_only():
    assert pace(0, 10, 5.0) == ""
    assert pace(10, 5, 60.0) == "10.0 runs/min, 30 s left"
    assert pace(1, 100, 60.0) == "1.0 runs/min, 1 h 40 min left"
    assert pace(1, 2, 600.0) == "6.0 runs/h, 20 min left"
