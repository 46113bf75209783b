"""`beampose init`: the files pass `beampose check`, say what they are, and can be processed at once."""

from __future__ import annotations

import re

import click
import numpy as np
import pytest

from lab.commands import setup
from lab.errors import InputError
from lab.files.rig.rig_file import load_rig
from lab.runs.input_check import check
from lab.runs.process import process_run
from lab.setup.init import Layout, rig_of, start
from tests.lab.command import typed
from tests.marks import further_slow

LAYOUTS = [
    Layout(),
    Layout(cameras=1, screens=1, beams=3),
    Layout(cameras=4, screens=2, beams=5),
    Layout(cameras=5, screens=2, beams=2),
    Layout(cameras=4, screens=4, beams=4),
    Layout(cameras=3, screens=3, beams=8),
    Layout(distance_m=0.5, image_size_px=(640, 480)),
]


MANY_BEAMS = [Layout(cameras=3, screens=3, beams=12), Layout(cameras=4, screens=2, beams=5)]


@pytest.mark.parametrize(
    "layout", further_slow([*(layout for layout in LAYOUTS if layout.beams != 5), *MANY_BEAMS], fast=2), ids=str
)
def test_the_files_pass_the_check_without_a_remark(tmp_path, layout):
    started = start(tmp_path / "lab", layout, 50.0)
    for path in (started.result, *([started.result / "rig.yaml"] if layout == Layout() else [])):
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
    assert setup._asked(NOTHING) == {"screens": 2, "cameras": 2, "beams": 3, "rate": 100.0}
    for screens in (1, 2, 3, 4):
        values = setup._asked({**NOTHING, "screens": screens})
        rig_of(Layout(int(values["cameras"]), screens, int(values["beams"])))


def test_on_a_terminal_only_what_is_not_given_is_asked(monkeypatch):
    asked = []

    def answer(question, default, type):
        asked.append(question)
        return type(7)

    monkeypatch.setattr(setup, "_on_a_terminal", lambda: True)
    monkeypatch.setattr(click, "prompt", answer)
    assert setup._asked({**NOTHING, "screens": 2, "rate": 25.0}) == {
        "screens": 2, "cameras": 7, "beams": 7, "rate": 25.0,
    }  # fmt: skip
    assert len(asked) == 2


WALL = "wall={corner_m: [[-2,2.5,0],[2,2.5,0],[-2,2.5,3]]}"
CEILING = "ceiling={yaw_pitch_roll_deg: [0,0,0], translation_m: [0,0.5,3], size_m: [4,3]}"
FRONT = "front={screen: wall, look_at: {eye_m: [0.5,-1.5,1.2], target_m: [0,2.5,1.5]}, field_of_view_deg: 55}"
UP = "up={screen: ceiling, look_at: {eye_m: [0.5,0.5,0.2], target_m: [0,0.5,3], up: [0,1,0]}, focal_px: 914}"
BEAMS = [
    "A={points_m: [[0,0,0],[0.1,1,0.05]], plus: wall}",
    "B={points_m: [[0,0,0],[-0.2,1,0.1]], plus: wall}",
    "C={points_m: [[0,0,0],[0.25,0.1,1]], plus: ceiling}",
    "D={direction: [-0.2,-0.05,1], point_m: [0,0,0], plus: ceiling}",
    "E={azimuth_elevation_deg: [70,5], point_m: [0,0,0], plus: wall}",
]


def own_arguments(folder, screens=(WALL, CEILING), cameras=(FRONT, UP), beams=BEAMS):
    out = ["init", str(folder)]
    for option, parts in (("--screen", screens), ("--camera", cameras), ("--beam", beams)):
        out += [word for part in parts for word in (option, part)]
    return out


