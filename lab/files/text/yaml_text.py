"""YAML files: read safely and strictly, each mistake reported in one line; written atomically.

Only the core types of YAML 1.2 are read (null, true/false, integers, decimal and exponent floats): `on`, `no`, `1:30`
and dates are words, and `1e-3` is a number, unlike in YAML 1.1. A key is the text in the file, so that the spots `1`
and `"1"` are the same spot. Why PyYAML and not ruamel.yaml: docs/decisions/yaml-reader.md.
"""

from __future__ import annotations

import re
import stat
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from lab.errors import InputError
from lab.files.text.atomic_write import atomic_write_text
from lab.files.text.yaml_loader import OpenCVLoader, StrictLoader

MAX_FILE_BYTES = 64 << 20  # our largest files, rigs with a joint covariance, have some 1 MB


def read_text(path: Path) -> str:
    """The text of a UTF-8 file of at most MAX_FILE_BYTES. Raises InputError, in one line."""
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode) and not stat.S_ISDIR(status.st_mode):
            raise InputError(f"{path}: expected a file, found a pipe or a device; save the text as a file")
        if status.st_size > MAX_FILE_BYTES:
            raise InputError(f"{path}: expected a file of at most {MAX_FILE_BYTES >> 20} MB, found a larger one")
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
        content = yaml.load(text, Loader=OpenCVLoader if opencv else StrictLoader)
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
        if problem.startswith("could not determine a constructor"):
            problem = "a tag of another program (`!name`, `!!name`); remove the tag"
        problem = problem.removeprefix("but ").removeprefix("expected a sequence node, but ").removeprefix("found ")
        raise InputError(f"{path}: {where}: expected YAML, found {problem}") from None
    except yaml.YAMLError as error:
        raise InputError(f"{path}: expected YAML, found {str(error).splitlines()[0]}") from None
    if not isinstance(content, dict):  # its content is not shown: the path may name any file
        kind = "nothing" if content is None else "a list" if isinstance(content, list) else "other text"
        raise InputError(f"{path}: expected `key: value` lines, got {kind}")
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
