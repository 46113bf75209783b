"""A recording as truth and noisy detections without pictures, for studies with many runs."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.rig import Rig
from lab.simulate.scenarios import PriorRegion, Scenario
from lab.simulate.scene import OCCLUDED, POINT_NOISE, VISIBLE, compose, with_overrides
from tracking.detections import Detections

CLUTTER = -1  # origin of a false detection
_LEAST_SIGMA_PX = 1e-3  # stated sigma of noise-free detections, so that their weight is finite


@dataclass(frozen=True, slots=True)
class PointRun:
    """T frames, n views (camera and spot, in the order of model.views), c cameras."""

    name: str
    seed: int
    rig: Rig
    model: SpotModel
    prior: PriorRegion
    noise_px: float  # 1 sigma per axis of each detection
    frame_rate_hz: float
    frame: Ints  # (T,) 0, 1, ...
    t_s: Array  # (T,)
    poses: Pose  # (T,) true world_from_body
    uv_px: Array  # (T, n, 2) true, also outside the picture; nan where there is none
    in_view: Ints  # (T, n) 1 visible in the picture, 2 occluded, 0 outside
    has_image: Bools  # (T, c); False: no detections
    turned: Bools  # (T,) the motion bends between the frame before and this one
    detections: tuple[tuple[Detections, ...], ...]  # [frame][camera], in random order
    origin: tuple[tuple[Ints, ...], ...]  # [frame][camera] (rows,): the view of each detection, or CLUTTER


def simulate_points(
    scenario: str | Scenario,
    seed: int,
    *,
    frames: int | None = None,
    noise_px: float = 0.1,
    clutter: float | None = None,
    miss_probability: float | None = None,
    picture_scale: float = 1.0,
    rig: Rig | None = None,
) -> PointRun:
    """One recording of a scenario as points.

    noise_px: 1 sigma per axis, also of clutter. clutter: probability of a false point near each spot in the picture
    (default: that of the scenario). miss_probability: of each spot in each frame. The motion depends on scenario and
    seed only; the clutter of a lower probability is a subset of that of a higher one. picture_scale, rig: as in
    `compose`.

    Raises:
        InputError: an unknown scenario, or an argument out of range.
    """
    overridden = with_overrides(scenario, clutter=clutter, miss_probability=miss_probability)
    scene = compose(overridden, seed, frames, picture_scale, rig)
    model, false = scene.model, scene.clutter_points
    n, cameras = len(model), range(len(model.camera_names))
    first_false = np.searchsorted(false.frame, np.arange(len(scene.frame) + 1))
    covariance = max(noise_px, _LEAST_SIGMA_PX) ** 2 * np.eye(2)
    detections, origins = [], []
    for k in range(len(scene.frame)):
        some = slice(first_false[k], first_false[k + 1])
        rng = np.random.default_rng([seed, POINT_NOISE, k])
        # Noise is drawn for all views, so that it does not depend on which spots are occluded.
        uv = np.concatenate([scene.uv_px[k], false.uv_px[some]])
        uv = uv + noise_px * rng.standard_normal(uv.shape)
        of = np.concatenate([np.arange(n), np.full(len(uv) - n, CLUTTER)])
        camera = np.concatenate([model.camera_of, false.camera[some]])
        there = np.concatenate([scene.in_view[k] == VISIBLE, np.ones(len(uv) - n, dtype=bool)])
        shuffled = rng.permutation(len(uv))
        rows = [shuffled[(there & (camera == c) & scene.has_image[k, c])[shuffled]] for c in cameras]
        detections.append(tuple(Detections.at(uv[r], np.tile(covariance, (len(r), 1, 1))) for r in rows))
        origins.append(tuple(of[r] for r in rows))
    return PointRun(
        name=scene.scenario.name,
        seed=seed,
        rig=scene.rig,
        model=model,
        prior=scene.scenario.prior,
        noise_px=noise_px,
        frame_rate_hz=scene.scenario.frame_rate_hz,
        frame=scene.frame,
        t_s=scene.t_s,
        poses=scene.poses,
        uv_px=scene.uv_px,
        in_view=scene.in_view,
        has_image=scene.has_image,
        turned=scene.turned,
        detections=tuple(detections),
        origin=tuple(origins),
    )


def with_occlusions(run: PointRun, hide: Bools) -> PointRun:
    """The recording with the spots of `hide` (T, n) occluded. False points are not changed."""
    detections, origins = [], []
    for k in range(len(run.frame)):
        keep = [np.array([o == CLUTTER or not hide[k, o] for o in of], dtype=bool) for of in run.origin[k]]
        detections.append(tuple(d[rows] for d, rows in zip(run.detections[k], keep, strict=True)))
        origins.append(tuple(of[rows] for of, rows in zip(run.origin[k], keep, strict=True)))
    in_view = np.where(hide & (run.in_view == VISIBLE), OCCLUDED, run.in_view)
    return replace(run, in_view=in_view, detections=tuple(detections), origin=tuple(origins))
