"""The forward model: from a pose of the vehicle to the pixels of its spots, with Jacobians.

The pose transforms each beam to world, the beam's ray intersects its screen, and the camera projects the lit point. The
solver, the trackers, the simulator and the calibrations all use this model, compiled (geometry/compiled_projection.py):

- `SpotModel.hits`: lit points on the screens, for drawings and searches;
- `SpotModel.project`: pixels and their Jacobian by the pose, for solver, trackers and simulator;
- `SpotModel.derivatives`: the Jacobian by every number of the rig as well, for calibrations.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numba
import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.camera import FISHEYE, in_picture, pinhole_numbers, project_points_full
from geometry.compiled_projection import VIEW, Views, derivatives_all, lens_codes, lit_points, project_all
from geometry.lens import padded, tilt_matrix
from geometry.planes import intersect_plane, screen_to_world
from geometry.pose import Pose
from geometry.rig import Rig


@dataclass(frozen=True, slots=True)
class SpotDerivatives:
    """Pixels of n views and their derivatives by every number of the rig, px per unit.

    The error of a transform a_from_b is [dt (m, in a), dtheta (rad, in b)], section 1 of the file contract.
    """

    pixels: Array  # (..., n, 2); nan where there is no projection
    pose: Array  # (..., n, 2, 6) of world_from_body
    pinhole: Array  # (..., n, 2, 4) of the camera's fx, fy, cx, cy
    distortion: Array  # (..., n, 2, 14) of its distortion
    camera: Array  # (..., n, 2, 6) of camera_from_world
    screen: Array  # (..., n, 2, 6) of world_from_screen
    bow: Array  # (..., n, 2, 3) of the screen's bow
    direction: Array  # (..., n, 2, 3) of the beam's direction, in body; 0 along the beam
    point: Array  # (..., n, 2, 3) of the beam's point, m, in body; 0 along the beam


@dataclass(frozen=True, slots=True)
class SpotModel:
    """A rig as arrays with one row per view: a camera and a spot of the screen that it observes.

    The n views have the order of Rig.views(): by camera, then by spot.
    """

    views: tuple[tuple[str, str], ...]  # (camera, spot)
    camera_names: tuple[str, ...]
    spot_names: tuple[str, ...]
    camera_of: Ints  # (n,) index into camera_names
    spot_of: Ints  # (n,) index into spot_names
    screen_of: Ints  # (n,) index into the rig's screens
    beam_of: Ints  # (n,) index into the rig's beams
    point: Array  # (n, 3), m, in body: the beam's point
    ray: Array  # (n, 3), unit, in body: from that point towards the spot
    sign: Array  # (n,) +1 where the ray runs along the beam's direction, -1 against it
    screen_rotation: Array  # (n, 3, 3), world from screen
    screen_origin: Array  # (n, 3), m, in world
    bow: Array  # (n, 3), 1/m, of the screen's surface; all 0: flat
    half_size: Array  # (n, 2), m, half the extent of the screen; inf where it has none
    camera_rotation: Array  # (n, 3, 3), camera from world
    camera_translation: Array  # (n, 3), m
    pinhole: Array  # (n, 4): fx, fy, cx, cy, px
    distortion: Array  # (n, 14)
    fisheye: Bools  # (n,)
    fold_r2: Array  # (n,)
    image_size_px: Array  # (n, 2): width, height
    numbers: Views = field(init=False, repr=False, compare=False)  # the same as records, for the compiled functions

    def __post_init__(self) -> None:
        lens = lens_codes(self.distortion, self.fisheye)
        tilt = tilt_matrix(self.distortion[..., 12], self.distortion[..., 13])
        numbers = np.empty(self.point.shape[:-1], VIEW)
        others = {"lens": lens, "tilt": tilt, "shift": 0.0}
        for name in VIEW.names or ():
            numbers[name] = others[name] if name in others else getattr(self, name)
        settings: Any = numba.config
        if settings.DISABLE_JIT:  # compiled code reads fields as attributes; plain Python needs a recarray for that
            numbers = numbers.view(np.recarray)
        object.__setattr__(self, "numbers", numbers)

    @staticmethod
    def of(rig: Rig) -> SpotModel:
        """The arrays of a rig."""
        views = rig.views()
        cameras = [rig.cameras[c] for c, _ in views]
        spots = [rig.spots[s] for _, s in views]
        beams = [rig.beams[s.beam] for s in spots]
        screens = [rig.screens[s.screen] for s in spots]
        camera_names, spot_names = list(rig.cameras), list(rig.spots)
        screen_names, beam_names = list(rig.screens), list(rig.beams)

        def rows(values: list[Array], width: int) -> Array:
            return np.array(values, dtype=float).reshape(len(views), width)

        def matrices(values: list[Array]) -> Array:
            return np.array(values, dtype=float).reshape(len(views), 3, 3)

        return SpotModel(
            views=tuple(views),
            camera_names=tuple(camera_names),
            spot_names=tuple(spot_names),
            camera_of=np.array([camera_names.index(c) for c, _ in views], dtype=np.int64),
            spot_of=np.array([spot_names.index(s) for _, s in views], dtype=np.int64),
            screen_of=np.array([screen_names.index(s.screen) for s in spots], dtype=np.int64),
            beam_of=np.array([beam_names.index(b.name) for b in beams], dtype=np.int64),
            point=rows([b.point for b in beams], 3),
            ray=rows([s.sign * b.direction for s, b in zip(spots, beams, strict=True)], 3),
            sign=np.array([s.sign for s in spots], dtype=float),
            screen_rotation=matrices([s.world_from_screen.rotation for s in screens]),
            screen_origin=rows([s.world_from_screen.translation for s in screens], 3),
            bow=rows([np.asarray(s.bow, dtype=float) for s in screens], 3),
            half_size=rows([np.full(2, np.inf) if s.size_m is None else np.asarray(s.size_m) / 2 for s in screens], 2),
            camera_rotation=matrices([c.camera_from_world.rotation for c in cameras]),
            camera_translation=rows([c.camera_from_world.translation for c in cameras], 3),
            pinhole=rows([pinhole_numbers(c) for c in cameras], 4),
            distortion=rows([padded(c.distortion) for c in cameras], 14),
            fisheye=np.array([c.lens == FISHEYE for c in cameras], dtype=bool),
            fold_r2=np.array([c.fold_r2 for c in cameras]),
            image_size_px=rows([np.asarray(c.image_size_px, dtype=float) for c in cameras], 2),
        )

    def __len__(self) -> int:
        return len(self.views)

    def subset(self, rows: Ints | Bools) -> SpotModel:
        """Some of the views, in the given order."""
        index = np.flatnonzero(rows) if np.asarray(rows).dtype == bool else np.asarray(rows, dtype=np.int64)
        per_view = {
            name: getattr(self, name)[index]
            for name in SpotModel.__slots__
            if name not in ("views", "camera_names", "spot_names", "numbers")
        }
        return SpotModel(
            views=tuple(self.views[i] for i in index),
            camera_names=self.camera_names,
            spot_names=self.spot_names,
            **per_view,
        )

    def hits(self, world_from_body: Pose) -> Array:
        """Lit points on the screens, in world (..., n, 3), m. The pose may be a stack (...).

        nan where a ray is parallel to its screen, points away from it or passes beside its extent.
        """
        R, t, stack = _stacked(world_from_body)
        return np.asarray(lit_points(self.numbers, R, t).reshape(*stack, len(self), 3))

    def project(self, world_from_body: Pose) -> tuple[Array, Array]:
        """Distorted pixels (..., n, 2) and their Jacobian (..., n, 2, 6), px per m and px per rad.

        nan where no projection exists: the beam misses its screen, or the lit point lies behind the camera or beyond
        the fold of its lens. Pixels outside the picture are returned too. The pose may be a stack (...). The Jacobian
        is with respect to the pose error [dt (m, world), dtheta (rad, body)], section 1 of the file contract.
        """
        R, t, stack = _stacked(world_from_body)
        uv, J = project_all(self.numbers, R, t)
        n = len(self)
        return uv.reshape(*stack, n, 2), J.reshape(*stack, n, 2, 6)

    def derivatives(self, world_from_body: Pose, of_lens: bool = True) -> SpotDerivatives:
        """As `project`, with the derivatives by everything in the rig that a calibration determines.

        The pose may be a stack (...); of a model whose arrays have rows (k, n, ...), pose i sees the views of row i.
        Without a projection the pixel is nan and the derivatives are undefined.
        of_lens: whether those by the numbers of the lenses are needed; otherwise they are 0.
        """
        R, t, stack = _stacked(world_from_body, self.numbers.shape[:-1])
        n = self.numbers.shape[-1]
        arrays = derivatives_all(self.numbers.reshape(-1, n), self.sign.reshape(-1, n), R, t)
        uv, pose, camera, screen, bow, direction, point, in_camera = (a.reshape(*stack, *a.shape[1:]) for a in arrays)
        if of_lens:
            projected = project_points_full(in_camera, self.pinhole, self.distortion, self.fold_r2, self.fisheye)
            lens = projected.d_pinhole, projected.d_distortion
        else:
            lens = np.zeros((*uv.shape, 4)), np.zeros((*uv.shape, 14))
        return SpotDerivatives(uv, pose, *lens, camera, screen, bow, direction, point)

    def in_picture(self, pixels: Array, margin_px: float = 0.0) -> Bools:
        """Whether pixels (..., n, 2) lie in their cameras' pictures, or at most the margin outside; False for nan."""

        return in_picture(pixels, self.image_size_px, margin_px)


