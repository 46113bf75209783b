"""Arrows between the packages point down only: cli -> studies -> lab -> tracking, calibration -> geometry -> numpy.

Folders inside a package do not import each other in a circle, hold few modules, and modules are short.

The imports are read with `ast`, wherever they stand in a module: one that hides in a function is an arrow too.
"""

from __future__ import annotations

import ast
import sys
import tomllib
from collections.abc import Iterator
from functools import cache
from graphlib import CycleError, TopologicalSorter
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from lab.packages import PACKAGES
from tests.paths import ROOT

FLOORS = ("geometry", "tracking", "calibration", "lab", "studies", "cli")
MAY_USE = {
    "geometry": set(),
    "tracking": {"geometry"},
    "calibration": {"geometry"},
    "lab": {"geometry", "tracking", "calibration"},
    "studies": {"geometry", "tracking", "calibration", "lab"},
    "cli": {"lab", "studies"},
}
MOST_MODULES, MOST_LINES = 15, 600
# lab and cli may use whatever pyproject.toml declares; the floors of formulas need no files, tables or plots.
MAY_USE_FROM_OUTSIDE = {
    "geometry": {"numpy", "scipy", "numba"},
    "tracking": {"numpy", "scipy", "numba", "cv2"},
    "calibration": {"numpy", "scipy", "cv2", "open3d", "libusb_package"},
}


def modules(root: Path) -> dict[str, Path]:
    """Dotted name and file of every module of the program."""
    found = {}
    for floor in FLOORS:
        for path in [*sorted((root / floor).rglob("*.py")), root / f"{floor}.py"]:
            if path.is_file():
                parts = path.relative_to(root).with_suffix("").parts
                found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def statements(tree: ast.AST, into_functions: bool) -> Iterator[ast.AST]:
    """All statements below, with or without those that run only when a function is called."""
    skipped = ast.expr if into_functions else ast.expr | ast.FunctionDef | ast.AsyncFunctionDef
    for node in ast.iter_child_nodes(tree):
        if not isinstance(node, skipped):
            yield node
            yield from statements(node, into_functions)


def imports(name: str, path: Path, into_functions: bool = True) -> set[str]:
    """Dotted names that a module imports; `from a import b` gives a and a.b, since b may be a module."""
    package = name if path.name == "__init__.py" else ".".join(name.split(".")[:-1])
    return set(imports_of_text(path.read_text(encoding="utf-8"), package, into_functions))


@cache  # every test reads the whole program
def imports_of_text(text: str, of_package: str, into_functions: bool) -> frozenset[str]:
    package = of_package.split(".") if of_package else []
    names = set()
    for node in statements(ast.parse(text), into_functions):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) + 1 - node.level] if node.level else []
            source = ".".join([*base, *([node.module] if node.module else [])])
            names |= {source, *(f"{source}.{alias.name}" for alias in node.names)}
    return frozenset(names)


def floor_of(name: str) -> str:
    return name.split(".")[0]


def wrong_arrows(root: Path) -> list[str]:
    """Imports from one floor to another that MAY_USE does not allow."""
    return sorted(
        f"{name} imports {target}"
        for name, path in modules(root).items()
        for target in imports(name, path)
        if floor_of(target) in FLOORS and floor_of(target) not in MAY_USE[floor_of(name)] | {floor_of(name)}
    )


def foreign_packages(root: Path, floor: str) -> set[str]:
    """Top-level names from neither the standard library nor the program that a floor imports."""
    used = {
        floor_of(target)
        for name, path in modules(root).items()
        if floor_of(name) == floor
        for target in imports(name, path)
    }
    return used - set(sys.stdlib_module_names) - set(FLOORS)


def circle(root: Path) -> list[str]:
    """A circle of modules that import each other, or an empty list."""
    known = modules(root)
    # A package's __init__ is a neighbour of its modules, not a user of them, when they name the package.
    graph = {name: (imports(name, path) & set(known)) - {name} for name, path in known.items()}
    for name in graph:
        graph[name] -= {target for target in graph[name] if name.startswith(target + ".")}
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return list(error.args[1])
    return []


def folder_of(name: str, path: Path) -> str:
    """The dotted name of the folder that a module lies in."""
    return name if path.name == "__init__.py" else name.rpartition(".")[0]


