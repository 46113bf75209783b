"""Blobs: centroids of discs with known centres, and what is not the target."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from tracking.single_target.blobs import BlobParameters, find_blobs


def disc(centre, radius, size=(240, 180), ground=140.0, ink=40.0, noise=1.5, seed=0):
    """A disc with soft edges on an even ground, (h, w), 8 bit."""
    w, h = size
    v, u = np.mgrid[:h, :w]
    cover = np.clip(radius + 0.5 - np.hypot(u - centre[0], v - centre[1]), 0, 1)
    grey = ground + (ink - ground) * cover + noise * np.random.default_rng(seed).standard_normal((h, w))
    return np.clip(np.round(grey), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("polarity", ["darker", "brighter"])
@pytest.mark.parametrize("centre", [(100.0, 80.0), (101.37, 77.81)])
def test_the_centroid_of_a_disc_is_its_centre(polarity, centre):
    ink = 40.0 if polarity == "darker" else 230.0
    found = find_blobs(disc(centre, 9.0, ink=ink), BlobParameters(polarity=polarity))
    assert len(found) == 1
    np.testing.assert_allclose(found.uv_px[0], centre, atol=0.05)
    assert found.major_px[0] == pytest.approx(4.5, rel=0.1)  # half the radius


@pytest.mark.parametrize("polarity", ["darker", "brighter"])
def test_a_slope_of_the_background_does_not_move_the_centroid(polarity):
    ink, ground = (20.0, 140.0) if polarity == "darker" else (250.0, 120.0)
    slope = ground + 0.4 * (np.arange(240) - 120.0) + np.zeros((180, 1))
    found = find_blobs(disc((120.4, 90.2), 8.0, ground=slope, ink=ink), BlobParameters(polarity=polarity))
    np.testing.assert_allclose(found.uv_px[0], (120.4, 90.2), atol=0.05)


def test_16_bit_pictures_give_the_same_place():
    picture = disc((100.3, 80.6), 8.0)
    narrow, wide = (find_blobs(p, BlobParameters()) for p in (picture, picture.astype(np.uint16) * 256))
    np.testing.assert_allclose(narrow.uv_px, wide.uv_px, atol=1e-3)


def test_an_empty_picture_has_no_blob():
    assert len(find_blobs(disc((100, 80), 0.0, ink=140.0), BlobParameters())) == 0
    assert len(find_blobs(np.full((60, 80), 7, np.uint8), BlobParameters())) == 0


def test_what_touches_the_edge_or_is_too_large_is_left_out():
    assert len(find_blobs(disc((3.0, 80.0), 9.0), BlobParameters())) == 0
    line = disc((100, 80), 9.0)
    cv2.line(line, (20, 5), (20, 170), 30, 3)
    found = find_blobs(line, BlobParameters(max_size_px=100.0))
    assert len(found) == 1
    np.testing.assert_allclose(found.uv_px[0], (100, 80), atol=0.1)


def test_the_stronger_blob_comes_first():
    picture = np.minimum(disc((60, 80), 5.0), disc((150, 90), 9.0, seed=1))
    found = find_blobs(picture, BlobParameters())
    assert len(found) == 2
    np.testing.assert_allclose(found.uv_px, [(150, 90), (60, 80)], atol=0.2)


@pytest.mark.parametrize("ink", [40.0, 230.0])
def test_a_disc_comes_before_a_part_of_a_cloud_with_a_larger_sum_of_contrasts(ink):
    v, u = np.mgrid[:180, :240]
    cloud = np.sign(ink - 140) * 70 * np.exp(-(np.hypot(u - 60, v - 80) ** 2) / (2 * 9.0**2))
    picture = disc((150.3, 90.2), 5.0, ground=140 + cloud, ink=ink)
    found = find_blobs(picture, BlobParameters(polarity="darker" if ink < 140 else "brighter"))
    assert len(found) == 2
    assert found.flux[1] > 1.5 * found.flux[0]
    np.testing.assert_allclose(found.uv_px[0], (150.3, 90.2), atol=0.1)


@pytest.mark.parametrize(("radius", "noise"), [(4.0, 1.5), (9.0, 1.5), (9.0, 5.0)])
def test_the_stated_sigma_is_that_of_the_errors_at_all_places_between_the_pixels(radius, noise):
    centres = np.array([100.0, 80.0]) + np.random.default_rng(3).uniform(-0.5, 0.5, (40, 2))
    found = [find_blobs(disc(c, radius, noise=noise, seed=k), BlobParameters()) for k, c in enumerate(centres)]
    errors = np.array([f.uv_px[0] for f in found]) - centres
    stated = np.sqrt(np.mean([f.cov_px2[0, 0, 0] for f in found]))
    assert stated / 2.5 < errors[:, 0].std() < 1.5 * stated


@pytest.mark.parametrize("polarity", ["darker", "brighter"])
@pytest.mark.parametrize("radius", [95.0, 110.0, 130.0])
def test_parts_of_the_edge_of_a_target_larger_than_the_picture_are_no_target(polarity, radius):
    """The disc reaches beyond the upper and the lower edge; beyond it the left and right ends of its rim are seen."""
    ink = 40.0 if polarity == "darker" else 230.0
    found = find_blobs(disc((120.0, 90.0), radius, ink=ink), BlobParameters(polarity=polarity))
    assert np.all(found.major_px < 2.5)  # at most a few pixels of noise; the ends are 150 px long


def test_a_target_larger_than_the_square_of_the_background_has_its_centre_if_it_is_seen_whole():
    found = find_blobs(disc((120.4, 88.7), 60.0), BlobParameters())
    assert len(found) == 1
    np.testing.assert_allclose(found.uv_px[0], (120.4, 88.7), atol=1.0)
