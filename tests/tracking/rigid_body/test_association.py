"""Data association: the joint search against all assignments."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from itertools import combinations, pairwise, permutations, product

import numpy as np
import pytest

from geometry.arrays import Array, Ints
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from lab.simulate.scenarios import RIGS
from tracking.rigid_body.association.frame_detections import (
    BLENDED,
    CLUTTER_RADIUS_PX,
    NOT_SEARCHED,
    DetectionModel,
    FrameDetections,
    Observation,
    ViewTable,
    detection_log_likelihood,
    distinct_spots,
    is_blended,
    log_clutter_ratio,
    p_in_picture,
)
from tracking.rigid_body.association.joint_search import GATE_CHI2, WIDE_PRUNE_NATS, associate
from tracking.rigid_body.models.occlusion import MISSED, P_BLACKOUT

RIG = RIGS["fan"]()
MODEL = SpotModel.of(RIG)
N = len(MODEL)
VIEW_TABLE = ViewTable.of(RIG, MODEL)
DETECTION_MODEL = DetectionModel(0.95, 0.01)
P_UNOCCLUDED = np.full(N, 0.97)
POSE = Pose.from_ypr(np.deg2rad([7.0, 0.0, 0.0]), np.zeros(3))
EXPECTED, JACOBIAN = MODEL.project(POSE)
# A pose known to 0.5 mm and 0.3 mrad: spots to about a pixel, against a noise of 0.1 px.
P_NEAR = np.diag(np.repeat([5e-4, 3e-4], 3) ** 2)
SIGMA_PX = 0.1
LOG_CLUTTER = float(np.log(1e-3))


@dataclass(frozen=True)
class Found:
    """Result of the search, best first."""

    assigned: Ints
    score: Array
    p_in: Array


def frame_of(
    points: list[Array], has_image: tuple[bool, bool] = (True, True), blend_px: float = 0.0, widening: float = 1.0
) -> FrameDetections:
    """A frame with these pixels (k, 2) per camera; widening: ratio of each point's size to the usual one."""
    uv = np.concatenate([np.zeros((0, 2)), *points])
    first = np.concatenate([[0], np.cumsum([len(p) for p in points])]).astype(np.int64)
    cov = np.tile(SIGMA_PX**2 * np.eye(2), (len(uv), 1, 1))
    m = len(uv)
    return FrameDetections(
        uv, cov, np.full(m, blend_px), first, np.array(has_image), np.full(N, LOG_CLUTTER),
        np.full(m, -np.inf), np.full(m, 2.0 * widening), np.full(N, 2.0), np.zeros(N), np.zeros(m),
    )  # fmt: skip


def observed(frame: FrameDetections, calibration_cov: Array | None = None) -> Observation:
    cov = np.zeros((N, 2, 2)) if calibration_cov is None else calibration_cov
    return Observation(
        MODEL.numbers, VIEW_TABLE, DETECTION_MODEL, cov, frame, np.zeros_like(cov), np.zeros((2, 3)), False
    )


def search(frame: FrameDetections, P: Array = P_NEAR, pose: Pose = POSE, calibration_cov: Array | None = None) -> Found:
    R, t = np.ascontiguousarray(pose.rotation), pose.translation
    found = associate(observed(frame, calibration_cov), R, t, P, P_UNOCCLUDED)
    return Found(*found[:3])


def injections(views: Ints, points: range) -> Iterator[tuple[int, ...]]:
    """All ways to assign to each of some views a different point or none."""
    for k in range(min(len(views), len(points)) + 1):
        for some in combinations(range(len(views)), k):
            for chosen in permutations(points, k):
                out = [MISSED] * len(views)
                for at, point in zip(some, chosen, strict=True):
                    out[at] = point
                yield tuple(out)


@cache
def together(rows: tuple[int, ...]) -> tuple[Array, Array, float]:
    """Of the Gaussian of some views' pixels: inverse covariance, its blocks, and the log of the normalisation."""
    H = JACOBIAN[list(rows)].reshape(-1, 6)
    S = H @ P_NEAR @ H.T + SIGMA_PX**2 * np.eye(len(H))
    inverse = np.linalg.inv(S)
    blocks = inverse.reshape(len(rows), 2, len(rows), 2)[np.arange(len(rows)), :, np.arange(len(rows))]
    return inverse, blocks, float(np.linalg.slogdet(2 * np.pi * S)[1])


