"""The truth of one recording (motion, true spots, occlusions, clutter), and one picture of it.

A picture: background, spots, clutter, noise, saturation and rounding.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from geometry import rotations
from geometry.arrays import Array, Bools, Ints
from geometry.camera import SensorNoise
from geometry.forward_model import SpotModel
from geometry.light_centroid import map_curvature
from geometry.pose import Pose
from geometry.rig import Rig
from lab.errors import InputError
from lab.pictures.picture_file import GreyPicture
from lab.simulate.points import exposure_instants, spot_images, spot_patch
from lab.simulate.scenarios import RIGS, SCENARIOS, AnyMotion, Light, Scenario, scaled, with_noise

# Every random number comes from a generator seeded by (seed, purpose, frame, ...): frame 7 is the same in a recording
# of ten frames and of a thousand, and the clutter does not depend on the noise.
MOTION, CLUTTER_AND_MISSES, BENDS, POINT_NOISE, LIGHT, PIXELS = range(6)

CHECKED_S = 20.0  # period of the motion of every scenario
_CHECKED_EVERY_S = 0.05
_FIRST_CHECKED = 16  # every 16th of these instants is checked first
_MARGIN_PX = 12.0  # distance from the border of a spot in view, so that the whole spot is visible
_MAX_DRAWS = 3000
_ROW_STEPS = 10  # towards the row in which a moving spot is exposed

VISIBLE, OCCLUDED, OUTSIDE = 1, 2, 0  # in_view of truth/spots.csv


@dataclass(frozen=True, slots=True)
class ClutterPoints:
    """The clutter of a whole recording: m false points, by frame."""

    frame: Ints  # (m,)
    camera: Ints  # (m,) index into model.camera_names
    uv_px: Array  # (m, 2), inside the picture
    strength: Array  # (m,) flux relative to a true spot


@dataclass(frozen=True, slots=True)
class Scene:
    """One recording of T frames with n views (camera and spot, in the order of model.views)."""

    scenario: Scenario
    seed: int
    rig: Rig
    model: SpotModel
    motion: AnyMotion  # with drawn phases
    frame: Ints  # (T,) 0, 1, ...
    t_s: Array  # (T,) mid-exposure
    poses: Pose  # (T,) world_from_body
    uv_px: Array  # (T, n, 2) true projection at mid-exposure, also outside the picture; nan where there is none
    in_view: Ints  # (T, n) SHINING, HIDDEN or OUTSIDE
    has_image: Bools  # (T, cameras) a usable picture exists
    turned: Bools  # (T,) the motion bends between the frame before and this one
    clutter_points: ClutterPoints
    exposed_s: Array  # (T, n) mid-exposure of each spot: t_s, except with clocks of the cameras' own


def scenario_named(scenario: str | Scenario) -> Scenario:
    """The scenario of this name. Raises InputError: no scenario has this name."""
    if isinstance(scenario, Scenario):
        return scenario
    if scenario not in SCENARIOS:
        raise InputError(f"scenario: expected one of {', '.join(SCENARIOS)}, got {scenario!r}")
    return SCENARIOS[scenario]


def compose(
    scenario: str | Scenario,
    seed: int,
    frames: int | None = None,
    picture_scale: float = 1.0,
    rig: Rig | None = None,
) -> Scene:
    """One recording of a scenario.

    frames: default: those of the scenario. rig: default: that of the scenario. Raises InputError: an unknown scenario,
    no frames, or a motion that does not meet the conditions of the scenario.
    """
    scenario = scenario_named(scenario)
    count = scenario.frames if frames is None else frames
    if count < 1:
        raise InputError(f"frames: expected at least 1, got {count}")
    rig = RIGS[scenario.rig]() if rig is None else rig
    motion = draw_motion(scenario, SpotModel.of(rig), seed)
    if picture_scale != 1.0:
        rig = scaled(rig, picture_scale)
    light, deeper = scenario.light, 2.0 ** (scenario.light.bits - 8)  # more grey values for the same electrons
    rig = with_noise(rig, SensorNoise(light.gain_e_per_dn / deeper, light.read_noise_e, light.black_dn * deeper))
    model = SpotModel.of(rig)
    frame = np.arange(count)
    t_s = frame / scenario.frame_rate_hz
    poses = motion.pose(t_s)
    uv, exposed_s = _exposed(scenario, model, motion, t_s, model.project(poses)[0])
    bend_frames = np.floor(motion.bends_s(float(t_s[-1]) + 1.0) * scenario.frame_rate_hz + 1e-6).astype(np.int64)
    turned = np.isin(frame, bend_frames + 1)
    occluded, clutter_points = _occlusions_and_clutter(scenario, model, uv, bend_frames, seed)
    in_view = np.where(model.in_picture(uv), np.where(occluded, OCCLUDED, VISIBLE), OUTSIDE)
    return Scene(
        scenario, seed, rig, model, motion, frame, t_s, poses, uv, in_view,
        _usable_pictures(scenario, model, count), turned, clutter_points, exposed_s,
    )  # fmt: skip


def _exposed(scenario: Scenario, model: SpotModel, motion: AnyMotion, t_s: Array, uv_px: Array) -> tuple[Array, Array]:
    """Pixels (T, n, 2) of the spots when their pictures, or the rows of these, are exposed; and those times (T, n), s.

    uv_px (T, n, 2): at the times t_s (T,) of the frames.
    """
    exposed_s = np.repeat(t_s[:, None], len(model), axis=1)
    uv_px = uv_px.copy()
    for timing in scenario.clocks:
        late_s = timing.late_frames / scenario.frame_rate_hz
        for view in np.flatnonzero(model.camera_of == model.camera_names.index(timing.camera)).tolist():
            one, middle = model.subset(np.array([view])), (model.image_size_px[view, 1] - 1) / 2
            for _ in range(_ROW_STEPS):
                row = np.clip(np.nan_to_num(uv_px[:, view, 1], nan=middle), -0.5, 2 * middle + 0.5)
                exposed_s[:, view] = t_s + late_s + (row - middle) * timing.row_time_s
                uv_px[:, view] = one.project(motion.pose(exposed_s[:, view]))[0][:, 0]
    return uv_px, exposed_s


def has_motion(scenario: Scenario, model: SpotModel, draws: int) -> bool:
    """Whether one of so many draws of phases meets the conditions of the scenario."""
    rng = np.random.default_rng(MOTION)
    motions = (scenario.motion.drawn(rng, scenario.frame_rate_hz) for _ in range(draws))
    return any(_valid_start(scenario, model, m) and _valid_views(scenario, model, m) for m in motions)


def spots_in_view(model: SpotModel, pose: Pose) -> list[str]:
    """The spots that are in some picture at a pose."""
    seen = model.in_picture(model.project(pose)[0], -_MARGIN_PX)
    return [name for i, name in enumerate(model.spot_names) if seen[model.spot_of == i].any()]


def draw_motion(scenario: Scenario, model: SpotModel, seed: int) -> AnyMotion:
    """The first draw of phases that meets all conditions of the scenario.

    Raises InputError: no draw of many meets them.
    """
    rng = np.random.default_rng([seed, MOTION])
    for _ in range(_MAX_DRAWS):
        motion = scenario.motion.drawn(rng, scenario.frame_rate_hz)
        if _valid_start(scenario, model, motion) and _valid_views(scenario, model, motion):
            return motion
    raise InputError(f"scenario {scenario.name!r}: none of {_MAX_DRAWS} motions keeps the spots in view as it requires")


def _valid_start(scenario: Scenario, model: SpotModel, motion: AnyMotion) -> bool:
    """The first pose lies within the prior, with all spots in the picture if the scenario requires it."""
    prior, start = scenario.prior, motion.pose(np.zeros(()))
    guess = Pose.from_ypr(np.deg2rad(prior.yaw_pitch_roll_deg), np.array(prior.position_m))
    away = start.minus(guess)
    if np.any(np.abs(away[:3]) > prior.within_m) or rotations.angle(guess.rotation.T @ start.rotation) > np.deg2rad(
        prior.within_deg
    ):
        return False
    return not scenario.all_in_view_at_start or bool(model.in_picture(model.project(start)[0], -_MARGIN_PX).all())


def _valid_views(scenario: Scenario, model: SpotModel, motion: AnyMotion) -> bool:
    """The spots stay in view, or leave and return, as the scenario requires."""
    spot = np.array([name for _, name in model.views])
    own = np.arange(scenario.frames) / scenario.frame_rate_hz
    if scenario.leaves_and_returns:
        views = np.isin(spot, scenario.leaves_and_returns)
        seen = model.subset(views).in_picture(model.subset(views).project(motion.pose(own[::4]))[0])
        # All spots start in view: one that is out of view and later in view has left and returned.
        if not np.all((~seen).any(axis=0) & (seen & (np.cumsum(~seen, axis=0) > 0)).any(axis=0)):
            return False
    every = np.arange(0.0, CHECKED_S, _CHECKED_EVERY_S)
    stay = model.subset(np.isin(spot, scenario.always_in_view))
    for t in (every[::_FIRST_CHECKED], every):  # most draws fail at some of the first
        if scenario.spots_in_view:
            seen = model.in_picture(model.project(motion.pose(t))[0], -_MARGIN_PX)
            spots = np.stack([seen[:, model.spot_of == i].any(axis=1) for i in range(len(model.spot_names))])
            if spots.sum(axis=0).min() < scenario.spots_in_view:
                return False
        if len(stay) and not stay.in_picture(stay.project(motion.pose(t))[0], -_MARGIN_PX).all():
            return False
    return True


def _occlusions_and_clutter(
    scenario: Scenario, model: SpotModel, uv_px: Array, bend_frames: Ints, seed: int
) -> tuple[Bools, ClutterPoints]:
    """Occlusion of each view (T, n), and the clutter."""
    clutter, occlusion = scenario.clutter, scenario.occlusion
    count, n = uv_px.shape[:2]
    n_spots, n_cameras = len(model.spot_names), len(model.camera_names)
    in_picture = model.in_picture(uv_px)
    occluded_spots = _occluded_spots(scenario, n_spots, count, bend_frames, seed)
    found: list[tuple[int, int, float, float, float]] = []
    low, high = clutter.strength
    for k in range(count):
        rng = np.random.default_rng([seed, CLUTTER_AND_MISSES, k])
        missed, chance, share, turn, strength = rng.random((5, n))
        if k >= occlusion.clean_start:
            occluded_spots[k, model.spot_of] |= missed[model.spot_of] < occlusion.miss_probability
        radius = clutter.within_px * np.sqrt(share)
        around = uv_px[k] + radius[:, None] * np.stack([np.cos(2 * np.pi * turn), np.sin(2 * np.pi * turn)], -1)
        near = np.flatnonzero((chance < clutter.per_spot) & in_picture[k] & model.in_picture(around))
        found.extend((k, int(model.camera_of[i]), *around[i], low + (high - low) * strength[i]) for i in near)
        if clutter.per_image > 0:
            for camera in range(n_cameras):
                size = model.image_size_px[model.camera_of == camera][0]
                for u, v, s in rng.random((rng.poisson(clutter.per_image), 3)):
                    found.append((k, camera, u * size[0] - 0.5, v * size[1] - 0.5, low + (high - low) * s))
    table = np.array(found, dtype=float).reshape(-1, 5)
    clutter_points = ClutterPoints(
        table[:, 0].astype(np.int64), table[:, 1].astype(np.int64), table[:, 2:4], table[:, 4]
    )
    return occluded_spots[:, model.spot_of], clutter_points


def _occluded_spots(scenario: Scenario, n_spots: int, count: int, bend_frames: Ints, seed: int) -> Bools:
    """(T, spots): occluded at bends and in blackouts, without the misses of single spots."""
    occlusion = scenario.occlusion
    occluded = np.zeros((count, n_spots), dtype=bool)
    if occlusion.at_bends_frames:
        for i, bend in enumerate(bend_frames):
            spots = np.random.default_rng([seed, BENDS, i]).permutation(n_spots)[: occlusion.at_bends_spots]
            first = max(0, int(bend) + 1 - occlusion.at_bends_frames // 2)
            occluded[first : first + occlusion.at_bends_frames, spots] = True
    if occlusion.blackout_every:
        blackout = np.arange(count) % occlusion.blackout_every < occlusion.blackout_frames
        occluded[blackout & (np.arange(count) >= occlusion.blackout_every)] = True
    occluded[: occlusion.clean_start] = False
    return occluded


def _usable_pictures(scenario: Scenario, model: SpotModel, count: int) -> Bools:
    """(T, cameras): no fault affects the picture."""
    usable = np.ones((count, len(model.camera_names)), dtype=bool)
    for fault in scenario.faults:
        if fault.frame < count:
            which = slice(None) if fault.camera is None else model.camera_names.index(fault.camera)
            usable[fault.frame, which] = False
    return usable


def scenario_with(
    scenario: str | Scenario,
    *,
    clutter: float | None = None,
    frame_rate_hz: float | None = None,
    exposure_s: float | None = None,
) -> Scenario:
    """The scenario with another clutter probability per spot, rate or exposure.

    Raises InputError: an unknown scenario, a probability outside 0 to 1, or an exposure longer than a frame.
    """
    scenario = scenario_named(scenario)
    if frame_rate_hz is not None:
        scenario = replace(scenario, frame_rate_hz=frame_rate_hz)
    if exposure_s is not None:
        if not 0.0 < exposure_s <= 1 / scenario.frame_rate_hz:
            raise InputError(
                f"exposure: expected a time above 0, up to {1 / scenario.frame_rate_hz:g} s (one frame), got"
                f" {exposure_s:g} s"
            )
        scenario = replace(scenario, light=replace(scenario.light, exposure_s=exposure_s))
    if clutter is not None:
        if not 0.0 <= clutter <= 1.0:
            raise InputError(f"clutter: expected a probability per spot and frame, 0 to 1, got {clutter:g}")
        scenario = replace(scenario, clutter=replace(scenario.clutter, per_spot=clutter))
    return scenario


# One picture of a scene: background, spots, clutter, noise, saturation and rounding.


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
        if not scene.scenario.clocks:
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
