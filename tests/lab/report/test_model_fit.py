"""The report's section on the model check is complete, and is written for damaged summaries too."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from lab.findings.finding import Level
from lab.report.run import trust
from lab.report.run.page import write_report
from lab.report.run.trust import HEADS, model_fit
from lab.report.summary import summary_of
from lab.runs.model_check.check import check_model
from tests.calibration.model_check.model_scenes import changed, recorded
from tests.lab.fake_results import make


def block(really=None, frames: int = 300) -> dict[str, object]:
    """The content of summary.json on a recording, read back."""
    run, recording = recorded("smooth", 5, frames=frames, really=really, predicted=True)
    return {"model_check": json.loads(json.dumps(check_model(run.rig, recording).as_mapping()))}


@pytest.fixture(scope="module")
def moved_screen() -> dict[str, object]:
    return block(changed("screens.right.x_m", 8e-3))


def test_findings_come_first_and_every_spot_camera_and_beam_has_a_row(moved_screen):
    fit = model_fit(moved_screen["model_check"])
    assert fit is not None
    assert fit.sentence == "Probably not (300 frames, evenly spaced):"
    assert [f.level.word for f in fit.findings] == ["fail"]
    assert "screen `right` may have moved" in fit.findings[0].what
    assert [row[:2] for row in fit.rows[:6]] == [(s, "left" if int(s) < 4 else "right") for s in "123456"]
    assert [row[0] for row in fit.rows[6:]] == [
        "all of camera left", "all of camera right", "all of beam A", "all of beam B", "all of beam C",
    ]  # fmt: skip
    assert all(len(row) == len(HEADS) for row in fit.rows)
    line = trust._model(fit)
    assert (line.level, line.name) == (Level.FAIL, "Fit of rig and recording")
    assert line.text.startswith("the residuals do not fit the rig (300 frames tested): screen `right` may have moved")
    assert "Spot 6" not in line.text  # a line; the finding has the rest
    assert ". Spot 6 in camera `right` lies" in fit.findings[0].what


def test_each_camera_has_a_drawing_with_arrows_along_the_mean_residuals(moved_screen):
    fit = model_fit(moved_screen["model_check"])
    assert fit is not None
    assert len(fit.drawings) == 2
    views = {v["name"]: v for v in moved_screen["model_check"]["views"]}
    six = fit.drawings[1].split("<title>spot 6:")[1]
    x0, y0, x1, y1 = (float(x) for x in six.split('<path d="M')[1].split('"')[0].replace("L", " ").split())
    drawn, mean = np.array([x1 - x0, y1 - y0]), np.array(views["right/6"]["mean_px"])
    assert np.linalg.norm(drawn) > 10
    assert drawn @ mean / np.linalg.norm(drawn) / np.linalg.norm(mean) > 0.99


def test_a_correct_rig_is_reported_to_fit():
    fit = model_fit(block()["model_check"])
    assert fit is not None
    assert fit.sentence.startswith("Yes: ")
    assert fit.findings == ()


def test_the_reason_is_given_if_the_model_was_not_tested():
    fit = model_fit(block(frames=20)["model_check"])
    assert fit is not None
    assert fit.sentence == "Not tested: 20 frames have 3 and more spots measured; the test needs 30."


@pytest.mark.parametrize(
    "summary",
    [
        {"model_check": {}},
        {"model_check": {"tested": True, "findings": None, "views": "?", "image_sizes_px": {"left": None}}},
        {
            "model_check": {
                "tested": True,
                "findings": [{}],
                "views": [{"name": "left/1", "nis": {}, "mean_px": [None]}],
            }
        },
    ],
)
def test_a_damaged_summary_gives_an_incomplete_section_and_no_error(summary):
    assert model_fit(summary_of(summary).model_check) is not None


def test_a_summary_of_an_older_run_has_no_section():
    assert model_fit(summary_of({}).model_check) is None
    assert model_fit(summary_of({"model_check": None}).model_check) is None


def test_the_section_is_in_the_report_but_not_in_that_of_older_results(tmp_path: Path, moved_screen):
    fake = make(tmp_path, 60)
    title = "Does the rig fit the recording?"
    assert title not in write_report(fake.results).read_text(encoding="utf-8")
    path = fake.results / "summary.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | moved_screen))
    page = write_report(fake.results).read_text(encoding="utf-8")
    assert title in page
    assert page.index(title) < page.index("<h2>Residuals</h2>")
    assert "screen `right` may have moved" in page
    assert page.count("mean residual of each spot") == 2
