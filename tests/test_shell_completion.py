"""Shells complete commands, options and the words that they allow, with the lines of docs/shell_completion.md."""

from __future__ import annotations

import pytest
from click.shell_completion import ShellComplete
from click.testing import CliRunner

from cli import main
from lab.findings.finding import entries
from lab.simulate.scenarios import RIGS, SCENARIOS
from tests.paths import ROOT

DOCUMENT = ROOT / "docs" / "shell_completion.md"


def completed(*words: str) -> list[str]:
    """What a shell offers for the last of some words after the program's name."""
    shell = ShellComplete(main, {}, "beampose", "_BEAMPOSE_COMPLETE")
    return [item.value for item in shell.get_completions(list(words[:-1]), words[-1])]


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_the_line_of_the_document_prints_a_script_for_the_shell(shell):
    assert f"_BEAMPOSE_COMPLETE={shell}_source beampose" in DOCUMENT.read_text("utf-8")
    done = CliRunner().invoke(main, [], prog_name="beampose", env={"_BEAMPOSE_COMPLETE": f"{shell}_source"})
    assert done.exit_code == 0, done.output
    assert f"_BEAMPOSE_COMPLETE={shell}_complete" in done.stdout


def test_commands_options_and_allowed_words_are_completed():
    assert completed("cal") == ["calibrate"]
    assert {"--out", "--causal", "--set"} <= set(completed("run", "--"))
    assert completed("schema", "ca") == ["camera", "calibration"]
    assert completed("simulate", "hu") == [name for name in SCENARIOS if name.startswith("hu")] != []
    assert completed("calibrate", "simulate", "--rig", "f") == [name for name in RIGS if name.startswith("f")] != []
    assert completed("explain", "bp-v") == [code for code in entries() if code.startswith("BP-V")] != []
