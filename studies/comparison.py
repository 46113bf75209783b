"""A repeated experiment: the published figures beside ours, written as figures.csv and report.html."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from lab.files.text.atomic_write import atomic_folder, earlier_results
from lab.files.text.csv_text import write_table
from lab.findings.finding import Done
from lab.report.page import Page, PageTable, Section, made_with, write_page


@dataclass(frozen=True, slots=True)
class ComparisonRow:
    """One compared quantity; None where a column has no value. `values` has one number per method."""

    quantity: str
    unit: str
    paper: float | None
    values: tuple[float | None, ...]
    note: str = ""


@dataclass(frozen=True, slots=True)
class Comparison:
    """All that a study shows.

    `methods` are the names of the columns of values; `setting` is the line under the heading; `explanation` says what
    the methods are; `source` is the reference of the paper.
    """

    title: str
    setting: str
    methods: tuple[str, ...]
    rows: tuple[ComparisonRow, ...]
    explanation: str
    figures: tuple[Section, ...]
    source: str

    def value(self, quantity: str, method: str) -> float | None:
        """The number of one method for one quantity.

        Raises StopIteration: the study has no such quantity; ValueError: the study has no such method.
        """
        column = self.methods.index(method)
        return next(row.values[column] for row in self.rows if row.quantity == quantity)


def columns(comparison: Comparison) -> tuple[str, ...]:
    """The header of figures.csv."""
    methods = (method.replace(" ", "_").replace("-", "_") for method in comparison.methods)
    return ("quantity", "unit", "paper", *methods, "note")


def write_comparison(comparison: Comparison, out: Path) -> Done[Path]:
    """Write figures.csv and report.html into the folder `out`. Raises InputError: `out` contains other files."""
    with atomic_folder(out, earlier_results("figures.csv")) as work:
        cells = [[row.quantity, row.unit, row.paper, *row.values, row.note] for row in comparison.rows]
        rows = [["" if v is None else f"{v:.6g}" if isinstance(v, float) else v for v in row] for row in cells]
        write_table(work / "figures.csv", columns(comparison), rows)
        write_page(_page(comparison), work)
    lines = tuple(_line(comparison, row) for row in comparison.rows)
    return Done(out, (*lines, f"table: {out / 'figures.csv'}", f"report: {out / 'report.html'}"))


def _line(comparison: Comparison, row: ComparisonRow) -> str:
    values = zip(("paper", *comparison.methods), (row.paper, *row.values), strict=True)
    unit = f" ({row.unit})" if row.unit else ""
    return f"{row.quantity}{unit}: " + ", ".join(f"{name} {'-' if v is None else f'{v:.4g}'}" for name, v in values)


def _page(comparison: Comparison) -> Page:
    rows = [(r.quantity, r.unit, r.paper, *r.values, r.note) for r in comparison.rows]
    table = PageTable(("quantity", "unit", "paper", *comparison.methods, "note"), rows)
    figures = Section("Comparison with the published figures", comparison.explanation, table=table)
    maker, source = "reproduction of a published experiment", f"Source: {comparison.source}"
    sections = [figures, *comparison.figures]
    return Page(maker, comparison.title, comparison.setting, sections, notes=[source], made=[made_with()])
