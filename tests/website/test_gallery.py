"""The pages of the gallery are executed: the program reports each sight as its page states."""

from __future__ import annotations

import re
from dataclasses import replace

import pytest

from docs.website import gallery
from docs.website.recordings import MISTAKES
from lab.findings.finding import entries
from tests.website.test_commands_shown import problem

SIGHTS = {sight.name: sight for sight in gallery.sights()}


def test_a_sight_names_a_mistake_codes_and_commands_that_exist():
    assert len(SIGHTS) >= 15
    for sight in SIGHTS.values():
        assert sight.mistake in {*MISTAKES, ""}
        assert set(sight.named) <= set(entries())
        assert [wrong for c in sight.commands if (wrong := problem(f"beampose {c}"))] == []
    assert {sight.mistake for sight in SIGHTS.values()} - {""} == set(MISTAKES)


@pytest.fixture(scope="module")
def mirrored():
    """A short recording of mirrored pictures, which `check` looks at."""
    sight = SIGHTS["mirrored-pictures"]
    return replace(sight, commands=("check RUN",), recording={**sight.recording, "frames": 12})


@pytest.mark.slow
def test_a_page_shows_what_the_command_printed_and_the_picture(mirrored, tmp_path):
    page = gallery.make(mirrored, tmp_path / "work", tmp_path / "out")
    shown = re.search(r"```console\n(.*?)```", page, re.DOTALL)[1].splitlines()
    assert shown[0] == "$ beampose check mirrored-pictures  # exit status 2"
    assert any("the pictures of camera `right` are mirrored left to right" in line for line in shown)
    assert (tmp_path / "out" / "mirrored-pictures.webp").stat().st_size > 1000
    assert mirrored.do.strip() in page


def test_a_page_is_refused_if_the_program_does_not_report_its_sight(mirrored, tmp_path, monkeypatch):
    said = gallery.Printed("beampose check", 0, "fine (BP-M08)")
    monkeypatch.setattr(gallery, "write_recording", lambda sight, folder: folder)
    monkeypatch.setattr(gallery, "execute", lambda *_: said)
    with pytest.raises(gallery.SightError, match="BP-M06"):
        gallery.make(mirrored, tmp_path, tmp_path)


@pytest.mark.slow
def test_the_program_reports_every_sight_as_its_page_states(tmp_path):
    out = gallery.build(tmp_path)
    assert {path.stem for path in out.glob("*.md")} == {"index", *SIGHTS}
    assert sum(path.stat().st_size for path in out.glob("*.webp")) < 1_000_000
