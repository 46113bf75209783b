"""Simulated calibration campaigns are valid projects, and their measurements agree with their truth."""

from __future__ import annotations

import filecmp

import numpy as np
import pytest

from geometry.forward_model import SpotModel
from lab.errors import InputError
from lab.files.project.point_files import read_observations, read_poses, read_survey
from lab.files.project.project import load_project
from lab.files.rig.rig_file import load_rig
from lab.files.text.csv_text import read_table
from lab.setup.init import Layout, start
from lab.simulate.campaign import CampaignQuality, draw_campaign, lens_covariance, simulate_calibration
from lab.simulate.scenarios import RIGS
from lab.simulate.write import simulate


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return simulate_calibration(tmp_path_factory.mktemp("campaigns") / "one", seed=7, positions=8)


def sizes(project):
    return {name: camera.lens.image_size_px for name, camera in project.cameras.items()}


def test_the_folder_is_a_valid_project(folder):
    project = load_project(folder)
    survey = read_survey(project.survey, project.screens)
    seen = read_observations(project.points, sizes(project), survey.names)
    assert len(survey.names) > 20
    assert len(seen.pixels) >= len(survey.names)
    assert len(read_poses(project.recordings[0].poses).frames) == 8
    assert all(c.lens.covariance is not None for c in project.cameras.values())
    assert project.stand.world_from_stand is None


def test_spots_and_dots_agree_with_the_truth_within_their_sigmas(folder):
    truth, project = load_rig(folder / "truth" / "rig.yaml"), load_project(folder)
    survey = read_survey(project.survey, project.screens)
    seen = read_observations(project.points, sizes(project), survey.names)
    for name, camera in truth.cameras.items():
        mine = np.array([c == name for c in seen.camera])
        at = survey.xyz[[survey.names.index(p) for p, m in zip(seen.point, mine, strict=True) if m]]
        # The survey error of 0.3 mm is 0.08 px at 4.4 m and 0.14 px at 2.5 m; that of the pixels is 0.07 px.
        rms = np.sqrt(np.mean((camera.project(at) - seen.pixels[mine]) ** 2))
        assert 0.07 < rms < 0.16
    poses = read_poses(folder / "truth" / "poses.csv")
    model = SpotModel.of(truth)
    pixels, _ = model.project(poses.stand_from_body)
    spots = read_table(folder / "spots.csv", ("frame", "camera", "spot", "u_px", "v_px"))
    view = [
        model.views.index(v) for v in zip(spots.words["camera"].tolist(), spots.words["spot"].tolist(), strict=True)
    ]
    away = spots.stack("u_px", "v_px") - pixels[spots.whole("frame"), view]
    # Some 90 numbers: their RMS scatters by 7 %.
    assert np.sqrt(np.mean(away**2)) == pytest.approx(0.054, rel=0.25)


def test_the_dots_lie_on_their_screens_and_spread_over_them(folder):
    truth, project = load_rig(folder / "truth" / "rig.yaml"), load_project(folder)
    survey = read_survey(project.survey, project.screens)
    for name, screen in truth.screens.items():
        at = survey.xyz[[point.startswith(f"{name}-") for point in survey.names]]
        x, y, z = screen.world_from_screen.inverse().apply(at).T
        a, b, c = screen.bow
        assert np.abs(z - (a * x * x + b * x * y + c * y * y)).max() < 1.5e-3  # m; the survey's error is 0.3 mm
        assert min(np.ptp(x), np.ptp(y)) > 1.0


def test_errors_of_the_recorded_stand_positions_agree_with_their_sigmas():
    c = draw_campaign(3, quality=CampaignQuality(positions=400))
    sigmas = np.repeat([c.quality.stand_m, np.deg2rad(c.quality.stand_deg)], 3)
    errors = c.stand_recorded.minus(c.stand_from_body) / sigmas
    assert np.sqrt(np.mean(errors**2)) == pytest.approx(1.0, abs=0.05)


def test_the_mounted_rig_deviates_from_its_drawing_by_mounting_tolerances():
    c = draw_campaign(0)
    for name, camera in c.truth.cameras.items():
        drawn = c.nominal.cameras[name]
        apart = camera.camera_from_world.inverse().minus(drawn.camera_from_world.inverse())
        assert 1e-4 < np.linalg.norm(apart[:3]) < 0.03
        assert np.deg2rad(0.02) < np.linalg.norm(apart[3:]) < np.deg2rad(2)


def test_lens_errors_agree_with_their_covariance():
    sizes = []
    for seed in range(12):
        c = draw_campaign(seed, quality=CampaignQuality(positions=3, dots=(2, 2)))
        for name, lens in c.lenses.items():
            true = c.truth.cameras[name]
            e = np.array(
                [
                    lens.camera_matrix[i] - true.matrix[i] for i in ((0, 0), (1, 1), (0, 2), (1, 2))
                ] + list(np.array(lens.distortion) - true.distortion)
            )  # fmt: skip
            sizes.append(e @ np.linalg.solve(lens.covariance.matrix, e) / len(e))
    # 24 lenses of 9 parameters: relative sigma sqrt(2 / 216) = 0.1.
    assert np.mean(sizes) == pytest.approx(1.0, abs=0.3)


def test_more_board_photographs_reduce_the_lens_covariance():
    camera = RIGS["fan"]().cameras["left"]
    few, many = lens_covariance(camera, 0.1, views=10), lens_covariance(camera, 0.1, views=40)
    assert np.all(np.diagonal(many) < np.diagonal(few))


