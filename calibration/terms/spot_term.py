"""Pixels of spots as a term of an adjustment: measurements of beams, screens, cameras, the stand and its positions."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace

import numpy as np

from calibration.least_squares.adjustment import Linearised, Loss, Part, Values
from calibration.terms.rig_blocks import BEAMS, BOWS, CAMERAS, INTRINSICS, POSES, SCREENS, STAND, lines_in
from calibration.terms.surveyed import array_of, pose_of
from geometry.arrays import Array, Bools, Ints, skew
from geometry.camera import FISHEYE
from geometry.forward_model import SpotModel
from geometry.lens import fisheye_fold_limit, fold_limit
from geometry.pose import Pose
from geometry.pose_solver.gauss_newton import whiten
from geometry.rig import Rig


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
    _screen_of: Ints = field(init=False)  # (N,)
    _W: Array = field(init=False)  # (N, 2, 2) whitening matrices

    def __post_init__(self) -> None:
        model = SpotModel.of(self.rig)
        screens = list(self.rig.screens)
        screen_of = np.array([screens.index(self.rig.spots[s].screen) for _, s in model.views], dtype=np.int64)
        of_spots = model.subset(self.spots.view)
        arrays = {
            f.name: getattr(of_spots, f.name)[:, None]
            for f in fields(of_spots)
            if f.init and isinstance(getattr(of_spots, f.name), np.ndarray)
        }
        unlimited = np.full_like(arrays["half_size"], np.inf)
        object.__setattr__(self, "_model", replace(of_spots, **{**arrays, "half_size": unlimited}))
        object.__setattr__(self, "_screen_of", screen_of[self.spots.view])
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
        beam, camera, screen = model.beam_of[:, 0], model.camera_of[:, 0], self._screen_of
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
        screen = self._screen_of[:, None]
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
