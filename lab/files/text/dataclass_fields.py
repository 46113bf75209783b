"""Parameter dataclasses from blocks of YAML files (docs/decisions/parameters-from-files.md)."""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Annotated, Any, TypeVar, cast

import pydantic

from lab.errors import InputError
from lab.files.text import fields
from lab.files.text.error_text import describe_value

T = TypeVar("T")


def dataclass_from_yaml(cls: type[T], mapping: Any, path: Path | str, inside: str = "") -> T:
    """A frozen parameter dataclass from a block of a file; fields that the block does not have keep their default.

    The dataclass's fields are floats, ints, bools, strings, Literals, tuples of floats, other such dataclasses, or
    optional ones of these. Raises FileError: unknown keys, wrong types, and values that the dataclass itself refuses.
    """
    model = block_of(typing.cast(Any, cls))
    return _value_of(
        cls, fields.validated(model, {} if mapping is None else _as_mapping(mapping, path, inside), path, inside)
    )


def _as_mapping(value: Any, path: Path | str, inside: str) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise InputError(f"{path}: {inside}: expected a mapping, got {describe_value(value)}")
    return value


@cache
def block_of(cls: type) -> type[fields.Block]:
    """A strict pydantic model with the fields of a parameter dataclass, see `dataclass_from_yaml`."""
    hints = typing.get_type_hints(cls)
    kinds: dict[str, Any] = {}
    for field in dataclasses.fields(cls):
        if not field.init:
            continue
        if field.default is not dataclasses.MISSING:
            default = field.default
        elif field.default_factory is not dataclasses.MISSING:
            default = field.default_factory()
        else:
            default = ...
        kinds[field.name] = (_kind_of(hints[field.name]), default)
    made = pydantic.create_model(cls.__name__, __base__=fields.Block, **kinds)

    def build(self: fields.Block) -> Any:
        """The dataclass's own checks, run while pydantic knows the position in the file."""
        try:
            _value_of(cls, self)
        except ValueError as error:
            raise fields.field_error(str(error)) from None
        return self

    return pydantic.create_model(
        cls.__name__,
        __base__=made,
        __validators__={"build": typing.cast(Any, pydantic.model_validator(mode="after")(build))},
    )


def _kind_of(hint: Any) -> Any:
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        inner = next(a for a in arguments if a is not type(None))
        return Annotated[_kind_of(inner) | None, pydantic.WrapValidator(lambda v, of: None if v is None else of(v))]
    if origin is typing.Literal:
        return Annotated[Any, pydantic.PlainValidator(fields.one_of(arguments))]
    if origin is tuple:
        if arguments[-1] is Ellipsis:
            return Annotated[Any, pydantic.PlainValidator(_number_tuple)]
        return Annotated[Any, pydantic.PlainValidator(lambda v: tuple(fields.numbers(len(arguments))(v)))]
    if dataclasses.is_dataclass(hint):
        return block_of(typing.cast(type, hint))
    kinds: dict[Any, Any] = {
        float: fields.Number,
        int: fields.Integer,
        bool: Annotated[bool, pydantic.PlainValidator(fields.boolean)],
        str: fields.Word,
    }
    if hint not in kinds:
        raise TypeError(f"a parameter of type {hint} cannot be read from a file")
    return kinds[hint]


def _number_tuple(value: Any) -> tuple[float, ...]:
    if not isinstance(value, list):
        raise fields.unexpected_value("a list of numbers", value)
    return tuple(fields.finite_number(v) for v in value)


def _value_of(cls: type[T], block: fields.Block) -> T:
    """The dataclass of a validated block."""
    hints = typing.get_type_hints(cls)
    values = {}
    for name in type(block).model_fields:
        value = getattr(block, name)
        if isinstance(value, fields.Block):
            inner = [a for a in (hints[name], *typing.get_args(hints[name])) if dataclasses.is_dataclass(a)]
            value = _value_of(typing.cast(type, inner[0]), value)
        values[name] = value
    return cls(**values)


MAX_DOTS = 5  # of a name; the parameters have one level of blocks


def with_overrides(parameters: T, overrides: Mapping[str, Any], place: str = "--set") -> T:
    """Parameters with overrides, checked as in a file. Dotted names address inner blocks.

    place: where the overrides are from, in messages. Raises InputError.
    """
    content: dict[str, Any] = dataclasses.asdict(cast(Any, parameters))
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
    return dataclass_from_yaml(type(parameters), content, place)
