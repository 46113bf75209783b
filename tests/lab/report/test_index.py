"""The index page of a batch: its runs, the worst first, and how their quantities change from day to day."""

from __future__ import annotations

import re
from html import unescape
from pathlib import Path

import pytest

from lab.simulate.write import simulate
from tests.lab.command import typed

DAYS = ("2026-03-02", "2026-03-03", "2026-03-05", "2026-03-09", None)


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The folder of a batch and its index: four good runs of four days, and a bad one of an unknown day."""
    folder = tmp_path_factory.mktemp("index")
    for number, day in enumerate(DAYS):
        run = simulate("smooth", folder / f"run{number}", seed=number, frames=4, points=True) / "run.yaml"
        run.write_text(run.read_text() + (f"recorded: {day}\n" if day else ""))
    (folder / "run4" / "detections.csv").unlink()
    names = [str(folder / f"run{number}") for number in range(len(DAYS))]
    typed("batch", *names, "--out", folder / "out")
    return folder / "out", (folder / "out" / "index.html").read_text()


def test_the_worst_run_is_first_and_each_report_is_linked(page):
    folder, text = page
    links = [unescape(link) for link in re.findall(r'href="([^"]*report\.html)"', text)]
    assert {folder / link for link in links} == {folder / f"run{number}" / "report.html" for number in range(4)}
    assert all((folder / link).is_file() for link in links)
    rows = re.findall(r"run\d", re.search(r"<tbody>.*?</tbody>", text, re.S).group())
    assert rows[0] == "run4"


def test_quantities_are_drawn_over_the_days_of_the_recordings_with_a_median_of_each_day(page):
    _, text = page
    drawings = [d for d in re.findall(r"<svg.*?</svg>", text, re.S) if "Median of the runs of each day" in d]
    assert len(drawings) >= 4  # residuals and sigmas
    for drawing in drawings:
        dots = "".join(re.findall(r' d="((?:M\d+ \d+h0)+)"', drawing))
        assert dots.count("h0") == 4
        assert len({place.split()[0] for place in re.findall(r"M\d+ \d+", dots)}) == 4