def log_likelihood(frame: FrameDetections, views: Ints, assigned: tuple[int, ...]) -> tuple[float, float]:
    """Log-likelihood with one Gaussian of all pixels together, against false points.

    Also the largest squared Mahalanobis distance of a spot from its prediction by the prior and all other spots of the
    assignment, which is what the search's last gate sees.
    """
    score, rows, at = 0.0, [], []
    for v, d in zip(views.tolist(), assigned, strict=True):
        p = DETECTION_MODEL.p_detect * P_UNOCCLUDED[v]
        score += np.log(1 - p) if d == MISSED else np.log(p) - LOG_CLUTTER
        if d != MISSED:
            rows.append(v)
            at.append(d)
    if not rows:
        return score, 0.0
    inverse, blocks, log_det = together(tuple(rows))
    y = (frame.uv[at] - EXPECTED[rows]).ravel()
    # Each spot given the others: from its block of the inverse.
    z = (inverse @ y).reshape(-1, 2)
    distances2 = np.sum(z * np.linalg.solve(blocks, z[..., None])[..., 0], axis=-1)
    return score - 0.5 * float(y @ z.ravel() + log_det), float(distances2.max())


def scattered(rng: np.random.Generator, cameras: tuple[bool, bool], most: int) -> FrameDetections:
    """Spots about a pose drawn from the prior, some missing, and false points within some pixels of them."""
    pose = POSE.plus(np.sqrt(np.diagonal(P_NEAR)) * rng.normal(size=6))
    true = MODEL.project(pose)[0] + SIGMA_PX * rng.normal(size=(N, 2))
    points = []
    for c, there in enumerate(cameras):
        of = np.flatnonzero(MODEL.camera_of == c)
        spots = true[of[rng.random(len(of)) < 0.8]]
        false = true[rng.choice(of, size=most - len(spots))] + rng.uniform(-3, 3, size=(most - len(spots), 2))
        both = np.concatenate([spots, false])
        points.append(both[rng.permutation(len(both))] if there else np.zeros((0, 2)))
    return frame_of(points, cameras)


ONE, BOTH = (True, False), (True, True)


@pytest.mark.parametrize(
    ("cameras", "most", "seeds"),
    [
        (ONE, 4, range(5)),
        (BOTH, 3, range(60, 66)),
        pytest.param(ONE, 4, range(5, 60), marks=pytest.mark.slow),
        pytest.param(BOTH, 3, range(66, 70), marks=pytest.mark.slow),
    ],
)
def test_the_search_finds_the_best_of_all_assignments(cameras, most, seeds):
    compared = 0
    for seed in seeds:
        frame = scattered(np.random.default_rng(seed), cameras, most)
        by_camera = []
        for c in np.flatnonzero(cameras):
            views = np.flatnonzero(MODEL.camera_of == c)
            by_camera.append((views, list(injections(views, range(frame.first[c], frame.first[c + 1])))))
        views = np.concatenate([v for v, _ in by_camera])
        scores = {}
        for parts in product(*(some for _, some in by_camera)):
            assigned = sum(parts, ())
            score, distance2 = log_likelihood(frame, views, assigned)
            if distance2 < 0.9 * GATE_CHI2:  # the search's earlier gates, with fewer spots, are at least as wide
                scores[assigned] = score
        found = search(frame)
        assert np.all(np.diff(found.score) <= 0)
        elsewhere = np.setdiff1d(np.arange(N), views)
        assert np.all(found.assigned[:, elsewhere] == NOT_SEARCHED)
        # 0.03 nats: over a pixel the projection is linear to a thousandth of a pixel.
        best = max(scores, key=lambda a: scores[a])
        assert found.score[0] == pytest.approx(scores[best], abs=0.03)
        for row, score in zip(found.assigned[:, views], found.score, strict=True):
            if tuple(row) in scores:
                assert score == pytest.approx(scores[tuple(row)], abs=0.03)
        rivals = [s for s in scores.values() if s > scores[best] - 0.1]
        if len(rivals) == 1:
            compared += 1
            assert tuple(found.assigned[0, views]) == best
    assert compared >= 0.8 * len(seeds)


