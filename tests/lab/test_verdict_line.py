"""The line on the terminal: one sentence of the first reason; the report has the others and the whole texts."""

from __future__ import annotations

import pytest

from lab.findings.finding import Finding, Level, Verdict, first_sentence

LONG = "Spot 3 was found in 12.5 % of the frames. It stood beside an edge, e.g. of a frame. `beampose show` draws it"


@pytest.mark.parametrize(
    ("text", "first"),
    [
        (LONG, "Spot 3 was found in 12.5 % of the frames"),
        ("One sentence of 0.1 px.", "One sentence of 0.1 px"),
        ("See run.yaml, i.e. its prior. Then again.", "See run.yaml, i.e. its prior"),
        ("Use `a.b`. `c` is wrong.", "Use `a.b`"),
        ("Are the lasers on? If so, look.", "Are the lasers on?"),
        ("", ""),
    ],
)
def test_the_first_sentence_ends_at_its_full_stop(text, first):
    assert first_sentence(text) == first


def test_the_line_has_one_sentence_of_the_first_reason_and_counts_the_others():
    found = Verdict(
        tuple(Finding(Level.FAIL, LONG, remedy="Clean it. Then run again.", code="BP-V03") for _ in range(3))
    )
    line = found.of_frames(5, 10)
    assert line == (
        "FAIL: 5 of 10 frames measured (Spot 3 was found in 12.5 % of the frames; 2 more in the report) Clean it."
    )
    assert all(reason == LONG for reason in found.as_mapping()["reasons"])


def test_a_reason_that_refers_to_the_others_is_shown_with_the_next_one():
    lost = Finding(Level.FAIL, "the vehicle was never found", remedy="Act on the other reasons.", code="BP-V02")
    unlit = Finding(
        Level.FAIL, "camera left: nothing was detected", remedy="Are the lasers on? If so, look.", code="BP-V08"
    )
    assert Verdict((lost, unlit)).of_frames(0, 10) == (
        "FAIL: 0 of 10 frames measured (the vehicle was never found; camera left: nothing was detected)"
        " Are the lasers on?"
    )
