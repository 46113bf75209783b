"""Points of light that stay in their place are detected as static; spots, which move or are labelled, are not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from geometry.arrays import Array
from geometry.forward_model import SpotModel
from lab.simulate.scenarios import fan
from tracking.detections import Detections
from tracking.parameters import TrackerParameters
from tracking.rigid_body.frame_summary import FrameSummary
from tracking.rigid_body.online_estimates import (
    DECAY,
    MIN_SEEN,
    PicturePoints,
    PointStatistics,
    StaticPlaces,
    no_places,
    static_log_density,
    update_places,
)

SIGMA_PX = 0.05
FAR_PX = np.array([[900.0, 900.0]])
CAMERA_OF = np.zeros(1, dtype=np.int64)  # one view: camera 0 sees one spot
FIRST = np.array([0, 1, 1])  # the only point is camera 0's
HAS_IMAGE = np.ones(2, dtype=bool)
NO_LABEL, LABELLED = np.array([-1]), np.array([0])


def noise(points: Array) -> Array:
    return np.full(len(points), SIGMA_PX**2)


def after(places: StaticPlaces, path: Array, assigned: Array, expected: Array) -> StaticPlaces:
    """Places after frames with one point at path (T, 2), px, and the spot expected at (T, 2), px."""
    rng = np.random.default_rng(1)
    for at, spot in zip(path, expected, strict=True):
        uv = (at + SIGMA_PX * rng.normal(size=2))[None]
        points = PicturePoints(uv, noise(uv), FIRST, HAS_IMAGE)
        update_places(places, points, assigned, spot[None], CAMERA_OF, DECAY)
    return places


def density_at(places: StaticPlaces, uv: Array) -> float:
    return float(static_log_density(places, uv, noise(uv), FIRST)[0])


STILL = np.tile([[400.0, 300.0]], (30, 1))
AWAY = np.tile(FAR_PX, (30, 1))
MOVING = STILL + 2.0 * np.arange(30)[:, None]  # 2.8 px per frame


def test_a_reflection_becomes_static_within_a_few_frames():
    places = no_places(2)
    few = int(MIN_SEEN) - 1
    after(places, STILL[:few], NO_LABEL, AWAY[:few])
    assert density_at(places, STILL[:1]) == -np.inf
    after(places, STILL[few:], NO_LABEL, AWAY[few:])
    # It is there in every frame: density 1 over the area of a disc of 0.4 px.
    assert density_at(places, STILL[:1]) == pytest.approx(-np.log(np.pi * 0.4**2), abs=0.05)
    assert density_at(places, STILL[:1] + 5.0) == -np.inf
    camera_1 = static_log_density(places, STILL[:1], noise(STILL[:1]), np.array([0, 0, 1]))
    assert camera_1[0] == -np.inf


def test_each_of_a_hundred_points_at_rest_is_static():
    """Pictures in front of a photograph show some 70 of them."""
    uv = np.stack(np.meshgrid(np.arange(100.0, 600.0, 50.0), np.arange(100.0, 600.0, 50.0)), axis=-1).reshape(-1, 2)
    places, points = no_places(2), PicturePoints(uv, noise(uv), np.array([0, 100, 100]), HAS_IMAGE)
    for _ in range(10):
        update_places(places, points, NO_LABEL, FAR_PX, CAMERA_OF, DECAY)
    assert np.isfinite(static_log_density(places, uv, noise(uv), points.first)).all()


def test_a_spot_that_moves_without_a_label_is_not_static():
    places = after(no_places(2), MOVING, NO_LABEL, AWAY)
    assert all(density_at(places, at[None]) == -np.inf for at in MOVING)


def test_a_labelled_spot_at_rest_is_not_static():
    places = after(no_places(2), STILL, LABELLED, AWAY)
    assert density_at(places, STILL[:1]) == -np.inf


def test_an_unlabelled_point_near_an_expected_spot_is_not_static():
    places = after(no_places(2), STILL, NO_LABEL, STILL + 1.0)
    assert density_at(places, STILL[:1]) == -np.inf


def test_a_reflection_that_is_gone_is_forgotten():
    places = after(no_places(2), STILL, NO_LABEL, AWAY)
    none = np.zeros((0, 2))
    for frame in range(300):
        assert (density_at(places, STILL[:1]) > -np.inf) or frame > 50
        points = PicturePoints(none, noise(none), np.zeros(3, dtype=np.int64), HAS_IMAGE)
        update_places(places, points, NO_LABEL, FAR_PX, CAMERA_OF, DECAY)
    assert density_at(places, STILL[:1]) == -np.inf


def test_the_places_of_a_camera_without_a_picture_do_not_decay():
    places = after(no_places(2), STILL, NO_LABEL, AWAY)
    before = density_at(places, STILL[:1])
    none = np.zeros((0, 2))
    for _ in range(500):
        no_picture = np.zeros(2, dtype=bool)
        points = PicturePoints(none, noise(none), np.zeros(3, dtype=np.int64), no_picture)
        update_places(places, points, NO_LABEL, FAR_PX, CAMERA_OF, DECAY)
    assert density_at(places, STILL[:1]) == before


def test_an_object_that_stands_still_is_static_however_uncertain_the_place_of_its_middle_is():
    """A board of 25 px: its fit is 20 px off, by the same in all pictures."""
    model = SpotModel.of(fan())
    statistics = PointStatistics(model, TrackerParameters())
    board = replace(
        Detections.at(STILL[:1], 400.0 * np.eye(2)[None]), major_px=np.array([25.0]), place_px2=np.array([399.99])
    )
    found = [board if c == 0 else Detections.none() for c in range(len(model.camera_names))]
    n = len(model)
    away = np.full((n, 2), 900.0)
    summary = FrameSummary(
        np.zeros(n, bool), np.zeros(n, bool), away, np.zeros((n, 2, 2)), 0.0, 0.0, np.eye(6), away,
        np.zeros((n, 2, 6)), np.zeros(n, bool), np.zeros(len(found)), np.zeros(len(found)),
    )  # fmt: skip
    for _ in range(2 * int(MIN_SEEN)):
        statistics.update(statistics.frame(found, 1.0, False), np.full(n, -1), summary, measured=True)
    # As a spot it would have a density of 1 / (2 pi 400 px^2).
    assert statistics.frame(found, 1.0, False).log_static[0] > np.log(0.1)
