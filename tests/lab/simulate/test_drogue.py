"""Rendered drogues: the picture shows what the forward model and the stated truth say."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bench.related_measurements.drogue_sequences import moving_drogue
from geometry.camera import Camera
from geometry.pose import Pose
from studies.drogue.render import render_drogue
from studies.drogue.scene import (
    DISC,
    PICTURE,
    SIDE_LIGHT,
    DrogueBackground,
    DrogueLight,
    DrogueLook,
    DrogueScene,
    Occluder,
    ellipse_through,
)

SIZE, FOCAL = (320, 240), 500.0
GREY = 60
PLAIN = DrogueBackground(PICTURE, picture=np.full((8, 8), GREY, np.uint8))
WHITE = DrogueLook(hose_length=0.0, gore_contrast=0.0, marker_bgr=((225.0, 228.0, 230.0),) * 7)
AMBIENT = DrogueLight((0.0, 0.0, -1.0), 1.0, 0.0)


def camera(distortion: tuple[float, ...] = ()) -> Camera:
    matrix = np.array([[FOCAL, 0, (SIZE[0] - 1) / 2], [0, FOCAL, (SIZE[1] - 1) / 2], [0, 0, 1]])
    return Camera("camera", "", SIZE, matrix, distortion, Pose(np.eye(3), np.zeros(3)))


def scene(
    place: tuple[float, float, float] = (0.0, 0.0, 2.5),
    tilt_deg: tuple[float, float, float] = (0.0, 0.0, 0.0),
    distortion: tuple[float, ...] = (),
    **changes: object,
) -> DrogueScene:
    pose = Pose(Rotation.from_rotvec(np.radians(tilt_deg)).as_matrix(), np.array(place))
    plain = DrogueScene(
        camera(distortion), pose, 0.3, look=WHITE, light=AMBIENT, background=PLAIN, blur_px=0.0, noise_dn=0.0
    )
    return replace(plain, **changes)


def grey(of: DrogueScene, seed: int = 0) -> np.ndarray:
    return render_drogue(of, np.random.default_rng(seed)).image.mean(axis=2)


POSES = [
    ((0.0, 0.0, 2.5), (0.0, 0.0, 0.0), ()),
    ((0.2, -0.1, 2.4), (20.0, 0.0, 0.0), ()),
    ((-0.25, 0.1, 2.6), (-12.0, 22.0, 40.0), ()),
    ((0.3, 0.15, 2.5), (10.0, -15.0, 0.0), (-0.2, 0.05, 0.002, -0.001, 0.0)),
]


@pytest.mark.parametrize(("place", "tilt", "distortion"), POSES)
def test_the_outline_is_the_image_of_the_rim(place, tilt, distortion):
    """The rim is projected here by the camera alone; the outline is where a row or column of pixels is half covered."""
    drawn = scene(place, tilt, distortion)
    angle = np.linspace(0, 2 * np.pi, 20_001)
    circle = 0.3 * np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
    rim = drawn.camera.project(drawn.world_from_drogue.apply(circle))
    centre = drawn.camera.project(drawn.world_from_drogue.translation)
    picture = grey(drawn)
    # Along rays from the centre: the last place where the picture is brighter than half of canopy and background.
    turn = 2 * np.pi * (np.arange(90) + 0.3) / 90
    reach = np.arange(40.0, 75.0, 0.05)
    u = centre[0] + reach * np.cos(turn)[:, None]
    v = centre[1] + reach * np.sin(turn)[:, None]
    column, row = np.floor(u).astype(int), np.floor(v).astype(int)
    a, b = u - column, v - row
    values = (1 - a) * (1 - b) * picture[row, column] + a * (1 - b) * picture[row, column + 1]
    values += (1 - a) * b * picture[row + 1, column] + a * b * picture[row + 1, column + 1]
    bright = values > (GREY + np.mean([225, 228, 230])) / 2
    found = reach[len(reach) - 1 - np.argmax(bright[:, ::-1], axis=1)]
    away = rim - centre
    direction = np.unwrap(np.arctan2(away[:, 1], away[:, 0]))
    expected = np.interp(turn, *_rising(direction, np.hypot(*away.T)), period=2 * np.pi)
    assert abs(np.mean(found - expected)) < 0.05
    assert np.std(found - expected) < 0.15  # 3 points per pixel and axis


def _rising(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return (x, y) if x[-1] > x[0] else (x[::-1], y[::-1])


@pytest.mark.parametrize(("place", "tilt"), [p[:2] for p in POSES[:3]])
def test_the_ellipse_is_the_conic_of_the_projected_circle(place, tilt):
    """By the plane's homography H: the conic of the rim is H^-T diag(1, 1, -r^2) H^-1."""
    drawn = scene(place, tilt)
    truth = render_drogue(drawn, np.random.default_rng(0))
    R, t = drawn.world_from_drogue.rotation, drawn.world_from_drogue.translation
    inverse = np.linalg.inv(drawn.camera.matrix @ np.column_stack([R[:, 0], R[:, 1], t]))
    conic = inverse.T @ np.diag([1, 1, -(0.3**2)]) @ inverse
    centre = -np.linalg.solve(conic[:2, :2], conic[:2, 2])
    level = -(conic[2, 2] + conic[:2, 2] @ centre)
    axes = np.sort(np.sqrt(level / np.linalg.eigvalsh(conic[:2, :2])))
    np.testing.assert_allclose(truth.ellipse.centre_px, centre, atol=1e-6)
    np.testing.assert_allclose([truth.ellipse.minor_px, truth.ellipse.major_px], axes, atol=1e-6)
    assert truth.radius_px == truth.ellipse.major_px
    # The image of the circle's centre is another point as soon as the circle is tilted.
    away = float(np.hypot(*(truth.centre_px - centre)))
    assert away < 1e-9 if tilt == (0.0, 0.0, 0.0) else 0.5 < away < 5


