"""The example notebook runs from its first cell to its last, and is stored without outputs."""

from __future__ import annotations

import ast
import importlib.util
import json
import sys
import tempfile
from unittest.mock import MagicMock

import pytest

from lab.api.results import AnnotatedPicture, Results
from tests.paths import ROOT

NOTEBOOK = ROOT / "docs" / "notebooks" / "first_steps.ipynb"

pytestmark = pytest.mark.skipif(not NOTEBOOK.is_file(), reason="a source distribution has no notebooks")


def code_cells() -> list[str]:
    cells = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]
    return ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]


@pytest.fixture
def plots(monkeypatch):
    """The plots that are shown. Without matplotlib (extra `notebook`) the calls of it are only recorded."""
    monkeypatch.setenv("MPLBACKEND", "Agg")
    shown = []
    if importlib.util.find_spec("matplotlib") is None:
        plt = MagicMock()
        plt.subplots.side_effect = lambda rows=1, *_, **__: (
            MagicMock(),
            [MagicMock(), MagicMock()] if rows > 1 else MagicMock(),
        )
        plt.show.side_effect = lambda: shown.append("figure")
        monkeypatch.setitem(sys.modules, "matplotlib", MagicMock(pyplot=plt))
        monkeypatch.setitem(sys.modules, "matplotlib.pyplot", plt)
    else:
        import matplotlib.pyplot as plt

        monkeypatch.setattr(plt, "show", lambda: shown.append(plt.get_fignums()))
    return shown


def test_the_notebook_runs_and_its_last_lines_are_results(tmp_path, monkeypatch, plots, capsys):
    monkeypatch.setattr(tempfile, "mkdtemp", lambda prefix: str(tmp_path))
    names: dict[str, object] = {}
    results = []
    for number, cell in enumerate(code_cells()):
        *body, last = ast.parse(cell).body
        exec(compile(ast.Module(body, []), f"cell {number}", "exec"), names)
        if isinstance(last, ast.Expr):  # its value is displayed
            results.append(eval(compile(ast.Expression(last.value), f"cell {number}", "eval"), names))
        else:
            exec(compile(ast.Module([last], []), f"cell {number}", "exec"), names)
    assert len(plots) == 2
    assert sum(isinstance(r, AnnotatedPicture) for r in results) == 1
    assert sum(isinstance(r, Results) for r in results) == 1
    assert names["run"].summary["verdict"]["status"] == "pass"
    assert "nowhere: expected a folder" in capsys.readouterr().out


def test_the_notebook_is_small_and_has_no_outputs():
    cells = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]
    assert all(
        cell["outputs"] == [] and cell["execution_count"] is None for cell in cells if cell["cell_type"] == "code"
    )
    assert NOTEBOOK.stat().st_size < 20_000
