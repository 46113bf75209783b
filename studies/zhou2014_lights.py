"""The experiment of Zhou (2014), section 4, with rendered drogues: an approach from 10 m in three lights.

Nobody publishes pictures of a refuelling drogue, so they are rendered. A drogue has several circles: the rim of the
canopy, its inner edge and the opening of the basket. The tracker follows the one that it acquires; the truth is the
image of that circle.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from geometry.arrays import Array
from geometry.camera import Camera
from geometry.pose import Pose
from lab.targets.circle import CircleOptions
from studies.drogue.render import render_drogue, rim_of
from studies.drogue.scene import LIGHTS, DrogueBackground, DrogueScene, Occluder, ellipse_through
from tracking.statuses import PoseStatus

PAPER_PERCENT = {"front": 92.2, "side": 96.7, "overcast": 96.7}  # table 1
RADIUS_M, FAR_M, NEAR_M = 0.3, 10.0, 2.0
FOCAL_PX, SIZE = 600.0, (640, 512)
RATE_HZ, EXPOSURE_S = 25.0, 0.004
TRACKED = 0.1  # largest error of the centre, as a share of the radius of the rim, of a tracked frame
_PERIOD, _PROBE = 120, 24  # frames: the probe enters once in each period, for this long
_TILT_DEG = 8.0
_LEAST_FRAMES = 150  # of the whole approach: in fewer frames it would be a jump


@dataclass(frozen=True, slots=True)
class DrogueFrame:
    """One rendered picture and its circles."""

    picture: NDArray[np.uint8]  # (h, w) grey
    circles: Array  # (3, 3): u, v and semi-major axis of the rim, the inner edge of the canopy, the basket's opening
    hidden: float  # share of the rim


@dataclass(frozen=True, slots=True)
class LightResult:
    """A tracker on the frames of one light."""

    light: str
    frames: int
    tracked: int  # measured or predicted, with a centre within a tenth of the radius
    measured: int
    errors_px: Array  # (m,) of the tracked frames

    @property
    def percent(self) -> float:
        """Share of tracked frames."""
        return 100 * self.tracked / self.frames


def approach(seed: int, light: str, frames: int, scale: int = 1) -> Iterator[DrogueFrame]:
    """A drogue that comes nearer, sways and tilts, before moving clouds; a probe covers a part of it at times.

    scale: 2 renders pictures of twice the width, with twice the focal length.
    """
    width, height, focal = scale * SIZE[0], scale * SIZE[1], scale * FOCAL_PX
    rng = np.random.default_rng([seed, 4, sorted(LIGHTS).index(light)])
    camera = Camera(
        name="camera", screen="", image_size_px=(width, height),
        matrix=np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]]),
        distortion=(), camera_from_world=Pose(np.eye(3), np.zeros(3)),
    )  # fmt: skip
    phase = rng.uniform(0, 2 * np.pi, 7)
    kind = ("sky", "clouds", "ground")[int(rng.integers(3))]
    look = int(rng.integers(2**31))
    drift = rng.uniform(-1.5, 1.5, 2)
    side = rng.uniform(0, 2 * np.pi, frames // _PERIOD + 1)
    for k in range(frames):
        pose, rate = _pose(k / RATE_HZ, k / max(frames, _LEAST_FRAMES), phase)
        distance = float(pose.translation[2])
        moved = focal / distance * rate[:2] * EXPOSURE_S
        # The texture is mirrored at its edges: the background moves to and fro.
        shift = 60 * np.sin(drift * k / 60)
        scene = DrogueScene(
            camera, pose, RADIUS_M, light=LIGHTS[light], blur_px=0.8, noise_dn=3.0,
            background=DrogueBackground(kind, look, (float(shift[0]), float(shift[1]))),
            motion_px=(float(moved[0]), float(moved[1])),
            occluders=_probe(camera, pose, k, float(side[k // _PERIOD])),
        )  # fmt: skip
        drawn = render_drogue(scene, rng)
        grey = cv2.cvtColor(drawn.image, cv2.COLOR_BGR2GRAY).astype(np.uint8, copy=False)
        yield DrogueFrame(grey, _circles(scene), drawn.hidden)


def _pose(t_s: float, share: float, phase: Array) -> tuple[Pose, Array]:
    """The drogue in the camera's frame, and its velocity, m/s. share: part of the approach that is done."""
    turn = 2 * np.pi * np.array([0.2, 0.17, 0.6, 0.55])
    size = np.array([0.25, 0.15, 0.02, 0.02])
    angle = turn * t_s + phase[:4]
    sway, rate = size * np.sin(angle), size * turn * np.cos(angle)
    distance = FAR_M * (NEAR_M / FAR_M) ** share
    tilt = np.radians(_TILT_DEG) * np.sin(2 * np.pi * np.array([0.25, 0.21, 0.1]) * t_s + phase[4:])
    place = np.array([sway[0] + sway[2], sway[1] + sway[3], distance])
    velocity = np.array([rate[0] + rate[2], rate[1] + rate[3], 0.0])
    return Pose(Rotation.from_rotvec(tilt).as_matrix(), place), velocity


