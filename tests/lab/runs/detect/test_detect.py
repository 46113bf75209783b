"""`beampose detect`: spots of any pictures, without a rig."""

from __future__ import annotations

import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from lab.errors import InputError
from lab.files.text import columns
from lab.runs.detect.detect import SHEET, DetectOptions, detect_pictures
from lab.runs.detect.detect_page import MOST, ContactSheet
from lab.runs.detect.picture_series import MOST_KEPT, SpotCollection, laser_likeness, matched_snr
from tests.lab.tables import rows_of
from tests.tracking.rendering import Scene, Spot, expected
from tracking.detections import Detections

SPOTS = [Spot(60.3, 40.6, 90.0, 1.4, 1.2), Spot(110.2, 70.4, 160.0, 1.6, 1.3), Spot(31.7, 92.1, 120.0, 1.2, 1.1)]
SIZE = (160, 120)


def picture(frame: int, *, size: tuple[int, int] = SIZE, bits: int = 8, seed: int = 0) -> np.ndarray:
    """Three spots that move one pixel to the right per frame, on a background with noise of 1 DN (8 bit)."""
    moved = [Spot(s.u + frame, s.v, s.peak, s.major, s.minor) for s in SPOTS]
    clean = expected(Scene(moved, size=size, background=12.0))
    noisy = clean + np.random.default_rng([seed, frame]).normal(0, 1.0, clean.shape)
    factor, dtype = (1, np.uint8) if bits == 8 else (64, np.uint16)
    return np.clip(np.round(noisy * factor), 0, np.iinfo(dtype).max).astype(dtype)


def write_folder(folder: Path, frames: range, suffix: str = ".png", **options: int) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for frame in frames:
        cv2.imwrite(str(folder / f"img_{frame:04d}{suffix}"), picture(frame, **options))
    return folder


def rows(out: Path) -> list[dict[str, str]]:
    return rows_of(out / "detections.csv")


def summary(out: Path) -> dict:
    return json.loads((out / "summary.json").read_text("utf-8"))


@pytest.mark.parametrize("sigma", [45.0, 90.0])
def test_a_beam_wider_than_the_limit_is_named_with_the_value_that_reports_it(tmp_path, sigma):
    """A user who sees the beam and an empty table learns the reason, and the value in the note works."""
    v, u = np.mgrid[:600, :720]
    light = 150.0 * np.exp(-0.5 * ((u - 350.3) ** 2 + (v - 300.8) ** 2) / sigma**2)
    noisy = light + 10.0 + np.random.default_rng(3).normal(0, 1.5, light.shape)
    cv2.imwrite(str(tmp_path / "beam_1.png"), np.clip(np.rint(noisy), 0, 255).astype(np.uint8))
    detect_pictures([tmp_path / "beam_1.png"], tmp_path / "plain")
    named = re.search(r"--set detect.max_sigma_px=(\d+)", (tmp_path / "plain" / "report.html").read_text("utf-8"))
    assert named is not None
    options = DetectOptions(overrides={"detect.max_sigma_px": float(named[1])})
    detect_pictures([tmp_path / "beam_1.png"], tmp_path / "wide", options)
    (beam,) = rows(tmp_path / "wide")
    assert np.hypot(float(beam["u_px"]) - 350.3, float(beam["v_px"]) - 300.8) < 0.2
    assert 0.95 * sigma < float(beam["major_px"]) < 1.05 * sigma
    assert "max_sigma_px=" not in (tmp_path / "wide" / "report.html").read_text("utf-8")


