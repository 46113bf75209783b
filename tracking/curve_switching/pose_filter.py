"""Positions of spots outside the image, and the filter of the pose for frames that do not determine it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geometry import rotations
from geometry.arrays import Array, symmetric
from geometry.forward_model import SpotModel
from geometry.planes import common_perpendicular, intersect_plane, screen_to_world
from geometry.pose import Pose
from geometry.pose_solver.closed_form import meeting_point, middle_spot, outer_spot
from geometry.rig import Rig

# The paper's positions of spots outside the image, for rigs with coplanar beams that meet in one point.
#
# Source: Huo, Yang & Yang 2015, section 4.2; the formulas, eqs. (10) to (14), are in
# geometry/pose_solver/closed_form.py.

MEETING_TOLERANCE_M = 1e-3  # beams with a larger distance between their lines do not meet in one point
COPLANAR_TOLERANCE = 1e-3  # rad: largest angle between a beam and the plane of the other two


@dataclass(frozen=True, slots=True)
class Construction:
    """How the position of one view follows from four others. The views are rows of the model."""

    target: int
    first: int  # A: view of a neighbouring beam on the same screen and camera
    second: int  # B (outer target) or C (middle target), also on that screen and camera
    first_opposite: int  # views of the other ends of the two beams: the two lines meet in O
    second_opposite: int
    middle: bool  # the target's beam lies between the two others
    alpha: float  # rad: angle from A's beam to B's (outer), or from A's to the target's (middle)
    beta: float  # rad: angle from B's beam to the target's (outer), or from the target's to C's (middle)


@dataclass(frozen=True, slots=True)
class CoplanarViews:
    """All constructions of a rig; empty if no three beams are coplanar and meet in one point."""

    constructions: tuple[Construction, ...]

    @staticmethod
    def of(rig: Rig, model: SpotModel) -> CoplanarViews:
        """Find every view that follows from two beams of which both ends are observed."""
        opposite = _opposites(model)
        constructions: list[Construction] = []
        for target in range(len(model)):
            same = [
                v
                for v in range(len(model))
                if v != target and model.camera_of[v] == model.camera_of[target] and v in opposite
            ]
            for a in same:
                for b in same:
                    if a != b and _meet(model, target, a) and _meet(model, target, b) and _meet(model, a, b):
                        construction = _construction(model, target, a, b, opposite)
                        if construction is not None:
                            constructions.append(construction)
        return CoplanarViews(tuple(constructions))


def quadratic_positions(rig: Rig, model: SpotModel, coplanar_views: CoplanarViews, uv_px: Array) -> Array:
    """Pixels (n, 2) of the unmatched views that follow from the matched ones; nan for all other views.

    uv_px (n, 2): pixels of the matched views, nan for the others. Source: section 4.2, with O from both lines, eq. (10)
    to (14) for an outer beam and a rotation (ours) for a middle beam.
    """
    out = np.full((len(model), 2), np.nan)
    world = None
    for r in coplanar_views.constructions:
        required = [r.first, r.second, r.first_opposite, r.second_opposite]
        if not np.isnan(uv_px[r.target, 0]) or np.isnan(uv_px[required, 0]).any() or not np.isnan(out[r.target, 0]):
            continue
        world = _on_screens(rig, model, uv_px) if world is None else world
        A, B, A2, B2 = (world[v] for v in required)
        O = meeting_point(A, A - A2, B, B - B2)
        camera = rig.cameras[model.views[r.target][0]]
        screen = rig.screens[camera.screen].world_from_screen
        if r.middle:
            spot = middle_spot(O, A, B, r.alpha, r.beta, screen)
        else:
            spot = outer_spot(O, A, B, r.alpha, r.beta)
        if not np.isnan(spot).any():
            out[r.target] = camera.project(spot)
    return out


def _opposites(model: SpotModel) -> dict[int, int]:
    """For each view a view of the other end of its beam, where one exists."""
    out: dict[int, int] = {}
    for i in range(len(model)):
        for j in range(len(model)):
            if model.beam_of[i] == model.beam_of[j] and model.ray[i] @ model.ray[j] < 0:
                out.setdefault(i, j)
    return out


def _meet(model: SpotModel, a: int, b: int) -> bool:
    """Whether the beams of two views are different beams that pass through one point."""
    if model.beam_of[a] == model.beam_of[b]:
        return False
    on_a, on_b = common_perpendicular(model.point[a], model.ray[a], model.point[b], model.ray[b])
    return bool(np.linalg.norm(on_a - on_b) < MEETING_TOLERANCE_M)


def _construction(model: SpotModel, target: int, a: int, b: int, opposite: dict[int, int]) -> Construction | None:
    """The construction of the target from beams a and b, if the three are coplanar and in the order that it needs."""
    ra, rb, rt = model.ray[a], model.ray[b], model.ray[target]
    meeting = [common_perpendicular(model.point[v], model.ray[v], model.point[a], ra)[0] for v in (b, target)]
    if np.linalg.norm(meeting[0] - meeting[1]) > MEETING_TOLERANCE_M:
        return None
    normal = np.cross(ra, rb)
    normal /= np.linalg.norm(normal)
    if abs(float(normal @ rt)) > COPLANAR_TOLERANCE:
        return None
    across = np.cross(normal, ra)

    def angle_from_a(ray: Array) -> float:
        return float(np.arctan2(ray @ across, ray @ ra))

    at_b, at_t = angle_from_a(rb), angle_from_a(rt)
    ends = opposite[a], opposite[b]
    if 0 < at_b < at_t < np.pi / 2:
        return Construction(target, a, b, *ends, False, at_b, at_t - at_b)
    if 0 < at_t < at_b < np.pi / 2:
        return Construction(target, a, b, *ends, True, at_t, at_b - at_t)
    return None


def _on_screens(rig: Rig, model: SpotModel, uv_px: Array) -> Array:
    """World points (n, 3), m, on the screens, of the views' pixels (n, 2); nan where the pixel is nan."""
    out = np.full((len(model), 3), np.nan)
    for c, name in enumerate(model.camera_names):
        rows = np.flatnonzero((model.camera_of == c) & ~np.isnan(uv_px[:, 0]))
        camera = rig.cameras[name]
        screen = rig.screens[camera.screen].world_from_screen
        origin, rays = camera.rays(uv_px[rows])
        out[rows] = screen_to_world(intersect_plane(origin, rays, screen), screen)
    return out


