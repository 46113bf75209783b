"""What a drogue, its light and its surroundings are: the input of `render_drogue`, and the picture with its truth.

Frames: the drogue frame has its origin at the centre of the rim circle, x and y in the plane of the rim and z from the
rim towards the hose, so that an identity rotation faces the camera (x right, y down). Source of the layout: Zhou
(2020), figures 3 and 4; the dimensions are ours, since the paper prints none.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from geometry.arrays import Array, Bools
from geometry.camera import Camera
from geometry.pose import Pose

ColourPicture = NDArray[np.uint8]  # (h, w, 3), blue, green, red
Floats32 = NDArray[np.float32]

SKY, CLOUDS, GROUND, PICTURE = "sky", "clouds", "ground", "picture"
BACKGROUNDS = (SKY, CLOUDS, GROUND, PICTURE)
BAR, DISC = "bar", "disc"
RED = (40.0, 40.0, 205.0)
# Uneven angles: a turn of the drogue does not carry one marker set onto another.
_MARKER_ANGLES_DEG = (0.0, 45.0, 100.0, 150.0, 205.0, 255.0, 310.0)
_MARKER_RING = 0.92  # of the radius of the rim


def standard_markers(radius_m: float) -> Array:
    """Centres (7, 3), m, in the drogue frame, of seven markers in the middle of the canopy ring."""
    angles = np.radians(_MARKER_ANGLES_DEG)
    ring = _MARKER_RING * radius_m
    return np.stack([ring * np.cos(angles), ring * np.sin(angles), np.zeros(7)], axis=1)


@dataclass(frozen=True, slots=True)
class DrogueLook:
    """Shape and colours; lengths in radii of the rim, colours as blue, green, red in DN under full light."""

    canopy_bgr: tuple[float, float, float] = (225.0, 228.0, 230.0)
    canopy_inner: float = 0.84  # inner radius of the bright ring
    gores: int = 24  # panels of the canopy, alternately brighter and darker
    gore_contrast: float = 0.12
    ribs: int = 16  # struts of the basket
    rib_share: float = 0.4  # of the circumference that struts cover
    rib_bgr: tuple[float, float, float] = (120.0, 122.0, 125.0)
    lining_from: float = 0.45  # depth behind which a black lining closes the gaps, in depths of the basket
    lining_bgr: tuple[float, float, float] = (38.0, 36.0, 36.0)
    depth: float = 0.9  # of the basket
    rear: float = 0.3  # radius of its end
    coupling_bgr: tuple[float, float, float] = (90.0, 92.0, 95.0)
    hose_length: float = 14.0
    hose_radius: float = 0.1
    marker_radius: float = 0.055
    marker_bgr: tuple[tuple[float, float, float], ...] = (RED,) * 7


@dataclass(frozen=True, slots=True)
class DrogueLight:
    """Light of the scene: the grey value of a surface is its colour times ambient + diffuse * cosine.

    towards (3,): unit vector from the drogue to the light in the CAMERA's frame.
    """

    towards: tuple[float, float, float]
    ambient: float
    diffuse: float
    translucency: float = 0.35  # share of the light that a canopy passes from behind


FRONT_LIGHT = DrogueLight((0.0, -0.24, -0.97), 0.35, 0.65)
SIDE_LIGHT = DrogueLight((0.93, -0.3, -0.2), 0.3, 0.75)
OVERCAST = DrogueLight((0.0, -0.97, -0.24), 0.68, 0.25)
LIGHTS = {"front": FRONT_LIGHT, "side": SIDE_LIGHT, "overcast": OVERCAST}


@dataclass(frozen=True, slots=True)
class DrogueBackground:
    """What is behind the drogue, from its seed; `offset_px` (du, dv) moves it between the frames of a sequence.

    Raises:
        ValueError: unknown kind, or no picture with the kind "picture".
    """

    kind: str = CLOUDS
    seed: int = 0
    offset_px: tuple[float, float] = (0.0, 0.0)
    brightness_dn: float = 140.0  # mean level
    contrast_dn: float = 45.0  # of clouds and ground, about two sigmas
    clutter: int = 0  # distractors: discs, thin rings, lines, polygons; they move with the background
    picture: NDArray[np.uint8] | None = None  # (h, w) or (h, w, 3), for the kind "picture"

    def __post_init__(self) -> None:
        if self.kind not in BACKGROUNDS:
            raise ValueError(f"background: expected one of {', '.join(BACKGROUNDS)}, got {self.kind!r}")
        if (self.picture is None) != (self.kind != PICTURE):
            raise ValueError("background: a picture belongs to the kind 'picture', and only to it")


@dataclass(frozen=True, slots=True)
class Occluder:
    """An opaque object in front of the drogue, in pixels: a bar with a round end (the probe), or a disc.

    A bar extends from `start_px` to `end_px` and is `width_px` wide; a disc has its centre at `end_px` and `width_px`
    as diameter.
    """

    end_px: tuple[float, float]
    width_px: float
    start_px: tuple[float, float] = (0.0, 0.0)
    kind: str = BAR
    bgr: tuple[float, float, float] = (70.0, 70.0, 72.0)


@dataclass(frozen=True, slots=True)
class DrogueScene:
    """All that determines a picture, apart from the noise.

    The pose is in the world of the camera; a camera with the identity as `camera_from_world` has poses in its own
    frame.

    Raises:
        ValueError: a radius that is not positive, markers of another shape, or a camera behind the rim.
    """

    camera: Camera
    world_from_drogue: Pose
    radius_m: float = 0.3
    look: DrogueLook = field(default_factory=DrogueLook)
    light: DrogueLight = FRONT_LIGHT
    background: DrogueBackground = field(default_factory=DrogueBackground)
    blur_px: float = 0.7  # sigma of the defocus
    motion_px: tuple[float, float] = (0.0, 0.0)  # path (du, dv) of the drogue in the picture during the exposure
    noise_dn: float = 2.0  # 1 sigma at 128 DN; a quarter of its variance is independent of the light
    haze: float = 0.0  # share of the drogue's light that haze of the background's mean colour replaces
    occluders: tuple[Occluder, ...] = ()
    markers_m: Array | None = None  # (7, 3) centres in the drogue frame; None: `standard_markers`

    def __post_init__(self) -> None:
        if not self.radius_m > 0:
            raise ValueError(f"radius_m: expected a positive length, got {self.radius_m:g}")
        if self.markers_m is not None and np.shape(self.markers_m) != (7, 3):
            raise ValueError(f"markers_m: expected the shape (7, 3), got {np.shape(self.markers_m)}")
        if self.camera_from_drogue.inverse().translation[2] >= 0:
            raise ValueError("world_from_drogue: the camera must lie before the plane of the rim (z < 0 there)")

    @property
    def camera_from_drogue(self) -> Pose:
        """The drogue in the camera's frame."""
        return self.camera.camera_from_world @ self.world_from_drogue

    @property
    def markers(self) -> Array:
        """Centres (7, 3), m, in the drogue frame."""
        return standard_markers(self.radius_m) if self.markers_m is None else np.asarray(self.markers_m, dtype=float)


@dataclass(frozen=True, slots=True)
class Ellipse:
    """An ellipse in the picture: distorted pixels."""

    centre_px: Array  # (2,)
    major_px: float  # semi-axes
    minor_px: float
    angle_deg: float  # of the major axis, from +u towards +v, in (-90, 90]


@dataclass(frozen=True, slots=True)
class DroguePicture:
    """A picture and its truth at mid-exposure."""

    image: ColourPicture  # (h, w, 3)
    centre_px: Array  # (2,) image of the centre of the rim
    ellipse: Ellipse  # image of the rim; its centre differs from `centre_px` by the perspective
    radius_px: float  # semi-major axis: independent of the tilt, to first order
    hidden: float  # share of the rim behind occluders or outside the picture, 0 to 1
    markers_px: Array  # (7, 2), nan behind the camera
    markers_visible: Bools  # (7,) in the picture and not behind an occluder
