"""The report of a run, and the index of a batch: HTML files that open without a network."""

from __future__ import annotations

from pathlib import Path


def write_report(results: Path, run_folder: Path | None = None) -> Path:
    """See lab.report.page: the template engine is loaded when a report is written."""
    from lab.report.page import write_report as write

    return write(results, run_folder)
