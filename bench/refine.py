"""Rigs refined from recordings, against the true rig: `python -m bench.refine --seeds 1:41`.

Each seed is a random lab (bench/random_scenes) and four recordings of points. The program is given a rig that is off by
a draw of its stated sigmas, refines it from three recordings, and measures the fourth with the result. Printed per rig:
RMS of the poses of the fourth recording over that with the true rig, NEES of the rig and of the poses, and the verdict.
The projection and the errors of the rig (about each camera's own centre) share no code with the program.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.linalg import block_diag

from bench.random_scenes.draw.motions import sines
from bench.random_scenes.draw.nuisances import draw_false_points, draw_hidden, draw_missing
from bench.random_scenes.draw.rigs import Lab, draw_lab
from bench.random_scenes.projection import in_picture, spot_pixels
from bench.random_scenes.scene import Scene, composed, draw_prior, fitted_motion, view_indices
from bench.random_scenes.write_folder import write_run_folder
from geometry import rotations
from geometry.arrays import Array, skew
from geometry.pose import Pose
from geometry.rig import Beam, Rig
from geometry.uncertainty.rig_uncertainty import RigCovariance

POSE_NAMES = ("x_m", "y_m", "z_m", "rot_x_rad", "rot_y_rad", "rot_z_rad")
LINE_NAMES = tuple(f"{kind}_{axis}{unit}" for kind, unit in (("direction", ""), ("point", "_m")) for axis in "xyz")
LAB, RIG, MOTION, NUISANCE, PRIOR = range(5)
NOISE_PX = (0.03, 0.3)
FASTEST_PX = 30.0


@dataclass(frozen=True, slots=True)
class Sigmas:
    """Of the rig that is given: of each part's position, m, and rotation or direction, rad, per axis."""

    cameras: tuple[float, float] = (5e-3, 3e-3)
    screens: tuple[float, float] = (2e-3, 1e-3)
    beams: tuple[float, float] = (1e-3, 1e-3)


def rig_covariance(rig: Rig, s: Sigmas) -> RigCovariance:
    """The covariance of rig.yaml's numbers: cameras turn about their centres, screens about their origins."""
    names: list[str] = []
    blocks: list[Array] = []
    for n, c in rig.cameras.items():
        R, t = c.camera_from_world.rotation, c.camera_from_world.translation
        # A turn phi (in the camera's frame) about the centre: R' = Exp(phi) R = R Exp(R^T phi), t' = t + phi x t.
        D = np.block([[np.eye(3), -skew(t)], [np.zeros((3, 3)), R.T]])
        names += [f"cameras.{n}.{p}" for p in POSE_NAMES]
        blocks.append(D @ np.diag(np.repeat(np.square(s.cameras), 3)) @ D.T)
    for n in rig.screens:
        names += [f"screens.{n}.{p}" for p in POSE_NAMES]
        blocks.append(np.diag(np.repeat(np.square(s.screens), 3)))
    for n, b in rig.beams.items():
        across = np.eye(3) - np.outer(b.direction, b.direction)
        names += [f"beams.{n}.{p}" for p in LINE_NAMES]
        blocks.append(block_diag(s.beams[1] ** 2 * across, s.beams[0] ** 2 * across))
    return RigCovariance(tuple(names), block_diag(*blocks))


def drawn_rig(rng: np.random.Generator, true: Rig, s: Sigmas, only: tuple[str, str] | None = None) -> Rig:
    """A rig that is off by a draw of the sigmas. only: the kind and name of the one part that is."""

    def off(kind: str, name: str, sigmas: tuple[float, float]) -> tuple[Array, Array]:
        shift, turn = rng.normal(size=3) * sigmas[0], rng.normal(size=3) * sigmas[1]
        return (shift, turn) if only is None or only == (kind, name) else (np.zeros(3), np.zeros(3))

    cameras, screens, beams = {}, {}, {}
    for n, c in true.cameras.items():
        shift, turn = off("cameras", n, s.cameras)
        R = rotations.exp(turn) @ c.camera_from_world.rotation
        cameras[n] = replace(c, camera_from_world=Pose(R, -R @ (_centre(c.camera_from_world) + shift)))
    for n, screen in true.screens.items():
        shift, turn = off("screens", n, s.screens)
        place = screen.world_from_screen
        screens[n] = replace(
            screen, world_from_screen=Pose(place.rotation @ rotations.exp(turn), place.translation + shift)
        )
    for n, b in true.beams.items():
        shift, turn = off("beams", n, s.beams)
        beams[n] = Beam(n, rotations.exp(turn) @ b.direction, b.point + shift)
    return Rig(screens, cameras, beams, true.spots)


def _centre(camera_from_world: Pose) -> Array:
    return -camera_from_world.rotation.T @ camera_from_world.translation


def campaign(seed: int, frames: int = 600, recordings: int = 4) -> tuple[Lab, list[Scene], str]:
    """A lab with recordings in which all six coordinates move."""
    attempt = 0
    while True:
        key = [seed, attempt]
        lab = draw_lab(np.random.default_rng([*key, LAB]))
        scenes = [_scene([*key, r], seed, lab, frames) for r in range(recordings)]
        if len(lab.rig.cameras) > 1 and all(s is not None for s in scenes):
            return lab, [s for s in scenes if s is not None], lab.text
        attempt += 1


def _scene(key: list[int], seed: int, lab: Lab, frames: int) -> Scene | None:
    rng = np.random.default_rng([*key, MOTION])
    rate = 100.0
    motion = sines(rng, np.arange(frames) / rate)
    amplitudes = np.minimum(lab.reach_m * rng.uniform(0.4, 1.0, 6) * np.repeat([0.8, 1 / lab.lever_m], 3), 0.5)
    q = fitted_motion(lab, motion, amplitudes, FASTEST_PX, 0.8)
    if q is None:
        return None
    poses = lab.poses(q)
    uv = spot_pixels(lab.rig, poses)
    camera_of, spot_of = view_indices(lab.rig)
    noise = float(np.exp(np.random.default_rng([seed, NUISANCE]).uniform(*np.log(NOISE_PX))))
    rng = np.random.default_rng([*key, NUISANCE])
    false = draw_false_points(rng, lab.rig, uv, camera_of)
    hidden, hidden_text = draw_hidden(rng, frames, camera_of, spot_of, motion.corners_s * rate)
    has_image, _ = draw_missing(rng, frames, len(lab.rig.cameras))
    text = f"{motion.text}; noise {noise:.2g} px; {false.text}; {hidden_text}"
    return composed(
        key, seed, lab.rig, poses, rate, np.full(len(camera_of), noise), false, hidden, has_image, motion.corners_s,
        text, draw_prior(np.random.default_rng([*key, PRIOR]), poses[0]),
    )  # fmt: skip
