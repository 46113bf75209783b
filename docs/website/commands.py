"""The page of all commands, from the command line itself."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator

import click

from cli import main
from docs.website.text import cell, code, table

_HEAD = """# All commands

`beampose COMMAND --help` shows the same on the terminal. [Shell completion](../shell_completion.md) completes them.

This page is generated from `lab/commands/`.
"""

_TAIL = """## Exit status

| status | meaning |
| --- | --- |
| 0 | all done |
| 1 | some run could not be processed |
| 2 | the command, a file or a configuration is wrong |
| 3 | the calibration is unusable or out of date |
| 4 | processed, but a quality gate failed |
| 128 + n | stopped by signal n (130: Ctrl-C) |

An error is one or two plain lines on standard error. The status always agrees with the verdict of the report.
"""


def commands(group: click.Group = main, before: str = "") -> Iterator[tuple[str, click.Command]]:
    """All commands with the words that call them; a group comes before its commands."""
    for name, command in group.commands.items():
        yield before + name, command
        if isinstance(command, click.Group):
            yield from commands(command, f"{before}{name} ")


def page() -> str:
    """The page as Markdown."""
    listed = sorted(commands(), key=lambda item: item[0])
    lines = [_HEAD]
    lines += table(("command", "what it does"), ((_link(name), cell(_first_line(c))) for name, c in listed))
    lines.append(_TAIL)
    for name, command in listed:
        lines += _section(name, command)
    return "\n".join(lines)


def _link(name: str) -> str:
    return f"[`{name}`](#{name.replace(' ', '-')})"


def _help(command: click.Command) -> str:
    return inspect.cleandoc(command.help or "")


def _first_line(command: click.Command) -> str:
    return " ".join(_help(command).split("\n\n")[0].split())


def _section(name: str, command: click.Command) -> list[str]:
    context = click.Context(command, info_name=f"beampose {name}")
    text = _help(command)
    body, _, example = text.partition("\b\n")
    lines = [f"## {name} {{ #{name.replace(' ', '-')} }}", ""]
    for paragraph in body.strip().split("\n\n"):
        lines += [cell(paragraph), ""]
    usage = command.get_usage(context).removeprefix("Usage: ")
    lines += ["```text", re.sub(r"\s+", " ", usage), "```", ""]
    shown = [line.strip() for line in example.splitlines() if line.strip().startswith("beampose ")]
    if shown:
        lines += ["Example:", "", "```text", *shown, "```", ""]
    options = [(p, *record) for p in command.params if (record := p.get_help_record(context)) and record[1]]
    if options and not isinstance(command, click.Group):
        rows = ((code(names), cell(_meaning(text)), _default(p)) for p, names, text in options)
        lines += table(("option", "meaning", "default"), rows)
    return lines


def _default(parameter: click.Parameter) -> str:
    if parameter.required:
        return "required"
    shown = isinstance(parameter, click.Option) and parameter.show_default and not parameter.is_flag
    return code(parameter.default) if shown else ""


def _meaning(text: str) -> str:
    """The help of an option without the remarks in brackets that have a column of their own."""
    text = re.sub(r"(\[|; )(default: [^;\]]+|required)(?=[;\]])", r"\1", text)
    return re.sub(r"\[[; ]*\]", "", text.replace("[; ", "[")).strip()
