"""The benches, which no other test runs, still fit the code that they measure."""

from __future__ import annotations

import ast
import importlib
import pkgutil
from pathlib import Path

import pytest

import bench

# Other trackers and detectors, which `make peers` installs into environments of their own.
PEERS = {"motmetrics", "supervision", "laptrack", "norfair", "pyrecest", "stonesoup", "trackpy"}
FOLDER = Path(bench.__path__[0])
MODULES = sorted(m.name for m in pkgutil.walk_packages(bench.__path__, "bench.") if not m.name.endswith("__main__"))


@pytest.mark.parametrize("name", MODULES)
def test_every_module_of_the_benches_can_be_imported(name):
    try:
        importlib.import_module(name)
    except ModuleNotFoundError as missing:
        if missing.name not in PEERS:
            raise
        pytest.skip(f"{missing.name} is not installed")


@pytest.mark.parametrize("path", sorted(FOLDER.rglob("__main__.py")), ids=lambda path: path.parent.name)
def test_other_processes_call_no_function_of_a_main_module_which_they_do_not_import(path):
    tree = ast.parse(path.read_text())
    own = {node.name for node in tree.body if isinstance(node, ast.FunctionDef | ast.ClassDef)}
    called = [node for node in ast.walk(tree) if isinstance(node, ast.Call)]
    handed_over = {
        name.id
        for call in called
        if getattr(call.func, "id", getattr(call.func, "attr", ""))
        in ("results_of", "shown_results", "imap", "Process")
        for name in call.args
        if isinstance(name, ast.Name)
    }
    assert not own & handed_over
