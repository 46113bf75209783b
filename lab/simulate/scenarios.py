"""The named scenarios, and the motions of their vehicles."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Protocol, TypeAlias

import numpy as np

from geometry.arrays import Array
from geometry.camera import Camera, SensorNoise
from geometry.pose import Pose, look_at
from geometry.rig import Beam, Rig, Screen, Spot

IMAGE_SIZE_PX = (1280, 1024)  # the paper's, section 5.1
FOCAL_PX = 1180.0
# Mild barrel distortion without a fold: 1 - 3 * 0.12 r^2 + 5 * 0.05 r^4 has no real root, so that a spot far outside
# the picture still has pixel coordinates.
DISTORTION = (-0.12, 0.05, 3e-4, -2e-4, 0.0)
SCREEN_X_M = 2.5  # distance of either screen from the world's origin


def scaled(rig: Rig, scale: float) -> Rig:
    """The rig with pictures of another size: `scale` 0.5 halves width, height and focal length.

    Pixel centres are integers, so the principal point c becomes (c + 0.5) scale - 0.5. The noise is unchanged.
    """
    cameras = {}
    for name, c in rig.cameras.items():
        matrix = np.array(c.matrix, dtype=float)
        matrix[:2] *= scale
        matrix[:2, 2] += 0.5 * scale - 0.5
        width, height = (round(n * scale) for n in c.image_size_px)
        cameras[name] = replace(c, image_size_px=(width, height), matrix=matrix)
    return replace(rig, cameras=cameras)


def with_noise(rig: Rig, noise: SensorNoise) -> Rig:
    """The rig with this sensor noise in every camera."""
    return replace(rig, cameras={n: replace(c, noise=noise) for n, c in rig.cameras.items()})


def lab_camera(name: str, screen: str, position_m: Sequence[float], target_m: Sequence[float]) -> Camera:
    """A camera of the simulated lab at `position_m`, aimed at `target_m`, with the usual size and lens."""
    width, height = IMAGE_SIZE_PX
    matrix = np.array([[FOCAL_PX, 0, (width - 1) / 2], [0, FOCAL_PX, (height - 1) / 2], [0, 0, 1]])
    pose = look_at(np.asarray(position_m, dtype=float), np.asarray(target_m, dtype=float))
    return Camera(name, screen, IMAGE_SIZE_PX, matrix, DISTORTION, pose)


def _screens(size_m: tuple[float, float] | None) -> dict[str, Screen]:
    """Two screens perpendicular to the world x axis; screen x, y, z = world y, z, x."""
    turn = np.array([0.5, 0.5, 0.5, 0.5])
    return {
        name: Screen(name, Pose.from_quaternion(turn, np.array([x, 0.0, 0.0])), size_m)
        for name, x in (("left", -SCREEN_X_M), ("right", SCREEN_X_M))
    }


def _two_cameras() -> dict[str, Camera]:
    """One oblique camera per screen, 4.4 m away and above the vehicle.

    Each is aimed beside the centre of the screen, away from beam C (see `fan`), so that A and B stay in the picture
    while C leaves it.
    """
    return {
        "left": lab_camera("left", "left", (1.6, 0.6, 1.5), (-2.5, 0.35, 0.0)),
        "right": lab_camera("right", "right", (-1.6, -0.6, 1.5), (2.5, -0.35, 0.0)),
    }


def _both_ends(beams: dict[str, Beam]) -> dict[str, Spot]:
    """Spots 1, 2, ... on the left screen (ends "-"), the next ones on the right screen (ends "+")."""
    names = list(beams)
    left = [Spot(str(i + 1), b, -1, "left") for i, b in enumerate(names)]
    right = [Spot(str(i + 1 + len(names)), b, 1, "right") for i, b in enumerate(names)]
    return {s.name: s for s in (*left, *right)}


def fan(angles_deg: tuple[float, float, float] = (-20.0, 0.0, 20.0)) -> Rig:
    """Three beams A, B, C through the body origin, in its x-y plane at these angles from x towards y.

    The cooperation target of Huo et al. (2015), Fig. 1, with 20 deg between neighbours; unlimited screens.
    """
    beams = {
        name: Beam(name, np.array([np.cos(a), np.sin(a), 0.0]), np.zeros(3))
        for name, a in zip("ABC", np.deg2rad(angles_deg), strict=True)
    }
    return Rig(_screens(None), _two_cameras(), beams, _both_ends(beams))


def unequal_fan() -> Rig:
    """As `fan`, with 18 and 23 deg between neighbours: two visible beams can be identified."""
    return fan((-18.0, 0.0, 23.0))


def two_cameras_per_screen() -> Rig:
    """As `fan`, each screen observed by two cameras from different sides: twelve views of six spots."""
    cameras = {
        "left-a": lab_camera("left-a", "left", (1.6, 0.6, 1.5), (-2.5, 0.35, 0.0)),
        "left-b": lab_camera("left-b", "left", (1.2, -1.5, 1.3), (-2.5, 0.0, 0.0)),
        "right-a": lab_camera("right-a", "right", (-1.6, -0.6, 1.5), (2.5, -0.35, 0.0)),
        "right-b": lab_camera("right-b", "right", (-1.2, 1.5, 1.3), (2.5, 0.0, 0.0)),
    }
    return replace(fan(), cameras=cameras)


def four_skew_beams() -> Rig:
    """Four skew beams at unequal angles; D points to the right only.

    Screens of 6 m x 5 m: a beam can miss them.
    """
    beams = {
        "A": Beam("A", np.array([1.0, -0.32, 0.02]), np.array([0.05, -0.08, 0.03])),
        "B": Beam("B", np.array([1.0, 0.03, 0.12]), np.array([-0.04, 0.02, 0.10])),
        "C": Beam("C", np.array([1.0, 0.27, -0.03]), np.array([0.02, 0.09, -0.05])),
        "D": Beam("D", np.array([1.0, -0.10, -0.21]), np.array([0.10, -0.03, -0.10])),
    }
    ends = (
        ("1", "A", -1, "left"), ("2", "B", -1, "left"), ("3", "C", -1, "left"),
        ("4", "A", 1, "right"), ("5", "B", 1, "right"), ("6", "C", 1, "right"), ("7", "D", 1, "right"),
    )  # fmt: skip
    spots = {name: Spot(name, beam, sign, screen) for name, beam, sign, screen in ends}
    return Rig(_screens((6.0, 5.0)), _two_cameras(), beams, spots)


RIGS: MappingProxyType[str, Callable[[], Rig]] = MappingProxyType(
    {
        "fan": fan,
        "unequal-fan": unequal_fan,
        "two-cameras-per-screen": two_cameras_per_screen,
        "four-skew-beams": four_skew_beams,
    }
)


# Motions of the vehicle as functions of time, which give the exact pose at any instant of an exposure.

AXES = ("x", "y", "z", "yaw", "pitch", "roll")
SHAPES = ("sine", "triangle", "plateau", "steps")
_STEPNESS = 2.5  # of "plateau": tanh(2.5 sin) stays within 10 % of its end value for two thirds of each half cycle
_STEPS = 6  # of "steps": number of steps from end to end
_MOVING = 0.4  # of "steps": share of the time of each step in motion


@dataclass(frozen=True, slots=True)
class Wave:
    """One periodic part of the motion of one axis."""

    axis: str  # one of AXES
    amplitude: float  # m for x, y, z; deg for yaw, pitch, roll
    frequency_hz: float
    shape: str = "sine"  # one of SHAPES
    phase: float | None = None  # cycles at t = 0; None: drawn per seed

    def __post_init__(self) -> None:
        if self.axis not in AXES or self.shape not in SHAPES:
            raise ValueError(f"a wave has an axis of {AXES} and a shape of {SHAPES}, got {self.axis!r}, {self.shape!r}")

    def at(self, t_s: Array) -> Array:
        """The wave at times (...), in its axis' unit."""
        return self.amplitude * _unit_wave(self.shape, self.frequency_hz * np.asarray(t_s) + (self.phase or 0.0))


