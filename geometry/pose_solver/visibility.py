"""What a rig can see: which spots are in which pictures, over a range of poses, and how well they fix the pose."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from geometry import rotations
from geometry.arrays import Array, Bools, normalised
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.pose_prior import PosePrior
from geometry.pose_solver.gauss_newton import SolveLimits, covariance_of
from geometry.rig import Rig

POSES = 2000  # a share of 50 % is then known to 1 %
SEED = 0
NOISE_PX = 0.1  # the error of a spot for which the sigmas are given: a clean laser spot's
DEFAULT_RANGE = PosePrior(Pose.identity(), within_m=0.5, within_rad=float(np.deg2rad(30.0)))


@dataclass(frozen=True, slots=True)
class Visibility:
    """What n poses of a range show. All shares are 0 to 1."""

    views: tuple[tuple[str, str], ...]  # camera, spot
    in_picture: Array  # (views,) share of the poses with this spot in this picture
    outside: Array  # (views,) ... on its screen, but outside the picture
    off_screen: Array  # (views,) ... beside its screen, or where the lens model ends
    on_screen: Mapping[str, float]  # by spot: share of the poses in which its ray meets its screen
    blind: Mapping[str, float]  # by camera: share of the poses in which it sees no spot at all
    observable: float  # share of the poses that one frame's visible spots fix, by the solver's own limits
    spots_in_view: Array  # (n,) how many views are in the picture
    sigma_m: Array  # (n,) largest standard deviation of a position, m, with `NOISE_PX`; inf where not observable
    sigma_rad: Array  # (n,) ... of the attitude, rad


def poses_within(prior: PosePrior, count: int, seed: int = SEED) -> Pose:
    """A stack (count,) of poses spread evenly over a prior: over its cube, and over all turns up to its angle.

    Turns are even in the rotation group's own measure, whose density over the angle is 1 - cos(angle).
    """
    rng = np.random.default_rng(seed)
    axis = normalised(rng.normal(size=(count, 3)))
    grid = np.linspace(0, prior.within_rad, 2001)
    below = grid - np.sin(grid)
    angle = np.interp(rng.uniform(0, below[-1], count), below, grid)
    shift = rng.uniform(-prior.within_m, prior.within_m, (count, 3))
    return Pose(
        prior.centre.rotation @ rotations.exp(axis * angle[:, None]),
        prior.centre.translation + shift,
    )


def visibility_of(rig: Rig, prior: PosePrior, limits: SolveLimits, count: int = POSES) -> Visibility:
    """What the rig sees of poses drawn from a range; the same for the same arguments."""
    poses = poses_within(prior, count)
    model = SpotModel.of(rig)
    pixels, J = model.project(poses)
    seen = np.asarray(model.in_picture(pixels))
    projected = np.isfinite(pixels[..., 0])
    hits = np.isfinite(model.hits(poses)[0][..., 0])
    sigma_m, sigma_rad, good = _sigmas(np.where(seen[..., None, None], J, 0.0), limits)
    cameras, spots = np.array([c for c, _ in model.views]), np.array([s for _, s in model.views])
    return Visibility(
        views=model.views,
        in_picture=seen.mean(axis=0),
        outside=(projected & ~seen).mean(axis=0),
        off_screen=(~projected).mean(axis=0),
        on_screen={s: float(hits[:, spots == s].any(axis=1).mean()) for s in rig.spots if s in spots},
        blind={c: float(1 - seen[:, cameras == c].any(axis=1).mean()) for c in rig.cameras},
        observable=float(good.mean()),
        spots_in_view=seen.sum(axis=1),
        sigma_m=sigma_m,
        sigma_rad=sigma_rad,
    )


def _sigmas(J: Array, limits: SolveLimits) -> tuple[Array, Array, Bools]:
    """Worst sigma of position (n,), m, and attitude (n,), rad, of Jacobians (n, views, 2, 6); whether it is a pose."""
    flat = J.reshape(len(J), -1, 6) / NOISE_PX
    normal = np.swapaxes(flat, -1, -2) @ flat
    sigma_m, sigma_rad = np.full(len(J), np.inf), np.full(len(J), np.inf)
    for i, H in enumerate(normal):
        covariance, observable = covariance_of(H)
        if observable:
            sigma_m[i] = np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1])
            sigma_rad[i] = np.sqrt(np.linalg.eigvalsh(covariance[3:, 3:])[-1])
    return sigma_m, sigma_rad, (sigma_m <= limits.max_sigma_m) & (sigma_rad <= limits.max_sigma_rad)


def with_inverted_camera(rig: Rig, camera: str) -> Rig:
    """The rig as it would be if this camera's pose had been given the wrong way round."""
    turned = dataclasses.replace(rig.cameras[camera], camera_from_world=rig.cameras[camera].camera_from_world.inverse())
    return dataclasses.replace(rig, cameras={**rig.cameras, camera: turned})


def with_other_end(rig: Rig, spot: str) -> Rig:
    """The rig as it would be if this spot were at the other end of its beam."""
    return dataclasses.replace(
        rig, spots={**rig.spots, spot: dataclasses.replace(rig.spots[spot], sign=-rig.spots[spot].sign)}
    )
