"""Formulas of the pages become MathML."""

from __future__ import annotations

import re
from xml.etree import ElementTree

import pytest

formulas = pytest.importorskip("docs.website.formulas", reason="latex2mathml is not installed; `make docs` installs it")
INLINE, BLOCK = r'<span class="arithmatex">\({}\)</span>', r'<div class="arithmatex">\[{}\]</div>'


@pytest.mark.parametrize(("form", "display"), [(INLINE, "inline"), (BLOCK, "block")])
def test_a_formula_becomes_mathml_that_is_well_formed(form, display):
    page = formulas.with_mathml("<p>" + form.format(r"a &lt; \frac{1}{2} \mathbf{R}^\top") + "</p>")
    assert "arithmatex" not in page
    math = ElementTree.fromstring(re.search(r"<math.*</math>", page, re.DOTALL)[0])
    assert math.get("display") == display
    assert "".join(math.itertext()).replace(" ", "").startswith("a<12")


@pytest.mark.parametrize("latex", [r"\notacommand{x}", r"\frac{1"])
def test_a_formula_that_cannot_be_rendered_stops_the_build(latex):
    with pytest.raises(formulas.FormulaError, match="formula"):
        formulas.with_mathml(INLINE.format(latex))


def test_function_names_are_set_apart_from_their_arguments():
    page = formulas.with_mathml(INLINE.format(r"l q \cos^2 \beta + \ln(x) \frac{\ln p}{2}"))
    assert page.count("<mspace") == 3  # q cos, cos beta, ln p; none before the bracket
    ElementTree.fromstring(re.search(r"<math.*</math>", page, re.DOTALL)[0])
