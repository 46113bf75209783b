"""A laser spot's light, and simulated points without pictures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.camera import project_points
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.rig import Rig
from lab.simulate.scenarios import PriorRegion, Scenario
from lab.simulate.scene import POINT_NOISE, VISIBLE, Scene, compose, scenario_with
from tracking.detections import Detections

# Shape and brightness of a laser spot in a picture, and its light integrated over pixels and exposure.

_REACH = 5.0  # sigmas that are drawn: a spot of 150 DN ends below 0.001 DN
_FLAT = np.zeros((2, 3))
# Gauss-Legendre nodes within a pixel, per axis. With four, the integral over a pixel of a Gaussian with sigma 0.5 px
# has an error of 1e-6 of its peak; three suffice from 0.8 px on.
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(4)


@dataclass(frozen=True, slots=True)
class SpotImages:
    """The images of n spots at one instant."""

    uv_px: Array  # (n, 2) centre: the image of the axis of the beam
    covariance_px2: Array  # (n, 2, 2) of the Gaussian in the picture, before the integration over pixels
    light: Array  # (n,) relative light received by the camera: cosine at the screen over squared distance


def on_screen_covariance(direction: Array, axes: Array, sigma_m: float) -> Array:
    """The covariance (..., 2, 2), m^2, of the Gaussian spot of a beam on an oblique screen.

    direction (..., 3): unit vector d of the beam; axes (..., 3, 2): the x and y axes B of the screen, in the same
    frame. The light is proportional to exp(-r^2 / 2 sigma^2) with the distance r from the axis of the beam. For a point
    s of the screen, r^2 = s^T B^T (I - d d^T) B s = s^T (I - b b^T) s with b = B^T d, so the covariance is sigma^2
    times the inverse of I - b b^T, which is I + b b^T / (1 - b^T b) (Sherman-Morrison). The divergence of the beam is
    neglected.
    """
    b = np.einsum("...ij,...i->...j", axes, direction)
    slack = np.maximum(1.0 - np.sum(b * b, axis=-1), 1e-4)  # cos^2 of the incidence; limited for grazing beams
    return sigma_m**2 * (np.eye(2) + b[..., :, None] * b[..., None, :] / slack[..., None, None])


def spot_images(model: SpotModel, world_from_body: Pose, sigma_m: float, blur_px: float) -> SpotImages:
    """The spots of all views for one pose: ellipses on the screens, mapped to the picture by the local affine map.

    sigma_m: of the beam, half its 1/e^2 radius. blur_px: sigma of the blur of the lens. nan where there is no
    projection.
    """
    hit = model.hits(world_from_body)
    uv = model.project(world_from_body)[0]
    direction = (world_from_body.rotation @ model.ray[..., None])[..., 0]
    axes = model.screen_rotation[..., :2]
    in_camera = (model.camera_rotation @ hit[..., None])[..., 0] + model.camera_translation
    seen = np.isfinite(uv[:, 0])
    in_camera = np.where(seen[:, None], in_camera, [0.0, 0.0, 1.0])
    J = project_points(in_camera, model.pinhole, model.distortion, model.fold_r2, model.fisheye)[1]
    A = J @ (model.camera_rotation @ axes)  # (n, 2, 2) px per m of the screen
    covariance = A @ on_screen_covariance(direction, axes, sigma_m) @ np.swapaxes(A, -1, -2) + blur_px**2 * np.eye(2)
    # A diffuse (Lambertian) screen: the camera receives power times cosine over squared distance.
    distance = np.linalg.norm(in_camera, axis=-1)
    normal = (model.camera_rotation @ model.screen_rotation[..., 2:])[..., 0]
    cosine = np.abs(np.sum(normal * in_camera, axis=-1)) / distance
    light = np.where(seen, cosine / distance**2, np.nan)
    return SpotImages(uv, np.where(seen[:, None, None], covariance, np.nan), light)


@dataclass(frozen=True, slots=True)
class Patch:
    """A small piece of a picture: light per pixel."""

    row: int  # of its first pixel
    column: int
    values: Array  # (h, w)


def spot_patch(
    path_px: Array, weights: Array, covariance_px2: Array, size_px: tuple[int, int],
    curvature: Array = _FLAT, blur_px: float = 0.0,
) -> Patch | None:  # fmt: skip
    """A Gaussian spot of flux 1 that moves during the exposure, integrated over pixels; None outside the picture.

    path_px (m, 2): images of the beam's axis at m instants; weights (m,): their shares of the exposure. covariance_px2
    (2, 2): constant during the exposure. size_px: width, height. curvature (2, 3), 1/px: see
    geometry.light_centroid.map_curvature; it skews the spot except for the blur of the lens, whose sigma is blur_px.
    """
    cubic, linear = _skew(covariance_px2, curvature, blur_px)
    reach = _REACH * np.sqrt(np.diagonal(covariance_px2)) + 1.0
    first = np.maximum(np.floor(path_px.min(axis=0) - reach), 0).astype(int)
    last = np.minimum(np.ceil(path_px.max(axis=0) + reach), np.array(size_px) - 1).astype(int)
    if np.any(last < first):
        return None
    precision = np.linalg.inv(covariance_px2)
    norm = np.sqrt(np.linalg.det(precision)) / (2 * np.pi)
    u = (np.arange(first[0], last[0] + 1)[:, None] + _NODES / 2).ravel()
    v = (np.arange(first[1], last[1] + 1)[:, None] + _NODES / 2).ravel()
    light = np.zeros((len(v), len(u)))
    for centre, weight in zip(path_px, weights, strict=True):
        du, dv = u - centre[0], v[:, None] - centre[1]
        exponent = precision[0, 1] * dv * du
        exponent += 0.5 * precision[0, 0] * du**2
        exponent += 0.5 * precision[1, 1] * dv**2
        if curvature.any():
            exponent += du * (du * (cubic[0] * du + cubic[1] * dv) - linear[0])
            exponent += dv * (dv * (cubic[3] * dv + cubic[2] * du) - linear[1])
        light += weight * np.exp(-exponent)
    k = len(_NODES)
    blocks = light.reshape(len(v) // k, k, len(u) // k, k)
    values = norm * np.einsum("ijkl,j,l->ik", blocks, _WEIGHTS / 2, _WEIGHTS / 2)
    return Patch(int(first[1]), int(first[0]), values)


def _skew(covariance_px2: Array, curvature: Array, blur_px: float) -> tuple[Array, Array]:
    """The third order of a spot's exponent: coefficients of uuu, uuv, uvv, vvv (4,) and, to subtract, of u, v (2,).

    The light before the blur is exp(-|d + T(d, d)|^2 / 2), in the metric of its covariance B, with the curvature T. To
    first order in T it is (1 + linear and cubic derivatives) of exp(-|d|^2 / 2); the blur changes only the covariance
    of the latter, to C. Source: ours.
    """
    T = np.stack([curvature[:, :2], curvature[:, 1:]], axis=1)  # (2, 2, 2)
    B, P = covariance_px2 - blur_px**2 * np.eye(2), np.linalg.inv(covariance_px2)
    G = B @ P
    A = np.einsum("la,ljk,jb,kc->abc", P, T, G, G)
    linear = 2 * np.einsum("ljk,jl,kc->c", T, G - np.eye(2), G) + np.einsum("lc,ljk,jk->c", P, T, G @ B - B)
    mixed = A[0, 0, 1] + A[0, 1, 0] + A[1, 0, 0], A[0, 1, 1] + A[1, 0, 1] + A[1, 1, 0]
    return np.array([A[0, 0, 0], *mixed, A[1, 1, 1]]), linear


def exposure_instants(length_px: float, sigma_px: float) -> tuple[Array, Array]:
    """Instants (m,) in [-0.5, 0.5] of the exposure and their weights (m,) for a streak of this length.

    Gauss-Legendre quadrature with nodes about one sigma of the spot apart: its error is below 1e-6 of the peak. A
    stationary spot needs one instant.
    """
    if length_px < 1e-3 * sigma_px:
        return np.zeros(1), np.ones(1)
    nodes, weights = np.polynomial.legendre.leggauss(int(np.clip(3 + np.ceil(length_px / sigma_px), 4, 200)))
    return nodes / 2, weights / 2


# A recording as truth and noisy detections without pictures, for studies with many runs.


CLUTTER = -1  # origin of a false detection
_LEAST_SIGMA_PX = 1e-3  # stated sigma of noise-free detections, so that their weight is finite


@dataclass(frozen=True, slots=True)
class PointRun:
    """T frames, n views (camera and spot, in the order of model.views), c cameras."""

    seed: int
    rig: Rig
    model: SpotModel
    prior: PriorRegion
    noise_px: float  # 1 sigma per axis of each detection
    frame: Ints  # (T,) 0, 1, ...
    t_s: Array  # (T,)
    poses: Pose  # (T,) true world_from_body
    uv_px: Array  # (T, n, 2) true, also outside the picture; nan where there is none
    in_view: Ints  # (T, n) 1 visible in the picture, 2 occluded, 0 outside
    has_image: Bools  # (T, c); False: no detections
    turned: Bools  # (T,) the motion bends between the frame before and this one
    detections: tuple[tuple[Detections, ...], ...]  # [frame][camera], in random order
    origin: tuple[tuple[Ints, ...], ...]  # [frame][camera] (rows,): the view of each detection, or CLUTTER


def simulate_points(
    scenario: str | Scenario,
    seed: int,
    *,
    frames: int | None = None,
    noise_px: float = 0.1,
    clutter: float | None = None,
    picture_scale: float = 1.0,
    rig: Rig | None = None,
) -> PointRun:
    """One recording of a scenario as points.

    noise_px: 1 sigma per axis, also of clutter. clutter: probability of a false point near each spot in the picture
    (default: that of the scenario). The motion depends on scenario and seed only; the clutter of a lower probability is
    a subset of that of a higher one. picture_scale, rig: as in `compose`. Raises InputError: an unknown scenario, or an
    argument out of range.
    """
    return points_of(compose(scenario_with(scenario, clutter=clutter), seed, frames, picture_scale, rig), noise_px)


def points_of(scene: Scene, noise_px: float) -> PointRun:
    """A scene as points, with noise of `noise_px`, 1 sigma per axis."""
    model, false = scene.model, scene.clutter_points
    n, cameras = len(model), range(len(model.camera_names))
    first_false = np.searchsorted(false.frame, np.arange(len(scene.frame) + 1))
    covariance = max(noise_px, _LEAST_SIGMA_PX) ** 2 * np.eye(2)
    detections, origins = [], []
    for k in range(len(scene.frame)):
        some = slice(first_false[k], first_false[k + 1])
        rng = np.random.default_rng([scene.seed, POINT_NOISE, k])
        # Noise is drawn for all views, so that it does not depend on which spots are occluded.
        uv = np.concatenate([scene.uv_px[k], false.uv_px[some]])
        uv = uv + noise_px * rng.standard_normal(uv.shape)
        of = np.concatenate([np.arange(n), np.full(len(uv) - n, CLUTTER)])
        camera = np.concatenate([model.camera_of, false.camera[some]])
        there = np.concatenate([scene.in_view[k] == VISIBLE, np.ones(len(uv) - n, dtype=bool)])
        shuffled = rng.permutation(len(uv))
        rows = [shuffled[(there & (camera == c) & scene.has_image[k, c])[shuffled]] for c in cameras]
        detections.append(tuple(Detections.at(uv[r], np.tile(covariance, (len(r), 1, 1))) for r in rows))
        origins.append(tuple(of[r] for r in rows))
    return PointRun(
        seed=scene.seed,
        rig=scene.rig,
        model=model,
        prior=scene.scenario.prior,
        noise_px=noise_px,
        frame=scene.frame,
        t_s=scene.t_s,
        poses=scene.poses,
        uv_px=scene.uv_px,
        in_view=scene.in_view,
        has_image=scene.has_image,
        turned=scene.turned,
        detections=tuple(detections),
        origin=tuple(origins),
    )
