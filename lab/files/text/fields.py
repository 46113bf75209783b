"""Field types of the YAML files, each with its error message.

pydantic walks the file and collects all mistakes. Every check is one of these validators, so that each mistake reads
`file: field: expected this, got that`.
"""

from __future__ import annotations

import datetime
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, TypeVar

import pydantic
from pydantic_core import PydanticCustomError

from lab.files.text.error_text import FileError, describe_value, is_formula, suggest_name

M = TypeVar("M", bound="Block")
MAX_NUMBER = 1e15  # largest magnitude of any number: its higher powers can still be computed
MIN_POSITIVE = 1e-15
MAX_EXACT_INTEGER = 2**53
MAX_COORDINATE = 1e8  # m, of a vector
MAX_NAME = 200  # characters


def field_error(text: str) -> PydanticCustomError:
    """The error that a validator raises for a mistake, with this text."""
    return PydanticCustomError("mistake", "{text}", {"text": text})


def unexpected_value(expected: str, found: object) -> PydanticCustomError:
    """The error `expected ..., got ...`."""
    return field_error(f"expected {expected}, got {describe_value(found)}")


def _is_number(value: Any) -> bool:
    """Whether the value is a finite number. An integer may have more digits than a float can hold."""
    return (
        isinstance(value, int | float)
        and not isinstance(value, bool)
        and (isinstance(value, int) or math.isfinite(value))
    )


def finite_number(value: Any) -> float:
    """A finite number of magnitude up to MAX_NUMBER."""
    if not _is_number(value):
        raise unexpected_value("a finite number", value)
    if abs(value) > MAX_NUMBER:
        raise unexpected_value(f"a number of magnitude up to {MAX_NUMBER:g}", value)
    return float(value)


def positive_number(value: Any) -> float:
    """A number above zero, from MIN_POSITIVE to MAX_NUMBER."""
    if not _is_number(value) or value <= 0:
        raise unexpected_value("a number above 0", value)
    if not MIN_POSITIVE <= value <= MAX_NUMBER:
        raise unexpected_value(f"a number from {MIN_POSITIVE:g} to {MAX_NUMBER:g}", value)
    return float(value)


def number_between(least: float, largest: float, unit: str) -> Callable[[Any], float]:
    """A validator of numbers from `least` to `largest`."""

    def check(value: Any) -> float:
        if not _is_number(value) or (least > 0 >= value):
            raise unexpected_value("a number above 0" if least > 0 else "a finite number", value)
        if not least <= value <= largest:
            raise unexpected_value(f"{least:g} to {largest:g} {unit}", value)
        return float(value)

    return check


def non_negative_number(value: Any) -> float:
    """A number from 0 to MAX_NUMBER."""
    if not _is_number(value) or value < 0:
        raise unexpected_value("a number of 0 or more", value)
    if value > MAX_NUMBER:
        raise unexpected_value(f"a number from 0 to {MAX_NUMBER:g}", value)
    return float(value)


def whole_number(value: Any) -> int:
    """A whole number of magnitude up to MAX_EXACT_INTEGER; 3.0 counts as one."""
    if not _is_number(value) or value != int(value):
        raise unexpected_value("a whole number", value)
    if abs(value) > MAX_EXACT_INTEGER:
        raise unexpected_value(f"a whole number up to {MAX_EXACT_INTEGER}", value)
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


def printable_name(value: Any) -> str:
    """A name that can be printed, and that a spreadsheet reads as a text, not as a formula."""
    text = word(value)
    if not text.isprintable():
        raise unexpected_value("a name without control characters", text)
    if len(text) > MAX_NAME:
        raise unexpected_value(f"a name of up to {MAX_NAME} characters", text)
    if is_formula(text):
        raise unexpected_value("a name that a spreadsheet does not read as a formula (no =, +, -, @ in front)", text)
    return text


def free_text(value: Any) -> str:
    """A text, possibly empty."""
    return "" if value is None else value if value == "" else word(value)


def lines_of_text(value: Any) -> tuple[str, ...]:
    """A list of lines of text."""
    if not isinstance(value, list | tuple) or not all(isinstance(v, str) for v in value):
        raise unexpected_value("a list of lines of text", value)
    return tuple(value)


def numbers(count: int) -> Callable[[Any], list[float]]:
    """A validator of lists of `count` finite numbers."""

    def check(value: Any) -> list[float]:
        if not isinstance(value, list):
            raise unexpected_value(f"a list of {count} numbers", value)
        if len(value) != count:
            raise field_error(f"expected {count} numbers, got {len(value)}")
        return [finite_number(v) for v in value]

    return check


def vector3(value: Any) -> list[float]:
    """A list of three numbers of magnitude up to MAX_COORDINATE."""
    values = numbers(3)(value)
    if max(map(abs, values)) > MAX_COORDINATE:
        raise unexpected_value(f"three numbers of magnitude up to {MAX_COORDINATE:g}", value)
    return values


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
Name = Annotated[str, _plain(printable_name)]
Vector3 = Annotated[list[float], _plain(vector3)]
Lines = Annotated[tuple[str, ...], _plain(lines_of_text)]


class Block(pydantic.BaseModel):
    """A mapping in a file. Unknown keys are mistakes, as are known keys without a value."""

    model_config = pydantic.ConfigDict(frozen=True, arbitrary_types_allowed=True, defer_build=True)

    def as_mapping(self) -> dict[str, Any]:
        """The plain mapping from which the same block is read, without what has its default."""
        return {key: _plain_value(value) for key, value in self.model_dump(exclude_defaults=True).items()}

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


def _plain_value(value: Any) -> Any:
    if isinstance(value, datetime.date):
        return value.isoformat()
    return list(value) if isinstance(value, tuple) else value


def validated(model: type[M], content: Mapping[str, Any], path: Path | str, inside: str = "") -> M:
    """The content of a file, validated. inside: the block of the file that `content` is, for the messages.

    Raises FileError: a line for each mistake, in the order of the file.
    """
    value, mistakes = mistakes_in(model, content, path, inside)
    if value is None:
        raise FileError(mistakes)
    return value


def mistakes_in(
    model: type[M], content: Mapping[str, Any], path: Path | str, inside: str = "", folder: Path | None = None
) -> tuple[M | None, list[str]]:
    """As `validated`, with the mistakes as lines; None where there are some.

    folder: the context of the validation, for validators that look for files.
    """
    has_schema = "schema_" in model.model_fields  # a missing one is named with the value that is expected
    try:
        return model.model_validate({**({"schema": None} if has_schema else {}), **content}, context=folder), []
    except pydantic.ValidationError as error:
        return None, [_line(e, path, inside) for e in error.errors()]


def _line(error: Any, path: Path | str, inside: str) -> str:
    field = ".".join(([inside] if inside else []) + [str(part) for part in error["loc"] if part != "[key]"])
    where = f"{path}: {field}: " if field else f"{path}: "
    if error["type"] == "missing":
        return f"{where}expected a value, got nothing; add it"
    if error["type"] == "mistake":
        return f"{where}{error['ctx']['text']}"
    expected = error["msg"].replace("Input should be ", "expected ").removeprefix("Value error, ")
    return f"{where}{expected}, got {describe_value(error['input'])}"
