"""`beampose track point`: tables, statuses and verdicts for good and bad input."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest

from lab.findings.finding import Level, verdict
from lab.targets.point import COLUMNS, PointOptions, PointTarget
from lab.targets.track import track_target
from studies.duan2020 import compare_duan2020
from tests.lab.command import typed
from tests.lab.tables import rows_of

FRAMES = 30


def path_of(k):
    return np.array([40.0 + 1.5 * k, 60.0 + 0.5 * k])


def picture(k, ink=40, ground=150):
    """A disc of radius 6 px on an even ground with a little noise, 8 bit."""
    v, u = np.mgrid[:120, :160]
    cover = np.clip(6.5 - np.hypot(u - path_of(k)[0], v - path_of(k)[1]), 0, 1)
    noise = np.random.default_rng(k).normal(0, 1.5, u.shape)
    return np.clip(ground + (ink - ground) * cover + noise, 0, 255).round().astype(np.uint8)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Pictures of a black disc; two are missing, one shows nothing, one is damaged."""
    out = tmp_path_factory.mktemp("pictures") / "disc"
    out.mkdir()
    for k in range(FRAMES):
        if k in (10, 11):
            continue
        shown = np.full((120, 160), 150, np.uint8) if k == 15 else picture(k)
        cv2.imwrite(str(out / f"{k:04d}.png"), shown)
    (out / "0020.png").write_bytes((out / "0020.png").read_bytes()[:200])
    return out


def track_of(out):
    return rows_of(out / "track.csv")


def write_points(path, places, header="frame,u_px,v_px"):
    path.write_text(header + "\n" + "".join(f"{k},{u},{v}\n" for k, (u, v) in places.items()))
    return path


def test_a_black_target_in_pictures_is_tracked_through_missing_pictures(folder, tmp_path):
    outcome = track_target(PointTarget(PointOptions("darker", rate_hz=50.0, overlay=True)), folder, tmp_path / "out")
    rows = track_of(tmp_path / "out")
    assert [int(r["frame"]) for r in rows] == list(range(FRAMES))
    words = [r["status"] for r in rows]
    assert [k for k, w in enumerate(words) if w != "measured"] == [10, 11, 15, 20]
    assert set(words) == {"measured", "predicted"}
    for k, r in enumerate(rows):
        error = np.array([float(r["u_px"]), float(r["v_px"])]) - path_of(k)
        assert np.abs(error).max() < 0.3
        assert np.abs(error).max() < 5 * float(r["sigma_u_px"])
    assert float(rows[-1]["velocity_u_px_s"]) == pytest.approx(75.0, abs=4.0)
    assert float(rows[-1]["t_s"]) == pytest.approx((FRAMES - 1) / 50)
    assert (verdict(outcome.findings), outcome.exit_status) == (Level.WARN, 0)
    assert [f.code for f in outcome.findings] == ["BP-N02", "BP-N06"]
    video = cv2.VideoCapture(str(tmp_path / "out" / "overlay.mp4"))
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) == FRAMES
    page = (tmp_path / "out" / "report.html").read_text("utf-8")
    assert "BP-N06" in page
    assert not any(word in page for word in ("http://", "https://", ">nan", "None"))


def clouds(seed, sky=120.0, cloud=200.0):
    """Broken clouds before the sky, (180, 240), DN, with structure of all sizes from 4 to 30 px."""
    rng, out = np.random.default_rng(seed), np.zeros((180, 240))
    for share, size_px in ((1.0, 30), (0.4, 10), (0.2, 4)):
        part = cv2.GaussianBlur(rng.normal(size=out.shape), (0, 0), size_px)
        out += share * (part - part.mean()) / part.std()
    return sky + (cloud - sky) / (1 + np.exp(-6 * out))