def _unit_wave(shape: str, cycles: Array) -> Array:
    """A wave between -1 and 1 with period 1. All start at 0 or -1 and rise."""
    if shape == "sine":
        return np.sin(2 * np.pi * cycles)
    if shape == "plateau":
        return np.tanh(_STEPNESS * np.sin(2 * np.pi * cycles)) / np.tanh(_STEPNESS)
    up_and_down = 1 - np.abs(2 * (cycles - np.floor(cycles)) - 1)  # 0 at whole cycles, 1 half way
    if shape == "triangle":
        return 2 * up_and_down - 1
    level = up_and_down * _STEPS
    whole = np.floor(level)
    # Each step: rest, then a move with a sinusoidal speed, so that the speed has no jumps.
    moved = np.clip((level - whole - (1 - _MOVING) / 2) / _MOVING, 0.0, 1.0)
    return 2 * (whole + 0.5 * (1 - np.cos(np.pi * moved))) / _STEPS - 1


_Sixfold: TypeAlias = tuple[float, float, float, float, float, float]


class AnyMotion(Protocol):
    """A motion of the vehicle as a function of time: waves (Motion), or through stated poses (own_motion.py)."""

    def drawn(self, rng: np.random.Generator, frame_rate_hz: float) -> AnyMotion:
        """The motion with what is random in it drawn."""

    def pose(self, t_s: Array) -> Pose:
        """world_from_body, stacked (...), at times (...), s."""

    def bends_s(self, end_s: float) -> Array:
        """The sorted times (n,) in (0, end_s] at which the velocity jumps."""


