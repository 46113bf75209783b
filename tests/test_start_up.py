"""What a command imports: start-up does not load libraries that the command does not use."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from tests.lab.run_folders import RIG, RUN
from tests.paths import ROOT

REPORT = """
import sys
from cli import main
try:
    main({arguments!r})
except SystemExit:
    pass
print("LOADED", *sorted(sys.modules))
"""
# Imports modules as usual, and prints those that were loaded when the tables were opened.
WATCHED = """
import sys
import lab.runs.tables
first = []
enter = lab.runs.tables.TableWriter.__enter__
def begun(self):
    first.extend(sys.modules)
    return enter(self)
lab.runs.tables.TableWriter.__enter__ = begun
from cli import main
try:
    main({arguments!r})
except SystemExit as done:
    print("STATUS", done.code)
print("FIRST", *sorted(first))
print("LOADED", *sorted(sys.modules))
"""
# All modules of some packages, given as words.
EVERYTHING = """
import importlib, pkgutil, sys
for name in {arguments!r}:
    package = importlib.import_module(name)
    for module in pkgutil.walk_packages(package.__path__, name + "."):
        importlib.import_module(module.name)
print("LOADED", *sorted(sys.modules))
"""
# What an exit handler finds that runs after those of the program.
AT_EXIT = """
import atexit, gc
atexit.register(lambda: print("LOADED", gc.get_freeze_count() > 1000, gc.get_threshold()[0] > 100_000))
from cli import main
main({arguments!r})
"""
SLOW_SCIPY = {
    "scipy.stats", "scipy.optimize", "scipy.special", "scipy.ndimage", "scipy.spatial", "scipy.sparse", "scipy.linalg",
}  # fmt: skip
COMPILER = {"numba.np.linalg", "numba.np.arraymath", "numba.cpython.setobj", "numba.np.polynomial"}


def words_of(code: str, *arguments: str) -> dict[str, set[str]]:
    """What the program printed: the words of each line, by its first word."""
    command = [sys.executable, "-c", code.format(arguments=list(arguments))]
    out = subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOT).stdout
    lines = [line.split() for line in out.splitlines() if line.strip()]
    return {first: set(words) for first, *words in lines}


def loaded(code: str, *arguments: str) -> set[str]:
    return words_of(code, *arguments)["LOADED"]


@pytest.mark.parametrize(
    "arguments",
    [
        ("--version",),
        ("--help",),
        ("run", "--help"),
        ("detect", "--help"),
        ("watch", "--help"),
        ("view", "--help"),
        ("calibrate", "rig", "--help"),
    ],
)
def test_help_and_version_import_no_library_but_click(arguments):
    heavy = {"numpy", "scipy", "cv2", "pandas", "numba", "pydantic", "yaml", "jinja2", "rich"}
    assert heavy & loaded(REPORT, *arguments) == set()


@pytest.fixture(scope="module")
def points_run(tmp_path_factory) -> dict[str, set[str]]:
    """The modules that a run of 12 frames has loaded: before its first row (FIRST), and at its end (LOADED)."""
    folder = tmp_path_factory.mktemp("points")
    (folder / "rig.yaml").write_text(RIG)
    text = RUN.replace("{frames: frames/left}", "{detections: points.csv}")
    (folder / "run.yaml").write_text(text.replace("{frames: frames/right}", "{detections: points.csv}"))
    rows = [f"{f},{camera},{20 + f / 10},{20 - f / 10}" for f in range(12) for camera in ("left", "right")]
    (folder / "points.csv").write_text("\n".join(["frame,camera,u_px,v_px", *rows]) + "\n")
    arguments = ("run", str(folder), "--out", str(folder / "out"))
    modules = words_of(WATCHED, *arguments)
    return words_of(WATCHED, *arguments) if modules["LOADED"] & COMPILER else modules  # the first run may compile


def test_a_run_loads_neither_report_nor_pandas_nor_slow_parts_of_scipy_before_its_first_row(points_run):
    before = points_run["FIRST"]
    assert {"numpy", "numba", "lab.runs.tables"} <= before
    assert (
        before & (SLOW_SCIPY | {"jinja2", "markupsafe", "rich", "pandas", "lab.report.run.page", "lab.simulate.write"})
        == set()
    )


def test_a_short_run_never_loads_pandas_or_the_slow_parts_of_scipy_or_the_compiler(points_run):
    after = points_run["LOADED"]
    assert {"jinja2", "lab.report.run.page"} <= after
    assert after & (SLOW_SCIPY | COMPILER | {"pandas", "cv2", "unittest"}) == set()


def test_no_calibration_loads_the_distributions_of_scipy():
    after = loaded(EVERYTHING, "calibration", "lab.calibrate")
    assert {"scipy.special", "lab.calibrate.step"} <= after
    assert not any(name.startswith("scipy.stats") for name in after)


def test_python_does_not_search_for_cycles_while_the_program_ends():
    assert loaded(AT_EXIT, "--version") == {"True"}


def test_the_linear_algebra_has_one_thread_unless_the_user_says_otherwise():
    code = "import cli, os; print('THREADS', os.environ['OPENBLAS_NUM_THREADS'])"
    for stated in ("", "2"):
        free = {name: value for name, value in os.environ.items() if name != "OPENBLAS_NUM_THREADS"}
        env = free | ({"OPENBLAS_NUM_THREADS": stated} if stated else {})
        out = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT, env=env
        )
        assert out.stdout == f"THREADS {stated or 1}\n"
