"""A report is one self-contained, complete file, and is written for incomplete or poor results too."""

from __future__ import annotations

import base64
import csv
import itertools
import json
import re
import shutil
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pytest

from lab import number_format
from lab.errors import InputError
from lab.files.run.results import read_poses
from lab.report.frames.canvas import Canvas, bgr
from lab.report.index import write_index
from lab.report.plot import svg
from lab.report.plot.series import Line, Shade, time_panel
from lab.report.plot.svg import BLUE, SPOT_COLOURS, grey_limits, line_path, stretched, tick_texts, ticks
from lab.report.run import tables
from lab.report.run.events import MOST_PICTURES, events, selected
from lab.report.run.page import write_report
from lab.report.run.report_data import read_report_data
from lab.report.summary import summary_of, verdict_of
from tests.lab.fake_results import Fake, make
from tracking.statuses import PoseStatus, SpotStatus


@pytest.fixture(scope="module")
def fake(tmp_path_factory: pytest.TempPathFactory) -> Fake:
    return make(tmp_path_factory.mktemp("run"), 300)


@pytest.fixture(scope="module")
def page(fake: Fake) -> str:
    return write_report(fake.results).read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def filmed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Fake, str]:
    """With pictures; that of frame 8 of the left camera is cut short, and its rows say no_image."""
    fake = make(tmp_path_factory.mktemp("filmed"), 12, pictures=True)
    path = fake.results / "spots.csv"
    lines = path.read_text().splitlines()
    damaged = [
        re.sub(r"matched", "no_image", line) if line.startswith("8,") and ",left," in line else line for line in lines
    ]
    path.write_text("\n".join(damaged) + "\n")
    return fake, write_report(fake.results).read_text(encoding="utf-8")


class _Balance(HTMLParser):
    """Whether every tag that opens is closed, in order."""

    VOID = frozenset({"meta", "br", "link", "img", "input", "hr"})

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        pass

    def handle_endtag(self, tag: str) -> None:
        assert self.open, f"</{tag}> closes nothing"
        assert self.open.pop() == tag


def assert_well_formed(html: str) -> None:
    parser = _Balance()
    parser.feed(html)
    parser.close()
    assert parser.open == []


def test_a_report_loads_nothing_from_outside(filmed):
    html = filmed[1]
    for found in re.findall(r"""(?:src|href|url|action)\s*[=(]\s*["']?([^"')\s>]+)""", html):
        assert found.startswith(("data:image/", "#")), found
    assert "@import" not in html
    assert "fetch(" not in html


def test_a_report_has_every_part(page):
    for head in ("Attitude and position", "Spots over the picture", "Status over time", "Residuals", "Events",
                 "Errors against truth", "Provenance", "Input fingerprints", "Method"):  # fmt: skip
        assert head in page
    meanings = [s.meaning_for("spots") for s in SpotStatus] + [s.meaning for s in PoseStatus]
    assert all(meaning in page.replace("&#39;", "'") for meaning in meanings)
    assert "ab" * 32 in page
    assert "tracker.r1_px" in page
    assert_well_formed(page)


def test_markup_in_the_users_texts_is_escaped(page):
    assert "fake &lt;yaw &amp; bend&gt;" in page
    assert "A note with &lt;b&gt;markup&lt;/b&gt; &amp; an ampersand." in page
    assert "<yaw" not in page
    assert "<b>markup" not in page


def test_markup_in_names_of_spots_and_cameras_is_escaped(fake, tmp_path):
    shutil.copytree(fake.results, tmp_path / "results")
    path = tmp_path / "results" / "spots.csv"
    path.write_text(path.read_text().replace(",left,1,", ",left,<script>1,"))
    html = write_report(tmp_path / "results").read_text(encoding="utf-8")
    assert "&lt;script&gt;1" in html
    assert "<script>1" not in html
    assert_well_formed(html)