def test_an_ellipse_through_many_points_takes_memory_in_proportion_to_their_number():
    t = np.linspace(0, 2 * np.pi, 4000)
    points = np.stack([30 + 20 * np.cos(t), 40 + 10 * np.sin(t)], axis=1)
    tracemalloc.start()
    ellipse = ellipse_through(points)
    peak_mb = tracemalloc.get_traced_memory()[1] / 1e6
    tracemalloc.stop()
    np.testing.assert_allclose([*ellipse.centre_px, ellipse.major_px, ellipse.minor_px], [30, 40, 20, 10], rtol=1e-9)
    assert peak_mb < 3  # a square matrix of 4,000 rows has 128 MB, and took half of the time of each picture


def test_an_ellipse_needs_five_points_on_one():
    with pytest.raises(ValueError, match="five"):
        ellipse_through(np.zeros((4, 2)))
    t = np.linspace(0.5, 2, 9)
    with pytest.raises(ValueError, match="no ellipse"):
        ellipse_through(np.stack([t, 1 / t], axis=1))


@pytest.mark.parametrize(
    ("occluder", "hidden"),
    [
        (Occluder((159.5, 119.5), 200.0, kind=DISC), 1.0),
        (Occluder((159.5, 119.5), 60.0, kind=DISC), 0.0),  # only the middle
        (Occluder((-240.5, -400.0), 800.0, (-240.5, 900.0)), 0.5),  # all to the left of the centre
        (Occluder((159.5, -400.0), 42.0, (159.5, 900.0)), 4 * np.arcsin(21 / 60) / (2 * np.pi)),  # a vertical bar
    ],
)
def test_the_hidden_share_of_the_rim_is_that_of_the_geometry_and_of_the_picture(occluder, hidden):
    clear, covered = scene(), scene(occluders=(occluder,))
    truth = render_drogue(covered, np.random.default_rng(0))
    assert truth.hidden == pytest.approx(hidden, abs=0.01)
    angle = 2 * np.pi * np.arange(720) / 720
    # Just within the rim, where the canopy is seen unless something is in front of it.
    u, v = (np.rint(c + 56 * f(angle)).astype(int) for c, f in ((159.5, np.cos), (119.5, np.sin)))
    changed = np.abs(grey(covered) - grey(clear))[v, u] > 20
    assert changed.mean() == pytest.approx(hidden, abs=0.04)