def test_a_frame_in_which_nothing_is_found_is_no_evidence_of_a_vehicle():
    """Spots that may be anywhere may be outside the pictures: then nothing follows from not finding them."""
    p_visible = np.full(N + 2, 0.95)
    for sigma_m in (1e-3, 0.03, 0.3, 3.0):
        frame = frame_of([np.zeros((0, 2)), np.zeros((0, 2))])
        found = search(frame, np.diag(np.repeat([sigma_m, sigma_m], 3) ** 2))
        assert len(found.assigned) == 1
        assert np.all(found.assigned[0] < 0)
        nats = detection_log_likelihood(observed(frame), p_visible, found.assigned[0], found.p_in[0])
        assert nats <= np.log(1 + P_BLACKOUT)
    assert nats > -1.0  # with the widest prediction hardly any spot is probably in its picture


def test_spots_that_are_found_count_with_their_detection_and_the_density_of_false_points():
    frame = frame_of([EXPECTED[MODEL.camera_of == c] for c in range(2)])
    found = search(frame)
    np.testing.assert_array_equal(found.assigned[0], np.argsort(np.argsort(MODEL.camera_of, kind="stable")))
    p_visible = np.full(N + 2, 1.0 - 1e-12)
    nats = detection_log_likelihood(observed(frame), p_visible, found.assigned[0], found.p_in[0])
    assert nats == pytest.approx(N * (np.log(DETECTION_MODEL.p_detect) - LOG_CLUTTER))


def test_a_false_point_in_the_first_gate_is_rejected_once_the_other_spots_have_narrowed_it():
    # A pose known to 5 mm and 3 mrad gives a spot a gate of dozens of pixels; five other spots reduce it below one.
    P = 100 * P_NEAR
    view = 2
    wide = JACOBIAN[view] @ P @ JACOBIAN[view].T
    along = np.linalg.eigh(wide)[1][:, 1]
    false = EXPECTED[view] + 2.0 * np.sqrt(np.linalg.eigvalsh(wide)[1]) * along
    assert np.linalg.norm(false - EXPECTED[view]) > 20 * SIGMA_PX
    others = [EXPECTED[(MODEL.camera_of == c) & (np.arange(N) != view)] for c in range(2)]
    camera = MODEL.camera_of[view]
    alone = [false[None] if c == camera else np.zeros((0, 2)) for c in range(2)]
    taken = search(frame_of(alone), P).assigned[0]
    assert np.count_nonzero(taken >= 0) == 1  # alone it may be a spot ...
    together = [np.concatenate([others[c], alone[c]]) for c in range(2)]
    found = search(frame_of(together), P).assigned[0]
    assert found[view] == MISSED  # ... but not with the others
    assert np.all(np.delete(found, view) >= 0)


def test_errors_of_the_calibration_widen_the_gates():
    # One spot is a pixel off through its calibration; all others fit.
    shifted = EXPECTED.copy()
    shifted[4] += [1.0, -0.5]
    frame = frame_of([shifted[MODEL.camera_of == c] for c in range(2)])
    assert search(frame, 1e-4 * P_NEAR).assigned[0, 4] == MISSED
    calibration_cov = np.zeros((N, 2, 2))
    calibration_cov[4] = 0.5 * np.eye(2)
    assert search(frame, 1e-4 * P_NEAR, calibration_cov=calibration_cov).assigned[0, 4] >= 0


def test_a_spot_that_has_merged_with_a_neighbour_stays_labelled_at_the_cost_of_its_improbability():
    shifted = EXPECTED.copy()
    shifted[4] += [2.0, 0.0]
    points = [shifted[MODEL.camera_of == c] for c in range(2)]
    assert search(frame_of(points), 1e-4 * P_NEAR).assigned[0, 4] == MISSED
    found = search(frame_of(points, blend_px=3.0, widening=1.2), 1e-4 * P_NEAR)
    assert found.assigned[0, 4] >= BLENDED
    separate = search(
        frame_of([EXPECTED[MODEL.camera_of == c] for c in range(2)], blend_px=3.0, widening=1.2), 1e-4 * P_NEAR
    )
    assert separate.score[0] > found.score[0] + 4