def test_the_same_results_give_the_same_report(fake, page):
    assert write_report(fake.results).read_text(encoding="utf-8") == page


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ({"n_frames": 1}, "PASS"),
        ({"n_frames": 3}, "PASS"),
        ({"n_frames": 150, "truth": False}, "The run has no truth"),
        ({"n_frames": 60, "all_lost": True}, "No frame has a pose"),
        ({"n_frames": 150, "n_cameras": 1}, "1 camera (left)"),
    ],
    ids=["one frame", "three frames", "no truth", "all lost", "one camera"],
)
@pytest.mark.filterwarnings("error")
def test_a_report_is_written_for_poor_results_too(tmp_path, kind, words):
    html = write_report(make(tmp_path, **kind).results).read_text(encoding="utf-8")
    assert words in html
    assert_well_formed(html)
    assert not re.search(r'[ "M]-?(nan|inf)\b', re.sub(r"<title>.*?</title>", "", html))


def test_a_report_is_written_from_the_tables_alone_and_names_what_is_missing(tmp_path):
    fake = make(tmp_path, 50)
    shutil.rmtree(fake.run_folder)
    for given in (None, fake.run_folder):
        html = write_report(fake.results, given).read_text(encoding="utf-8")
        assert "The run folder could not be read" in html
    (fake.results / "summary.json").unlink()
    html = write_report(fake.results).read_text(encoding="utf-8")
    assert "NO VERDICT" in html
    assert "summary.json is missing" in html


def test_the_report_of_a_smoothed_run_also_shows_the_causal_errors(tmp_path, page):
    html = write_report(make(tmp_path, 120, causal=True).results).read_text(encoding="utf-8")
    assert html.count("causal minus truth</title>") == 6
    assert "median, smoothed; causal" in html
    assert "RMS, smoothed; causal" in html
    assert "Bierman (1973)" in html
    assert_well_formed(html)
    for words in ("causal minus", "median, smoothed", "Bierman"):  # of a run that was not smoothed
        assert words not in page


def test_velocity_and_rate_have_a_panel_and_a_band_each(fake, page):
    for name in ("velocity x", "velocity y", "velocity z", "rate x", "rate y", "rate z"):
        assert f"<title>{name}</title>" in page
        assert f"<title>{name}: \u00b1\u03c3, \u00b13\u03c3 and error</title>" in page
    assert "against differences of the true poses" in page


def test_the_report_counts_doubtful_and_changed_labels(fake, tmp_path):
    shutil.copytree(fake.results, tmp_path / "results")
    spots = tmp_path / "results" / "spots.csv"
    lines = spots.read_text().splitlines()
    doubtful = [i for i, line in enumerate(lines) if ",occluded," in line][:3]
    for i in doubtful:
        lines[i] += "0.6"  # there was a detection, but its label was not likely enough
    spots.write_text("\n".join(lines) + "\n")
    path = tmp_path / "results" / "summary.json"
    summary = json.loads(path.read_text())
    summary["counts"]["events"] = {"changed": 4, "tie": 1, "reacquired": 2, "labelled": 1}
    open_for_long = {"frame": 20, "last_frame": 24, "kind": "undecided", "camera": "left", "spot": "1", "text": "open"}
    path.write_text(json.dumps(summary | {"events": [open_for_long]}))
    html = write_report(tmp_path / "results").read_text(encoding="utf-8")
    assert len(doubtful) == 3
    assert "Labels: 3 left open: no label was likely enough; 4 changed by the smoothing pass" in html
    assert "1 ties, in which" in html
    assert "2 times the vehicle was found again" in html
    assert "<td>spot 1: open, for 5 frames</td>" in html


def test_residuals_are_compared_with_their_variance_after_the_fit_of_the_pose(fake):
    material = read_report_data(fake.results, None)
    shares = (material.residual_px / material.spots.sigma_px) ** 2
    # These poses are drawn independently of the measured places: residuals are larger than after a fit.
    assert np.nanmean(shares) > 1.0
    assert material.residual_share == pytest.approx(
        1 - 6 / 12, abs=0.1
    )  # a fit of 6 parameters to 6 spots, 12 coordinates


