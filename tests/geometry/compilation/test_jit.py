"""Machine code on disk: kept for the next process, never that of other sources, and never required."""

from __future__ import annotations

import ast
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from geometry import compiled_projection
from geometry.compilation import compile_cache, jit, numba_internals
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from tests.geometry.scenes import paper_rig
from tests.paths import ROOT
from tests.test_architecture import imports, modules

# A program of two packages. The compiled function of the upper one calls one of the lower one, which uses a constant of
# a module without compiled functions.
CONSTANTS = "FACTOR = 10\n"
INNER = """
from geometry.compilation.jit import compiled
from .constants import FACTOR

@compiled
def grown(x, by):
    return x + FACTOR * by
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
# One process of this program; it prints what it finds as JSON.
FIND = """
import json, logging, sys, tempfile
if "nowhere" in sys.argv:
    tempfile.tempdir = "/dev/null/nowhere"
if "other" in sys.argv:  # a numba without one of the undocumented interfaces
    from numba.core import codegen
    del codegen.JITCodeLibrary
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
    "value": value, "cold": [before, compiled.is_empty(here)], "reports": [r.getMessage() for r in lines],
    "compiled": sorted(begun), "signatures": len(outer.grown.signatures), "folder": str(compiled.cache_folder(here)),
}))
"""


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The two packages in a folder, never run before."""
    folder = tmp_path_factory.mktemp("program")
    for floor in ("geometry", "geometry/compilation", "floor"):
        (folder / floor).mkdir()
        (folder / floor / "__init__.py").write_text("")
    for module in (jit, compile_cache, numba_internals):
        shutil.copy(str(module.__file__), folder / "geometry" / "compilation")
    (folder / "geometry" / "constants.py").write_text(CONSTANTS)
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
    """Two processes that start at the same time, when nothing is compiled."""
    return [found(process) for process in [started(program), started(program)]]


def test_two_processes_that_compile_at_once_do_not_disturb_each_other(first_two):
    assert [one["value"] for one in first_two] == [20.0, 20.0]
    assert "twice_grown" in first_two[0]["compiled"] + first_two[1]["compiled"]


def test_the_first_compilation_is_reported_once(first_two):
    reports = [one["reports"] for one in first_two if one["reports"]]
    assert 1 <= len(reports) <= 2  # the later of the two may have found some code
    for report in reports:
        assert report == ["compiling for this machine, once (about half a minute)"]
    assert [one["cold"][1] for one in first_two] == [False, False]


def test_a_literal_argument_is_compiled_as_a_plain_number(first_two):
    compiling = [one for one in first_two if "grown" in one["compiled"]]
    assert [one["compiled"].count("grown") for one in compiling] == [1] * len(compiling)
    assert [one["signatures"] for one in compiling] == [1] * len(compiling)


def test_the_next_process_compiles_nothing(program, first_two):
    later = found(started(program))
    assert (later["value"], later["compiled"], later["reports"]) == (20.0, [], [])


def test_code_of_an_edited_source_is_never_run(program, first_two, tmp_path):
    """numba's own cache compares only outer.py, which stays as it is."""
    copy = tmp_path / "program"
    shutil.copytree(program, copy)
    folders = {Path(first_two[0]["folder"]).name}
    for edited, old, new, value in (
        ("geometry/inner.py", "FACTOR * by", "10 * FACTOR * by", 200.0),
        ("geometry/constants.py", "FACTOR = 10", "FACTOR = 100", 2000.0),
    ):
        source = copy / edited
        source.write_text(source.read_text().replace(old, new))
        after = found(started(copy))
        assert (after["value"], after["cold"]) == (value, [True, False])
        assert Path(after["folder"]).name not in folders
        folders.add(Path(after["folder"]).name)


