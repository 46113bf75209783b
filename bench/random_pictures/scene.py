"""One random recording in pictures: rig and motion as in bench.random_scenes, light as in looks.py."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bench.random_pictures.looks import Look, draw_look
from bench.random_pictures.optics import BeamShape
from bench.random_pictures.sensors import Light
from bench.random_pictures.spots import BeamEnd, draw_developed_speckle, draw_speckle
from bench.random_scenes.drafts import paper_lab
from bench.random_scenes.draw.motions import MOTIONS, Motion, draw_motion
from bench.random_scenes.draw.nuisances import FalsePoints, draw_hidden, draw_missing
from bench.random_scenes.draw.rigs import Lab, draw_lab
from bench.random_scenes.projection import spot_pixels
from bench.random_scenes.scene import (
    LAB,
    MOTION,
    NUISANCE,
    PRIOR,
    Scene,
    composed,
    draw_amplitudes,
    draw_prior,
    fitted_motion,
    view_indices,
)
from geometry.arrays import Array, Bools, Ints
from geometry.pose import Pose

FRAMES = 48
SIZES_PX = ((640, 512), (800, 600), (1024, 768), (1280, 1024))
MOST_HIDDEN, LEAST_PICTURES = 0.2, 0.85
LOOK, LIGHT = 11, 12  # streams of random numbers besides those of bench.random_scenes.scene
MOST_PARTS = 65  # sub-exposures


@dataclass(frozen=True, slots=True)
class PictureScene:
    """A recording with its truth and the data for rendering its pictures."""

    seed: int
    family: str | None
    key: list[int]
    look: Look
    scene: Scene  # rig, truth, occlusions and missing pictures; its points are not used
    hidden: Bools  # (T, n)
    exposures: Pose  # (T * S,) world_from_body at the middles of the S parts of each exposure
    parts: int  # S, odd: the middle one is at mid-exposure
    ends: tuple[BeamEnd, ...]  # (n,)
    powers: Array  # (n,) of the beams, relative

    def __len__(self) -> int:
        return len(self.scene)

    @property
    def text(self) -> str:
        """A description in one line."""
        return f"{self.family or 'mixed'}: {self.look.text}; {self.scene.text}"

    def during(self, k: int) -> Pose:
        """(S,) the poses during the exposure of frame k."""
        return self.exposures[k * self.parts : (k + 1) * self.parts]


def picture_scene(
    seed: int,
    family: str | None = None,
    frames: int | None = None,
    sizes_px: Sequence[tuple[int, int]] = SIZES_PX,
) -> PictureScene:
    """The scene of a seed; it depends on the size of the pictures."""
    name = 0 if family is None else zlib.crc32(family.encode())
    for attempt in range(1000):
        made = _attempt([seed, name, attempt], seed, family, FRAMES if frames is None else frames, sizes_px)
        if made is not None:
            return made
    raise RuntimeError(f"no scene in pictures for seed {seed}, family {family}")


def _attempt(
    key: list[int], seed: int, family: str | None, frames: int, sizes_px: Sequence[tuple[int, int]]
) -> PictureScene | None:
    look = draw_look(np.random.default_rng([*key, LOOK]), family)
    lab = paper_lab() if look.plain_rig else draw_lab(np.random.default_rng([*key, LAB]), sizes_px)
    rng = np.random.default_rng([*key, MOTION])
    rate = float(np.exp(rng.uniform(np.log(25), np.log(300))))
    draw_seed = int(rng.integers(2**31))
    times = np.arange(frames) / rate
    motion = _motion(look, draw_seed, times)
    q = fitted_motion(lab, motion, draw_amplitudes(rng, lab), look.fastest_px, 0.9)
    if q is None:
        return None
    poses = lab.poses(q)
    uv = spot_pixels(lab.rig, poses)
    streak = float(np.nanmax(np.linalg.norm(np.diff(uv, axis=0), axis=-1), initial=0.0)) * look.exposure_share
    if streak < look.least_streak_px:
        return None
    parts = int(min(2 * np.ceil(streak / max(0.5 * look.sigma_px, 0.3)) + 1, MOST_PARTS))
    exposures = lab.poses(_during(lab, look, draw_seed, motion, q, times, parts))
    camera_of, spot_of = view_indices(lab.rig)
    hidden, has_image, words = _disturbances(key, look, frames, camera_of, spot_of, motion.corners_s * rate)
    text = f"{lab.text}; {rate:.0f} Hz, {motion.text}, streaks up to {streak:.1f} px{words}"
    nothing = FalsePoints(0.0, (15.0, 40.0), 0.0, tuple(np.zeros((0, 2)) for _ in lab.rig.cameras))
    prior = draw_prior(np.random.default_rng([*key, PRIOR]), poses[0])
    scene = composed(
        key, seed, lab.rig, poses, rate, np.full(len(camera_of), 0.05), nothing, hidden, has_image,
        motion.corners_s * rate, text, prior,
    )  # fmt: skip
    ends, powers = _beam_ends(np.random.default_rng([*key, LIGHT]), look, scene)
    if ends is None:
        return None
    return PictureScene(seed, family, key, look, scene, hidden, exposures, parts, ends, powers)


def _motion(look: Look, seed: int, times: Array) -> Motion:
    rng = np.random.default_rng(seed)
    return MOTIONS[look.motion](rng, times) if look.motion else draw_motion(rng, times)


def _during(lab: Lab, look: Look, seed: int, motion: Motion, q: Array, times: Array, parts: int) -> Array:
    """x, y, z, yaw, pitch, roll (T * S, 6) at the middles of the parts of each exposure.

    The random numbers of a motion depend only on its first two times and the last one, so that the same motion can be
    evaluated at other times between these.
    """
    frame_s = times[1] - times[0]
    inside = (times[:, None] + look.exposure_share * frame_s * ((np.arange(parts) + 0.5) / parts - 0.5)).reshape(-1)
    again = _motion(look, seed, np.concatenate([times[:2], inside, times[-1:]]))
    assert np.allclose(again.shape[[0, 1, -1]], motion.shape[[0, 1, -1]], atol=1e-12), "the same motion"
    largest = np.argmax(np.abs(motion.shape), axis=0)
    axis = np.arange(6)
    at_most = motion.shape[largest, axis]
    size = np.where(at_most == 0, 0.0, (q - lab.rest)[largest, axis] / np.where(at_most == 0, 1.0, at_most))
    return np.asarray(lab.rest + size * again.shape[2:-1])


def _disturbances(
    key: list[int], look: Look, frames: int, camera_of: Ints, spot_of: Ints, corner_frames: Array
) -> tuple[Bools, Bools, str]:
    """Occluded views (T, n), existing pictures (T, c), and a description; a video has all pictures."""
    rng = np.random.default_rng([*key, NUISANCE])
    cameras = int(camera_of.max()) + 1
    nothing = np.zeros((frames, len(camera_of)), dtype=bool), np.ones((frames, cameras), dtype=bool)
    if not look.hidden or frames < 15:
        return *nothing, ""
    hidden, words = draw_hidden(rng, frames, camera_of, spot_of, corner_frames)
    while hidden.mean() > MOST_HIDDEN:
        hidden, words = draw_hidden(rng, frames, camera_of, spot_of, corner_frames)
    has_image, missing = draw_missing(rng, frames, cameras)
    while has_image.mean() < LEAST_PICTURES:
        has_image, missing = draw_missing(rng, frames, cameras)
    if look.sensor.file_format == "mjpg":
        has_image, missing = nothing[1], ""
    return hidden, has_image, f"; {words}{'; ' * bool(missing)}{missing}"


def _beam_ends(rng: np.random.Generator, look: Look, scene: Scene) -> tuple[tuple[BeamEnd, ...] | None, Array]:
    """The light of the views; the median view has the given width. None if a view has no valid position."""
    rig = scene.rig
    fine = 2 if look.patterns == 0 else int(np.ceil(1 / look.speckle_grain_px)) + 1
    speckles: dict[str, Light | None] = {
        name: draw_developed_speckle(rng, look.patterns, look.speckle_grain_px, fine)
        if look.patterns
        else draw_speckle(rng, look.speckle, look.speckle_grain_px)
        for name in rig.cameras
    }
    unit = BeamShape(1e-3, 0.0)
    probes = []
    for c, s in rig.views():
        spot = rig.spots[s]
        probes.append(BeamEnd(rig.cameras[c], rig.screens[spot.screen], rig.beams[spot.beam], spot, unit, 0.0, None))
    widths, reaches = [], []
    for i, probe in enumerate(probes):
        shown = np.flatnonzero(scene.in_view[:, i])
        if not shown.size:
            continue
        pose = scene.poses[shown[:1]]
        covariance = probe.covariance_px2(pose) - np.eye(2) / 12
        widths.append(float(np.linalg.det(covariance)) ** 0.25 / unit.sigma_m)  # px per m of the beam
        reaches.append(float(probe.hits(pose)[1][0]))
    if not widths:
        return None, np.zeros(0)
    own_px = np.sqrt(max(look.sigma_px**2 - look.blur_px**2 - 1 / 12, (0.35 * look.sigma_px) ** 2))
    sigma_m = own_px / float(np.median(widths))
    share = look.divergence * 0.95
    beams = {
        name: BeamShape(
            sigma_m=sigma_m * np.sqrt(1 - share**2) * scale,
            divergence=sigma_m * share / float(np.median(reaches)) * scale,
            ratio=look.ratio, turn_rad=float(rng.uniform(0, np.pi)), flat=look.flat, halo=look.halo,
        )
        for name, scale in zip(rig.beams, np.exp(rng.uniform(-0.12, 0.12, len(rig.beams))), strict=True)
    }  # fmt: skip
    power = dict(zip(rig.beams, 1 - look.power_spread * rng.random(len(rig.beams)), strict=True))
    ends = tuple(
        BeamEnd(p.camera, p.screen, p.beam, p.spot, beams[p.spot.beam], look.blur_px, speckles[p.camera.name], fine)
        for p in probes
    )
    return ends, np.array([power[p.spot.beam] for p in probes])
