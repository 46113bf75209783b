"""A closed form for one whole beam and one more spot: an independent solution for some cases of
geometry/pose_solver/three_spots.py.
"""

from __future__ import annotations

import numpy as np

from geometry.arrays import Array, cross, normalised
from geometry.pose import Pose


def poses_from_line_and_spot(
    beam_point: Array,
    beam_direction: Array,
    line_point: Array,
    line_direction: Array,
    other_point: Array,
    other_ray: Array,
    spot_world: Array,
) -> Pose:
    """Both poses (..., 2) that put a beam on a known line, and the ray of another beam through a known point.

    beam_*, (3,): the whole beam, in body; line_*, (..., 3): the line that it lies on, in world, pointing the same way;
    other_point, other_ray (3,): the other ray, in body; spot_world (..., 3): where it lands, in world.

    A turn about the line and a slide along it remain free. Seen from the beam's axis, the point `other_point + l ray`
    has the distance rho of the landing point for at most two l: a quadratic. Then the axial coordinates give
    the slide and the azimuths the turn. nan where no l > 0 does it.
    """
    d = normalised(beam_direction)
    e = normalised(line_direction)
    # Cylinder coordinates about the axis: in world of the landing point, in body of the ray.
    from_line = spot_world - line_point
    height_world = np.sum(from_line * e, axis=-1)
    radial_world = from_line - height_world[..., None] * e
    offset = other_point - beam_point
    a_perp = offset - (offset @ d) * d
    r_perp = other_ray - (other_ray @ d) * d
    A = r_perp @ r_perp
    B = a_perp @ r_perp
    C = a_perp @ a_perp - np.sum(radial_world * radial_world, axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        root = np.sqrt(B * B - A * C)
        along = np.stack([(-B + root) / A, (-B - root) / A], axis=-1)  # (..., 2)
        along = np.where(along > 0, along, np.nan)
        on_ray = offset + along[..., None] * other_ray  # from the beam's point, in body
        height_body = on_ray @ d
        radial_body = on_ray - height_body[..., None] * d
        body_axes = _frame(np.broadcast_to(d, radial_body.shape), radial_body)
        world_axes = _frame(
            np.broadcast_to(e[..., None, :], radial_body.shape),
            np.broadcast_to(radial_world[..., None, :], radial_body.shape),
        )
        R = world_axes @ np.swapaxes(body_axes, -1, -2)
        # The beam's point lies on the line, `height_world - height_body` along it.
        anchor = line_point[..., None, :] + (height_world[..., None] - height_body)[..., None] * e[..., None, :]
        return Pose(R, anchor - (R @ beam_point[..., None])[..., 0])


def _frame(axis: Array, across: Array) -> Array:
    """Orthonormal frames (..., 3, 3) as columns: the axis, the direction across it, and their cross product."""
    u = normalised(across)
    return np.stack([axis, u, cross(axis, u)], axis=-1)
