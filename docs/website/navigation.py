"""Patterns in the navigation of mkdocs.yml, so that a new page in a folder needs no line there."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from fnmatch import fnmatch
from pathlib import Path
from typing import Any


def expanded(nav: list[Any], docs: Path, made: Sequence[str] = ()) -> list[Any]:
    """The navigation with every `{title: pattern}` whose pattern has a `*` replaced by a section of the files found.

    A folder's README.md comes first, the others by name. Files that the navigation names anywhere do not count, so that
    `*.md` stands for all other pages. A section without any file is left out. made: pages that are made when the site
    is built; they come after the files, in this order.
    """
    return _expanded(nav, docs, set(_named(nav)), made)


def _named(nav: list[Any]) -> Iterator[str]:
    """All values of the navigation: files and patterns."""
    for entry in nav:
        for value in entry.values() if isinstance(entry, dict) else (entry,):
            if isinstance(value, list):
                yield from _named(value)
            else:
                yield value


def _expanded(nav: list[Any], docs: Path, named: set[str], made: Sequence[str]) -> list[Any]:
    out: list[Any] = []
    for entry in nav:
        if not isinstance(entry, dict):
            out.append(entry)
            continue
        title, value = next(iter(entry.items()))
        if isinstance(value, list):
            out.append({title: _expanded(value, docs, named, made)})
        elif "*" not in value:
            out.append(entry)
        else:
            found = sorted(docs.glob(value), key=lambda path: (path.name != "README.md", path.name))
            files = [name for path in found if (name := path.relative_to(docs).as_posix()) not in named]
            files += [name for name in made if fnmatch(name, value)]
            out += [{title: files}] if files else []
    return out