def folder_graph(root: Path) -> dict[str, set[str]]:
    """Which folders of the program each folder imports from."""
    known = modules(root)
    graph: dict[str, set[str]] = {folder_of(name, path): set() for name, path in known.items()}
    for name, path in known.items():
        targets = imports(name, path) & set(known)
        # `from lab.files import columns` names the folder and the module: only the module counts.
        modules_only = {t for t in targets if not any(other.startswith(t + ".") for other in targets)}
        graph[folder_of(name, path)] |= {folder_of(target, known[target]) for target in modules_only}
    return {folder: used - {folder} for folder, used in graph.items()}


def folder_circle(root: Path) -> list[str]:
    """A circle of folders that import each other, or an empty list."""
    try:
        TopologicalSorter(folder_graph(root)).prepare()
    except CycleError as error:
        return list(error.args[1])
    return []


def crowded_folders(root: Path, most: int) -> list[str]:
    """Folders of the program, its tests and its bench with more .py files than `most`."""
    folders = {path.parent for top in (*FLOORS[:-1], "tests", "bench") for path in (root / top).rglob("*.py")}
    counts = {folder: len(list(folder.glob("*.py"))) for folder in folders}
    return sorted(f"{folder.relative_to(root)}: {n} modules" for folder, n in counts.items() if n > most)


def long_modules(root: Path, most: int) -> list[str]:
    """Modules of the program with more lines than `most`."""
    lengths = {name: len(path.read_text(encoding="utf-8").splitlines()) for name, path in modules(root).items()}
    return sorted(f"{name}: {n} lines" for name, n in lengths.items() if n > most)


@pytest.fixture
def small_program(tmp_path: Path) -> Path:
    """A program that keeps the rules, for a test to break."""
    for floor in FLOORS[:-1]:
        (tmp_path / floor).mkdir()
        (tmp_path / floor / "__init__.py").write_text("")
    (tmp_path / "geometry" / "pose.py").write_text("import numpy as np\n")
    (tmp_path / "geometry" / "rig.py").write_text("from geometry import pose\n")
    (tmp_path / "lab" / "run.py").write_text("import pandas\nfrom geometry.rig import Rig\n")
    (tmp_path / "cli.py").write_text("from lab.run import run\n")
    return tmp_path


def test_the_walk_sees_the_whole_program():
    found = modules(ROOT)
    geometry = {name for name in found if name.startswith("geometry.")}
    assert len(found) >= 20
    assert {"geometry.lens", "geometry.forward_model", "geometry.rotations", "tracking.statuses", "lab.errors"} <= set(
        found
    )
    assert sum(len(imports(name, found[name])) for name in geometry) >= 30


@pytest.mark.parametrize("floor", FLOORS)
def test_each_floor_stands_only_on_the_floors_below_it(floor):
    assert [line for line in wrong_arrows(ROOT) if floor_of(line) == floor] == []


def test_nobody_imports_the_command_line():
    users = [n for n, path in modules(ROOT).items() if n != "cli" and "cli" in map(floor_of, imports(n, path))]
    assert users == []


def test_modules_do_not_import_each_other_in_a_circle():
    assert circle(ROOT) == []


def test_folders_do_not_import_each_other_in_a_circle():
    assert folder_circle(ROOT) == []


def test_no_folder_holds_more_than_fifteen_modules():
    assert crowded_folders(ROOT, MOST_MODULES) == []


def test_modules_are_short_enough_to_read():
    assert long_modules(ROOT, MOST_LINES) == []


@pytest.mark.parametrize("floor", MAY_USE_FROM_OUTSIDE)
def test_formulas_use_only_numerical_packages(floor):
    assert foreign_packages(ROOT, floor) <= MAY_USE_FROM_OUTSIDE[floor]


def numbers_without_a_word(text: str) -> list[str]:
    """Names of the constants that are plain numbers without a comment: on their line, above their block, or below."""
    lines, found = text.splitlines(), []
    body = ast.parse(text).body
    for node, after in zip(body, [*body, None][1:], strict=True):
        if not isinstance(node, ast.Assign) or any(isinstance(n, ast.Name | ast.Call) for n in ast.walk(node.value)):
            continue
        names = [n.id for target in node.targets for n in ast.walk(target) if isinstance(n, ast.Name)]
        numbers = [n for n in ast.walk(node.value) if isinstance(n, ast.Constant) and isinstance(n.value, int | float)]
        above = node.lineno - 2
        while above >= 0 and " = " in lines[above] and not lines[above].startswith("#"):
            above -= 1
        said = "#" in "".join(lines[node.lineno - 1 : node.end_lineno]) or lines[above].startswith("#")
        if numbers and all(map(str.isupper, names)) and not said and not isinstance(after, ast.Expr):
            found += names
    return found


