"""The pose in closed form from whole beams, both of whose spots are seen.

A start for the Gauss-Newton of geometry/pose_solver/gauss_newton.py; from three spots:
geometry/pose_solver/three_spots.py. Source: ours; the rotation from directions is Wahba's problem, solved by scipy
(Kabsch's method).
"""

from __future__ import annotations

import numpy as np

from geometry.arrays import Array, normalised
from geometry.lines import nearest_point
from geometry.pose import Pose


def pose_from_lines(
    beam_points: Array, beam_directions: Array, line_points: Array, line_directions: Array
) -> Pose | None:
    """world_from_body from m >= 2 beams (m, 3), in body, seen as lines (m, 3), in world.

    Directions point the same way along a beam in both. The rotation is Kabsch's on the directions; then every
    line, moved back by its beam's own point, must pass through the body's origin: the nearest point to all
    of them. The beams need not meet. None if all are parallel.
    """
    body, world = normalised(beam_directions), normalised(line_directions)
    if len(body) < 2 or np.linalg.matrix_rank(body, tol=1e-6) < 2:
        return None
    from scipy.spatial.transform import Rotation  # 0.1 s to import: only where it is asked for

    R = Rotation.align_vectors(world, body)[0].as_matrix()
    origin = nearest_point(line_points - beam_points @ R.T, world)
    return None if np.isnan(origin).any() else Pose(R, origin)
