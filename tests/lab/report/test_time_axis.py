"""A report's plots carry their series, so that a part of the time can be enlarged; and links lead to places in time."""

from __future__ import annotations

import base64
import datetime
import json
import re
import zlib
from pathlib import Path

import numpy as np
import pytest

from lab.report.plot.series import Band, Line, ZoomData, time_panel, unwrapped
from lab.report.plot.svg import BLUE, area_path, date_ticks, line_path
from lab.report.run.figures import pose_figure
from lab.report.run.page import write_report
from lab.report.run.report_data import read_report_data
from lab.report.run.trust import evidence, time_link
from tests.lab.fake_results import Fake, make


def read(text: str) -> tuple[np.ndarray, list[np.ndarray], list[np.ndarray]]:
    """Times, rows of statuses and series of `ZoomData.encoded`: what cursor.js does, written again.

    A series in blocks is (2, blocks): smallest and largest.
    """
    head = json.loads(text)
    data = np.frombuffer(zlib.decompress(base64.b64decode(head["data"])), np.uint8)
    n, at = head["n"], 0

    def integers(count: int, width: int) -> np.ndarray:
        nonlocal at
        planes = data[at : at + count * width].reshape(width, count).astype(np.int64)
        at += count * width
        return (planes << (8 * np.arange(width))[:, None]).sum(axis=0)

    def places(first_step: list[float]) -> np.ndarray:
        steps = (integers(n, 4) + 2**31) % 2**32 - 2**31
        return first_step[0] + first_step[1] * np.cumsum(np.cumsum(steps))

    t, _ = places(head["t"]), places(head["frames"])
    rows = [integers(n, 1) - 1 for _ in head["rows"]]
    out = []
    for centre, scale, lowest, step, width, block in head["series"]:
        blocks = -(-n // block)
        q = np.cumsum(integers(blocks * (2 if block > 1 else 1), width)) % 2 ** (8 * width)
        y = np.where(q > 0, centre + scale * np.sinh(lowest + (q - 1) * step), np.nan)
        out.append(y.reshape(2, blocks) if block > 1 else y)
    assert at == len(data)
    return t, rows, out


@pytest.fixture(scope="module")
def fake(tmp_path_factory: pytest.TempPathFactory) -> Fake:
    return make(tmp_path_factory.mktemp("zoom"), 300, causal=True)


@pytest.fixture(scope="module")
def page(fake: Fake) -> str:
    return write_report(fake.results).read_text(encoding="utf-8")


def test_series_come_back_with_their_gaps_and_the_digits_that_a_plot_resolves():
    rng = np.random.default_rng(3)
    t = np.arange(400) / 97.0
    noise = rng.normal(size=400)
    noise[50:60] = np.nan
    spiky = noise.copy()
    spiky[100] = 1e6
    smooth = 20 * np.sin(t)
    zoom = ZoomData(t, np.arange(400) + 7)
    codes = rng.integers(-1, 3, size=400)
    assert zoom.add_row("pose", codes, [("a", "#000000")]) == 0
    names = [
        zoom.add(noise),
        zoom.add(spiky),
        zoom.add(smooth, fine=True),
        zoom.add(noise),
        zoom.add(np.full(400, 2.5)),
    ]
    assert names == ["0", "1", "2", "0", "=2.5"]
    assert zoom.add(noise[1:]) is None
    times, rows, (a, b, c) = read(zoom.encoded())
    np.testing.assert_allclose(times, t, atol=1e-6)
    assert np.array_equal(rows[0], codes)
    assert np.array_equal(np.isnan(a), np.isnan(noise))
    usual = np.isfinite(noise) & (np.arange(400) != 100)
    np.testing.assert_allclose(a[usual], noise[usual], atol=1e-3)
    np.testing.assert_allclose(b[usual], spiky[usual], atol=5e-3)  # a spike of a million sigmas costs few digits
    assert b[100] == pytest.approx(1e6, rel=1e-3)
    np.testing.assert_allclose(c, smooth, atol=1e-4)


def test_a_spike_of_one_frame_survives_in_blocks():
    rng = np.random.default_rng(4)
    n = 60_000
    series = [rng.normal(size=n) for _ in range(60)]
    series[5][31_234] = 40.0
    zoom = ZoomData(np.arange(n) / 100, np.arange(n))
    for y in series:
        zoom.add(y)
    text = zoom.encoded()
    assert len(text) < 3_000_000
    low, high = read(text)[2][5]
    block = json.loads(text)["series"][5][5]
    assert block > 1
    assert np.nanargmax(high) == 31_234 // block
    assert np.nanmax(high) == pytest.approx(40.0, rel=1e-3)
    assert np.all(low <= high)


def test_every_plot_over_time_of_a_report_can_be_enlarged(page):
    plots = re.findall(r"<svg[^>]* data-t=[^>]*>.*?</svg>", page, flags=re.S)
    assert len(plots) > 40
    for plot in plots:
        assert " data-y=" in plot
        assert '<g class="whole">' in plot
        assert plot.count('class="line"') == plot.count("data-s=")
    head = json.loads(re.search(r'id="zoom-data">(.*?)</script>', page, flags=re.S).group(1))
    names = {int(n) for n in re.findall(r'data-s="(\d+)"', page)}
    assert max(names) < len(head["series"])
    assert [row["name"] for row in head["rows"]][:2] == ["pose", "left / 1"]


def test_a_report_of_300_frames_stays_under_600_kilobytes(page):
    assert len(page.encode()) < 600_000


def test_markup_in_names_does_not_end_the_data_block(fake, tmp_path):
    results = tmp_path / "results"
    results.mkdir()
    for path in fake.results.iterdir():
        (results / path.name).write_bytes(path.read_bytes())
    spots = results / "spots.csv"
    spots.write_text(spots.read_text().replace(",left,1,", ",left,</script>1,"))
    html = write_report(results).read_text(encoding="utf-8")
    assert html.count("</script>") == 4  # two blocks of data, two programs
    assert json.loads(re.search(r'id="zoom-data">(.*?)</script>', html, flags=re.S).group(1))["rows"]


def test_results_whose_tables_disagree_give_a_report_without_enlarging(fake, tmp_path):
    results = tmp_path / "results"
    results.mkdir()
    for path in fake.results.iterdir():
        (results / path.name).write_bytes(path.read_bytes())
    attitude = results / "attitude.csv"
    attitude.write_text("\n".join(attitude.read_text().splitlines()[:-5]) + "\n")
    html = write_report(results).read_text(encoding="utf-8")
    assert 'id="zoom-data"' not in html
    assert "Attitude and position" in html
    assert "spots.csv and attitude.csv have different frames" in html


def test_damaged_tables_give_a_report_that_says_so(tmp_path):
    (tmp_path / "spots.csv").write_text("frame,<b>\n1,2\n")
    with pytest.raises(Exception, match=r"spots\.csv"):
        write_report(tmp_path)
    html = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert ">ERROR</strong>" in html
    assert "spots.csv" in html
    assert "PASS" not in html


def test_the_evidence_leads_to_the_longest_gap_and_the_least_certain_label(fake):
    m = read_report_data(fake.results, None)
    lines = {e.name: e for e in evidence(m, None)}
    residuals = {"Residuals by camera", "Residuals by beam"}
    assert set(lines) >= {"Poses", "Calibration", "Fit of rig and recording", *residuals}
    gap = lines["Poses"]
    assert gap.link.startswith("#t=")
    first = float(gap.link.split("at=")[1])
    assert m.poses.status[int(np.argmin(np.abs(m.t_s - first)))] != 0
    assert "left" in lines["Residuals by camera"].text
    assert "A " in lines["Residuals by beam"].text
    assert lines["Calibration"].word == "unknown"


@pytest.mark.parametrize(
    ("state", "recorded", "level", "words"),
    [
        (
            {"date": "2026-03-01", "verdict": "PASS", "valid_until": "2026-06-01"},
            "2026-03-11",
            "pass",
            "10 days before",
        ),
        ({"date": "2026-03-01", "verdict": "WARN"}, "2026-03-11", "check", "WARN"),
        ({"date": "2026-03-01", "verdict": "PASS", "valid_until": "2026-03-05"}, "2026-03-11", "fail", "valid until"),
        ({"date": "2026-03-01", "verdict": "PASS"}, None, "pass", "age is unknown"),
    ],
)
def test_the_age_of_the_calibration_is_counted_to_the_recording(tmp_path: Path, state, recorded, level, words):
    fake = make(tmp_path, 20)
    path = fake.results / "summary.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"calibration": state}))
    if recorded:
        run = fake.run_folder / "run.yaml"
        run.write_text(run.read_text() + f"recorded: {recorded}\n")
    m = read_report_data(fake.results, None)
    line = next(e for e in evidence(m, None) if e.name == "Calibration")
    assert line.word == level
    assert words in line.text


def test_the_methods_text_has_the_runs_own_numbers_and_cites_what_it_used(page):
    text = re.search(r'id="methods">(.*?)</div>', page, flags=re.S).group(1)
    for word in ("300 frames", "100 Hz", "6 spots of 3 laser beams", "2 cameras", "beampose 0.1.0", "Huo J", "Bierman"):
        assert word in text
    cited = {int(n) for n in re.findall(r"\[(\d+)\]", text)}
    assert cited == set(range(1, text.count("<li>") + 1))


def test_a_link_to_a_place_in_time_contains_it(fake):
    m = read_report_data(fake.results, None)
    for first, last in ((0, 0), (299, 299), (100, 180)):
        a, b = map(float, time_link(m, first, last)[3:].split("&")[0].split(","))
        assert a <= m.t_s[first] <= m.t_s[last] <= b


def test_steps_of_a_path_do_not_accumulate_errors():
    rng = np.random.default_rng(6)
    x, y = np.arange(500) * 0.333, rng.normal(scale=30, size=500)
    numbers = np.array([float(v) for v in re.findall(r"-?\d*\.?\d+", line_path(x, y).replace("l", " "))]).reshape(-1, 2)
    np.testing.assert_allclose(np.cumsum(numbers, axis=0), np.stack([x, y], -1), atol=0.051)
    assert area_path(x[:2], y[:2], y[:2] + 1).endswith("z")


def test_a_band_about_a_centre_names_its_parts():
    zoom = ZoomData(np.arange(50.0), np.arange(50))
    centre, sigma = np.sin(np.arange(50.0)), np.full(50, 0.1)
    band = Band.about(centre, sigma, 3.0, BLUE, "three sigma")
    np.testing.assert_allclose(band.high - band.low, 0.6)
    panel = time_panel(
        np.arange(50.0), "x", "m", lines=(Line(centre, BLUE, "x"),), bands=(band,), zoom=zoom, row=0, fit=True
    )
    assert 'data-b="0 =0.1 3.0"' in panel
    assert 'data-s="0"' in panel


@pytest.mark.parametrize(
    ("first", "last", "labels"),
    [
        ((2024, 2, 27), (2024, 3, 2), ["2024-02-27", "2024-02-28", "2024-02-29", "2024-03-01", "2024-03-02"]),
        ((2024, 1, 20), (2025, 6, 10), ["2024-04", "2024-07", "2024-10", "2025-01", "2025-04"]),
        ((2023, 12, 31), (2024, 5, 1), ["2024-01", "2024-02", "2024-03", "2024-04", "2024-05"]),
        ((1990, 5, 5), (2026, 1, 1), ["2000", "2010", "2020"]),
    ],
)
def test_ticks_of_dates_are_days_or_first_days_of_months_and_years(first, last, labels):
    places, found = date_ticks(*(datetime.date(*day).toordinal() for day in (first, last)))
    assert found == labels
    days = [datetime.date.fromordinal(int(p)).isoformat() for p in places]
    assert days == [label + "-01-01"[len(label) - 4 :] if len(label) < 10 else label for label in labels]


def test_angles_over_time_have_no_jumps_although_poses_are_missing():
    turning = np.linspace(100.0, 800.0, 141)[:, None] * [1.0, -1.0, 0.01]
    stated = (turning + 180.0) % 360.0 - 180.0
    stated[30:33] = stated[100] = np.nan
    shown = unwrapped(stated)
    known = np.isfinite(stated)
    np.testing.assert_array_equal(np.isfinite(shown), known)
    np.testing.assert_allclose((shown - shown[0])[known], (turning - turning[0])[known], atol=1e-9)


def test_the_report_of_a_run_with_a_missing_pose_shows_angles_without_jumps(tmp_path):
    fake = make(tmp_path, 60)
    table = fake.results / "attitude.csv"
    head, *rows = (line.split(",") for line in table.read_text().splitlines())
    yaw, status = head.index("yaw_deg"), head.index("status")
    for k, row in enumerate(rows):
        row[yaw] = f"{(170.0 + k + 180.0) % 360.0 - 180.0}"  # from 170 to 229 deg
    rows[5] = [v if n in ("frame", "t_s") else "" for n, v in zip(head, rows[5], strict=True)]
    rows[5][status] = "lost"
    table.write_text("\n".join(",".join(row) for row in (head, *rows)) + "\n")
    zoom = ZoomData(np.arange(60.0), np.arange(60))
    pose_figure(read_report_data(fake.results, None), zoom)
    _, _, series = read(zoom.encoded())
    assert any(np.nanmax(y) > 220.0 and np.nanmin(y) > 160.0 for y in series if np.isfinite(y).any())