def test_every_number_that_the_tracking_was_tuned_with_says_what_it_is():
    found = {n: numbers_without_a_word(p.read_text()) for n, p in modules(ROOT).items() if floor_of(n) == "tracking"}
    assert {name: numbers for name, numbers in found.items() if numbers} == {}


def test_a_number_without_a_word_is_seen():
    assert (
        numbers_without_a_word("A = 1.0  # px\n# Of a pixel:\nB = 2\nC, D = 3, 4\nE = A + B\nF = 5.0\n'''Text.'''\n")
        == []
    )
    assert numbers_without_a_word("A = 1.0  # px\nB = 2\nC, D = (3, 4), -5\n") == ["B", "C", "D"]


def test_what_the_program_imports_is_declared_in_pyproject():
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = declared["optional-dependencies"]
    required = [*declared["dependencies"], *(r for extra in PACKAGES for r in extras[extra]), *extras["training"]]
    names = {canonicalize_name(Requirement(requirement).name) for requirement in required}
    not_everywhere = {
        "open3d": ["open3d"],
        "libusb_package": ["libusb-package"],
        "pyarrow": ["pyarrow"],
        "torch": ["torch"],
    }
    distributions = not_everywhere | packages_distributions()
    used = set().union(*(foreign_packages(ROOT, floor) for floor in FLOORS))
    assert {"numpy", "scipy"} <= used
    missing = {p for p in used if not names & set(map(canonicalize_name, distributions.get(p, [])))}
    assert missing == set()


def test_open3d_is_not_needed_to_import_anything():
    names = {"open3d", "libusb_package"}
    hungry = [n for n, p in modules(ROOT).items() if names & set(map(floor_of, imports(n, p, into_functions=False)))]
    assert hungry == []


@pytest.mark.parametrize(
    ("module", "line", "complaint"),
    [
        ("geometry/pose.py", "from tracking import match", "geometry.pose imports tracking"),
        ("geometry/pose.py", "def f():\n    import lab.run", "geometry.pose imports lab.run"),
        ("tracking/match.py", "from ..lab import run", "tracking.match imports lab.run"),
        ("tracking/match.py", "import calibration", "tracking.match imports calibration"),
        ("lab/run.py", "from cli import main", "lab.run imports cli"),
        ("cli.py", "from geometry.pose import Pose", "cli imports geometry.pose"),
    ],
)
def test_an_arrow_that_points_up_is_seen(small_program, module, line, complaint):
    assert wrong_arrows(small_program) == []
    (small_program / module).write_text(line + "\n")
    assert complaint in wrong_arrows(small_program)


def test_a_circle_is_seen(small_program):
    assert circle(small_program) == []
    (small_program / "geometry" / "pose.py").write_text("def late():\n    from geometry.rig import Rig\n")
    assert {"geometry.pose", "geometry.rig"} <= set(circle(small_program))


def test_a_circle_of_folders_is_seen(small_program):
    assert folder_circle(small_program) == []
    inner = small_program / "geometry" / "solver"
    inner.mkdir()
    (inner / "__init__.py").write_text("")
    (inner / "fit.py").write_text("from geometry.rig import Rig\n")
    assert folder_circle(small_program) == []
    # No circle of modules, and yet one of folders.
    (small_program / "geometry" / "pose.py").write_text("from geometry.solver import errors\n")
    (inner / "errors.py").write_text("")
    assert circle(small_program) == []
    assert {"geometry", "geometry.solver"} <= set(folder_circle(small_program))


def test_a_crowded_folder_and_a_long_module_are_seen(small_program):
    assert (crowded_folders(small_program, 3), long_modules(small_program, 3)) == ([], [])
    (small_program / "geometry" / "rig.py").write_text("\n" * 4)
    (small_program / "geometry" / "lens.py").write_text("")
    assert crowded_folders(small_program, 3) == ["geometry: 4 modules"]
    assert long_modules(small_program, 3) == ["geometry.rig: 4 lines"]


def test_a_package_from_outside_is_seen(small_program):
    assert foreign_packages(small_program, "geometry") == {"numpy"}
    (small_program / "geometry" / "rig.py").write_text("import json\nfrom cv2 import norm\n")
    assert foreign_packages(small_program, "geometry") == {"numpy", "cv2"}


def test_an_import_at_the_top_is_distinguished_from_one_in_a_function(small_program):
    path = small_program / "lab" / "run.py"
    path.write_text("try:\n    import cv2\nexcept ImportError:\n    pass\ndef f():\n    import open3d\n")
    assert imports("lab.run", path, into_functions=False) == {"cv2"}
    assert imports("lab.run", path) == {"cv2", "open3d"}