@pytest.mark.parametrize("detector", ["darker", "brighter"])
@pytest.mark.parametrize("seed", range(4))
def test_a_disc_before_clouds_has_its_own_centre_in_all_frames_in_which_it_is_measured(detector, seed, tmp_path):
    source, scene = tmp_path / "disc", clouds(seed)
    source.mkdir()
    v, u = np.mgrid[:180, :240]
    for k in range(FRAMES):
        cover = np.clip(6.5 - np.hypot(u - 2 * path_of(k)[0], v - path_of(k)[1]), 0, 1)
        shown = scene * (1 - cover) + 25 * cover + np.random.default_rng(k).normal(0, 3, u.shape)
        shown = np.clip(shown if detector == "darker" else 255 - shown, 0, 255).round().astype(np.uint8)
        cv2.imwrite(str(source / f"{k:04d}.png"), shown)
    typed("track", "point", source, "--out", tmp_path / "out", "--detector", detector)
    places = {k: (r["u_px"], r["v_px"]) for k, r in enumerate(track_of(tmp_path / "out")) if r["status"] == "measured"}
    errors = [np.hypot(float(u) - 2 * path_of(k)[0], float(v) - path_of(k)[1]) for k, (u, v) in places.items()]
    assert len(errors) >= 5
    assert max(errors) < 0.5


def test_the_summary_has_what_other_results_have(folder, tmp_path):
    track_target(PointTarget(PointOptions("darker")), folder, tmp_path / "out")
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["counts"]["status"] == {"measured": 26, "predicted": 4, "lost": 0}
    assert summary["inputs"][0]["sha256"]
    assert summary["versions"]["numpy"]
    assert summary["verdict"]["status"] == "check"
    assert summary["parameters"]["blobs"]["polarity"] == "darker"
    assert summary["events"] == [{"frame": 0, "kind": "acquired", "targets": 1}]
    track_target(PointTarget(PointOptions("darker")), folder, tmp_path / "out")  # replaces its own results


def test_a_plain_table_is_tracked_and_irregular_times_count(tmp_path):
    rng = np.random.default_rng(1)
    t = np.cumsum(rng.uniform(0.05, 0.15, 60))
    lines = [f"{k},{s:.6f},{100 * s:.4f},{50 - 20 * s:.4f},0.1,0.1" for k, s in enumerate(t) if k % 20 != 13]
    table = tmp_path / "points.csv"
    table.write_text("frame,t_s,u_px,v_px,sigma_u_px,sigma_v_px\n" + "\n".join(lines) + "\n")
    outcome = track_target(PointTarget(), table, tmp_path / "out")
    assert outcome.result.statuses() == {"measured": 57, "predicted": 3, "lost": 0}
    last = track_of(tmp_path / "out")[-1]
    assert float(last["velocity_u_px_s"]) == pytest.approx(100, abs=3)
    assert tuple(track_of(tmp_path / "out")[0]) == COLUMNS


def test_without_a_frame_rate_there_are_no_seconds(tmp_path):
    table = write_points(tmp_path / "points.csv", {k: path_of(k) for k in range(10)})
    track_target(PointTarget(), table, tmp_path / "out")
    last = track_of(tmp_path / "out")[-1]
    assert (last["t_s"], last["velocity_u_px_s"]) == ("", "")
    assert float(last["velocity_u_px_frame"]) == pytest.approx(1.5, abs=1e-6)


def test_a_target_that_is_not_there_is_a_failed_gate_without_positions(folder, tmp_path):
    done = typed("track", "point", folder, "--out", tmp_path / "out", "--detector", "brighter")
    assert done.exit_code == 4
    assert done.output.startswith("disc: FAIL: 0 of 30 frames measured (no target was found in 30 frames")
    rows = track_of(tmp_path / "out")
    assert {r["status"] for r in rows} == {"lost"}
    assert all(r["u_px"] == r["sigma_u_px"] == r["c00"] == "" for r in rows)
    assert "BP-N01" in (tmp_path / "out" / "report.html").read_text("utf-8")


def test_too_few_measured_frames_fail_the_gate(folder, tmp_path):
    outcome = track_target(PointTarget(PointOptions("darker", min_measured=0.9)), folder, tmp_path / "out")
    assert (verdict(outcome.findings), outcome.exit_status) == (Level.FAIL, 4)
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["verdict"]["exit_status"] == 4
    assert "FAIL" in (tmp_path / "out" / "report.html").read_text("utf-8")


def test_two_similar_targets_are_reported_and_one_can_be_chosen(tmp_path):
    lines = [f"{k},{u},{v}" for k in range(20) for u, v in (path_of(k), path_of(k) + np.array([300, 0]))]
    table = tmp_path / "two.csv"
    table.write_text("frame,u_px,v_px\n" + "\n".join(lines) + "\n")
    assert "BP-N05" in [f.code for f in track_target(PointTarget(), table, tmp_path / "out").findings]
    chosen = track_target(PointTarget(PointOptions(near_px=(345.0, 60.0))), table, tmp_path / "other")
    assert verdict(chosen.findings) is Level.PASS
    assert chosen.result.frames[-1].place[0] == pytest.approx(path_of(19)[0] + 300, abs=0.1)


