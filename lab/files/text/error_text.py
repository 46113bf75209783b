"""Words of error messages about files: values, lines and suggestions in the file's own terms."""

from __future__ import annotations

import difflib
import re
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path

from lab.errors import InputError


class FileError(InputError):
    """All mistakes of one file, a line each. The message shows the first one and counts the others."""

    def __init__(self, lines: Iterable[str]) -> None:
        self.lines = tuple(lines)
        more = len(self.lines) - 1
        tail = f"\n(and {more} more in this file: `beampose check` lists them)" if more else ""
        super().__init__(self.lines[0] + tail)


def near_name(word: object, known: Iterable[str]) -> str | None:
    """The known name that is most similar to a word; None where none is similar."""
    names = [str(k) for k in known]
    lowered = {k.lower(): k for k in names}
    near = difflib.get_close_matches(str(word), names, n=1, cutoff=0.6)
    return near[0] if near else lowered.get(str(word).lower())


def suggest_name(word: object, known: Iterable[str]) -> str:
    """`; did you mean 'frames'?`; `; known: ...` where no name is similar; empty where no name is known."""
    known = [str(k) for k in known]
    near = near_name(word, known)
    if near is not None:
        return f"; did you mean {near!r}?"
    return f"; known: {', '.join(known)}" if known else ""


def require_one_of(name: str, value: str, known: Collection[str]) -> None:
    """Raises InputError for a word that is not one of the known ones; with the nearest one."""
    if value not in known:
        near = near_name(value, known)
        hint = "" if near is None else f"; did you mean {near!r}?"
        raise InputError(f"{name}: expected one of {', '.join(known)}, got {value!r}{hint}")


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


def is_formula(text: str) -> bool:
    """Whether a spreadsheet may read this text as a formula that calls something.

    `=` and `@` begin one. So do `+` and `-`, but a sign with letters and digits only (`+x`, `-12.5`) calls nothing.
    """
    start = text.lstrip()[:1]
    return start in ("=", "@") or (start in ("+", "-") and re.fullmatch(r"[\w.+-]*", text.strip()) is None)


def printable(text: str) -> str:
    """A text without characters that control a terminal or that have no UTF-8 form; line breaks stay."""
    return "".join(c if c.isprintable() or c in "\n\t" else "?" for c in text)


def name_of_path(path: Path) -> str:
    """The last part of a path as the name of a run or a camera: printable, and no formula for a spreadsheet."""
    text = printable(path.resolve().name).strip()
    while is_formula(text):
        text = text[1:].lstrip()
    return text or "unnamed"


def printable_line(line: str) -> str:
    """A line of a file as an error message shows it: at most 150 characters, control characters replaced."""
    text = "".join(c if c.isprintable() else "?" for c in line)
    return text if len(text) <= 150 else f"{text[:146]} ..."
