"""The pose in closed form from beams of which both spots are seen.

It is a start value for geometry/pose_solver/gauss_newton.py. For three single spots see
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
    """world_from_body from m >= 2 beams, in body, observed as lines, in world; points (m, 3), m, directions (m, 3).

    A beam's direction has the same sense in both frames. Kabsch's method on the directions gives the rotation. Each
    line, shifted by its beam's point, then passes through the origin of body, which is the point nearest to all shifted
    lines. The beams need not meet. None if all are parallel.
    """
    body, world = normalised(beam_directions), normalised(line_directions)
    if len(body) < 2 or np.linalg.matrix_rank(body, tol=1e-6) < 2:
        return None
    from scipy.spatial.transform import Rotation  # imported here because the import takes 0.1 s

    R = Rotation.align_vectors(world, body)[0].as_matrix()
    origin = nearest_point(line_points - beam_points @ R.T, world)
    return None if np.isnan(origin).any() else Pose(R, origin)