def at_the_border(past_px: float) -> tuple[Pose, int]:
    """A pose that puts one spot this far outside the left or right border of its picture, and the view."""
    view, pose = 2, POSE
    width = float(MODEL.image_size_px[view, 0])
    for _ in range(20):
        uv, J = MODEL.project(pose)
        right = uv[view, 0] > width / 2
        goal = width - 0.5 + past_px if right else -0.5 - past_px
        pose = pose.plus(np.array([0, 0, 0, 0, 0, 1.0]) * (goal - uv[view, 0]) / J[view, 0, 5])
    return pose, view


def probability_in_picture(view: int, pose: Pose, P: Array) -> float:
    uv, J = MODEL.project(pose)
    S = J[view] @ P @ J[view].T
    width, height = MODEL.image_size_px[view]
    return p_in_picture(uv[view, 0], uv[view, 1], S[0, 0], S[1, 1], float(width), float(height))


def only(view: int, points: Array) -> FrameDetections:
    """A frame whose only points are these, in the picture of a view."""
    camera = MODEL.camera_of[view]
    return frame_of([points if c == camera else np.zeros((0, 2)) for c in range(2)])


def test_a_spot_at_the_pictures_border_is_found_if_it_is_there_and_its_miss_costs_little_if_not():
    for past, probability in ((-30.0, 1.0), (0.0, 0.5), (30.0, 0.0)):
        pose, view = at_the_border(past)
        uv, J = MODEL.project(pose)
        P = 4 * P_NEAR
        S = J[view] @ P @ J[view].T
        inside = uv[view] - [np.sign(uv[view, 0] - MODEL.image_size_px[view, 0] / 2) * 1.5 * np.sqrt(S[0, 0]), 0.0]
        found = search(only(view, inside[None]), P, pose)
        none = search(only(view, np.zeros((0, 2))), P, pose)
        if past > 0:
            assert none.assigned[0, view] == NOT_SEARCHED
            assert found.assigned[0, view] == NOT_SEARCHED
            continue
        assert found.assigned[0, view] == 0
        there = [probability_in_picture(i, pose, P) for i in range(N)]
        assert there[view] == pytest.approx(probability, abs=1e-6)
        cost = np.log(1 - DETECTION_MODEL.p_detect * P_UNOCCLUDED * there)[none.assigned[0] == MISSED].sum()
        assert none.score[0] == pytest.approx(cost, abs=1e-3)


def test_a_camera_without_a_picture_is_not_searched():
    frame = frame_of([EXPECTED[MODEL.camera_of == 0], np.zeros((0, 2))], (True, False))
    found = search(frame)
    assert np.all(found.assigned[:, MODEL.camera_of == 1] == NOT_SEARCHED)
    assert np.all(found.assigned[0, MODEL.camera_of == 0] >= 0)


def test_no_point_is_two_spots_and_much_less_likely_assignments_are_dropped():
    rng = np.random.default_rng(8)
    for _ in range(5):
        frame = scattered(rng, (True, True), 4)
        found = search(frame, 200**2 * P_NEAR)  # so wide that each point is in several spots' gates
        for row in found.assigned:
            taken = row[row >= 0] % BLENDED
            assert len(set(taken.tolist())) == len(taken)
        assert len({tuple(row) for row in found.assigned}) == len(found.assigned)
        assert found.score[0] - found.score[-1] <= WIDE_PRUNE_NATS


def clutter_ratio(frame: FrameDetections, pose: Pose, P: Array = 1e-4 * P_NEAR) -> float:
    return log_clutter_ratio(observed(frame), np.ascontiguousarray(pose.rotation), pose.translation, P)


def beside_the_spots(px: float) -> list[Array]:
    return [EXPECTED[MODEL.camera_of == c] + [px, 0.0] for c in range(2)]


