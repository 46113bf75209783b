"""Correct recordings of six rigs as run folders: two symmetric ones, two with calibrated cameras, two at random."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from bench.random_scenes.scene import random_scene
from bench.random_scenes.write_folder import write_run_folder
from geometry.rig import Rig
from lab.files.rig.rig_file import save_rig
from lab.simulate.scenarios import fan, four_skew_beams, unequal_fan
from lab.simulate.write import simulate

FRAMES, RANDOM_FRAMES = 60, 40
RANDOM_SEEDS = (116, 113)


def calibrated(rig: Rig, seed: int) -> Rig:
    """The rig with cameras that differ as calibrated ones do: focal length, principal point, lens and place."""
    rng = np.random.default_rng(seed)
    cameras = {}
    for name, c in rig.cameras.items():
        matrix = np.array(c.matrix)
        matrix[:2] += np.array([[1, 0, 1], [0, 1, 1]]) * rng.normal(0, 8.0, (2, 3))
        matrix[1, 1] = matrix[0, 0] + rng.normal(0, 1.0)
        distortion = tuple(np.array(c.distortion) * (1 + 0.1 * rng.normal(size=len(c.distortion))))
        pose = c.camera_from_world.plus(rng.normal(size=6) * [0.05, 0.05, 0.05, 0.02, 0.02, 0.02])
        cameras[name] = dataclasses.replace(c, matrix=matrix, distortion=distortion, camera_from_world=pose)
    return dataclasses.replace(rig, cameras=cameras)


def recordings(folder: Path, seed: int) -> dict[str, Path]:
    """Write the six recordings; run folders by the name of their rig."""
    rigs = {
        "symmetric fan": ("huo2015", fan()),
        "symmetric unequal fan": ("smooth", unequal_fan()),
        "unequal fan": ("huo2015", calibrated(unequal_fan(), seed)),
        "four skew beams": ("four-skew-beams", calibrated(four_skew_beams(), seed + 1)),
    }
    out = {}
    for k, (name, (scenario, rig)) in enumerate(rigs.items()):
        path = folder / f"rig-{k}.yaml"
        save_rig(rig, path)
        out[name] = simulate(scenario, folder / f"run-{k}", seed=seed, frames=FRAMES, points=True, rig=path)
    for k, first in enumerate(RANDOM_SEEDS):
        out[f"random {k + 1}"] = write_run_folder(
            random_scene(first + 1000 * (seed - 1), RANDOM_FRAMES), folder / f"random-{k}"
        )
    return out
