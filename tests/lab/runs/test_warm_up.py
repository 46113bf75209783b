"""`make setup` compiles all that the sample runs need."""

from __future__ import annotations

import subprocess
import sys

import pytest

from tests.paths import ROOT

PROGRAM = """
import gc, sys, tempfile
from pathlib import Path
from numba.core.registry import CPUDispatcher
from lab.runs.process import process_run
from lab.runs.warm_up import warm_up

def versions():
    functions = [one for one in gc.get_objects() if isinstance(one, CPUDispatcher)]
    return {(f.py_func.__module__, f.py_func.__name__, str(s)) for f in functions for s in f.signatures}

warm_up()
before = versions()
assert before, "the warm-up compiles nothing"
for run in sys.argv[1:]:
    with tempfile.TemporaryDirectory() as out:
        process_run(Path(run), Path(out) / "out")
    print(*sorted(versions() - before), sep="\\n", end="")
"""


@pytest.mark.slow
@pytest.mark.parametrize("name", ["calibrated", "four-skew-beams", "turntable-video"])
def test_a_sample_run_needs_no_code_that_the_warm_up_has_not_compiled(name):
    command = [sys.executable, "-c", PROGRAM, str(ROOT / "sample_runs" / name)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout == ""
