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

    Raises ValueError: unknown kind, or no picture with the kind "picture".
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
    frame. Raises ValueError: a radius that is not positive, markers of another shape, or a camera behind the rim.
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

    image: ColourPicture  # (h, w, 3); (h, w) of a grey camera
    centre_px: Array  # (2,) image of the centre of the rim
    ellipse: Ellipse  # image of the rim; its centre differs from `centre_px` by the perspective
    radius_px: float  # semi-major axis: independent of the tilt, to first order
    hidden: float  # share of the rim behind occluders or outside the picture, 0 to 1
    markers_px: Array  # (7, 2), nan behind the camera
    markers_visible: Bools  # (7,) in the picture and not behind an occluder


# Projections of the rim and the markers: the truth of a drogue's picture.


RIM_POINTS = 360


def rim_points_px(scene: DrogueScene) -> Array:
    """Images (RIM_POINTS, 2), px, of points at equal angles on the rim; nan where there is no projection."""
    angle = np.arange(RIM_POINTS) * (2 * np.pi / RIM_POINTS)
    rim = scene.radius_m * np.stack([np.cos(angle), np.sin(angle), np.zeros(RIM_POINTS)], axis=1)
    return scene.camera.project(scene.world_from_drogue.apply(rim))


def ellipse_through(points_px: Array) -> Ellipse:
    """The ellipse through points (n, 2): least squares of the conic's equation, scaled about their mean.

    Exact for the image of a circle by a camera without distortion. Raises ValueError: fewer than five points, or the
    conic is no ellipse.
    """
    points = np.asarray(points_px, dtype=float)
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) < 5:
        raise ValueError(f"an ellipse needs five points, got {len(points)}")
    mean = points.mean(axis=0)
    scale = float(np.sqrt(np.mean(np.sum((points - mean) ** 2, axis=1))))
    x, y = ((points - mean) / scale).T
    a, b, c, d, e, f = np.linalg.svd(
        np.stack([x * x, x * y, y * y, x, y, np.ones_like(x)], axis=1), full_matrices=False
    )[2][-1]
    M = np.array([[a, b / 2], [b / 2, c]])
    if np.linalg.det(M) <= 0:
        raise ValueError("the points lie on no ellipse")
    centre = np.linalg.solve(-2 * M, [d, e])
    level = centre @ M @ centre - f
    size, axes = np.linalg.eigh(M / level)  # increasing: the first belongs to the major axis
    angle = np.degrees(np.arctan2(axes[1, 0], axes[0, 0]))
    angle = 90.0 - (90.0 - angle) % 180.0  # into (-90, 90]
    major, minor = scale / np.sqrt(size)
    return Ellipse(mean + scale * centre, float(major), float(minor), float(angle))


# Colours of the drogue along rays: canopy ring, markers, basket of struts with gaps, lining and coupling.
#
# A ray is given by its slopes (mx, my) = d(x, y)/dz in the drogue frame and the point (x0, y0) where it meets the
# plane of the rim, so that the equations of the surfaces are well conditioned at any distance. Source: ours.


_INSIDE_SHADE = 0.75  # loss of light at the end of the basket
_RING_AT, _RING_WIDTH = 0.26, 0.05  # spreader ring between the struts, in depths of the basket
_LIP = (0.6, 0.8)  # components of the canopy's normal outwards and towards the camera


def shade_rays(scene: DrogueScene, mx: Floats32, my: Floats32, x0: Floats32, y0: Floats32) -> tuple[Floats32, Floats32]:
    """Colours (n, 3) in DN and opacities (n,), 0 or 1, of rays (n,); lengths in radii of the rim."""
    look = scene.look
    towards = scene.camera_from_drogue.rotation.T @ np.asarray(scene.light.towards)
    towards /= np.linalg.norm(towards)
    colour = np.zeros((len(mx), 3), np.float32)
    alpha = np.zeros(len(mx), np.float32)
    rho2 = x0 * x0 + y0 * y0
    inner2 = np.float32(look.canopy_inner**2)

    ring = np.flatnonzero((rho2 <= 1) & (rho2 >= inner2))
    colour[ring], alpha[ring] = _canopy(scene, x0[ring], y0[ring], towards), 1
    rest = np.flatnonzero((rho2 < inner2) | (rho2 > 1))
    found, basket, solid = _basket(scene, mx[rest], my[rest], x0[rest], y0[rest], rho2[rest] < inner2, towards)
    rest = rest[found]
    colour[rest], alpha[rest] = basket, solid
    _paint_markers(scene, colour, alpha, (mx, my, x0, y0), towards)
    return colour, alpha


def _lit(scene: DrogueScene, cosine: Floats32, translucency: float = 0.0) -> Floats32:
    light = scene.light
    through = np.maximum(cosine, 0) + np.float32(translucency) * np.maximum(-cosine, 0)
    return np.float32(light.ambient) + np.float32(light.diffuse) * through


def _canopy(scene: DrogueScene, x: Floats32, y: Floats32, towards: Array) -> Floats32:
    look = scene.look
    rho = np.sqrt(x * x + y * y)
    out, front = _LIP
    cosine = (out * (x * towards[0] + y * towards[1]) / rho - front * towards[2]).astype(np.float32)
    gore = np.floor(np.arctan2(y, x) * np.float32(look.gores / (2 * np.pi))) % 2
    light = _lit(scene, cosine, scene.light.translucency) * (1 - np.float32(look.gore_contrast) * gore)
    return np.asarray(light[:, None] * np.asarray(look.canopy_bgr, np.float32), np.float32)


