"""The report of a run that ended with an error: it says so, and why, instead of figures."""

from __future__ import annotations

from pathlib import Path

from lab.files.text.atomic_write import atomic_write_text
from lab.report.html import environment


def write_failure_report(results: Path, name: str, message: str, run_folder: Path | None = None) -> Path:
    """Write report.html into a folder that has no usable results; returns its path.

    message: the error as the command line shows it: one plain line. The page lists the files of the folder, so that
    results of an earlier attempt are not taken for those of this one.
    """
    files = sorted(p.name for p in results.iterdir() if p.is_file() and p.name != "report.html")
    page = environment().get_template("failure.html.j2")
    path = results / "report.html"
    where = "" if run_folder is None else str(run_folder)
    atomic_write_text(page.render(name=name, message=message, run_folder=where, files=files), path)
    return path
