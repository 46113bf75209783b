"""run.log: start, stages, warnings with their codes, and end; shown by --verbose, and nothing by --quiet."""

from __future__ import annotations

import logging
import re
from pathlib import Path

import pytest

from lab.runs.run_log import LOGGER, RunLog, listening
from lab.simulate.write import simulate
from tests.lab.command import typed
from tests.lab.run_folders import write_run

LINE = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}Z (INFO|WARNING|ERROR) +(.+)")


@pytest.fixture(scope="module")
def points(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return simulate("smooth", tmp_path_factory.mktemp("log") / "run", seed=5, frames=6, points=True)


def lines(out: Path) -> list[tuple[str, str]]:
    """Level and text of each line of run.log."""
    found = [LINE.fullmatch(line) for line in (out / "run.log").read_text("utf-8").splitlines()]
    assert None not in found
    return [(m[1], m[2]) for m in found if m]


def test_the_log_has_start_stages_and_end(points, tmp_path):
    assert typed("run", points, "--out", tmp_path / "out").exit_code == 0
    found = lines(tmp_path / "out")
    assert found[0] == ("INFO", f"start: smooth-5, run folder {points}, rig {points / 'rig.yaml'}")
    assert [t for _, t in found if t.startswith("stage: ")] == [
        "stage: tracking", "stage: smoothing", "stage: writing", "stage: report",
    ]  # fmt: skip
    assert re.fullmatch(r"end: PASS, \d+\.\d s, exit status 0", found[-1][1])


def test_a_failed_gate_is_an_error_with_its_code(tmp_path):
    assert typed("run", write_run(tmp_path / "grey"), "--out", tmp_path / "out", "--causal").exit_code == 4
    found = lines(tmp_path / "out")
    assert any(level == "ERROR" and text.startswith("BP-V02 the vehicle was never found") for level, text in found)
    assert "stage: smoothing" not in {text for _, text in found}
    assert found[-1][1].endswith("exit status 4")


def test_verbose_shows_the_lines_of_the_log_and_quiet_nothing(points, tmp_path):
    done = typed("run", points, "--out", tmp_path / "out", "--verbose")
    assert done.exit_code == 0
    assert done.stderr == (tmp_path / "out" / "run.log").read_text("utf-8")
    assert done.stdout.startswith("smooth-5: PASS")
    assert not any(type(handler).__module__ == "lab.commands.common" for handler in LOGGER.handlers)
    done = typed("run", points, "--out", tmp_path / "out", "-q")
    assert (done.exit_code, done.stdout, done.stderr) == (0, "", "")


def test_quiet_still_shows_errors(tmp_path):
    done = typed("run", tmp_path / "nowhere", "--out", tmp_path / "out", "--quiet")
    assert (done.exit_code, done.stdout) == (2, "")
    assert "expected a run folder, found nothing" in done.stderr


def test_verbose_and_quiet_exclude_each_other(points, tmp_path):
    done = typed("run", points, "--out", tmp_path / "out", "-v", "-q")
    assert done.exit_code == 2
    assert "expected --verbose or --quiet, got both" in done.stderr


def test_messages_of_the_libraries_are_in_the_log_until_it_ends(tmp_path, capsys):
    libraries = logging.getLogger("beampose")
    before = libraries.level
    with listening() as log:
        libraries.info("compiling\nfor this machine")
    libraries.info("later")
    log.write(tmp_path)
    assert [text for _, text in lines(tmp_path)] == ["compiling for this machine"]
    assert (libraries.level, log in libraries.handlers) == (before, False)
    assert capsys.readouterr().err == ""


def test_a_stage_is_noted_once_and_progress_is_passed_on():
    log, seen = RunLog(), []
    noted = log.progress(lambda *a: seen.append(a))
    for done in range(3):
        noted(done, 3, "tracking")
    assert seen == [(0, 3, "tracking"), (1, 3, "tracking"), (2, 3, "tracking")]
    assert len(log._lines) == 1


def test_a_new_run_states_that_the_video_of_the_earlier_results_is_gone(points, tmp_path):
    out = tmp_path / "out"
    assert typed("run", points, "--out", out).stderr == ""
    assert typed("report", out, "--video").exit_code == 0
    assert f"{out / 'overlay.mp4'}: removed with the earlier results" in typed("run", points, "--out", out).stderr
    assert not (out / "overlay.mp4").exists()
