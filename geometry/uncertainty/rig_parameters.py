"""The numbers of a rig that a calibration determines: their names, how they move the rig, and what they are known to.

Names as in rig.yaml's covariance blocks: `cameras.left.fx`, `screens.right.rot_x_rad`, `beams.A.direction_y`. Cameras
have fx, fy, cx, cy (px), as many of k1 ... tau_y as their lens model uses, and the error of camera_from_world; screens
the error of world_from_screen and the bow; beams a direction and a point in body (along the beam they do nothing).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from geometry.arrays import Array
from geometry.camera import FISHEYE, Camera
from geometry.forward_model import SpotDerivatives, SpotModel
from geometry.pose import Pose
from geometry.rig import Beam, Rig, Screen

PINHOLE = ("fx", "fy", "cx", "cy")
DISTORTION = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tau_x", "tau_y")
FISHEYE_DISTORTION = ("k1", "k2", "k3", "k4")
POSE = ("x_m", "y_m", "z_m", "rot_x_rad", "rot_y_rad", "rot_z_rad")
BOW = ("bow_xx_per_m", "bow_xy_per_m", "bow_yy_per_m")
DIRECTION = ("direction_x", "direction_y", "direction_z")
POINT = ("point_x_m", "point_y_m", "point_z_m")


@dataclass(frozen=True, slots=True)
class RigCovariance:
    """What a calibration knows of the joint errors of a rig's numbers."""

    names: tuple[str, ...]  # p names as above
    matrix: Array  # (p, p), in the parameters' units; may be singular


def distortion_names(camera: Camera) -> tuple[str, ...]:
    """The names of the distortion numbers that a camera has, in order."""
    names = FISHEYE_DISTORTION if camera.lens == FISHEYE else DISTORTION
    return names[: len(camera.distortion)]


def camera_names(camera: Camera) -> tuple[str, ...]:
    """All parameters of a camera, without its own name."""
    return (*PINHOLE, *distortion_names(camera), *POSE)


def rig_names(rig: Rig, bow: bool = False) -> tuple[str, ...]:
    """All parameters of a rig: cameras, screens (with their bows where asked for), beams."""
    names = [f"cameras.{n}.{p}" for n, c in rig.cameras.items() for p in camera_names(c)]
    names += [f"screens.{n}.{p}" for n in rig.screens for p in ((*POSE, *BOW) if bow else POSE)]
    names += [f"beams.{n}.{p}" for n in rig.beams for p in (*DIRECTION, *POINT)]
    return tuple(names)


def split(name: str) -> tuple[str, str, str]:
    """Kind, thing and parameter: `cameras.left.fx` is cameras, left, fx; the thing's own name may hold dots."""
    kind, rest = name.split(".", 1)
    thing, parameter = rest.rsplit(".", 1)
    return kind, thing, parameter


def is_known(rig: Rig, name: str) -> bool:
    """Whether a name is that of a number of this rig."""
    if name.count(".") < 2:
        return False
    kind, thing, parameter = split(name)
    if kind == "cameras" and thing in rig.cameras:
        return parameter in camera_names(rig.cameras[thing])
    if kind == "screens" and thing in rig.screens:
        return parameter in (*POSE, *BOW)
    return kind == "beams" and thing in rig.beams and parameter in (*DIRECTION, *POINT)


def moved(rig: Rig, names: Sequence[str], delta: Array) -> Rig:
    """The rig with each named number changed by delta (p,), in the parameters' units. KeyError for unknown names."""
    changes: dict[tuple[str, str], dict[str, float]] = {}
    for name, value in zip(names, delta, strict=True):
        if not is_known(rig, name):
            raise KeyError(name)
        kind, thing, parameter = split(name)
        changes.setdefault((kind, thing), {})[parameter] = float(value)
    cameras, screens, beams = dict(rig.cameras), dict(rig.screens), dict(rig.beams)
    for (kind, thing), change in changes.items():
        if kind == "cameras":
            cameras[thing] = _moved_camera(cameras[thing], change)
        elif kind == "screens":
            screens[thing] = _moved_screen(screens[thing], change)
        else:
            beams[thing] = _moved_beam(beams[thing], change)
    return Rig(screens, cameras, beams, rig.spots)


