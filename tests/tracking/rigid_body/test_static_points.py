"""Points of light that stay in their place are detected as static; spots, which move or are labelled, are not."""

from __future__ import annotations

import numpy as np
import pytest

from geometry.arrays import Array
from tracking.rigid_body.online_estimates import (
    DECAY,
    MIN_SEEN,
    PicturePoints,
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


def after(places: StaticPlaces, path: Array, assigned: Array, expected: Array, decay: float = DECAY) -> StaticPlaces:
    """Places after frames with one point at path (T, 2), px, and the spot expected at (T, 2), px."""
    rng = np.random.default_rng(1)
    for at, spot in zip(path, expected, strict=True):
        uv = (at + SIGMA_PX * rng.normal(size=2))[None]
        points = PicturePoints(uv, noise(uv), FIRST, HAS_IMAGE)
        update_places(places, points, assigned, spot[None], CAMERA_OF, decay)
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


def test_a_spot_that_moves_without_a_label_is_not_static():
    places = after(no_places(2), MOVING, NO_LABEL, AWAY)
    assert all(density_at(places, at[None]) == -np.inf for at in MOVING)


def test_a_labelled_spot_at_rest_is_not_static():
    places = after(no_places(2), STILL, LABELLED, AWAY)
    assert density_at(places, STILL[:1]) == -np.inf


def test_an_unlabelled_point_near_an_expected_spot_is_not_static():
    places = after(no_places(2), STILL, NO_LABEL, STILL + 1.0)
    assert density_at(places, STILL[:1]) == -np.inf


def test_a_reflection_that_is_gone_is_forgotten_unless_counts_do_not_decay():
    for decay, forgotten in ((DECAY, True), (1.0, False)):
        places = after(no_places(2), STILL, NO_LABEL, AWAY, decay)
        none = np.zeros((0, 2))
        for _ in range(300):
            points = PicturePoints(none, noise(none), np.zeros(3, dtype=np.int64), HAS_IMAGE)
            update_places(places, points, NO_LABEL, FAR_PX, CAMERA_OF, decay)
        assert (density_at(places, STILL[:1]) == -np.inf) == forgotten


def test_the_places_of_a_camera_without_a_picture_do_not_decay():
    places = after(no_places(2), STILL, NO_LABEL, AWAY)
    before = density_at(places, STILL[:1])
    none = np.zeros((0, 2))
    for _ in range(500):
        no_picture = np.zeros(2, dtype=bool)
        points = PicturePoints(none, noise(none), np.zeros(3, dtype=np.int64), no_picture)
        update_places(places, points, NO_LABEL, FAR_PX, CAMERA_OF, DECAY)
    assert density_at(places, STILL[:1]) == before