def test_frames_without_a_picture_are_listed_as_ranges(fake, page):
    first, last = json.loads((fake.results / "summary.json").read_text())["counts"]["no_image"]["left"][0]
    assert f"Camera left has no usable picture for frames {first}\u2013{last} (3 in all)." in page


@pytest.mark.parametrize(("method", "own", "other"), [("rigid", "rigid", "spots"), ("spots", "spots", "rigid")])
def test_the_status_meanings_are_those_of_the_tracker_method(tmp_path, method, own, other):
    fake = make(tmp_path, 30)
    path = fake.results / "summary.json"
    summary = json.loads(path.read_text())
    summary["parameters"]["tracker"]["method"] = method
    path.write_text(json.dumps(summary))
    html = write_report(fake.results).read_text(encoding="utf-8").replace("&#39;", "'")
    for status in (SpotStatus.MATCHED, SpotStatus.OCCLUDED, SpotStatus.OUT_OF_VIEW):
        assert status.meaning_for(own) in html
        assert status.meaning_for(other) not in html
    assert ("matching step 1" in html) == (method == "spots")


@pytest.mark.parametrize("tree", [{"parameters": None}, {"parameters": {"tracker": {"method": "a newer one"}}}])
def test_a_summary_without_a_known_tracker_method_has_the_meanings_of_the_oldest(tree):
    assert summary_of(tree).method == "spots"


def test_damaged_parts_of_a_summary_are_left_out():
    odd = {"counts": {"events": {"tie": "many"}, "no_image": 3}, "events": ["odd", {"frame": 4}], "errors": [],
           "inputs": [{"path": "a", "bytes": "?"}, {"path": "b"}], "notes": "one"}  # fmt: skip
    summary = summary_of(odd)
    assert (summary.event_counts, summary.no_image, summary.errors) == ({}, {}, None)
    assert [(e.frame, e.kind) for e in summary.events] == [(4, "noted")]
    assert [i.path for i in summary.inputs] == ["b"]
    assert summary.notes == ("one",)


def test_damaged_errors_against_truth_are_dashes(tmp_path):
    fake = make(tmp_path, 3)
    shutil.rmtree(fake.run_folder)
    path = fake.results / "summary.json"
    odd = {"spots": {"wrong_labels": "many", "in_view_identity": 0.5, "prediction_px": 3, "per_spot": ["odd"]},
           "pose": {"measured": {"rotation_deg": "large", "nees_mean": 6.2}}, "motion_vs_differences": []}  # fmt: skip
    path.write_text(json.dumps(json.loads(path.read_text()) | {"errors": odd}))
    html = write_report(fake.results).read_text(encoding="utf-8")
    assert "50.0 %" in html
    assert "6.20" in html
    assert tables.truth_figures(odd)[4][1] == "\u2013"


@pytest.mark.parametrize(("status", "word"), [("pass", "PASS"), ("check", "CHECK"), ("fail", "FAIL")])
def test_the_verdict_is_that_of_the_summary_with_all_its_reasons(tmp_path, status, word):
    fake = make(tmp_path, 3)
    path = fake.results / "summary.json"
    summary = json.loads(path.read_text()) | {"verdict": {"status": status, "reasons": ["one thing", "another"]}}
    path.write_text(json.dumps(summary))
    html = write_report(fake.results).read_text(encoding="utf-8")
    assert f'<section class="verdict {status}">' in html
    assert f">{word}</strong>" in html
    assert "<li>one thing</li><li>another</li>" in html


def test_each_reason_is_at_the_top_with_its_remedy(tmp_path):
    make(tmp_path, 40)
    path = tmp_path / "results/summary.json"
    evidence = [
        {"kind": "model", "level": "fail", "what": "camera <right> has turned", "remedy": "Fix its mount."},
        {"kind": "lost", "level": "check", "what": "3 frames are lost", "remedy": ""},
    ]
    verdict = {"status": "fail", "reasons": ["a", "b"], "exit_status": 4, "evidence": evidence}
    path.write_text(json.dumps(json.loads(path.read_text()) | {"verdict": verdict}))
    html = write_report(tmp_path / "results").read_text(encoding="utf-8")
    top = html[html.index('<section class="verdict fail">') : html.index("</section>")]
    assert "<strong>camera &lt;right&gt; has turned</strong><br>" in top
    assert '<span class="remedy">Fix its mount.</span>' in top
    assert "<li>3 frames are lost</li>" in top