def test_a_target_at_rest_before_a_scene_is_ambiguous_until_its_place_is_stated(tmp_path):
    places = np.array([[40.0, 60.0], [200, 50], [90, 210], [300, 150]])
    lines = [f"{k},{u},{v}" for k in range(20) for u, v in places]
    table = tmp_path / "scene.csv"
    table.write_text("frame,u_px,v_px\n" + "\n".join(lines) + "\n")
    outcome = track_target(PointTarget(), table, tmp_path / "out")
    assert outcome.exit_status == 4
    assert {"BP-N01", "BP-N05"} <= {f.code for f in outcome.findings}
    assert "--near" in next(f for f in outcome.findings if f.code == "BP-N01").remedy
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["counts"]["not_measured"]["ambiguous"] == 18
    assert {r["u_px"] for r in track_of(tmp_path / "out")} == {""}
    chosen = track_target(PointTarget(PointOptions(near_px=(205.0, 60.0))), table, tmp_path / "other")
    assert verdict(chosen.findings) is Level.PASS
    assert chosen.result.frames[0].place[0] == pytest.approx(200, abs=0.1)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("frame,u_px\n0,1\n", "expected a column 'v_px'"),
        ("frame,u_px,v_px\n", "expected rows"),
        ("frame,u_px,v_px\n0,a,b\n", "not a finite number"),
        ("frame,u_px,v_px\n0,1,1\n900000000,2,2\n", "time stamps"),
        ("frame,camera,u_px,v_px\n0,left,1,1\n0,right,5,5\n", "expected points of one camera, got left, right"),
        ("frame,t_s,u_px,v_px\n0,1.0,1,1\n1,0.5,5,5\n", "t_s: expected times that rise"),
        ("", "an empty file"),
    ],
)
def test_a_table_that_cannot_be_used_is_one_plain_line(tmp_path, text, words):
    table = tmp_path / "points.csv"
    table.write_text(text)
    done = typed("track", "point", table, "--out", tmp_path / "out")
    assert done.exit_code == 2
    assert words in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--camera", "left"], "expected a table with a column camera"),
        (["--near", "5"], "requires 2 arguments"),
        (["--near", "nan", "5"], "finite"),
        (["--set", "track.sigma_a=1"], "unknown key"),
        (["--set", "track.p_gate=2"], "expected a number between 0 and 1"),
    ],
)
def test_an_option_that_cannot_be_used_is_exit_status_2(folder, tmp_path, arguments, words):
    done = typed("track", "point", folder, "--out", tmp_path / "out", *arguments)
    assert done.exit_code == 2
    assert words in done.stderr


def test_the_study_shows_why_a_gate_is_needed():
    study = compare_duan2020(seed=2, scenes=2)
    hidden = "largest error, 20 hidden frames, with false detections"
    assert study.value(hidden, "beampose") < 0.1 * study.value(hidden, "corrected")
    in_view = "RMS error in view, without false detections"
    assert study.value(in_view, "beampose") < 0.85 * study.value(in_view, "detections")
    nees = "NEES per coordinate, without false detections"
    assert study.value(nees, "as printed") < 0, "the printed covariance has negative variances"
    assert 0.7 < study.value(nees, "beampose") < 1.3


def coloured(k, bgr=(40, 40, 190)):
    """The disc in colour on a grey ground, before a brighter grey one."""
    v, u = np.mgrid[:120, :160]
    out = np.full((120, 160, 3), 150.0)
    for place, ink in ((np.array([120.0, 20.0]), (250, 250, 250)), (path_of(k), bgr)):
        cover = np.clip(6.5 - np.hypot(u - place[0], v - place[1]), 0, 1)[..., None]
        out += cover * (np.asarray(ink, float) - out)
    noise = np.random.default_rng(k).normal(0, 1.5, out.shape)
    return np.clip(out + noise, 0, 255).round().astype(np.uint8)


