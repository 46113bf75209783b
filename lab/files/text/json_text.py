"""Reads JSON, and writes it from values of Python and numpy.

Refuses named pipes and devices as files: reading them can wait for ever, or never end.
"""

from __future__ import annotations

import json
import os
import stat
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lab.errors import InputError

_KINDS = (
    (stat.S_ISFIFO, "a named pipe"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)


def require_regular_file(path: Path) -> None:
    """Raises InputError for a named pipe, a socket or a device. Missing files and folders are left to the reader.

    The pipes of a shell, such as `<(zcat survey.csv.gz)`, have no name on disk and are accepted.
    """
    try:
        mode = Path(os.path.realpath(path)).lstat().st_mode
    except (OSError, ValueError):
        return
    for is_kind, words in _KINDS:
        if is_kind(mode):
            raise InputError(f"{path}: expected a file, found {words}; write its content to a file")


def text_of_file(path: Path) -> str:
    """The text of a file.

    Raises InputError: it is a named pipe, a socket or a device; OSError: it cannot be read; ValueError: it has another
    encoding.
    """
    require_regular_file(path)
    return path.read_text("utf-8")


def bytes_of_file(path: Path) -> bytes:
    """The bytes of a file. Raises InputError: it is a named pipe, a socket or a device; OSError: it cannot be read."""
    require_regular_file(path)
    return path.read_bytes()


def write_json(content: Any, path: Path) -> None:
    """Write a value as a JSON file, indented."""
    text = json.dumps(plain_value(content), indent=1, ensure_ascii=False, allow_nan=False) + "\n"
    path.write_bytes(text.encode("utf-8", "backslashreplace"))  # of names that are not UTF-8; JSON has these escapes


def read_json(path: Path) -> Any:
    """The content of a JSON file.

    Raises InputError: it is a named pipe, a socket or a device; OSError: it cannot be read; ValueError: it is not JSON
    in UTF-8.
    """
    return json.loads(text_of_file(path))


def has_schema(folder: Path, schema: str) -> bool:
    """Whether a folder holds results with this schema in their summary.json.

    Raises InputError: summary.json is a named pipe, a socket or a device.
    """
    try:
        return bool(read_json(folder / "summary.json").get("schema") == schema)
    except (OSError, ValueError, AttributeError):
        return False


def plain_value(value: Any) -> Any:
    """The value with Python numbers instead of numpy's, and None for nan and infinity, which JSON does not have."""
    if isinstance(value, Mapping):
        return {str(k): plain_value(v) for k, v in value.items()}
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, list | tuple):
        return [plain_value(v) for v in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value
