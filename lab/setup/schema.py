"""`beampose schema`: JSON schemas of the YAML files, from their pydantic models."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import inspect
import json
import re
import textwrap
import types
import typing
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any

import pydantic

from lab.files.project.project import Project
from lab.files.rig import board_file, camera_file, rig_file
from lab.files.run import run_file
from lab.files.text import fields
from lab.files.text.atomic_write import atomic_write_text, made_folder
from lab.files.text.dataclass_fields import block_of
from lab.files.text.fields import Block
from tracking.parameters import TrackerParameters

# JSON schemas from the blocks of the YAML files (pydantic models whose fields have validators of their own).

Schema = dict[str, Any]
_TEXT: Schema = {"type": ["string", "number", "boolean"], "minLength": 1}  # a bare number counts as its text
_OF_VALIDATORS: dict[Callable[..., Any], Schema] = {
    fields.finite_number: {"type": "number"},
    fields.positive_number: {"type": "number", "exclusiveMinimum": 0},
    fields.non_negative_number: {"type": "number", "minimum": 0},
    fields.whole_number: {"type": "integer"},
    fields.boolean: {"type": "boolean"},
    fields.word: _TEXT,
    fields.printable_name: {**_TEXT, "maxLength": fields.MAX_NAME},
    fields.vector3: {"type": "array", "items": {"type": "number"}, "minItems": 3, "maxItems": 3},
    fields.free_text: {"type": ["string", "number", "boolean", "null"]},
    fields.lines_of_text: {"type": "array", "items": {"type": "string"}},
}
# Validators that belong to one file, by name: what they accept beside or instead of their type.
_OF_NAMES: dict[str, Schema] = {
    "_paths": {"anyOf": [{"type": "string"}, {"type": "array", "items": {"type": "string"}}]},
    "_patterns": {"anyOf": [{"type": "string"}, {"type": "array", "items": {"type": "string"}}]},
    "_file": _TEXT,
    "_run_folder": _TEXT,
    "_board": {"type": "string"},
    "_days": {"type": ["integer", "null"], "minimum": 1},
    "_name": _TEXT,
    "unit_quaternion": {"type": "array", "items": {"type": "number"}, "minItems": 4, "maxItems": 4},
    "nonzero_vector": {"type": "array", "items": {"type": "number"}, "minItems": 3, "maxItems": 3},
    "rotation_rows": {"type": "array", "items": _OF_VALIDATORS[fields.vector3], "minItems": 3, "maxItems": 3},
    "_image_size": {"type": "array", "items": {"type": "integer", "minimum": 1}, "minItems": 2, "maxItems": 2},
    "_distortion": {"type": "array", "items": {"type": "number"}, "maxItems": 14},
    "_a_device": {"type": ["integer", "string"]},
    "_an_angle_range": {"type": "number", "exclusiveMinimum": 0, "maximum": 180},
    "iso_date": {"type": "string", "description": "a date such as 2026-03-14"},
    "_day_or_none": {"type": ["string", "null"], "description": "a date such as 2026-03-14"},
    "_seconds_or_estimate": {"anyOf": [{"type": "number"}, {"enum": ["estimate"]}]},
    "_number_tuple": {"type": "array", "items": {"type": "number"}},
}
_OF_TYPES: dict[Any, Schema] = {
    float: {"type": "number"}, int: {"type": "integer"}, bool: {"type": "boolean"}, str: {"type": "string"},
    type(None): {"type": "null"},
}  # fmt: skip
_COMMENT = re.compile(r"^    (\w+): [^#\n]*#(?!\s*noqa)\s*(.+)$", re.MULTILINE)


def schema_of_block(block: type[Block], commented: type | None = None) -> Schema:
    """The schema of a mapping. commented: the class whose source has comments for the fields; default: the block."""
    comments = comments_of(commented or block)
    properties, required = {}, []
    for name, field in block.model_fields.items():
        key = field.alias or name
        schema = _of_field(field)
        if name in comments:
            schema = {**schema, "description": comments[name]}
        if field.is_required():
            required.append(key)
        elif not isinstance(field.default, Block) and field.default not in (None, [], {}, (), ""):
            schema = {**schema, "default": field.default}
        properties[key] = schema
    out: Schema = {"type": "object", "properties": properties, "additionalProperties": False}
    return {**out, "required": required} if required else out


@functools.cache  # a schema asks for those of one block up to ten times, and its source is searched each time
def comments_of(cls: type) -> Mapping[str, str]:
    """The comments behind the fields of a class and of those that it extends, by field; empty without their source."""
    found = {} if cls is object else {k: v for base in reversed(cls.__bases__) for k, v in comments_of(base).items()}
    with contextlib.suppress(OSError, TypeError):
        found.update(_COMMENT.findall(textwrap.dedent(inspect.getsource(cls))))
    return found


def _of_field(field: pydantic.fields.FieldInfo) -> Schema:
    validators = [m for m in field.metadata if isinstance(m, pydantic.PlainValidator)]
    return _of_validator(validators[-1].func, field.annotation) if validators else schema_of(field.annotation)


def schema_of(hint: Any) -> Schema:
    """The schema of a type of a field; empty (anything) for types that have none."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is Annotated:
        validators = [m for m in arguments[1:] if isinstance(m, pydantic.PlainValidator)]
        return _of_validator(validators[-1].func, arguments[0]) if validators else schema_of(arguments[0])
    if origin in (typing.Union, types.UnionType):
        return {"anyOf": [schema_of(a) for a in arguments]}
    if origin is list:
        return {"type": "array", "items": schema_of(arguments[0])}
    if origin is dict:
        return {"type": "object", "additionalProperties": schema_of(arguments[1])}
    if isinstance(hint, type) and issubclass(hint, Block):
        return schema_of_block(hint)
    return dict(_OF_TYPES.get(hint, {}))


