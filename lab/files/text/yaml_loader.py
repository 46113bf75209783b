"""The YAML loader: core types of YAML 1.2, keys as written, no repeated key, and limits on what a file may hold."""

from __future__ import annotations

import math
import re
from typing import Any

import yaml

MAX_DEPTH = 60  # nesting of lists and mappings; our own files have 6
MAX_ALIAS_NODES = 100_000  # values that the aliases of a file stand for, in all
MAX_DIGITS = 100  # of an integer
_CORE = ("null", "bool", "int", "float", "str", "seq", "map")
_BOOLEANS = {"true": True, "false": False}
_Node = yaml.Node


def _mistake(problem: str, node: Any) -> yaml.constructor.ConstructorError:
    return yaml.constructor.ConstructorError(None, None, problem, node.start_mark)


class StrictLoader(yaml.SafeLoader):
    """Safe loader with the core types of YAML 1.2 only, keys as written, and no repeated key.

    Aliases are counted by the values that they stand for: a file of 500 bytes can stand for billions.
    """

    yaml_implicit_resolvers: dict[str, list[tuple[str, re.Pattern[str]]]] = {}  # noqa: RUF012 - replaces the base's

    def __init__(self, stream: str) -> None:
        super().__init__(stream)
        self._depth = 0
        self._nodes = 0  # composed so far; an alias counts as what it stands for
        self._of_aliases = 0
        self._sizes: dict[str, int] = {}  # by anchor; absent while the anchored value is being read

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
        if any("\ud800" <= c <= "\udfff" or c == "\0" for c in text):
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


class OpenCVLoader(StrictLoader):
    """The strict loader, with OpenCV's matrices as mappings."""


def _construct_tagged(loader: OpenCVLoader, _suffix: str, node: yaml.MappingNode) -> dict[Any, Any]:
    return loader.construct_mapping(node, deep=True)


OpenCVLoader.add_multi_constructor("tag:yaml.org,2002:opencv-", _construct_tagged)
