"""The one forward model: from a pose of the vehicle to the pixels of its spots, with the Jacobian.

A pose puts each beam into world; its ray meets its screen; the camera sees the point of light. The solver, the
trackers, the spots out of view and the simulator all use this and nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geometry.arrays import Array, Bools, Ints, cross
from geometry.camera import in_picture, pinhole_numbers, project_points
from geometry.lens import padded
from geometry.pose import Pose
from geometry.rig import Rig


@dataclass(frozen=True, slots=True)
class SpotModel:
    """A rig unrolled into arrays, one row per view: a camera and a spot of the screen that it observes.

    n views, in the order of Rig.views(): by camera, then by spot.
    """

    views: tuple[tuple[str, str], ...]  # (camera, spot)
    camera_names: tuple[str, ...]
    spot_names: tuple[str, ...]
    camera_of: Ints  # (n,) index into camera_names
    spot_of: Ints  # (n,) index into spot_names
    beam_of: Ints  # (n,) index into the rig's beams
    point: Array  # (n, 3), m, in body: the beam's point
    ray: Array  # (n, 3), unit, in body: from that point towards the spot
    screen_rotation: Array  # (n, 3, 3), world from screen
    screen_origin: Array  # (n, 3), m, in world
    half_size: Array  # (n, 2), m, half the extent of the screen; inf where it has none
    camera_rotation: Array  # (n, 3, 3), camera from world
    camera_translation: Array  # (n, 3), m
    pinhole: Array  # (n, 4): fx, fy, cx, cy, px
    distortion: Array  # (n, 14)
    fold_r2: Array  # (n,)
    image_size_px: Array  # (n, 2): width, height

    @staticmethod
    def of(rig: Rig) -> SpotModel:
        """Unroll a rig."""
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
            screen_rotation=matrices([s.world_from_screen.rotation for s in screens]),
            screen_origin=rows([s.world_from_screen.translation for s in screens], 3),
            half_size=rows([np.full(2, np.inf) if s.size_m is None else np.asarray(s.size_m) / 2 for s in screens], 2),
            camera_rotation=matrices([c.camera_from_world.rotation for c in cameras]),
            camera_translation=rows([c.camera_from_world.translation for c in cameras], 3),
            pinhole=rows([pinhole_numbers(c) for c in cameras], 4),
            distortion=rows([padded(c.distortion) for c in cameras], 14),
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
            if name not in ("views", "camera_names", "spot_names")
        }
        return SpotModel(
            views=tuple(self.views[i] for i in index),
            camera_names=self.camera_names,
            spot_names=self.spot_names,
            **per_view,
        )

    def hits(self, world_from_body: Pose) -> tuple[Array, Array]:
        """Where the rays meet their screens: world points (..., n, 3), m, and their Jacobian (..., n, 3, 6).

        The pose may be a stack (...). The Jacobian is with respect to the pose error [dt (m, world), dtheta (rad,
        body)], section 1 of the files' contract. A ray that is parallel to its screen, points away from it or falls
        beside its extent gives nan.
        """
        R = world_from_body.rotation[..., None, :, :]
        p = (R @ self.point[..., None])[..., 0] + world_from_body.translation[..., None, :]
        d = (R @ self.ray[..., None])[..., 0]
        normal = self.screen_rotation[..., 2]
        facing = np.sum(normal * d, axis=-1)
        height = np.sum(normal * (self.screen_origin - p), axis=-1)
        ahead = np.abs(facing) > 1e-12
        t = height / np.where(ahead, facing, 1.0)
        hit = p + t[..., None] * d
        on_screen = ((hit - self.screen_origin)[..., None, :] @ self.screen_rotation)[..., 0, :2]
        good = ahead & (t > 0) & np.all(np.abs(on_screen) <= self.half_size, axis=-1)

        # Along the ray a small move changes nothing, so only what the move does across the ray counts:
        # d(hit) = (I - d n^T / (n.d)) (d(p) + t d(d)), and with theta in body: d(p) + t d(d) = dt - R [q]x dtheta,
        # q = point + t ray the lit point in body.
        oblique = np.eye(3) - d[..., :, None] * normal[..., None, :] / np.where(ahead, facing, 1.0)[..., None, None]
        q = self.point + t[..., None] * self.ray
        J = np.empty((*hit.shape, 6))
        J[..., :3] = oblique
        # The columns of -R [q]x are R (e_i x q) = (R e_i) x (R q).
        lever = (R @ q[..., None])[..., 0]
        columns = cross(np.swapaxes(R, -1, -2), lever[..., None, :])  # (..., n, 3 axes, 3)
        J[..., 3:] = oblique @ np.swapaxes(columns, -1, -2)
        return np.where(good[..., None], hit, np.nan), J

    def project(self, world_from_body: Pose) -> tuple[Array, Array]:
        """Distorted pixels (..., n, 2) and their Jacobian (..., n, 2, 6), px per m and px per rad.

        nan where no projection exists: the beam misses its screen, or the point lies beyond what the lens model
        maps. Pixels outside the picture are given as well. Jacobian as in `hits`.
        """
        hit, J_hit = self.hits(world_from_body)
        in_camera = (self.camera_rotation @ hit[..., None])[..., 0] + self.camera_translation
        missed = np.isnan(in_camera[..., 2])
        in_camera = np.where(missed[..., None], [0.0, 0.0, 1.0], in_camera)
        pixels, J_pixel = project_points(in_camera, self.pinhole, self.distortion, self.fold_r2)
        return np.where(missed[..., None], np.nan, pixels), J_pixel @ (self.camera_rotation @ J_hit)

    def in_picture(self, pixels: Array, margin_px: float = 0.0) -> Bools:
        """Whether pixels (..., n, 2) lie in their cameras' pictures, or at most the margin outside. nan does not."""
        return in_picture(pixels, self.image_size_px, margin_px)