@pytest.mark.parametrize("kind", ["pictures", "video"])
@pytest.mark.parametrize("name", ["red", "#be2828"])
def test_a_coloured_target_is_tracked(kind, name, tmp_path):
    if kind == "video":
        source = tmp_path / "ball.avi"
        writer = cv2.VideoWriter(str(source), cv2.VideoWriter.fourcc(*"MJPG"), 25.0, (160, 120))
        for k in range(FRAMES):
            writer.write(np.full((120, 160, 3), 150, np.uint8) if k == 15 else coloured(k))
        writer.release()
    else:
        source = tmp_path / "ball"
        source.mkdir()
        for k in range(FRAMES):
            shown = np.full((120, 160, 3), 150, np.uint8) if k == 15 else coloured(k)
            cv2.imwrite(str(source / f"{k:04d}.png"), shown)
    arguments = ["track", "point", str(source), "--out", str(tmp_path / "out"), "--detector", "colour", "--colour"]
    result = typed(*arguments, name)
    assert result.exit_code == 0, result.output
    rows = track_of(tmp_path / "out")
    assert [k for k, r in enumerate(rows) if r["status"] != "measured"] == [15]
    errors = [np.hypot(*(np.array([float(r["u_px"]), float(r["v_px"])]) - path_of(k))) for k, r in enumerate(rows)]
    assert max(errors) < 0.5


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--detector", "colour"], "expected --colour with red"),
        (["--detector", "colour", "--colour", "mauve"], "expected red, orange"),
        (["--detector", "colour", "--colour", "#808080"], "got the grey #808080"),
        (["--detector", "colour", "--colour", "red"], "got grey ones; use --detector darker"),
        (["--detector", "darker", "--colour", "red"], "belongs to --detector colour"),
    ],
)
def test_a_colour_that_cannot_be_searched_is_one_plain_line(arguments, words, folder, tmp_path):
    result = typed("track", "point", folder, "--out", tmp_path / "out", *arguments)
    assert result.exit_code == 2
    assert words in result.output
    assert len(result.output.strip().splitlines()) == 1
    assert not (tmp_path / "out").exists()


def test_a_target_of_another_colour_is_lost_and_never_reported(tmp_path):
    source = tmp_path / "ball"
    source.mkdir()
    for k in range(8):
        cv2.imwrite(str(source / f"{k:04d}.png"), coloured(k))
    options = PointOptions("colour", rate_hz=25.0, colour="blue")
    assert track_target(PointTarget(options), source, tmp_path / "out").exit_status == 4
    assert {r["status"] for r in track_of(tmp_path / "out")} == {"lost"}


@pytest.mark.parametrize(("bits", "shift"), [(8, 0), (10, 0), (12, 0), (12, 4), (14, 0), (16, 0)])
@pytest.mark.parametrize("suffix", ["png", "tiff"])
def test_colours_of_a_sensor_with_fewer_bits_than_its_files_are_found_as_in_8_bits(bits, shift, suffix, tmp_path):
    found = []
    for name, wide in (("narrow", False), ("wide", True)):
        (source := tmp_path / name).mkdir()
        for k in range(8):
            stored = coloured(k).astype(np.uint16) * 257 >> (16 - bits) << shift
            stored = stored >> 4 if k == 0 else stored  # unlit: the first picture alone does not show the bits
            cv2.imwrite(str(source / f"{k:04d}.{suffix}"), stored if wide else coloured(k))
        options = PointOptions("colour", rate_hz=25.0, colour="red")
        assert track_target(PointTarget(options), source, tmp_path / f"{name}-out").exit_status == 0
        found.append([[float(r["u_px"]), float(r["v_px"])] for r in track_of(tmp_path / f"{name}-out")[3:]])
    np.testing.assert_allclose(found[1], found[0], atol=0.1)


def test_a_video_that_ends_early_is_noted(tmp_path):
    path = tmp_path / "cut.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 25.0, (160, 120))
    for k in range(FRAMES):
        writer.write(cv2.cvtColor(picture(k), cv2.COLOR_GRAY2BGR))
    writer.release()
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    outcome = track_target(PointTarget(PointOptions("darker")), path, tmp_path / "out")
    assert any(f"of the {FRAMES} pictures that its header states" in note for note in outcome.result.recording.notes)


def test_a_gate_above_the_usual_share_of_measured_frames_counts_too(tmp_path):
    table = write_points(tmp_path / "points.csv", {k: path_of(k) for k in range(40) if k != 30})
    assert track_target(PointTarget(), table, tmp_path / "out").exit_status == 0
    assert track_target(PointTarget(PointOptions(min_measured=0.98)), table, tmp_path / "out").exit_status == 4
