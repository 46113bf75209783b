"""The rig as frozen values: screens and cameras in the lab, beams and spots of the vehicle."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from geometry.arrays import Array
from geometry.camera import Camera
from geometry.pose import Pose


@dataclass(frozen=True, slots=True)
class Screen:
    """A receiving screen, flat or slightly bent."""

    name: str
    world_from_screen: Pose  # the screen's z axis is its normal
    size_m: tuple[float, float] | None = None  # extent along x and y, centred on the origin; None: unlimited
    bow: tuple[float, float, float] = (0.0, 0.0, 0.0)  # a, b, c, 1/m: the surface is z = a x^2 + b x y + c y^2


@dataclass(frozen=True, slots=True)
class Beam:
    """The line of a laser beam, fixed in the vehicle. Raises ValueError: the direction has no length."""

    name: str
    direction: Array  # (3,), unit, in body
    point: Array  # (3,), m, in body

    def __post_init__(self) -> None:
        length = float(np.linalg.norm(self.direction))
        if not np.isfinite(length) or length < 1e-9:
            raise ValueError(f"beam {self.name!r}: the direction has no length")
        object.__setattr__(self, "direction", np.asarray(self.direction, dtype=float) / length)


@dataclass(frozen=True, slots=True)
class Spot:
    """One end of a beam and the screen on which it falls."""

    name: str
    beam: str
    sign: int  # +1: the ray from the beam's point along its direction; -1: against it
    screen: str


@dataclass(frozen=True, slots=True)
class Rig:
    """Everything that is calibrated. Keys are names, in the order of the file.

    Raises ValueError: a camera or spot refers to a screen or beam that the rig does not have.
    """

    screens: Mapping[str, Screen]
    cameras: Mapping[str, Camera]
    beams: Mapping[str, Beam]
    spots: Mapping[str, Spot]

    def __post_init__(self) -> None:
        for camera in self.cameras.values():
            if camera.screen not in self.screens:
                raise ValueError(f"camera {camera.name!r} observes screen {camera.screen!r}, which is not in the rig")
        for spot in self.spots.values():
            if spot.screen not in self.screens:
                raise ValueError(f"spot {spot.name!r} falls on screen {spot.screen!r}, which is not in the rig")
            if spot.beam not in self.beams:
                raise ValueError(f"spot {spot.name!r} belongs to beam {spot.beam!r}, which is not in the rig")

    def views(self) -> list[tuple[str, str]]:
        """All (camera, spot) pairs: each camera with the spots of its screen."""
        return [(c.name, s.name) for c in self.cameras.values() for s in self.spots.values() if s.screen == c.screen]
