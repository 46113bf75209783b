"""The truth of training samples follows their pictures through reduction, movement and turn."""

from __future__ import annotations

import numpy as np
import pytest

from studies.learned_detector import samples as dataset
from studies.learned_detector.samples import (
    BESIDE,
    DIAMETERS_PX,
    RENDERED_PX,
    SIZE_PX,
    SMALL_PX,
    Sample,
    augmented,
    draw_sample,
    level_sample,
    middle,
    rendered,
    structured_picture,
)
from studies.learned_detector.train import STRIDE, targets


def disc(centre, diameter, side=RENDERED_PX):
    v, u = np.mgrid[:side, :side]
    distance = np.hypot(u - centre[0], v - centre[1])
    return (200 * np.clip(diameter / 2 - distance + 0.5, 0, 1)).astype(np.uint8)


def centroid(picture):
    weight = picture - picture.min()
    v, u = np.mgrid[: picture.shape[0], : picture.shape[1]]
    return np.array([(u * weight).sum(), (v * weight).sum()]) / weight.sum()


@pytest.fixture(scope="module")
def discs():
    rng = np.random.default_rng(1)
    truth = np.column_stack([rng.uniform(60, 84, (40, 2)), rng.uniform(9, 20, 40)])
    return np.stack([disc(t[:2], t[2]) for t in truth]), truth


def test_the_truth_moves_with_the_picture(discs):
    rng = np.random.default_rng(2)
    for _ in range(4):
        pictures, wanted = augmented(*discs, rng)
        whole = (wanted[:, :2] > 14).all(axis=1) & (wanted[:, :2] < SIZE_PX - 15).all(axis=1)
        assert whole.sum() > 5
        for picture, (u, v, diameter) in zip(pictures[whole], wanted[whole], strict=True):
            assert np.hypot(*(centroid(picture) - [u, v])) < 0.3
            area = ((picture - picture.min()) / np.ptp(picture)).sum()
            assert 2 * np.sqrt(area / np.pi) == pytest.approx(diameter, rel=0.06)


def test_a_drogue_that_leaves_the_part_is_no_longer_there():
    pictures = np.stack([disc((4.0, 4.0), 10.0)] * 3)
    _, wanted = middle(pictures, np.array([[4.0, 4.0, 10.0]] * 3))
    assert np.isnan(wanted).all()


def test_a_reduced_sample_has_its_drogue_where_the_truth_says(monkeypatch):
    def drawn_disc(rng, size_px, diameters_px, beside):
        assert beside == BESIDE
        smallest, largest = np.array(diameters_px) * RENDERED_PX / size_px[0]
        assert smallest == pytest.approx(DIAMETERS_PX[0])
        assert min(abs(largest - DIAMETERS_PX[1]), abs(largest - SMALL_PX)) < 1e-9
        centre, diameter = rng.uniform(0.3, 0.7, 2) * size_px, 0.15 * size_px[0]
        place = (float(centre[0]), float(centre[1]))
        return Sample(disc(centre, diameter, size_px[0]), place, diameter, ((*place, 2 * diameter),))

    monkeypatch.setattr(dataset, "draw_sample", drawn_disc)
    rng = np.random.default_rng(3)
    for _ in range(12):
        sample = level_sample(rng)
        assert sample.image.shape == (RENDERED_PX, RENDERED_PX)
        assert np.hypot(*(centroid(sample.image.astype(float)) - sample.centre_px)) < 0.1
        assert sample.diameter_px == pytest.approx(0.15 * RENDERED_PX)
        assert sample.beside[0] == pytest.approx((*sample.centre_px, 2 * sample.diameter_px))


def test_rendered_samples_are_kept_and_used_again(tmp_path, monkeypatch):
    monkeypatch.setattr(dataset, "CHUNK", 3)
    images, truth = rendered(5, 7, tmp_path)
    assert images.shape == (5, RENDERED_PX, RENDERED_PX)
    assert truth.shape == (5, 1 + BESIDE, 3)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["samples_7_0.npz", "samples_7_1.npz"]
    monkeypatch.setattr(dataset, "level_sample", None)
    again, same = rendered(5, 7, tmp_path)
    np.testing.assert_array_equal(images, again)
    np.testing.assert_array_equal(truth, same)


def test_structured_backgrounds_have_contrast_and_follow_their_seed():
    pictures = [structured_picture(np.random.default_rng(k), (80, 60)) for k in range(12)]
    assert all(p.shape == (60, 80, 3) and p.std() > 1.5 for p in pictures)
    np.testing.assert_array_equal(pictures[5], structured_picture(np.random.default_rng(5), (80, 60)))


def test_a_painted_drogue_has_its_centre_and_its_rim_where_the_truth_says(monkeypatch):
    monkeypatch.setattr(dataset, "_paint_hose", lambda *_: None)
    monkeypatch.setattr(dataset, "_occluders", lambda *_: ())
    v, u = np.mgrid[:80, :80]
    reaches, shifts = [], []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        centre, radius = rng.uniform(38, 42, 2), rng.uniform(6, 18)
        picture = np.full((80, 80), 300.0, np.float32)  # no level of a drogue is the background's
        dataset._paint_drogue(rng, picture, (float(centre[0]), float(centre[1])), 2 * radius)
        changed = np.abs(picture - 300.0) > 20
        assert changed.any()
        reaches.append(np.hypot(u - centre[0], v - centre[1])[changed].max() / radius)
        shifts.append(np.hypot(u[changed].mean() - centre[0], v[changed].mean() - centre[1]) / radius)
    assert 0.95 < np.median(reaches) < 1.1
    assert np.median(shifts) < 0.1


def test_empty_samples_have_decoys_but_no_truth_and_others_up_to_four_drogues_apart():
    rng = np.random.default_rng(11)
    empty = draw_sample(rng, (96, 96), (8.0, 30.0), empty=True, beside=3)
    assert np.isnan([*empty.centre_px, empty.diameter_px]).all()
    assert not empty.beside
    numbers = set()
    for _ in range(20):
        sample = draw_sample(rng, (128, 128), (8.0, 16.0), empty=False, beside=3)
        found = dataset._truth(sample)
        numbers.add(len(found))
        for i, one in enumerate(found):
            for other in found[:i]:
                assert np.hypot(*(one[:2] - other[:2])) > 0.7 * (one[2] + other[2])
    assert max(numbers) == 4


def test_each_drogue_of_a_picture_is_a_target_of_its_own():
    truth = np.array([[[20.0, 30.0, 10.0], [70.0, 60.0, 30.0], [np.nan] * 3], [[np.nan] * 3] * 3])
    heat, values, weight = targets(truth)
    assert heat[1].max() == weight[1].max() == 0.0
    for u, v, diameter in truth[0, :2]:
        i, j = int((v + 0.5) // STRIDE), int((u + 0.5) // STRIDE)
        assert heat[0, i, j] == 1.0
        du, dv, size = values[0, :, i, j]
        assert (STRIDE * (j + 0.5 + du) - 0.5, STRIDE * (i + 0.5 + dv) - 0.5) == pytest.approx((u, v))
        assert np.exp(size) == pytest.approx(diameter)
    assert (heat[0] == 1.0).sum() == 2
