"""Damaged inputs end in a result or in one line; see bench/fuzz."""

from __future__ import annotations

import random

import pytest

from bench.fuzz.cases import KINDS
from bench.fuzz.inputs import write_inputs
from bench.fuzz.judge import fault_of_lines, not_finite_in, run_case, run_command
from lab.runs.batch.task import COLUMNS


@pytest.fixture(scope="module")
def base(tmp_path_factory):
    return write_inputs(tmp_path_factory.mktemp("fuzz") / "base")


@pytest.mark.parametrize("numbers", [range(20), pytest.param(range(20, 120), marks=pytest.mark.slow)], ids=len)
def test_damaged_inputs_end_in_a_result_or_in_a_line(base, tmp_path, numbers):
    endings = [run_case(2, n, base, tmp_path / "work") for n in numbers]
    assert [e for e in endings if e.fault] == []
    assert {e.status for e in endings} >= {0, 2}


_HOSTILE_OPTIONS = ("--set", "plan options", "simulate options", "names", "compare options", "init")


@pytest.mark.parametrize("kind", [k for k in KINDS if k not in _HOSTILE_OPTIONS])
def test_the_inputs_are_valid_before_they_are_damaged(kind, base, tmp_path, monkeypatch):
    for module in ("cases", "result_cases"):
        monkeypatch.setattr(f"bench.fuzz.{module}.damage_file", lambda path, rng: None)
    command = KINDS[kind][0](tmp_path, base, random.Random(1))
    status, out, err, fault = run_command(command)
    assert (status, fault) == (0, ""), out + err


def test_the_judge_knows_a_wrong_ending(tmp_path):
    assert fault_of_lines(0, "fine\n", "") == fault_of_lines(2, "", "beampose: a line\n") == ""
    assert all(map(fault_of_lines, (7, 2, 1), ("", "", ""), ("x\n", "", "Traceback ...\n")))
    assert all(map(fault_of_lines, (2, 2), ("", ""), ("a\n" * 9, "\x1b[2J\n")))
    out = tmp_path / "out"
    out.mkdir()
    (tmp_path / "out" / "a.csv").write_text("x\n1\n")
    assert not_finite_in(tmp_path) == ""
    (tmp_path / "out" / "a.csv").write_text("x\n1\ninf\n")
    assert not_finite_in(tmp_path).startswith("a.csv line 3")
    (out / "a.csv").unlink()
    (out / "batch.csv").write_text(",".join(COLUMNS) + ",mine\n" + "1," * len(COLUMNS) + "-inf\n")
    assert not_finite_in(tmp_path) == ""  # a column of the user
    (out / "batch.csv").write_text(",".join(COLUMNS) + "\n" + "inf," + "1," * (len(COLUMNS) - 1) + "\n")
    assert not_finite_in(tmp_path).startswith("batch.csv line 2")
    (out / "batch.csv").unlink()
    (out / "summary.json").write_text('{"note": ": NaN"}')
    assert not_finite_in(tmp_path) == ""
    (out / "summary.json").write_text('{"value": NaN}')
    assert not_finite_in(tmp_path) == "summary.json: NaN"


def test_an_exception_that_leaves_the_program_is_a_fault(monkeypatch):
    def breaks(*_):
        raise ZeroDivisionError("x")

    monkeypatch.setattr("lab.runs.input_check.check", breaks)
    status, _, err, fault = run_command(["check", "nowhere"])
    assert "ZeroDivisionError" in fault + err
    assert fault or fault_of_lines(status, "", err)
