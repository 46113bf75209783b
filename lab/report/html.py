"""The template engine of all reports: each is one self-contained HTML file."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

import jinja2
from markupsafe import Markup, escape

from lab.report.content_policy import content_policy
from lab.report.template_cache import template_cache

TEMPLATES = Path(__file__).parent / "templates"


@cache
def environment() -> jinja2.Environment:
    """The templates in lab/report/templates/; text that is not marked as HTML is escaped."""
    made = jinja2.Environment(
        loader=jinja2.FileSystemLoader(TEMPLATES),
        bytecode_cache=template_cache((Path(__file__), *sorted(TEMPLATES.iterdir()))),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.filters["words"] = words
    made.globals["content_policy"] = lambda template: content_policy(made, template)
    return made


def words(text: str) -> Markup:
    """A message as HTML: what the command line shows between backticks is code here."""
    return Markup(re.sub(r"`([^`\n]+)`", r"<code>\1</code>", str(escape(text))))