@dataclass(frozen=True, slots=True)
class Motion:
    """The sum of waves about a mean pose."""

    middle: _Sixfold  # x, y, z (m), yaw, pitch, roll (deg)
    waves: tuple[Wave, ...]
    about_pose: _Sixfold | None = None  # the same: the frame in which the motion is stated; None: the world

    def drawn(self, rng: np.random.Generator, frame_rate_hz: float) -> Motion:
        """This motion with the missing phases drawn.

        The corners of triangles coincide with frames, so that a constant-velocity prediction fails in exactly one frame
        after each corner.
        """
        waves = []
        for w in self.waves:
            phase = rng.random()
            frames_per_cycle = frame_rate_hz / w.frequency_hz
            if w.shape == "triangle":
                phase = np.round(phase * frames_per_cycle) / frames_per_cycle
            waves.append(w if w.phase is not None else replace(w, phase=float(phase)))
        return replace(self, waves=tuple(waves))

    def faster(self, factor: float) -> Motion:
        """The same path in less time."""
        return replace(self, waves=tuple(replace(w, frequency_hz=w.frequency_hz * factor) for w in self.waves))

    def about(self, pose: _Sixfold, size: float) -> Motion:
        """The same motion in the frame of another pose, with all its distances and angles multiplied by `size`."""
        x, y, z, yaw, pitch, roll = (size * v for v in self.middle)
        waves = tuple(replace(w, amplitude=size * w.amplitude) for w in self.waves)
        return Motion((x, y, z, yaw, pitch, roll), waves, pose)

    def at(self, t_s: Array) -> Array:
        """x, y, z (m), yaw, pitch, roll (rad), (..., 6), at times (...), s."""
        t_s = np.asarray(t_s, dtype=float)
        out = np.broadcast_to(np.array(self.middle, dtype=float), (*t_s.shape, 6)).copy()
        for w in self.waves:
            out[..., AXES.index(w.axis)] += w.at(t_s)
        out[..., 3:] = np.deg2rad(out[..., 3:])
        return out

    def pose(self, t_s: Array) -> Pose:
        """world_from_body, stacked (...), at times (...), s."""
        q = self.at(t_s)
        pose = Pose.from_ypr(q[..., 3:], q[..., :3])
        if self.about_pose is None:
            return pose
        place = np.array(self.about_pose)
        return Pose.from_ypr(np.deg2rad(place[3:]), place[:3]) @ pose

    def bends_s(self, end_s: float) -> Array:
        """The sorted times (n,) in (0, end_s] of the corners of triangles, where the velocity jumps."""
        times = [np.zeros(0)]
        for w in self.waves:
            if w.shape == "triangle":
                halves = np.arange(np.floor(2 * (w.frequency_hz * end_s + (w.phase or 0.0))) + 1)
                times.append((halves / 2 - (w.phase or 0.0)) / w.frequency_hz)
        bends: Array = np.unique(np.round(np.concatenate(times), 9))
        return np.asarray(bends[(bends > 0) & (bends <= end_s)], dtype=np.float64)


# Named scenarios as frozen values: motion, images, clutter, occlusions and faults.


