"""The paper's closed forms for a spot out of view: against the rigid body, trigonometry, and limiting cases."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geometry.arrays import Array, normalised
from geometry.forward_model import SpotModel
from geometry.planes import intersect_plane, screen_to_world
from geometry.pose import Pose
from geometry.pose_solver.closed_form import meeting_point, middle_spot, outer_spot, quadratic_coefficients
from geometry.rig import Beam, Rig, Screen
from tests.geometry.scenes import LENSES, camera_that_looks_at, paper_rig, random_pose

EXACT_PX = 1e-6  # the project's goal for noise-free data
ORIGIN_SCREEN = Pose.identity()  # the plane z = 0


def rotated_spot(O: Array, A: Array, B: Array, beta: float, world_from_screen: Pose) -> Array:
    """C (..., 3), m: OA rotated towards and beyond OB, by exactly `beta` (rad) beyond it. Equal to `outer_spot`."""
    OA, OB = normalised(A - O), normalised(B - O)
    between = np.arctan2(np.linalg.norm(np.cross(OA, OB), axis=-1), np.sum(OA * OB, axis=-1))
    return middle_spot(O, A, B, between + beta, -beta, world_from_screen)


def tilted_fan(rng: np.random.Generator) -> tuple[Rig, float, float]:
    """Three coplanar beams through one point at unequal angles, in a random plane of body; tilted screens.

    Also alpha, from A to B, and beta, from B to C, rad.
    """
    rig = paper_rig()
    screens = {
        name: Screen(name, Pose(Rotation.from_rotvec(rng.normal(0, 0.15, 3)).as_matrix() @ s.world_from_screen.rotation,
                                s.world_from_screen.translation + rng.normal(0, 0.2, 3)))
        for name, s in rig.screens.items()
    }  # fmt: skip
    lens = LENSES[int(rng.choice([0, 4, 5]))]
    cameras = {
        name: camera_that_looks_at(name, screens[name], np.array([*rng.uniform(-0.6, 0.6, 2), side * 3.5]), lens)
        for name, side in (("left", -1.0), ("right", 1.0))
    }
    alpha, beta = np.deg2rad(rng.uniform(8, 25, 2))
    plane = Rotation.from_rotvec([rng.uniform(-np.pi, np.pi), 0, 0])
    meet = rng.normal(0, 0.1, 3)
    along = {n: plane.apply([np.cos(a), np.sin(a), 0.0]) for n, a in zip("ABC", (-alpha, 0.0, beta), strict=True)}
    beams = {n: Beam(n, d, meet + rng.uniform(-0.3, 0.3) * d) for n, d in along.items()}
    return replace(rig, screens=screens, cameras=cameras, beams=beams), float(alpha), float(beta)


def seen_world_points(rig: Rig, model: SpotModel, pixels: np.ndarray) -> np.ndarray:
    """Points (..., n, 3), m, on the screens, from pixels (..., n, 2)."""
    out = []
    for i, (name, _) in enumerate(model.views):
        camera = rig.cameras[name]
        screen = rig.screens[camera.screen].world_from_screen
        out.append(screen_to_world(intersect_plane(*camera.rays(pixels[..., i, :]), screen), screen))
    return np.stack(out, axis=-2)


def test_quadratic_rotation_and_rigid_body_give_the_same_pixel():
    """2000 poses within 1 m and 30 deg of 200 rigs: three solutions for C, two for A, one for the middle spot B."""
    rng = np.random.default_rng(1)
    off_px, compared, outside = [], 0, 0
    for _ in range(200):
        rig, alpha, beta = tilted_fan(rng)
        model = SpotModel.of(rig)
        row = {spot: i for i, (_, spot) in enumerate(model.views)}
        poses = [random_pose(rng, 1.0, np.deg2rad(30)) for _ in range(10)]
        rigid = model.project(Pose(np.stack([p.rotation for p in poses]), np.stack([p.translation for p in poses])))[0]
        rigid = rigid[np.isfinite(rigid).all(axis=(1, 2))]
        world = seen_world_points(rig, model, rigid)
        A, B, C, A2, B2 = (world[:, row[s]] for s in ("1", "2", "3", "4", "5"))
        camera = rig.cameras["left"]
        screen = rig.screens["left"].world_from_screen
        O = meeting_point(A, A - A2, B, B - B2)
        for found, of in (
            (outer_spot(O, A, B, alpha, beta), "3"),
            (rotated_spot(O, A, B, beta, screen), "3"),
            (outer_spot(O, C, B, beta, alpha), "1"),
            (middle_spot(O, A, C, alpha, beta, screen), "2"),
        ):
            off_px.append(np.abs(camera.project(found) - rigid[:, row[of]]).max(initial=0.0))
        compared += len(rigid)
        outside += np.count_nonzero(~camera.sees(rigid[:, row["3"]]))
    assert compared > 1500
    assert outside > 100  # the spots of interest lie outside the picture
    assert np.max(off_px) < EXACT_PX  # fails for nan too


def geometries(rng: np.random.Generator, count: int, low_deg: float, high_deg: float):
    """O (n, 3), directions a, b, c (n, 3) in one plane with angles alpha, beta (n,); A and B on z = 0, C possibly not.

    Only geometries where A's and B's beams reach the plane; c's angle to the plane is at least 1e-4 rad.
    """
    n = 6 * count
    alpha, beta = np.deg2rad(rng.uniform(low_deg, high_deg, (2, n)))
    turns = Rotation.random(n, random_state=rng)
    e1, e2 = turns.apply([1.0, 0, 0]), turns.apply([0.0, 1, 0])

    def ray(angle):
        return np.cos(angle)[:, None] * e1 + np.sin(angle)[:, None] * e2

    a, b, c = ray(-alpha), ray(np.zeros(n)), ray(beta)
    usable = (a[:, 2] < -0.01) & (b[:, 2] < -0.01) & (np.abs(c[:, 2]) > 1e-4)
    rows = np.flatnonzero(usable)[:count]
    O = np.column_stack([rng.uniform(-1, 1, (n, 2)), rng.uniform(0.5, 3, n)])
    return O[rows], a[rows], b[rows], c[rows], alpha[rows], beta[rows]


def on_floor(O: np.ndarray, ray: np.ndarray) -> np.ndarray:
    """Intersections of rays from above with z = 0."""
    return O - O[..., 2:] / ray[..., 2:] * ray


@pytest.mark.parametrize(("low_deg", "high_deg"), [(2, 10), (10, 30), (30, 60), (60, 89)])
def test_the_wrong_root_is_never_taken_and_nan_means_that_the_beam_misses(low_deg, high_deg):
    O, a, b, c, alpha, beta = geometries(np.random.default_rng(2), 1000, low_deg, high_deg)
    assert len(O) == 1000
    A, B = on_floor(O, a), on_floor(O, b)
    hits = c[:, 2] < 0
    found = np.array([outer_spot(O[i], A[i], B[i], alpha[i], beta[i]) for i in range(len(O))])
    np.testing.assert_array_equal(np.isfinite(found).all(axis=1), hits)
    assert (~hits).any()
    # Seen from O: 1e-6 rad is 1e-3 px of a camera with a focal length of 1000 px.
    towards = found[hits] - O[hits]
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    assert np.linalg.norm(towards - c[hits], axis=1).max() < 1e-6
    np.testing.assert_allclose(found[hits, 2], 0.0, atol=1e-6 * np.abs(found[hits]).max())


@pytest.mark.parametrize(("low_deg", "high_deg"), [(2, 30), (30, 89)])
def test_the_rotation_form_gives_nan_exactly_where_the_beam_misses(low_deg, high_deg):
    O, a, b, c, _, beta = geometries(np.random.default_rng(3), 500, low_deg, high_deg)
    A, B = on_floor(O, a), on_floor(O, b)
    found = np.array([rotated_spot(O[i], A[i], B[i], beta[i], ORIGIN_SCREEN) for i in range(len(O))])
    np.testing.assert_array_equal(np.isfinite(found).all(axis=1), c[:, 2] < 0)


def test_the_papers_rule_alone_would_accept_a_spot_that_does_not_exist():
    """The angle AOC nearest to 2 alpha, without tolerance and k > 0, gives a point even where C's beam misses."""
    O, a, b, c, alpha, _ = geometries(np.random.default_rng(4), 2000, 60, 89)
    A, B = on_floor(O, a), on_floor(O, b)
    # Equal angles, as in the paper: c at alpha beyond b.
    c = 2 * np.cos(alpha)[:, None] * b - a
    misses = c[:, 2] > 1e-4
    assert misses.mean() > 0.3
    for i in np.flatnonzero(misses)[:300]:
        k = np.roots(quadratic_coefficients(O[i], A[i], B[i], alpha[i])).real
        assert np.isfinite(k).all()  # the quadratic has two roots, neither of which is C
        assert np.isnan(outer_spot(O[i], A[i], B[i], alpha[i], alpha[i])).all()


