"""Errors that belong to a place on the screen, which averaging over a vehicle at rest does not reduce."""

from dataclasses import replace

import numpy as np
import pytest

from geometry.pose import Pose
from geometry.rig import Rig
from geometry.uncertainty.rig_uncertainty import PINHOLE, RigCovariance, perturbed_rig, rig_names, split_name
from lab.simulate.points import CLUTTER, PointRun, simulate_points
from lab.simulate.scenarios import RIGS, PriorRegion
from tests.marks import further_slow
from tests.tracking.rigid_runs import assess, recording_of, smoothed_frames, tracked, zig_zag
from tracking.detections import Detections
from tracking.smoothing.place_errors import correlation, more_of_means, place_errors

WIDTH_PX = 2.0


def textured(
    run: PointRun, place_px: float | np.ndarray, white_px: float, seed: int, known: bool = False, stated: float = 1.0
) -> PointRun:
    """The recording with other errors: white noise, and for each spot a smooth random field over its picture.

    place_px: of all spots, or (views,) of each.
    known: the points state which part of their variance belongs to the place, with sigmas `stated` times too large.
    """
    rng = np.random.default_rng(seed)
    waves, n = 48, run.uv_px.shape[1]
    k_vectors = rng.normal(0, 1 / np.sqrt(2) / WIDTH_PX, (n, 2, waves, 2))
    phases = rng.uniform(0, 2 * np.pi, (n, 2, waves))
    place = np.broadcast_to(place_px, n)
    detections = []
    for k, per_camera in enumerate(run.detections):
        row = []
        for found, views in zip(per_camera, run.origin[k], strict=True):
            uv = found.uv_px.copy()
            for i, view in enumerate(views):
                if view != CLUTTER:
                    at = run.uv_px[k, view]
                    field = np.sqrt(2 / waves) * np.cos(k_vectors[view] @ at + phases[view]).sum(axis=-1)
                    uv[i] = at + place[view] * field + white_px * rng.standard_normal(2)
            width = np.full(len(uv), WIDTH_PX)
            place_px2 = (stated * place[[max(view, 0) for view in views]]) ** 2
            points = Detections.at(uv, (place_px2 + white_px**2)[:, None, None] * np.eye(2))
            place_px2 = place_px2 if known else None
            row.append(replace(points, major_px=width, minor_px=width, place_px2=place_px2))
        detections.append(tuple(row))
    return replace(run, detections=tuple(detections))


@pytest.mark.parametrize(("scenario", "least", "most"), further_slow([("huo2015", 0.5, 1.6), ("static", 0.1, 3.0)]))
def test_sigmas_stay_right_where_texture_shifts_the_spots(scenario, least, most):
    """Taken for white noise, they would make the sigmas at rest 10 times too small: a NEES of 100."""
    nees, shares = [], []
    for seed in range(2):
        run = textured(simulate_points(scenario, seed, frames=120, noise_px=0.05, clutter=0.0), 0.03, 0.01, seed)
        frames, smoothed = smoothed_frames(run, tracked(run))
        answers = assess(run, frames).nees
        nees.append(np.nanmean(answers) / 6)
        shares.append(smoothed.place_share)
    assert least < np.mean(nees) < most
    assert np.min(shares) > 0.5


def only_views(run: PointRun, count: int) -> PointRun:
    """The recording without the points of the views from `count` on: hardly any residuals are left."""
    detections, origins = [], []
    for per_camera, origin in zip(run.detections, run.origin, strict=True):
        kept = [np.flatnonzero(np.asarray(views) < count) for views in origin]
        detections.append(tuple(found[rows] for found, rows in zip(per_camera, kept, strict=True)))
        origins.append(tuple(np.asarray(views)[rows] for views, rows in zip(origin, kept, strict=True)))
    return replace(run, detections=tuple(detections), origin=tuple(origins))


