"""Observations of control points that an adjustment excluded, with their probable cause."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.screens.network import Network, NetworkFit
from geometry.arrays import Array
from geometry.camera import Camera
from geometry.planes import intersect_plane
from geometry.rig import Screen

_SAME_POSITION = 0.15  # tolerance of another dot's position, as a share of the distance of neighbouring dots


@dataclass(frozen=True, slots=True)
class Outlier:
    """An outlier among the observations, with its probable cause."""

    observation: int
    camera: str
    dot: str
    error_px: float
    error_m: Array  # (2,), on the dot's screen along its x, y; nan if the dot is not on a screen
    at_place_of: str  # the dot at this position; empty: none
    swapped: bool  # whether that dot's pixel is at this dot's position


def classify_outliers(network: Network, fit: NetworkFit) -> tuple[Outlier, ...]:
    """The observations that the adjustment excluded, with their probable cause."""
    s, control_points = network.point_observations, network.control_points
    cameras, screens = list(fit.rig.cameras.values()), list(fit.rig.screens.values())
    out: list[Outlier] = []
    for i in np.flatnonzero(~fit.used):
        camera, dot = cameras[s.camera_of[i]], int(s.point_of[i])
        everywhere = camera.project(control_points.xyz)
        distances = np.linalg.norm(everywhere - s.pixels[i], axis=1)
        distances[~np.isfinite(distances)] = np.inf
        distances[dot] = np.inf
        nearest = int(np.argmin(distances))
        spacing = np.linalg.norm(everywhere - everywhere[nearest], axis=1)
        spacing[nearest] = np.inf
        limit = max(_SAME_POSITION * float(np.nanmin(spacing)), 5 * float(s.sigma_px[i]))
        at_place_of = control_points.names[nearest] if distances[nearest] < limit else ""
        back = np.flatnonzero((s.camera_of == s.camera_of[i]) & (s.point_of == nearest) & ~fit.used)
        swapped = bool(at_place_of) and any(
            np.linalg.norm(everywhere[dot] - s.pixels[b]) < limit for b in back.tolist()
        )
        error_m = np.full(2, np.nan)
        if control_points.screen_of[dot] >= 0:
            error_m = _on_screen(camera, screens[control_points.screen_of[dot]], s.pixels[i], control_points.xyz[dot])
        error_px = float(np.linalg.norm(fit.observation_residuals_px[i]))
        out.append(Outlier(int(i), camera.name, control_points.names[dot], error_px, error_m, at_place_of, swapped))
    return tuple(out)


def _on_screen(camera: Camera, screen: Screen, pixel: Array, dot: Array) -> Array:
    origin, ray = camera.rays(pixel)
    return intersect_plane(origin, ray, screen.world_from_screen) - screen.world_from_screen.inverse().apply(dot)[:2]
