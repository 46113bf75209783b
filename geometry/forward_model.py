"""The forward model: from a pose of the vehicle to the pixels of its spots, with Jacobians.

The pose transforms each beam to world, the beam's ray intersects its screen, and the camera projects the lit point. The
solver, the trackers, the simulator and the calibrations all use this model. It has two implementations:

- `SpotModel.project` and `SpotModel.derivatives`, compiled (geometry/compiled_projection.py): pixels and their Jacobian
  by the pose, and by every number of the rig, for solver, trackers, simulator and calibrations;
- `SpotModel.hits`, numpy: lit points with their Jacobian, for drawings and searches.

tests/geometry/test_forward_model.py compares both.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numba
import numpy as np

from geometry.arrays import Array, Bools, Ints, cross
from geometry.camera import FISHEYE, in_picture, pinhole_numbers, project_points_full
from geometry.compiled_projection import VIEW, Views, derivatives_all, lens_codes, project_all
from geometry.lens import padded, tilt_matrix
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
class _Intersection:
    """Intersections of n rays with their screens, for poses (...)."""

    R: Array  # (..., 1, 3, 3) world from body
    t: Array  # (..., n) m, the ray's length to the screen
    hit: Array  # (..., n, 3) m, in world
    oblique: Array  # (..., n, 3, 3) the projection along the ray onto the surface
    good: Bools  # (..., n) whether the ray meets the screen within its extent


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
        camera_names, spot_names, beam_names = list(rig.cameras), list(rig.spots), list(rig.beams)

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

    def hits(self, world_from_body: Pose) -> tuple[Array, Array]:
        """Lit points on the screens, in world (..., n, 3), m, and their Jacobian (..., n, 3, 6).

        The pose may be a stack (...). The Jacobian is with respect to the pose error [dt (m, world), dtheta (rad,
        body)], section 1 of the file contract. nan where a ray is parallel to its screen, points away from it or
        passes beside its extent.
        """
        m = self._intersect(world_from_body)
        return np.where(m.good[..., None], m.hit, np.nan), self._hit_jacobian(m)

    def _hit_jacobian(self, m: _Intersection) -> Array:
        """The Jacobian (..., n, 3, 6) of the lit points, as in `hits`."""
        # A small motion of the ray along itself has no effect, so the motion is projected along the ray:
        # d(hit) = (I - d n^T / (n.d)) (d(p) + t d(d)), and with theta in body: d(p) + t d(d) = dt - R [q]x dtheta,
        # where q = point + t ray is the lit point in body.
        q = self.point + m.t[..., None] * self.ray
        J = np.empty((*m.hit.shape, 6))
        J[..., :3] = m.oblique
        # The columns of -R [q]x are R (e_i x q) = (R e_i) x (R q).
        lever = (m.R @ q[..., None])[..., 0]
        columns = cross(np.swapaxes(m.R, -1, -2), lever[..., None, :])  # (..., n, 3 axes, 3)
        J[..., 3:] = m.oblique @ np.swapaxes(columns, -1, -2)
        return J

    def _intersect(self, world_from_body: Pose) -> _Intersection:
        """Intersections of the rays with their screens."""
        R = world_from_body.rotation[..., None, :, :]
        p = (R @ self.point[..., None])[..., 0] + world_from_body.translation[..., None, :]
        d = (R @ self.ray[..., None])[..., 0]
        normal = self.screen_rotation[..., 2]
        facing = np.sum(normal * d, axis=-1)
        height = np.sum(normal * (self.screen_origin - p), axis=-1)
        ahead = np.abs(facing) > 1e-12
        t = height / np.where(ahead, facing, 1.0)
        if self.bow.any():
            t, normal = self._intersect_bent(p, d, t)
            facing = np.sum(normal * d, axis=-1)
        hit = p + t[..., None] * d
        on_screen = ((hit - self.screen_origin)[..., None, :] @ self.screen_rotation)[..., 0, :]
        good = ahead & (t > 0) & np.all(np.abs(on_screen[..., :2]) <= self.half_size, axis=-1)
        along = np.where(ahead, facing, 1.0)
        oblique = np.eye(3) - d[..., :, None] * normal[..., None, :] / along[..., None, None]
        return _Intersection(R, t, hit, oblique, good)

    def _intersect_bent(self, p: Array, d: Array, t: Array) -> tuple[Array, Array]:
        """Lengths (..., n), m, of rays to bent screens, and the surface normals there (..., n, 3), in world.

        p, d: (..., n, 3), m and unit, in world; t (..., n), m: lengths to the flat screens. Newton's method from there:
        a bow of centimetres over metres converges to rounding in two or three steps; the fourth is for larger bows.
        """
        a, b, c = np.moveaxis(self.bow, -1, 0)
        p_s = ((p - self.screen_origin)[..., None, :] @ self.screen_rotation)[..., 0, :]
        d_s = (d[..., None, :] @ self.screen_rotation)[..., 0, :]
        for _ in range(4):
            x, y = p_s[..., 0] + t * d_s[..., 0], p_s[..., 1] + t * d_s[..., 1]
            height = p_s[..., 2] + t * d_s[..., 2] - (a * x * x + b * x * y + c * y * y)
            slope = d_s[..., 2] - (2 * a * x + b * y) * d_s[..., 0] - (b * x + 2 * c * y) * d_s[..., 1]
            t = t - height / np.where(np.abs(slope) > 1e-12, slope, 1.0)
        x, y = p_s[..., 0] + t * d_s[..., 0], p_s[..., 1] + t * d_s[..., 1]
        normal = np.stack([-(2 * a * x + b * y), -(b * x + 2 * c * y), np.ones_like(x)], axis=-1)
        return t, (self.screen_rotation @ normal[..., None])[..., 0]

    def project(self, world_from_body: Pose) -> tuple[Array, Array]:
        """Distorted pixels (..., n, 2) and their Jacobian (..., n, 2, 6), px per m and px per rad.

        nan where no projection exists: the beam misses its screen, or the lit point lies behind the camera or beyond
        the fold of its lens. Pixels outside the picture are returned too. The pose and the Jacobian are as in `hits`.
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