def test_few_spots_show_no_errors_of_places_but_the_texture_of_the_screen_does():
    """With four spots in eight coordinates a pose of six numbers absorbs most of a shift."""
    nees = {False: [], True: []}
    for seed in range(4):
        plain = simulate_points("static", seed, frames=40, noise_px=0.05, clutter=0.0)
        for known, answers in nees.items():
            run = only_views(textured(plain, 0.02, 0.05, seed, known), 4)
            frames, _ = smoothed_frames(run, tracked(run))
            answers.append(np.nanmean(assess(run, frames).nees) / 6)
    assert np.mean(nees[True]) < 1.5
    assert np.mean(nees[False]) > 1.8 * np.mean(nees[True])


def test_stated_errors_of_places_are_reduced_to_what_the_residuals_allow():
    """Clipped spots and backgrounds other than the screen predict ten times too much."""
    nees = {1.0: [], 10.0: []}
    for seed in range(2):
        plain = simulate_points("huo2015", seed, frames=120, noise_px=0.05, clutter=0.0)
        for stated, answers in nees.items():
            run = textured(plain, 0.02, 0.01, seed, True, stated)
            frames, smoothed = smoothed_frames(run, tracked(run))
            answers.append(np.nanmean(assess(run, frames).nees) / 6)
            assert np.all(smoothed.errors.factors.place >= (0.7 if stated == 1 else 0.005))
            # The prior, which does not expect a factor of 10 in sigma, keeps some of it.
            assert np.all(smoothed.errors.factors.place <= (1.4 if stated == 1 else 0.06))
    assert 0.5 < np.mean(nees[1.0]) < 1.5
    assert 0.4 < np.mean(nees[10.0]) < 1.5


def test_speckle_that_few_spots_state_belongs_to_the_places_of_all():
    """Narrow spots do not show their speckle, whose size the residuals then show: taken for noise, it averages out."""
    nees = []
    for seed in range(3):
        run = textured(simulate_points("static", seed, frames=60, noise_px=0.05, clutter=0.0), 0.08, 0.01, seed, True)
        detections = []
        for per_camera, origins in zip(run.detections, run.origin, strict=True):
            shown = [np.asarray(views) % 5 == 0 for views in origins]
            place = [np.where(some, found.place_px2, 1e-8) for some, found in zip(shown, per_camera, strict=True)]
            detections.append(tuple(
                replace(f, place_px2=px2, cov_px2=(px2 + 0.01**2)[:, None, None] * np.eye(2))
                for f, px2 in zip(per_camera, place, strict=True)
            ))  # fmt: skip
        run = replace(run, detections=tuple(detections))
        frames, _ = smoothed_frames(run, tracked(run))
        nees.append(np.nanmean(assess(run, frames).nees) / 6)
    assert 0.3 < np.mean(nees) < 1.6


def fast(seed: int, noise_px: float) -> PointRun:
    """A recording whose spots move by several widths from frame to frame."""
    start = Pose.from_ypr(np.deg2rad([7.0, 0.0, 0.0]), np.zeros(3))
    poses, t_s, turned = zig_zag(seed, 120, 100.0, 40, 1.0, start)
    prior = PriorRegion((0.0, 0.0, 0.0), (7.0, 0.0, 0.0), 0.3, 15.0)
    return recording_of(RIGS["four-skew-beams"](), poses, t_s, noise_px, seed, turned, prior=prior)


@pytest.mark.parametrize("moves", further_slow([False, True]), ids=["slow", "fast"])
@pytest.mark.parametrize(("stated", "least", "most"), further_slow([(2.0, 0.2, 0.33), (1.0, 0.85, 1.15)]))
def test_stated_noise_is_reduced_to_what_the_residuals_allow(stated, least, most, moves):
    nees = []
    for seed in range(2):
        run = fast(seed, 0.05) if moves else simulate_points("huo2015", seed, frames=120, noise_px=0.05, clutter=0.0)
        wider = tuple(
            tuple(replace(found, cov_px2=stated**2 * found.cov_px2) for found in frame) for frame in run.detections
        )
        run = replace(run, detections=wider)
        frames, smoothed = smoothed_frames(run, tracked(run))
        nees.append(np.nanmean(assess(run, frames).nees) / 6)
        assert np.all(smoothed.errors.factors.noise >= least)
        assert np.all(smoothed.errors.factors.noise <= most)
    assert 0.6 < np.mean(nees) < 1.4