def test_a_rig_of_ones_own_is_what_was_measured_and_says_and_draws_it(tmp_path):
    done = typed(*own_arguments(tmp_path / "lab"))
    assert done.exit_code == 0, done.output
    assert "screen wall: 4 x 3 m, middle at (0, 2.5, 1.5) m, normal (0, -1, 0)" in done.output
    assert (
        "camera front: at (0.5, -1.5, 1.2) m, looks along (-0.124, 0.99, 0.0742), 55 deg wide, 4.04 m from"
        in done.output
    )
    assert "beam D: along (-0.196, -0.049, 0.979) of the vehicle, to ceiling (spot 4)" in done.output
    rig = load_rig(tmp_path / "lab" / "rig.yaml")
    np.testing.assert_allclose(
        rig.screens["wall"].world_from_screen.apply(np.array([-2, -1.5, 0])), [-2, 2.5, 0], atol=1e-12
    )
    np.testing.assert_allclose(
        rig.cameras["front"].camera_from_world.inverse().translation, [0.5, -1.5, 1.2], atol=1e-12
    )
    middle = rig.cameras["front"].project(np.array([[0.0, 2.5, 1.5]]))
    np.testing.assert_allclose(np.ravel(middle)[:2], [639.5, 511.5], atol=1e-9)
    width = 2 * np.degrees(np.arctan(640 / rig.cameras["front"].matrix[0, 0]))
    assert width == pytest.approx(55, abs=0.01)
    assert (rig.spots["4"].beam, rig.spots["4"].sign, rig.spots["4"].screen) == ("D", 1, "ceiling")
    page = (tmp_path / "lab" / "rig.html").read_text()
    assert "grey box of" in page
    assert '<div class="controls" hidden>' in page
    assert "# measured as {corner_m" in (tmp_path / "lab" / "rig.yaml").read_text()
    assert check(tmp_path / "lab").exit_status == 0


def test_questions_in_plain_words_give_the_same_rig_as_options(monkeypatch, tmp_path):
    monkeypatch.setattr(setup, "_on_a_terminal", lambda: True)
    answers = [
        "2", "2", "2", "100",
        "wall", "-2 2.5 0", "2, 2.5, 0", "-2 2.5 x", "-2 2.5 3",  # one is no number: asked again
        "ceiling", "-2 -1 3", "2 -1 3", "-2 2 3",
        "front", "wal", "wall", "0.5 -1.5 1.2", "0 2.5 1.5", "55",  # no such screen: asked again
        "up", "ceiling", "0.5 0.5 0.2", "0.5 0.5 3", "70", "0 1 0",
        "A", "0 0 0", "0.1 1 0.05", "wall", "",
        "C", "0 0 0", "0.25 0.1 1", "ceiling", "wall",
    ]  # fmt: skip
    arguments = ["init", str(tmp_path / "asked"), "--own"]
    done = typed(*arguments, input="\n".join(answers) + "\n")
    assert done.exit_code == 0, done.output
    assert "expected 3 numbers, got '-2 2.5 x'; wall: the next corner along its height, x y z in m" in done.output
    assert "'wal' is none of wall, ceiling; front: the screen that it films" in done.output
    assert "it looks up or down: the direction that is up in its picture" in done.output
    asked = load_rig(tmp_path / "asked" / "rig.yaml")
    ceiling = "ceiling={corner_m: [[-2,-1,3],[2,-1,3],[-2,2,3]]}"
    look_at = "{eye_m: [0.5,0.5,0.2], target_m: [0.5,0.5,3], up: [0,1,0]}"
    up = f"up={{screen: ceiling, look_at: {look_at}, field_of_view_deg: 70}}"
    beams = [BEAMS[0], "C={points_m: [[0,0,0],[0.25,0.1,1]], plus: ceiling, minus: wall}"]
    done = typed(*own_arguments(tmp_path / "given", (WALL, ceiling), (FRONT, up), beams))
    assert done.exit_code == 0, done.output
    assert (tmp_path / "asked/rig.yaml").read_text() == (tmp_path / "given/rig.yaml").read_text()
    ends = [(spot.beam, spot.sign, spot.screen) for spot in asked.spots.values()]
    assert ends == [("A", 1, "wall"), ("C", -1, "wall"), ("C", 1, "ceiling")]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"screens": ("wall",)}, "--screen: expected NAME={...}"),
        ({"screens": ("wall={corners: 3}",)}, "screens.wall: unknown field 'corners'; did you mean 'corner_m'?"),
        (
            {"screens": ("wall={corner_m: [[0,0,0],[1,0,0]]}",)},
            "rig: screens.wall.world_from_screen.corner_m:",
        ),
        ({"cameras": ()}, "expected at least one --screen, --camera and --beam each"),
        (
            {"cameras": ("a={screen: wall, look_at: {eye_m: [0,0,0], target_m: [0,1,0]}}",)},
            "expected field_of_view_deg or",
        ),
        (
            {"cameras": (FRONT.replace("wall", "wal"), UP)},
            "rig: cameras.front.screen: expected a screen of this file, got 'wal'",
        ),
        ({"beams": [*BEAMS[1:], "A={points_m: [[0,0,0],[0,1,0]], plus: floor}"]}, "screen of this file, got 'floor'"),
    ],
)
def test_a_mistake_in_a_part_names_its_place(tmp_path, change, words):
    done = typed(*own_arguments(tmp_path / "lab", **change))
    assert done.exit_code == 2
    assert words in done.output
    assert not (tmp_path / "lab").exists()