def _stacked(poses: Pose, rows: tuple[int, ...] = ()) -> tuple[Array, Array, tuple[int, ...]]:
    """Rotations (m, 3, 3) and translations (m, 3), m, of a stack of poses, and the shape of the stack.

    rows: a shape that the stack must have at least.
    """
    R, t = poses.rotation, poses.translation
    stack = R.shape[:-2]
    if stack != t.shape[:-1] or len(stack) < len(rows):
        stack = np.broadcast_shapes(stack, t.shape[:-1], rows)
        R, t = np.broadcast_to(R, (*stack, 3, 3)), np.broadcast_to(t, (*stack, 3))
    # Copies, because read-only arrays have another type for numba, which would compile a second time for them.
    return (
        np.array(R, dtype=np.float64, order="C").reshape(-1, 3, 3),
        np.array(t, dtype=np.float64, order="C").reshape(-1, 3),
        stack,
    )


def points_on_screens(rig: Rig, view: Ints, pixels: Array) -> Array:
    """World points (N, 3), m, on the planes of the screens, of pixels (N, 2) of some views (N,); nan for nan."""
    out = np.full((len(pixels), 3), np.nan)
    for v, (camera, spot) in enumerate(rig.views()):
        rows = np.flatnonzero((view == v) & ~np.isnan(pixels[:, 0]))
        if len(rows):
            screen = rig.screens[rig.spots[spot].screen].world_from_screen
            out[rows] = screen_to_world(intersect_plane(*rig.cameras[camera].rays(pixels[rows]), screen), screen)
    return out
