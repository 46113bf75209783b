"""One random recording: T frames, n views (camera and spot, in the order of Rig.views()), c cameras."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from bench.random_scenes.draw.motions import Motion, draw_motion
from bench.random_scenes.draw.nuisances import (
    CLEAN_FRAMES,
    MOST_ANYWHERE,
    FalsePoints,
    draw_false_points,
    draw_hidden,
    draw_missing,
)
from bench.random_scenes.draw.rigs import Lab, draw_lab
from bench.random_scenes.draw.vehicles import LEAST_SPOTS
from bench.random_scenes.projection import in_picture, spot_pixels
from geometry import rotations
from geometry.arrays import Array, Bools, Ints
from geometry.pose import Pose
from geometry.pose_prior import PosePrior
from geometry.rig import Rig
from geometry.uncertainty.rig_uncertainty import RigCovariance
from tracking.detections import Detections

# Independent streams of random numbers, so that the kinds of draws do not affect each other.
LAB, MOTION, NUISANCE, POINTS, PRIOR = range(5)
OUTSIDE, SHINING, HIDDEN = 0, 1, 2
CLUTTER = -1  # origin of a false point
FASTEST_PX = (30.0, 100.0)  # largest speed of a spot, px per frame: usually, and in one scene of seven
LEAST_IN_VIEW = 0.7


@dataclass(frozen=True, slots=True)
class Scene:
    """A recording with its truth."""

    seed: int
    rig: Rig  # the true rig
    known_rig: Rig  # the rig given to the program
    covariance: RigCovariance | None  # stated covariance of the difference
    prior: PosePrior | None
    frame_rate_hz: float
    poses: Pose  # (T,) true world_from_body
    uv_px: Array  # (T, n, 2) true, also outside the picture; nan where there is none
    in_view: Ints  # (T, n) SHINING, HIDDEN (or missed) or OUTSIDE
    has_image: Bools  # (T, c)
    sigma_px: Array  # (n,) 1 sigma per axis of the points of each view
    detections: tuple[tuple[Detections, ...], ...]  # [frame][camera], in random order; none without a picture
    origin: tuple[tuple[Ints, ...], ...]  # [frame][camera] (rows,): the view of each point, or CLUTTER
    corner_frames: Array  # (k,) corners of the motion, in frames and fractions
    text: str
    late_start: bool = False  # the first frames need not determine a pose
    camera_of: Ints = field(init=False)  # (n,)
    spot_of: Ints = field(init=False)  # (n,)

    def __post_init__(self) -> None:
        camera_of, spot_of = view_indices(self.rig)
        object.__setattr__(self, "camera_of", camera_of)
        object.__setattr__(self, "spot_of", spot_of)

    def __len__(self) -> int:
        return len(self.in_view)

    @property
    def t_s(self) -> Array:
        """(T,)"""
        return np.arange(len(self)) / self.frame_rate_hz

    @property
    def shining(self) -> Bools:
        """(T, n): there is a point of this view."""
        return (self.in_view == SHINING) & self.has_image[:, self.camera_of]

    def found(self, k: int) -> list[Detections | None]:
        """The points of frame k by camera; None without a picture."""
        return [d if self.has_image[k, c] else None for c, d in enumerate(self.detections[k])]


def view_indices(rig: Rig) -> tuple[Ints, Ints]:
    """The camera and the spot of each view, (n,) each."""
    cameras, spots = list(rig.cameras), list(rig.spots)
    views = rig.views()
    return np.array([cameras.index(c) for c, _ in views]), np.array([spots.index(s) for _, s in views])


def random_scene(seed: int, frames: int = 200) -> Scene:
    """The scene of a seed; it depends on the number of frames."""
    attempt = 0
    while True:
        scene = _attempt([seed, attempt], seed, frames)
        if scene is not None:
            return scene
        attempt += 1


def _attempt(key: list[int], seed: int, frames: int) -> Scene | None:
    lab = draw_lab(np.random.default_rng([*key, LAB]))
    rng = np.random.default_rng([*key, MOTION])
    rate = float(np.exp(rng.uniform(np.log(25), np.log(500))))
    motion = draw_motion(rng, np.arange(frames) / rate)
    fastest = FASTEST_PX[int(rng.random() < 1 / 7)]
    in_view = 1.0 if rng.random() < 0.5 else float(rng.uniform(LEAST_IN_VIEW, 1.0))
    amplitudes = draw_amplitudes(rng, lab) * (1.0 if in_view == 1.0 else rng.uniform(1.0, 3.0))
    q = fitted_motion(lab, motion, amplitudes, fastest, in_view)
    if q is None:
        return None
    noise = float(np.exp(rng.uniform(np.log(0.005), np.log(0.3))))
    uneven = rng.random() < 0.3
    poses = lab.poses(q)
    uv = spot_pixels(lab.rig, poses)
    camera_of, spot_of = view_indices(lab.rig)
    sigma = noise * (
        np.exp(rng.uniform(np.log(0.5), np.log(2.0), len(camera_of))) if uneven else np.ones(len(camera_of))
    )
    corners = motion.corners_s * rate
    rng = np.random.default_rng([*key, NUISANCE])
    false = draw_false_points(rng, lab.rig, uv, camera_of)
    hidden, hidden_text = draw_hidden(rng, frames, camera_of, spot_of, corners)
    has_image, missing_text = draw_missing(rng, frames, len(lab.rig.cameras))
    step = np.nanmedian(np.linalg.norm(np.diff(uv, axis=0), axis=-1))
    text = (
        f"{lab.text}; {rate:.0f} Hz, {motion.text}, {step:.2g} px/frame; noise {noise:.2g} px{' uneven' * uneven};"
        f" {false.text}; {hidden_text}{'; ' * bool(missing_text)}{missing_text}"
    )
    return composed(
        key, seed, lab.rig, poses, rate, sigma, false, hidden, has_image, corners, text,
        draw_prior(np.random.default_rng([*key, PRIOR]), poses[0]),
    )  # fmt: skip


def composed(
    key: list[int],
    seed: int,
    rig: Rig,
    poses: Pose,
    rate_hz: float,
    sigma_px: Array,
    false: FalsePoints,
    hidden: Bools,
    has_image: Bools,
    corner_frames: Array,
    text: str,
    prior: PosePrior | None,
    uv: Array | None = None,
) -> Scene:
    """The points and the truth of a motion with a rig. uv (T, n, 2): where pictures have instants of their own."""
    uv = spot_pixels(rig, poses) if uv is None else uv
    camera_of, _ = view_indices(rig)
    sizes = np.array([c.image_size_px for c in rig.cameras.values()], dtype=float)
    inside = in_picture(uv, sizes[camera_of])
    in_view = np.where(inside, np.where(hidden, HIDDEN, SHINING), OUTSIDE)
    rng = np.random.default_rng([*key, POINTS])
    detections, origins = [], []
    for k in range(len(uv)):
        points = [
            one_picture(rng, c, uv[k], in_view[k], camera_of, sigma_px, sizes[c], false) for c in range(len(sizes))
        ]
        points = [
            p if has_image[k, c] else (Detections.none(), np.zeros(0, dtype=np.int64)) for c, p in enumerate(points)
        ]
        detections.append(tuple(d for d, _ in points))
        origins.append(tuple(o for _, o in points))
    return Scene(
        seed=seed,
        rig=rig,
        known_rig=rig,
        covariance=None,
        prior=prior,
        frame_rate_hz=rate_hz,
        poses=poses,
        uv_px=uv,
        in_view=in_view,
        has_image=has_image,
        sigma_px=sigma_px,
        detections=tuple(detections),
        origin=tuple(origins),
        corner_frames=corner_frames,
        text=text,
    )


def one_picture(
    rng: np.random.Generator,
    camera: int,
    uv: Array,
    in_view: Ints,
    camera_of: Ints,
    sigma_px: Array,
    size: Array,
    false: FalsePoints,
) -> tuple[Detections, Ints]:
    """The points of one picture in random order, and their views."""
    mine = np.flatnonzero((camera_of == camera) & (in_view != OUTSIDE))
    shining = mine[in_view[mine] == SHINING]
    typical = float(np.median(sigma_px[camera_of == camera]))
    low, high = false.beside_px
    chosen = mine[rng.random(len(mine)) < false.beside]
    turn, radius = rng.uniform(0, 2 * np.pi, len(chosen)), np.sqrt(rng.uniform(low**2, high**2, len(chosen)))
    beside = uv[chosen] + radius[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    drawn = min(int(rng.poisson(false.anywhere)), MOST_ANYWHERE)
    anywhere = rng.uniform(-0.5, size - 0.5, (drawn if false.exactly is None else false.exactly, 2))
    static = false.reflections[camera]
    static = static[rng.random(len(static)) < false.reflection_seen]
    false_uv = np.concatenate([beside, anywhere, static])
    false_uv = false_uv[in_picture(false_uv, size)]
    true_uv = np.concatenate([uv[shining], false_uv])
    sigma = np.concatenate([sigma_px[shining], np.full(len(false_uv), typical)])
    origin = np.concatenate([shining, np.full(len(false_uv), CLUTTER)])
    points = true_uv + sigma[:, None] * rng.normal(size=true_uv.shape)
    order = rng.permutation(len(points))
    return Detections.at(points[order], sigma[order, None, None] ** 2 * np.eye(2)), origin[order]


def draw_amplitudes(rng: np.random.Generator, lab: Lab) -> Array:
    """(6,) m and rad: random amplitudes, each of which moves the spots by up to about the reach of the lab."""
    weight = rng.uniform(0.05, 1.0, 6) * (rng.random(6) > 0.15)
    if not weight.any():
        weight[3] = 1.0
    return np.minimum(lab.reach_m * weight * np.repeat([0.8, 1 / lab.lever_m], 3), np.deg2rad(40))


def fitted_motion(lab: Lab, motion: Motion, amplitudes: Array, fastest_px: float, least_in_view: float) -> Array | None:
    """x, y, z, yaw, pitch, roll (T, 6) with amplitudes reduced until enough spots are in view and not too fast.

    None where even a small motion does not show LEAST_SPOTS spots (or all) in the first frames.
    """
    camera_of, spot_of = view_indices(lab.rig)
    sizes = np.array([c.image_size_px for c in lab.rig.cameras.values()], dtype=float)[camera_of]
    size = 1.0
    for _ in range(40):
        q = lab.rest + size * amplitudes * motion.shape
        uv = spot_pixels(lab.rig, lab.poses(q))
        seen = in_picture(uv, sizes)
        early = min(len(np.unique(spot_of[row])) for row in seen[:CLEAN_FRAMES])
        moved = np.linalg.norm(np.diff(uv, axis=0), axis=-1)
        quick = np.nanmax(np.where(seen[1:], moved, 0.0))
        if early >= min(LEAST_SPOTS, len(lab.rig.spots)) and seen.mean() >= least_in_view and quick <= fastest_px:
            return q
        size *= 0.8
    return None


def draw_prior(rng: np.random.Generator, first: Pose) -> PosePrior:
    """A prior that contains the first pose."""
    within_m, within_rad = rng.uniform(0.3, 1.0), np.deg2rad(rng.uniform(10, 30))
    axis = rng.normal(size=3)
    turn = axis / np.linalg.norm(axis) * within_rad * rng.uniform(0, 0.95)
    centre = Pose(first.rotation @ rotations.exp(turn), first.translation + 0.95 * within_m * rng.uniform(-1, 1, 3))
    return PosePrior(centre, float(within_m), float(within_rad))
