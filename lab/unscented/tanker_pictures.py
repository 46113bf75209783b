"""Rendered pictures of a tanker with five lamps: two on the wing and three on the fuselage, as in Fu (2016).

The paper gives neither the places of the lamps nor the camera. World is the paper's navigation frame: x ahead, y to the
right, z down; the camera looks ahead.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from geometry.arrays import Array
from geometry.camera import Camera
from geometry.pose import Pose
from geometry.pose_solver.marker_model import MarkerModel

SIZE_PX, FOCAL_PX = (640, 512), 500.0
# In body, m: x ahead, y right, z down. Left and right wing tip; fuselage: tail, spine, belly.
MARKERS = np.array([[-0.6, -3.0, 0.0], [-0.6, 3.0, 0.0], [-3.2, 0.0, -1.0], [0.8, 0.0, -0.1], [-0.4, 0.0, 0.75]])
NOISE_DN, LAMP_DN, LAMP_SIGMA_PX = 2.0, 130.0, 1.2
_WING = np.array([[0.6, 0.0, 0.0], [-0.5, 3.2, 0.0], [-0.9, 3.2, 0.0], [-0.9, -3.2, 0.0], [-0.5, -3.2, 0.0]])
_BODY = np.array([[3.5, 0.0, 0.0], [0.0, 0.0, -0.5], [-3.2, 0.0, -0.9], [-3.4, 0.0, -0.2], [0.0, 0.0, 0.5]])
_BELLY = np.array([[3.5, 0.0, 0.0], [0.0, 0.45, 0.0], [-3.4, 0.1, 0.0], [-3.4, -0.1, 0.0], [0.0, -0.45, 0.0]])


def camera() -> Camera:
    """The receiver's camera: world y, z, x are its x, y, z."""
    K = np.array([[FOCAL_PX, 0, SIZE_PX[0] / 2 - 0.5], [0, FOCAL_PX, SIZE_PX[1] / 2 - 0.5], [0, 0, 1.0]])
    turn = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])
    return Camera("receiver", "", SIZE_PX, K, (), Pose(turn, np.zeros(3)))


def marker_model() -> MarkerModel:
    """The five lamps seen by the camera."""
    return MarkerModel(MARKERS, camera())


def pose_of(state: Array) -> Pose:
    """world_from_body of a state (8,) of tracking/unscented/fu2016.py; the roll is 0."""
    return Pose.from_ypr(np.array([state[6], state[7], 0.0]), state[:3])


@dataclass(frozen=True, slots=True)
class Difficulty:
    """What makes a picture harder than a clear one."""

    false_lights: int = 6  # glints at random places
    p_hidden: float = 0.03  # probability that a lamp is hidden
    blur_px: float = 0.0  # length of the motion blur


CLEAR, GUST = Difficulty(), Difficulty(false_lights=16, p_hidden=0.1, blur_px=3.0)


def render(state: Array, difficulty: Difficulty, rng: np.random.Generator) -> NDArray[np.uint8]:
    """The picture (h, w) of a tanker in a state (8,) of tracking/unscented/fu2016.py: sky, body, lamps, noise."""
    w, h = SIZE_PX
    cloud = rng.standard_normal((8, 10)).astype(np.float32)
    sky: NDArray[np.float32] = np.empty((h, w), np.float32)
    sky[:] = (
        95
        + np.linspace(18, 0, h, dtype=np.float32)[:, None]
        + 7 * cv2.resize(cloud, SIZE_PX, interpolation=cv2.INTER_CUBIC)
    )
    model, pose = marker_model(), pose_of(state)
    for outline, grey in ((_WING, 62.0), (_BELLY, 55.0), (_BODY, 50.0)):
        places, _ = MarkerModel(outline, model.camera).project(pose)
        if np.isfinite(places).all():
            cv2.fillPoly(sky, [np.round(16 * places).astype(np.int32)], grey, cv2.LINE_AA, 4)
    lamps, _ = model.project(pose)
    lit = lamps[(rng.random(len(lamps)) >= difficulty.p_hidden) & np.isfinite(lamps).all(axis=1)]
    false = rng.uniform((0, 0), SIZE_PX, (difficulty.false_lights, 2))
    about = lamps[rng.integers(len(lamps), size=difficulty.false_lights // 2)]
    false[: len(about)] = about + rng.normal(0, 40.0, about.shape)  # glints of the tanker itself
    light = np.zeros((h, w), np.float32)
    for place in np.concatenate([lit, false[np.isfinite(false).all(axis=1)]]):
        _add_lamp(light, place)
    if difficulty.blur_px > 1:
        light[:] = cv2.filter2D(light, -1, _line(difficulty.blur_px, rng.uniform(0, np.pi)))
    picture = sky + light + NOISE_DN * rng.standard_normal((h, w)).astype(np.float32)
    return np.clip(np.round(picture), 0, 255).astype(np.uint8)


def _add_lamp(light: NDArray[np.float32], place: Array) -> None:
    """Add a Gaussian spot at a place (2,), px."""
    h, w = light.shape
    u, v = np.round(place).astype(int).tolist()
    reach = 7
    u0, u1, v0, v1 = max(u - reach, 0), min(u + reach + 1, w), max(v - reach, 0), min(v + reach + 1, h)
    if u0 >= u1 or v0 >= v1:
        return
    du, dv = np.arange(u0, u1) - place[0], np.arange(v0, v1) - place[1]
    light[v0:v1, u0:u1] += LAMP_DN * np.exp(-(du**2 + dv[:, None] ** 2) / (2 * LAMP_SIGMA_PX**2))


def _line(length_px: float, angle: float) -> NDArray[np.float32]:
    """A kernel of motion blur."""
    n = 2 * int(np.ceil(length_px / 2)) + 1
    kernel = np.zeros((n, n), np.float32)
    for s in np.linspace(-length_px / 2, length_px / 2, 8 * n):
        kernel[round(n // 2 + s * np.sin(angle)), round(n // 2 + s * np.cos(angle))] += 1
    return np.asarray(kernel / kernel.sum(), dtype=np.float32)
