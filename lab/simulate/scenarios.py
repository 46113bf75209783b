"""Named scenarios: what moves, what is filmed and what goes wrong, as frozen values."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import MappingProxyType

from lab.simulate.motion import Motion, Wave


@dataclass(frozen=True, slots=True)
class Light:
    """What pictures look like. DN are those of an 8-bit picture; deeper pictures have 2^(bits - 8) times as many."""

    exposure_s: float = 0.0005  # centred on the frame's time; a moving spot leaves a streak
    bits: int = 8  # of the sensor: 8, or up to 16 in a 16-bit file; it clips at 2^bits - 1
    gain_e_per_dn: float = 38.0  # these three go into rig.yaml
    read_noise_e: float = 30.0
    black_dn: float = 8.0
    beam_radius_m: float = 0.011  # 1/e^2 radius of the beam (two sigmas), measured across it at the screen
    blur_px: float = 0.6  # sigma of the lens' own blur
    peak_dn: float = 150.0  # of a spot above the background, with the vehicle at the origin of world; its power is kept
    power_spread: float = 0.15  # relative 1-sigma spread of the lasers' powers
    background_dn: float = 6.0  # above black, at its mean
    gradient_dn: float = 6.0  # by how much the background differs between two opposite sides or corners
    texture: float = 0.005  # relative 1-sigma unevenness of the screen's paint: it modulates background and spots
    hot_pixels: int = 12  # per camera, at the same places all along
    reflections: int = 2  # diffuse, 15 to 40 px wide, per camera, at the same places all along
    reflection_dn: float = 12.0
    # Relative 1-sigma of a spot's speckle, new in every frame. It moves a centroid by contrast * sqrt(A / 8 pi), A =
    # 4 pi grain^2 its correlation area: 0.007 px here, as much as the photons of a bright spot do.
    speckle_contrast: float = 0.01
    speckle_grain_px: float = 1.0  # sigma of the speckle's correlation


@dataclass(frozen=True, slots=True)
class Clutter:
    """Points of light that are no spots, a new draw in every frame."""

    per_spot: float = 0.2  # probability, for each spot in the picture, of a false one near it (the paper's 20 %)
    within_px: float = 15.0  # of the spot; uniform over that disc
    per_image: float = 0.0  # mean number of false ones anywhere in a picture (Poisson)
    strength: tuple[float, float] = (0.3, 1.2)  # of its flux against a spot's, uniform


@dataclass(frozen=True, slots=True)
class Hiding:
    """What stands between a beam and its screen: a hidden spot is hidden from every camera."""

    miss_probability: float = 0.0  # of each spot in each frame, by itself
    at_bends_frames: int = 0  # for so many frames around each bend ...
    at_bends_spots: int = 1  # ... so many spots are hidden, drawn anew for each bend
    blackout_every: int = 0  # frames between the starts of blackouts; 0: none
    blackout_frames: int = 0  # so long all spots are hidden
    clean_start: int = 10  # nothing is hidden in the first frames


@dataclass(frozen=True, slots=True)
class RecordingFault:
    """One picture that did not arrive as it should."""

    frame: int
    kind: str  # "dropped": no file; "truncated": its second half is missing; "wrong size": half as wide and high
    camera: str | None = None  # None: in every camera

    def __post_init__(self) -> None:
        if self.kind not in ("dropped", "truncated", "wrong size"):
            raise ValueError(f"a fault is 'dropped', 'truncated' or 'wrong size', got {self.kind!r}")


@dataclass(frozen=True, slots=True)
class PriorRegion:
    """Where the vehicle is at the first frame, as run.yaml tells it. The drawn motion begins within it."""

    position_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    yaw_pitch_roll_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    within_m: float = 1.0
    within_deg: float = 30.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Scenario:
    """One kind of recording. A seed makes one recording of it."""

    name: str
    summary: str  # what to see in it: one sentence, also the notes of its run.yaml
    rig: str = "fan"  # a name of lab.simulate.rigs.RIGS
    motion: Motion
    frames: int = 600
    frame_rate_hz: float = 100.0  # the paper's 10 ms
    prior: PriorRegion = PriorRegion()
    # The phases of the motion are drawn until these hold:
    all_in_view_at_start: bool = True
    always_in_view: tuple[str, ...] = ()  # spots that never leave the picture, in any camera, however long the run is
    leaves_and_returns: tuple[str, ...] = ()  # spots that do so at least once within the scenario's own frames
    clutter: Clutter = Clutter()
    occlusion: Hiding = Hiding()
    faults: tuple[RecordingFault, ...] = ()
    light: Light = Light()


# Every frequency below is a multiple of 0.05 Hz, so that each motion repeats after 20 s and a property that holds for
# 20 s holds for ever. lab.simulate.scene checks just that long.
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
LIGHTS: MappingProxyType[str, Light] = MappingProxyType(
    {
        "lab": Light(),
        # Nothing but the noise.
        "clean": Light(
            texture=0.0, hot_pixels=0, reflections=0, speckle_contrast=0.0, gradient_dn=3.0, power_spread=0.1
        ),
        # A dark room, a filter for the lasers' colour, a quiet sensor: nearly all pixels show the black level, so that
        # the files are small.
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
        summary="As smooth, without clutter, speckle, texture, hot pixels, reflections: what the noise alone allows.",
        clutter=Clutter(per_spot=0.0),
        light=LIGHTS["clean"],
    ),
    _SHARP_TURNS,
    replace(
        _SHARP_TURNS,
        name="hidden-in-turn",
        summary="As sharp-turns, and around every bend one spot is hidden for ten frames.",
        occlusion=Hiding(at_bends_frames=10),
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
        summary="The vehicle stands still: what scatters is the measurement.",
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
        summary="As huo2015, with 18 and 23 deg between the beams: two beams in view already tell which two they are.",
        rig="unequal-fan",
    ),
    replace(
        _SMOOTH_SCENARIO,
        name="two-cameras-per-screen",
        summary="As smooth, each screen watched by two cameras: pair 3/6 often leaves one of them only.",
        rig="two-cameras-per-screen",
        always_in_view=(),
        leaves_and_returns=(),
    ),
    Scenario(
        name="long-out",
        summary="The vehicle looks to one side for seconds: pair 3/6 is out of the picture for hundreds of frames.",
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
        summary="As smooth, and every 150 frames all spots are hidden for ten.",
        occlusion=Hiding(blackout_every=150, blackout_frames=10),
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
