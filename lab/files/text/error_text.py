"""Words of error messages about files: values, lines and suggestions in the file's own terms."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping

from lab.errors import InputError


class FileError(InputError):
    """All mistakes of one file, a line each. The message shows the first one and counts the others."""

    def __init__(self, lines: Iterable[str]) -> None:
        self.lines = tuple(lines)
        more = len(self.lines) - 1
        tail = f"\n(and {more} more in this file: `beampose check` lists them)" if more else ""
        super().__init__(self.lines[0] + tail)


def suggest_name(word: object, known: Iterable[str]) -> str:
    """`; did you mean 'frames'?`; `; known: ...` where no name is similar; empty where no name is known."""
    known = [str(k) for k in known]
    near = difflib.get_close_matches(str(word), known, n=1, cutoff=0.6)
    if not near:
        lowered = {k.lower(): k for k in known}
        near = [lowered[str(word).lower()]] if str(word).lower() in lowered else []
    if near:
        return f"; did you mean {near[0]!r}?"
    return f"; known: {', '.join(known)}" if known else ""


def describe_value(value: object) -> str:
    """A value as an error message shows it: short, and in the file's terms."""
    if value is None:
        return "nothing"
    if isinstance(value, Mapping):
        return f"a mapping with {', '.join(map(str, value)) or 'no keys'}"[:70]
    if isinstance(value, bool):
        return str(value).lower()
    text = repr(value)
    if len(text) > 50 and isinstance(value, list):
        return f"a list of {len(value)}"
    return text if len(text) <= 50 else text[:46] + " ..."


def printable_line(line: str) -> str:
    """A line of a file as an error message shows it: at most 150 characters, control characters replaced."""
    text = "".join(c if c.isprintable() else "?" for c in line)
    return text if len(text) <= 150 else f"{text[:146]} ..."