def _several(change: dict[str, float], names: Sequence[str]) -> Array:
    return np.array([change.get(n, 0.0) for n in names])


def _moved_pose(pose: Pose, change: dict[str, float]) -> Pose:
    delta = _several(change, POSE)
    return pose.plus(delta) if delta.any() else pose


def _moved_camera(camera: Camera, change: dict[str, float]) -> Camera:
    d = _several(change, PINHOLE)
    matrix = camera.matrix + np.array([[d[0], 0, d[2]], [0, d[1], d[3]], [0, 0, 0]])
    distortion = np.array(camera.distortion) + _several(change, distortion_names(camera))
    return replace(
        camera,
        matrix=matrix,
        distortion=tuple(distortion.tolist()),
        camera_from_world=_moved_pose(camera.camera_from_world, change),
    )


def _moved_screen(screen: Screen, change: dict[str, float]) -> Screen:
    a, b, c = (np.array(screen.bow) + _several(change, BOW)).tolist()
    return replace(screen, world_from_screen=_moved_pose(screen.world_from_screen, change), bow=(a, b, c))


def _moved_beam(beam: Beam, change: dict[str, float]) -> Beam:
    return Beam(beam.name, beam.direction + _several(change, DIRECTION), beam.point + _several(change, POINT))


class Sensitivity:
    """What the named numbers of a rig do to the pixels of its n views.

    Prepared once per rig, since where each number acts does not depend on the pose.
    """

    def __init__(self, rig: Rig, model: SpotModel, names: Sequence[str]) -> None:
        """KeyError for a name that the rig does not have. model: of this rig, also a subset of its views."""
        self.names = tuple(names)
        cameras, screens, beams = list(rig.cameras), list(rig.screens), list(rig.beams)
        camera_of = model.camera_of
        screen_of = np.array([screens.index(rig.spots[s].screen) for _, s in model.views], dtype=np.int64)
        # By field of SpotDerivatives: the parameters' places, their columns there, and which views (n, .) they move.
        self._moves: dict[str, tuple[list[int], list[int], Array]] = {}
        masks: dict[str, list[Array]] = {}
        for i, name in enumerate(self.names):
            if not is_known(rig, name):
                raise KeyError(name)
            kind, thing, parameter = split(name)
            if kind == "cameras":
                field, column = _camera_place(rig.cameras[thing], parameter)
                views = camera_of == cameras.index(thing)
            elif kind == "screens":
                field, column = ("bow", BOW.index(parameter)) if parameter in BOW else ("screen", POSE.index(parameter))
                views = screen_of == screens.index(thing)
            else:
                is_direction = parameter in DIRECTION
                field = "direction" if is_direction else "point"
                column = (DIRECTION if is_direction else POINT).index(parameter)
                views = model.beam_of == beams.index(thing)
            places, columns, _ = self._moves.setdefault(field, ([], [], np.empty(0)))
            places.append(i)
            columns.append(column)
            masks.setdefault(field, []).append(views.astype(float))
        for field, (places, columns, _) in self._moves.items():
            self._moves[field] = places, columns, np.stack(masks[field], axis=-1)

    def of(self, derivatives: SpotDerivatives) -> Array:
        """d(pixels)/d(parameters) (..., n, 2, p), px per unit."""
        out = np.zeros((*derivatives.pixels.shape, len(self.names)))
        for field, (places, columns, views) in self._moves.items():
            out[..., places] = getattr(derivatives, field)[..., columns] * views[:, None, :]
        return out


def _camera_place(camera: Camera, parameter: str) -> tuple[str, int]:
    if parameter in PINHOLE:
        return "pinhole", PINHOLE.index(parameter)
    if parameter in POSE:
        return "camera", POSE.index(parameter)
    return "distortion", distortion_names(camera).index(parameter)
