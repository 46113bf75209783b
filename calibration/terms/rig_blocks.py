"""A rig as stacks of unknowns (values, names and covariances), and the pixels of its spots as a term of an adjustment.

The stacks "intrinsics", "cameras", "screens", "bow", "beams", "offsets" and "row times" are in the rig's order. Pixels
of a vehicle at rest measure beams, screens, cameras, the stand and its positions; those of a recording also the clocks.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace

import numpy as np

from calibration.least_squares.adjustment import (
    At,
    Linearised,
    Lines,
    Loss,
    Part,
    Poses,
    Prior,
    Stack,
    Values,
    Vectors,
    places,
)
from calibration.terms.surveyed import array_of, pose_of
from geometry.arrays import Array, Bools, Ints, skew
from geometry.camera import FISHEYE, Camera, camera_matrix, pinhole_numbers
from geometry.forward_model import SpotModel
from geometry.lens import fisheye_fold_limit, fold_limit, padded
from geometry.pose import Pose
from geometry.pose_solver.gauss_newton import whiten
from geometry.rig import Beam, Rig
from geometry.uncertainty.rig_uncertainty import (
    BOW,
    DIRECTION,
    PINHOLE,
    POINT,
    POSE,
    ROW_TIME,
    TIME_OFFSET,
    RigCovariance,
    distortion_names,
)

INTRINSICS, CAMERAS, SCREENS, BOWS, BEAMS = "intrinsics", "cameras", "screens", "bow", "beams"
OFFSETS, ROW_TIMES = "offsets", "row times"  # of the cameras' clocks, s
_CLOCKS = {OFFSETS: TIME_OFFSET, ROW_TIMES: ROW_TIME}
STAND, POSES = "stand", "poses"  # world_from_stand (1), and stand_from_body, one per stand position
_INTRINSICS_COUNT = 18  # fx, fy, cx, cy and 14 distortion coefficients
# Share of its variance that is added to each number of a prior. A singular covariance then also constrains the
# directions in which it is 0 (to 1e-4 of a sigma); `Prior` leaves such directions free.
_RIDGE = 1e-8


def stacks_of(rig: Rig) -> dict[str, Stack]:
    """The stacks of a rig. Lens numbers that a camera's model does not have are 0 and must not be free."""
    cameras = list(rig.cameras.values())
    lens = [np.concatenate([pinhole_numbers(c), padded(c.distortion)]) for c in cameras]
    return {
        INTRINSICS: Vectors(np.array(lens, dtype=float).reshape(-1, _INTRINSICS_COUNT)),
        CAMERAS: Poses.of([c.camera_from_world for c in cameras]),
        SCREENS: Poses.of([s.world_from_screen for s in rig.screens.values()]),
        BOWS: Vectors(np.array([s.bow for s in rig.screens.values()], dtype=float).reshape(-1, 3)),
        BEAMS: Lines(
            np.array([b.point for b in rig.beams.values()], dtype=float).reshape(-1, 3),
            np.array([b.direction for b in rig.beams.values()], dtype=float).reshape(-1, 3),
        ),
        OFFSETS: Vectors(np.array([c.time_offset_s for c in cameras], dtype=float).reshape(-1, 1)),
        ROW_TIMES: Vectors(np.array([c.row_time_s for c in cameras], dtype=float).reshape(-1, 1)),
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

    Raises KeyError: the stack does not belong to the rig.
    """
    stack, i = at
    if stack in (INTRINSICS, CAMERAS, *_CLOCKS):
        name, camera = list(rig.cameras.items())[i]
        if stack in _CLOCKS:
            return (f"cameras.{name}.{_CLOCKS[stack]}",)
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


def named_covariance(rig: Rig, values: Values, at: Sequence[At], covariance: Array) -> RigCovariance:
    """The covariance (q, q) of some unknowns as that of their named numbers; without those that have no error."""
    names, T = named_errors(rig, values, at)
    matrix = T @ covariance @ T.T
    return RigCovariance(names, matrix).part(np.diagonal(matrix) > 0)


def prior_of(rig: Rig, covariance: RigCovariance) -> tuple[Prior | None, dict[str, Bools]]:
    """A covariance of rig parameters as a prior on the rig's stacks, and the numbers (k, dof) that are then free.

    Numbers that are not named, or have a variance of 0, are known and stay fixed. The prior is None if none is free.
    Raises KeyError: the rig has no parameter of this name.
    """
    values = stacks_of(rig)
    every = [(s, i) for s, stack in values.items() for i in range(len(stack))]
    place = {n: (a, k) for a in every for k, n in enumerate(names_at(rig, a))}
    named = {place[n][0] for n in covariance.names}
    used = [a for a in every if a in named]  # whatever the order of the names, as in every term
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
    for (stack, i), own in places(used, values).items():
        free.setdefault(stack, np.zeros((len(values[stack]), len(own)), dtype=bool))[i] = known[own]
    picked = tuple(values[s].pick(np.array([i])) for s, i in used)
    return (Prior(tuple(used), picked, C) if known.any() else None), free


def _camera(c: Camera, i: int, values: Values) -> Camera:
    pose = pose_of(values, CAMERAS)[i] if CAMERAS in values else c.camera_from_world
    if OFFSETS in values:
        c = replace(c, time_offset_s=float(array_of(values, OFFSETS)[i, 0]))
    if ROW_TIMES in values:
        c = replace(c, row_time_s=float(array_of(values, ROW_TIMES)[i, 0]))
    if INTRINSICS not in values:
        return replace(c, camera_from_world=pose)
    lens = array_of(values, INTRINSICS)[i].tolist()
    distortion = tuple(lens[4 : 4 + len(c.distortion)])
    return replace(c, matrix=camera_matrix(lens[:4]), distortion=distortion, camera_from_world=pose)


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


@dataclass(frozen=True, slots=True)
class SpotPixels:
    """N detected and labelled spots at positions of the stand."""

    position: Ints  # (N,) index of the stand's position
    view: Ints  # (N,) index of the view, in the order of Rig.views()
    pixels: Array  # (N, 2), distorted
    covariance: Array  # (N, 2, 2), px^2

    def __len__(self) -> int:
        return len(self.position)

    def pick(self, rows: Bools | Ints) -> SpotPixels:
        """Some of the spots."""
        return SpotPixels(self.position[rows], self.view[rows], self.pixels[rows], self.covariance[rows])


@dataclass(frozen=True, slots=True)
class SpotTerm:
    """Predicted minus measured pixels of spots, in sigmas.

    The stacks are those of rig_blocks.py: "intrinsics", "cameras", "screens", "bow" and "beams" in the rig's order,
    "stand" (one) and "poses" (one per position), with world_from_body = stand[0] @ poses[position]. The forward model
    is that of geometry/forward_model.py with unlimited screens: a spot that was detected did hit its screen.
    """

    rig: Rig  # for what the stacks do not contain: which camera sees which screen, ends of beams, lens models
    spots: SpotPixels
    loss: Loss | None = None
    _model: SpotModel = field(init=False)  # one view per spot, with arrays (N, 1, ...), because each has its own pose
    _W: Array = field(init=False)  # (N, 2, 2) whitening matrices

    def __post_init__(self) -> None:
        model = SpotModel.of(self.rig)
        of_spots = model.subset(self.spots.view)
        arrays = {
            f.name: getattr(of_spots, f.name)[:, None]
            for f in fields(of_spots)
            if f.init and isinstance(getattr(of_spots, f.name), np.ndarray)
        }
        unlimited = np.full_like(arrays["half_size"], np.inf)
        object.__setattr__(self, "_model", replace(of_spots, **{**arrays, "half_size": unlimited}))
        object.__setattr__(self, "_W", whiten(self.spots.covariance))

    def __len__(self) -> int:
        return len(self.spots)

    def pick(self, rows: Bools, loss: Loss | None = None) -> SpotTerm:
        """Some of the spots, with this loss."""
        return SpotTerm(self.rig, self.spots.pick(rows), loss)

    def widened(self, scale: float) -> SpotTerm:
        """The same spots with all sigmas multiplied."""
        return SpotTerm(self.rig, replace(self.spots, covariance=self.spots.covariance * scale**2), self.loss)

    def linearise(self, values: Values) -> Linearised:
        """Residuals (N, 2), and their derivatives by all seven stacks; nan where a beam misses its screen."""
        model = self._at(values)
        beam, camera, screen = model.beam_of[:, 0], model.camera_of[:, 0], model.screen_of[:, 0]
        world_from_stand, stand_from_body = pose_of(values, STAND)[0], pose_of(values, POSES)[self.spots.position]
        d = model.derivatives(world_from_stand @ stand_from_body)
        residuals = self._W @ (d.pixels[:, 0] - self.spots.pixels)[..., None]
        by_stand, by_pose = _chain(d.pose[:, 0], world_from_stand, stand_from_body)
        B = lines_in(values).basis[beam]
        by_beam = np.concatenate([d.direction[:, 0] @ B, d.point[:, 0] @ B], axis=-1)
        by_lens = np.concatenate([d.pinhole[:, 0], d.distortion[:, 0]], axis=-1)
        parts = [
            (INTRINSICS, camera, by_lens),
            (CAMERAS, camera, d.camera[:, 0]),
            (SCREENS, screen, d.screen[:, 0]),
            (BOWS, screen, d.bow[:, 0]),
            (BEAMS, beam, by_beam),
            (STAND, np.zeros(len(beam), dtype=np.int64), by_stand),
            (POSES, self.spots.position, by_pose),
        ]
        return Linearised(residuals[..., 0], [Part(name, index, self._W @ J) for name, index, J in parts])

    def _at(self, values: Values) -> SpotModel:
        """The forward model with the values of the stacks."""
        m = self._model
        lens, lines = array_of(values, INTRINSICS), lines_in(values)
        cameras, screens = pose_of(values, CAMERAS), pose_of(values, SCREENS)
        fold = self._folds(lens)
        screen = m.screen_of
        return replace(
            m,
            point=lines.points[m.beam_of],
            ray=m.sign[..., None] * lines.directions[m.beam_of],
            screen_rotation=screens.rotation[screen],
            screen_origin=screens.translation[screen],
            bow=array_of(values, BOWS)[screen],
            camera_rotation=cameras.rotation[m.camera_of],
            camera_translation=cameras.translation[m.camera_of],
            pinhole=lens[m.camera_of][..., :4],
            distortion=lens[m.camera_of][..., 4:],
            fold_r2=fold[m.camera_of],
        )

    def _folds(self, lens: Array) -> Array:
        """Squared radius (cameras,) at which each lens model folds; that of the rig for an unchanged lens."""
        out = []
        for c, row in zip(self.rig.cameras.values(), lens, strict=True):
            numbers = tuple(row[4 : 4 + len(c.distortion)].tolist())
            if numbers == c.distortion:
                out.append(c.fold_r2)
            else:
                out.append(fisheye_fold_limit(numbers) if c.lens == FISHEYE else fold_limit(numbers))
        return np.array(out)


def _chain(by_body: Array, world_from_stand: Pose, stand_from_body: Pose) -> tuple[Array, Array]:
    """Derivatives (N, 2, 6) by world_from_stand and by stand_from_body, from those by world_from_body (N, 2, 6).

    To first order, dt_body = dt_stand - R_stand [t_pose]x dtheta_stand + R_stand dt_pose and

    dtheta_body = R_pose^T dtheta_stand + dtheta_pose.
    """
    R = world_from_stand.rotation
    shift, turn = by_body[..., :3], by_body[..., 3:]
    R_pose_t = np.swapaxes(stand_from_body.rotation, -1, -2)
    by_stand = np.concatenate([shift, turn @ R_pose_t - shift @ R @ skew(stand_from_body.translation)], axis=-1)
    return by_stand, np.concatenate([shift @ R, turn], axis=-1)