@dataclass(frozen=True, slots=True)
class Light:
    """Light, lens and sensor. DN are those of an 8-bit picture; others have 2^(bits - 8) times as many."""

    exposure_s: float = 0.0005  # centred on the frame's time; a moving spot leaves a streak
    bits: int = 8  # of the sensor: 8, or up to 16 in a 16-bit file; it saturates at 2^bits - 1
    gain_e_per_dn: float = 38.0  # this and the next two are written to rig.yaml
    read_noise_e: float = 30.0
    black_dn: float = 8.0
    beam_radius_m: float = 0.011  # 1/e^2 radius of the beam (two sigmas), perpendicular to it at the screen
    blur_px: float = 0.6  # sigma of the blur of the lens
    peak_dn: float = 150.0  # of a spot above the background, with the vehicle at the world origin; defines its power
    power_spread: float = 0.15  # relative 1-sigma spread of the lasers' powers
    background_dn: float = 6.0  # above black, at its mean
    gradient_dn: float = 6.0  # difference of the background between two opposite sides or corners
    texture: float = 0.005  # relative 1-sigma variation of the reflectivity of the screen, in background and spots
    hot_pixels: int = 12  # per camera, at fixed places
    reflections: int = 2  # diffuse, 15 to 40 px wide, per camera, at fixed places
    reflection_dn: float = 12.0
    # Relative 1-sigma of the speckle of a spot, drawn for every frame. It moves a centroid by contrast * sqrt(A / 8 pi)
    # with the correlation area A = 4 pi grain^2: 0.007 px here, as much as the photon noise of a bright spot.
    speckle_contrast: float = 0.01
    speckle_grain_px: float = 1.0  # sigma of the correlation of the speckle


@dataclass(frozen=True, slots=True)
class Clutter:
    """False detections, drawn for every frame."""

    per_spot: float = 0.2  # probability of a false point near each spot in the picture (Huo 2015: 20 %)
    within_px: float = 15.0  # radius around the spot; uniform over the disc
    per_image: float = 0.0  # mean number of false points anywhere in a picture (Poisson)
    strength: tuple[float, float] = (0.3, 1.2)  # flux relative to a spot, uniform


@dataclass(frozen=True, slots=True)
class Occlusion:
    """Obstacles between a beam and its screen: an occluded spot is invisible to every camera."""

    miss_probability: float = 0.0  # of each spot in each frame, independently
    at_bends_frames: int = 0  # frames of occlusion of one spot, drawn for each bend, around the bend
    blackout_every: int = 0  # frames between the starts of blackouts; 0: none
    blackout_frames: int = 0  # duration, in which all spots are occluded
    clean_start: int = 10  # first frames without occlusions


@dataclass(frozen=True, slots=True)
class RecordingFault:
    """One missing or damaged picture."""

    frame: int
    kind: str  # "dropped": no file; "truncated": its second half is missing; "wrong size": half as wide and high
    camera: str | None = None  # None: in every camera

    def __post_init__(self) -> None:
        if self.kind not in ("dropped", "truncated", "wrong size"):
            raise ValueError(f"a fault is 'dropped', 'truncated' or 'wrong size', got {self.kind!r}")


@dataclass(frozen=True, slots=True)
class PictureTiming:
    """When a camera takes its pictures, if not at the instants of the frames."""

    camera: str
    late_frames: float = 0.0  # its mid-exposure minus the frame's instant
    row_time_s: float = 0.0  # rolling shutter: by which each row is exposed later than the one above


@dataclass(frozen=True, slots=True)
class PriorRegion:
    """The region of the first pose, as written to run.yaml. The drawn motion starts within it."""

    position_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    yaw_pitch_roll_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    within_m: float = 1.0
    within_deg: float = 30.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Scenario:
    """One kind of recording; a seed selects one recording."""

    name: str
    summary: str  # one sentence; also the notes of its run.yaml
    rig: str = "fan"  # a name of lab.simulate.scenarios.RIGS
    motion: AnyMotion
    frames: int = 600
    frame_rate_hz: float = 100.0  # the paper's 10 ms
    prior: PriorRegion = PriorRegion()
    # The phases of the motion are drawn until these conditions hold:
    all_in_view_at_start: bool = True
    always_in_view: tuple[str, ...] = ()  # spots that never leave the picture of any camera, for any length of run
    leaves_and_returns: tuple[str, ...] = ()  # spots that do so at least once within `frames`
    spots_in_view: int = 0  # spots, any of them, that are in some picture at any time
    clutter: Clutter = Clutter()
    occlusion: Occlusion = Occlusion()
    faults: tuple[RecordingFault, ...] = ()
    clocks: tuple[PictureTiming, ...] = ()
    light: Light = Light()