# The Kalman filter of the vehicle's pose: constant velocity on R3 x SO(3), for frames that do not determine the pose.
#
# Error state (12): [dt (m, world), dtheta (rad, body), dv (m/s, world), domega (rad/s, body)]. Source: ours; the
# error-state form of Sola (2017), "Quaternion kinematics for the error-state Kalman filter", sec. 5, without the
# inertial sensors.


@dataclass(frozen=True, slots=True)
class RigidMotion:
    """Pose and velocities with their covariance."""

    world_from_body: Pose
    velocity: Array  # (3,), m/s, world
    rate: Array  # (3,), rad/s, body
    P: Array  # (12, 12) of the error state

    @property
    def twist(self) -> Array:
        """(6,): time derivative of the pose's error coordinates; a pixel Jacobian (.., 6) times it is px/s."""
        return np.concatenate([self.velocity, self.rate])

    @property
    def covariance(self) -> Array:
        """(6, 6) of the pose alone."""
        return self.P[:6, :6]


def begin(pose: Pose, covariance: Array, sigma_velocity_m_s: float = 3.0, sigma_rate_rad_s: float = 3.0) -> RigidMotion:
    """The initial state: a pose with covariance (6, 6), velocities of zero with wide sigmas."""
    P = np.zeros((12, 12))
    P[:6, :6] = covariance
    P[6:9, 6:9] = sigma_velocity_m_s**2 * np.eye(3)
    P[9:, 9:] = sigma_rate_rad_s**2 * np.eye(3)
    return RigidMotion(pose, np.zeros(3), np.zeros(3), P)


def predict(motion: RigidMotion, dt_s: float, sigma_a_m_s2: float, sigma_a_rad_s2: float) -> RigidMotion:
    """The prediction over one time step, with white accelerations (1 sigma) that are constant within the step."""
    turn = motion.rate * dt_s
    pose = motion.world_from_body.plus(np.concatenate([motion.velocity * dt_s, turn]))
    F = np.eye(12)
    F[:3, 6:9] = dt_s * np.eye(3)
    F[3:6, 3:6] = rotations.exp(-turn)
    F[3:6, 9:] = dt_s * rotations.right_jacobian(turn)
    Q = np.zeros((12, 12))
    a2 = np.repeat([sigma_a_m_s2**2, sigma_a_rad_s2**2], 3)
    i = np.arange(6)
    Q[i, i] = a2 * dt_s**4 / 4
    Q[i, i + 6] = Q[i + 6, i] = a2 * dt_s**3 / 2
    Q[i + 6, i + 6] = a2 * dt_s**2
    return RigidMotion(pose, motion.velocity, motion.rate, symmetric(F @ motion.P @ F.T + Q))


def update(motion: RigidMotion, y: Array, H: Array, R: Array) -> tuple[RigidMotion, Array]:
    """The update with a measurement; also the innovation covariance S (k, k).

    y (k,): innovation; H (k, 6): its Jacobian with respect to the pose; R (k, k): measurement covariance.
    """
    PH = motion.P[:, :6] @ H.T
    S = H @ PH[:6] + R
    K = np.linalg.solve(S, PH.T).T
    keep = np.eye(12)
    keep[:, :6] -= K @ H
    P = symmetric(keep @ motion.P @ keep.T + K @ R @ K.T)
    d = K @ y
    return (
        RigidMotion(motion.world_from_body.plus(d[:6]), motion.velocity + d[6:9], motion.rate + d[9:], P),
        S,
    )


def update_with_pose(motion: RigidMotion, pose: Pose, covariance: Array) -> tuple[RigidMotion, Array, Array]:
    """The update with a measured pose, covariance (6, 6); also the innovation (6,) and its covariance (6, 6)."""
    y = pose.minus(motion.world_from_body)
    after, S = update(motion, y, np.eye(6), covariance)
    return after, y, S
