"""A report of sections is one self-contained file of limited size with all findings; its drawings are well-formed."""

from __future__ import annotations

import datetime
import re
import xml.etree.ElementTree as ET
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from geometry.pose import Pose
from lab.calibrate.camera.camera_page import representative_views
from lab.calibrate.step import fingerprints_of_inputs, made_of
from lab.errors import InputError
from lab.findings.finding import Finding, Level, counted
from lab.report.calibration import calibration_drawings as draw
from lab.report.calibration import calibration_scene as scene
from lab.report.page import LARGEST_BYTES, Page, PageDrawing, PageTable, Section, cell, html_of, write_page
from lab.report.plot.maps import _enlarged, contour_levels, contour_lines, heat_map, value_range
from lab.report.plot.svg import image_area
from tests.geometry.scenes import paper_rig

SIZE = (640, 480)
RNG = np.random.default_rng(4)
CORNERS = RNG.uniform([0, 0], SIZE, (300, 2))
RESIDUALS = RNG.normal(0, 0.2, (300, 2))
HOLED = np.where(np.arange(300)[:, None] % 7 == 0, np.nan, CORNERS)
MAP = 0.02 + np.hypot(*np.meshgrid(np.linspace(-1, 1, 17), np.linspace(-1, 1, 13))) ** 3


def all_drawings() -> dict[str, str]:
    """One of each kind, with names that must be escaped and values that are missing."""
    holed = MAP.copy()
    holed[:3, :3] = np.nan
    photograph = RNG.integers(0, 255, (480, 640)).astype(np.uint8)
    rig = paper_rig()
    days = [datetime.date(2026, 1, 1 + 3 * i) for i in range(5)]
    rejected = np.arange(300) % 50 == 0
    things = scene.rig_things(rig, Pose.identity())
    A = RNG.normal(size=(6, 6))
    covariance = A @ A.T
    covariance[2] = covariance[:, 2] = 0.0
    return {
        "overlay": draw.corners_overlay(
            SIZE, CORNERS, RESIDUALS, "a <view> & b", picture=photograph, rejected=rejected
        ),
        "overlay without picture": draw.corners_overlay(SIZE, CORNERS[:2], RESIDUALS[:2], "v", labels=["<a>", "b"]),
        "field": draw.residual_field(SIZE, CORNERS, RESIDUALS),
        "field with holes": draw.residual_field(SIZE, HOLED, RESIDUALS),
        "field of none": draw.residual_field(SIZE, CORNERS[:0], RESIDUALS[:0]),
        "coverage": draw.coverage_map(SIZE, CORNERS, outlines_px=[CORNERS[:4]]),
        "coverage with holes": draw.coverage_map(SIZE, HOLED),
        "coverage of none": draw.coverage_map(SIZE, CORNERS[:0]),
        "tilt": draw.tilt_polar(np.array([10.0, 40, np.nan]), np.array([0.0, 90, 10])),
        "map": heat_map(holed, (0, 640, 0, 480), "uncertainty <px>", "px"),
        "map that rises upwards": heat_map(MAP - 1, (-1, 1, -1, 1), "t", "mm", y_down=False),
        "map of nothing": heat_map(np.full((3, 4), np.nan), (0, 1, 0, 1), "t", "px"),
        "histogram": draw.residual_histogram(RESIDUALS, sigma=0.2),
        "histogram of none": draw.residual_histogram(RESIDUALS[:0]),
        "ladder": draw.lens_model_chart(
            ["4 <&>", "5", "fisheye"], np.array([0.3, 0.2, np.nan]), 1, noise_px=np.array([0.3, 0.1, np.nan])
        ),
        "flatness": draw.flatness_map(
            RNG.normal(size=(40, 2)), RNG.normal(0, 1e-3, 40), size_m=(4, 3), bow=(1e-3, 0, 0)
        ),
        "correlations": draw.correlation_matrix(["fx", "<k1>", "fixed", "a", "b", "c"], covariance),
        "drift": draw.drift_chart(
            {"left": draw.DriftLine(days, np.array([0.1, np.nan, 0.2, 0.1, 0.3]), np.full(5, 0.1))},
            warn=0.2,
            fail=0.5,
            expires=datetime.date(2026, 2, 1),
        ),
        "one check": draw.drift_chart({"l & r": draw.DriftLine(days[:1], np.array([0.1]))}),
        **{f"scene {i}": s for i, s in enumerate(scene.scene_views(things))},
        "boards": scene.scene_view(
            [
                scene.Frustum("<c>", Pose.identity(), (0.5, 0.4)),
                scene.Rectangle("b", Pose.identity(), (1, 1)),
            ],
            "a <scene>",
            scene.LAB_VIEWS[0],
        ),
    }


