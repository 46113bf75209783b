"""Points of light that stay in their place are learnt; spots, which move or are labelled, are not."""

from __future__ import annotations

import numpy as np
import pytest

from geometry.arrays import Array
from tracking.rigid_body.static_points import FADES, LEAST_SEEN, StaticPlaces, learn, log_density, no_places

SIGMA_PX = 0.05
FAR_PX = np.array([[900.0, 900.0]])
CAMERA_OF = np.zeros(1, dtype=np.int64)  # one view: camera 0 sees one spot
FIRST = np.array([0, 1, 1])  # the only point is camera 0's
SEEN = np.ones(2, dtype=bool)
NO_LABEL, LABELLED = np.array([-1]), np.array([0])


def cov(points: Array) -> Array:
    return np.tile(SIGMA_PX**2 * np.eye(2), (len(points), 1, 1))


def after(places: StaticPlaces, path: Array, assigned: Array, expected: Array, fades: float = FADES) -> StaticPlaces:
    """What was learnt from frames in which one point is at path (T, 2), px, and the spot's place expected (T, 2)."""
    rng = np.random.default_rng(1)
    for at, spot in zip(path, expected, strict=True):
        uv = (at + SIGMA_PX * rng.normal(size=2))[None]
        learn(places, uv, cov(uv), FIRST, SEEN, assigned, spot[None], CAMERA_OF, fades)
    return places


def density_at(places: StaticPlaces, uv: Array) -> float:
    return float(log_density(places, uv, cov(uv), FIRST)[0])


STILL = np.tile([[400.0, 300.0]], (30, 1))
AWAY = np.tile(FAR_PX, (30, 1))
MOVING = STILL + 2.0 * np.arange(30)[:, None]  # 2.8 px per frame


def test_a_reflection_is_learnt_as_static_within_a_few_frames():
    places = no_places(2)
    few = int(LEAST_SEEN) - 1
    after(places, STILL[:few], NO_LABEL, AWAY[:few])
    assert density_at(places, STILL[:1]) == -np.inf
    after(places, STILL[few:], NO_LABEL, AWAY[few:])
    # It is there in every frame: 1 over a disc of five sigmas or 0.4 px.
    assert density_at(places, STILL[:1]) == pytest.approx(-np.log(np.pi * 0.4**2), abs=0.05)
    assert density_at(places, STILL[:1] + 5.0) == -np.inf
    camera_1 = log_density(places, STILL[:1], cov(STILL[:1]), np.array([0, 0, 1]))
    assert camera_1[0] == -np.inf


def test_a_spot_that_moves_without_a_label_is_not_static():
    places = after(no_places(2), MOVING, NO_LABEL, AWAY)
    assert all(density_at(places, at[None]) == -np.inf for at in MOVING)


def test_a_labelled_spot_at_rest_is_not_static():
    places = after(no_places(2), STILL, LABELLED, AWAY)
    assert density_at(places, STILL[:1]) == -np.inf


def test_a_point_where_a_spot_is_expected_is_not_static_though_its_label_is_missing():
    places = after(no_places(2), STILL, NO_LABEL, STILL + 1.0)
    assert density_at(places, STILL[:1]) == -np.inf


def test_a_reflection_that_is_gone_is_forgotten_and_over_a_whole_run_it_is_not():
    for fades, forgotten in ((FADES, True), (1.0, False)):
        places = after(no_places(2), STILL, NO_LABEL, AWAY, fades)
        none = np.zeros((0, 2))
        for _ in range(300):
            learn(places, none, cov(none), np.zeros(3, dtype=np.int64), SEEN, NO_LABEL, FAR_PX, CAMERA_OF, fades)
        assert (density_at(places, STILL[:1]) == -np.inf) == forgotten


def test_a_camera_without_a_picture_forgets_nothing():
    places = after(no_places(2), STILL, NO_LABEL, AWAY)
    before = density_at(places, STILL[:1])
    none = np.zeros((0, 2))
    for _ in range(500):
        no_picture = np.zeros(2, dtype=bool)
        learn(places, none, cov(none), np.zeros(3, dtype=np.int64), no_picture, NO_LABEL, FAR_PX, CAMERA_OF, FADES)
    assert density_at(places, STILL[:1]) == before
