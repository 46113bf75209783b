"""One picture of a scene: background, spots, clutter, noise, saturation and rounding."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from geometry.arrays import Array
from geometry.camera import SensorNoise
from geometry.light_centroid import map_curvature
from geometry.pose import Pose
from lab.pictures.picture_file import GreyPicture
from lab.simulate.points import exposure_instants, spot_images, spot_patch
from lab.simulate.scenarios import Light
from lab.simulate.scene import LIGHT, PIXELS, VISIBLE, Scene

Floats32 = NDArray[np.float32]

_GRAIN_SIGMAS_PX = (1.2, 9.0)  # of the reflectivity of the screen: fine and coarse, half of the variance each


@dataclass(frozen=True, slots=True)
class Sensor:
    """The constant properties of the pictures of one camera. Light in DN above black."""

    camera: int  # index into model.camera_names
    size_px: tuple[int, int]
    noise: SensorNoise
    full_dn: float  # grey value of saturation
    albedo: Floats32  # (h, w) reflectivity of the screen, mean 1
    background: Floats32  # (h, w) with reflections, without hot pixels
    sigma: Floats32  # (h, w) DN, noise of the background alone
    hot_rows: NDArray[np.int64]
    hot_columns: NDArray[np.int64]
    hot_dn: Floats32


def make_sensor(scene: Scene, camera: int) -> Sensor:
    """Reflectivity, gradient, reflections and hot pixels of one camera, drawn from the seed of the scene.

    Raises ValueError: the camera has no sensor noise.
    """
    light = scene.scenario.light
    name = scene.model.camera_names[camera]
    width, height = scene.rig.cameras[name].image_size_px
    noise = scene.rig.cameras[name].noise
    if noise is None:
        raise ValueError(f"camera {name!r}: expected the noise of its sensor, got none")
    deeper = 2.0 ** (light.bits - 8)
    rng = np.random.default_rng([scene.seed, LIGHT, camera])
    u = np.linspace(-0.5, 0.5, width, dtype=np.float32)
    v = np.linspace(-0.5, 0.5, height, dtype=np.float32)[:, None]

    albedo = np.ones((height, width), dtype=np.float32)
    for sigma_px in _GRAIN_SIGMAS_PX if light.texture > 0 else ():
        grain = cv2.GaussianBlur(rng.standard_normal((height, width), dtype=np.float32), (0, 0), sigma_px)
        albedo += np.float32(light.texture / np.sqrt(2) / max(float(grain.std()), 1e-12)) * grain
    turn = rng.uniform(0, 2 * np.pi)
    slope = light.gradient_dn * (np.cos(turn) * u + np.sin(turn) * v) / (abs(np.cos(turn)) + abs(np.sin(turn)))
    background = np.maximum(light.background_dn + slope, 0.0) * albedo
    for _ in range(light.reflections):
        cu, cv, size, share = rng.uniform([-0.45, -0.45, 15, 0.5], [0.45, 0.45, 40, 1.0])
        r2 = ((u - cu) * width) ** 2 + ((v - cv) * height) ** 2
        background = background + share * light.reflection_dn * np.exp(-r2 / (2 * size**2))
    background = (deeper * background).astype(np.float32)
    return Sensor(
        camera=camera,
        size_px=(width, height),
        noise=noise,
        full_dn=2.0**light.bits - 1,
        albedo=albedo.astype(np.float32),
        background=background,
        sigma=_noise_sigma(background, noise),
        hot_rows=rng.integers(0, height, light.hot_pixels),
        hot_columns=rng.integers(0, width, light.hot_pixels),
        hot_dn=(deeper * rng.uniform(20, 255, light.hot_pixels)).astype(np.float32),
    )


def _noise_sigma(light_dn: Floats32, noise: SensorNoise) -> Floats32:
    """Shot and read noise, 1 sigma in DN, of light in DN above black: variance (light * gain + read^2) / gain^2."""
    electrons = np.maximum(light_dn, 0) * np.float32(noise.gain_e_per_dn) + np.float32(noise.read_noise_e**2)
    return np.sqrt(electrons, dtype=np.float32) / np.float32(noise.gain_e_per_dn)


@dataclass(frozen=True, slots=True)
class LaserPowers:
    """The powers of the lasers, scaled so that a spot has `peak_dn` with the vehicle at the world origin."""

    flux_dn_per_light: Array  # (n,) DN summed over the spot, per unit of optics.Spots.light


def laser_powers(scene: Scene) -> LaserPowers:
    """The powers, drawn once per recording. The two ends of one beam are two lasers."""
    light, model = scene.scenario.light, scene.model
    at_origin = spot_images(model, Pose.identity(), light.beam_radius_m / 2, light.blur_px)
    area = 2 * np.pi * np.sqrt(np.linalg.det(at_origin.covariance_px2))
    # All spots share the exposure, so their mean peak is that of the scenario; nan: no spot from the origin.
    flux = np.nanmean(light.peak_dn * area / at_origin.light) * 2.0 ** (light.bits - 8)
    rng = np.random.default_rng([scene.seed, LIGHT, 1_000])
    spread = np.exp(light.power_spread * rng.standard_normal(len(model.spot_names)))
    return LaserPowers(flux * spread[model.spot_of])


def expected_light(
    scene: Scene, sensor: Sensor, powers: LaserPowers, k: int
) -> tuple[Floats32, list[tuple[slice, slice]]]:
    """The light of frame k in one camera, and the regions of the picture in which it exceeds the background.

    The light is in DN above black, before noise, hot pixels and rounding: (h, w).
    """
    light, model = scene.scenario.light, scene.model
    views = np.flatnonzero(model.camera_of == sensor.camera)
    spots = spot_images(model.subset(views), scene.poses[k], light.beam_radius_m / 2, light.blur_px)
    paths, weights = _paths(scene, views, k, spots.covariance_px2)
    rng = np.random.default_rng([scene.seed, LIGHT, sensor.camera, k + 1])
    picture = sensor.background.copy()
    pieces: list[tuple[slice, slice]] = []

    camera = scene.rig.cameras[model.camera_names[sensor.camera]]
    screen = scene.rig.screens[camera.screen]

    def add(path: Array, share: Array, covariance: Array, flux: float) -> None:
        curvature = map_curvature(camera, screen, np.mean(path, axis=0))
        patch = spot_patch(path, share, covariance, sensor.size_px, curvature, light.blur_px)
        if patch is None:
            return
        h, w = patch.values.shape
        piece = (slice(patch.row, patch.row + h), slice(patch.column, patch.column + w))
        values = flux * patch.values * sensor.albedo[piece]
        picture[piece] += (values * _speckle(rng, (h, w), light)).astype(np.float32)
        pieces.append(piece)

    met = np.isfinite(spots.light)  # beams that meet the screen; the picture of a camera may have none
    shape = np.median(spots.covariance_px2[met], axis=0) if met.any() else np.eye(2)
    typical_flux = float(np.median(powers.flux_dn_per_light[views][met] * spots.light[met])) if met.any() else np.nan
    for i, view in enumerate(views):
        occluded = scene.in_view[k, view] not in (VISIBLE, 0)
        if not occluded and np.isfinite(paths[:, i]).all():
            add(paths[:, i], weights, spots.covariance_px2[i], float(powers.flux_dn_per_light[view] * spots.light[i]))
    false = scene.clutter_points
    for row in range(*np.searchsorted(false.frame, [k, k + 1])):
        if false.camera[row] == sensor.camera and np.isfinite(typical_flux):
            add(false.uv_px[row][None], np.ones(1), shape, float(false.strength[row]) * typical_flux)
    return picture, pieces


def _paths(scene: Scene, views: NDArray[np.int64], k: int, covariance_px2: Array) -> tuple[Array, Array]:
    """Centres (m, n, 2) of these views at m instants of the exposure of frame k, and the weights (m,).

    With a rolling shutter the rows that one spot covers are taken to be exposed together.
    """
    half = scene.scenario.light.exposure_s / 2
    model = scene.model.subset(views)

    def at(since: Array) -> Array:
        if np.all(scene.exposed_s[k, views] == scene.t_s[k]):
            return model.project(scene.motion.pose(float(scene.t_s[k]) + since))[0]
        times = scene.exposed_s[k, views] + since[:, None]  # (m, n)
        every = model.project(scene.motion.pose(times))[0]  # (m, n, n, 2)
        return np.asarray(np.diagonal(every, axis1=1, axis2=2).transpose(0, 2, 1))

    ends = at(half * np.array([-1.0, 1.0]))
    length = np.linalg.norm(ends[1] - ends[0], axis=-1)
    seen = np.isfinite(covariance_px2).all(axis=(1, 2), keepdims=True)
    narrow = np.sqrt(np.linalg.eigvalsh(np.where(seen, covariance_px2, np.eye(2)))[:, 0])
    longest = int(np.nanargmax(np.nan_to_num(length / narrow)))
    instants, weights = exposure_instants(float(np.nan_to_num(length[longest])), float(narrow[longest]))
    return at(2 * half * instants), weights


def _speckle(rng: np.random.Generator, shape: tuple[int, int], light: Light) -> Array | float:
    """Log-normal speckle with mean 1, correlated over `speckle_grain_px`."""
    if light.speckle_contrast <= 0:
        return 1.0
    white = rng.standard_normal(shape, dtype=np.float32)
    grain = cv2.GaussianBlur(white, (0, 0), light.speckle_grain_px, borderType=cv2.BORDER_REFLECT)
    # A Gaussian blur of sigma s reduces the sigma of white noise by the factor 1 / (2 sqrt(pi) s).
    sigma = np.sqrt(np.log1p(light.speckle_contrast**2))
    factor = float(sigma * 2 * np.sqrt(np.pi) * light.speckle_grain_px)
    return np.exp(factor * grain.astype(np.float64) - sigma**2 / 2)


def render(scene: Scene, sensor: Sensor, powers: LaserPowers, k: int, *, noisy: bool = True) -> GreyPicture:
    """The picture of frame k: (h, w), uint8 up to 8 bits, otherwise uint16."""
    value, pieces = expected_light(scene, sensor, powers, k)
    if noisy:
        rng = np.random.Generator(np.random.SFC64([scene.seed, PIXELS, sensor.camera, k]))
        grain = rng.standard_normal(value.shape, dtype=np.float32)
        sigma = sensor.sigma
        if pieces:
            sigma = sigma.copy()
            for piece in pieces:
                sigma[piece] = _noise_sigma(value[piece], sensor.noise)
        grain *= sigma
        value += grain
    value[sensor.hot_rows, sensor.hot_columns] += sensor.hot_dn
    value += np.float32(sensor.noise.black_dn)
    np.rint(value, out=value)
    np.clip(value, 0, sensor.full_dn, out=value)
    return value.astype(np.uint8) if sensor.full_dn <= 255 else value.astype(np.uint16)
