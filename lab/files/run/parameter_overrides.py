"""Parameters of the command line (--set NAME=VALUE), which replace those of a file and the defaults."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

from lab.files.text.dataclass_fields import dataclass_from_yaml
from tracking.parameters import TrackerParameters

MAX_DOTS = 5  # of a name; the parameters have one level of blocks


def with_overrides(
    parameters: TrackerParameters, overrides: Mapping[str, Any], place: str = "--set"
) -> TrackerParameters:
    """The parameters with overrides, checked as in a file. Dotted names address inner blocks.

    place: where the overrides are from, in messages. Raises InputError.
    """
    content = dataclasses.asdict(parameters)
    for name, value in overrides.items():
        *blocks, last = name.split(".") if name.count(".") <= MAX_DOTS else [name]
        inner: Any = content
        for block in blocks:
            inner = inner.setdefault(block, {})
            if not isinstance(inner, dict):
                break
        else:
            inner[last] = value
            continue
        content[name] = value  # there is no such block, which the check reports
    return dataclass_from_yaml(TrackerParameters, content, place)
