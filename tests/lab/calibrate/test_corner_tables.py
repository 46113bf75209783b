"""Cameras from tables of corners: the same lens as from the photographs, and mrcal's published one."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares

from calibration.boards.board_types import parse
from calibration.lens.fit.lens_models import LensModel
from calibration.lens.intrinsics import IntrinsicsOptions, calibrate_intrinsics
from geometry.camera import project_points_full
from geometry.rotations import exp
from lab.calibrate.camera.camera import CameraOptions, calibrate_camera, corner_table
from lab.calibrate.camera.photos import read_corner_table
from lab.errors import InputError
from tests.calibration.lens.lens_scenes import SIZE, Scene, board_points, photographs
from tests.calibration.lens.random_lenses import corners_of, random_lens
from tests.paths import DATA

BOARD = "chessboard:9x6:30mm"
MRCAL = DATA / "mrcal_wide_lens"
needs_mrcal = pytest.mark.skipif(not MRCAL.is_dir(), reason="mrcal's corners are not here")


@pytest.fixture(scope="module")
def views():
    table = photographs(Scene(views=6), 5)
    return [(f"view{v}.png", table.point[table.view == v], table.pixels[table.view == v]) for v in range(6)]


def write_vnl(path, views):
    lines = ["# filename x y weight"]
    for name, ids, pixels in views:
        seen = dict(zip(ids.tolist(), pixels.tolist(), strict=True))
        lines += [f"{name} {seen[k][0]:.6f} {seen[k][1]:.6f} 1" if k in seen else f"{name} - - -" for k in range(54)]
    path.write_text("\n".join([*lines, "empty.png - - -"]))


def write_csv(path, views):
    rows = [f"{n},{k},{u:.6f},{v:.6f}" for n, ids, p in views for k, (u, v) in zip(ids, p, strict=True)]
    path.write_text("\n".join(["view,id,u_px,v_px", *rows]))


@pytest.mark.parametrize(("name", "write"), [("corners.vnl", write_vnl), ("corners.csv", write_csv)])
def test_a_table_gives_the_corners_that_were_written(tmp_path, views, name, write):
    write(tmp_path / name, views)
    found = read_corner_table(tmp_path / name, parse(BOARD), SIZE)
    assert [n for n, _ in found.views] == [n for n, _, _ in views]
    for (_, view), (_, ids, pixels) in zip(found.views, views, strict=True):
        np.testing.assert_array_equal(view.ids, ids)
        np.testing.assert_allclose(view.pixels, pixels, atol=1e-6)
    np.testing.assert_allclose(corner_table(found).board_points, board_points(Scene()), atol=1e-12)


def test_a_camera_from_a_table_has_a_report_and_corners_that_can_be_read_again(tmp_path, views):
    write_vnl(tmp_path / "corners.vnl", views)
    options = CameraOptions(lens="4", warp="off", stretch="off", image_size_px=SIZE)
    first = calibrate_camera([tmp_path / "corners.vnl"], BOARD, tmp_path / "a", options)
    assert (first.out / "report.html").is_file()
    again = calibrate_camera([first.out / "corners.csv"], BOARD, tmp_path / "b", options)
    assert again.result.fit.lens[0] == pytest.approx(first.result.fit.lens[0], abs=0.01)


def test_boards_in_one_corner_of_the_picture_fail_with_the_empty_sides_and_what_to_photograph(tmp_path):
    table = corners_of(random_lens(1, "plain"), 1, views=40)
    near = np.all(table.pixels < [560, 450], axis=1)
    rows = [(f"v{v}", table.point[m := near & (table.view == v)], table.pixels[m]) for v in range(40)]
    write_csv(tmp_path / "corners.csv", [row for row in rows if len(row[1]) > 20])
    options = CameraOptions(image_size_px=table.image_size_px)
    line = calibrate_camera([tmp_path / "corners.csv"], "chessboard:12x8:30mm", tmp_path / "out", options).line()
    assert "FAIL" in line
    assert "none came near its right side and bottom, where directions are extrapolated" in line
    assert "Photograph next: 5 more, the board near the right side and bottom of the picture" in line


def test_a_view_that_a_table_holds_twice_counts_once(tmp_path, views):
    """Also where a tenth of its points was not found; a view that is elsewhere counts."""
    noise = np.random.default_rng(0).normal(0, 0.02, (len(views[0][1]), 2))
    again = [("again.png", views[0][1][5:], views[0][2][5:] + noise[5:]), ("moved.png", views[1][1], views[1][2] + 1)]
    write_csv(tmp_path / "c.csv", [*views, *again])
    found = read_corner_table(tmp_path / "c.csv", parse(BOARD), SIZE)
    assert [n for n, _ in found.views] == [*(n for n, _, _ in views), "moved.png"]
    assert [n for n, _ in found.refused] == ["again.png"]
    assert found.refused[0][1].startswith("the same picture as view0.png, points within 0.0")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda text: text.replace("view0.png", "x", 1), r"expected 54 rows, one per point .*, got"),
        (lambda text: text.replace(" 1\n", " one\n", 1), r"line [0-9]+: expected `filename x y"),
    ],
)
def test_a_damaged_table_is_refused_with_its_place(tmp_path, views, change, words):
    path = tmp_path / "corners.vnl"
    write_vnl(path, views)
    path.write_text(change(path.read_text()))
    with pytest.raises(InputError, match=words):
        read_corner_table(path, parse(BOARD), SIZE)


def test_the_picture_size_is_required_and_checked(tmp_path, views):
    write_csv(tmp_path / "c.csv", views)
    with pytest.raises(InputError, match="add --image-size"):
        calibrate_camera([tmp_path / "c.csv"], BOARD, tmp_path / "out")
    with pytest.raises(InputError, match=r"inside 100x80 px.*check --image-size"):
        calibrate_camera([tmp_path / "c.csv"], BOARD, tmp_path / "out", CameraOptions(image_size_px=(100, 80)))


@needs_mrcal
@pytest.mark.slow
@pytest.mark.parametrize("lens", [None, LensModel(8)])
def test_the_published_wide_lens_is_found(lens):
    """mrcal's own solution for twice as many views; it holds its directions to be right within .25 px."""
    found = read_corner_table(MRCAL / "corners.vnl", parse("chessboard:10x10:77mm"), (6016, 4016))
    c = calibrate_intrinsics(corner_table(found), IntrinsicsOptions(lens=lens))
    assert max(difference_per_ring(c)) < 0.3
    assert not c.board.stretch.corrected
    assert c.board.stretch.change_px > 0.5