def test_code_from_disk_is_inlined_into_a_caller_that_is_compiled_again(program, first_two, tmp_path):
    """Its bitcode is parsed only then; if numba's loader changed, `grown` would be compiled again as well."""
    copy = tmp_path / "program"
    shutil.copytree(program, copy)
    assert found(started(copy))["value"] == 20.0
    outer = copy / "floor" / "outer.py"
    outer.write_text(outer.read_text().replace("x + count", "x + 2 * count"))
    again = found(started(copy))
    assert (again["value"], again["compiled"]) == (40.0, ["twice_grown"])


MEAN = """
from geometry.compilation.jit import compiled

@compiled
def mean(x):
    if x.size == 0:
        raise ValueError("no values")
    return x.mean()
"""
USE_MEAN = """
import sys
import numpy as np
from floor.mean import mean
try:
    mean(np.zeros(0))
except ValueError as error:
    print(error, mean(np.array([1.0, 3.0])), "numba.np.arraymath" in sys.modules, "scipy.linalg" in sys.modules)
"""


def test_code_from_disk_imports_nothing_that_only_a_compilation_needs(program, tmp_path):
    """numba imports the module of each of its own functions that machine code contains: scipy.linalg for a mean."""
    copy = tmp_path / "program"
    shutil.copytree(program, copy, ignore=shutil.ignore_patterns("__pycache__"))
    (copy / "floor" / "mean.py").write_text(MEAN)
    environment = {**os.environ, "PYTHONPATH": str(copy)}
    printed = [
        subprocess.run([sys.executable, "-c", USE_MEAN], env=environment, capture_output=True, text=True, timeout=60)
        for _ in range(2)
    ]
    assert [(p.stdout.strip(), p.stderr) for p in printed] == [
        ("no values 2.0 True True", ""), ("no values 2.0 False False", ""),
    ]  # fmt: skip


STEPS = "".join(f"    x = math.sin(x + {k}) * x\n    if x > {k + 2}: raise ValueError('step {k}')\n" for k in range(30))
SLOPES = f"""
import math
from geometry.compilation.jit import compiled

@compiled
def slope(x):
{STEPS}    return x

@compiled
def hill(x):
{STEPS}    return x + slope(x)

@compiled
def steeper(x):
    return 2 * slope(x)
"""
USE_SLOPES = """
import sys
from numba.core import event
begun = []
event.register("numba:compile", type("Count", (event.Listener,), {
    "on_start": lambda _, e: begun.append(e.data["dispatcher"].py_func.__name__), "on_end": lambda _, e: None
})())
from floor import caller
from geometry import slopes
errors = 0
try:
    caller.climbed(1e9)
except ValueError as error:
    errors = str(error)
value = caller.climbed(0.5)
codes = [one.library for one in caller.climbed.overloads.values()]
copied = [f.name for code in codes for f in code.get_defined_functions() if "slope" in f.name or "hill" in f.name]
print(value == caller.climbed.py_func(0.5), errors, copied, [n for n in begun if not n.startswith(("impl", "_"))])
"""


@pytest.mark.slow
def test_a_large_function_is_called_and_not_copied(program, tmp_path):
    """Compiled, from disk, called by one that is compiled again, and that from disk: with its errors.

    What Python calls after a compiled function has called it is compiled once more, and kept as that.
    """
    copy = tmp_path / "program"
    shutil.copytree(program, copy, ignore=shutil.ignore_patterns("__pycache__"))
    (copy / "geometry" / "slopes.py").write_text(SLOPES)
    caller = copy / "floor" / "caller.py"
    printed = []
    for factor in (1.0, 3.0):
        caller.write_text(
            "from geometry.compilation.jit import compiled\nfrom geometry.slopes import hill, steeper\n\n"
            f"@compiled\ndef climbed(x):\n    return {factor} * hill(x) + steeper(x)\n"
        )
        for _ in range(2):
            done = subprocess.run(
                [sys.executable, "-c", USE_SLOPES], cwd=copy,
                env={**os.environ, "PYTHONPATH": str(copy)}, capture_output=True, text=True, timeout=60,
            )  # fmt: skip
            printed.append((done.stdout.strip(), done.stderr))
    assert printed == [
        ("True step 0 [] ['climbed', 'hill', 'slope', 'steeper', 'hill', 'steeper']", ""),  # the last two for Python
        ("True step 0 [] []", ""),
        ("True step 0 [] ['climbed']", ""),
        ("True step 0 [] []", ""),
    ]


