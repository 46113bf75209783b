"""The page of all fields of the YAML files, from the schemas of `beampose schema`."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

from docs.website.text import cell, code, table
from lab.setup.schema import BLOCKS, schema

_HEAD = """# Fields of the YAML files

Every field that a YAML file may have, as the program checks it. `NAME` stands for a name of your choice, `[]` for the
items of a list. A required field must be there if its block is. An unknown field is an error with a suggestion.
`beampose schema --out schemas` writes the same as JSON schemas, with which editors complete and check the files.
Meanings, frames and conventions: [File formats](../formats.md).

This page is generated from `lab/setup/schema.py`.
"""
_WORDS = {"string": "text", "number": "number", "integer": "whole number", "boolean": "true or false"}


def page() -> str:
    """The page as Markdown."""
    lines = [_HEAD]
    for name, (_, title) in BLOCKS.items():
        lines += [f"## {title.split(':')[0]} {{ #{name} }}", "", f"{title.split(': ')[1].capitalize()}.", ""]
        head = ("field", "value", "required", "default, remark")
        lines += table(head, _rows(schema(name), ""))
        if name == "run":
            lines += ["`tracker` has all [parameters](parameters.md).", ""]
    return "\n".join(lines)


def _rows(block: dict[str, Any], prefix: str) -> Iterator[tuple[str, ...]]:
    required = set(block.get("required", ()))
    for name, field in block.get("properties", {}).items():
        path = f"{prefix}{name}"
        remark = [code(field["default"])] if "default" in field and not isinstance(field["default"], dict) else []
        remark += [cell(field["description"])] if "description" in field else []
        yield code(path), cell(kind_of(field)), "yes" if name in required else "", "; ".join(remark)
        if path != "tracker":
            yield from _inner(field, path)


def _inner(field: dict[str, Any], path: str) -> Iterator[tuple[str, ...]]:
    """The fields of a block, of the items of a list or of the values of a mapping."""
    for option in field.get("anyOf", [field]):
        if option.get("properties"):
            yield from _rows(option, f"{path}.")
        elif isinstance(option.get("additionalProperties"), dict):
            yield from _inner(option["additionalProperties"], f"{path}.NAME")
        elif isinstance(option.get("items"), dict) and option["items"].get("properties"):
            yield from _rows(option["items"], f"{path}[].")


def kind_of(field: dict[str, Any]) -> str:
    """What a field may hold, in words."""
    if "enum" in field:
        return " or ".join(f"`{value}`" if value else "empty" for value in field["enum"])
    if "anyOf" in field:
        return " or ".join(dict.fromkeys(kind_of(o) for o in field["anyOf"] if o.get("type") != "null"))
    kind = field.get("type", "")
    if isinstance(kind, list):
        words = [k for k in kind if k != "null"]
        return "text" if "string" in words else " or ".join(_WORDS.get(k, k) for k in words)
    if kind == "array":
        return _array(field)
    if kind == "object":
        inner = field.get("additionalProperties")
        return f"names, each with a {kind_of(inner)}" if isinstance(inner, dict) and inner else "block"
    return f"{_WORDS.get(kind, 'any')}{_limits(field)}"


def _array(field: dict[str, Any]) -> str:
    least, most = field.get("minItems"), field.get("maxItems")
    count = f"{most} " if least == most and most else f"up to {most} " if most else ""
    inner = kind_of(field.get("items", {}))
    plural = re.sub(r"^(number|whole number|text|list|block)\b", r"\1s", inner)
    return f"list of {count}{plural}"


def _limits(field: dict[str, Any]) -> str:
    parts = [
        f"{word} {field[key]:g}"
        for key, word in (("exclusiveMinimum", "above"), ("minimum", "from"), ("maximum", "to"))
        if key in field
    ]
    return f" {' '.join(parts)}" if parts else ""
