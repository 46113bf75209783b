"""Recordings of simulated set-ups, correct ones and ones with a known fault, for the tests of the model check."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np

from calibration.model_check.linearised_frames import ModelCheckRecording
from geometry import rotations
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.rig import Rig
from geometry.uncertainty.rig_uncertainty import perturbed_rig
from lab.simulate.scene import Scene, compose

SCENES = ("smooth", "sharp-turns", "huo2015", "two-cameras-per-screen", "four-skew-beams")
NOISE_PX = 0.1

Change = Callable[[Rig], Rig]


def turned(camera: str, angle_deg: float, axis: int) -> Change:
    """A camera turned about its own centre: axis 0 up or down, 1 sideways, 2 about its optical axis."""

    def change(rig: Rig) -> Rig:
        place = rig.cameras[camera].camera_from_world
        turn = rotations.exp(np.deg2rad(angle_deg) * np.eye(3)[axis])
        now = replace(rig.cameras[camera], camera_from_world=Pose(turn @ place.rotation, turn @ place.translation))
        return Rig(rig.screens, {**rig.cameras, camera: now}, rig.beams, rig.spots)

    return change


def changed(name: str, by: float) -> Change:
    """One parameter of the rig changed, by its name in geometry.uncertainty.rig_uncertainty."""
    return lambda rig: perturbed_rig(rig, [name], np.array([by]))


@cache
def scene_of(scene: str, seed: int) -> Scene:
    """A scene of 600 frames, cached: composing it takes longer than the tests."""
    return compose(scene, seed, 600)


def one_camera(scene: str) -> str:
    """The camera that has the fault."""
    return "right-a" if scene == "two-cameras-per-screen" else "right"


def recorded(
    scene: str,
    seed: int,
    *,
    frames: int = 600,
    really: Change | None = None,
    late: tuple[str, float] | None = None,
    claimed_px: float = NOISE_PX,
    predicted: bool = False,
) -> tuple[Scene, ModelCheckRecording]:
    """The first frames of a simulated recording with the true labels; the poses have errors of 1 mm and 0.3 mrad.

    The run's rig is the stated one; `really` changes it to the one that the spots come from. late: a camera and its
    delay, s. predicted: with predictions that have an error of 0.1 px and the covariance of that.
    """
    run, some = scene_of(scene, seed), slice(0, frames)
    poses, t_s = run.poses[some], run.t_s[some]
    rng = np.random.default_rng([seed, 2026])
    uv = run.uv_px[some] if really is None else SpotModel.of(really(run.rig)).project(poses)[0]
    if late is not None:
        filmed = run.model.camera_of == run.model.camera_names.index(late[0])
        uv = np.where(filmed[:, None], run.model.project(run.motion.pose(t_s + late[1]))[0], uv)
    measured = uv + NOISE_PX * rng.standard_normal(uv.shape)
    shift = np.array([1e-3] * 3 + [3e-4] * 3) * rng.standard_normal((frames, 6))
    covariance = np.broadcast_to(claimed_px**2 * np.eye(2), (*uv.shape, 2)).copy()
    guess = uv + 0.1 * rng.standard_normal(uv.shape) if predicted else None
    return run, ModelCheckRecording(
        t_s=t_s,
        seen=(run.in_view[some] == 1) & run.has_image[some][:, run.model.camera_of],
        uv_px=measured,
        cov_px2=covariance,
        poses=poses.plus(shift),
        predicted_px=guess,
        predicted_cov_px2=np.broadcast_to(0.01 * np.eye(2), covariance.shape).copy() if predicted else None,
    )