def test_a_rim_outside_the_picture_counts_as_hidden():
    left_edge = -(SIZE[0] - 1) / 2 / FOCAL * 2.5
    truth = render_drogue(scene((left_edge, 0.0, 2.5)), np.random.default_rng(0))
    assert truth.hidden == pytest.approx(0.5, abs=0.01)


def test_markers_are_seen_where_the_forward_model_puts_them():
    blue = ((255.0, 0.0, 0.0),) * 7
    drawn = scene((0.05, 0.0, 1.6), (14.0, -9.0, 5.0), look=replace(WHITE, marker_bgr=blue, marker_radius=0.07))
    truth = render_drogue(drawn, np.random.default_rng(0))
    expected = drawn.camera.project(drawn.world_from_drogue.apply(drawn.markers))
    np.testing.assert_allclose(truth.markers_px, expected, atol=1e-9)
    colour = truth.image.astype(float)
    share = np.clip(colour[..., 0] - colour[..., 2], 0, None)  # blue less red: the markers alone
    v, u = np.mgrid[: SIZE[1], : SIZE[0]]
    for place in expected:
        near = share * (np.hypot(u - place[0], v - place[1]) < 10)
        centroid = np.array([(near * u).sum(), (near * v).sum()]) / near.sum()
        assert np.hypot(*(centroid - place)) < 0.15
    assert truth.markers_visible.all()
    first = Occluder((float(expected[0, 0]), float(expected[0, 1])), 8.0, kind=DISC)
    behind = render_drogue(replace(drawn, occluders=(first,)), np.random.default_rng(0)).markers_visible
    assert behind.tolist() == [False] + [True] * 6


def test_grey_values_are_proportional_to_the_light():
    full, half = (scene(light=DrogueLight((0.3, -0.5, -0.8), a, d)) for a, d in ((0.4, 0.4), (0.2, 0.2)))
    ring = _ring()
    np.testing.assert_allclose(grey(full)[ring], 2 * grey(half)[ring], atol=1.01)  # rounding
    assert grey(full)[ring].mean() > 60


def test_light_from_the_side_brightens_the_canopy_on_that_side():
    u = np.arange(SIZE[0])[None, :] + np.zeros((SIZE[1], 1))
    right, left = (_ring() & side for side in (u > 190, u < 129))
    lit = grey(scene(light=SIDE_LIGHT))
    assert lit[right].mean() > 1.3 * lit[left].mean()
    even = grey(scene())
    assert even[right].mean() == pytest.approx(even[left].mean(), rel=1e-3)


def _ring() -> np.ndarray:
    """Pixels (h, w) well within the canopy of the drogue that faces the camera: radius 60 px, inner edge at 50."""
    v, u = np.mgrid[: SIZE[1], : SIZE[0]]
    away = np.hypot(u - 159.5, v - 119.5)
    return (away > 53) & (away < 57)


def test_the_same_seed_gives_the_same_picture_and_another_one_only_other_noise():
    drawn = scene(noise_dn=4.0, background=DrogueBackground("clouds", 7), blur_px=0.7)
    one, same, other = (render_drogue(drawn, np.random.default_rng(k)).image.astype(float) for k in (3, 3, 4))
    np.testing.assert_array_equal(one, same)
    still = render_drogue(replace(drawn, noise_dn=0.0), np.random.default_rng(9)).image.astype(float)
    assert abs((one - still).mean()) < 0.05
    assert abs((other - still).mean()) < 0.05
    assert np.std(one - other) == pytest.approx(np.sqrt(2) * np.std(one - still), rel=0.02)