def test_the_discriminant_equals_that_of_the_corrected_formula():
    """b^2 - 4ac = 4 l^2 sin^2 cos^2 |OB x AB|^2: never negative, zero only for O, A, B on a line or a right angle."""
    rng = np.random.default_rng(5)
    O, A, B = rng.normal(size=(3, 500, 3))
    for beta in np.deg2rad([2, 20, 45, 70, 89]):
        a, b, c = quadratic_coefficients(O, A, B, beta)
        OB, AB = B - O, B - A
        l = np.sum(OB**2, axis=1)
        area2 = np.sum(np.cross(OB, AB) ** 2, axis=1)
        np.testing.assert_allclose(b * b - 4 * a * c, 4 * l**2 * np.sin(beta) ** 2 * np.cos(beta) ** 2 * area2,
                                   rtol=1e-9, atol=1e-12 * np.max(b * b))  # fmt: skip


def test_with_equal_angles_one_root_gives_spot_a():
    O, a, b, _, alpha, _ = geometries(np.random.default_rng(6), 200, 5, 80)
    A, B = on_floor(O, a), on_floor(O, b)
    qa, qb, qc = (np.array(q) for q in zip(*(quadratic_coefficients(*g) for g in zip(O, A, B, alpha, strict=True)),
                                           strict=True))  # fmt: skip
    at_minus_one = qa - qb + qc
    assert np.abs(at_minus_one / (np.abs(qa) + np.abs(qb) + np.abs(qc))).max() < 1e-9