def _basket(
    scene: DrogueScene,
    mx: Floats32,
    my: Floats32,
    x0: Floats32,
    y0: Floats32,
    enters: NDArray[np.bool_],
    towards: Array,
) -> tuple[NDArray[np.intp], Floats32, Floats32]:
    """Which rays (k,) meet the basket, their colours (k, 3) and opacities (k,).

    The basket is the cone of radius inner - k z, 0 < z < depth. A ray meets it where A z^2 + 2 B z + C = 0; the first
    of the two places at which it is not a gap counts. A ray through the mouth that meets no wall ends at the coupling.
    """
    look = scene.look
    k = np.float32((look.canopy_inner - look.rear) / look.depth)
    inner = np.float32(look.canopy_inner)
    A = mx * mx + my * my - k * k
    B = x0 * mx + y0 * my + k * inner
    C = x0 * x0 + y0 * y0 - inner * inner
    root = np.sqrt(np.maximum(B * B - A * C, 0))
    q = -(B + np.where(B >= 0, root, -root))
    q = np.where(np.abs(q) > 1e-12, q, np.float32(1e-12))
    A = np.where(np.abs(A) > 1e-9, A, np.float32(1e-9))
    one, two = q / A, C / q
    meets = B * B - A * C > 0
    colour = np.zeros((len(mx), 3), np.float32)
    done = np.zeros(len(mx), bool)
    for z in (np.minimum(one, two), np.maximum(one, two)):
        here = np.flatnonzero(meets & ~done & (z > 0) & (z < look.depth))
        zh = z[here]
        x, y = x0[here] + mx[here] * zh, y0[here] + my[here] * zh
        paint, solid = _wall(look, x, y, zh)
        radial = (x * towards[0] + y * towards[1]) / np.sqrt(x * x + y * y)
        # The inner wall is seen if the ray leaves the cone there: its outward slope exceeds the wall's.
        inside = (x * mx[here] + y * my[here]) / np.sqrt(x * x + y * y) > -k
        cosine = np.where(inside, -radial, radial).astype(np.float32)
        dim = np.where(inside, 1 - np.float32(_INSIDE_SHADE) * zh / np.float32(look.depth), np.float32(0.8))
        shade = (_lit(scene, cosine) * dim)[:, None] * paint
        colour[here[solid]], done[here[solid]] = shade[solid], True
    depth = np.float32(look.depth)
    end2 = (x0 + mx * depth) ** 2 + (y0 + my * depth) ** 2
    end = enters & ~done & (end2 < look.rear**2)
    coupling = (end2 > (0.35 * look.rear) ** 2) & (end2 < (0.7 * look.rear) ** 2)
    level = np.float32((1 - _INSIDE_SHADE) * (scene.light.ambient + 0.5 * scene.light.diffuse))
    colour[end & coupling] = level * np.asarray(look.coupling_bgr, np.float32) * np.float32(2)
    colour[end & ~coupling] = level * np.asarray(look.lining_bgr, np.float32)
    found = np.flatnonzero(done | end)
    return found, colour[found], np.ones(len(found), np.float32)


def _wall(look: DrogueLook, x: Floats32, y: Floats32, z: Floats32) -> tuple[Floats32, NDArray[np.bool_]]:
    """Colours (n, 3) of the wall of the basket at points of it, and where it is solid."""
    turn = np.arctan2(y, x) * np.float32(look.ribs / (2 * np.pi)) % 1
    rib = np.abs(turn - np.float32(0.5)) < 0.5 * look.rib_share
    share = z / np.float32(look.depth)
    rib |= np.abs(share - np.float32(_RING_AT)) < 0.5 * _RING_WIDTH
    paint = np.where(rib[:, None], np.asarray(look.rib_bgr, np.float32), np.asarray(look.lining_bgr, np.float32))
    return paint, rib | (share > look.lining_from)


def _paint_markers(
    scene: DrogueScene,
    colour: Floats32,
    alpha: Floats32,
    rays: tuple[Floats32, Floats32, Floats32, Floats32],
    towards: Array,
) -> None:
    """Discs parallel to the rim, in front of everything else of the drogue."""
    mx, my, x0, y0 = rays
    look = scene.look
    markers = scene.markers / scene.radius_m
    near = np.arange(len(mx))
    flat = bool(np.all(markers[:, 2] == 0))
    if flat:
        reach = np.hypot(markers[:, 0], markers[:, 1])
        rho2 = x0 * x0 + y0 * y0
        low, high = max(reach.min() - look.marker_radius, 0), reach.max() + look.marker_radius
        near = np.flatnonzero((rho2 >= low * low) & (rho2 <= high * high))
    level = _lit(scene, np.float32(-towards[2]) * np.ones(1, np.float32), 0.0)
    for (x, y, z), bgr in zip(markers.astype(np.float32), look.marker_bgr, strict=True):
        dx, dy = x0[near] + mx[near] * z - x, y0[near] + my[near] * z - y
        hit = near[dx * dx + dy * dy <= look.marker_radius**2]
        colour[hit], alpha[hit] = level * np.asarray(bgr, np.float32), 1
