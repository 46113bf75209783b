"""Code, tests, templates and documents are written in plain English: no word of tests/words_to_avoid.txt occurs."""

from __future__ import annotations

import re
import subprocess
from functools import cache
from pathlib import Path

import pytest

from tests.paths import ROOT

WORDS = Path(__file__).with_name("words_to_avoid.txt")
SUFFIXES = {".py", ".md", ".j2", ".css", ".js", ".toml", ".yaml", ".yml"}
NAMES = {"Makefile", "run"}  # and .ci/run
# CSS and the tests of it: the name of a colour scheme is not ours to choose.
ALLOWED = re.compile(r"color-scheme[\w\": =]*dark")


@cache
def replacements() -> dict[str, str]:
    """What to write instead of each word of the list."""
    lines = [line.split("#")[0].strip() for line in WORDS.read_text(encoding="utf-8").splitlines()]
    return {word.strip(): other.strip() for word, other in (line.split("|") for line in lines if line)}


def found_in(text: str) -> list[tuple[int, str]]:
    """Line number and word of each word of the list in a text."""
    # An underscore, a digit or a change of case ends a word of an identifier.
    whole = re.compile(rf"(?i:(?<![a-z])({'|'.join(replacements())})(?![a-z]))")
    out = []
    for number, line in enumerate(text.splitlines(), 1):
        spaced = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", ALLOWED.sub("", line))
        out += [(number, match[1].lower()) for match in whole.finditer(spaced)]
    return out


def texts() -> list[Path]:
    """The tracked text files of the project."""
    try:
        listed = subprocess.run(
            ["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True
        ).stdout.split("\0")
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("not a git checkout: the list of the project's files is not known")
    paths = [ROOT / name for name in listed if name]
    return [p for p in paths if (p.suffix in SUFFIXES or p.name in NAMES) and p.is_file()]


def test_no_word_of_the_list_occurs():
    lines = [
        f"{path.relative_to(ROOT)}:{number}: {word} (write: {replacements()[word]})"
        for path in texts()
        for number, word in found_in(path.read_text(encoding="utf-8"))
        if path != Path(__file__)
    ]
    assert lines == []


@pytest.mark.parametrize(
    "text", ["It was Told.", "told_by_the_others = 1", "def isTold(): ...", "MOST_DARK = 2", "a cure"]
)
def test_a_word_is_found_in_prose_and_in_identifiers(text):
    assert len(found_in(text)) == 1


@pytest.mark.parametrize("text", ["stolid", "darkness_of = 1", "@media (prefers-color-scheme: dark) {", "secure"])
def test_other_words_are_not_found(text):
    assert found_in(text) == []


def test_every_word_has_a_replacement_and_the_walk_sees_the_project():
    assert all(replacements().values())
    assert {"README.md", "cli.py", "geometry/rotations.py"} <= {str(p.relative_to(ROOT)) for p in texts()}
