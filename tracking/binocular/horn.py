"""Pose from points in two frames by unit quaternions: Zhou (2020), equations (10) to (18); Horn (1987).

Horn, "Closed-form solution of absolute orientation using unit quaternions", J. Opt. Soc. Am. A 4, 629. The paper does
not print the matrix M of (14); this is Horn's. Maximising (14) is the same as minimising (13); the text names (12) and
(13). The largest eigenvalue is lambda_1 in (18). Two quaternions, q and -q, are one rotation. Three points suffice.
"""

from __future__ import annotations

import numpy as np

from geometry.arrays import Array
from geometry.pose import Pose


def quaternion_matrix(from_body: Array, measured: Array) -> Array:
    """The matrix M (4, 4) with D = q^T M q of equation (14), of centred points (n, 3) in body and measured (n, 3)."""
    S = from_body.T @ measured  # S[i, j] = sum of body_i measured_j
    d = np.array([S[1, 2] - S[2, 1], S[2, 0] - S[0, 2], S[0, 1] - S[1, 0]])
    M = np.empty((4, 4))
    M[0, 0] = np.trace(S)
    M[0, 1:] = M[1:, 0] = d
    M[1:, 1:] = S + S.T - np.trace(S) * np.eye(3)
    return M


def pose_of_points(body: Array, measured: Array) -> Pose:
    """The pose a_from_body with the least sum of squared distances, equation (13).

    body, measured (n, 3), m: the same n >= 3 points in body and in the frame a, not on one line.
    """
    centre_b, centre_m = body.mean(axis=0), measured.mean(axis=0)
    M = quaternion_matrix(body - centre_b, measured - centre_m)
    q = np.linalg.eigh(M)[1][:, -1]
    rotation = Pose.from_quaternion(q, np.zeros(3)).rotation
    return Pose(rotation, centre_m - rotation @ centre_b)
