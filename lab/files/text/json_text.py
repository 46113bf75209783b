"""Writes JSON from values of Python and numpy."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np


def write_json(content: Any, path: Path) -> None:
    """Write a value as a JSON file, indented."""
    text = json.dumps(plain_value(content), indent=1, ensure_ascii=False, allow_nan=False) + "\n"
    path.write_bytes(text.encode("utf-8", "backslashreplace"))  # of names that are not UTF-8; JSON has these escapes


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
