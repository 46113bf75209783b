"""The forward model of markers on the vehicle that a camera sees directly, for `fit_pose`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geometry import lens
from geometry.arrays import Array, skew
from geometry.camera import FISHEYE, Camera, pinhole_numbers, project_points
from geometry.pose import Pose


@dataclass(frozen=True, slots=True)
class MarkerModel:
    """n markers at known places of the body, and the camera that sees them."""

    markers: Array  # (n, 3), m, in body
    camera: Camera

    def project(self, world_from_body: Pose) -> tuple[Array, Array]:
        """Distorted pixels (n, 2) and their Jacobian (n, 2, 6) by [dt (m, world), dtheta (rad, body)].

        nan behind the camera. A small turn moves a marker at q by -R [q]x dtheta. Source: ours.
        """
        camera_from_world, R = self.camera.camera_from_world, world_from_body.rotation
        pixels, d_point = project_points(
            camera_from_world.apply(world_from_body.apply(self.markers)),
            pinhole_numbers(self.camera),
            lens.padded(self.camera.distortion),
            np.asarray(self.camera.fold_r2),
            np.asarray(self.camera.lens == FISHEYE),
        )
        d_world = d_point @ camera_from_world.rotation
        return pixels, np.concatenate([d_world, -d_world @ R @ skew(self.markers)], axis=-1)