@pytest.mark.slow
def test_code_for_other_types_than_its_index_says_is_compiled_again(program, tmp_path):
    """Two processes that keep code of one function at once may give their files the same name."""
    copy = tmp_path / "program"
    shutil.copytree(program, copy, ignore=shutil.ignore_patterns("__pycache__"))
    (copy / "geometry" / "slopes.py").write_text(SLOPES)
    use = "from geometry.slopes import slope; print(slope(0.5), slope(1))"
    command, environment = [sys.executable, "-c", use], {**os.environ, "PYTHONPATH": str(copy)}
    printed = []
    for _ in range(2):
        done = subprocess.run(command, cwd=copy, env=environment, capture_output=True, text=True, timeout=60)
        printed.append((done.returncode, done.stdout, done.stderr))
        one, other = copy.rglob("slopes.slope-*.nbc")
        content = one.read_bytes()
        one.write_bytes(other.read_bytes())
        other.write_bytes(content)
    assert printed[0] == printed[1]
    assert printed[0][0] == 0


CLIMB = """
import shutil, sys
from pathlib import Path
from geometry import slopes
from geometry.compilation.compile_cache import cache_folder
from floor import caller
if "forget" in sys.argv:
    shutil.rmtree(cache_folder(Path(slopes.__file__).parent))
else:
    print(getattr(caller, sys.argv[1])(0.5))
"""


@pytest.mark.slow
def test_code_of_two_processes_that_name_functions_alike_is_called_together(program, tmp_path):
    """numba numbers functions by process: `hill` has the same name in both here, and `slope`, which it calls, has not.

    What is kept of their common caller must load each function after those that it calls, else LLVM ends the process.
    """
    copy = tmp_path / "program"
    shutil.copytree(program, copy, ignore=shutil.ignore_patterns("__pycache__"))
    (copy / "geometry" / "slopes.py").write_text(SLOPES)
    one = "@compiled\ndef {}(x):\n    return {}\n\n"
    functions = {"first": "hill(x)", "steep": "slope(x)", "second": "2 * hill(x)", "both": "first(x) + second(x)"}
    (copy / "floor" / "caller.py").write_text(
        "from geometry.compilation.jit import compiled\nfrom geometry.slopes import hill, slope\n\n"
        + "".join(one.format(*each) for each in functions.items())
    )
    printed = []
    for step in ("first", "forget", "steep", "second", "both", "both"):
        done = subprocess.run(
            [sys.executable, "-c", CLIMB, step], cwd=copy,
            env={**os.environ, "PYTHONPATH": str(copy)}, capture_output=True, text=True, timeout=60,
        )  # fmt: skip
        assert (done.returncode, done.stderr) == (0, ""), step
        printed += map(float, done.stdout.split())
    hill, _, *others = printed
    assert others == pytest.approx([2 * hill, 3 * hill, 3 * hill], rel=1e-12)


@pytest.mark.slow
def test_with_a_numba_that_has_other_internals_code_is_kept_and_never_that_of_an_edited_source(program, tmp_path):
    copy = tmp_path / "program"
    shutil.copytree(program, copy, ignore=shutil.ignore_patterns("__pycache__"))
    first = found(started(copy, "other"))
    assert first["value"] == 20.0
    assert {"grown", "twice_grown"} <= set(first["compiled"])
    later = found(started(copy, "other"))
    assert (later["value"], later["compiled"], later["reports"]) == (20.0, [], [])
    (copy / "geometry" / "constants.py").write_text(CONSTANTS.replace("10", "100"))
    assert found(started(copy, "other"))["value"] == 200.0


