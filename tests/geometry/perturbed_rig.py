"""A rig with changed parameters: for numerical derivatives, and for rigs that differ from their calibration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from geometry.arrays import Array
from geometry.pose import Pose
from geometry.rig import Beam, Rig, Screen
from geometry.uncertainty.rig_uncertainty import (
    BOW,
    DIRECTION,
    POINT,
    POSE,
    is_known,
    perturbed_camera,
    split_name,
)


def perturbed(rig: Rig, names: Sequence[str], delta: Array) -> Rig:
    """The rig with each named parameter changed by delta (p,), in the parameters' units.

    Raises:
        KeyError: the rig has no parameter of this name.
    """
    changes: dict[tuple[str, str], dict[str, float]] = {}
    for name, value in zip(names, delta, strict=True):
        if not is_known(rig, name):
            raise KeyError(name)
        kind, item, parameter = split_name(name)
        changes.setdefault((kind, item), {})[parameter] = float(value)
    cameras, screens, beams = dict(rig.cameras), dict(rig.screens), dict(rig.beams)
    for (kind, item), change in changes.items():
        if kind == "cameras":
            cameras[item] = perturbed_camera(cameras[item], change)
        elif kind == "screens":
            screens[item] = _perturbed_screen(screens[item], change)
        else:
            beams[item] = _perturbed_beam(beams[item], change)
    return Rig(screens, cameras, beams, rig.spots)


def _changes_of(change: dict[str, float], names: Sequence[str]) -> Array:
    """The changes of the named parameters (k,), 0 for those that do not change."""
    return np.array([change.get(n, 0.0) for n in names])


def _perturbed_pose(pose: Pose, change: dict[str, float]) -> Pose:
    delta = _changes_of(change, POSE)
    return pose.plus(delta) if delta.any() else pose


def _perturbed_screen(screen: Screen, change: dict[str, float]) -> Screen:
    a, b, c = (np.array(screen.bow) + _changes_of(change, BOW)).tolist()
    return replace(screen, world_from_screen=_perturbed_pose(screen.world_from_screen, change), bow=(a, b, c))


def _perturbed_beam(beam: Beam, change: dict[str, float]) -> Beam:
    return Beam(beam.name, beam.direction + _changes_of(change, DIRECTION), beam.point + _changes_of(change, POINT))
