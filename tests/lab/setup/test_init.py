"""`beampose init`: the files pass `beampose check`, say what they are, and can be processed at once."""

from __future__ import annotations

import re

import click
import numpy as np
import pytest

from lab.commands import maintenance
from lab.errors import InputError
from lab.files.rig.rig_file import load_rig
from lab.runs.input_check import check
from lab.runs.process import process_run
from lab.setup.init import Layout, rig_of, start

LAYOUTS = [
    Layout(),
    Layout(cameras=1, screens=1, beams=3),
    Layout(cameras=4, screens=2, beams=5),
    Layout(cameras=5, screens=2, beams=2),
    Layout(cameras=4, screens=4, beams=4),
    Layout(cameras=3, screens=3, beams=8),
    Layout(distance_m=0.5, image_size_px=(640, 480)),
]


MANY_BEAMS = pytest.param(Layout(cameras=3, screens=3, beams=12), marks=pytest.mark.slow)


@pytest.mark.parametrize("layout", [*LAYOUTS, MANY_BEAMS], ids=str)
def test_the_files_pass_the_check_without_a_remark(tmp_path, layout):
    started = start(tmp_path / "lab", layout, 50.0)
    for path in (started.result, started.result / "rig.yaml"):
        result = check(path)
        assert (result.exit_status, result.lines[0].rsplit(": ", 1)[1]) == (0, "fine")


def test_the_rig_has_what_was_asked_for():
    for layout in LAYOUTS:
        rig = rig_of(layout)
        assert (len(rig.cameras), len(rig.screens), len(rig.beams)) == (layout.cameras, layout.screens, layout.beams)
        assert {c.screen for c in rig.cameras.values()} == set(rig.screens)
        for screen in rig.screens.values():
            pose = screen.world_from_screen
            assert np.linalg.norm(pose.translation) == pytest.approx(layout.distance_m)
            assert np.linalg.det(pose.rotation) == pytest.approx(1.0)


def test_the_files_are_commented_and_read_as_the_same_rig(tmp_path):
    started = start(tmp_path / "lab", Layout(), 50.0)
    for path, least in ((started.result / "rig.yaml", 10), (started.result / "run.yaml", 8)):
        text = path.read_text("utf-8")
        assert len(re.findall(r"^ *# ", text, re.MULTILINE)) >= least
        assert max(map(len, text.splitlines())) <= 140
    rig, wanted = load_rig(started.result / "rig.yaml"), rig_of(Layout())
    for name, beam in wanted.beams.items():
        assert rig.beams[name].direction == pytest.approx(beam.direction, abs=1e-12)


def test_the_simulated_points_are_processed_and_pass(tmp_path):
    started = start(tmp_path / "lab", Layout(), 100.0)
    assert process_run(started.result, tmp_path / "out").verdict.status == "pass"


def test_a_folder_with_files_is_left_alone(tmp_path):
    (tmp_path / "rig.yaml").write_text("mine")
    with pytest.raises(InputError, match="expected a new or empty folder, found files"):
        start(tmp_path, Layout(), 100.0)
    assert [p.name for p in tmp_path.iterdir()] == ["rig.yaml"]


@pytest.mark.parametrize(
    "layout",
    [Layout(cameras=1), Layout(beams=1), Layout(cameras=1, screens=1, beams=2), Layout(cameras=3, screens=3, beams=3)],
    ids=str,
)
def test_a_layout_that_cannot_measure_a_pose_is_refused(tmp_path, layout):
    with pytest.raises(InputError, match="expected at least"):
        start(tmp_path / "lab", layout, 100.0)
    assert not (tmp_path / "lab").exists()


NOTHING = {"screens": None, "cameras": None, "beams": None, "rate": None}


def test_without_a_terminal_nothing_is_asked_and_the_defaults_fit_each_other():
    assert maintenance._asked(NOTHING) == {"screens": 2, "cameras": 2, "beams": 3, "rate": 100.0}
    for screens in (1, 2, 3, 4):
        values = maintenance._asked({**NOTHING, "screens": screens})
        rig_of(Layout(int(values["cameras"]), screens, int(values["beams"])))


def test_on_a_terminal_only_what_is_not_given_is_asked(monkeypatch):
    asked = []

    def answer(question, default, type):
        asked.append(question)
        return type(7)

    monkeypatch.setattr(maintenance, "_on_a_terminal", lambda: True)
    monkeypatch.setattr(click, "prompt", answer)
    assert maintenance._asked({**NOTHING, "screens": 2, "rate": 25.0}) == {
        "screens": 2, "cameras": 7, "beams": 7, "rate": 25.0,
    }  # fmt: skip
    assert len(asked) == 2
