"""The schemas of all YAML files."""

from __future__ import annotations

import dataclasses
import json
import typing
from pathlib import Path
from typing import Any

from lab.errors import InputError
from lab.files.project.project_blocks import ProjectBlock
from lab.files.rig import board_file, camera_file, rig_file, screens_file
from lab.files.run import run_file
from lab.files.text.atomic_write import atomic_write_text
from lab.files.text.dataclass_fields import block_of
from lab.files.text.fields import Block
from lab.schema.json_schema import Schema, comments_of, schema_of_block
from tracking.parameters import TrackerParameters

_DIALECT = "https://json-schema.org/draft/2020-12/schema"
BLOCKS: dict[str, tuple[type[Block], str]] = {
    "rig": (rig_file._RigBlock, "rig.yaml: screens, cameras, beams and spots"),
    "run": (run_file._RunBlock, "run.yaml: one recording"),
    "camera": (camera_file._CameraFileBlock, "camera.yaml: the lens of a camera"),
    "board": (board_file._BoardBlock, "board.yaml: a calibration board"),
    "calibration": (ProjectBlock, "calibration.yaml: the measurements of a calibration"),
    "screens": (screens_file._ScreensBlock, "screens.yaml: cameras and screens in one frame"),
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

    Raises:
        InputError: the folder cannot be made, or a file cannot be written.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{out}: the folder cannot be made: {error.strerror}; choose another --out") from None
    paths = [out / f"{name}.schema.json" for name in names]
    for name, path in zip(names, paths, strict=True):
        atomic_write_text(as_text(name), path)
    return paths
