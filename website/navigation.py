"""Patterns in the navigation of mkdocs.yml, so that a new page in a folder needs no line there."""

from __future__ import annotations

from pathlib import Path
from typing import Any


def expanded(nav: list[Any], docs: Path) -> list[Any]:
    """The navigation with every `{title: pattern}` whose pattern has a `*` replaced by a section of the files found.

    A folder's README.md comes first, the others by name. A section without any file is left out.
    """
    out: list[Any] = []
    for entry in nav:
        if not isinstance(entry, dict):
            out.append(entry)
            continue
        title, value = next(iter(entry.items()))
        if isinstance(value, list):
            out.append({title: expanded(value, docs)})
        elif "*" not in value:
            out.append(entry)
        elif found := sorted(docs.glob(value), key=lambda path: (path.name != "README.md", path.name)):
            out.append({title: [path.relative_to(docs).as_posix() for path in found]})
    return out
