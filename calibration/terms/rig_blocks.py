"""Conversion of a rig to stacks of unknowns and back: values, names and covariances.

The stacks "intrinsics", "cameras", "screens", "bow" and "beams" have the rig's order.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from calibration.least_squares.adjustment import At, Lines, Poses, Prior, Stack, Values, Vectors
from calibration.terms.surveyed import array_of, pose_of
from geometry.arrays import Array, Bools
from geometry.camera import Camera, pinhole_numbers
from geometry.lens import padded
from geometry.rig import Beam, Rig
from geometry.uncertainty.rig_uncertainty import BOW, DIRECTION, PINHOLE, POINT, POSE, RigCovariance, distortion_names

INTRINSICS, CAMERAS, SCREENS, BOWS, BEAMS = "intrinsics", "cameras", "screens", "bow", "beams"
STAND, POSES = "stand", "poses"  # world_from_stand (1), and stand_from_body, one per stand position
_INTRINSICS_COUNT = 18  # fx, fy, cx, cy and 14 distortion coefficients
# Share of its variance that is added to each number of a prior. A singular covariance then also constrains the
# directions in which it is 0 (to 1e-4 of a sigma); `Prior` leaves such directions free.
_RIDGE = 1e-8


def stacks_of(rig: Rig) -> dict[str, Stack]:
    """The stacks of a rig. Lens numbers that a camera's model does not have are 0 and must not be free."""
    lens = [np.concatenate([pinhole_numbers(c), padded(c.distortion)]) for c in rig.cameras.values()]
    return {
        INTRINSICS: Vectors(np.array(lens, dtype=float).reshape(-1, _INTRINSICS_COUNT)),
        CAMERAS: Poses.of([c.camera_from_world for c in rig.cameras.values()]),
        SCREENS: Poses.of([s.world_from_screen for s in rig.screens.values()]),
        BOWS: Vectors(np.array([s.bow for s in rig.screens.values()], dtype=float).reshape(-1, 3)),
        BEAMS: Lines(
            np.array([b.point for b in rig.beams.values()], dtype=float).reshape(-1, 3),
            np.array([b.direction for b in rig.beams.values()], dtype=float).reshape(-1, 3),
        ),
    }


def rig_of(rig: Rig, values: Values) -> Rig:
    """The rig with the values of those stacks that are present; everything else is that of the given rig."""
    cameras, screens, beams = dict(rig.cameras), dict(rig.screens), dict(rig.beams)
    for i, (name, c) in enumerate(rig.cameras.items()):
        cameras[name] = _camera(c, i, values)
    for i, (name, s) in enumerate(rig.screens.items()):
        world_from_screen = pose_of(values, SCREENS)[i] if SCREENS in values else s.world_from_screen
        a, b, c_ = array_of(values, BOWS)[i].tolist() if BOWS in values else s.bow
        screens[name] = replace(s, world_from_screen=world_from_screen, bow=(a, b, c_))
    if BEAMS in values:
        lines = lines_in(values)
        beams = {n: Beam(n, lines.directions[i], lines.points[i]) for i, n in enumerate(beams)}
    return Rig(screens, cameras, beams, rig.spots)


def lines_in(values: Values) -> Lines:
    """The stack of the beams."""
    stack = values[BEAMS]
    assert isinstance(stack, Lines)
    return stack


def names_at(rig: Rig, at: At) -> tuple[str, ...]:
    """The names, as in rig.yaml's covariance blocks, of the numbers of one unknown of a stack.

    Raises:
        KeyError: the stack does not belong to the rig.
    """
    stack, i = at
    if stack in (INTRINSICS, CAMERAS):
        name, camera = list(rig.cameras.items())[i]
        return _full_names(f"cameras.{name}", (*PINHOLE, *distortion_names(camera)) if stack == INTRINSICS else POSE)
    if stack in (SCREENS, BOWS):
        return _full_names(f"screens.{list(rig.screens)[i]}", POSE if stack == SCREENS else BOW)
    if stack == BEAMS:
        return _full_names(f"beams.{list(rig.beams)[i]}", (*DIRECTION, *POINT))
    raise KeyError(stack)


def named_errors(rig: Rig, values: Values, at: Sequence[At]) -> tuple[tuple[str, ...], Array]:
    """Names (p) of the numbers of some unknowns, and the matrix (p, q) from errors of the unknowns to their errors.

    A beam's four errors give six, with none along the beam. Only lens numbers that the camera's model uses have names.
    """
    names = [names_at(rig, a) for a in at]
    T = np.zeros((sum(map(len, names)), sum(values[s].dof for s, _ in at)))
    row = column = 0
    for a, n in zip(at, names, strict=True):
        block = _to_names(values, a, len(n))
        T[row : row + len(n), column : column + block.shape[1]] = block
        row, column = row + len(n), column + block.shape[1]
    return tuple(n for some in names for n in some), T


def prior_of(rig: Rig, covariance: RigCovariance) -> tuple[Prior | None, dict[str, Bools]]:
    """A covariance of rig parameters as a prior on the rig's stacks, and the numbers (k, dof) that are then free.

    Numbers that are not named, or have a variance of 0, are known and stay fixed. The prior is None if none is free.

    Raises:
        KeyError: the rig has no parameter of this name.
    """
    values = stacks_of(rig)
    every = [(s, i) for s, stack in values.items() for i in range(len(stack))]
    place = {n: (a, k) for a in every for k, n in enumerate(names_at(rig, a))}
    used: list[At] = list(dict.fromkeys(place[n][0] for n in covariance.names))
    if not used:
        return None, {}
    names, T = named_errors(rig, values, used)
    order = {n: i for i, n in enumerate(names)}
    rows = np.array([order[n] for n in covariance.names], dtype=np.int64)
    full = np.zeros((len(names), len(names)))
    full[np.ix_(rows, rows)] = covariance.matrix
    # The columns of T are orthonormal or 0, so that its transpose maps errors of the numbers back to the unknowns.
    C = T.T @ full @ T
    C += np.diag(_RIDGE * np.diagonal(C))
    known = np.diagonal(C) > 0
    free: dict[str, Bools] = {}
    start = 0
    for stack, i in used:
        dof = values[stack].dof
        mask = free.setdefault(stack, np.zeros((len(values[stack]), dof), dtype=bool))
        mask[i] = known[start : start + dof]
        start += dof
    picked = tuple(values[s].pick(np.array([i])) for s, i in used)
    return (Prior(tuple(used), picked, C) if known.any() else None), free


def _camera(c: Camera, i: int, values: Values) -> Camera:
    pose = pose_of(values, CAMERAS)[i] if CAMERAS in values else c.camera_from_world
    if INTRINSICS not in values:
        return replace(c, camera_from_world=pose)
    fx, fy, cx, cy, *lens = array_of(values, INTRINSICS)[i].tolist()
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    return replace(c, matrix=matrix, distortion=tuple(lens[: len(c.distortion)]), camera_from_world=pose)


def _full_names(item: str, parameters: Sequence[str]) -> tuple[str, ...]:
    return tuple(f"{item}.{p}" for p in parameters)


def _to_names(values: Mapping[str, Stack], at: At, count: int) -> Array:
    """The matrix (count, dof) from the errors of an unknown to those of its `count` named numbers."""

    stack = values[at[0]]
    if not isinstance(stack, Lines):
        return np.eye(count, stack.dof)
    B = stack.basis[at[1]]
    T = np.zeros((6, 4))
    T[:3, :2] = T[3:, 2:] = B
    return T
