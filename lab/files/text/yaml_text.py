"""YAML files: the loader, with its limits, and what reads and writes with it."""

from __future__ import annotations

import contextlib
import math
import re
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import yaml

from lab.errors import InputError
from lab.files.text.atomic_write import atomic_write_text
from lab.files.text.json_text import bytes_of_file

# The YAML loader: core types of YAML 1.2, keys as written, no repeated key, and limits on what a file may hold.

MAX_DEPTH = 60  # nesting of lists and mappings; our own files have 6
MAX_ALIAS_NODES = 100_000  # values that the aliases of a file stand for, in all
MAX_DIGITS = 100  # of an integer
_CORE = ("null", "bool", "int", "float", "str", "seq", "map")
_BOOLEANS = {"true": True, "false": False}
_NO_CHARACTER = re.compile("[\ud800-\udfff\0]")
_Node = yaml.Node


def _mistake(problem: str, node: Any) -> yaml.constructor.ConstructorError:
    return yaml.constructor.ConstructorError(None, None, problem, node.start_mark)


class StrictLoader(yaml.SafeLoader):
    """Safe loader with the core types of YAML 1.2 only, keys as written, and no repeated key.

    Aliases are counted by the values that they stand for: a file of 500 bytes can stand for billions.
    """

    yaml_implicit_resolvers: dict[str, list[tuple[str, re.Pattern[str]]]] = {}  # noqa: RUF012 - replaces the base's

    def __init__(self, stream: str) -> None:
        self._open(stream)
        self._depth = 0
        self._nodes = 0  # composed so far; an alias counts as what it stands for
        self._of_aliases = 0
        self._sizes: dict[str, int] = {}  # by anchor; absent while the anchored value is being read

    def _open(self, stream: str) -> None:
        super().__init__(stream)

    def compose_node(self, parent: _Node | None, index: int) -> _Node | None:
        event: Any = self.peek_event()  # type: ignore[no-untyped-call]
        if isinstance(event, yaml.AliasEvent):
            if event.anchor in self.anchors and event.anchor not in self._sizes:
                raise _mistake("an alias inside the value that it stands for; write the value out", event)
            size = self._sizes.get(str(event.anchor), 0)
            self._nodes += size
            self._of_aliases += size
            if self._of_aliases > MAX_ALIAS_NODES:
                raise _mistake(
                    f"aliases that stand for more than {MAX_ALIAS_NODES} values; write the values out", event
                )
            return super().compose_node(parent, index)
        if self._depth >= MAX_DEPTH:
            raise _mistake(f"a nesting deeper than {MAX_DEPTH} levels; remove some brackets or indentation", event)
        self._depth += 1
        before = self._nodes
        self._nodes += 1
        anchor = event.anchor
        node = super().compose_node(parent, index)
        self._depth -= 1
        if anchor is not None:
            self._sizes[anchor] = self._nodes - before
        return node

    def construct_scalar(self, node: yaml.ScalarNode | yaml.MappingNode) -> Any:
        if not isinstance(node, yaml.ScalarNode):
            raise _mistake("a list or mapping where one value is expected", node)
        text = str(node.value)
        if _NO_CHARACTER.search(text):
            raise _mistake("an escape that is no character, such as \\0 or \\ud800; remove it", node)
        return text

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        if not isinstance(node, yaml.MappingNode):
            raise _mistake("a value where a mapping is expected", node)
        own = [key for key, _ in node.value if key.tag != "tag:yaml.org,2002:merge"]
        seen: set[str] = set()
        for key in own:
            name = self._key(key)
            if name in seen:
                raise _mistake(f"the key {name!r} a second time", key)
            seen.add(name)
        self.flatten_mapping(node)
        return {self._key(key): self.construct_object(value, deep=True) for key, value in node.value}

    def _key(self, key: _Node) -> str:
        if not isinstance(key, yaml.ScalarNode):
            raise _mistake("a key that is not a word", key)
        return str(self.construct_scalar(key))


def _construct_map(loader: StrictLoader, node: yaml.MappingNode) -> dict[Any, Any]:
    return loader.construct_mapping(node, deep=True)


# Other tags (!!timestamp, !!set ...) are mistakes: nothing in our files needs them.
StrictLoader.yaml_constructors = {
    tag: make
    for tag, make in yaml.SafeLoader.yaml_constructors.items()
    if tag is None or tag.removeprefix("tag:yaml.org,2002:") in _CORE
}
StrictLoader.add_constructor("tag:yaml.org,2002:map", _construct_map)
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
    StrictLoader.add_implicit_resolver(f"tag:yaml.org,2002:{_tag}", re.compile(rf"^(?:{_pattern})$"), _first)


def _construct_bool(loader: StrictLoader, node: yaml.ScalarNode) -> bool:
    text = str(loader.construct_scalar(node)).lower()
    if text not in _BOOLEANS:
        raise _mistake("a word that is not true or false, tagged as !!bool; remove the tag", node)
    return _BOOLEANS[text]


