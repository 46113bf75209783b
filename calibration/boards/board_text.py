"""Counts and lengths in the text of a board."""

from __future__ import annotations

import re


def read_count(text: str) -> tuple[int, int]:
    """Columns and rows from a text such as 9x6.

    Raises:
        ValueError: the text is not valid.
    """
    found = re.fullmatch(r"(\d{1,4})\s*[xX×]\s*(\d{1,4})", text)
    if found is None:
        raise ValueError(f"expected columns x rows such as 9x6, got {text!r}")
    return int(found[1]), int(found[2])


def read_length(text: str) -> float:
    """A length in m from a text with a unit, such as 25mm.

    Raises:
        ValueError: the text is not valid.
    """
    found = re.fullmatch(r"(\d+\.?\d*|\.\d+)\s*(mm|cm|m)", text, flags=re.IGNORECASE)
    if found is None:
        raise ValueError(f"expected a length with its unit such as 25mm, got {text!r}")
    # By division: 25 / 1000 is the double nearest to 0.025, and 25 * 0.001 is not.
    return float(found[1]) / {"mm": 1000.0, "cm": 100.0, "m": 1.0}[found[2].lower()]


def in_mm(length_m: float) -> str:
    """The text of a length, which `read_length` reads: 25mm."""
    return f"{round(length_m * 1000, 9):.12g}mm"