@pytest.mark.parametrize("summary", [{}, {"verdict": None}, {"verdict": "good"}, {"verdict": {"status": "splendid"}}])
def test_without_a_valid_verdict_the_report_says_so(summary):
    verdict = verdict_of(summary)
    assert (verdict.word, verdict.status) == ("NO VERDICT", "unknown")


def test_pictures_show_the_spot_where_it_was_measured(filmed):
    fake, html = filmed
    rows = [line.split(",") for line in (fake.results / "spots.csv").read_text().splitlines()[1:]]
    row = next(r for r in rows if r[2] == "left" and r[8] == "matched")
    shots = re.findall(r'<svg class="plot shot".*?</svg>', html, re.DOTALL)
    assert len(shots) <= MOST_PICTURES
    shot = next(s for s in shots if f'data-frame="{row[0]}"' in s and "camera left" in s)
    data = base64.b64decode(re.search(r"data:image/jpeg;base64,([^\"]+)", shot)[1])
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR).astype(float)
    scale = image.shape[1] / 1280
    u, v = ((float(x) + 0.5) * scale - 0.5 for x in row[4:6])
    around = image[round(v) - 25 : round(v) + 26, round(u) - 25 : round(u) + 26]
    green = np.argwhere(np.abs(around - bgr(SPOT_COLOURS[SpotStatus.MATCHED])).max(axis=2) < 60) - 25
    away = np.hypot(*green.T)  # from the centre of a ring of 9 units of 1.5 px
    assert np.median(away) == pytest.approx(13.5, abs=1)
    assert away.min() > 9
    assert away.max() < 18


def test_a_damaged_picture_is_shown_as_such(filmed):
    assert "unreadable: cut short" in filmed[1]
    assert "no usable picture, for 1 frame" in filmed[1]


def test_at_most_eight_pictures_include_every_kind_of_event(fake):
    material = read_report_data(fake.results, None)
    found = events(material)
    selection = selected(material, found)
    assert len(selection) <= MOST_PICTURES
    assert {e.kind for e in found} <= {e.kind for e in selection}


def test_events_recorded_by_the_run_are_listed_and_pictured(fake, tmp_path):
    shutil.copytree(fake.results, tmp_path / "results")
    path = tmp_path / "results" / "summary.json"
    noted = {"frame": 33, "kind": "tie", "camera": None, "spot": None, "text": "two labels fit <equally>"}
    path.write_text(json.dumps(json.loads(path.read_text()) | {"events": [noted, {"frame": 10**9}, "odd"]}))
    assert ">33</a></td><td>0.330</td><td>left</td><td>two labels fit &lt;equally&gt;</td>" in write_report(
        tmp_path / "results"
    ).read_text(encoding="utf-8")
    material = read_report_data(tmp_path / "results", fake.run_folder)
    assert "tie" in {e.kind for e in selected(material, events(material))}


def test_a_faint_spot_in_a_black_picture_is_shown_bright_and_the_background_stays_black():
    rng = np.random.default_rng(1)
    black = 8 + rng.normal(scale=1, size=(512, 640))
    faint = black.copy()
    faint[250:256, 300:306] += 30
    faint[10, 10] = 255.0  # a hot pixel
    assert stretched(faint, *grey_limits(faint))[253, 303] > 200
    assert np.median(stretched(black, *grey_limits(black))) < 128


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_whole_grey_values_are_shown_like_the_same_values_with_a_fraction(kind):
    picture = np.random.default_rng(2).poisson(20.0, (97, 83)).astype(kind)
    picture[40:44, 50:53] = np.iinfo(kind).max
    limits = grey_limits(picture.astype(float))
    np.testing.assert_allclose(grey_limits(picture), limits, rtol=1e-12)
    np.testing.assert_array_equal(stretched(picture, *limits), stretched(picture.astype(float), *limits))


