"""Uncertainty of spots on the screens, in metres, from the covariance of a network."""

from __future__ import annotations

import numpy as np

from calibration.screens.screens import ScreensResult
from geometry.arrays import Array, skew
from geometry.uncertainty.rig_uncertainty import BOW, POSE


def spot_sigmas(result: ScreensResult, screen: int) -> Array:
    """Sigma, m, of the screen's surface along its normal at its points (m,)."""
    name = list(result.network.rig.screens)[screen]
    C, names = result.fit.covariance.matrix, result.fit.covariance.names
    xyz = result.screens[screen].xyz
    if not len(xyz):
        size = result.network.rig.screens[name].size_m or (1.0, 1.0)
        xyz = np.array([[sx * size[0] / 2, sy * size[1] / 2, 0.0] for sx in (-1, 0, 1) for sy in (-1, 0, 1)])
    R = result.fit.rig.screens[name].world_from_screen.rotation
    x, y = xyz[:, 0], xyz[:, 1]
    J = np.zeros((len(xyz), len(names)))
    for k, p in enumerate(("x_m", "y_m", "z_m")):
        J[:, names.index(f"screens.{name}.{p}")] = R[k, 2]
    J[:, names.index(f"screens.{name}.rot_x_rad")] = y
    J[:, names.index(f"screens.{name}.rot_y_rad")] = -x
    for p, shape in zip(BOW, (x * x, x * y, y * y), strict=True):
        if f"screens.{name}.{p}" in names:
            J[:, names.index(f"screens.{name}.{p}")] = shape
    return np.sqrt(np.maximum(np.einsum("ni,ij,nj->n", J, C, J), 0.0))


def camera_sigmas(result: ScreensResult) -> dict[str, tuple[float, float]]:
    """Sigmas of each camera's position (m) and attitude (rad), each the root of the sum over three axes."""
    names, C = result.fit.covariance.names, np.diagonal(result.fit.covariance.matrix)
    out = {}
    for camera in result.network.rig.cameras:
        at = [names.index(f"cameras.{camera}.{p}") for p in POSE]
        out[camera] = (float(np.sqrt(C[at[:3]].sum())), float(np.sqrt(C[at[3:]].sum())))
    return out


def pointing_sigmas_m(result: ScreensResult) -> dict[str, float]:
    """Displacement, m (1 sigma, RMS of both directions), of the centre of each camera's screen by the pose's error."""
    out = {}
    names, C = result.fit.covariance.names, result.fit.covariance.matrix
    for name, camera in result.fit.rig.cameras.items():
        screen = result.fit.rig.screens[camera.screen]
        X = screen.world_from_screen.translation
        x_c = camera.camera_from_world.apply(X)
        at = [names.index(f"cameras.{name}.{p}") for p in POSE]
        R = camera.camera_from_world.rotation
        J = np.concatenate([np.eye(3), -R @ skew(X)], axis=1)
        across = np.eye(3) - np.outer(x_c, x_c) / (x_c @ x_c)
        moved = across @ J @ C[np.ix_(at, at)] @ J.T @ across.T
        out[name] = float(np.sqrt(max(np.trace(moved) / 2, 0.0)))
    return out