def test_the_undocumented_interfaces_of_numba_are_used_in_one_module():
    private = re.compile(r"numba\.core\.(?!event\b|types\b)|JITCodeLibrary|_load_overload|get_call_template|c_helpers")
    users = {name for name, path in modules(ROOT).items() if private.search(path.read_text("utf-8"))}
    assert users == {"geometry.compilation.numba_internals"}


def is_compiled(node: ast.AST) -> bool:
    return isinstance(node, ast.FunctionDef) and any("compiled" in ast.unparse(d) for d in node.decorator_list)


def python_calls(tree: ast.AST) -> Iterator[ast.Call]:
    """The calls of functions by their names, outside of compiled functions."""
    for node in ast.iter_child_nodes(tree):
        if is_compiled(node):
            continue
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            yield node
        yield from python_calls(node)


def test_python_code_leaves_no_argument_of_a_compiled_function_to_its_default():
    """numba compiles the function once more for such a call, up to three seconds."""
    program = {module: path.read_text("utf-8") for module, path in modules(ROOT).items()}
    compiled = {
        f"{module}.{node.name}": len(node.args.args)
        for module, text in program.items()
        if re.search(r"@compiled\w*\ndef \w+\([^)]*=", text)
        for node in ast.parse(text).body
        if is_compiled(node) and node.args.defaults
    }
    assert len(compiled) >= 3
    called = re.compile(rf"\b({'|'.join(name.rsplit('.', 1)[1] for name in compiled)})\(")
    others = [path for folder in ("tests", "bench") for path in (ROOT / folder).rglob("*.py")]
    for text in filter(called.search, [*program.values(), *(path.read_text("utf-8") for path in others)]):
        tree = ast.parse(text)
        lines = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
        known = {a.asname or a.name: compiled.get(f"{line.module}.{a.name}") for line in lines for a in line.names}
        for call in python_calls(tree):
            if known.get(call.func.id) and not any(isinstance(a, ast.Starred) for a in call.args):
                assert len(call.args) + len(call.keywords) == known[call.func.id], ast.unparse(call)


def test_a_truncated_cache_file_is_discarded_and_compiled_again(program, first_two, tmp_path):
    copy = tmp_path / "program"
    shutil.copytree(program, copy)
    folder = Path(found(started(copy))["folder"])
    for kind in ("*.nbi", "*.nbc"):
        files = sorted(folder.rglob(kind))
        assert len(files) >= 2
        for n, file in enumerate(files):
            file.write_bytes(file.read_bytes()[: 20 * (n % 2)])
        again = found(started(copy))
        assert (again["value"], "twice_grown" in again["compiled"]) == (20.0, True)
    assert found(started(copy))["compiled"] == []  # what was compiled again is kept


