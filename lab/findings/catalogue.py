"""All codes with their texts, from catalogue.toml. Codes are stable: a text may change, a code keeps its meaning."""

from __future__ import annotations

import re
import textwrap
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from lab.errors import InputError
from lab.files.text.error_text import suggest_name

_WIDTH = 100


@dataclass(frozen=True, slots=True)
class Entry:
    """What a code means, for a person who sees it in a report, in summary.json or on the terminal."""

    title: str
    meaning: str  # what was found, and what it means for the results
    remedy: str
    kind: str = ""  # the word in the summary of a run
    variants: Mapping[str, Mapping[str, str]] = field(default_factory=dict)  # other texts, by the name of a variant

    def variant(self, name: str) -> Entry:
        """The entry with the texts of a variant; itself for the empty name."""
        return replace(self, **self.variants[name]) if name else self  # type: ignore[arg-type]


def _entry(table: Mapping[str, Any]) -> Entry:
    texts = {key: value for key, value in table.items() if isinstance(value, str)}
    return Entry(**texts, variants={key: value for key, value in table.items() if key not in texts})


_TABLE = tomllib.loads(Path(__file__).with_name("catalogue.toml").read_text("utf-8"))
ENTRIES: Mapping[str, Entry] = {code: _entry(table) for code, table in _TABLE.items() if code != "sections"}
SECTIONS: Mapping[str, Mapping[str, Entry]] = {
    title: {code: entry for code, entry in ENTRIES.items() if code.startswith(f"BP-{letter}")}
    for letter, title in _TABLE["sections"].items()
}


def explain(code: str) -> str:
    """The explanation of a code, as lines; `V03`, `v3` and `bp-v03` are read as BP-V03.

    Raises:
        InputError: there is no such code.
    """
    name = code.strip().upper()
    name = name if name.startswith("BP-") else f"BP-{name}"
    if parts := re.fullmatch(r"BP-([A-Z])(\d)", name):
        name = f"BP-{parts[1]}0{parts[2]}"
    if name not in ENTRIES:
        near = suggest_name(name, ENTRIES)
        hint = near if "did you mean" in near else ""
        raise InputError(f"expected a code such as BP-V03, got {code!r}{hint}; `beampose explain` lists all codes")
    entry = ENTRIES[name]
    lines = [f"{name}  {entry.title}"]
    for part in (f"What it means: {entry.meaning}", f"What to do: {entry.remedy}"):
        lines += ["", *textwrap.wrap(part, _WIDTH, break_long_words=False, break_on_hyphens=False)]
    return "\n".join(lines)


def listed() -> list[str]:
    """A line for each code, under the title of its section."""
    lines: list[str] = []
    for title, section in SECTIONS.items():
        lines += ["", title] if lines else [title]
        lines += [f"  {code}  {entry.title}" for code, entry in section.items()]
    return lines