def test_a_beam_parallel_to_the_screen_gives_no_spot():
    """OC parallel to AB: a = 0, and the root is infinite."""
    alpha, beta = np.deg2rad([25.0, 35.0])
    O = np.array([0.0, 0.0, 1.0])
    B = np.array([1 / np.tan(beta), 0.0, 0.0])
    A = np.array([1 / np.tan(alpha + beta), 0.0, 0.0])
    a, b, c = quadratic_coefficients(O, A, B, beta)
    assert abs(a) < 1e-14 * (abs(b) + abs(c))
    C = outer_spot(O, A, B, alpha, beta)
    assert np.isnan(C).all() or np.linalg.norm(C - O) > 1e10
    # A thousandth of a radian off, to either side, the spot is far away or absent.
    for tip in (-1e-3, 1e-3):
        B = np.array([1 / np.tan(beta + tip), 0.0, 0.0])
        A = np.array([1 / np.tan(alpha + beta + tip), 0.0, 0.0])
        C = outer_spot(O, A, B, alpha, beta)
        if tip > 0:
            np.testing.assert_allclose(C, [1 / np.tan(tip), 0, 0], rtol=1e-6, atol=1e-9)
        else:
            assert np.isnan(C).all()


def test_the_spot_is_found_if_the_wrong_root_is_infinite():
    """The mirrored beam, at -beta from B, is parallel to the screen: a = 0, and C is the only finite root."""
    alpha, beta = np.deg2rad([20.0, 60.0])
    O = np.array([0.0, 0.0, 1.0])

    def floor_at(angle_from_b):
        # The fan's plane is y = 0; straight down is at 90 deg - beta from B, towards C.
        return np.array([np.tan(angle_from_b - (np.pi / 2 - beta)), 0.0, 0.0])

    A, B = floor_at(-alpha), floor_at(0.0)
    a, b, c = quadratic_coefficients(O, A, B, beta)
    assert abs(a) < 1e-14 * (abs(b) + abs(c))
    np.testing.assert_allclose(outer_spot(O, A, B, alpha, beta), floor_at(beta), atol=1e-12)


