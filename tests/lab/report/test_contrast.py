"""Contrast of the pages' colours, by the formula of WCAG 2.2: text 4.5 (AA), curves and marks of plots 3."""

from __future__ import annotations

import re
from itertools import product
from pathlib import Path

import pytest

import lab.report

CSS = Path(lab.report.__file__).parent / "templates"
PAGES = {"run report": ("style.css", "sections.css"), "batch index": ("style.css", "index.css")}
MEDIA = {"screen": None, "second scheme": "prefers-color-scheme", "print": "print"}
TEXT, GRAPHICS = 4.5, 3.0


def rules(page: str, medium: str) -> str:
    """The style rules of a page that a medium uses: those outside of @media, then its own."""
    text = re.sub(r"{%.*?%}", "", "".join((CSS / name).read_text("utf-8") for name in PAGES[page]))
    blocks = re.findall(r"@media([^{]*)\{((?:[^{}]*\{[^{}]*\})*[^{}]*)\}", text)
    own = [body for head, body in blocks if MEDIA[medium] and MEDIA[medium] in head.replace(" ", "")]
    return "".join([re.sub(r"@media[^{]*\{(?:[^{}]*\{[^{}]*\})*[^{}]*\}", "", text), *own])


def variables(page: str, medium: str) -> dict[str, str]:
    """The colours of :root, the last definition of each."""
    found = re.findall(r":root\{([^}]*)\}", rules(page, medium))
    return dict(re.findall(r"--([\w-]+):(#[0-9a-fA-F]{3,6})\b", ";".join(found)))


def luminance(colour: str) -> float:
    digits = colour.removeprefix("#")
    digits = "".join(2 * d for d in digits) if len(digits) == 3 else digits
    channels = [int(digits[i : i + 2], 16) / 255 for i in (0, 2, 4)]
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in channels]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def contrast(one: str, other: str) -> float:
    high, low = sorted((luminance(one), luminance(other)), reverse=True)
    return (high + 0.05) / (low + 0.05)


def test_the_formula_gives_the_known_values():
    assert contrast("#000", "#ffffff") == pytest.approx(21.0)
    assert contrast("#777777", "#fff") == pytest.approx(4.48, abs=0.005)  # the grey that just fails AA
    assert contrast("#767676", "#fff") == pytest.approx(4.54, abs=0.005)


@pytest.mark.parametrize(("page", "medium"), list(product(PAGES, MEDIA)))
def test_text_and_links_are_readable_on_every_ground(page, medium):
    colours = variables(page, medium)
    low = {
        f"{text} on {ground}": round(value, 2)
        for text, ground in product(("ink", "soft", "link"), ("paper", "card"))
        if (value := contrast(colours[text], colours[ground])) < TEXT
    }
    assert low == {}


@pytest.mark.parametrize("medium", MEDIA)
def test_the_words_of_the_badges_are_readable(medium):
    colours = variables("batch index", medium)
    grounds = [colours[word] for word in ("pass", "check", "fail", "error")]
    default = re.search(r"\.badge\{[^}]*color:(#\w+);background:(#\w+)", rules("batch index", medium))
    assert default[1] == "#fff"
    assert min(contrast("#fff", ground) for ground in [*grounds, default[2]]) >= TEXT


@pytest.mark.parametrize("medium", MEDIA)
def test_the_curves_and_marks_stand_out(medium):
    colours = variables("batch index", medium)
    paper = colours["paper"]
    assert min(contrast(colours[curve], paper) for curve in "abc") >= GRAPHICS
    css = rules("batch index", medium)
    marks = dict(re.findall(r"svg path\.dots\.(\w+)\{stroke:([^};]+)", css))
    assert set(marks) == {"pass", "check", "fail", "error"}
    shown = {word: colours[v[6:-1]] if (v := value).startswith("var(") else v for word, value in marks.items()}
    assert {w: round(contrast(c, paper), 2) for w, c in shown.items() if contrast(c, paper) < GRAPHICS} == {}