def test_the_spots_of_a_folder_have_their_true_positions_and_sizes(tmp_path):
    folder = write_folder(tmp_path / "left", range(7, 19))
    outcome = detect_pictures([folder], tmp_path / "out")
    assert (outcome.result.pictures, outcome.result.spots.total, outcome.exit_status) == (12, 36, 0)
    found = rows(tmp_path / "out")
    assert tuple(found[0]) == (*columns.DETECTIONS, columns.LIKENESS)
    assert {r["camera"] for r in found} == {"left"}
    assert [int(r["frame"]) for r in found] == sorted(3 * list(range(7, 19)))
    for frame in (7, 18):
        uv = np.array([[float(r["u_px"]), float(r["v_px"])] for r in found if int(r["frame"]) == frame])
        truth = np.array([[s.u + frame, s.v] for s in SPOTS])
        gaps = np.linalg.norm(uv[:, None] - truth, axis=-1)
        assert gaps.min(axis=0).max() < 0.1
    sizes = summary(tmp_path / "out")["sizes_px"]
    # A pixel adds 1/12 px^2 to the square of each axis.
    assert sizes["major"]["median"] == pytest.approx(np.hypot(1.4, 0.29), rel=0.05)


def test_the_estimated_noise_is_the_true_one(tmp_path):
    detect_pictures([write_folder(tmp_path / "cam", range(8))], tmp_path / "out")
    (noise,) = summary(tmp_path / "out")["noise"]
    assert np.sqrt(noise["floor_dn2"]) == pytest.approx(np.sqrt(1 + 1 / 12), rel=0.15)
    assert noise["estimated"]["temporal"]


def test_16_bit_pictures_give_the_same_positions_and_signal_to_noise(tmp_path):
    shallow = write_folder(tmp_path / "8", range(6))
    deep = write_folder(tmp_path / "16", range(6), ".tif", bits=16)
    for name, folder in (("a", shallow), ("b", deep)):
        detect_pictures([folder], tmp_path / name)
    a, b = rows(tmp_path / "a"), rows(tmp_path / "b")
    assert len(a) == len(b) == 18
    assert np.allclose([float(r["u_px"]) for r in a], [float(r["u_px"]) for r in b], atol=0.1)
    ratio = summary(tmp_path / "b")["snr"]["median"] / summary(tmp_path / "a")["snr"]["median"]
    assert ratio == pytest.approx(1.0, abs=0.2)


def test_a_video_gives_the_same_detections_as_its_pictures(tmp_path):
    folder = write_folder(tmp_path / "pictures", range(20))
    video = cv2.VideoWriter(str(tmp_path / "shot.avi"), cv2.VideoWriter_fourcc(*"FFV1"), 25, SIZE, False)
    for frame in range(20):
        video.write(picture(frame))
    video.release()
    detect_pictures([tmp_path / "shot.avi"], tmp_path / "v", DetectOptions(every=4, limit=4))
    detect_pictures([folder], tmp_path / "p", DetectOptions(camera="shot", every=4, limit=4))
    assert {r["camera"] for r in rows(tmp_path / "v")} == {"shot"}
    assert {int(r["frame"]) for r in rows(tmp_path / "v")} == {0, 4, 8, 12}
    a, b = rows(tmp_path / "v"), rows(tmp_path / "p")
    assert len(a) == len(b) == 12
    assert np.allclose([float(r["u_px"]) for r in a], [float(r["u_px"]) for r in b], atol=0.02)


def test_each_size_and_depth_of_pictures_has_its_own_noise_and_a_note_in_the_report(tmp_path):
    folder = write_folder(tmp_path / "mixed", range(3))
    write_folder(folder, range(3, 6), ".tif", bits=16)
    write_folder(folder, range(6, 8), size=(200, 130))
    outcome = detect_pictures([folder], tmp_path / "out")
    assert outcome.result.pictures == 8
    assert outcome.result.spots.total == 24
    written = summary(tmp_path / "out")
    assert {(*n["size_px"], n["bits"]): n["pictures"] for n in written["noise"]} == {
        (160, 120, 8): 3,
        (160, 120, 16): 3,
        (200, 130, 8): 2,
    }
    assert [n["estimated"]["pictures"] for n in written["noise"]] == [2, 2, 2]
    assert any("different sizes or depths" in note for note in written["notes"])
    assert "different sizes or depths" in (tmp_path / "out/report.html").read_text("utf-8")