DRAWINGS = all_drawings()


def report(sections: list[Section], findings: list[Finding] | None = None) -> Page:
    findings = findings if findings is not None else [Finding(Level.PASS, "fine")]
    figures = [("RMS <&>", "0.2 px", "0.5 mm")]
    return Page("camera", "left <b>", counted(findings), sections, figures, findings=findings, sentence="as it is")


@pytest.mark.parametrize("name", DRAWINGS)
def test_a_drawing_is_well_formed_and_has_a_title(name):
    root = ET.fromstring(DRAWINGS[name])
    assert root.tag == "svg"
    assert root.get("aria-label")
    assert root.find("title") is not None
    assert "nan" not in re.sub(r'href="data:[^"]*"', "", DRAWINGS[name])


@pytest.mark.parametrize("name", DRAWINGS)
def test_the_text_of_a_drawing_is_within_its_frame(name):
    _, _, width, height = (float(v) for v in ET.fromstring(DRAWINGS[name]).get("viewBox").split())
    assert 300 <= width <= 1200
    assert 60 <= height <= 800
    for place in ET.fromstring(DRAWINGS[name]).iter("text"):
        if place.get("transform") is None:
            assert -20 <= float(place.get("x")) <= width + 20
            assert -20 <= float(place.get("y")) <= height + 20


class _Tags(HTMLParser):
    """Checks that all tags are closed in order, and collects the resources that the page loads."""

    VOID = frozenset({"meta", "br", "link", "img", "input", "hr"})

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.loads: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.loads += [v for k, v in attrs if k in ("src", "href", "xlink:href", "data") and v]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.loads += [v for k, v in attrs if k in ("src", "href", "xlink:href", "data") and v]

    def handle_endtag(self, tag: str) -> None:
        assert self.open
        assert self.open.pop() == tag


def test_the_page_is_balanced_and_loads_no_external_resource():
    table = PageTable(("a", "b (px)"), [("x", 1.5), ("y", float("nan"))])
    html = html_of(report([Section("s", ["w"], [*map(PageDrawing, DRAWINGS.values()), "<p>plain</p>"], table)]))
    tags = _Tags()
    tags.feed(html)
    assert tags.open == []
    assert tags.loads
    assert all(u.startswith("data:image/") for u in tags.loads)
    outside = re.sub(r"data:image/[^\"]*", "", html)
    assert not re.search(r"https?://|url\(|@import|<script", outside)


def test_all_findings_are_shown_with_reason_and_remedy_the_worst_first():
    findings = [
        Finding(Level.PASS, "what-pass"),
        Finding(Level.WARN, "what-warn", "why-warn", "remedy-warn"),
        Finding(Level.FAIL, "what-fail", "why-fail", "remedy-fail"),
    ]
    html = html_of(report([], findings))
    places = [
        html.index(w)
        for w in ("what-fail", "why-fail", "remedy-fail", "what-warn", "why-warn", "remedy-warn", "what-pass")
    ]
    assert places == sorted(places)
    assert "1 failed, 1 warning, 1 passed" in html
    assert "<title>FAIL" in html


def test_what_the_command_line_shows_between_backticks_is_code_in_all_texts_of_a_finding():
    html = html_of(report([], [Finding(Level.FAIL, "the `what` <i>", "the `why`", "run `beampose doctor`")]))
    assert all(f"<code>{words}</code>" in html for words in ("what", "why", "beampose doctor"))
    assert "`" not in re.sub(r"<script.*?</script>|<style.*?</style>", "", html, flags=re.DOTALL)
    assert "<i>" not in html


def test_all_names_and_texts_are_escaped():
    evil = "<script>alert(1)</script>"
    finding = Finding(Level.WARN, evil, evil, evil)
    section = Section(evil, evil, [PageDrawing("<svg></svg>", evil)], PageTable((evil,), [(evil,)]))
    whole = Page(evil, evil, evil, [section], [(evil, evil, evil)], [evil], [(evil, evil)], [finding], evil)
    assert "<script" not in html_of(whole)


