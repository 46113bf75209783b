"""What is in the repository can be given away, installed again, and named by one version."""

from __future__ import annotations

import re
import shutil
import subprocess
import tomllib
from functools import cache
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

from tests.paths import ROOT

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
LOCK = (ROOT / "requirements.lock").read_text(encoding="utf-8")
LOCKS = ("requirements.lock", "requirements-docs.lock")
SAMPLE_RUNS_LIMIT = 25_000_000  # bytes: what a clone may be asked to carry

# Written so that this file does not match itself.
MACHINE_PATH = re.compile(r"(?<![\w./])/(?:wor[k]|hom[e]|roo[t]|Users|opt|tm[p])/\w")
PRIVATE_HOST = re.compile(
    r"https?://(?!127\.0\.0\.1\b)(?:\d+\.\d+\.\d+\.\d+|localhos[t]|[\w-]+[:/]|[\w.-]+\.(?:internal|local|lan|corp|intra)\b)"
)
UNFINISHED = re.compile(r"\b(?:TOD[O]|FIXM[E]|XX[X])\b")
PACKAGE_INDEX = re.compile(r"--(?:extra-)?index-url|--find-links|--trusted-host|@ (?:file|https?):|https?://")


@cache
def tracked_files() -> list[Path]:
    """What git would give to a clone; where there is no git (a source distribution) there is nothing to check."""
    try:
        listing = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True).stdout
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("not a git checkout")
    return [path for name in listing.decode().split("\0") if name and (path := ROOT / name).is_file()]


@cache
def tracked_texts() -> dict[str, str]:
    """Contents of the tracked files that are text, by name."""
    texts = {}
    for path in tracked_files():
        data = path.read_bytes()
        if b"\0" not in data[:8192]:
            texts[str(path.relative_to(ROOT))] = data.decode("utf-8")
    return texts


def places(pattern: re.Pattern[str], texts: dict[str, str]) -> list[str]:
    """name:line: text of every line that has the pattern."""
    return [
        f"{name}:{i}: {line.strip()[:100]}"
        for name, text in texts.items()
        for i, line in enumerate(text.splitlines(), 1)
        if pattern.search(line)
    ]


def locked() -> dict[str, str]:
    """Versions by name."""
    return pins(LOCK)


def pins(text: str) -> dict[str, str]:
    """Versions by name that the text of a lock file states; the name of a package occurs once."""
    found = re.findall(r"^([A-Za-z0-9_.-]+)==(\S+)(?: ; .*?)?(?: \\)?$", text, flags=re.MULTILINE)
    versions = {canonicalize_name(name): version for name, version in found}
    assert len(versions) == len(found)
    return versions


def test_the_checks_see_the_repository():
    assert len(tracked_texts()) >= 40
    assert {"pyproject.toml", "geometry/forward_model.py", ".ci/run"} <= set(tracked_texts())


@pytest.mark.parametrize("pattern", [MACHINE_PATH, PRIVATE_HOST, UNFINISHED], ids=["path", "host", "unfinished"])
def test_no_file_names_somebodys_machine_or_is_unfinished(pattern):
    assert places(pattern, tracked_texts()) == []


@pytest.mark.parametrize(
    ("pattern", "line"),
    [
        (MACHINE_PATH, "data = '/hom" + "e/ann/data'"),
        (MACHINE_PATH, "see /wor" + "k/main"),
        (PRIVATE_HOST, "http" + "://10.0.0.7/simple"),
        (PRIVATE_HOST, "https" + "://mirror/simple"),
        (PRIVATE_HOST, "https" + "://packages.lab.internal/simple"),
        (UNFINISHED, "# TOD" + "O: later"),
    ],
)
def test_such_a_line_would_be_seen(pattern, line):
    assert places(pattern, {"a": line}) == [f"a:1: {line}"]
    assert not places(pattern, {"a": "https://doi.org/10.1109/7.1 and results/demo/a.csv, /tmpl/, fixed later"})


