"""Random scenes with a property that the random draws never have: `--variant NAME`.

Each variant changes a scene of `random_scene`: what the program is given, or what the recording shows.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from bench.random_scenes.projection import in_picture
from bench.random_scenes.scene import CLUTTER, HIDDEN, SHINING, Scene
from geometry.arrays import Array, Bools, Ints
from geometry.pose import Pose
from tracking.detections import Detections

VARIANTS = 31  # the stream of random numbers
Variant = Callable[[Scene, np.random.Generator], Scene]
PointsOf = Callable[[int, int], Array]
"""Additional false points (m, 2), px, of a frame and a camera."""


def varied(scene: Scene, name: str) -> Scene:
    """A variant of a scene; its text begins with the name."""
    changed = CHANGES[name](scene, np.random.default_rng([scene.seed, VARIANTS, *map(ord, name)]))
    return replace(changed, text=f"{name}; {scene.text}")


def _with_false_points(scene: Scene, rng: np.random.Generator, points_of: PointsOf) -> Scene:
    sizes = [np.array(c.image_size_px) for c in scene.rig.cameras.values()]
    detections, origins = [], []
    for k in range(len(scene)):
        found, origin = list(scene.detections[k]), list(scene.origin[k])
        for c in np.flatnonzero(scene.has_image[k]):
            new = points_of(k, int(c)).reshape(-1, 2)
            new = new[in_picture(new, sizes[c])]
            sigma = float(np.median(scene.sigma_px[scene.camera_of == c]))
            new = new + sigma * rng.normal(size=new.shape)
            order = rng.permutation(len(found[c]) + len(new))
            cov = np.concatenate([found[c].cov_px2, np.tile(sigma**2 * np.eye(2), (len(new), 1, 1))])
            found[c] = Detections.at(np.concatenate([found[c].uv_px, new])[order], cov[order])
            origin[c] = np.concatenate([origin[c], np.full(len(new), CLUTTER)])[order]
        detections.append(tuple(found))
        origins.append(tuple(origin))
    return replace(scene, detections=tuple(detections), origin=tuple(origins))


def _hidden(scene: Scene, mask: Bools) -> Scene:
    """The scene with further views (T, n) hidden."""
    mask = mask & (scene.in_view == SHINING)
    detections, origins = [], []
    for k in range(len(scene)):
        kept = [(o == CLUTTER) | ~mask[k][np.maximum(o, 0)] for o in scene.origin[k]]
        detections.append(tuple(d[keep] for d, keep in zip(scene.detections[k], kept, strict=True)))
        origins.append(tuple(o[keep] for o, keep in zip(scene.origin[k], kept, strict=True)))
    in_view: Ints = np.where(mask, HIDDEN, scene.in_view)
    return replace(scene, in_view=in_view, detections=tuple(detections), origin=tuple(origins))


def _shining(scene: Scene, k: int, camera: int) -> Ints:
    return np.flatnonzero((scene.camera_of == camera) & (scene.in_view[k] == SHINING))


def _no_prior(scene: Scene, _: np.random.Generator) -> Scene:
    return replace(scene, prior=None)


def _hidden_start(scene: Scene, rng: np.random.Generator) -> Scene:
    """All spots, those of a camera, or half of them hidden in the first 3 to 40 frames."""
    frames, mask = int(rng.integers(3, 40)), np.zeros(scene.in_view.shape, dtype=bool)
    spots = np.unique(scene.spot_of)
    half = rng.choice(spots, max(1, len(spots) // 2), replace=False)
    one_camera = scene.camera_of == rng.integers(scene.camera_of.max() + 1)
    views = (np.ones(len(scene.camera_of), dtype=bool), one_camera, np.isin(scene.spot_of, half))[rng.integers(3)]
    mask[:frames, views] = True
    return replace(_hidden(scene, mask), late_start=True)


def _few_left(scene: Scene, rng: np.random.Generator) -> Scene:
    """One to three spots left for 20 frames or more."""
    first = int(rng.integers(12, 60))
    last = int(rng.integers(first + 20, len(scene) - 20))
    spots = np.unique(scene.spot_of)
    left = rng.choice(spots, min(int(rng.integers(1, 4)), len(spots) - 1), replace=False)
    mask = np.zeros(scene.in_view.shape, dtype=bool)
    mask[first:last] = ~np.isin(scene.spot_of, left)
    return _hidden(scene, mask)


def _missed(scene: Scene, rng: np.random.Generator) -> Scene:
    """Each spot missed at random in 5 to 40 % of the frames."""
    return _hidden(scene, rng.random(scene.in_view.shape) < rng.uniform(0.05, 0.4))


def _thinned(scene: Scene, rng: np.random.Generator) -> Scene:
    """Every second to fourth frame."""
    k = np.arange(0, len(scene), int(rng.integers(2, 5)))
    poses = Pose(scene.poses.rotation[k], scene.poses.translation[k])
    return replace(
        scene, frame_rate_hz=scene.frame_rate_hz / int(k[1]), poses=poses,
        uv_px=scene.uv_px[k], in_view=scene.in_view[k], has_image=scene.has_image[k],
        detections=tuple(scene.detections[i] for i in k), origin=tuple(scene.origin[i] for i in k),
        corner_frames=scene.corner_frames / k[1],
    )  # fmt: skip


def _misstated(scene: Scene, rng: np.random.Generator) -> Scene:
    """All sigmas stated 0.3 to 3 times as large as they are."""
    factor = float(np.exp(rng.uniform(np.log(0.3), np.log(3.0))))
    given = tuple(tuple(Detections.at(d.uv_px, d.cov_px2 * factor**2) for d in of) for of in scene.detections)
    return replace(scene, detections=given)


def _lens_ghosts(scene: Scene, rng: np.random.Generator) -> Scene:
    """Each spot mirrored about the centre of the picture."""
    centres = [(np.array(c.image_size_px) - 1) / 2 for c in scene.rig.cameras.values()]
    scale = -rng.uniform(0.6, 1.1)
    return _with_false_points(
        scene, rng, lambda k, c: centres[c] + scale * (scene.uv_px[k, _shining(scene, k, c)] - centres[c])
    )


def _double_reflections(scene: Scene, rng: np.random.Generator) -> Scene:
    """Beside half of the spots a second point at a fixed distance of 0 to 80 px."""
    doubled = rng.random(len(scene.camera_of)) < 0.5
    offset = rng.normal(size=(len(scene.camera_of), 2)) * rng.uniform(5, 40, (len(scene.camera_of), 1))

    def beside(k: int, camera: int) -> Array:
        views = _shining(scene, k, camera)
        views = views[doubled[views]]
        return np.asarray(scene.uv_px[k, views] + offset[views])

    return _with_false_points(scene, rng, beside)


def _moving_lights(scene: Scene, rng: np.random.Generator) -> Scene:
    """One or two lights per picture on Lissajous curves of their own."""
    lights = [
        [
            (
                rng.uniform(0, 1, 2) * size,
                rng.uniform(0.05, 0.5, 2) * size,
                rng.uniform(0.05, 3, 2),
                rng.uniform(0, 6, 2),
            )
            for _ in range(rng.integers(1, 3))
        ]
        for size in (np.array(c.image_size_px) for c in scene.rig.cameras.values())
    ]

    def at(k: int, camera: int) -> Array:
        t = scene.t_s[k]
        return np.array([m + a * np.sin(2 * np.pi * hz * t + phase) for m, a, hz, phase in lights[camera]])

    return _with_false_points(scene, rng, at)


def _dense(scene: Scene, rng: np.random.Generator) -> Scene:
    """10 to 60 false points anywhere in each picture."""
    sizes = [np.array(c.image_size_px) for c in scene.rig.cameras.values()]
    count = int(rng.integers(10, 60))
    return _with_false_points(scene, rng, lambda _, c: rng.uniform(-0.5, sizes[c] - 0.5, (count, 2)))


CHANGES: dict[str, Variant] = {
    "no-prior": _no_prior,
    "hidden-start": _hidden_start,
    "few-left": _few_left,
    "missed": _missed,
    "thinned": _thinned,
    "misstated": _misstated,
    "lens-ghosts": _lens_ghosts,
    "double-reflections": _double_reflections,
    "moving-lights": _moving_lights,
    "dense": _dense,
}