def test_a_stack_of_geometries_gives_the_same_as_each_alone():
    O, a, b, _, _, _ = geometries(np.random.default_rng(7), 50, 10, 11)
    A, B = on_floor(O, a), on_floor(O, b)
    alpha = beta = np.deg2rad(10.5)
    many = outer_spot(O, A, B, alpha, beta)
    for i in range(len(O)):
        np.testing.assert_array_equal(many[i], outer_spot(O[i], A[i], B[i], alpha, beta))


def test_an_angle_that_contradicts_the_calibration_gives_no_spot():
    """The measured angle is 15 deg, the calibrated one 20: these are not the beams A and B, or O is wrong."""
    O = np.array([0.0, 0.0, 1.0])
    A, B = (np.array([np.tan(np.deg2rad(x)), 0.0, 0.0]) for x in (-15.0, 0.0))
    assert np.isfinite(outer_spot(O, A, B, np.deg2rad(15.0), np.deg2rad(20.0))).all()
    assert np.isnan(outer_spot(O, A, B, np.deg2rad(20.0), np.deg2rad(20.0))).all()


def test_the_misprint_in_equation_12_misses_by_hundreds_of_pixels():
    """Printed: C = A + k (B - A) with the k of eq. (14). Meant, by eq. (11): C = B + k (B - A)."""
    rng = np.random.default_rng(8)
    rig = paper_rig()
    model = SpotModel.of(rig)
    row = {spot: i for i, (_, spot) in enumerate(model.views)}
    alpha = np.deg2rad(30.0)  # beams B (+30 deg), A (0), C (-30): A is the middle one
    literal, meant = [], []
    for _ in range(200):
        pose = random_pose(rng, 1.0, np.deg2rad(30))
        hit = model.hits(pose)
        A, B, C = (hit[row[s]] for s in ("2", "1", "3"))
        truth = model.project(pose)[0][row["3"]]
        if np.isnan(hit).any() or np.isnan(truth).any():
            continue
        k = np.linalg.norm(C - B) / np.linalg.norm(B - A)
        qa, qb, qc = quadratic_coefficients(pose.translation, A, B, alpha)
        assert abs(qa * k * k + qb * k + qc) < 1e-8 * (abs(qa * k * k) + abs(qb * k) + abs(qc))  # a root of (14)
        camera = rig.cameras["left"]
        literal.append(np.linalg.norm(camera.project(A + k * (B - A)) - truth))
        meant.append(np.linalg.norm(camera.project(B + k * (B - A)) - truth))
    assert len(meant) > 100
    assert np.nanmax(meant) < EXACT_PX
    assert np.nanmedian(literal) > 200.0


def test_the_meeting_point_of_skew_beams_is_the_middle_of_their_common_perpendicular():
    up, gap = np.array([0.0, 0, 1]), 0.02
    a, along_a = np.array([1.0, 0.0, 0.0]), np.array([2.0, 0, 0])
    b, along_b = np.array([0.0, -3.0, gap]), np.array([0.0, 1, 0])
    np.testing.assert_allclose(meeting_point(a, along_a, b, along_b), gap / 2 * up, atol=1e-15)


def test_an_error_of_the_calibrated_alpha_does_not_move_the_spot():
    """In eq. (14) the angle beta is measured from B, and alpha only selects the root; the rotation form is similar."""
    O = np.array([0.3, -0.2, 2.0])
    A, B = np.array([-0.9, 0.1, 0.0]), np.array([0.1, 0.2, 0.0])
    true_alpha = np.arccos((A - O) @ (B - O) / np.linalg.norm(A - O) / np.linalg.norm(B - O))
    beta = np.deg2rad(17.0)
    right = outer_spot(O, A, B, true_alpha, beta)
    wrong = outer_spot(O, A, B, true_alpha + np.deg2rad(1.0), beta)
    np.testing.assert_array_equal(right, wrong)
    np.testing.assert_allclose(rotated_spot(O, A, B, beta, ORIGIN_SCREEN), right, atol=1e-12)
