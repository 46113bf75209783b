"""Every command and option that messages, docstrings, reports and documents mention exists."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import click
import pytest

from cli import main
from tests.paths import ROOT

PACKAGES = ("geometry", "tracking", "calibration", "lab", "studies")
MENTIONS = (
    re.compile(r"`(beampose [^`]+)`"),  # a command in backticks
    re.compile(r"`(calibrate [a-z][^`]*)`"),  # ... without the program's name
    re.compile(r"^(?: {4,}|\$ )(beampose .+)$", re.MULTILINE),  # a line of example code
    re.compile(r"(beampose calibrate [a-z-]+)"),  # in running text
    re.compile(rf"`((?:{'|'.join(main.commands)}) [^`]*--[^`]*)`"),  # any command with an option, without it
    re.compile(r"`(--[a-z][^`]*)`"),  # an option alone, of any command, bench or study
    re.compile(r"(python -m (?:bench|studies)\.[^`\n]+)"),
)
OPTION = re.compile(r"(?<!\S)(--[a-z][a-z0-9-]*)")
REMOVED = re.compile(r"CHANGELOG.md: .*: no option --(?:dask|frame-rate|overlay)")  # what an earlier version had


def strings_of(code: str) -> Iterator[str]:
    """The string literals of a Python source; the values in an f-string are replaced by a capital letter."""
    tree = ast.parse(code)
    parts = {id(part) for node in ast.walk(tree) if isinstance(node, ast.JoinedStr) for part in node.values}
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in parts:
            yield node.value
        elif isinstance(node, ast.JoinedStr):
            yield "".join(str(v.value) if isinstance(v, ast.Constant) else "X" for v in node.values)


@cache
def texts(root: Path) -> list[tuple[str, str]]:
    """File name and text of all messages, docstrings, templates and documents of the project."""
    found = []
    for path in [root / "cli.py", *(p for name in PACKAGES for p in sorted((root / name).rglob("*.py")))]:
        code = path.read_text(encoding="utf-8")
        if "beampose" in code or "`calibrate" in code:  # others name no command; each takes some ms
            found += [(str(path.relative_to(root)), text) for text in strings_of(code)]
    documents = [
        *sorted(root.glob("*.md")),
        *sorted((root / "docs").rglob("*.md")),
        *sorted((root / "lab").rglob("*.j2")),
    ]
    return found + [(str(path.relative_to(root)), path.read_text(encoding="utf-8")) for path in documents]


def mentions(text: str) -> Iterator[str]:
    """The commands that a text names, without the program's name and shell comments."""
    for pattern in MENTIONS:
        for found in pattern.findall(text):
            yield found.removeprefix("beampose ").split(" #")[0].strip()


def options_of(command: click.Command) -> set[str]:
    """The options of a command and of all commands below it."""
    below = command.commands.values() if isinstance(command, click.Group) else ()
    own = {name for p in command.params for name in (*p.opts, *p.secondary_opts)}
    return {"--help", "--version"}.union(own, *(options_of(each) for each in below))


@cache
def options_of_module(name: str) -> set[str]:
    """The options of a bench or a study, or of all below a package; empty: there is none of that name."""
    path = ROOT.joinpath(*name.split("."))
    files = [path.with_suffix(".py")] if path.with_suffix(".py").is_file() else sorted(path.rglob("*.py"))
    return {option for f in files for option in re.findall(r"\"(--[a-z][a-z0-9-]*)\"", f.read_text(encoding="utf-8"))}


def problem(mention: str) -> str | None:
    """Why a command cannot be run as it is mentioned; None where it can."""
    command: click.Command = main
    words = mention.split()
    python = mention.startswith("python -m ")
    while not python and isinstance(command, click.Group) and words and re.fullmatch(r"[a-z][a-z-]*[.,;:)]?", words[0]):
        word = words.pop(0).rstrip(".,;:)")
        if word not in command.commands:
            return f"`{mention}`: {command.name} has no command {word!r}"
        command = command.commands[word]
    if python:
        known = options_of_module(words[2])
    elif mention.startswith("--"):
        known = options_of(main) | options_of_module("bench") | options_of_module("studies")
    else:
        known = {"--help", "--version", *(name for p in command.params for name in (*p.opts, *p.secondary_opts))}
    unknown = [name for name in OPTION.findall(mention) if name not in known]
    return f"`{mention}`: no option {unknown[0]}" if unknown else None


def problems(root: Path) -> list[str]:
    """All mentions that name no existing command or option."""
    found = ((name, problem(mention)) for name, text in texts(root) for mention in mentions(text))
    every = {f"{name}: {wrong}" for name, wrong in found if wrong is not None}
    return sorted(each for each in every if not REMOVED.fullmatch(each))


def test_every_command_that_a_text_names_exists():
    assert problems(ROOT) == []


def test_the_texts_of_the_project_are_read():
    named = {mention for _, text in texts(ROOT) for mention in mentions(text)}
    assert len(named) >= 30
    assert any(mention.startswith("calibrate check") for mention in named)


