"""Parameters from the command line (--set NAME=VALUE) in place of those of a file or the defaults."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

from lab.files.text.dataclass_fields import dataclass_from_yaml
from tracking.parameters import TrackerParameters


def overridden(parameters: TrackerParameters, overrides: Mapping[str, Any]) -> TrackerParameters:
    """Parameters with some replaced, checked like those of a file; dotted names reach the inner blocks."""
    content = dataclasses.asdict(parameters)
    for name, value in overrides.items():
        *blocks, last = name.split(".")
        inner = content
        for block in blocks:
            inner = inner.setdefault(block, {})
            if not isinstance(inner, dict):
                break
        else:
            inner[last] = value
            continue
        content[name] = value  # no such block: the checker says so
    return dataclass_from_yaml(TrackerParameters, content, "--set")