def test_the_same_seed_gives_the_same_bytes_and_another_seed_does_not(folder, tmp_path):
    again = simulate_calibration(tmp_path / "again", seed=7, positions=8)
    other = simulate_calibration(tmp_path / "other", seed=5, positions=8)
    names = sorted(p.relative_to(folder) for p in folder.rglob("*") if p.is_file())
    same, _, _ = filecmp.cmpfiles(folder, again, names, shallow=False)
    assert sorted(map(str, same)) == sorted(map(str, names))
    assert not filecmp.cmp(folder / "spots.csv", other / "spots.csv", shallow=False)


def test_outliers_have_the_given_share_and_large_errors():
    c = draw_campaign(6, quality=CampaignQuality(wrong=0.1))
    good = draw_campaign(6)
    assert 0.04 < c.wrong_spots.mean() < 0.18
    away = np.linalg.norm(c.spots.pixels - good.spots.pixels, axis=1)
    assert away[c.wrong_spots].min() > 3.9
    assert not away[~c.wrong_spots].any()


@pytest.mark.parametrize("rig", sorted(RIGS))
def test_every_example_rig_can_be_calibrated_with_its_campaign(rig):
    c = draw_campaign(1, rig, CampaignQuality(positions=10))
    # Each camera needs four dots, each position five coordinates.
    assert np.bincount(c.seen_camera).min() >= 8
    assert np.bincount(c.spots.position).min() >= 3
    assert {c.truth.spots[s].beam for _, s in c.truth.views()} == set(c.truth.beams)


@pytest.mark.slow
def test_board_photographs_show_the_board_that_the_folder_names(tmp_path, monkeypatch):
    from calibration.boards.board_detection import find_board
    from calibration.boards.board_view import NotFound
    from lab.files.rig.board_file import load_board
    from lab.pictures.picture_file import read_picture
    from lab.simulate import campaign as campaign_files

    monkeypatch.setattr(campaign_files, "PHOTOS", 1)
    folder = simulate_calibration(tmp_path / "photos", seed=1, positions=3, photos=True)
    board = load_board(folder / "board.yaml")
    picture = read_picture(folder / "photos" / "left" / "00.png", None)
    assert not isinstance(find_board(picture, board), NotFound)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"rig": "fann"}, "did you mean 'fan'"),
        ({"positions": 2}, "positions: expected 3 or more, got 2"),
        ({"wrong": 0.5}, "wrong: expected a share from 0 up to 0.3, got 0.5"),
    ],
)
def test_invalid_arguments_are_rejected_and_nothing_is_written(tmp_path, arguments, words):
    with pytest.raises(InputError, match=words):
        simulate_calibration(tmp_path / "none", **arguments)
    assert list(tmp_path.iterdir()) == []


def test_an_existing_folder_is_not_overwritten(folder):
    with pytest.raises(InputError, match="choose another --out"):
        simulate_calibration(folder, seed=9)


def test_a_known_pose_of_the_stand_is_written_with_its_sigmas(tmp_path):
    quality = CampaignQuality(place_known=True)
    stand = load_project(simulate_calibration(tmp_path / "known", seed=2, positions=3, quality=quality)).stand
    c = draw_campaign(2, quality=CampaignQuality(place_known=True, positions=3))
    assert stand.world_from_stand is not None
    error = stand.world_from_stand.pose().minus(c.world_from_stand)
    assert np.all(np.abs(error) < 5 * np.repeat([quality.place_m, np.deg2rad(quality.place_deg)], 3))
    assert np.isclose(stand.sigma_m, quality.place_m)


def test_a_campaign_and_a_recording_of_a_rig_of_your_own(tmp_path):
    """The rig that `beampose init` writes has no spots that leave the picture, as most scenarios require."""
    designed = start(tmp_path / "lab", Layout(cameras=2, screens=2, beams=3), 100.0).result / "rig.yaml"
    folder = simulate_calibration(tmp_path / "campaign", rig=str(designed), positions=4)
    assert set(load_project(folder).cameras) == set(load_rig(designed).cameras)
    true = folder / "truth" / "rig.yaml"
    run = simulate("small-motion", tmp_path / "run", frames=3, points=True, rig=true, known_rig=designed)
    np.testing.assert_allclose(load_rig(run / "rig.yaml").beams["A"].direction, load_rig(designed).beams["A"].direction)
    assert not np.allclose(load_rig(true).beams["A"].direction, load_rig(designed).beams["A"].direction, atol=1e-6)


@pytest.mark.parametrize(("rig", "words"), [("fna", "did you mean 'fan'"), ("lab/rig.yaml", "known: fan")])
def test_a_rig_that_is_neither_a_name_nor_a_file_is_an_error(rig, words, tmp_path):
    with pytest.raises(InputError, match=words):
        simulate_calibration(tmp_path / "campaign", rig=rig)
    assert not (tmp_path / "campaign").exists()


def test_the_dots_are_spread_evenly_about_the_middle_of_each_screen():
    c = draw_campaign(5)
    for k, screen in enumerate(c.truth.screens.values()):
        dots = screen.world_from_screen.inverse().apply(c.dots_surveyed[c.dot_screen == k])
        np.testing.assert_allclose([dots.min(axis=0)[:2], dots.max(axis=0)[:2]], [[-2.2, -1.7], [2.2, 1.7]], atol=0.03)