def test_without_compilation_the_same_functions_run_as_plain_python():
    script = """
import numpy as np
import lab.runs.process
from geometry.compiled_linalg import solve
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from tests.geometry.scenes import paper_rig
assert solve(np.diag([2.0, 4.0]), np.ones((2, 1)))[0].ravel().tolist() == [0.5, 0.25]
model = SpotModel.of(paper_rig())
assert model.numbers[0].point.tolist() == model.point[0].tolist()  # as the trackers' loops read them
print(model.project(Pose.identity())[0].round(3).tolist())
"""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "NUMBA_DISABLE_JIT": "1"}
    done = subprocess.run([sys.executable, "-c", script], env=environment, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")
    expected = SpotModel.of(paper_rig()).project(Pose.identity())[0].round(3).tolist()
    assert json.loads(done.stdout) == expected


def test_the_sources_of_compiled_code_are_those_that_it_imports():
    """The regular expressions find the same files as the syntax tree, in every module of the program."""
    known = modules(ROOT)
    for name, path in known.items():
        expected = {known[n] for n in imports(name, path) if n in known}
        assert expected <= compile_cache._imported(path), path


@pytest.mark.parametrize(
    "text",
    [
        "import a.b",
        "import os, a.b as x",
        "from a import b",
        "from a import (\n    c,  # with a bracket :)\n    b as x,\n)",
        "from a import c, \\\n    b",
        "from . import b",
        "from .b import something",
        "from ..a.b import something",
        "def f():\n    from a.b import something",
    ],
)
def test_every_form_of_import_is_followed(tmp_path, text):
    package = tmp_path / "a"
    package.mkdir()
    for file in ("__init__.py", "b.py"):
        (package / file).write_text("")
    (package / "source.py").write_text(text)
    assert package / "b.py" in compile_cache._imported(package / "source.py")


def test_without_a_writable_folder_it_compiles_in_every_process_and_reports_it(program, tmp_path):
    shutil.copytree(program, tmp_path / "program", ignore=shutil.ignore_patterns("__pycache__"))
    (tmp_path / "program" / "geometry" / "compilation" / "__pycache__").write_text(
        "a file in place of the folder, so that even root cannot create it"
    )
    alone = found(started(tmp_path / "program", "nowhere", XDG_CACHE_HOME="/dev/null/nowhere"))
    assert alone["folder"] == "None"
    assert alone["value"] == 20.0
    assert alone["cold"] == [True, True]
    assert len(alone["reports"]) == 1
    assert "each time" in alone["reports"][0]


def test_only_the_cache_folders_used_last_are_kept(tmp_path):
    for age in range(compile_cache.MAX_FOLDERS + 3):
        folder = tmp_path / f"beampose-compiled-{age:02d}"
        folder.mkdir()
        (folder / "code.nbi").write_text("")
        os.utime(folder, (1e9 - age, 1e9 - age))
    (tmp_path / "another").mkdir()
    compile_cache._remove_old(tmp_path)
    kept = sorted(p.name for p in tmp_path.iterdir())
    assert kept == ["another", *(f"beampose-compiled-{age:02d}" for age in range(compile_cache.MAX_FOLDERS))]


owners = pytest.mark.skipif(not hasattr(os, "getuid"), reason="files of this system have no owners")


@pytest.fixture
def private_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[[], Path | None]:
    """Looks for the cache folder of geometry/, where only tmp_path can be used."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "cache"))
    monkeypatch.setattr(compile_cache, "__file__", "/dev/null/compile_cache.py")
    sources = compile_cache._sources(Path(str(compiled_projection.__file__)).parent)
    return lambda: compile_cache.private_folder.__wrapped__(sources)  # without its memory of earlier results


@owners
def test_code_of_another_user_is_not_run(private_folder, monkeypatch):
    assert private_folder() is not None
    monkeypatch.setattr(os, "getuid", lambda: 12345)
    assert private_folder() is None


@owners
@pytest.mark.parametrize("mode", [0o720, 0o702, 0o777])
def test_a_folder_that_others_may_write_is_refused(private_folder, mode):
    folder = private_folder()
    folder.chmod(mode)
    assert private_folder() is None
    folder.chmod(0o755)
    assert private_folder() == folder


@owners
def test_a_folder_that_is_a_symbolic_link_is_refused(private_folder, tmp_path):
    folder = private_folder()
    folder.rename(tmp_path / "elsewhere")
    folder.symlink_to(tmp_path / "elsewhere")
    assert private_folder() is None


@owners
def test_a_folder_is_reached_only_through_links_of_this_user_or_of_root(private_folder, tmp_path, monkeypatch):
    (tmp_path / "real").mkdir()
    (tmp_path / "cache").symlink_to(tmp_path / "real")
    assert private_folder() is not None
    status = Path.lstat

    def of_another_user(path: Path) -> os.stat_result:
        got = status(path)
        return os.stat_result((*got[:4], 12345, *got[5:])) if path == tmp_path / "cache" else got

    monkeypatch.setattr(Path, "lstat", of_another_user)
    assert private_folder() is None
