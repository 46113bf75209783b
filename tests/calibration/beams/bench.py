"""A simulated stand: spots of a rig at known positions, with noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calibration.beams.beams import StandModel
from calibration.terms.rig_blocks import SpotPixels, lines_in, stacks_of
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.rig import Beam, Rig, Spot

WORLD_FROM_STAND = Pose.from_ypr(np.deg2rad([3.0, -2.0, 1.0]), np.array([0.02, 0.03, -0.05]))
# 0.2 mm on the screen for the cameras of lab/simulate/scenarios.py, 4.4 m away with a focal length of 1180 px.
SIGMA_PX = 0.2e-3 * 1180 / 4.4
ARCSEC = np.deg2rad(1 / 3600)


def positions(
    rng: np.random.Generator,
    count: int = 40,
    turn_deg: float = 30.0,
    shift_m: tuple[float, float, float] = (0.2, 0.2, 0.2),
) -> Pose:
    """stand_from_body at `count` positions: uniform yaw, pitch, roll and shifts within these limits."""
    turns = rng.uniform(-1, 1, (count, 3)) * np.deg2rad(turn_deg)
    return Pose.from_ypr(turns, rng.uniform(-1, 1, (count, 3)) * np.asarray(shift_m))


def recorded(rng: np.random.Generator, rig: Rig, stand_from_body: Pose, sigma_px: float = SIGMA_PX) -> SpotPixels:
    """The spots inside the pictures, with noise."""
    model = SpotModel.of(rig)
    pixels, _ = model.project(WORLD_FROM_STAND @ stand_from_body)
    position, view = np.nonzero(model.in_picture(pixels))
    noise = rng.normal(0, sigma_px, (len(position), 2))
    covariance = np.broadcast_to(np.eye(2) * sigma_px**2, (len(position), 2, 2)).copy()
    return SpotPixels(position, view, pixels[position, view] + noise, covariance)


def exact(stand_from_body: Pose) -> StandModel:
    """A stand with exactly known pose and positions."""
    return StandModel(stand_from_body, np.zeros(6), WORLD_FROM_STAND, np.zeros((6, 6)))


def unknown_place(stand_from_body: Pose) -> StandModel:
    """A stand with known positions and an unknown pose."""
    return StandModel(stand_from_body, np.zeros(6), None, None)


def opposed(rig: Rig, rng: np.random.Generator, turn_rad: float = 2e-3, shift_m: float = 2e-3) -> Rig:
    """The rig with every beam of two ends replaced by two nearly collinear, opposed lasers."""
    beams, spots = {}, {}
    for name, b in rig.beams.items():
        for sign in (1, -1):
            of_end = [s for s in rig.spots.values() if s.beam == name and s.sign == sign]
            if of_end:
                laser = f"{name}{'+' if sign > 0 else '-'}"
                offset = rng.normal(size=(2, 3)) * [[turn_rad], [shift_m]]
                beams[laser] = Beam(laser, sign * b.direction + offset[0], b.point + offset[1])
                spots |= {s.name: Spot(s.name, laser, 1, s.screen) for s in of_end}
    return replace(rig, beams=beams, spots={n: spots[n] for n in rig.spots})


def drawn(rig: Rig, rng: np.random.Generator, turn_rad: float = 0.02, shift_m: float = 0.01) -> Rig:
    """The rig with nominal beams, which differ from the mounted ones."""
    beams = {
        n: Beam(n, b.direction + rng.normal(0, turn_rad, 3), b.point + rng.normal(0, shift_m, 3))
        for n, b in rig.beams.items()
    }
    return replace(rig, beams=beams)


def errors(rig: Rig, found: Rig) -> np.ndarray:
    """Errors (beams, 4) of the estimated beams: direction (rad) and point (m), in the basis of the estimates.

    The covariance is in the same basis. Bases of nearly equal directions may differ by a right angle.
    """
    return -lines_in(stacks_of(rig)).minus(lines_in(stacks_of(found)))