def _construct_int(loader: StrictLoader, node: yaml.ScalarNode) -> int:
    text = str(loader.construct_scalar(node))
    if len(text) > MAX_DIGITS:
        raise _mistake(f"an integer of more than {MAX_DIGITS} digits; quote it if it is a name", node)
    try:
        return int(text)
    except ValueError:
        raise _mistake("a word that is not an integer, tagged as !!int; remove the tag", node) from None


def _construct_float(loader: StrictLoader, node: yaml.ScalarNode) -> float:
    text = str(loader.construct_scalar(node)).lower()
    if text.lstrip("+-") in (".inf", ".nan"):
        return math.copysign(math.inf, -1 if text[0] == "-" else 1) if "inf" in text else math.nan
    try:
        return float(text)
    except ValueError:
        raise _mistake("a word that is not a number, tagged as !!float; remove the tag", node) from None


StrictLoader.add_constructor("tag:yaml.org,2002:bool", _construct_bool)
StrictLoader.add_constructor("tag:yaml.org,2002:int", _construct_int)
StrictLoader.add_constructor("tag:yaml.org,2002:float", _construct_float)


if yaml.__with_libyaml__:

    class _LibyamlLoader(StrictLoader, yaml.CSafeLoader):
        """The strict loader with libyaml's parser: a fifth of the time, but other messages."""

        def _open(self, stream: str) -> None:
            yaml.CSafeLoader.__init__(self, stream)
            yaml.composer.Composer.__init__(self)

        check_event, peek_event = yaml.CSafeLoader.check_event, yaml.CSafeLoader.peek_event
        get_event, dispose = yaml.CSafeLoader.get_event, yaml.CSafeLoader.dispose


# A text of these characters that libyaml accepts is the same to PyYAML's parser. With others libyaml accepts more: a
# tab for a space, a `?` within a word.
_SAME_TO_LIBYAML = re.compile(r"[\n \"#$'-)+-;=A-\[\]^_a-{}~\xa1-\u2027\u2030-\ud7ff]*")


class OpenCVLoader(StrictLoader):
    """The strict loader, with OpenCV's matrices as mappings."""


OpenCVLoader.add_multi_constructor("tag:yaml.org,2002:opencv-", lambda loader, _, node: _construct_map(loader, node))


# YAML files: read safely and strictly, each mistake reported in one line; written atomically.
#
# Only the core types of YAML 1.2 are read (null, true/false, integers, decimal and exponent floats): `on`, `no`,
# `1:30` and dates are words, and `1e-3` is a number, unlike in YAML 1.1. A key is the text in the file, so that the
# spots `1` and `"1"` are the same spot. Why PyYAML and not ruamel.yaml: docs/decisions/yaml-reader.md.


MAX_FILE_BYTES = 64 << 20  # our largest files, rigs with a joint covariance, have some 1 MB


def read_text(path: Path) -> str:
    """The text of a UTF-8 file of at most MAX_FILE_BYTES. Raises InputError, in one line."""
    try:
        if path.stat().st_size > MAX_FILE_BYTES:
            raise InputError(f"{path}: expected a file of at most {MAX_FILE_BYTES >> 20} MB, found a larger one")
        return bytes_of_file(path).decode("utf-8")
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


# What the parser's words mean to the user, by a part of them. Of some, it notices the mistake in a later line.
_MISTAKES = {
    "'\\t'": "a tab; indent with spaces",
    "sequence entries are not allowed": 'a lone minus; quote it: "-"',
    "mapping values are not allowed": "a colon out of place; write a space after the colons of this line and the one"
    " above, indent them alike, and quote a text that holds a colon",
    "could not determine a constructor": "a tag of another program (`!name`, `!!name`); remove the tag",
    "could not find expected ':'": "text without a colon; write `key: value`",
    "expected ',' or": "a bracket that is not closed, or a missing comma",
    "unexpected end of stream": "a quote that is not closed",
    "expected <block end>": "text that does not continue the lines above; check indents, brackets and quotes",
    "expected '<document start>'": "text that does not continue the lines above; check indents, brackets and quotes",
    "expected the node content": "a comma or a bracket in place of a value",
    "cannot start any token": "a value that begins with {character}; quote it",
    "unknown escape character": "a backslash in double quotes; use single quotes, or / between folders",
}
_SEEN_LATER = {"could not find expected ':'", "expected ',' or", "unexpected end of stream"}


def read_mapping(path: Path) -> dict[str, Any]:
    """The mapping in a YAML file; keys are words. Raises InputError, in one line, with the line number."""
    return parse_mapping(read_text(path), path)


