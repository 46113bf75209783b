"""Every formula of the theory pages names its function, and every page ends in a check that can be run.

tests/test_docs.py checks that the functions exist.
"""

from __future__ import annotations

import re

import pytest

from tests.paths import ROOT
from tests.test_docs import FUNCTIONS_OF

PAGES = {path.name: path.read_text(encoding="utf-8") for path in sorted((ROOT / "docs" / "theory").glob("*.md"))}


@pytest.mark.parametrize("page", PAGES)
def test_every_section_with_a_formula_names_its_function(page):
    sections = re.split(r"^## ", PAGES[page], flags=re.MULTILINE)[1:]
    with_formula = [s for s in sections if "$$" in s]
    assert [s.splitlines()[0] for s in with_formula if not FUNCTIONS_OF.search(s) and "in the code:" not in s] == []


def test_the_theory_covers_the_equations_of_the_paper():
    text = PAGES["spot-tracker.md"]
    assert [f"eq. ({n})" for n in (15,) if f"eq. ({n})" not in text] == []
    assert all(words in text for words in ("eqs. (1) to (6)", "eqs. (7) to (9)", "eqs. (10) to (14)", "section 4.1.2"))
    assert sum(page.count("$$") for page in PAGES.values()) >= 50


@pytest.mark.parametrize("page", PAGES)
def test_every_formula_can_be_rendered(page):
    formulas = pytest.importorskip(
        "docs.website.formulas", reason="latex2mathml is not installed; `make docs` installs it"
    )
    for latex in re.findall(r"\$\$(.+?)\$\$|(?<!\$)\$([^$\n]+)\$(?!\$)", PAGES[page]):
        shown = "".join(latex).replace("&", "&amp;").replace("<", "&lt;")
        assert "<math" in formulas.with_mathml(rf'<span class="arithmatex">\({shown}\)</span>')


CHECK = re.compile(r"\n## Check it\n.*?```python\n(.*?)```\n.*?```text\n(.*?)```\n\Z", re.DOTALL)


@pytest.mark.parametrize("page", sorted(set(PAGES) - {"index.md"}))
def test_a_page_ends_in_a_check_that_prints_what_is_shown(page, tmp_path, monkeypatch, capsys):
    code, shown = CHECK.search(PAGES[page]).groups()
    monkeypatch.chdir(tmp_path)
    exec(compile(code, page, "exec"), {})
    assert capsys.readouterr().out == shown
