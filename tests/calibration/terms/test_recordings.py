"""A recording whose poses are eliminated frame by frame, against the whole system with all poses as unknowns."""

from __future__ import annotations

import numpy as np
import pytest

from calibration.least_squares.adjustment import Poses, solve
from calibration.model_check.linearised_frames import ModelCheckRecording
from calibration.terms.recordings import RecordingTerm
from calibration.terms.rig_blocks import BEAMS, CAMERAS, POSES, SCREENS, STAND, SpotPixels, SpotTerm, stacks_of
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from tests.geometry.scenes import random_pose, random_rig

FRAMES = 12


def recorded(seed: int):
    """A rig, its recording with noise, and the poses."""
    rng = np.random.default_rng(seed)
    rig = random_rig(rng)
    poses = Poses.of([random_pose(rng, 0.1, 0.1) for _ in range(FRAMES)]).pose
    uv, _ = SpotModel.of(rig).project(poses)
    seen = np.isfinite(uv).all(axis=-1)
    cov = np.broadcast_to(0.01 * np.eye(2), (*seen.shape, 2, 2)).copy()
    noisy = uv + 0.1 * rng.normal(size=uv.shape)
    return rig, ModelCheckRecording(np.arange(float(FRAMES)), seen, noisy, cov, poses)


@pytest.mark.parametrize("seed", range(3))
def test_the_information_on_the_rig_is_the_schur_complement_of_the_whole_system(seed):
    rig, recording = recorded(seed)
    stacks = stacks_of(rig)
    free = {s: np.ones((len(stacks[s]), stacks[s].dof), dtype=bool) for s in (CAMERAS, SCREENS, BEAMS)}
    term = RecordingTerm(rig, recording, free)
    reduced = term.reduced(stacks)
    position, view = np.nonzero(recording.seen)
    spots = SpotPixels(position, view, recording.uv_px[position, view], recording.cov_px2[position, view])
    values = {**stacks, STAND: Poses.of([Pose.identity()]), POSES: Poses(recording.poses)}
    whole = SpotTerm(rig, spots)
    # The poses alone are adjusted first: the term is about the poses that fit the given rig best.
    fitted = solve(values, [whole], {POSES: True})
    assert reduced.rest + reduced.y @ reduced.y == pytest.approx(fitted.chi2, rel=1e-6)
    H = np.zeros((reduced.X.shape[1],) * 2)
    line = whole.linearise(fitted.values)
    J = np.zeros((line.residuals.size, reduced.X.shape[1] + 6 * FRAMES))
    place = {a: i for i, a in enumerate(term.at)}
    start = np.cumsum([0, *(stacks[s].dof for s, _ in term.at)])
    for part in line.parts:
        for row, element in enumerate(part.index):
            if part.stack == POSES:
                first = reduced.X.shape[1] + 6 * element
            elif (part.stack, element) in place:
                first = start[place[part.stack, element]]
            else:
                continue
            J[2 * row : 2 * row + 2, first : first + part.jacobian.shape[2]] += part.jacobian[row]
    p = reduced.X.shape[1]
    A, B = J[:, :p], J[:, p:]
    H = A.T @ A - A.T @ B @ np.linalg.pinv(B.T @ B) @ B.T @ A
    scale = 1 / np.sqrt(np.maximum(np.diagonal(H), 1e-12))
    np.testing.assert_allclose(
        (reduced.X.T @ reduced.X) * np.outer(scale, scale), H * np.outer(scale, scale), atol=1e-6
    )


def test_the_derivatives_of_the_term_are_those_of_its_cost():
    rig, recording = recorded(5)
    stacks = stacks_of(rig)
    free = {s: np.ones((len(stacks[s]), stacks[s].dof), dtype=bool) for s in (CAMERAS, SCREENS, BEAMS)}
    term = RecordingTerm(rig, recording, free)

    def cost(step: float, direction: np.ndarray) -> float:
        values, start = dict(stacks), 0
        for stack in (CAMERAS, SCREENS, BEAMS):
            count = len(stacks[stack]) * stacks[stack].dof
            delta = step * direction[start : start + count].reshape(len(stacks[stack]), -1)
            values[stack] = stacks[stack].plus(delta)
            start += count
        return float(np.sum(term.linearise(values).residuals ** 2))

    reduced = term.reduced(stacks)
    rng = np.random.default_rng(0)
    for _ in range(3):
        direction = rng.normal(size=reduced.X.shape[1])
        slope = (cost(1e-6, direction) - cost(-1e-6, direction)) / 2e-6
        assert slope == pytest.approx(-2 * float(reduced.y @ reduced.X @ direction), rel=1e-4, abs=1.0)