@pytest.mark.parametrize(("every", "limit", "expected"), [(1, None, 5), (2, None, 3), (1, 2, 2), (2, 9, 3)])
def test_progress_counts_the_pictures_that_are_searched(tmp_path, every, limit, expected):
    reported = []
    folder = write_folder(tmp_path / "series", range(5))
    options = DetectOptions(every=every, limit=limit)
    detect_pictures([folder], tmp_path / "out", options, lambda done, total: reported.append((done, total)))
    assert reported == [(k + 1, expected) for k in range(expected)]


def test_one_picture_is_enough(tmp_path):
    cv2.imwrite(str(tmp_path / "screen.bmp"), picture(0))
    outcome = detect_pictures([tmp_path / "screen.bmp"], tmp_path / "out")
    assert (outcome.result.camera, outcome.result.pictures, outcome.result.spots.total) == ("screen", 1, 3)


def test_files_are_numbered_by_their_names_or_else_alphabetically(tmp_path):
    folder = write_folder(tmp_path / "shots", range(4, 8))
    files = sorted(folder.iterdir())
    assert detect_pictures(files[::-1], tmp_path / "a").result.camera == "shots"
    assert [int(r["frame"]) for r in rows(tmp_path / "a")] == sorted(3 * [4, 5, 6, 7])
    detect_pictures([folder / "img_*.png"], tmp_path / "pattern")
    assert rows(tmp_path / "pattern") == rows(tmp_path / "a")
    files[0].rename(folder / "first.png")
    detect_pictures([folder], tmp_path / "b")
    assert {int(r["frame"]) for r in rows(tmp_path / "b")} == {0, 1, 2, 3}
    assert any("in alphabetical order" in note for note in summary(tmp_path / "b")["notes"])


