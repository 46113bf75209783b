"""Access to the noise estimate of the program and to the model that it reports."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields
from typing import Any

import numpy as np

from bench.random_pictures.sensors import Picture
from geometry.camera import SensorNoise
from lab.runs.frames.sensor_noise import noise_estimation_frames
from tracking.noise import NoiseModel
from tracking.noise_estimation.photon_transfer import estimate_noise


def model_of_pictures(frames: int, picture: Callable[[int], Picture]) -> NoiseModel:
    """The initial noise model of a run without a stated noise, from a recording with this number of pictures."""
    return estimate_noise([picture(k) for k in noise_estimation_frames(frames)]).model


def reported_model(block: Mapping[str, Any]) -> NoiseModel:
    """The model in summary.json's `parameters.noise.CAMERA`: estimated, or as rig.yaml stated it."""
    if "gain_e_per_dn" in block:
        return NoiseModel.of(SensorNoise(**block))
    return NoiseModel(**{f.name: block[f.name] for f in fields(NoiseModel) if f.name in block})


def variance_at(model: NoiseModel, level_dn: float) -> float:
    """The variance of a model at a level, DN^2 of the values in the file."""
    return float(np.asarray(model.variance(level_dn)))
