"""The bench with peers judges rightly: scenes with exact truth, scores of trackers whose score is known.

No peer library is needed here; what they do is measured by `make bench-peers`.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bench.peers import command, ours, results
from bench.peers.identity import NAMING_FRAMES, score_identity
from bench.peers.rows import Tracked
from bench.peers.scenes import (
    CAMERA_OF,
    CLUTTER,
    DETECTED,
    FRAME_S,
    HIDDEN,
    NOISE_PX,
    OUTSIDE,
    SCENES,
    SIZE_PX,
    Scene,
    make_scene,
    rig,
)
from bench.peers.trackers import ENTRIES, Entry
from bench.peers.unseen import score_unseen
from geometry.forward_model import SpotModel

FRAMES = 400


@pytest.fixture(scope="module")
def scene() -> Scene:
    return make_scene("standard", 101, FRAMES)


def perfect(scene: Scene) -> Tracked:
    """Every spot in every frame at its true place under its own name."""
    frame, spot = np.nonzero(np.ones(scene.state.shape, dtype=bool))
    return Tracked(frame, CAMERA_OF[spot], spot, scene.uv_px[frame, spot], scene.state[frame, spot] == DETECTED, 1.0)


def swapped(scene: Scene, from_frame: int) -> Tracked:
    """As perfect, but spots 1 and 2 change names."""
    rows = perfect(scene)
    other = np.array([1, 0, 2, 3, 4, 5])[rows.identity]
    return replace(rows, identity=np.where(rows.frame >= from_frame, other, rows.identity))


# -- scenes -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SCENES)
def test_the_same_seed_gives_the_same_points_and_another_one_others(name):
    one, again, other = make_scene(name, 5, 60), make_scene(name, 5, 60), make_scene(name, 6, 60)
    for k in range(60):
        for c in (0, 1):
            np.testing.assert_array_equal(one.detections[k][c], again.detections[k][c])
            np.testing.assert_array_equal(one.origin[k][c], again.origin[k][c])
    assert not np.array_equal(one.uv_px[5:], other.uv_px[5:])


@pytest.mark.parametrize("name", SCENES)
def test_the_scenes_own_projection_and_the_forward_model_agree(name):
    """Two programs for one optical set-up: 1e-9 px is rounding (5e-13 was seen)."""
    scene = make_scene(name, 102, 300)
    there, _ = SpotModel.of(rig()).project(scene.poses)
    np.testing.assert_allclose(there, scene.uv_px, atol=1e-9)


@pytest.mark.parametrize("name", SCENES)
def test_every_detected_spot_is_among_the_points_once_with_the_stated_noise(name):
    scene = make_scene(name, 103, 300)
    count = np.zeros(scene.state.shape, dtype=int)
    errors = []
    for k in range(len(scene)):
        for c in (0, 1):
            points, origin = scene.detections[k][c], scene.origin[k][c]
            assert np.all((points >= -1) & (points <= SIZE_PX))  # a spot at the edge may lie outside by its noise
            real = origin != CLUTTER
            assert np.all(CAMERA_OF[origin[real]] == c)
            np.add.at(count[k], origin[real], 1)
            errors.append(points[real] - scene.uv_px[k, origin[real]])
    np.testing.assert_array_equal(count, scene.state == DETECTED)
    error = np.concatenate(errors)
    # The scatter of a sigma from n numbers is 1/sqrt(2 n): 5 of those.
    assert error.std() == pytest.approx(NOISE_PX, rel=5 / np.sqrt(2 * error.size))
    outside = np.any((scene.uv_px < 0) | (scene.uv_px > SIZE_PX - 1), axis=-1)
    np.testing.assert_array_equal(outside, scene.state == OUTSIDE)


def test_the_scenes_are_as_hard_as_they_say():
    step = {n: np.linalg.norm(np.diff(make_scene(n, 1).uv_px, axis=0), axis=-1) for n in SCENES}
    assert np.median(step["standard"]) == pytest.approx(2.9, abs=0.2)
    assert np.median(step["fast"]) == pytest.approx(12, abs=1)
    assert 35 < step["fast"].max() < 50
    dense, usual = make_scene("dense", 1, 300), make_scene("standard", 1, 300)
    per_picture = [np.mean([len(p) for found in s.detections for p in found]) for s in (usual, dense)]
    assert per_picture[0] < 4 < 11 < per_picture[1]
    out = make_scene("longout", 1).state == OUTSIDE
    ends = np.flatnonzero(np.diff(np.concatenate([[0], out[:, 2] | out[:, 5], [0]]).astype(int)))
    assert np.diff(ends)[::2].max() > 200  # frames that a spot of beam C stays away


# -- scores -----------------------------------------------------------------------------------------------------------


def test_a_perfect_tracker_scores_one(scene):
    score = score_identity(scene, perfect(scene))
    assert score.share == 1.0
    assert score.detected == np.count_nonzero(scene.state[NAMING_FRAMES:] == DETECTED)
    assert (score.wrong, score.gaps_kept, score.reentries_kept) == (0, score.gaps, score.reentries)
    assert min(score.gaps, score.reentries) > 0


@pytest.mark.parametrize("first", [NAMING_FRAMES, FRAMES // 2])
def test_swapped_names_cost_exactly_the_frames_after_the_swap(scene, first):
    score = score_identity(scene, swapped(scene, first))
    lost = np.count_nonzero(scene.state[first:, :2] == DETECTED)
    assert lost > 100
    assert score.detected - score.right == lost == score.wrong


def test_names_are_the_trackers_own(scene):
    rows = perfect(scene)
    renamed = replace(rows, identity=np.array([70, 71, 5, 9, 2, 3])[rows.identity])
    assert score_identity(scene, renamed) == score_identity(scene, rows)


def test_a_new_name_after_every_absence_keeps_no_gap(scene):
    seen = scene.state == DETECTED
    absences = np.cumsum(np.diff(seen.astype(int), axis=0, prepend=1) < 0, axis=0)
    rows = perfect(scene)
    rows = replace(rows, identity=rows.identity + 10 * absences[rows.frame, rows.identity])
    score = score_identity(scene, rows)
    assert score.gaps > 0
    assert score.reentries > 0
    assert (score.gaps_kept, score.reentries_kept, score.wrong) == (0, 0, 0)
    assert 0.05 < score.share < 0.5


@pytest.mark.parametrize("false_rows_first", [True, False])
def test_false_rows_beside_the_spots_break_no_gap(scene, false_rows_first):
    rows = perfect(scene)
    real = rows.measured
    beside = (rows.frame[real], rows.camera[real], 90 + np.arange(real.sum()), rows.uv_px[real] + [3.0, 0.0])
    true = (rows.frame, rows.camera, rows.identity, rows.uv_px)
    parts = (beside, true) if false_rows_first else (true, beside)
    frame, camera, identity, uv = (np.concatenate(pair) for pair in zip(*parts, strict=True))
    measured = np.concatenate([np.ones(len(p[0]), dtype=bool) if p is beside else real for p in parts])
    score = score_identity(scene, Tracked(frame, camera, identity, uv, measured, 1.0))
    assert score == score_identity(scene, rows)


def test_clutter_taken_for_a_hidden_spot_is_wrong(scene):
    rows = perfect(scene)
    lured = replace(rows, measured=np.ones_like(rows.measured))
    hidden = np.count_nonzero(scene.state[NAMING_FRAMES:] != DETECTED)
    assert score_identity(scene, lured).wrong == hidden > 0


def test_a_tracker_that_finds_nothing_scores_nothing(scene):
    score = score_identity(scene, Tracked.of([], 1.0))
    assert (score.share, score.labelled, score.gaps_kept, score.reentries_kept) == (0.0, 0, 0, 0)


def test_errors_of_unseen_spots_are_those_that_were_made(scene):
    rows = perfect(scene)
    moved = replace(rows, uv_px=rows.uv_px + np.where(rows.measured, 0.0, 1.0)[:, None] * [0.3, 0.4])
    for state in (HIDDEN, OUTSIDE):
        unseen = score_unseen(scene, moved, state)
        assert unseen.covered == 1.0
        np.testing.assert_allclose([unseen.rms_px, unseen.p95_px, unseen.max_px], 0.5, rtol=1e-9)
        # A detection that is claimed for such a spot is no estimate, however wrong.
        even = rows.frame % 2 == 0
        claimed = score_unseen(scene, replace(moved, measured=moved.measured | even), state)
        assert claimed.covered == np.mean(np.nonzero(scene.state == state)[0] % 2 == 1)


def test_motmetrics_agrees_on_the_perfect_and_the_swapped(scene):
    pytest.importorskip("motmetrics", reason="py-motmetrics is not installed (make peers)")
    from bench.peers.multi_object import score_multi_object

    good, bad = score_multi_object(scene, perfect(scene)), score_multi_object(scene, swapped(scene, FRAMES // 2))
    assert (good.idf1, good.switches, good.mota) == (1.0, 0, 1.0)
    assert bad.switches == 2
    assert bad.idf1 < 0.9 < bad.mota


# -- running ----------------------------------------------------------------------------------------------------------


def test_our_tracker_gets_no_labels_and_finds_them():
    scene = make_scene("standard", 101, 60)
    rows = ours.track(scene, "spots")
    assert rows.spent_s > 0
    assert score_identity(scene, rows).share == 1.0
    assert FRAME_S == 0.01


def test_a_missing_library_is_reported_and_the_others_are_measured(monkeypatch, tmp_path, capsys):
    monkeypatch.setitem(ENTRIES, "norfair", Entry("norfair", "adapters.with_norfair", "no_such_library"))
    out = tmp_path / "results.csv"
    arguments = ["--trackers", "spots", "norfair", "--scenes", "standard", "--seeds", "1", "1", "--frames", "60"]
    assert command.main([*arguments, "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert "| norfair | not installed: make peers |" in said
    assert "norfair: not installed: make peers" in said
    (only,) = results.read_results(out)
    assert (only.tracker, only.identity, only.frames) == ("spots", 1.0, 60)
    assert only.frames_per_s > 0


def test_a_tracker_that_fails_is_reported_and_the_others_are_measured(monkeypatch, tmp_path, capsys):
    monkeypatch.setitem(ENTRIES, "trackpy", Entry("trackpy", "ours", options={"colour": "red"}))
    arguments = ["--trackers", "spots", "trackpy", "--scenes", "standard", "--seeds", "1", "1", "--frames", "60"]
    assert command.main([*arguments, "--out", str(tmp_path / "results.csv")]) == 1
    said = capsys.readouterr()
    assert "trackpy on standard, seed 1: TypeError" in said.err
    assert "| spots | 1 | 1.0000 |" in said.out


def test_a_slow_tracker_takes_the_first_seeds_and_says_so():
    slow = Entry("spots", "ours", seeds=1)
    assert command.notes([slow], [101, 102])[0] == "spots: slow, seeds 101 only"
    assert not any("slow" in line for line in command.notes([slow], [101]))
    measured: list[results.Result] = []
    slow = Entry("spots", "ours", options={"method": "spots"}, seeds=1)
    assert command.run([slow], ["standard"], [101, 102], 40, measured.append) == []
    assert [r.seed for r in measured] == [101]


def test_results_read_back_as_written_and_newer_ones_replace_older(scene, tmp_path):
    entry = ENTRIES["spots"]
    old = results.judged(entry, scene, perfect(scene), np.nan, "long ago")
    other = replace(old, scene="dense")
    new = results.judged(entry, scene, swapped(scene, 200), 0.5, "today")
    path = tmp_path / "results.csv"
    results.write_results(results.merged([other, old], [new]), path)
    back = results.read_results(path)
    assert [r.key for r in back] == [new.key, other.key]
    assert (back[0].measured, back[0].wrong, back[0].of_rigid) == ("today", new.wrong, 2.0)
    assert np.isnan(back[1].of_rigid)
    assert back[0].identity == pytest.approx(new.identity, rel=1e-5)


def test_a_file_of_another_kind_is_not_overwritten(tmp_path, capsys):
    path = tmp_path / "results.csv"
    path.write_text("tracker,fps\nnorfair,2000\n")
    with pytest.raises(SystemExit, match="2"):
        command.main(["--trackers", "spots", "--frames", "30", "--out", str(path)])
    assert "the columns are not those of this bench; choose another --out" in capsys.readouterr().err
    assert path.read_text().startswith("tracker,fps\n")
