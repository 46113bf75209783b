"""The ratio of the spots' errors to their stated sigmas, where no redundant spots show it."""

from __future__ import annotations

import numpy as np
import pytest

from geometry.pose import Pose
from lab.simulate.scenarios import RIGS
from tests.tracking.rigid_runs import RIGID, dt_of, found_in, recording_of, tracked
from tracking.rigid_body.association.frame_detections import BLENDED
from tracking.smoothing.error_scale import ErrorScale, scattered_width_share, well_known, widened
from tracking.smoothing.motion.run_detections import Reference, RunDetections
from tracking.smoothing.recording import TrackedRecording

FRAMES, VIEWS, WIDTH = 60, 3, 2.0


def detections(sizes: np.ndarray, sigma_px: float) -> RunDetections:
    """One detection per view and frame with these larger half axes (T, n), px."""
    count = sizes.size
    return RunDetections(
        uv=np.zeros((count, 2)), cov=np.tile(sigma_px**2 * np.eye(2), (count, 1, 1)), blend_px=np.zeros(count),
        begin=np.arange(len(sizes) + 1) * sizes.shape[1], first=np.tile([0, sizes.shape[1]], (len(sizes), 1)),
        has_image=np.ones((len(sizes), 1), dtype=bool), size_px=sizes.ravel(),
        usual_size_px=np.full(sizes.shape[1], np.nan),
    )  # fmt: skip


def sizes(error_px: float) -> np.ndarray:
    """Widths (T, n), px, that change steadily while the vehicle moves, with errors of this sigma."""
    trend = WIDTH * (1 + 0.3 * np.linspace(0, 1, FRAMES)[:, None] * np.arange(VIEWS))
    return trend + error_px * np.random.default_rng(1).normal(size=(FRAMES, VIEWS))


LABELS = np.tile(np.arange(VIEWS), (FRAMES, 1))
CAMERAS = np.zeros(VIEWS, dtype=np.int64)


def share_of(found: RunDetections, labels: np.ndarray) -> np.ndarray:
    """The share of one camera with round spots."""
    return scattered_width_share(found, labels, CAMERAS)


def test_widths_that_scatter_as_their_stated_sigmas_say_add_nothing():
    assert share_of(detections(sizes(0.02), 0.02), LABELS) == [0.0]


def test_widths_that_scatter_more_show_errors_of_this_share_of_the_width():
    errors = 0.06 * sizes(0.0)
    rng = np.random.default_rng(2)
    share = share_of(detections(sizes(0.0) + errors * rng.normal(size=errors.shape), 0.02), LABELS)
    assert share == pytest.approx([0.06], rel=0.2)


def test_unlabelled_and_blended_points_and_unknown_widths_do_not_count():
    wild = detections(sizes(0.5), 0.02)
    assert share_of(wild, np.full_like(LABELS, -1)) == [0.0]
    assert share_of(wild, LABELS + BLENDED) == [0.0]
    assert share_of(wild._replace(size_px=np.full(LABELS.size, np.nan)), LABELS) == [0.0]


def test_errors_that_last_while_a_spot_moves_by_less_than_its_width_show_in_places_farther_apart():
    """A spot that moves by a fifth of its width per frame has nearly the same error in the next frame."""
    rng, views = np.random.default_rng(5), 20
    moved = 0.2 * WIDTH * (np.arange(FRAMES)[:, None] - np.arange(FRAMES))
    alike = np.linalg.cholesky(np.exp(-0.25 * (moved / WIDTH) ** 2) + 1e-6 * np.eye(FRAMES))
    slow = detections(WIDTH * (1 + 0.1 * alike @ rng.normal(size=(FRAMES, views))), 0.02)
    uv = np.stack([0.2 * WIDTH * np.repeat(np.arange(FRAMES), views), np.zeros(FRAMES * views)], axis=-1)
    labels, cameras = np.tile(np.arange(views), (FRAMES, 1)), np.zeros(views, dtype=np.int64)
    # The median of few independent changes is larger in the mean.
    assert scattered_width_share(slow._replace(uv=uv), labels, cameras) == pytest.approx([0.11], rel=0.2)
    assert scattered_width_share(slow, labels, cameras) == [0.0]  # at rest such changes are those of the light


def test_errors_that_only_narrow_spots_hide_add_to_their_camera_alone():
    """One of two cameras, and in it one of three views whose sigmas contain the errors."""
    rng = np.random.default_rng(3)
    scattered = sizes(0.0) * (1 + 0.08 * rng.normal(size=(FRAMES, VIEWS)))
    both = np.concatenate([scattered, sizes(0.02)], axis=1)
    found = detections(both, 0.02)
    cov = found.cov.reshape(FRAMES, 2 * VIEWS, 2, 2).copy()
    cov[:, 0] += (0.08 * WIDTH) ** 2 * np.eye(2)
    found = found._replace(
        cov=cov.reshape(-1, 2, 2),
        first=np.tile([0, VIEWS, 2 * VIEWS], (FRAMES, 1)),
        has_image=np.ones((FRAMES, 2), bool),
    )
    labels, camera_of = np.tile(np.arange(2 * VIEWS), (FRAMES, 1)), np.repeat([0, 1], VIEWS)
    share = scattered_width_share(found, labels, camera_of)
    assert share[0] == pytest.approx(0.07, rel=0.25)
    assert share[1] == 0.0
    added = np.trace(widened(found, share).cov - found.cov, axis1=1, axis2=2).reshape(FRAMES, 2 * VIEWS)
    assert np.all(added[:, :VIEWS] > 0)
    assert np.all(added[:, VIEWS:] == 0)


@pytest.mark.parametrize("uncertain", [0.0, 1.0])
def test_motion_between_pictures_that_is_better_than_stated_does_not_make_the_spots_more_certain(uncertain):
    """uncertain: the share of the frames to whose instants the spots were moved by a motion with stated sigmas."""
    frames, stated = 40, 6.0  # stated: sigma of that motion, over that of the spots
    pose = Pose.from_ypr(np.deg2rad([7.0, 0.0, 0.0]), np.zeros(3))
    every = Pose(np.tile(pose.rotation, (frames, 1, 1)), np.tile(pose.translation, (frames, 1)))
    run = recording_of(RIGS["four-skew-beams"](), every, np.arange(frames) / 80, 0.05, 2)
    recording = TrackedRecording(run.rig, RIGID)
    for k, frame in enumerate(tracked(run)):
        recording.append(dt_of(run, k), found_in(run, k), frame)
    found, labels = recording.run_detections(), recording.assigned
    n = len(run.model)
    motion = found.cov * stated**2 * (np.random.default_rng(1).random(len(found.uv)) < uncertain)[:, None, None]
    moved = found._replace(cov=found.cov + motion)
    ref = Reference(every.rotation, every.translation, np.zeros((frames, 12)))
    errors = ErrorScale.of(
        run.model, found, np.zeros(len(found.uv)), well_known(moved, found, labels), np.zeros((n, 2, 2)), ref,
        np.ones(frames, dtype=bool), motion,
    )  # fmt: skip
    assert errors.factors.noise == pytest.approx(np.ones(len(errors.factors.noise)), abs=0.15)
