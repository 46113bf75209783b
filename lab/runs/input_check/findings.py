"""The findings of `beampose check` as plain lines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from lab.errors import CalibrationError, InputError
from lab.files.text.error_text import FileError
from lab.findings.outcome import Done


@dataclass(slots=True)
class Findings:
    """Collects the findings of the single checks."""

    subject: str
    problems: list[str] = field(default_factory=list)  # a run would stop, or be wrong
    remarks: list[str] = field(default_factory=list)  # a run continues
    facts: list[str] = field(default_factory=list)
    unusable: list[str] = field(default_factory=list)  # reasons why the calibration stops a run

    def add_error(self, error: InputError) -> None:
        """Add the lines of an input error to the problems."""
        self.problems += error.lines if isinstance(error, FileError) else str(error).splitlines()

    def result(self) -> Done[None]:
        """The findings as lines. Exit status 2: something must be corrected first; 3: that is the calibration alone."""
        counts = [
            f"{len(lines)} {word}{'s' if len(lines) > 1 else ''}"
            for word, lines in (("problem", self.problems + self.unusable), ("remark", self.remarks))
            if lines
        ]
        lines = [f"{self.subject}: {', '.join(counts) or 'fine'}"]
        if self.problems or self.unusable:
            lines += ["", "Problems, to be corrected first:", *(f"  {p}" for p in self.problems + self.unusable)]
        if self.remarks:
            lines += ["", "Remarks; a run continues with these:", *(f"  {r}" for r in self.remarks)]
        if self.facts:
            lines += ["", *self.facts]
        status = InputError.exit_status if self.problems else CalibrationError.exit_status if self.unusable else 0
        return Done(None, tuple(lines), exit_status=status)


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Aligned columns: texts to the left, numbers to the right."""
    widths = [max(len(r[i]) for r in (header, *rows)) for i in range(len(header))]
    numeric = [
        bool(rows) and all(r[i][:1].isdigit() and r[i][-1:] in "0123456789%" for r in rows) for i in range(len(header))
    ]
    return [
        "  " + "  ".join(c.rjust(w) if n else c.ljust(w) for c, w, n in zip(row, widths, numeric, strict=True)).rstrip()
        for row in (header, *rows)
    ]
