"""YAML files: read safely and strictly, each mistake reported in one line; written atomically.

Only the core types of YAML 1.2 are read (null, true/false, integers, decimal and exponent floats): `on`, `no`, `1:30`
and dates are words, and `1e-3` is a number, unlike in YAML 1.1. A key is the text in the file, so that the spots `1`
and `"1"` are the same spot. Why PyYAML and not ruamel.yaml: docs/decisions/yaml-reader.md.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from lab.errors import InputError
from lab.files.text.atomic_write import atomic_write_text
from lab.files.text.error_text import describe_value


class _StrictLoader(yaml.SafeLoader):
    """Safe loader with the core types of YAML 1.2 only, keys as written, and no repeated key."""

    yaml_implicit_resolvers: dict[str, list[tuple[str, re.Pattern[str]]]] = {}  # noqa: RUF012 - replaces the base's

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        own = [key for key, _ in node.value if key.tag != "tag:yaml.org,2002:merge"]
        seen: set[str] = set()
        for key in own:
            if not isinstance(key, yaml.ScalarNode):
                raise yaml.constructor.ConstructorError(None, None, "a key that is not a word", key.start_mark)
            if key.value in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f"the key {key.value!r} a second time", key.start_mark
                )
            seen.add(key.value)
        self.flatten_mapping(node)
        return {key.value: self.construct_object(value, deep=True) for key, value in node.value}


def _construct_map(loader: _StrictLoader, node: yaml.MappingNode) -> dict[Any, Any]:
    return loader.construct_mapping(node, deep=True)


_StrictLoader.add_constructor("tag:yaml.org,2002:map", _construct_map)
for _tag, _pattern, _first in (
    ("null", r"~|null|Null|NULL|", ["~", "n", "N", ""]),
    ("bool", r"true|True|TRUE|false|False|FALSE", list("tTfF")),
    ("int", r"[-+]?(0|[1-9][0-9]*)", list("-+0123456789")),
    (
        "float",
        r"[-+]?((\.[0-9]+|[0-9]+\.[0-9]*)([eE][-+]?[0-9]+)?|[0-9]+[eE][-+]?[0-9]+|\.(inf|Inf|INF))|\.(nan|NaN|NAN)",
        list("-+.0123456789"),
    ),
    ("merge", r"<<", ["<"]),
):
    _StrictLoader.add_implicit_resolver(f"tag:yaml.org,2002:{_tag}", re.compile(rf"^(?:{_pattern})$"), _first)


def _construct_int(loader: _StrictLoader, node: yaml.ScalarNode) -> int:
    return int(loader.construct_scalar(node))


def _construct_float(loader: _StrictLoader, node: yaml.ScalarNode) -> float:
    text = str(loader.construct_scalar(node)).lower()
    if text.lstrip("+-") in (".inf", ".nan"):
        return math.copysign(math.inf, -1 if text[0] == "-" else 1) if "inf" in text else math.nan
    return float(text)


_StrictLoader.add_constructor("tag:yaml.org,2002:int", _construct_int)
_StrictLoader.add_constructor("tag:yaml.org,2002:float", _construct_float)


class _OpenCVLoader(_StrictLoader):
    """The strict loader, with OpenCV's matrices as mappings."""


def _construct_tagged(loader: _OpenCVLoader, _suffix: str, node: yaml.MappingNode) -> dict[Any, Any]:
    return loader.construct_mapping(node, deep=True)


_OpenCVLoader.add_multi_constructor("tag:yaml.org,2002:opencv-", _construct_tagged)


def read_text(path: Path) -> str:
    """The text of a UTF-8 file. Raises InputError, in one line."""
    try:
        return path.read_bytes().decode("utf-8")
    except UnicodeDecodeError as error:
        raise InputError(
            f"{path}: expected UTF-8 text, got an invalid byte at position {error.start}; save it as UTF-8"
        ) from None
    except FileNotFoundError:
        raise InputError(f"{path}: expected a file, found none; check the path") from None
    except IsADirectoryError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}; name a file in it") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None


def read_mapping(path: Path) -> dict[str, Any]:
    """The mapping in a YAML file; keys are words. Raises InputError, in one line, with the line number."""
    return parse_mapping(read_text(path), path)


def parse_mapping(text: str, path: Path | str, opencv: bool = False) -> dict[str, Any]:
    """As `read_mapping`, from a text. opencv: OpenCV's own head and tags are accepted. path: for the messages."""
    if opencv:
        text = re.sub(r"\A\ufeff?%YAML:1\.0[^\n]*", "", text)
    try:
        content = yaml.load(text, Loader=_OpenCVLoader if opencv else _StrictLoader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        where = f"line {mark.line + 1}" if mark else "the text"
        problem = error.problem or "a mistake"
        if "'\\t'" in problem:
            problem = "a tab; indent with spaces"
        elif "sequence entries are not allowed" in problem:
            problem = 'a lone minus; quote it: "-"'
        elif "mapping values are not allowed" in problem:
            problem = "a second colon; quote the text that holds it"
        problem = problem.removeprefix("but ").removeprefix("found ")
        raise InputError(f"{path}: {where}: expected YAML, found {problem}") from None
    except yaml.YAMLError as error:
        raise InputError(f"{path}: expected YAML, found {str(error).splitlines()[0]}") from None
    except RecursionError:
        raise InputError(f"{path}: expected YAML, found a nesting too deep to read") from None
    if not isinstance(content, dict):
        raise InputError(f"{path}: expected `key: value` lines, got {describe_value(content)}")
    return content


def parse_value(text: str, name: str) -> Any:
    """A single value written as in a file, such as 1e-3 or [0, 1]. name: in the message. Raises InputError."""
    return parse_mapping(f"value: {text}", name)["value"]


class _Writer(yaml.SafeDumper):
    """Lists of plain values on one line, keys in the given order, no aliases."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


def _represent_list(writer: _Writer, values: list[Any]) -> yaml.Node:
    flow = all(not isinstance(v, dict | list) for v in values)
    return writer.represent_sequence("tag:yaml.org,2002:seq", values, flow_style=flow)


def _represent_dict(writer: _Writer, values: dict[Any, Any]) -> yaml.Node:
    flow = all(not isinstance(v, dict | list) for v in values.values())
    return writer.represent_mapping("tag:yaml.org,2002:map", values.items(), flow_style=flow and len(values) > 1)


# Words that this reader would read as numbers must be quoted; YAML 1.1 does not quote them.
_Writer.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"^[-+]?[0-9]+[eE][-+]?[0-9]+$"), list("-+0123456789")
)
_Writer.add_representer(list, _represent_list)
_Writer.add_representer(dict, _represent_dict)


def write_mapping(content: Mapping[str, Any], path: Path) -> None:
    """Write plain values as YAML, atomically; floats read back to the last bit. Raises InputError."""
    atomic_write_text(yaml.dump(dict(content), Dumper=_Writer, sort_keys=False, allow_unicode=True, width=120), path)
