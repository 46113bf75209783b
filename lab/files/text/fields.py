"""Field types of the YAML files, each with its error message.

pydantic walks the file and collects all mistakes. Every check is one of these validators, so that each mistake reads
`file: field: expected this, got that`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, TypeVar

import pydantic
from pydantic_core import PydanticCustomError

from lab.files.text.error_text import FileError, describe_value, suggest_name

M = TypeVar("M", bound="Block")


def field_error(text: str) -> PydanticCustomError:
    """The error that a validator raises for a mistake, with this text."""
    return PydanticCustomError("mistake", "{text}", {"text": text})


def unexpected_value(expected: str, found: object) -> PydanticCustomError:
    """The error `expected ..., got ...`."""
    return field_error(f"expected {expected}, got {describe_value(found)}")


def finite_number(value: Any) -> float:
    """A finite number."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise unexpected_value("a finite number", value)
    return float(value)


def positive_number(value: Any) -> float:
    """A finite number above zero."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not (math.isfinite(value) and value > 0):
        raise unexpected_value("a number above 0", value)
    return float(value)


def non_negative_number(value: Any) -> float:
    """A finite number, zero or above."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not (math.isfinite(value) and value >= 0):
        raise unexpected_value("a number of 0 or more", value)
    return float(value)


def whole_number(value: Any) -> int:
    """A whole number; 3.0 counts as one."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value) or value != int(value):
        raise unexpected_value("a whole number", value)
    return int(value)


def boolean(value: Any) -> bool:
    """true or false."""
    if not isinstance(value, bool):
        raise unexpected_value("true or false", value)
    return value


def word(value: Any) -> str:
    """A text that is not empty; a bare number or true/false counts as its text."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, int | float):
        return str(value)
    if not isinstance(value, str) or not value.strip():
        raise unexpected_value("a word", value)
    return value


def free_text(value: Any) -> str:
    """A text, possibly empty."""
    return "" if value is None else value if value == "" else word(value)


def lines_of_text(value: Any) -> list[str]:
    """A list of lines of text."""
    if not isinstance(value, list) or not all(isinstance(v, str) for v in value):
        raise unexpected_value("a list of lines of text", value)
    return value


def numbers(count: int) -> Callable[[Any], list[float]]:
    """A validator of lists of `count` finite numbers."""

    def check(value: Any) -> list[float]:
        if not isinstance(value, list):
            raise unexpected_value(f"a list of {count} numbers", value)
        if len(value) != count:
            raise field_error(f"expected {count} numbers, got {len(value)}")
        return [finite_number(v) for v in value]

    return check


def positive_numbers(count: int) -> Callable[[Any], list[float]]:
    """A validator of lists of `count` finite numbers above zero."""

    def check(value: Any) -> list[float]:
        return [positive_number(v) for v in numbers(count)(value)]

    return check


def one_of(allowed: tuple[Any, ...]) -> Callable[[Any], Any]:
    """A validator that accepts only the given values."""

    def check(value: Any) -> Any:
        if value in allowed and not (isinstance(value, bool) and True not in allowed and False not in allowed):
            return value
        words = (
            ", ".join(repr(a) for a in allowed[:-1]) + f" or {allowed[-1]!r}" if len(allowed) > 1 else repr(*allowed)
        )
        suggestion = suggest_name(value, [a for a in allowed if isinstance(a, str)])
        raise field_error(
            f"expected {words}, got {describe_value(value)}" + (suggestion if "did you mean" in suggestion else "")
        )

    return check


def _plain(check: Callable[[Any], Any]) -> pydantic.PlainValidator:
    return pydantic.PlainValidator(check)


Number = Annotated[float, _plain(finite_number)]
Positive = Annotated[float, _plain(positive_number)]
NonNegative = Annotated[float, _plain(non_negative_number)]
Integer = Annotated[int, _plain(whole_number)]
Word = Annotated[str, _plain(word)]
Text = Annotated[str, _plain(free_text)]
Vector3 = Annotated[list[float], _plain(numbers(3))]
Lines = Annotated[list[str], _plain(lines_of_text)]


class Block(pydantic.BaseModel):
    """A mapping in a file. Unknown keys are mistakes, as are known keys without a value."""

    model_config = pydantic.ConfigDict(frozen=True, arbitrary_types_allowed=True)

    @pydantic.model_validator(mode="before")
    @classmethod
    def _keys(cls, value: Any) -> Any:
        names = {f.alias or n: f for n, f in cls.model_fields.items()}
        if not isinstance(value, dict):
            raise unexpected_value(f"a mapping with {', '.join(names)}", value)
        for key in value:
            if key not in names:
                raise field_error(f"unknown key {key!r}{suggest_name(key, names)}")
        return value


def validated(model: type[M], content: Mapping[str, Any], path: Path | str, inside: str = "") -> M:
    """The content of a file, validated. inside: the block of the file that `content` is, for the messages.

    Raises:
        FileError: a line for each mistake, in the order of the file.
    """
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
    return f"{where}{expected}, got {describe_value(error['input'])}"