def difference_per_ring(c) -> list[float]:
    """Median difference, px, to mrcal's OPENCV8 at .53 m, per ring of 15 deg, after the best rotation and shift."""
    text = (MRCAL / "opencv8.txt").read_text().splitlines()[1]
    published = np.append(np.array(text.split(), dtype=float), np.zeros(6))
    rays = np.loadtxt(MRCAL / "splined_directions.csv", delimiter=",", skiprows=1)[:, :3]
    off_axis = np.degrees(np.arccos(rays[:, 2] / np.linalg.norm(rays, axis=1)))

    def pixels(points, lens, fisheye):
        return project_points_full(points, lens[:4], lens[4:], np.asarray(np.inf), np.asarray(fisheye)).pixels

    theirs = pixels(rays, published, False)
    use = (off_axis < 60) & np.all((theirs > 0) & (theirs < [6015, 4015]), axis=1)
    points, theirs, off_axis = 0.53 * rays[use], theirs[use], off_axis[use]

    def apart(x):
        return pixels(points @ exp(x[:3]).T + x[3:], c.fit.lens, c.model.fisheye) - theirs

    x = least_squares(lambda x: apart(x).ravel(), np.zeros(6), loss="soft_l1", x_scale=1e-3).x
    away = np.linalg.norm(apart(x), axis=1)
    return [float(np.median(away[(off_axis >= a) & (off_axis < a + 15)])) for a in (0, 15, 30, 45)]
