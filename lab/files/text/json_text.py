"""Reads JSON, and writes it from values of Python and numpy."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lab.files.text.regular_file import text_of_file


def write_json(content: Any, path: Path) -> None:
    """Write a value as a JSON file, indented."""
    text = json.dumps(plain_value(content), indent=1, ensure_ascii=False, allow_nan=False) + "\n"
    path.write_bytes(text.encode("utf-8", "backslashreplace"))  # of names that are not UTF-8; JSON has these escapes


def read_json(path: Path) -> Any:
    """The content of a JSON file.

    Raises:
        InputError: it is a named pipe, a socket or a device.
        OSError: it cannot be read.
        ValueError: it is not JSON in UTF-8.
    """
    return json.loads(text_of_file(path))


def has_schema(folder: Path, schema: str) -> bool:
    """Whether a folder holds results with this schema in their summary.json.

    Raises:
        InputError: summary.json is a named pipe, a socket or a device.
    """
    try:
        return bool(read_json(folder / "summary.json").get("schema") == schema)
    except (OSError, ValueError, AttributeError):
        return False


def plain_value(value: Any) -> Any:
    """The value with Python numbers instead of numpy's, and None for nan and infinity, which JSON does not have."""
    if isinstance(value, Mapping):
        return {str(k): plain_value(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain_value(v) for v in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value