def test_a_report_of_400_views_stays_below_5_mb_and_keeps_its_table():
    photograph = RNG.integers(0, 255, (1024, 1280)).astype(np.uint8)  # noise: the worst case of JPEG
    one = draw.corners_overlay((1280, 1024), CORNERS, RESIDUALS, "view", picture=photograph)
    views = [PageDrawing(one, f"view {i}") for i in range(400)]
    rows = [(f"photograph-{i}", 0.2) for i in range(400)]
    html = html_of(report([Section("views", (), views, PageTable(("view", "RMS (px)"), rows))]))
    assert len(html.encode()) <= LARGEST_BYTES
    assert html.count("Picture omitted") > 100
    assert "<svg" in html  # some pictures remain
    assert all(f"photograph-{i}<" in html for i in range(400))


def test_the_representative_views_are_the_worst_the_median_and_the_best():
    rms = np.array([0.5, 0.1, 0.9, np.nan, 0.3, 0.7])
    assert dict(representative_views(rms, 2)) == {2: "worst", 5: "2. worst", 0: "median", 1: "best"}
    assert representative_views(np.full(3, np.nan)) == []
    assert [i for i, _ in representative_views(np.array([0.2]))] == [0]


def test_the_file_is_written_atomically_and_lists_its_inputs(tmp_path: Path):
    data = tmp_path / "photo.png"
    data.write_bytes(b"123")
    made = made_of(datetime.date(2026, 5, 1), fingerprints_of_inputs([data]))
    path = write_page(Page("beams", "x", "", [], made=made), tmp_path)
    assert path == tmp_path / "report.html"
    text = path.read_text(encoding="utf-8")
    assert "photo.png" in text
    assert "a665a45920422f9d" in text
    assert "2026-05-01" in text
    assert [p.name for p in tmp_path.iterdir() if p.name.endswith(".part")] == []
    with pytest.raises(InputError, match="cannot be read"):
        fingerprints_of_inputs([tmp_path / "missing.png"])


def test_an_uneven_table_is_refused():
    with pytest.raises(ValueError, match="2 cells"):
        PageTable(("a",), [("b", "c")])


@pytest.mark.parametrize(
    ("value", "shown"), [(0.123456, "0.1235"), (float("nan"), "–"), (None, "–"), (3, "3"), (True, "yes"), ("a", "a")]
)
def test_a_cell_shows_numbers_to_four_digits(value, shown):
    assert cell(value) == shown


def test_correlations_of_many_parameters_are_those_of_the_first_sixty():
    for count in (60, 61):
        drawn = draw.correlation_matrix([f"p{i:02d}" for i in range(count)], np.eye(count))
        assert [f">p{i:02d}<" in drawn for i in range(count)] == [True] * 60 + [False] * (count - 60)
        assert ("(the first 60)" in drawn) == (count > 60)


def test_contours_of_a_cone_lie_on_its_circles():
    x, y = np.linspace(-1, 1, 81), np.linspace(-1, 1, 61)
    X, Y = np.meshgrid(x, y)
    for level in (0.3, 0.6):
        (line,) = contour_lines(np.hypot(X, Y), x, y, level)
        assert np.array_equal(line[0], line[-1])
        assert np.abs(np.linalg.norm(line, axis=1) - level).max() < 2e-3  # chords of cells of 1/40
        assert np.linalg.norm(np.diff(line, axis=0), axis=1).sum() == pytest.approx(2 * np.pi * level, rel=5e-3)


def test_a_contour_line_ends_at_cells_without_a_value():
    x = y = np.arange(5.0)
    values = np.tile(x, (5, 1))
    values[2, 2] = np.nan
    lines = contour_lines(values, x, y, 1.5)
    assert sorted(float(np.ptp(line[:, 1])) for line in lines) == [1.0, 1.0]
    assert contour_lines(values[:1], x, y[:1], 1.5) == []


def test_levels_of_a_steep_map_crowd_where_it_is_low():
    assert contour_levels(0.02, 1.0).tolist() == pytest.approx([0.05, 0.1, 0.2, 0.5])
    assert value_range(np.array([1.0] * 99 + [1e6]), False)[1] < 10  # one runaway value does not drown the map