# Every frequency below is a multiple of 0.05 Hz, so that each motion repeats after 20 s and a condition that holds for
# 20 s always holds. lab.simulate.scene checks this period.
_SWAY = (Wave("x", 0.7, 0.15), Wave("y", 0.5, 0.2), Wave("z", 0.35, 0.25), Wave("x", 0.28, 0.35), Wave("roll", 24, 0.2))
_SMOOTH = Motion(
    (0.0, 0.0, 0.0, 7.0, 0.0, 0.0),
    (*_SWAY, Wave("yaw", 19, 0.45), Wave("yaw", 3, 0.6), Wave("pitch", 17, 0.5)),
)
_PAPER = Motion(
    (0.0, 0.0, 0.0, 7.0, 0.0, 0.0),
    (*_SWAY, Wave("yaw", 21, 0.25, "triangle"), Wave("pitch", 16, 0.25, "triangle")),
)
_SHARP = Motion(
    (0.0, 0.0, 0.0, 3.0, 0.0, 0.0),
    (
        Wave("x", 0.4, 0.15), Wave("y", 0.3, 0.2), Wave("z", 0.25, 0.25), Wave("roll", 10, 0.2),
        Wave("yaw", 20, 1.25, "triangle"), Wave("pitch", 10, 1.0, "triangle"),
    ),
)  # fmt: skip
_SMALL = Motion(
    (0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    (Wave("x", 0.06, 0.2), Wave("y", 0.08, 0.25), Wave("yaw", 7, 0.3), Wave("pitch", 5, 0.35), Wave("roll", 6, 0.2)),
)
LIGHTS: MappingProxyType[str, Light] = MappingProxyType(
    {
        "lab": Light(),
        # Noise only.
        "clean": Light(
            texture=0.0, hot_pixels=0, reflections=0, speckle_contrast=0.0, gradient_dn=3.0, power_spread=0.1
        ),
        # An unlit room, a filter for the lasers' wavelength, a sensor with low noise: nearly all pixels are at the
        # black level, so that the files are small.
        "quiet": Light(
            read_noise_e=6.0, black_dn=4.0, background_dn=0.0, gradient_dn=0.0, reflections=1,
            reflection_dn=6.0,
        ),
        # A 12-bit sensor in 16-bit files.
        "deep": Light(bits=12),
        # Bright room, coarse speckle, some spots saturated.
        "harsh": Light(
            peak_dn=260.0, power_spread=0.4, background_dn=25.0, gradient_dn=40.0, texture=0.04, hot_pixels=60,
            reflections=5, reflection_dn=40.0, speckle_contrast=0.2,
        ),
    }
)  # fmt: skip

_HUO2015 = Scenario(
    name="huo2015",
    summary="Section 5.1 of Huo et al. (2015): three beams, two bends of the trajectory per 4 s, pair 3/6 leaves the"
    " picture and returns, 20 % clutter.",
    motion=_PAPER,
    always_in_view=("1", "2", "4", "5"),
    leaves_and_returns=("3", "6"),
)
_SHARP_TURNS = Scenario(
    name="sharp-turns",
    summary="Yaw and pitch swing as triangles: every spot turns back within one frame, several times a second.",
    motion=_SHARP,
    always_in_view=("1", "2", "4", "5"),
)
_SMOOTH_SCENARIO = Scenario(
    name="smooth",
    summary="Slow sinusoids about all axes, up to 15 px per frame; pair 3/6 leaves the picture and returns.",
    motion=_SMOOTH,
    always_in_view=("1", "2", "4", "5"),
    leaves_and_returns=("3", "6"),
)

_ALL = (
    _HUO2015,
    _SMOOTH_SCENARIO,
    replace(
        _SMOOTH_SCENARIO,
        name="clean",
        summary="As smooth, without clutter, speckle, texture, hot pixels, reflections: errors by noise only.",
        clutter=Clutter(per_spot=0.0),
        light=LIGHTS["clean"],
    ),
    Scenario(
        name="small-motion",
        summary="Slow motion of a few centimetres and degrees; suits any rig, such as one of your own.",
        motion=_SMALL,
        light=LIGHTS["clean"],
    ),
    _SHARP_TURNS,
    replace(
        _SHARP_TURNS,
        name="hidden-in-turn",
        summary="As sharp-turns, with one spot occluded for ten frames around every bend.",
        occlusion=Occlusion(at_bends_frames=10),
    ),
    replace(
        _SMOOTH_SCENARIO,
        name="fast",
        summary="As smooth, four times as fast: up to about 70 px per frame, with streaks.",
        motion=_SMOOTH.faster(4.0),
    ),
    replace(
        _SMOOTH_SCENARIO,
        name="very-fast",
        summary="As smooth, eight times as fast: up to about 140 px per frame, with streaks.",
        motion=_SMOOTH.faster(8.0),
    ),
    Scenario(
        name="static",
        summary="The vehicle stands still: all scatter is measurement noise.",
        motion=Motion((0.2, -0.1, 0.1, 3.0, 5.0, -8.0), ()),
        always_in_view=("1", "2", "3", "4", "5", "6"),
    ),
    Scenario(
        name="turntable",
        summary="A turntable goes up and down in yaw in six steps and stops after each; nothing else moves.",
        motion=Motion((0.05, 0.0, 0.0, 6.0, 2.0, 1.0), (Wave("yaw", 18.0, 0.1, "steps", phase=0.0),)),
        always_in_view=("1", "2", "4", "5"),
        prior=PriorRegion(yaw_pitch_roll_deg=(-10.0, 0.0, 0.0), within_m=0.3, within_deg=10.0),
    ),
    replace(
        _SMOOTH_SCENARIO,
        name="four-skew-beams",
        summary="Four beams that neither meet nor lie in one plane; beam D lights the right screen only.",
        rig="four-skew-beams",
        always_in_view=("1", "2", "4", "5"),
    ),
    replace(
        _HUO2015,
        name="unequal-fan",
        summary="As huo2015, with 18 and 23 deg between the beams: two visible beams can be identified.",
        rig="unequal-fan",
    ),
    replace(
        _SMOOTH_SCENARIO,
        name="two-cameras-per-screen",
        summary="As smooth, each screen observed by two cameras: pair 3/6 often leaves only one of them.",
        rig="two-cameras-per-screen",
        always_in_view=(),
        leaves_and_returns=(),
    ),
    Scenario(
        name="long-out",
        summary="The vehicle is turned to one side for seconds: pair 3/6 is out of the picture for hundreds of frames.",
        motion=Motion(
            (0.0, 0.0, 0.0, 7.0, 0.0, 0.0),
            (
                Wave("x", 0.25, 0.15), Wave("y", 0.12, 0.2), Wave("z", 0.2, 0.25), Wave("roll", 8, 0.2),
                Wave("yaw", 19, 0.1, "plateau"), Wave("pitch", 8, 0.3),
            ),
        ),
        always_in_view=("1", "2", "4", "5"),
        leaves_and_returns=("3", "6"),
        frames=1000,
    ),
    replace(
        _SMOOTH_SCENARIO,
        name="blackout",
        summary="As smooth, with all spots occluded for ten frames every 150 frames.",
        occlusion=Occlusion(blackout_every=150, blackout_frames=10),
    ),
    replace(
        _SMOOTH_SCENARIO,
        name="clocks",
        summary="As smooth, with rolling shutters (8 us per row left, 5 us right) and a right camera 1.3 frames late.",
        clocks=(PictureTiming("left", 0.0, 8e-6), PictureTiming("right", 1.3, 5e-6)),
    ),
    replace(
        _SMOOTH_SCENARIO,
        name="damaged",
        summary="As smooth, with dropped frames (20 in both cameras, 31 to 33 in the left one), cut-off files (40"
        " right, 41 left) and a picture of the wrong size (55 left).",
        faults=(
            RecordingFault(20, "dropped"),
            *(RecordingFault(n, "dropped", "left") for n in (31, 32, 33)),
            RecordingFault(40, "truncated", "right"),
            RecordingFault(41, "truncated", "left"),
            RecordingFault(55, "wrong size", "left"),
        ),
    ),
)  # fmt: skip

SCENARIOS: MappingProxyType[str, Scenario] = MappingProxyType({s.name: s for s in _ALL})
