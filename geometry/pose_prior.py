"""The prior region of poses, before any measurement: a cube of positions and a maximal angle, or everywhere."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geometry.arrays import Array, Bools
from geometry.planes import intersect_surface
from geometry.pose import Pose
from geometry.rig import Rig

SLACK, SLACK_M, SLACK_RAD = 1.02, 0.005, float(np.deg2rad(0.25))  # the limits are widened by this: poses are noisy
CUBE_FACTOR = 2.0  # side of the vehicle's cube over that of the screens and cameras
BORDER_POINTS = 9  # along each side of a picture; their rays bound the part of the screen that the camera sees
# An oblique camera may see its screen up to the horizon. Beyond this multiple of the camera's distance from the screen
# a spot is too faint and too oblique to be detected.
MAX_DISTANCE_FACTOR = 6.0


@dataclass(frozen=True, slots=True)
class PosePrior:
    """The region of possible poses: each coordinate and the rotation angle, relative to the centre, are bounded."""

    centre: Pose
    within_m: float
    within_rad: float

    @staticmethod
    def everywhere(rig: Rig) -> PosePrior:
        """All poses in which the rig can see its spots: the prior of a run that states none.

        The vehicle lies in a cube CUBE_FACTOR times as wide as the box of the cameras and of everything that they see
        of their screens (a vehicle may be farther from its only screen than the camera is). Any attitude is possible.
        As with any prior, every candidate pose must also put each beam on its screen, within the picture of a camera.
        """
        seen = [_seen_of_screen(rig, name) for name in rig.cameras]
        places = np.concatenate(
            [*seen, *(c.camera_from_world.inverse().translation[None] for c in rig.cameras.values())]
        )
        low, high = places.min(axis=0), places.max(axis=0)
        return PosePrior(Pose(np.eye(3), 0.5 * (low + high)), float(0.5 * CUBE_FACTOR * (high - low).max()), np.pi)

    @property
    def half_width_m(self) -> float:
        """The largest distance from the centre, m, of each coordinate, including the allowance for noise."""
        return SLACK * self.within_m + SLACK_M

    @property
    def largest_turn_rad(self) -> float:
        """The largest rotation angle from the centre, rad, including the allowance for noise."""
        return min(SLACK * self.within_rad + SLACK_RAD, np.pi)

    @property
    def log_volume(self) -> float:
        """Log of the volume of the region, in m^3 rad^3, the units of pose covariances."""
        angle = self.largest_turn_rad
        return float(3 * np.log(2 * self.half_width_m) + np.log(8 * np.pi * (angle - np.sin(angle))))

    def contains(self, poses: Pose) -> Bools:
        """Which of a stack of poses (...) lie in the region, including the allowance for noise; False for nan."""
        near = np.all(np.abs(poses.translation - self.centre.translation) <= self.half_width_m, axis=-1)
        trace = np.einsum("ij,...ij->...", self.centre.rotation, poses.rotation)
        return np.asarray(near & ((trace - 1) / 2 >= np.cos(self.largest_turn_rad) - 1e-12))

    def reaches(self, point: Array, ray: Array, places: Array) -> Bools:
        """Which points (m, 3), in world, a ray of the vehicle (point and unit direction, in body) may light.

        Necessary, not sufficient: the angle between the ray at the centre pose and the direction to the point is at
        most the largest turn plus the parallax of a shift of the ray's origin within the region.
        """
        start = self.centre.apply(point)
        shift = np.sqrt(3) * self.half_width_m + 2 * np.linalg.norm(point) * np.sin(0.5 * self.largest_turn_rad)
        way = places - start
        length = np.linalg.norm(way, axis=-1)
        with np.errstate(invalid="ignore", divide="ignore"):
            cosine = np.clip(way @ self.centre.turn(ray) / length, -1, 1)
            parallax = np.where(length > shift, np.arcsin(np.minimum(shift / length, 1.0)), np.pi)
        return np.asarray(~(np.arccos(cosine) > self.largest_turn_rad + parallax))


def _seen_of_screen(rig: Rig, camera: str) -> Array:
    """Points (k, 3), m, in world: the border of a camera's picture, projected to its screen and clipped to its size."""
    seen_by = rig.cameras[camera]
    screen = rig.screens[seen_by.screen]
    width, height = seen_by.image_size_px
    u, v = np.meshgrid(np.linspace(-0.5, width - 0.5, BORDER_POINTS), np.linspace(-0.5, height - 0.5, BORDER_POINTS))
    origin, rays = seen_by.rays(np.stack([u.ravel(), v.ravel()], axis=-1))
    hits = intersect_surface(origin, rays, screen.world_from_screen, screen.bow)
    middle = screen.world_from_screen.translation
    distance = abs((origin - middle) @ screen.world_from_screen.rotation[:, 2])
    near = np.linalg.norm(hits - origin, axis=-1) <= MAX_DISTANCE_FACTOR * distance

    hits = hits[near]
    if not len(hits):
        hits = middle[None]
    if screen.size_m is not None:
        local = screen.world_from_screen.inverse().apply(hits)
        half = np.asarray(screen.size_m) / 2
        local[:, :2] = np.clip(local[:, :2], -half, half)
        hits = screen.world_from_screen.apply(local)
    return np.asarray(hits)