def test_a_spot_far_outside_gets_an_arrow_at_the_border_and_a_name_inside():
    canvas = Canvas(np.zeros((1024, 1280, 3), np.uint8), np.array([-0.5, -0.5]), 1.0, 2.0)
    x, y = canvas.arrow(np.array([1500.0, 300.0]), (10, 200, 30))
    rows, columns = np.nonzero(canvas.image.max(axis=2) > 100)
    assert columns.max() == pytest.approx(1276, abs=1)  # two units inside the border
    assert rows.mean() == pytest.approx(300, abs=0.5)
    assert x < columns.min()
    assert y == pytest.approx(300)


def test_names_of_spots_that_are_close_together_do_not_cover_each_other():
    canvas = Canvas(np.zeros((300, 400, 3), np.uint8), np.array([-0.5, -0.5]), 1.0, 1.0)
    taken = []
    for k in range(6):
        canvas.label((200 + 3 * k, 150), 12, f"spot {k}", 16, (255, 255, 255), taken)
    for a, b in itertools.combinations(taken, 2):
        assert a[2] <= b[0] or b[2] <= a[0] or a[3] <= b[1] or b[3] <= a[1]


class TestDrawing:
    def test_a_spike_of_one_frame_survives_thinning(self):
        t, y = np.arange(100_000.0), np.zeros(100_000)
        y[51_234] = 7.0
        x, thin = svg.envelope(t, y, 500)
        assert len(x) <= 1000
        assert x[np.argmax(thin)] == 51_234
        assert thin.max() == 7.0
        assert (np.diff(x) >= 0).all()

    def test_a_gap_survives_thinning(self):
        t, y = np.arange(10_000.0), np.ones(10_000)
        y[4000:6000] = np.nan
        x, thin = svg.envelope(t, y, 100)
        assert np.isnan(thin[(x > 4200) & (x < 5800)]).all()
        assert np.isfinite(thin[(x < 3900) | (x > 6100)]).all()

    def test_thinning_keeps_the_extremes_of_a_band(self):
        t = np.arange(10_000.0)
        low, high = -np.ones(10_000), np.ones(10_000)
        high[777], low[778] = 5.0, -6.0
        _, thin_low, thin_high = svg.band_envelope(t, low, high, 100)
        assert (thin_low.min(), thin_high.max()) == (-6.0, 5.0)

    def test_a_plot_of_a_hundred_thousand_frames_stays_small(self):
        rng = np.random.default_rng(5)
        t = np.arange(100_000) / 100
        panel = time_panel(t, "noise", "px", lines=(Line(rng.normal(size=100_000), BLUE, "noise"),))
        assert len(panel) < 30_000

    def test_one_lost_frame_among_a_hundred_thousand_is_shaded(self):
        t, lost = np.arange(100_000.0), np.zeros(100_000, dtype=bool)
        lost[31_415] = True
        panel = time_panel(t, "x", "m", lines=(), shades=(Shade(lost, "lost", "lost"),))
        assert panel.count('class="lost"') == 1

    def test_values_beyond_the_axis_are_marked_and_the_largest_is_given(self):
        y = np.zeros(500)
        y[100] = 40.0
        panel = time_panel(np.arange(500.0), "x", "px", lines=(Line(y, BLUE, "x"),), y_range=(-1.0, 1.0))
        assert "up to 40.0 px" in panel
        assert "h6l-3 -5z" in panel

    def test_an_isolated_value_between_gaps_is_drawn(self):
        assert line_path(np.array([1.0, 2, 3]), np.array([np.nan, 5.0, np.nan])) == "M2.0 5.0h0"

    def test_ticks_are_round_within_the_range_and_without_negative_zero(self):
        for lo, hi in ((-0.3, 0.4), (-2e-5, 1e-6), (19_990.0, 20_010.0), (-7.0, -6.9)):
            values = ticks(lo, hi, 5)
            assert 2 <= len(values) <= 7
            assert ((values >= lo - 1e-9) & (values <= hi + 1e-9)).all()
            texts = tick_texts(values)
            assert len(set(texts)) == len(texts)
            assert not any(re.fullmatch("\u22120(\\.0+)?", t) for t in texts)
            np.testing.assert_allclose([float(t.replace("\u2212", "-")) for t in texts], values, atol=1e-3 * (hi - lo))


