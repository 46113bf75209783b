"""Example rigs by name: typical arrangements of screens, cameras and a vehicle."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from types import MappingProxyType

import numpy as np

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
        cameras[name] = Camera(name, c.screen, (width, height), matrix, c.distortion, c.camera_from_world, c.noise)
    return Rig(rig.screens, cameras, rig.beams, rig.spots)


def with_noise(rig: Rig, noise: SensorNoise) -> Rig:
    """The rig with this sensor noise in every camera."""
    cameras = {
        n: Camera(n, c.screen, c.image_size_px, c.matrix, c.distortion, c.camera_from_world, noise)
        for n, c in rig.cameras.items()
    }
    return Rig(rig.screens, cameras, rig.beams, rig.spots)


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
    rig = fan()
    cameras = {
        "left-a": lab_camera("left-a", "left", (1.6, 0.6, 1.5), (-2.5, 0.35, 0.0)),
        "left-b": lab_camera("left-b", "left", (1.2, -1.5, 1.3), (-2.5, 0.0, 0.0)),
        "right-a": lab_camera("right-a", "right", (-1.6, -0.6, 1.5), (2.5, -0.35, 0.0)),
        "right-b": lab_camera("right-b", "right", (-1.2, 1.5, 1.3), (2.5, 0.0, 0.0)),
    }
    return Rig(rig.screens, cameras, rig.beams, rig.spots)


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