def test_a_damaged_picture_does_not_affect_the_others(tmp_path):
    folder = write_folder(tmp_path / "cam", range(5))
    whole = (folder / "img_0002.png").read_bytes()
    (folder / "img_0002.png").write_bytes(whole[: len(whole) // 2])
    outcome = detect_pictures([folder], tmp_path / "out")
    assert (outcome.result.pictures, sum(map(len, outcome.result.unreadable.values())), outcome.exit_status) == (
        4,
        1,
        0,
    )
    assert "1 more cannot be read" in outcome.line()
    assert any("cut short (frame 2)" in note for note in summary(tmp_path / "out")["notes"])


def test_pictures_without_a_spot_are_no_error(tmp_path):
    for frame in range(3):
        grey = np.random.default_rng(frame).normal(20, 1, (60, 80))
        cv2.imwrite(str(tmp_path / f"{frame}.png"), np.round(grey).astype(np.uint8))
    outcome = detect_pictures(sorted(tmp_path.glob("*.png")), tmp_path / "out")
    assert (outcome.result.spots.total, outcome.exit_status) == (0, 0)
    assert "No spot was found" in (tmp_path / "out/report.html").read_text("utf-8")


@pytest.mark.parametrize(
    "names", [["nothing"], ["text.txt"], ["text.png"], ["cam", "text.png"], ["empty"], ["no*.png"]]
)
def test_a_path_without_pictures_is_an_error_of_one_line(tmp_path, names):
    (tmp_path / "text.txt").write_text("words")
    (tmp_path / "text.png").write_text("words")
    (tmp_path / "empty").mkdir()
    write_folder(tmp_path / "cam", range(1))
    with pytest.raises(InputError) as raised:
        detect_pictures([tmp_path / name for name in names], tmp_path / "out")
    message = str(raised.value)
    assert "\n" not in message
    assert names[0].split(".")[0].rstrip("*") in message
    assert not (tmp_path / "out").exists()


def test_a_parameter_that_does_not_belong_to_the_detection_is_an_error(tmp_path):
    folder = write_folder(tmp_path / "cam", range(1))
    with pytest.raises(InputError, match="expected a parameter of detection"):
        detect_pictures([folder], tmp_path / "out", DetectOptions(overrides={"r1_px": 3}))
    with pytest.raises(InputError, match=r"did you mean .*threshold_sigma"):
        detect_pictures([folder], tmp_path / "out", DetectOptions(overrides={"detect.threshold_sigmas": 3}))


def test_a_higher_threshold_finds_fewer(tmp_path):
    folder = write_folder(tmp_path / "cam", range(2))
    high = DetectOptions(overrides={"detect.threshold_sigma": 700.0})
    assert detect_pictures([folder], tmp_path / "out", high).result.spots.total < 6


def test_earlier_results_are_replaced_and_other_folders_are_not(tmp_path):
    folder = write_folder(tmp_path / "cam", range(1))
    for _ in range(2):
        detect_pictures([folder], tmp_path / "out")
    assert {p.name for p in (tmp_path / "out").iterdir()} == {"detections.csv", "report.html", "summary.json", SHEET}
    with pytest.raises(InputError, match="something other than earlier results"):
        detect_pictures([folder], folder)


def test_the_report_is_one_file_that_needs_no_network(tmp_path):
    detect_pictures([write_folder(tmp_path / "<cam> & co", range(3))], tmp_path / "out")
    html = (tmp_path / "out/report.html").read_text("utf-8")
    assert not re.findall(r'(?:src|href)="(?!data:)[^"#]', html)
    assert "<cam>" not in html
    assert "&lt;cam&gt; &amp; co" in html


@pytest.mark.parametrize(("pictures", "shown"), [(1, 1), (24, 24), (25, 24), (1000, 24)])
def test_a_contact_sheet_shows_pictures_from_the_first_to_the_last(pictures, shown):
    sheet = ContactSheet(pictures)
    for k in range(pictures):
        sheet.offer(k, k, np.zeros((3, 4), np.uint8), Detections.none(), np.zeros(0))
    indices = sorted(sheet._kept)
    assert len(indices) == shown
    assert (indices[0], indices[-1]) == (0, pictures - 1)
    assert pictures == 1 or np.ptp(np.diff(indices)) <= 1


def test_a_contact_sheet_of_an_unknown_number_of_pictures_is_evenly_spaced():
    sheet = ContactSheet(None)
    for k in range(333):
        sheet.offer(k, k, np.zeros((3, 4), np.uint8), Detections.none(), np.zeros(0))
    indices = sorted(sheet._kept)
    assert MOST / 2 <= len(indices) <= MOST
    assert np.ptp(np.diff(indices)) == 0


def test_a_contact_sheet_has_rings_around_the_spots():
    sheet = ContactSheet(1)
    found = Detections(np.array([[100.0, 50.0]]), np.eye(2)[None], *(np.array([x]) for x in (1.0, 1.0, 2.0, 2.0, 0.0)))
    sheet.offer(0, 5, np.full((120, 160), 10, np.uint8), found, np.ones(1))
    drawn = sheet.drawn().astype(int)
    coloured = np.argwhere(drawn.max(axis=-1) - drawn.min(axis=-1) > 100)
    scale = 8  # 1280 / 160
    centre = np.array([8 + 22 + 50.5 * scale, 8 + 100.5 * scale])
    ring = coloured[np.abs(coloured - centre).max(axis=1) < 70]  # its number stands above it, to the right
    radius = 3.5 * 2 * scale
    assert (ring[:, 0].max(), ring[:, 1].min()) == pytest.approx((centre[0] + radius, centre[1] - radius), abs=3)


def test_the_spots_most_like_a_laser_have_a_number_however_faint_they_are():
    count = 60
    place = np.stack([20.0 + 60 * (np.arange(count) % 20), 20.0 + 60 * (np.arange(count) // 20)], axis=-1)
    found = Detections(
        place, np.tile(np.eye(2), (count, 1, 1)), *(np.full(count, x) for x in (1.0, 1.0, 2.0, 2.0, 0.0))
    )
    sheets = []
    for alike in (count - 1, 0):
        sheet = ContactSheet(1)
        sheet.offer(0, 0, np.full((200, 1280), 10, np.uint8), found, np.where(np.arange(count) == alike, 0.9, 0.1))
        sheets.append(sheet.drawn().astype(int))
    changed = np.argwhere(np.abs(sheets[0] - sheets[1]).max(axis=-1) > 50) - [8 + 22, 8]
    beside = np.abs(changed - place[count - 1][::-1]).max(axis=1) < 40
    assert beside.any()  # the faintest spot has a number in the first sheet and none in the second


def test_the_signal_to_noise_ratio_is_that_of_a_matched_filter():
    """Compared with a Gaussian filter applied to a rendered spot and to noise."""
    v, u = np.mgrid[:81, :81] - 40.0
    shape = np.exp(-0.5 * ((u / 2.5) ** 2 + (v / 1.5) ** 2))
    light, sigma = 30 * shape, 2.0
    response, spread = np.sum(light * shape), sigma * np.sqrt(np.sum(shape**2))
    found = Detections(np.zeros((1, 2)), np.eye(2)[None], *(np.array([x]) for x in (light.sum(), 30.0, 2.5, 1.5, 0.0)))
    assert matched_snr(found, sigma)[0] == pytest.approx(response / spread, rel=1e-3)


def test_a_round_bright_spot_looks_most_like_that_of_a_laser():
    """Beside it a fainter one, a streak, a bar and the corner of a bright square; each as the fit of its moments."""
    v, u = np.mgrid[:80, :400].astype(float)

    def gaussian(at: float, major: float, minor: float) -> np.ndarray:
        return np.exp(-0.5 * (((u - at) / major) ** 2 + ((v - 40) / minor) ** 2))

    light = 250 * gaussian(40, 3, 3) + 100 * gaussian(120, 3, 3) + 200 * gaussian(200, 9, 3)
    light[37:44, 265:296], light[40:, 360:] = 240.0, 240.0
    image = np.clip(light + 10.0, 0, 255).astype(np.uint8)
    places = np.column_stack([[40.0, 120.0, 200.0, 280.0, 361.0], [40.0, 40.0, 40.0, 40.0, 41.0]])
    major, minor = np.array([3.0, 3.0, 9.0, 9.0, 3.0]), np.array([3.0, 3.0, 3.0, 2.0, 3.0])
    found = Detections(places, np.tile(np.eye(2), (5, 1, 1)), major, major, major, minor, major)
    likeness = laser_likeness(image, found, 255.0)
    assert likeness[0] > 0.95
    assert np.all(likeness[1:] < 0.8)
    assert np.all(likeness >= 0.0)


def test_a_light_beside_a_spot_lowers_its_likeness_alike_on_either_side():
    v, u = np.mgrid[:60, :61].astype(float)
    light = 250 * np.exp(-0.5 * ((u - 30) ** 2 + (v - 30) ** 2) / 9)
    image = np.clip(light + 10.0, 0, 255).astype(np.uint8)
    beside = image.copy()
    beside[20:40, 37:39] = 200
    found = Detections(np.array([[30.0, 30.0]]), np.eye(2)[None], *(np.array([x]) for x in (1e4, 250.0, 3.0, 3.0, 0.0)))
    alone, right, left, below = (
        laser_likeness(np.ascontiguousarray(p), found, 255.0)[0]
        for p in (image, beside, beside[:, ::-1], beside[:, :60].T)
    )
    assert right < 0.8 * alone
    assert right == pytest.approx(left, rel=1e-6)
    assert right == pytest.approx(below, rel=1e-6)


def test_the_memory_for_figures_is_bounded():
    collection, n = SpotCollection(), MOST_KEPT // 8
    found = Detections(np.zeros((n, 2)), np.zeros((n, 2, 2)), *(np.zeros(n) for _ in range(5)))
    for frame in range(20):
        collection.add(frame, found, np.zeros(n), np.zeros(n))
    assert collection.total == 20 * n
    assert len(collection.table()) <= MOST_KEPT