def parse_mapping(text: str, path: Path | str, opencv: bool = False) -> dict[str, Any]:
    """As `read_mapping`, from a text. opencv: OpenCV's own head and tags are accepted. path: for the messages."""
    if opencv:
        text = re.sub(r"\A\ufeff?%YAML:1\.0[^\n]*", "", text)
    try:
        content = _loaded(text, opencv)
    except yaml.MarkedYAMLError as error:
        problem, where = error.problem or "a mistake", error.problem_mark or error.context_mark
        for part, words in _MISTAKES.items():
            if part in problem:
                where = (error.context_mark or where) if part in _SEEN_LATER else where
                problem = words.format(character=problem.split("'")[1] if "'" in problem else "")
        place = f"line {where.line + 1}" if where else "the text"
        problem = problem.removeprefix("but ").removeprefix("expected a sequence node, but ").removeprefix("found ")
        raise InputError(f"{path}: {place}: expected YAML, found {problem}") from None
    except yaml.YAMLError as error:
        raise InputError(f"{path}: expected YAML, found {str(error).splitlines()[0]}") from None
    if not isinstance(content, dict):  # its content is not shown: the path may name any file
        kind = "nothing" if content is None else "a list" if isinstance(content, list) else "other text"
        raise InputError(f"{path}: expected `key: value` lines, got {kind}")
    return content


def _loaded(text: str, opencv: bool) -> Any:
    if yaml.__with_libyaml__ and not opencv and _SAME_TO_LIBYAML.fullmatch(text):
        with contextlib.suppress(yaml.YAMLError):  # the other parser has the message
            return yaml.load(text, Loader=_LibyamlLoader)
    return yaml.load(text, Loader=OpenCVLoader if opencv else StrictLoader)


def parse_value(text: str, name: str) -> Any:
    """A single value written as in a file, such as 1e-3 or [0, 1]. name: in the message. Raises InputError."""
    return parse_mapping(f"value: {text}", name)["value"]


def _represent_list(writer: Any, values: list[Any]) -> yaml.Node:
    flow = all(not isinstance(v, dict | list) for v in values)
    return writer.represent_sequence("tag:yaml.org,2002:seq", values, flow_style=flow)


def _represent_dict(writer: Any, values: dict[Any, Any]) -> yaml.Node:
    flow = all(not isinstance(v, dict | list) for v in values.values())
    return writer.represent_mapping("tag:yaml.org,2002:map", values.items(), flow_style=flow and len(values) > 1)


def _writer(base: Any) -> Any:
    """A dumper: lists of plain values on one line, keys in the given order, no aliases."""
    writer: Any = type("_Writer", (base,), {"ignore_aliases": lambda self, data: True})
    # Words that this reader would read as numbers must be quoted; YAML 1.1 does not quote them.
    writer.add_implicit_resolver(
        "tag:yaml.org,2002:float", re.compile(r"^[-+]?[0-9]+[eE][-+]?[0-9]+$"), list("-+0123456789")
    )
    writer.add_representer(list, _represent_list)
    writer.add_representer(dict, _represent_dict)
    return writer


_WRITER = _writer(yaml.SafeDumper)
_LIBYAML_WRITER = _writer(yaml.CSafeDumper) if yaml.__with_libyaml__ else _WRITER


def _dumped(content: dict[str, Any]) -> str:
    """Plain values as YAML, by libyaml where its text is the same as PyYAML's: in a quarter of the time."""
    options: dict[str, Any] = {"sort_keys": False, "allow_unicode": True, "width": 120}
    if yaml.__with_libyaml__:
        text = str(yaml.dump(content, Dumper=_LIBYAML_WRITER, **options))
        if _SAME_TO_LIBYAML.fullmatch(text):
            return text
    return str(yaml.dump(content, Dumper=_WRITER, **options))


def write_mapping(content: Mapping[str, Any], path: Path, comments: Mapping[str, str] = MappingProxyType({})) -> None:
    """Write plain values as YAML, atomically; floats read back to the last bit. Raises InputError.

    comments: as in `with_comments`.
    """
    atomic_write_text(with_comments(_dumped(dict(content)), comments), path)


_KEY = re.compile(r"""^( *)('(?:[^']|'')*'|"(?:[^"\\]|\\.)*"|[^\s'"#{}[\]-][^:]*):(?:\s|$)""")


def with_comments(text: str, comments: Mapping[str, str]) -> str:
    """YAML text with comments, each before the first line of a key, by the key's place.

    A place is as cameras.left.screen, or cameras.*.screen for any name.
    """
    waiting = {re.compile(re.escape(place).replace(r"\*", "[^.]*")): words for place, words in comments.items()}
    keys: list[tuple[int, str]] = []
    lines = []
    for line in text.splitlines():
        match = _KEY.match(line) if waiting else None
        if match:
            indent = len(match[1])
            keys = [*(k for k in keys if k[0] < indent), (indent, str(yaml.safe_load(match[2])))]
            place = ".".join(key for _, key in keys)
            here = [p for p in waiting if p.fullmatch(place)]
            lines += [f"{match[1]}# {waiting.pop(pattern)}" for pattern in here]
        lines.append(line)
    return "\n".join([*lines, ""])
