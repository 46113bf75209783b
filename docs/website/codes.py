"""The page of all codes BP-..., from the catalogue that `beampose explain` reads."""

from __future__ import annotations

from docs.website.text import cell
from lab.findings.finding import sections

_HEAD = """# Codes

Every warning, verdict reason, finding and error has a code. It appears in reports, in `summary.json` and on the
terminal. `beampose explain BP-V03` shows the text of this page. A text may change; a code keeps its meaning.

This page is generated from `lab/findings/catalogue.toml`.
"""


def page() -> str:
    """The page as Markdown."""
    lines = [_HEAD]
    for title, section in sections().items():
        lines += [f"## {title}", ""]
        for code, text in section.items():
            lines += [f"### {code}: {cell(text.title)} {{ #{code.lower()} }}", ""]
            lines += [cell(text.meaning), "", f"**What to do:** {cell(text.remedy)}", ""]
    return "\n".join(lines)
