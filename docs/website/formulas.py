"""Formulas in pages: LaTeX to MathML, which browsers render without a script or a font from the network."""

from __future__ import annotations

import html as entities
import re
from xml.etree import ElementTree

from latex2mathml.converter import convert

# What the Markdown extension pymdownx.arithmatex (generic) makes of $...$ and $$...$$.
_FORMULA = re.compile(
    r'<(?P<tag>span|div) class="arithmatex">\\(?P<open>[(\[])(?P<latex>.*?)\\[)\]]</(?P=tag)>', re.DOTALL
)
_NAMESPACE = "http://www.w3.org/1998/Math/MathML"
_ROWS = {"math", "mrow", "mtd", "mstyle"}  # elements whose children stand side by side, in any number
_FUNCTIONS = {"ln", "log", "exp", "sin", "cos", "tan", "det"}
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
    mathml = _spaced(mathml)
    return f'<div class="formula">{mathml}</div>' if display == "block" else mathml


def _spaced(mathml: str) -> str:
    """The formula with thin spaces around function names, as in `a sin b`, but not next to brackets and signs."""
    ElementTree.register_namespace("", _NAMESPACE)
    root = ElementTree.fromstring(mathml)
    for row in [element for element in root.iter() if _name(element) in _ROWS]:
        children = list(row)
        for i in reversed(range(len(children))):
            if not _is_function(children[i]):
                continue
            if i + 1 < len(children) and _name(children[i + 1]) != "mo":
                row.insert(i + 1, _thin_space())
            if i > 0 and _name(children[i - 1]) != "mo":
                row.insert(i, _thin_space())
    return ElementTree.tostring(root, encoding="unicode")


def _name(element: ElementTree.Element) -> str:
    return element.tag.rpartition("}")[2]


def _is_function(element: ElementTree.Element) -> bool:
    """Whether this is the name of a function, with or without an exponent."""
    if _name(element) in ("msup", "msub") and len(element):
        return _is_function(element[0])
    return _name(element) == "mi" and element.text in _FUNCTIONS


def _thin_space() -> ElementTree.Element:
    return ElementTree.Element(f"{{{_NAMESPACE}}}mspace", {"width": "0.167em"})