class TestNumbers:
    def test_a_share_below_one_is_never_shown_as_100_percent(self):
        assert number_format.format_percent(0.99996) != "100.0 %"
        assert number_format.format_percent(0.99996).startswith("99.99")
        assert number_format.format_percent(1.0) == "100 %"
        assert number_format.format_percent(0.00001) != "0.0 %"

    @pytest.mark.parametrize(
        ("value", "words"),
        [
            (0.0, "0"),
            (0.1, "0.100"),
            (-12.345, "\u221212.3"),
            (123456.0, "123456"),
            (None, "\u2013"),
            (np.nan, "\u2013"),
        ],
    )
    def test_numbers_are_short_and_plain(self, value, words):
        assert number_format.format_number(value) == words

    def test_lengths_and_angles_have_a_suitable_unit(self):
        assert number_format.format_length(0.00046) == "0.460 mm"
        assert number_format.format_length(1.5) == "1.50 m"
        assert number_format.format_angle(0.0027) == "2.70 mdeg"
        assert number_format.format_angle(2.5) == "2.50\u00b0"


class TestIndex:
    ROWS = (
        {"name": "a-pass", "run": "/d/a-pass", "status": "pass", "results": "a-pass", "frames": 600, "message": ""},
        {
            "name": "b-error",
            "run": "/d/b-error",
            "status": "error",
            "results": "",
            "frames": "",
            "message": "no <rig> & no run",
        },
        {"name": "c-fail", "run": "/d/c-fail", "status": "fail", "results": "c-fail", "frames": 20, "message": "lost"},
        {
            "name": "d-check",
            "run": "/d/d-check",
            "status": "check",
            "results": "d-check",
            "frames": 20,
            "message": "few spots",
        },
    )

    def write(self, out: Path) -> str:
        for name in ("a-pass", "c-fail"):
            (out / name).mkdir()
            (out / name / "report.html").write_text("x")
        return write_index(list(self.ROWS), out).read_text(encoding="utf-8")

    def test_the_worst_come_first(self, tmp_path):
        html = self.write(tmp_path)
        assert re.findall(r'class="badge (\w+)"', html) == ["error", "fail", "check", "pass"]
        assert_well_formed(html)

    def test_only_existing_reports_are_linked(self, tmp_path):
        html = self.write(tmp_path)
        links = re.findall(r'<a href="([^"]+)"', html)
        assert links == ["./c-fail/report.html", "./a-pass/report.html"]
        assert all((tmp_path / link).is_file() for link in links)

    def test_markup_in_messages_is_escaped(self, tmp_path):
        html = self.write(tmp_path)
        assert "no &lt;rig&gt; &amp; no run" in html
        assert "<rig>" not in html

    def test_the_folder_of_all_runs_is_stated_once_and_a_column_without_a_value_is_left_out(self, tmp_path):
        rows = [{**row, "run": f"/data/campaign/day/{row['name']}-x"} for row in self.ROWS]
        rows[1]["message"] = "/data/campaign/day/b-error-x/run.yaml: expected a mapping"
        html = write_index(rows, tmp_path).read_text(encoding="utf-8")
        assert html.count("/data/campaign/day") == 1
        assert "b-error-x/run.yaml: expected a mapping" in html
        assert ">frames<" in html
        assert ">time (s)<" not in html

    def test_folders_without_a_common_one_are_shown_in_full(self, tmp_path):
        rows = [{**row, "run": f"{place}/x"} for row, place in zip(self.ROWS, ("/a", "/b", "", "c"), strict=True)]
        html = write_index(rows, tmp_path).read_text(encoding="utf-8")
        assert all(f'<span class="path">{place}/x</span>' in html for place in ("/a", "/b", "", "c"))

    def test_a_further_column_shows_yes_or_no_words_and_numbers(self, tmp_path):
        values = (True, "late", 12.0, 0.123456)
        rows = [{**row, "lamp_on": value} for row, value in zip(self.ROWS, values, strict=True)]
        html = write_index(rows, tmp_path).read_text(encoding="utf-8")
        assert ">lamp on<" in html
        cells = re.findall(r"<td[^>]*>([^<]*)</td>", html)
        assert [cells.count(shown) for shown in ("yes", "late", "12", "0.1235")] == [1, 1, 1, 1]

    def test_the_index_of_an_empty_batch_says_so(self, tmp_path):
        assert "The batch has no runs." in write_index([], tmp_path).read_text(encoding="utf-8")


