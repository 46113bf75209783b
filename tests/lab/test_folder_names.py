"""Folders whose names are not UTF-8 (Latin-1 disks, old archives) are folders like any other."""

from __future__ import annotations

import json
import os
import re
import sys
from pathlib import Path

import pytest

from lab.simulate.write import simulate
from tests.lab.command import typed
from tests.paths import ROOT

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="other systems have no such names")


def named(folder: Path, name: bytes) -> Path:
    return Path(os.fsdecode(os.path.join(os.fsencode(folder), name)))


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Path:
    """A folder with a run and its results."""
    folder = named(tmp_path_factory.mktemp("disk"), b"Universit\xe9")
    simulate("smooth", named(folder, b"caf\xe9"), seed=1, frames=8, points=True)
    assert typed("run", named(folder, b"caf\xe9"), "--out", named(folder, b"r\xe9sultats")).exit_code == 0
    return folder


def test_the_summary_names_the_folders_such_that_they_are_found_again(place):
    text = (named(place, b"r\xe9sultats") / "summary.json").read_text("utf-8")
    summary = json.loads(text)
    assert summary["run_folder"] == str(named(place, b"caf\xe9"))
    assert all(os.path.exists(entry["path"]) for entry in summary["inputs"])
    assert typed("verify", named(place, b"r\xe9sultats")).exit_code == 0


@pytest.mark.parametrize(
    "command",
    [
        *("check RUN", "report OUT", "batch RUN --out NEW", "init NEW"),
        pytest.param("compare OUT OUT --out NEW", marks=pytest.mark.slow),
        pytest.param("doctor RUN", marks=pytest.mark.slow),
        pytest.param("plan RUN/rig.yaml --out NEW --range x_m=0:0.1:2", marks=pytest.mark.slow),
    ],
)
def test_every_command_works_in_it(place, command):
    new = named(place, b"\xe9-" + command.split()[0].encode())
    words = {"RUN": named(place, b"caf\xe9"), "OUT": named(place, b"r\xe9sultats"), "NEW": new}
    arguments = [re.sub(r"RUN|OUT|NEW", lambda m: str(words[m[0]]), word) for word in command.split()]
    done = typed(*arguments)
    assert "unexpected error" not in done.stderr
    assert done.exit_code in (0, 4), ascii(done.output)


def test_commands_print_by_the_function_that_makes_text_printable():
    """A line with such a name, printed directly, ends in a UnicodeEncodeError."""
    direct = {
        path.name: lines
        for path in sorted((ROOT / "lab" / "commands").glob("*.py"))
        if path.name != "common.py"
        and (lines := [n for n in path.read_text("utf-8").splitlines() if "click.echo(" in n and "as_text" not in n])
    }
    assert direct == {}
