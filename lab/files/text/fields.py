"""The kinds of field that rig.yaml and run.yaml are made of, each with the words of its mistake.

pydantic walks the file and collects all mistakes; every check that can fail is one of these, so that each mistake
reads `file: field: expected this, got that`.
"""

from __future__ import annotations

import dataclasses
import math
import types
import typing
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, TypeVar

import pydantic
from pydantic_core import PydanticCustomError

from lab.errors import InputError
from lab.files.text.error_text import FileError, did_you_mean, shown

T = TypeVar("T")
M = TypeVar("M", bound="Block")


def wrong(text: str) -> PydanticCustomError:
    """A mistake in these words, to be raised by a validator."""
    return PydanticCustomError("mistake", "{text}", {"text": text})


def unexpected(expected: str, found: object) -> PydanticCustomError:
    """The mistake `expected ..., got ...`."""
    return wrong(f"expected {expected}, got {shown(found)}")


def a_number(value: Any) -> float:
    """A finite number."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise unexpected("a finite number", value)
    return float(value)


def a_positive_number(value: Any) -> float:
    """A finite number above zero."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not (math.isfinite(value) and value > 0):
        raise unexpected("a number above 0", value)
    return float(value)


def a_number_from_zero(value: Any) -> float:
    """A finite number, zero or above."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not (math.isfinite(value) and value >= 0):
        raise unexpected("a number of 0 or more", value)
    return float(value)


def an_integer(value: Any) -> int:
    """A whole number; 3.0 counts as one."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value) or value != int(value):
        raise unexpected("a whole number", value)
    return int(value)


def a_truth_value(value: Any) -> bool:
    """true or false."""
    if not isinstance(value, bool):
        raise unexpected("true or false", value)
    return value


