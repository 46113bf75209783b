"""The command as it was typed, for summary.json and the log."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click

_MOST_ARGUMENTS = 20  # of a list of runs: each of its results records the command


def command_line(ctx: click.Context) -> str:
    """The command of a context with its arguments and the options that differ from their defaults."""
    words = ["beampose", *ctx.command_path.split()[1:]]
    options: list[str] = []
    for parameter in ctx.command.params:
        value = ctx.params.get(parameter.name or "")
        if isinstance(parameter, click.Argument):
            words += _arguments(value) if isinstance(value, tuple) else [str(value)]
        elif value not in (None, False, (), {}) and value != parameter.get_default(ctx):
            options += _option(max(parameter.opts, key=len), value)
    return shlex.join([*words, *options])


def _arguments(values: tuple[Any, ...]) -> list[str]:
    """The values of an argument; of a long list the first ones, and how many there are."""
    words = [str(v) for v in values]
    if len(words) <= _MOST_ARGUMENTS:
        return words
    return [*words[:_MOST_ARGUMENTS], f"... ({len(words)} in all)"]


def _option(name: str, value: Any) -> list[str]:
    if value is True:
        return [name]
    if isinstance(value, Mapping):  # --set
        return [word for key, inner in value.items() for word in (name, f"{key}={_as_yaml(inner)}")]
    values = value if isinstance(value, tuple) else (value,)
    return [word for v in values for word in (name, str(v))]


def _as_yaml(value: Any) -> str:
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    return str(value)


def provenance(ctx: click.Context) -> dict[str, Any]:
    """What summary.json records of the command: the line, and the folder that relative paths start from."""
    return {"command": command_line(ctx), "working_folder": str(Path.cwd())}
