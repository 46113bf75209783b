"""The truth of one recording: motion, true spots, occlusions and clutter.

Both the points (lab.simulate.points) and the pictures (lab.simulate.write) are made from a scene, so that they agree
for the same seed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from geometry import rotations
from geometry.arrays import Array, Bools, Ints
from geometry.camera import SensorNoise
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.rig import Rig
from lab.errors import InputError
from lab.files.text.error_text import require_one_of
from lab.simulate.scenarios import RIGS, SCENARIOS, AnyMotion, PictureTiming, Scenario, scaled, with_noise

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
    require_one_of("scenario", scenario, SCENARIOS)
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
    uv, exposed_s = _exposed(scenario, rig, model, motion, t_s, model.project(poses)[0])
    bend_frames = np.floor(motion.bends_s(float(t_s[-1]) + 1.0) * scenario.frame_rate_hz + 1e-6).astype(np.int64)
    turned = np.isin(frame, bend_frames + 1)
    occluded, clutter_points = _occlusions_and_clutter(scenario, model, uv, bend_frames, seed)
    in_view = np.where(model.in_picture(uv), np.where(occluded, OCCLUDED, VISIBLE), OUTSIDE)
    return Scene(
        scenario, seed, rig, model, motion, frame, t_s, poses, uv, in_view,
        _usable_pictures(scenario, model, count), turned, clutter_points, exposed_s,
    )  # fmt: skip


def _exposed(
    scenario: Scenario, rig: Rig, model: SpotModel, motion: AnyMotion, t_s: Array, uv_px: Array
) -> tuple[Array, Array]:
    """Pixels (T, n, 2) of the spots when their pictures, or the rows of these, are exposed; and those times (T, n), s.

    uv_px (T, n, 2): at the times t_s (T,) of the frames.
    """
    exposed_s = np.repeat(t_s[:, None], len(model), axis=1)
    uv_px = uv_px.copy()
    clocks = {timing.camera: timing for timing in scenario.clocks}  # added to those of the rig
    for k, camera in enumerate(rig.cameras.values()):
        timing = clocks.get(camera.name, PictureTiming(camera.name))
        late_s = camera.time_offset_s + timing.late_frames / scenario.frame_rate_hz
        row_time_s = camera.row_time_s + timing.row_time_s
        if late_s == 0.0 == row_time_s:
            continue
        for view in np.flatnonzero(model.camera_of == k).tolist():
            one, middle = model.subset(np.array([view])), (model.image_size_px[view, 1] - 1) / 2
            for _ in range(_ROW_STEPS):
                row = np.clip(np.nan_to_num(uv_px[:, view, 1], nan=middle), -0.5, 2 * middle + 0.5)
                exposed_s[:, view] = t_s + late_s + (row - middle) * row_time_s
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
            spots = np.random.default_rng([seed, BENDS, i]).permutation(n_spots)[:1]
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