def test_a_field_of_view_begins_at_the_camera_and_its_corners_are_those_of_the_picture():
    camera = next(iter(paper_rig().cameras.values()))
    (width, height), K = camera.image_size_px, camera.matrix
    apex, *corners = scene.outline(scene.frustum_of(camera), 2.0)
    np.testing.assert_allclose(apex, camera.camera_from_world.inverse().translation, atol=1e-12)
    x, y, z = camera.camera_from_world.apply(np.array(corners)).T
    np.testing.assert_allclose(z, 2.0)
    np.testing.assert_allclose(K[0, 0] * x / z, width / 2 * np.array([-1, 1, 1, -1]))
    np.testing.assert_allclose(K[1, 1] * y / z, height / 2 * np.array([-1, -1, 1, 1]))
    wide = scene.Frustum("wide", Pose.identity(), (9.0, 0.5))
    assert np.ptp(scene.outline(wide, 1.0), axis=0).tolist() == [3.4, 1.0, 1.0]  # drawn with 120 degrees at most


def test_a_rectangle_has_its_size_about_its_centre():
    world_from_rectangle = Pose.from_ypr(np.array([0.3, 0.2, 0.1]), np.array([1.0, 2.0, 3.0]))
    rectangle = scene.Rectangle("r", world_from_rectangle, (3.0, 2.0))
    corners = world_from_rectangle.inverse().apply(scene.outline(rectangle, 1.0))
    np.testing.assert_allclose(corners - [-1.5, -1.0, 0.0], [[0, 0, 0], [3, 0, 0], [3, 2, 0], [0, 2, 0]], atol=1e-12)


def test_the_outlines_of_rays_trails_and_markers_are_their_own_places():
    a, b = np.array([1.0, 2.0, 3.0]), np.array([4.0, 5.0, 6.0])
    np.testing.assert_array_equal(scene.outline(scene.Ray("r", a, b), 1.0), [a, b])
    np.testing.assert_array_equal(scene.outline(scene.Trail("t", np.array([a, b, a])), 1.0), [a, b, a])
    np.testing.assert_array_equal(scene.outline(scene.Marker("m", b), 1.0), [b])


def test_the_cells_of_a_coverage_map_lie_where_their_corners_are():
    """All of them in the right half: its cells fill it, and those of the left half are crossed out."""
    u, v = np.meshgrid(np.arange(SIZE[0] / 2, SIZE[0], 4.0), np.arange(0.0, SIZE[1], 4.0))
    text = draw.coverage_map(SIZE, np.stack([u.ravel(), v.ravel()], axis=-1))
    found = re.findall(r'<rect x="([\d.]+)" y="([\d.]+)" width="([\d.]+)" height="([\d.]+)" fill="#', text)
    x, y, width, height = np.array(found, dtype=float).T
    left, top, wide, high = image_area(SIZE).box
    assert x.min() == pytest.approx(left + wide / 2, abs=0.2)
    assert np.max(x + width) == pytest.approx(left + wide, abs=0.2)
    assert (y.min(), np.max(y + height)) == (pytest.approx(top, abs=0.2), pytest.approx(top + high, abs=0.2))
    assert np.sum(width * height) == pytest.approx(wide * high / 2, rel=0.02)
    assert text.count('stroke-opacity="0.8"/>') == len(x)


def test_a_map_is_enlarged_between_its_values_and_has_no_value_where_none_is_near():
    u, v = np.meshgrid(np.arange(7.0), np.arange(5.0))
    values = 3 * u - 2 * v
    large = _enlarged(values)
    x = np.linspace(0, 6, large.shape[1]) * 3 - np.linspace(0, 4, large.shape[0])[:, None] * 2
    np.testing.assert_allclose(large, x, atol=0.1)  # cv2.remap has steps of 1/32 of a cell
    values[2, 3] = np.nan
    holed = _enlarged(values)
    hole = np.isnan(holed)
    assert 0.3 / 24 < hole.mean() < 1.0 / 24  # half a cell to each side, of 4 x 6
    np.testing.assert_allclose(holed[~hole], x[~hole], atol=2.5)
    assert np.isnan(_enlarged(np.full((5, 7), np.nan))).all()
