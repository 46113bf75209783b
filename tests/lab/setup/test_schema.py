"""JSON schemas: they accept every file that beampose reads here, and reject the mistakes that an editor should show."""

from __future__ import annotations

import copy
import json
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from jsonschema import Draft202012Validator

from calibration.boards import board_types
from lab.errors import InputError
from lab.files.rig import board_file
from lab.files.rig.rig_file import RigFile, load_rig_file, save_screens
from lab.files.text.yaml_text import parse_mapping, read_mapping
from lab.setup import schema as files
from lab.setup.schema import BLOCKS, as_text, schema
from tests.lab.run_folders import RIG, RUN
from tests.paths import ROOT

SAMPLES = sorted((ROOT / "sample_runs").rglob("*.yaml"))
MAX_LEAVES = 150  # of one file that are made wrong, one after the other


@cache
def validator_of(name: str) -> Draft202012Validator:
    return Draft202012Validator(schema(name))


def kind_of(content: dict[str, Any]) -> str:
    return content["schema"].split("/")[1]


def contents() -> dict[str, dict[str, Any]]:
    """A file of every kind, and more of those that samples have."""
    out = {p.relative_to(ROOT).as_posix(): read_mapping(p) for p in SAMPLES}
    out |= {"rig": parse_mapping(RIG, "rig"), "run": parse_mapping(RUN, "run")}
    out["rig in measured forms"] = measured = copy.deepcopy(out["rig"])
    measured["screens"]["left"]["world_from_screen"] = {"corner_m": [[0, 0, 0], [1, 0, 0], [0, 1, 0]]}
    turned = {"rotation_matrix": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "translation_m": [0, 0, 0]}
    measured["screens"]["right"]["world_from_screen"] = turned
    measured["cameras"]["left"]["camera_from_world"] = {"look_at": {"eye_m": [0, 0, 0], "target_m": [1, 0, 0]}}
    measured["target"]["beams"]["A"] = {"points_m": [[0, 0, 0], [1, 0, 0]]}
    measured["target"]["beams"]["B"] = {"azimuth_elevation_deg": [20, 0], "point_m": [0, 0, 0]}
    out["run with settings"] = {**out["run"], "tracker": {"r1_px": 12, "detect": {"threshold_sigma": 5}}}
    for name, example in board_types.EXAMPLES.items():
        out[f"board {name}"] = board_file.as_mapping(board_types.parse(example.split(" ")[0]))
    return out


CONTENTS = contents()


@pytest.mark.parametrize("name", CONTENTS)
def test_every_file_that_is_read_here_is_valid(name):
    content = CONTENTS[name]
    errors = [e.message for e in validator_of(kind_of(content)).iter_errors(content)]
    assert errors == []


def test_there_is_a_file_of_every_kind(tmp_path):
    rig = load_rig_file(next(p for p in SAMPLES if p.name == "rig.yaml")).rig
    save_screens("lab", RigFile(rig), tmp_path / "screens.yaml")
    content = read_mapping(tmp_path / "screens.yaml")
    assert [e.message for e in validator_of("screens").iter_errors(content)] == []
    assert {kind_of(c) for c in CONTENTS.values()} | {"screens"} == set(BLOCKS)


def leaves(content: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    if isinstance(content, dict) and content:
        for key, value in content.items():
            yield from leaves(value, (*path, key))
    else:
        yield path


def changed(content: dict[str, Any], path: tuple[Any, ...], value: Any) -> dict[str, Any]:
    out = copy.deepcopy(content)
    inner = out
    for key in path[:-1]:
        inner = inner[key]
    inner[path[-1]] = value
    return out


@pytest.mark.parametrize("name", CONTENTS)
def test_a_value_of_a_wrong_type_is_rejected_wherever_it_is(name):
    content = CONTENTS[name]
    validator = validator_of(kind_of(content))
    paths = list(leaves(content))[:MAX_LEAVES]
    assert [p for p in paths if validator.is_valid(changed(content, p, {"nonsense": [1]}))] == []


@pytest.mark.parametrize("name", CONTENTS)
def test_an_unknown_key_and_a_missing_schema_are_rejected(name):
    content = CONTENTS[name]
    validator = validator_of(kind_of(content))
    assert not validator.is_valid({**content, "colour": "red"})
    assert not validator.is_valid({k: v for k, v in content.items() if k != "schema"})


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (("frame_rate_hz",), 0),
        (("prior", "within_deg"), 181),
        (("prior", "position_m"), [0, 0]),
        (("tracker",), {"r1_pz": 3}),
        (("tracker",), {"method": "other"}),
        (("cameras", "left"), {"frame": "x"}),
    ],
)
def test_mistakes_in_a_run_are_rejected(path, value):
    assert not validator_of("run").is_valid(changed(CONTENTS["run"], path, value))


def empty(tree: Any, where: str = "") -> Iterator[str]:
    """The places of a schema that accept anything."""
    if isinstance(tree, dict):
        for key, value in tree.get("properties", {}).items():
            yield from (
                [f"{where}.{key}"] if not set(value) - {"description", "default"} else empty(value, f"{where}.{key}")
            )
        for value in [tree[k] for k in ("items", "additionalProperties") if isinstance(tree.get(k), dict)]:
            yield from [where] if not value else empty(value, where)
        for value in tree.get("anyOf", []):
            yield from [where] if not value else empty(value, where)


@pytest.mark.parametrize("name", BLOCKS)
def test_every_field_has_a_type(name):
    assert list(empty(schema(name))) == []


def test_a_field_that_accepts_anything_is_found():
    assert list(empty({"properties": {"a": {"type": "object", "properties": {"b": {"default": 1}}}}})) == [".a.b"]


@pytest.mark.parametrize("name", BLOCKS)
def test_a_schema_is_a_valid_schema_and_plain_json(name):
    content = json.loads(as_text(name))
    Draft202012Validator.check_schema(content)
    assert "schema" in content["required"]


def test_parameters_are_described_as_in_the_code():
    tracker = schema("run")["properties"]["tracker"]["anyOf"][0]["properties"]
    assert tracker["r1_px"]["description"].startswith("r1, px: radius of the first search")
    assert tracker["detect"]["properties"]["threshold_sigma"]["default"] == 6.0


def test_the_comment_of_a_field_stands_in_its_line_where_the_schema_finds_it():
    """The formatter moves the comment of a line that is too long into brackets."""
    wrapped = re.compile(r"^    (\w+): [^\n]*= \(\n[^\n]*#", re.MULTILINE)
    files_of_fields = [*(ROOT / "lab" / "files").rglob("*.py"), *(ROOT / "tracking").rglob("*.py")]
    assert {p.name: names for p in files_of_fields if (names := wrapped.findall(p.read_text("utf-8")))} == {}
    assert "receiving surface" in as_text("calibration")


def test_the_schemas_are_written_into_a_folder(tmp_path: Path):
    paths = files.write(list(BLOCKS), tmp_path / "made" / "here")
    assert [p.name for p in paths] == [f"{name}.schema.json" for name in BLOCKS]
    assert all(json.loads(p.read_text("utf-8"))["type"] == "object" for p in paths)
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="found a file"):
        files.write(["rig"], tmp_path / "file")


@pytest.mark.parametrize("name", BLOCKS)
def test_a_remark_for_the_linter_is_no_description(name):
    assert "noqa" not in as_text(name)
