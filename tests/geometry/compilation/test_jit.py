"""Machine code on disk: kept for the next process, never that of other sources, and never needed."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import pytest

from geometry import compiled_projection as forward
from geometry.compilation import compile_cache, jit

# A program of two floors. What the upper one compiles stands on the lower one's source.
INNER = """
from geometry.compilation.jit import compiled

@compiled
def grown(x, by):
    return x + 10 * by
"""
OUTER = """
from geometry.compilation.jit import compiled
from geometry.inner import grown

@compiled
def twice_grown(x):
    count = 0
    for _ in range(2):
        count = grown(count, 1)
    return x + count + grown(0, 0)
"""
# What a process of it finds, as JSON.
FIND = """
import json, logging, sys, tempfile
if "nowhere" in sys.argv:
    tempfile.tempdir = "/dev/null/nowhere"
lines, begun = [], []
logging.getLogger("beampose").setLevel(logging.INFO)
logging.getLogger("beampose").addHandler(type("Keep", (logging.Handler,), {"emit": lambda _, r: lines.append(r)})())
from pathlib import Path
from numba.core import event
from geometry.compilation import compile_cache as compiled
from floor import outer
with event.install_listener("numba:compile", type("Count", (event.Listener,), {
    "on_start": lambda _, e: begun.append(e.data["dispatcher"].py_func.__name__), "on_end": lambda _, e: None
})()):
    here = Path(outer.__file__).parent
    before = compiled.is_empty(here)
    value = outer.twice_grown(0.0)
print(json.dumps({
    "value": value, "cold": [before, compiled.is_empty(here)], "said": [r.getMessage() for r in lines],
    "compiled": sorted(begun), "signatures": len(outer.grown.signatures), "folder": str(compiled.cache_folder(here)),
}))
"""


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The two floors in a folder, as yet never run."""
    folder = tmp_path_factory.mktemp("program")
    for floor in ("geometry", "geometry/compilation", "floor"):
        (folder / floor).mkdir()
        (folder / floor / "__init__.py").write_text("")
    for module in (jit, compile_cache):
        shutil.copy(str(module.__file__), folder / "geometry" / "compilation")
    (folder / "geometry" / "inner.py").write_text(INNER)
    (folder / "floor" / "outer.py").write_text(OUTER)
    return folder


def started(program: Path, *arguments: str, **environment: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-c", FIND, *arguments],
        cwd=program,
        env={**os.environ, "PYTHONPATH": str(program), **environment},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def found(process: subprocess.Popen[str]) -> dict[str, Any]:
    out, err = process.communicate(timeout=60)
    assert (process.returncode, err) == (0, "")
    return dict(json.loads(out))


@pytest.fixture(scope="module")
def first_two(program: Path) -> list[dict[str, Any]]:
    """Two processes that begin at once, when nothing is compiled."""
    return [found(process) for process in [started(program), started(program)]]


def test_two_processes_that_compile_at_once_do_not_disturb_each_other(first_two):
    assert [one["value"] for one in first_two] == [20.0, 20.0]
    assert "twice_grown" in first_two[0]["compiled"] + first_two[1]["compiled"]


def test_who_waits_for_the_first_compiling_is_told_once(first_two):
    told = [one["said"] for one in first_two if one["said"]]
    assert 1 <= len(told) <= 2  # the later of the two may have found some code
    for said in told:
        assert said == ["compiling for this machine, once (about half a minute)"]
    assert [one["cold"][1] for one in first_two] == [False, False]


def test_a_literal_is_a_number_like_any_other(first_two):
    compiling = [one for one in first_two if "grown" in one["compiled"]]
    assert [one["compiled"].count("grown") for one in compiling] == [1] * len(compiling)
    assert [one["signatures"] for one in compiling] == [1] * len(compiling)


def test_the_next_process_compiles_nothing_and_code_of_an_edited_source_is_never_used(program, first_two):
    later = found(started(program))
    assert (later["value"], later["compiled"], later["said"]) == (20.0, [], [])
    # numba's own cache looks at outer.py only, which stays as it is.
    (program / "geometry" / "inner.py").write_text(INNER.replace("10", "100"))
    edited = found(started(program))
    assert (edited["value"], edited["cold"]) == (200.0, [True, False])
    assert edited["folder"] != later["folder"]


def test_without_any_folder_to_write_it_works_and_says_that_it_compiles_each_time(program, tmp_path):
    shutil.copytree(program, tmp_path / "program", ignore=shutil.ignore_patterns("__pycache__"))
    (tmp_path / "program" / "geometry" / "compilation" / "__pycache__").write_text(
        "a file where a folder should be: not even root can"
    )
    alone = found(started(tmp_path / "program", "nowhere", XDG_CACHE_HOME="/dev/null/nowhere"))
    assert alone["folder"] == "None"
    assert alone["value"] in (20.0, 200.0)
    assert alone["cold"] == [True, True]
    assert len(alone["said"]) == 1
    assert "each time" in alone["said"][0]


def test_of_old_code_the_last_used_is_left(tmp_path):
    for age in range(compile_cache.MOST_FOLDERS + 3):
        folder = tmp_path / f"beampose-compiled-{age:02d}"
        folder.mkdir()
        (folder / "code.nbi").write_text("")
        os.utime(folder, (1e9 - age, 1e9 - age))
    (tmp_path / "another").mkdir()
    compile_cache._remove_old(tmp_path)
    kept = sorted(p.name for p in tmp_path.iterdir())
    assert kept == ["another", *(f"beampose-compiled-{age:02d}" for age in range(compile_cache.MOST_FOLDERS))]


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="this system's files have no owners")
def test_code_that_somebody_else_has_laid_there_is_not_run(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    package = Path(str(forward.__file__)).parent
    look = compile_cache._writable_folder.__wrapped__  # what is found once is remembered
    assert look(compile_cache._sources(package)) is not None
    monkeypatch.setattr(os, "getuid", lambda: 12345)
    assert look(compile_cache._sources(package)) is None
