"""The Parquet data sets of a batch have the numbers of the tables, and one schema for all runs."""

from __future__ import annotations

import importlib

import pandas as pd
import pytest

from lab.errors import InputError
from lab.runs.batch.batch import BatchOptions, process_batch
from tests.lab.run_folders import edit, write_run
from tests.lab.runs.batch.test_batch import points_run

PARQUET = BatchOptions(parquet=True)


def test_the_data_sets_hold_the_tables_of_all_runs(tmp_path):
    pytest.importorskip("pyarrow")
    runs = [points_run(tmp_path / "001"), write_run(tmp_path / "x=y z"), points_run(tmp_path / "b", 6)]
    process_batch(runs[:2], tmp_path / "out", PARQUET)  # the second one has no pose in any frame
    process_batch(runs[2:], tmp_path / "out", PARQUET)
    for name in ("attitude", "spots"):
        together = pd.read_parquet(tmp_path / "out/parquet" / name)
        assert set(together["run"]) == {"001", "x=y z", "b"}
        for run in runs:
            own = together[together["run"] == run.name].drop(columns="run").reset_index(drop=True)
            words = {"status": str, "camera": str, "spot": str, "beam": str}
            table = pd.read_csv(tmp_path / "out" / run.name / f"{name}.csv", dtype=words)
            pd.testing.assert_frame_equal(own, table, check_dtype=False, rtol=1e-15)


def test_a_run_without_results_any_more_leaves_the_data_sets_and_the_others_are_not_written_again(tmp_path):
    pytest.importorskip("pyarrow")
    runs = [points_run(tmp_path / "a"), points_run(tmp_path / "b", 6)]
    process_batch(runs, tmp_path / "out", PARQUET)
    files = {p.name: p.stat().st_ino for p in (tmp_path / "out/parquet/spots").iterdir()}
    (line,) = [x for x in (runs[0] / "run.yaml").read_text().splitlines() if x.startswith("frame_rate_hz")]
    edit(runs[0] / "run.yaml", line, "frame_rate_hz: none")
    process_batch(runs, tmp_path / "out", PARQUET)
    after = {p.name: p.stat().st_ino for p in (tmp_path / "out/parquet/spots").iterdir()}
    assert after == {"b.parquet": files["b.parquet"]}


def test_a_missing_package_is_reported_before_the_work(tmp_path, monkeypatch):
    real = importlib.import_module
    monkeypatch.setattr(importlib, "import_module", lambda name, *a: real("no_such" if name == "pyarrow" else name, *a))
    with pytest.raises(InputError, match=r"--parquet: .*pyarrow.*pip install 'beampose\[parquet\]'"):
        process_batch([tmp_path / "a"], tmp_path / "out", PARQUET)
    assert not (tmp_path / "out").exists()