def _of_validator(function: Callable[..., Any], hint: Any) -> Schema:
    """The schema of what a validator accepts; where it is not known, that of the type it returns."""
    if function in _OF_VALIDATORS:
        return dict(_OF_VALIDATORS[function])
    name = function.__name__
    if name in _OF_NAMES:
        return dict(_OF_NAMES[name])
    inner = inspect.getclosurevars(function).nonlocals
    if {"least", "largest"} <= inner.keys():  # number_between
        return {"type": "number", "minimum": inner["least"], "maximum": inner["largest"]}
    if "points" in inner:  # points of a screen or a beam
        points = inner["points"]
        return {"type": "array", "items": _OF_VALIDATORS[fields.vector3], "minItems": points, "maxItems": points}
    if "allowed" in inner:  # one_of
        return {"enum": list(inner["allowed"])}
    if "count" in inner:  # numbers, positive_numbers
        limits = {"exclusiveMinimum": 0} if "positive" in function.__qualname__ else {}
        items = {"type": "number", **limits}
        return {"type": "array", "items": items, "minItems": inner["count"], "maxItems": inner["count"]}
    return schema_of(hint)


# The schemas of all YAML files.


_DIALECT = "https://json-schema.org/draft/2020-12/schema"
BLOCKS: dict[str, tuple[type[Block], str]] = {
    "rig": (rig_file._RigBlock, "rig.yaml: screens, cameras, beams and spots"),
    "run": (run_file._RunBlock, "run.yaml: one recording"),
    "camera": (camera_file._CameraFileBlock, "camera.yaml: the lens of a camera"),
    "board": (board_file._BoardBlock, "board.yaml: a calibration board"),
    "calibration": (Project, "calibration.yaml: the measurements of a calibration"),
    "screens": (rig_file.ScreensFileBlock, "screens.yaml: cameras and screens in one frame"),
}


def schema(name: str) -> Schema:
    """The JSON schema of a kind of file: a name of BLOCKS."""
    block, title = BLOCKS[name]
    out = schema_of_block(block)
    if name == "run":
        out["properties"]["tracker"] = {"anyOf": [_of_parameters(TrackerParameters), {"type": "null"}]}
    return {"$schema": _DIALECT, "title": title, **out}


def _of_parameters(cls: type) -> Schema:
    """The schema of a parameter dataclass, with the comments of its source as descriptions."""
    out = schema_of_block(block_of(cls), commented=cls)
    hints = typing.get_type_hints(cls)
    for field in dataclasses.fields(cls):
        if dataclasses.is_dataclass(hints[field.name]):
            out["properties"][field.name] = _of_parameters(typing.cast(type, hints[field.name]))
        elif field.name in out["properties"] and field.name in (comments := comments_of(cls)):
            out["properties"][field.name]["description"] = comments[field.name]
    return out


def as_text(name: str) -> str:
    """The schema as JSON text."""
    return json.dumps(schema(name), indent=1, ensure_ascii=False, default=_plain) + "\n"


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return dataclasses.asdict(value)
    raise TypeError(f"{value!r} has no JSON form")


def write(names: list[str], out: Path) -> list[Path]:
    """Write NAME.schema.json for each name into a folder, which is made if needed.

    Raises InputError: the folder cannot be made, or a file cannot be written.
    """
    made_folder(out)
    paths = [out / f"{name}.schema.json" for name in names]
    for name, path in zip(names, paths, strict=True):
        atomic_write_text(as_text(name), path)
    return paths
