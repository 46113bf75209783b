"""A plausible rig from a few numbers; the lab replaces its poses and directions by measurements."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geometry.arrays import Array
from geometry.camera import Camera
from geometry.pose import Pose
from geometry.rig import Beam, Rig, Screen, Spot
from lab.errors import InputError
from lab.simulate.rigs import look_at

# Name of a screen, where it stands as seen from the vehicle, and the rotation world_from_screen.
_SCREENS = (
    ("left", (-1.0, 0.0, 0.0), ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))),
    ("right", (1.0, 0.0, 0.0), ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))),
    ("front", (0.0, 1.0, 0.0), ((1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0))),
    ("back", (0.0, -1.0, 0.0), ((1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0))),
)
_HALF_FAN_DEG = 20.0  # between the middle and the outermost beam of a fan
_UNEQUAL = 1.25  # ratio of neighbouring angles: beams at unequal angles can be distinguished
_TILT = 0.08  # tangent by which every second beam leaves the plane of its fan: coplanar beams determine less
_VIEW_M = 2.6  # width of the picture at a screen 2.5 m away


@dataclass(frozen=True, slots=True)
class Layout:
    """What the user states about the rig."""

    cameras: int = 2
    screens: int = 2
    beams: int = 3
    distance_m: float = 2.5  # from the vehicle to each screen
    image_size_px: tuple[int, int] = (1280, 1024)  # width, height


def rig_of(layout: Layout) -> Rig:
    """The rig of a layout.

    Raises:
        InputError: it cannot measure a pose.
    """
    _check(layout)
    used = _SCREENS[: layout.screens] if layout.screens > 1 else _SCREENS[1:2]
    d = layout.distance_m
    screens = {
        name: Screen(name, Pose(np.array(axes), d * np.array(normal)), (1.6 * d, 1.2 * d))
        for name, normal, axes in used
    }
    cameras: dict[str, Camera] = {}
    for i in range(layout.cameras):
        name, normal, _ = used[i % len(used)]
        number, several = i // len(used), layout.cameras > len(used)
        own = f"{name}-{number + 1}" if several else name
        cameras[own] = _camera(own, name, np.array(normal), number, layout)
    beams, spots = _beams_and_spots(layout.beams, [name for name, _, _ in used])
    return Rig(screens, cameras, beams, spots)


def _check(layout: Layout) -> None:
    if layout.cameras < layout.screens:
        raise InputError(
            f"cameras: expected at least one per screen ({layout.screens}), got {layout.cameras}; add cameras, or take"
            " fewer screens"
        )
    least = 3 if layout.screens == 1 else 4 if layout.screens > 2 else 2
    if layout.beams < least:
        raise InputError(
            f"beams: expected at least {least} for {layout.screens} screen{'s' if layout.screens > 1 else ''}, got"
            f" {layout.beams}; fewer do not determine a pose"
        )


def _camera(name: str, screen: str, normal: Array, number: int, layout: Layout) -> Camera:
    """A camera on the far side of the vehicle and above it, beside it by turns on either side."""
    d = layout.distance_m
    aside = np.array([-normal[1], normal[0], 0.0]) * (0.24 + 0.2 * (number // 2)) * (-1) ** number
    position = d * (-0.64 * normal + aside + np.array([0.0, 0.0, 0.6]))
    width, height = layout.image_size_px
    target = d * normal
    focal = round(width * float(np.linalg.norm(target - position)) / (_VIEW_M * d / 2.5 * 1.6), 1)
    matrix = np.array([[focal, 0.0, (width - 1) / 2], [0.0, focal, (height - 1) / 2], [0.0, 0.0, 1.0]])
    return Camera(name, screen, (width, height), matrix, (0.0,) * 5, look_at(position, target))


def _fan(count: int, axis: Array) -> list[Array]:
    """Directions of `count` beams about a horizontal axis, at unequal angles."""
    steps = _UNEQUAL ** np.arange(max(count - 1, 0))
    places = np.concatenate([[0.0], np.cumsum(steps)]) if count > 1 else np.zeros(1)
    angles = np.deg2rad(_HALF_FAN_DEG) * (2 * places / places[-1] - 1) if count > 1 else places
    across = np.array([-axis[1], axis[0], 0.0])
    out = []
    for i, angle in enumerate(angles):
        d = np.cos(angle) * axis + np.sin(angle) * across + np.array([0.0, 0.0, _TILT * (-1) ** i])
        out.append(np.round(d / np.linalg.norm(d), 6))
    return out


def _beams_and_spots(count: int, screens: list[str]) -> tuple[dict[str, Beam], dict[str, Spot]]:
    along_y = count // 2 if len(screens) > 2 else 0
    directions = [(d, "x") for d in _fan(count - along_y, np.array([1.0, 0.0, 0.0]))]
    directions += [(d, "y") for d in _fan(along_y, np.array([0.0, 1.0, 0.0]))] if along_y else []
    beams: dict[str, Beam] = {}
    spots: dict[str, Spot] = {}
    ends = {"x": (("left", -1), ("right", 1)), "y": (("back", -1), ("front", 1))}
    for i, (direction, along) in enumerate(directions):
        name = chr(ord("A") + i)
        beams[name] = Beam(name, direction, np.zeros(3))
        for screen, sign in ends[along]:
            if screen in screens:
                number = str(len(spots) + 1)
                spots[number] = Spot(number, name, sign, screen)
    return beams, spots
