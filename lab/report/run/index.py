"""The index of a batch: one line per run with a link to its report, failed runs first."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any
from urllib.parse import quote

from lab.files.text.atomic_write import atomic_write_text
from lab.number_format import format_number
from lab.report.html import environment
from lab.report.run.summary import VERDICTS

FILE_NAME = "index.html"
_ORDER = {"error": 0, "fail": 1, "check": 2, "pass": 3}
_NAME = ("name", "run", "run_folder")  # keys of a row, in order of preference
_VERDICT = ("verdict", "status")
_LINK = ("report", "results")


def write_index(rows: list[dict[str, Any]], out: Path) -> Path:
    """Write index.html into the batch's folder `out`; returns its path.

    rows: those of batch.csv, a mapping per run. Known keys: `name`, `run` (its folder), `verdict` (or `status`): pass,
    check, fail or error, `report` or `results` (a path relative to `out`; default: the folder of the run's name).
    Every other key becomes a column.
    """
    known = {*_NAME, *_VERDICT, *_LINK}
    heads = list(dict.fromkeys(key for row in rows for key in row if key not in known))
    lines = [
        {
            "name": _first(row, _NAME) or "unnamed",
            "folder": _first(row, _NAME[1:]),
            "href": _href(row, out),
            "status": (status := _status(row)),
            "word": VERDICTS[status][0] if status in VERDICTS else status.upper(),
            "rank": _ORDER.get(status, 0),
            "cells": [_cell(row.get(head)) for head in heads],
        }
        for row in rows
    ]
    lines.sort(key=lambda line: (line["rank"], str(line["name"])))
    counts = {word: sum(line["word"] == word for line in lines) for word in dict.fromkeys(x["word"] for x in lines)}
    text = (
        environment()
        .get_template("index.html.j2")
        .render(heads=[h.replace("_", " ") for h in heads], lines=lines, counts=counts)
    )
    path = out / FILE_NAME
    atomic_write_text(text, path)
    return path


def _first(row: dict[str, Any], keys: tuple[str, ...]) -> str:
    return next((str(row[k]) for k in keys if row.get(k) not in (None, "")), "")


def _status(row: dict[str, Any]) -> str:
    return _first(row, _VERDICT).lower() or "error"


def _href(row: dict[str, Any], out: Path) -> str:
    """The address of the report relative to the index; empty where there is no such file."""
    named = _first(row, _LINK) or _first(row, _NAME)
    path = Path(named) if named.endswith(".html") else Path(named) / "report.html"
    if path.is_absolute():
        path = path.relative_to(out.resolve()) if path.is_relative_to(out.resolve()) else path
    if not (out / path).is_file():
        return ""
    return path.as_uri() if path.is_absolute() else "./" + quote(os.fsencode(path.as_posix()))


def _cell(value: Any) -> tuple[str, str]:
    """The text of a cell, and its sort key."""
    if value is None or value == "":
        return "", ""
    if isinstance(value, bool):
        return ("yes" if value else "no"), str(int(value))
    try:
        number = float(value)
    except (TypeError, ValueError):
        return str(value), str(value).lower()
    whole = number.is_integer() and abs(number) < 1e9
    return (str(int(number)) if whole else format_number(number, 4)), repr(number)