def test_spots_that_are_wider_in_other_places_have_no_larger_errors():
    """At a low frame rate a width changes from frame to frame because the spot is elsewhere."""
    run = fast(3, 0.02)
    changing = []
    for frame in run.detections:
        widths = [WIDTH_PX * (1 + 0.15 * np.sin(found.uv_px[:, 0] / 7.0)) for found in frame]
        changing.append(tuple(replace(f, major_px=w, minor_px=w) for f, w in zip(frame, widths, strict=True)))
    run = replace(run, detections=tuple(changing))
    frames, smoothed = smoothed_frames(run, tracked(run))
    assert np.all(smoothed.errors.width_share * WIDTH_PX < 0.02)
    assert 0.5 < np.nanmean(assess(run, frames).nees) / 6 < 1.5


@pytest.mark.parametrize("count", further_slow([4, 5, 6]))
def test_a_vehicle_at_rest_does_not_show_that_its_errors_of_places_are_small(count):
    """Few residuals, which agree in all frames, are small by chance."""
    nees = []
    for seed in range(6):
        run = simulate_points("static", seed, frames=40, noise_px=0.05, clutter=0.0)
        run = only_views(textured(run, 0.03, 0.005, seed, True), count)
        frames, _ = smoothed_frames(run, tracked(run))
        nees.append(np.nanmean(assess(run, frames).nees) / 6)
    assert np.mean(nees) < 1.5


def test_a_vehicle_at_rest_with_some_spots_on_edges_is_uncertain_where_these_determine_it():
    """One share for all spots takes the noise of the others for errors of places: a NEES/6 of 0.15."""
    nees = []
    for seed in range(6):
        run = simulate_points("static", seed, frames=40, noise_px=0.05, clutter=0.0)
        place_px = np.where(np.arange(run.uv_px.shape[1]) % 3 == seed % 3, 0.2, 0.002)
        run = textured(run, place_px, 0.02, seed, True)
        frames, _ = smoothed_frames(run, tracked(run))
        nees.append(np.nanmean(assess(run, frames).nees) / 6)
    assert 0.4 < np.mean(nees) < 1.5


def test_white_noise_is_averaged_over_a_vehicle_at_rest():
    for seed in range(2):
        run = textured(simulate_points("static", seed, frames=120, noise_px=0.05, clutter=0.0), 0.0, 0.05, seed)
        frames, smoothed = smoothed_frames(run, tracked(run))
        assert smoothed.place_share < 0.02
        one = assess(run, frames).bound[60]
        assert frames[60].pose_covariance[0, 0] < one[0] / 20


def test_the_correlation_length_of_the_errors_is_the_width_of_the_spot():
    """Means over a Gaussian of white texture in two places: their correlation is the overlap of the two Gaussians."""
    rng = np.random.default_rng(5)
    width, shift = 3.0, 4.0
    x = np.arange(-20, 21)
    weight = [np.exp(-((x - c) ** 2) / (2 * width**2)) for c in (0.0, shift)]
    means = rng.standard_normal((4000, len(x))) @ np.array(weight).T
    assert np.corrcoef(means.T)[0, 1] == pytest.approx(float(correlation(np.array(shift), width)), abs=0.03)