def test_the_noise_is_stated_at_128_dn_and_grows_with_the_light():
    def sigma(level: int) -> float:
        flat = DrogueBackground(PICTURE, picture=np.full((8, 8), level, np.uint8))
        far = Pose(np.eye(3), np.array([30.0, 0.0, 10.0]))  # the drogue is outside the picture
        return float(np.std(grey_of_blue(scene(background=flat, noise_dn=5.0, world_from_drogue=far))))

    assert sigma(128) == pytest.approx(5.0, rel=0.02)
    assert sigma(32) == pytest.approx(5 * np.sqrt(0.25 + 0.75 * 32 / 128), rel=0.03)


def grey_of_blue(of: DrogueScene) -> np.ndarray:
    return render_drogue(of, np.random.default_rng(5)).image[..., 0].astype(float)


def test_motion_during_the_exposure_widens_the_drogue_along_the_path_and_keeps_its_centre():
    still, moved = grey(scene()) - GREY, grey(scene(motion_px=(8.0, 0.0))) - GREY
    v, u = np.mgrid[: SIZE[1], : SIZE[0]]
    for axis in (u, v):
        assert (moved * axis).sum() / moved.sum() == pytest.approx((still * axis).sum() / still.sum(), abs=0.1)
    assert _extent(moved[119:121]) == pytest.approx(_extent(still[119:121]) + 8, abs=2)
    assert _extent(moved[:, 159:161].T) == _extent(still[:, 159:161].T)


def _extent(lines: np.ndarray) -> int:
    """From the first to the last pixel of lines (n, w) that is not background."""
    places = np.flatnonzero(lines.any(axis=0))
    return int(places[-1] - places[0])


def test_the_background_moves_by_its_offset_and_the_drogue_does_not():
    far = DrogueBackground("ground", 3)
    one, two = (grey(scene(background=replace(far, offset_px=o))) for o in ((0.0, 0.0), (12.0, -5.0)))
    away = np.hypot(*(np.mgrid[: SIZE[1], : SIZE[0]] - np.array([119.5, 159.5])[:, None, None]))
    on, off = away < 48, away > 90
    # The gaps between the struts show the background, the rest of the drogue does not change.
    assert np.mean(np.abs(one - two)[on] < 1) > 0.6
    shifted = np.roll(one, (-5, 12), axis=(0, 1))
    inner = np.zeros_like(off)
    inner[10:-10, 15:-15] = True
    both = off & np.roll(off, (-5, 12), axis=(0, 1)) & inner
    np.testing.assert_allclose(two[both], shifted[both], atol=1.01)


def test_haze_and_background_colour_meet_at_full_haze():
    drawn = scene(haze=1.0)
    np.testing.assert_allclose(grey(drawn), GREY, atol=1.5)


def test_a_sequence_follows_its_seed():
    one, same, other = (next(iter(moving_drogue(s, 2, (30.0, 40.0)))) for s in (5, 5, 6))
    np.testing.assert_array_equal(one.picture, same.picture)
    np.testing.assert_array_equal(one.centre_px, same.centre_px)
    assert not np.array_equal(one.centre_px, other.centre_px)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"radius_m": 0.0}, "radius_m"),
        ({"markers_m": np.zeros((3, 3))}, "markers_m"),
        ({"world_from_drogue": Pose(np.diag([-1.0, 1.0, -1.0]), np.array([0.0, 0.0, 2.0]))}, "camera"),
    ],
)
def test_scenes_without_a_meaning_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        scene(**changes)


@pytest.mark.parametrize("background", [{"kind": "fog"}, {"kind": PICTURE}, {"picture": np.zeros((4, 4), np.uint8)}])
def test_backgrounds_without_a_meaning_are_refused(background):
    with pytest.raises(ValueError, match="background"):
        DrogueBackground(**background)