def _probe(camera: Camera, pose: Pose, k: int, side_rad: float) -> tuple[Occluder, ...]:
    """The probe: once in each period it covers up to about a fifth of the drogue, from one side."""
    into = k % _PERIOD - (_PERIOD - _PROBE)
    if into < 0:
        return ()
    u, v = camera.project(pose.translation)
    radius = float(camera.matrix[0, 0]) * RADIUS_M / float(pose.translation[2])
    depth = np.sin(np.pi * (into + 0.5) / _PROBE)  # how far it reaches in: to half of the radius
    along = np.array([np.cos(side_rad), np.sin(side_rad)])
    end, start = [u, v] + (1.3 - 0.8 * depth) * radius * along, [u, v] + 900 * along
    return (Occluder((float(end[0]), float(end[1])), 0.35 * radius, (float(start[0]), float(start[1]))),)


def _circles(scene: DrogueScene) -> Array:
    look = scene.look
    opening = look.canopy_inner + (look.rear - look.canopy_inner) * look.lining_from
    places = ((1.0, 0.0), (look.canopy_inner, 0.0), (opening, look.lining_from * look.depth))
    ellipses = [ellipse_through(rim_of(scene, r * scene.radius_m, z * scene.radius_m)) for r, z in places]
    return np.array([[*e.centre_px, e.major_px] for e in ellipses])


def followed(seed: int, light: str, frames: int, forms: tuple[str, ...] = ("sound", "printed")) -> list[LightResult]:
    """Track the approach with each form of the tracker; both get the same pictures and no place of the first circle."""
    trackers = [CircleOptions(form=form, min_radius_px=10.0).tracker() for form in forms]
    own = [0] * len(forms)
    errors: list[list[float]] = [[] for _ in forms]
    measured = [0] * len(forms)
    for drawn in approach(seed, light, frames):
        for i, tracker in enumerate(trackers):
            frame = tracker.step(drawn.picture)
            if not np.isfinite(frame.state[:3]).all():
                errors[i].append(np.inf)
                continue
            if frame.event:  # acquired: which circle it follows from here on
                own[i] = int(np.argmin(np.abs(drawn.circles - frame.state[:3]).sum(axis=1)))
            error = float(np.hypot(*(frame.state[:2] - drawn.circles[own[i], :2])))
            errors[i].append(error if error < TRACKED * drawn.circles[0, 2] else np.inf)
            measured[i] += frame.status is PoseStatus.MEASURED
    out = []
    for own_errors, count in zip(errors, measured, strict=True):
        good = np.array([e for e in own_errors if np.isfinite(e)])
        out.append(LightResult(light, len(own_errors), len(good), count, good))
    return out