def with_other_rig(run: PointRun, seed: int) -> tuple[Rig, RigCovariance]:
    """What a calibration knows of the run's rig: the rig drawn from a covariance, and that; spots are .05 px off."""
    names = rig_names(run.rig)
    sigma = np.array([{"rad": 2e-5, "m": 5e-5}.get(n.rsplit("_", 1)[-1], 1e-5) for n in names])
    sigma[[split_name(n)[2] in PINHOLE for n in names]] = 0.05
    drawn = sigma * np.random.default_rng(seed).standard_normal(len(names))
    return perturbed_rig(run.rig, names, drawn), RigCovariance(names, np.diag(sigma**2))


@pytest.mark.parametrize("seed", further_slow(range(4)))
def test_calibration_errors_change_neither_the_noise_of_the_poses_nor_the_errors_of_places(seed):
    """Spots of .01 px, .05 px off by a calibration that says so: taken for errors of places, 2.9 times the sigmas."""
    run = simulate_points("small-motion", seed, frames=100, noise_px=0.01, clutter=0.0)
    rig, covariance = with_other_rig(run, seed)
    _, exact = smoothed_frames(run, tracked(run))
    _, known = smoothed_frames(run, tracked(run, rig=rig, covariance=covariance), rig=rig, covariance=covariance)
    assert known.place_share < 0.05
    of_exact = np.trace(np.linalg.solve(exact.covariance, known.covariance), axis1=1, axis2=2) / 6
    assert 0.8 < np.sqrt(np.median(of_exact)) < 1.2


@pytest.mark.parametrize("scenario", ["static", "small-motion"])
def test_errors_of_places_show_beside_those_of_the_calibration(scenario):
    """At rest both are constant, and what is predicted for the places stays."""
    run = textured(simulate_points(scenario, 1, frames=60, noise_px=0.05, clutter=0.0), 0.03, 0.01, 1, True)
    rig, covariance = with_other_rig(run, 1)
    _, exact = smoothed_frames(run, tracked(run))
    _, known = smoothed_frames(run, tracked(run, rig=rig, covariance=covariance), rig=rig, covariance=covariance)
    assert known.place_share == pytest.approx(exact.place_share, abs=0.1)
    assert exact.place_share > 0.5


def test_errors_that_are_the_same_in_all_frames_at_rest_belong_to_places():
    rng = np.random.default_rng(6)
    residual = np.tile(rng.standard_normal((1, 6, 2)), (80, 1, 1))
    uv, width, averaged = np.zeros((80, 6, 2)), np.full(6, 2.0), np.full(80, 80.0)
    assert place_errors(residual, uv, width, averaged, np.zeros(6)).share > 0.75


def test_a_run_without_labels_has_no_errors_of_places():
    nothing = place_errors(
        np.full((5, 4, 2), np.nan), np.full((5, 4, 2), np.nan), np.full(4, np.nan), np.ones(5), np.zeros(4)
    )
    assert nothing.share == 0.0
    assert np.array_equal(nothing.factor, np.ones(5))


def shown(residual, predicted, step_px=0.0):
    """The share of errors of places where the spots move by `step_px` per frame; residual (T, n, 2)."""
    frames, count = residual.shape[:2]
    along = step_px * np.arange(float(frames))[:, None, None] * np.array([1.0, 0.0])
    uv = np.random.default_rng(7).uniform(0, 500, (1, count, 2)) + along
    return place_errors(
        residual, uv, np.full(count, 2.0), np.full(frames, float(frames)), np.zeros(count), predicted
    ).share


def test_a_prediction_counts_where_the_residuals_hardly_show_errors_of_places():
    """At rest the poses of three spots absorb all of them; those of twelve leave most, and residuals without any
    overrule the prediction. So do twenty places of a moving vehicle.
    """
    rng = np.random.default_rng(8)
    few, many = (rng.standard_normal((60, count, 2)) for count in (3, 12))
    assert 0.25 < shown(few, 0.6) < 0.8
    assert shown(many, 0.6) < 0.05
    assert shown(many, 0.6, step_px=0.5) < 0.05