@pytest.mark.parametrize(
    "text",
    [
        "run `beampose calibrate daily` again",
        "find the camera's place again (`calibrate daily`)",
        "    beampose calibrate check rig.yaml --pionts points.csv",
        "give it to beampose calibrate screens",
        "`beampose runs`",
        "`beampose calibrate beams X --rigs Y`",
        "`track --video`",
        "`report --overlay`",
        "`--overlay`",
        "`python -m bench.throughput --overlay`",
        "python -m bench.no_such_bench --frames 5`",
    ],
)
def test_a_command_that_does_not_exist_is_found(text):
    assert [p for m in mentions(text) if (p := problem(m))]


@pytest.mark.parametrize(
    "text",
    [
        "`beampose calibrate check`.",
        "    beampose run X --out Y  # --any",
        "beampose reads",
        "`track point --video`",
        "`--video`",
        "`python -m bench.throughput --frames 5`",
    ],
)
def test_a_text_without_a_mistake_passes(text):
    assert not [p for m in mentions(text) if (p := problem(m))]


PATH = re.compile(r"`([\w./-]+/(?:[\w.-]+\.(?:py|md|j2|txt|yaml|toml))?)`")
FUNCTIONS_OF = re.compile(r"`([\w./]+\.py)`: ((?:`\w+`(?:, )?)+)")
NAME_OF = re.compile(r"(`\w+`) of `([\w./]+\.py)`")


def documents(root: Path) -> list[Path]:
    return [*sorted(root.glob("*.md")), *sorted((root / "docs").rglob("*.md")), root / "sample_runs" / "README.md"]


def missing_paths(text: str, root: Path) -> list[str]:
    """Paths of the program, its tests and benches in backticks that do not exist, and functions that a file lacks."""
    tops = ("geometry", "tracking", "calibration", "lab", "studies", "tests", "bench", "docs", "sample_runs")
    paths = [path for path in PATH.findall(text) if path.split("/")[0] in tops]
    wrong = [path for path in paths if not (root / path).exists()]
    for path, names in [*FUNCTIONS_OF.findall(text), *((path, name) for name, path in NAME_OF.findall(text))]:
        code = (root / path).read_text(encoding="utf-8") if (root / path).is_file() else ""
        wrong += [
            f"{path}: {n}" for n in re.findall(r"\w+", names) if not re.search(rf"^(def|class) {n}\b", code, re.M)
        ]
    return wrong


def test_every_path_and_function_that_a_document_names_exists():
    found = {d.name: missing_paths(d.read_text(encoding="utf-8"), ROOT) for d in documents(ROOT) if d.is_file()}
    assert {name: wrong for name, wrong in found.items() if wrong} == {}


def unclear_answers(line: str, root: Path) -> list[str]:
    """Paths that a row of the map names twice, and file names that are not beside any path of the row."""
    paths = PATH.findall(line)
    beside = {(root / path).parent if Path(path).suffix else root / path for path in paths}
    names = re.findall(r"`(\w+\.py)`", line)
    twice = [path for path in set(paths) if paths.count(path) > 1]
    return twice + [name for name in names if not any((folder / name).exists() for folder in [root, *beside])]


@pytest.mark.parametrize(
    "answer", ["`geometry/lens.py`, `geometry/lens.py`", "`geometry/lens.py`, `prism.py` beside it"]
)
def test_an_answer_of_the_map_that_is_repeated_or_not_there_is_found(answer):
    assert unclear_answers(f"| Where? | {answer} |", ROOT)


def test_the_map_answers_a_newcomers_questions_with_paths():
    text = (ROOT / "docs" / "design.md").read_text(encoding="utf-8")
    questions = [line for line in text.splitlines() if line.startswith("| ") and "? | " in line]
    assert len(questions) >= 25
    assert all(PATH.search(line) for line in questions)
    assert [wrong for line in questions for wrong in unclear_answers(line, ROOT)] == []


def test_every_name_in_the_text_of_the_design_and_of_the_theory_is_one_of_the_program():
    files = [path for package in PACKAGES for path in (ROOT / package).rglob("*.py")]
    code = set(re.findall(r"\w+", " ".join(path.read_text(encoding="utf-8") for path in files)))
    pages = [ROOT / "docs" / "design.md", *sorted((ROOT / "docs" / "theory").glob("*.md"))]
    names = [n for page in pages for n in re.findall(r"`([a-zA-Z]+_\w+)`", page.read_text(encoding="utf-8"))]
    assert len(names) > 20
    assert [name for name in names if name not in code] == []


@pytest.mark.parametrize(
    "text",
    [
        "`geometry/spots.py`",
        "`lab/none/`",
        "`geometry/lens.py`: `no_such_function`",
        "`no_such_function` of `geometry/lens.py`",
    ],
)
def test_a_path_or_function_that_does_not_exist_is_found(text):
    assert missing_paths(text, ROOT)
