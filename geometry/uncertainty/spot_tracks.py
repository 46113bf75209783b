"""Where the spots of a frame can lie in a picture: along a pose's uncertainty, and along a beam. Source: ours."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from geometry.arrays import Array
from geometry.camera import Camera
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.rig import Rig

_OUTLIER2 = 4.5**2  # squared distance, in sigmas, beyond which a difference does not count as scatter
_MAD = 1.4826  # sigma of a normal distribution over its median absolute deviation
_FEWEST = 10  # differences from which a scatter is computed
_NEAREST, _FARTHEST = 0.5, 1.5  # ends of a beam's image, over the lengths to the nearest and to the farthest screen


def unlimited(model: SpotModel) -> SpotModel:
    """The model with screens that have no edge: a beam that misses its screen has a place beside it."""
    return replace(model, half_size=np.full_like(model.half_size, np.inf))


def pixel_covariance(model: SpotModel, world_from_body: Pose, covariance: Array) -> Array:
    """Covariance (n, 2, 2), px^2, of the places of n views, to first order; nan where there is no projection.

    covariance (6, 6): of the pose error, section 1 of the file contract.
    """
    J = model.project(world_from_body)[1]
    return J @ covariance @ np.swapaxes(J, -1, -2)


def uncertainty_tracks(
    model: SpotModel, world_from_body: Pose, covariance: Array, sigmas: float = 3.0, steps: int = 61
) -> Array:
    """The curves (n, steps, 2), px, on which the spots of n views lie if the pose is wrong by up to so many sigmas.

    With the pixel's Jacobian J and the unit vector a of the largest variance of J P J^T, the curve is the projection
    (with all its bends) of the poses moved by s P J^T a / sqrt(a^T J P J^T a), s from -sigmas to sigmas: the expected
    pose for a spot that lies s sigmas along a. nan where a pose has no projection.
    """
    J = model.project(world_from_body)[1]
    spread = J @ covariance @ np.swapaxes(J, -1, -2)
    out = np.full((len(model), steps, 2), np.nan)
    for i in np.flatnonzero(np.isfinite(spread).all(axis=(1, 2))):
        values, vectors = np.linalg.eigh(spread[i])
        if not values[-1] > 0:
            continue
        direction = covariance @ J[i].T @ vectors[:, -1] / np.sqrt(values[-1])
        moved = world_from_body_moved(world_from_body, np.linspace(-sigmas, sigmas, steps)[:, None] * direction)
        out[i] = model.subset(np.array([i])).project(moved)[0][:, 0]
    return out


def world_from_body_moved(world_from_body: Pose, deltas: Array) -> Pose:
    """A stack of poses (k,): one pose changed by each of the pose errors (k, 6)."""
    k = len(deltas)
    stack = Pose(np.tile(world_from_body.rotation, (k, 1, 1)), np.tile(world_from_body.translation, (k, 1)))
    return stack.plus(deltas)


def beam_image(rig: Rig, camera: Camera, spot: str, world_from_body: Pose, steps: int = 81) -> Array:
    """The image (steps, 2), px, of the ray of a spot: where the spot would lie if its screen stood nearer or farther.

    The ray is taken from half its length to the nearest of the rig's screens to 1.5 times that to the farthest, with
    even steps of the inverse length, which the picture shows about evenly. nan where there is no projection.
    """
    of = rig.spots[spot]
    beam = rig.beams[of.beam]
    start, along = world_from_body.apply(beam.point), world_from_body.turn(of.sign * beam.direction)
    lengths = []
    for screen in rig.screens.values():
        normal, origin = screen.world_from_screen.rotation[:, 2], screen.world_from_screen.translation
        facing = float(normal @ along)
        length = float(normal @ (origin - start)) / facing if abs(facing) > 1e-9 else -1.0
        if 0 < length < 10 * float(np.linalg.norm(origin - start)):  # a ray along a screen meets it nowhere near
            lengths.append(length)
    if not lengths:
        lengths = [float(np.linalg.norm(s.world_from_screen.translation - start)) for s in rig.screens.values()]
    near, far = max(_NEAREST * min(lengths), 1e-6), max(_FARTHEST * max(lengths), 1e-6)
    samples = 1.0 / np.linspace(1 / near, 1 / far, steps)
    return camera.project(start + samples[:, None] * along)


def scatter(differences: Array) -> Array:
    """Covariance (2, 2), px^2, about zero of differences (n, 2), px, without outliers; nan for fewer than ten.

    Outliers lie farther from zero than 4.5 sigmas of the median absolute deviation of their axis.
    """
    known = differences[np.isfinite(differences).all(axis=1)]
    if len(known) < _FEWEST:
        return np.full((2, 2), np.nan)
    sigma = np.maximum(_MAD * np.median(np.abs(known), axis=0), 1e-9)
    near = known[((known / sigma) ** 2 < _OUTLIER2).all(axis=1)]
    if len(near) < _FEWEST:
        return np.full((2, 2), np.nan)
    return near.T @ near / len(near)
