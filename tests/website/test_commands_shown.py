"""Every command that the documentation shows can be typed (fast), and does what is shown (slow)."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import click
import pytest

from cli import main
from tests.paths import ROOT
from tests.website.console_blocks import Shown, commands_in, indented_commands, is_shown, pages

PAGES = {name: shown for name, text in pages().items() if (shown := commands_in(text))}


def problem(line: str) -> str | None:
    """Why the program would refuse a command line before it looks at any file; None if it would not."""
    words = shlex.split(line)
    if words[0] != "beampose":
        return None
    command: click.Command = main
    context = click.Context(main, info_name="beampose")
    rest = words[1:]
    try:
        while isinstance(command, click.Group) and rest and not rest[0].startswith("-"):
            name = rest.pop(0)
            inner = command.get_command(context, name)
            if inner is None:
                return f"{line}: no command {name!r}"
            command, context = inner, click.Context(inner, info_name=name, parent=context)
        values, _, _ = command.make_parser(context).parse_args(rest)
        for parameter in command.params:
            value = values.get(parameter.name)
            missing = value is None or str(value) == "Sentinel.UNSET" or value == ()
            if missing and parameter.required and "--help" not in rest:
                return f"{line}: {parameter.name} is missing"
            if not missing and not isinstance(parameter.type, click.Path):
                parameter.type_cast_value(context, value)
    except click.UsageError as error:
        return f"{line}: {error.format_message()}"
    return None


@pytest.mark.parametrize("page", PAGES)
def test_every_command_shown_has_valid_options(page):
    assert [wrong for shown in PAGES[page] if (wrong := problem(shown.command))] == []


def test_every_command_of_the_sample_runs_readme_has_valid_options():
    lines = indented_commands((ROOT / "sample_runs/README.md").read_text(encoding="utf-8"))
    assert len(lines) >= 5
    assert [wrong for line in lines if (wrong := problem(line.split(" #")[0]))] == []


def test_the_readme_shows_at_most_ten_commands_that_read_only_what_a_clone_holds_or_an_earlier_one_wrote():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    shown = [shlex.split(command.command) for command in PAGES["README.md"]]
    assert all(words[0] == "beampose" for words in shown)
    assert 5 <= len(shown) <= 10 - len(re.findall(r"^make \w+$", text, re.MULTILINE)) - text.count("`source ")
    written: set[str] = set()
    for words in shown:
        out = words.index("--out") + 1 if "--out" in words else len(words)
        for path in (word for k, word in enumerate(words) if "/" in word and k != out):
            assert (ROOT / path).exists() or any(f"{path}/".startswith(f"{folder}/") for folder in written), path
        written |= set(words[out : out + 1])


def test_the_pages_of_the_user_show_commands():
    assert {"docs/tutorial.md", "docs/quickstart.md", "docs/calibration.md", "docs/troubleshooting.md"} <= set(PAGES)
    assert len(PAGES["docs/tutorial.md"]) >= 10


def test_the_first_part_of_the_tutorial_has_six_commands_and_is_read_in_eight_minutes():
    text = (ROOT / "docs/tutorial.md").read_text(encoding="utf-8").split("## Part 2")[0]
    assert 5 <= len(commands_in(text)) <= 6
    assert len(text.split()) <= 8 * 150  # words in a minute, of a technical text


@pytest.mark.parametrize(
    "line",
    [
        "beampose rnu x --out y",
        "beampose run x",
        "beampose run x --out y --verbos",
        "beampose plan rig.yaml --out y --sigma-px -1",
        "beampose init lab --beams many",
        "beampose calibrate rigs x --out y",
    ],
)
def test_a_command_that_would_be_refused_is_found(line):
    assert problem(line) is not None


def test_commands_output_and_exit_status_are_read_from_a_block():
    text = "1. item\n\n    ```console\n    $ beampose a \\\n      b  # exit status 4\n    out 1\n    $ c\n    ```\n"
    assert commands_in(text) == [Shown("beampose a   b", 4, ("out 1",)), Shown("c", 0, ())]
    assert is_shown("drift 0.03 px", ["x", "drift 0.04 px"])
    assert not is_shown("drift 0.03 px", ["drift 0.03 mm"])
    assert not is_shown("chi-square 1.01 ± 0.05", ["chi-square 0.17 ± 0.05"])
    assert is_shown("beampose 0.1.0", ["beampose 0.2.0"])


@pytest.fixture
def desk(tmp_path: Path) -> Path:
    """An empty working folder with the sample runs and the program's command."""
    for path in ("sample_runs", "docs"):
        (tmp_path / path).symlink_to(ROOT / path)
    program = tmp_path / ".bin" / "beampose"
    program.parent.mkdir()
    start = f"import sys; sys.path.insert(0, {str(ROOT)!r}); from cli import main; main(prog_name='beampose')"
    program.write_text(f'#!/bin/sh\nexec {shlex.quote(sys.executable)} -P -c {shlex.quote(start)} "$@"\n')
    program.chmod(0o755)
    return tmp_path


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("bash") is None, reason="bash is not installed")
@pytest.mark.parametrize("page", PAGES)
def test_the_commands_of_a_page_work_in_their_order_and_print_what_is_shown(page, desk):
    for shown in PAGES[page]:
        done = subprocess.run(
            ["bash", "-c", f'PATH="$PWD/.bin:$PATH"\n{shown.command}'],
            cwd=desk, capture_output=True, text=True, timeout=600, check=False,
        )  # fmt: skip
        assert (done.returncode, shown.command) == (shown.status, shown.command), done.stderr
        printed = [*done.stdout.splitlines(), *done.stderr.splitlines()]
        for line in shown.output:
            assert line in ("...", "") or is_shown(line, printed), (shown.command, line, printed)
    if page == "docs/tutorial.md":
        assert "PASS" in (desk / "results/day-1/summary.json").read_text()
        assert (desk / "results/day-1/report.html").stat().st_size > 50_000