def test_only_points_near_an_expected_spot_count_as_clutter_near_spots():
    frame = frame_of(beside_the_spots(1.0))._replace(log_clutter_excess=np.full(N, 3.0))
    # At its centre, twice the mean density of the disc.
    assert clutter_ratio(frame, POSE) == pytest.approx(N * np.log(1 + 2 * (np.exp(3.0) - 1)), rel=0.01)
    farther = frame_of(beside_the_spots(CLUTTER_RADIUS_PX))._replace(log_clutter_excess=np.full(N, 3.0))
    assert 0 < clutter_ratio(farther, POSE) < 0.6 * clutter_ratio(frame, POSE)
    # None of these points is near the spots of a vehicle elsewhere.
    elsewhere = POSE.plus(np.array([0, 0.3, 0.3, 0, 0, 0]))
    assert np.nanmin(np.linalg.norm(MODEL.project(elsewhere)[0] - EXPECTED, axis=1)) > 4 * CLUTTER_RADIUS_PX
    assert clutter_ratio(frame, elsewhere) == pytest.approx(0.0, abs=1e-6)
    # Two points near one spot both count.
    points = beside_the_spots(0.0)
    twice = frame_of([np.concatenate([points[0], points[0] + 1.0]), points[1]])._replace(
        log_clutter_excess=np.full(N, 3.0)
    )
    beside_two = N + np.count_nonzero(MODEL.camera_of == 0)
    assert clutter_ratio(twice, POSE) == pytest.approx(clutter_ratio(frame, POSE) * beside_two / N, rel=0.01)


def test_false_points_near_spots_count_more_the_better_the_spots_places_are_known():
    frame = frame_of(beside_the_spots(4.0))._replace(log_clutter_excess=np.full(N, 3.0))
    sharper_first = [clutter_ratio(frame, POSE, scale * P_NEAR) for scale in (1e-4, 1e2, 1e3, 1e4, 1e8)]
    assert all(a > b > 0 for a, b in pairwise(sharper_first))
    assert sharper_first[-1] < 0.01


def test_static_points_do_not_count_as_clutter_near_spots():
    frame = frame_of(beside_the_spots(1.0))._replace(log_clutter_excess=np.full(N, 3.0))
    every = clutter_ratio(frame, POSE)
    frame.log_static[0] = LOG_CLUTTER + 2.0
    assert clutter_ratio(frame, POSE) == pytest.approx(every * (N - 1) / N, rel=0.01)


def test_a_point_at_a_static_place_is_an_unlikely_spot():
    points = [EXPECTED[MODEL.camera_of == c] for c in range(2)]
    plain, static = frame_of(points), frame_of(points)
    static.log_static[:] = LOG_CLUTTER + 4.0
    a, b = search(plain), search(static)
    np.testing.assert_array_equal(a.assigned[0], b.assigned[0])
    assert b.score[0] == pytest.approx(a.score[0] - 4.0 * N)


def test_without_sizes_no_point_is_taken_for_two_merged_spots():
    shifted = EXPECTED.copy()
    shifted[4] += [2.0, 0.0]
    points = [shifted[MODEL.camera_of == c] for c in range(2)]
    wide = frame_of(points, blend_px=3.0, widening=1.2)
    unknown = np.full(len(wide.uv), np.nan)
    for frame in (
        wide._replace(size_px=unknown),
        wide._replace(usual_size_px=np.full(N, np.nan)),
        frame_of(points, blend_px=3.0),  # of the usual size
    ):
        assert not any(is_blended(frame, v, d) for v in range(N) for d in range(len(frame.uv)))
        assert not np.any(search(frame, 1e-4 * P_NEAR).assigned >= BLENDED)
    assert is_blended(wide, 4, 0)


def test_a_spot_is_counted_once_however_many_cameras_see_it():
    spot = np.array([0, 0, 1, 2, 2, 3])
    rng = np.random.default_rng(0)
    for _ in range(50):
        assigned = rng.choice([MISSED, 0, 5, BLENDED + 2], 6).astype(np.int64)
        own = {int(s) for s, a in zip(spot, assigned, strict=True) if 0 <= a < BLENDED}
        chosen = (assigned >= 0) & (assigned < BLENDED)
        assert distinct_spots(chosen, spot) == len(own)
        assert distinct_spots(np.stack([chosen, ~chosen]), spot).tolist() == [
            len(own), len({int(s) for s in spot[~chosen]}),
        ]  # fmt: skip