@pytest.mark.parametrize("name", LOCKS)
def test_a_lock_file_says_versions_and_hashes_and_nothing_of_where_they_come_from(name):
    text = (ROOT / name).read_text(encoding="utf-8")
    assert places(PACKAGE_INDEX, {name: text}) == []
    lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    hashes = [line for line in lines if re.fullmatch(r"    --hash=sha256:[0-9a-f]{64}(?: \\)?", line)]
    assert len(lines) == len(pins(text)) + len(hashes)  # each line that is not a comment is one of the two
    assert len(pins(text)) >= 10


@pytest.mark.parametrize("name", LOCKS)
def test_every_locked_version_has_hashes(name):
    """pip refuses the whole list otherwise. Two and more: a wheel and the source, or the wheels of several systems."""
    text = (ROOT / name).read_text(encoding="utf-8")
    blocks = re.split(r"^(?=[A-Za-z0-9])", text, flags=re.MULTILINE)[1:]
    assert len(blocks) == len(pins(text))
    assert [block.splitlines()[0] for block in blocks if "--hash=" not in block] == []
    compiled = [block for block in blocks if block.startswith(("numpy==", "numba==", "scipy==", "watchdog=="))]
    assert compiled
    assert all(block.count("--hash=") >= 15 for block in compiled)  # those of all systems, not of one


def test_the_lock_file_of_the_documentation_adds_to_the_other_one_and_contradicts_none_of_it():
    versions = pins((ROOT / "requirements-docs.lock").read_text(encoding="utf-8"))
    shared = set(versions) & set(locked())  # what requirements.lock installs on some systems only
    assert {name: versions[name] for name in shared} == {name: locked()[name] for name in shared}
    assert "numpy" not in versions
    for requirement in map(Requirement, PROJECT["optional-dependencies"]["docs"]):
        assert requirement.specifier.contains(Version(versions[canonicalize_name(requirement.name)])), requirement


@pytest.mark.parametrize("group", ["dependencies", "dev"])
def test_the_lock_file_has_a_fitting_version_of_every_dependency(group):
    wanted = PROJECT["dependencies"] if group == "dependencies" else PROJECT["optional-dependencies"][group]
    assert len(wanted) >= 5
    extras = {extra for r in map(Requirement, wanted) if r.name == PROJECT["name"] for extra in r.extras}
    wanted = [r for r in wanted if Requirement(r).name != PROJECT["name"]]
    wanted += [r for extra in extras for r in PROJECT["optional-dependencies"][extra]]
    for requirement in map(Requirement, wanted):  # those of other systems too: one list serves all
        version = locked().get(canonicalize_name(requirement.name))
        assert version is not None, f"{requirement.name} is not locked: make lock"
        assert requirement.specifier.contains(Version(version)), f"{requirement} is locked at {version}: make lock"


def test_the_version_is_written_in_one_place():
    version = PROJECT["version"]
    code = {name: text for name, text in tracked_texts().items() if name.endswith(".py") and name[:6] != "tests/"}
    assert places(re.compile(rf"""["']{re.escape(version)}["']"""), code) == []


def test_the_changelog_begins_with_this_version():
    headings = re.findall(r"^## (\S+)", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), flags=re.MULTILINE)
    assert headings[0] == PROJECT["version"]


def test_every_folder_of_tests_is_a_package():
    """With an __init__.py in tests/geometry alone, pytest would take that folder for the real geometry."""
    folders = {path.parent for path in (ROOT / "tests").rglob("*.py")}
    assert len(folders) >= 3
    assert [str(folder) for folder in folders if not (folder / "__init__.py").is_file()] == []


def test_the_sample_runs_are_small():
    samples = [path for path in tracked_files() if path.is_relative_to(ROOT / "sample_runs")]
    assert sum(path.stat().st_size for path in samples) <= SAMPLE_RUNS_LIMIT


@pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed")
def test_every_chore_is_listed_by_make_help():
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    chores = re.search(r"^\.PHONY: (.*)$", makefile, flags=re.MULTILINE)
    assert chores is not None
    listed = subprocess.run(["make", "help"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    assert sorted(re.findall(r"^  make (\S+)", listed, flags=re.MULTILINE)) == sorted(chores[1].split())