@pytest.mark.slow
def test_a_report_of_a_hundred_thousand_frames_stays_under_five_megabytes(tmp_path):
    assert write_report(make(tmp_path, 100_000).results).stat().st_size < 5_000_000


def test_the_scene_in_three_dimensions_follows_the_cursor_and_has_the_poses_of_the_run(tmp_path):
    fake = make(tmp_path, 120, seed=4)
    page = write_report(fake.results).read_text()
    data = json.loads(re.search(r'<script type="application/json" id="scene-data">(.*?)</script>', page, re.DOTALL)[1])
    poses = read_poses(fake.results)
    places = {int(f): p for f, p in zip(poses.frames, poses.world_from_body.translation, strict=True)}
    assert len(data["packed"]) == 40
    for frame, _, _, at, spots in data["packed"]:
        np.testing.assert_allclose(np.array(at) / 1000, places[frame], atol=0.6e-3)
        assert {data["names"][s[0]] for s in spots} <= set("123456")
    # A drawing is there where no script runs, and in print.
    assert page.count("Screens, cameras and beams, ") >= 2
    assert page.count('"beampose-cursor"') == 2  # sent by the plots, received by the scene
    assert len(re.search(r'<div class="scene" data-scene>.*?</section>', page, re.DOTALL)[0]) < 45_000


def test_a_report_without_the_rig_has_no_scene(tmp_path):
    fake = make(tmp_path, 20)
    (fake.run_folder / "rig.yaml").unlink()
    assert "In three dimensions" not in write_report(fake.results).read_text()


@pytest.mark.parametrize(
    ("column", "value", "words"),
    [
        ("frame", "", "frame: expected a whole number, got nothing"),
        ("frame", "3.5", "frame: expected a whole number, got 3.5"),
        ("frame", "-5", "frame: expected frames in rising order, got -5 after"),
        ("t_s", "1e308", "t_s: expected seconds, got 1e+308"),
    ],
)
@pytest.mark.parametrize("name", ["attitude.csv", "spots.csv"])
def test_results_whose_frames_or_times_are_damaged_are_refused_with_the_line(name, column, value, words, tmp_path):
    results = make(tmp_path).results
    rows = list(csv.reader((results / name).read_text("utf-8").splitlines()))
    rows[5][rows[0].index(column)] = value
    (results / name).write_text("\n".join(map(",".join, rows)) + "\n", "utf-8")
    with pytest.raises(InputError, match=re.escape(f"{name}: line 6: {words}")):
        write_report(results)


@pytest.mark.filterwarnings("error")
def test_results_with_a_time_missing_are_shown_over_frame_numbers(tmp_path):
    results = make(tmp_path).results
    rows = list(csv.reader((results / "attitude.csv").read_text("utf-8").splitlines()))
    rows[5][rows[0].index("t_s")] = ""
    (results / "attitude.csv").write_text("\n".join(map(",".join, rows)) + "\n", "utf-8")
    assert ">frame<" in write_report(results).read_text("utf-8")
