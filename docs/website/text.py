"""Markdown of generated pages."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence


def cell(text: object) -> str:
    """Text of a table cell: one line, with the characters that Markdown or HTML would interpret written out.

    Text in backticks stays as it is.
    """
    line = " ".join(str(text).split()).replace("|", "\\|")
    parts = re.split(r"(`[^`]*`)", line)
    return "".join(p if p.startswith("`") else re.sub(r"([*_<\[\]$])", r"\\\1", p) for p in parts)


def table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> list[str]:
    """The lines of a Markdown table; cells are Markdown already."""
    lines = [f"| {' | '.join(head)} |", f"|{' --- |' * len(head)}"]
    return [*lines, *(f"| {' | '.join(map(str, row))} |" for row in rows), ""]


def code(value: object) -> str:
    """A value in backticks; empty for an empty text."""
    text = str(value).replace("|", "\\|")
    return f"`{text}`" if text else ""