def test_frames_in_motion_say_nothing_about_the_errors_of_a_vehicle_at_rest():
    """Each of them shows another place once. The places at rest are few, and small errors in them may be chance."""
    rng, rest, moving = np.random.default_rng(11), 36, 100
    residual = rng.standard_normal((rest + moving, 8, 2))
    residual[:rest] += 0.2 * rng.standard_normal((1, 8, 2))
    uv = rng.uniform(0, 500, (1, 8, 2)) + np.zeros((rest + moving, 8, 2))
    uv[rest:] += 30.0 * np.arange(1.0, moving + 1)[:, None, None]
    width, averaged = np.full(8, 2.0), np.full(rest + moving, 12.0)
    alone, both = (place_errors(residual[:k], uv[:k], width, averaged[:k], np.zeros(8), 0.3).share for k in (36, 136))
    assert both == pytest.approx(alone, rel=0.3)


def test_errors_of_places_that_nothing_predicted_count_where_the_residuals_show_them():
    rng = np.random.default_rng(9)
    same = np.tile(rng.standard_normal((1, 12, 2)), (60, 1, 1))
    assert shown(same + 0.1 * rng.standard_normal(same.shape), 0.0) > 0.8
    assert 0.04 < shown(0.3 * same + rng.standard_normal(same.shape), 0.0) < 0.2
    assert shown(rng.standard_normal(same.shape), 0.0) < 0.003


@pytest.mark.parametrize(("step_px", "frames"), [(0.0, 12.0), (0.3, 12.0), (1.0, 12.0), (1.0, 3.0), (20.0, 12.0)])
def test_the_variance_of_a_mean_of_errors_of_places(step_px, frames):
    """Drawn with their correlation along a path, against independent errors; weights as of a mean of `frames`."""
    rng = np.random.default_rng(10)
    k = np.arange(61.0)
    rho = np.exp(-0.25 * (step_px * (k[:, None] - k) / WIDTH_PX) ** 2)
    errors = np.linalg.cholesky(rho + 1e-9 * np.eye(61)) @ rng.standard_normal((61, 20_000))
    weight = np.exp(-0.5 * ((k - 30) * 2 * np.sqrt(np.pi) / frames) ** 2)
    weight /= weight.sum()
    path = np.stack([step_px * k, np.zeros(61)], axis=-1)
    ratio = 1 + more_of_means(path, WIDTH_PX, np.full(61, frames))[30]
    assert ratio == pytest.approx(np.var(weight @ errors) / np.sum(weight**2), rel=0.05)


def test_a_spot_that_shows_hardly_two_places_does_not_say_that_errors_are_the_same_everywhere():
    """Errors of places, drawn with their correlation, along a path of 3.5 widths; their ends agree by chance."""
    frames, width = 60, 10.0
    uv_px = np.zeros((frames, 1, 2))
    uv_px[:, 0, 0] = np.linspace(0, 3.5 * width, frames)
    distance = np.abs(uv_px[:, None, 0, 0] - uv_px[None, :, 0, 0])
    root = np.linalg.cholesky(np.exp(-0.25 * (distance / width) ** 2) + 1e-6 * np.eye(frames))
    seen = []
    for seed in range(40):
        residual = (root @ np.random.default_rng(seed).normal(size=(frames, 2)))[:, None]
        found = place_errors(residual, uv_px, np.array([width]), np.ones(frames), np.zeros(1))
        seen.append(found.elsewhere)
    assert np.mean(np.array(seen) > 0.1) < 0.05


def test_errors_that_are_the_same_at_many_places_of_a_spot_are_errors_of_the_rig():
    frames = 60
    uv_px = np.zeros((frames, 1, 2))
    uv_px[:, 0, 0] = np.linspace(0, 2000, frames)
    residual = np.array([1.5, -1.0]) + 0.3 * np.random.default_rng(3).normal(size=(frames, 1, 2))
    found = place_errors(residual, uv_px, np.array([10.0]), np.ones(frames), np.zeros(1))
    assert 0.7 < found.elsewhere < 1.2