def a_word(value: Any) -> str:
    """Text; a bare number or true/false counts as the text that it is."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, int | float):
        return str(value)
    if not isinstance(value, str) or not value.strip():
        raise unexpected("a word", value)
    return value


def free_text(value: Any) -> str:
    """Text of any length, also none."""
    return "" if value is None else value if value == "" else a_word(value)


def lines_of_text(value: Any) -> list[str]:
    """A list of texts, a line each."""
    if not isinstance(value, list) or not all(isinstance(v, str) for v in value):
        raise unexpected("a list of lines of text", value)
    return value


def numbers(count: int) -> Callable[[Any], list[float]]:
    """A validator of lists of so many finite numbers."""

    def check(value: Any) -> list[float]:
        if not isinstance(value, list):
            raise unexpected(f"a list of {count} numbers", value)
        if len(value) != count:
            raise wrong(f"expected {count} numbers, got {len(value)}")
        return [a_number(v) for v in value]

    return check


def positive_numbers(count: int) -> Callable[[Any], list[float]]:
    """A validator of lists of so many finite numbers above zero."""

    def check(value: Any) -> list[float]:
        return [a_positive_number(v) for v in numbers(count)(value)]

    return check


def one_of(allowed: tuple[Any, ...]) -> Callable[[Any], Any]:
    """A validator of a choice."""

    def check(value: Any) -> Any:
        if value in allowed and not (isinstance(value, bool) and True not in allowed and False not in allowed):
            return value
        words = (
            ", ".join(repr(a) for a in allowed[:-1]) + f" or {allowed[-1]!r}" if len(allowed) > 1 else repr(*allowed)
        )
        suggestion = did_you_mean(value, [a for a in allowed if isinstance(a, str)])
        raise wrong(f"expected {words}, got {shown(value)}" + (suggestion if "did you mean" in suggestion else ""))

    return check


def _plain(check: Callable[[Any], Any]) -> pydantic.PlainValidator:
    return pydantic.PlainValidator(check)


Number = Annotated[float, _plain(a_number)]
Positive = Annotated[float, _plain(a_positive_number)]
FromZero = Annotated[float, _plain(a_number_from_zero)]
Integer = Annotated[int, _plain(an_integer)]
Word = Annotated[str, _plain(a_word)]
Text = Annotated[str, _plain(free_text)]
Vector3 = Annotated[list[float], _plain(numbers(3))]
Lines = Annotated[list[str], _plain(lines_of_text)]


class Block(pydantic.BaseModel):
    """A mapping of the file. Unknown keys, and known ones with nothing behind them, are mistakes."""

    model_config = pydantic.ConfigDict(frozen=True, arbitrary_types_allowed=True)

    @pydantic.model_validator(mode="before")
    @classmethod
    def _keys(cls, value: Any) -> Any:
        names = {f.alias or n: f for n, f in cls.model_fields.items()}
        if not isinstance(value, dict):
            raise unexpected(f"a mapping with {', '.join(names)}", value)
        for key in value:
            if key not in names:
                raise wrong(f"unknown key {key!r}{did_you_mean(key, names)}")
        return value


def validated(model: type[M], content: Mapping[str, Any], path: Path | str, inside: str = "") -> M:
    """The file's content as a value. Raises FileError: a line for each mistake, in the file's order."""
    try:
        return model.model_validate(dict(content))
    except pydantic.ValidationError as error:
        raise FileError(_line(e, path, inside) for e in error.errors()) from None


def _line(error: Any, path: Path | str, inside: str) -> str:
    field = ".".join(([inside] if inside else []) + [str(part) for part in error["loc"]])
    where = f"{path}: {field}: " if field else f"{path}: "
    if error["type"] == "missing":
        return f"{where}expected a value, got nothing; add it"
    if error["type"] == "mistake":
        return f"{where}{error['ctx']['text']}"
    expected = error["msg"].replace("Input should be ", "expected ").removeprefix("Value error, ")
    return f"{where}{expected}, got {shown(error['input'])}"


def dataclass_from_yaml(cls: type[T], mapping: Any, path: Path | str, inside: str = "") -> T:
    """A frozen parameter dataclass from a block of a file; what the block leaves out keeps its default.

    The dataclass's fields are floats, ints, bools, strings, Literals, tuples of floats, other such dataclasses, or one
    of these or None. Raises FileError: unknown keys, wrong kinds, and whatever the dataclass itself refuses.
    """
    model = _model_of(cls)
    return _value_of(cls, validated(model, {} if mapping is None else _as_mapping(mapping, path, inside), path, inside))


def _as_mapping(value: Any, path: Path | str, inside: str) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise InputError(f"{path}: {inside}: expected a mapping, got {shown(value)}")
    return value


def _model_of(cls: type) -> type[Block]:
    """A strict model with the fields of a dataclass."""
    hints = typing.get_type_hints(cls)
    fields: dict[str, Any] = {}
    for field in dataclasses.fields(cls):
        if not field.init:
            continue
        if field.default is not dataclasses.MISSING:
            default = field.default
        elif field.default_factory is not dataclasses.MISSING:
            default = field.default_factory()
        else:
            default = ...
        fields[field.name] = (_kind_of(hints[field.name]), default)
    made = pydantic.create_model(cls.__name__, __base__=Block, **fields)

    def build(self: Block) -> Any:
        """The dataclass's own checks, run where pydantic knows the field's place in the file."""
        try:
            _value_of(cls, self)
        except ValueError as error:
            raise wrong(str(error)) from None
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
        return Annotated[_kind_of(inner) | None, pydantic.WrapValidator(_nothing_or)]
    if origin is typing.Literal:
        return Annotated[Any, _plain(one_of(arguments))]
    if origin is tuple:
        if arguments[-1] is Ellipsis:
            return Annotated[Any, _plain(_number_tuple)]
        return Annotated[Any, _plain(lambda v: tuple(numbers(len(arguments))(v)))]
    if dataclasses.is_dataclass(hint):
        return _model_of(typing.cast(type, hint))
    kinds: dict[Any, Any] = {
        float: Number,
        int: Integer,
        bool: Annotated[bool, _plain(a_truth_value)],
        str: Word,
    }
    if hint not in kinds:
        raise TypeError(f"a parameter of type {hint} cannot be read from a file")
    return kinds[hint]


def _nothing_or(value: Any, inner: Any) -> Any:
    return None if value is None else inner(value)


def _number_tuple(value: Any) -> tuple[float, ...]:
    if not isinstance(value, list):
        raise unexpected("a list of numbers", value)
    return tuple(a_number(v) for v in value)


def _value_of(cls: type[T], block: Block) -> T:
    """The dataclass of a validated block."""
    hints = typing.get_type_hints(cls)
    values = {}
    for name in type(block).model_fields:
        value = getattr(block, name)
        if isinstance(value, Block):
            inner = [a for a in (hints[name], *typing.get_args(hints[name])) if dataclasses.is_dataclass(a)]
            value = _value_of(typing.cast(type, inner[0]), value)
        values[name] = value
    return cls(**values)
