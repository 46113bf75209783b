"""Formulas in pages: LaTeX to MathML, which browsers render without a script or a font from the network."""

from __future__ import annotations

import html as entities
import re

from latex2mathml.converter import convert

# What the Markdown extension pymdownx.arithmatex (generic) makes of $...$ and $$...$$.
_FORMULA = re.compile(
    r'<(?P<tag>span|div) class="arithmatex">\\(?P<open>[(\[])(?P<latex>.*?)\\[)\]]</(?P=tag)>', re.DOTALL
)
_UNKNOWN = re.compile(r"<mi>(\\[A-Za-z]+)</mi>")


class FormulaError(ValueError):
    """A formula that cannot be rendered."""


def with_mathml(html: str) -> str:
    """A page with its formulas as MathML.

    Raises:
        FormulaError: a formula is not valid LaTeX, or has a command that is not known.
    """
    return _FORMULA.sub(_rendered, html)


def _rendered(match: re.Match[str]) -> str:
    latex = entities.unescape(match["latex"]).strip()
    plain = latex.replace("\\\\", "").replace("\\{", "").replace("\\}", "")
    if plain.count("{") != plain.count("}"):
        raise FormulaError(f"formula {latex!r}: the braces are not balanced")
    display = "block" if match["open"] == "[" else "inline"
    try:
        mathml = convert(latex, display=display)
    except Exception as error:
        raise FormulaError(f"formula {latex!r}: {type(error).__name__} {error}") from None
    unknown = _UNKNOWN.search(mathml)
    if unknown:
        raise FormulaError(f"formula {latex!r}: unknown command {unknown[1]}")
    return f'<div class="formula">{mathml}</div>' if display == "block" else mathml
