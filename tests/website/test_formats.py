"""docs/formats.md describes the files as the program writes them."""

from __future__ import annotations

import re

import pytest

from lab.calibrate.beams.beams_page import ANGLE_COLUMNS
from lab.calibrate.camera.camera import CORNER_COLUMNS
from lab.calibrate.drift_check import drift_check, drift_comparison
from lab.calibrate.rig import rig
from lab.calibrate.screens.screen import DOT_COLUMNS
from lab.files.project.point_files import POINTS, POSE_SIGMAS, SURVEY, SURVEY_SIGMAS
from lab.files.text import columns
from lab.files.text.yaml_text import parse_mapping
from lab.results.compare_page import ALLAN, DIFFERENCES
from lab.runs.batch import task
from lab.setup.schema import schema
from tests.paths import ROOT
from tracking.statuses import PoseStatus, SpotStatus

TEXT = (ROOT / "docs" / "formats.md").read_text(encoding="utf-8")
TABLES = {
    "attitude": columns.ATTITUDE,
    "covariance": columns.COVARIANCE,
    "beams": columns.BEAMS,
    "spots": columns.SPOTS,
    # The time only with clocks of single cameras, the likeness only of `detect`.
    "detections": (*columns.DETECTIONS, columns.PICTURE_TIME, columns.LIKENESS),
    "times": columns.TIMES,
    "truth-pose": columns.TRUTH_POSE,
    "truth-spots": columns.TRUTH_SPOTS,
    "batch": task.COLUMNS,
    "differences": DIFFERENCES,
    "allan": ALLAN,
    "survey": (*SURVEY, *SURVEY_SIGMAS, "screen"),
    "points": (*POINTS, "sigma_px"),
    "poses": POSE_SIGMAS,
    "drift": drift_check.COLUMNS,
}
LISTS = {
    "corners.csv": CORNER_COLUMNS,
    "residuals.csv": rig.COLUMNS,
    "dots.csv": DOT_COLUMNS,
    "angles.csv": ANGLE_COLUMNS,
    "--history": drift_comparison.HISTORY_COLUMNS,
}


def section(name: str) -> str:
    """The text below the heading with this anchor."""
    return re.split(r"^#", TEXT.split(f"{{ #{name} }}\n")[1], flags=re.MULTILINE)[0]


@pytest.mark.parametrize("name", TABLES)
def test_the_columns_of_a_table_are_described_in_their_order(name):
    table = section(name).split("| column |")[1].split("\n\n")[0]
    cells = [row.split(" | ")[0] for row in table.splitlines()[2:]]
    assert re.findall(r"`(\w+)`", " ".join(cells)) == list(TABLES[name])


@pytest.mark.parametrize("name", LISTS)
def test_the_columns_of_a_small_table_are_listed_in_their_order(name):
    line = next(line for line in TEXT.splitlines() if line.startswith((f"| `{name}`", f"`{name}`")))
    named = [word for word in re.findall(r"`(\w+)`", line) if word in LISTS[name]]
    assert named == list(LISTS[name])


@pytest.mark.parametrize("status", [*SpotStatus, *PoseStatus])
def test_every_status_is_explained_as_in_the_program(status):
    assert f"| `{status}` | {status.meaning} |" in TEXT


@pytest.mark.parametrize("name", ["rig", "run"])
def test_the_examples_of_rig_and_run_fit_their_schemas(name):
    jsonschema = pytest.importorskip("jsonschema", reason="jsonschema is not installed")

    example = re.search(rf"```yaml\n(schema: beampose/{name}/1\n.*?)```", TEXT, re.DOTALL)[1]
    jsonschema.validate(parse_mapping(example, "docs/formats.md"), schema(name))
