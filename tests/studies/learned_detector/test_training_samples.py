"""The truth of training samples follows their pictures through reduction, movement and turn."""

from __future__ import annotations

import numpy as np
import pytest

from studies.learned_detector import samples as dataset
from studies.learned_detector.samples import (
    DIAMETERS_PX,
    RENDERED_PX,
    SIZE_PX,
    Sample,
    augmented,
    level_sample,
    middle,
    rendered,
    structured_picture,
)


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
    def drawn_disc(rng, size_px, diameters_px):
        assert diameters_px == pytest.approx(np.array(DIAMETERS_PX) * size_px[0] / RENDERED_PX)
        centre, diameter = rng.uniform(0.3, 0.7, 2) * size_px, 0.15 * size_px[0]
        return Sample(disc(centre, diameter, size_px[0]), (float(centre[0]), float(centre[1])), diameter)

    monkeypatch.setattr(dataset, "draw_sample", drawn_disc)
    rng = np.random.default_rng(3)
    for _ in range(12):
        sample = level_sample(rng)
        assert sample.image.shape == (RENDERED_PX, RENDERED_PX)
        assert np.hypot(*(centroid(sample.image.astype(float)) - sample.centre_px)) < 0.1
        assert sample.diameter_px == pytest.approx(0.15 * RENDERED_PX)


def test_rendered_samples_are_kept_and_used_again(tmp_path, monkeypatch):
    monkeypatch.setattr(dataset, "CHUNK", 3)
    images, truth = rendered(5, 7, tmp_path)
    assert images.shape == (5, RENDERED_PX, RENDERED_PX)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["samples_7_0.npz", "samples_7_1.npz"]
    monkeypatch.setattr(dataset, "level_sample", None)
    again, same = rendered(5, 7, tmp_path)
    np.testing.assert_array_equal(images, again)
    np.testing.assert_array_equal(truth, same)


def test_structured_backgrounds_have_contrast_and_follow_their_seed():
    pictures = [structured_picture(np.random.default_rng(k), (80, 60)) for k in range(12)]
    assert all(p.shape == (60, 80, 3) and p.std() > 1.5 for p in pictures)
    np.testing.assert_array_equal(pictures[5], structured_picture(np.random.default_rng(5), (80, 60)))
