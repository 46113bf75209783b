"""One entry of the list of codes."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from typing import NamedTuple

_WIDTH = 100


class Explanation(NamedTuple):
    """What a code means, for a person who sees it in a report, in summary.json or on the terminal."""

    title: str
    meaning: str  # what was found, and what it means for the results
    remedy: str


Explanations = Mapping[str, Explanation]


def as_text(code: str, explanation: Explanation) -> str:
    """The explanation as lines of the terminal."""
    parts = (f"What it means: {explanation.meaning}", f"What to do: {explanation.remedy}")
    lines = [f"{code}  {explanation.title}"]
    for part in parts:
        lines += ["", *textwrap.wrap(part, _WIDTH, break_long_words=False, break_on_hyphens=False)]
    return "\n".join(lines)
