"""Expected calibration errors of a rig that has not been built yet.

The usual procedure is assumed: the lens of each camera is calibrated with a board, then the camera's pose by resection
on surveyed dots of its own screen, with the calibrated lens. The error of a lens is therefore correlated with that of
the pose, which compensates for most of it: of the effect of a wrong principal point on the attitude, a fortieth
remains. Screens, beams and lenses of different cameras have independent errors. Source: ours; first-order propagation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibration.budget.pose_budget import CAMERA_POSES, GROUPS, INTRINSICS, RigErrors, group_of
from geometry.arrays import Array, skew, symmetric
from geometry.camera import FISHEYE, Camera, Projected, pinhole_numbers, project_points_full
from geometry.lens import padded
from geometry.planes import intersect_plane
from geometry.rig import Rig, Screen
from geometry.uncertainty.rig_uncertainty import (
    DIRECTION,
    PINHOLE,
    POINT,
    POSE,
    RigCovariance,
    distortion_names,
    rig_names,
    split_name,
)

_FEWEST_DOTS = 4  # required for a resection: three dots allow four poses


@dataclass(frozen=True, slots=True)
class ExpectedErrors:
    """Standard deviations reached by a careful calibration."""

    focal_relative: float = 2e-4  # of fx and of fy: 25 tilted boards with corners to 0.1 px
    centre_px: float = 0.3  # of cx and of cy: the same boards
    distortion_px: float = 0.2  # all distortion coefficients together, at the picture's corners: the same boards
    dots: int = 20  # on a screen, evenly spread over the camera's picture, for the camera's pose
    dot_px: float = 0.1  # of a dot's centre in the picture
    dot_survey_m: float = 0.0002  # of a dot's position, per axis: total station
    camera_position_m: float = 0.002  # per axis, only for a camera without dots on its screen: by measuring tape
    camera_rotation_deg: float = 0.05  # likewise: by a board
    screen_position_m: float = 0.0001  # per axis: a plane through 20 surveyed dots of 0.2 mm, with some flatness error
    screen_rotation_deg: float = 0.004  # per axis: the same dots over 3 m
    beam_direction_arcsec: float = 15.0  # per axis across the beam: 40 stand poses, spots to 0.2 mm
    beam_point_m: float = 0.0001  # per axis across the beam: the same


def expected_errors(
    rig: Rig, expected: ExpectedErrors, stated: RigCovariance | None = None, whole: bool = False
) -> tuple[RigErrors, dict[str, str]]:
    """The errors of a rig's parameters, and the source of each group: `rig file` or `assumed`.

    stated: covariance in the rig file. A group with any parameter in it is taken from there; the others are assumed,
    unless the stated covariance is complete (whole).
    """
    names = rig_names(rig)
    if stated is not None:
        names += tuple(n for n in stated.names if n not in names)
    at = {name: i for i, name in enumerate(names)}
    p = len(names)
    stated_groups = {group_of(n) for n in stated.names} if stated else set()
    groups = {g: np.zeros((p, p)) for g in GROUPS}
    if stated is not None:
        for group in stated_groups:
            own = [i for i, n in enumerate(stated.names) if group_of(n) == group]
            place = [at[stated.names[i]] for i in own]
            groups[group][np.ix_(place, place)] = stated.matrix[np.ix_(own, own)]
    if not whole:
        for members, C in _alone(rig, expected):
            if group_of(members[0]) not in stated_groups:
                place = [at[n] for n in members]
                groups[group_of(members[0])][np.ix_(place, place)] = C
    joint = _joint(stated, at, p) if stated else np.zeros((p, p))
    # Joint effect of one parameter's error: the parameter itself and, for a lens, the pose of its camera.
    follow = np.eye(p)
    if not whole and CAMERA_POSES not in stated_groups:
        for name, camera in rig.cameras.items():
            lens_at = [at[f"cameras.{name}.{n}"] for n in (*PINHOLE, *distortion_names(camera))]
            pose_at = [at[f"cameras.{name}.{n}"] for n in POSE]
            found = _resection(camera, rig.screens[camera.screen], expected)
            if found is not None:
                noise, by_lens = found
                follow[np.ix_(pose_at, lens_at)] = by_lens
                groups[CAMERA_POSES][np.ix_(pose_at, pose_at)] = noise
    sigmas = np.sqrt(np.maximum(np.diagonal(sum(groups.values(), np.zeros((p, p)))), 0.0))
    things = _things(names, groups, follow)
    groups[INTRINSICS] = symmetric(follow @ groups[INTRINSICS] @ follow.T)
    kept = {g: C for g, C in groups.items() if C.any()}
    errors = RigErrors(
        names=names,
        covariance=sum(kept.values(), np.zeros((p, p))) + joint,
        groups=kept,
        moves=follow * sigmas,
        move_names=names,
        move_sigmas=sigmas,
        things=things,
    )
    return errors, {g: "rig file" if g in stated_groups else "assumed" for g in kept}


def _things(names: Sequence[str], groups: dict[str, Array], follow: Array) -> list[tuple[str, str, Array]]:
    """The groups' covariances split by camera, screen and beam; those of lenses include their effect on the pose."""
    owner = np.array([".".join(split_name(n)[:2]) for n in names])
    out = []
    for group, C in groups.items():
        for thing in dict.fromkeys(owner.tolist()):
            own = owner == thing
            part = np.where(own[:, None] & own[None, :], C, 0.0)
            if part.any():
                out.append((thing, group, follow @ part @ follow.T if group == INTRINSICS else part))
    return out


def _joint(stated: RigCovariance, at: dict[str, int], p: int) -> Array:
    """Covariance between parameters of different groups (p, p)."""
    group = np.array([group_of(n) for n in stated.names])
    place = [at[n] for n in stated.names]
    out = np.zeros((p, p))
    out[np.ix_(place, place)] = np.where(group[:, None] == group[None, :], 0.0, stated.matrix)
    return out


def _alone(rig: Rig, expected: ExpectedErrors) -> list[tuple[list[str], Array]]:
    """Names and covariances of independent parameters, with camera poses as without dots."""
    parts: list[tuple[list[str], Array]] = []
    placed = [expected.camera_position_m] * 3 + [float(np.deg2rad(expected.camera_rotation_deg))] * 3
    for name, camera in rig.cameras.items():
        f = pinhole_numbers(camera)[:2]
        sigmas = [*(expected.focal_relative * f), expected.centre_px, expected.centre_px]
        sigmas += _distortion_sigmas(camera, expected.distortion_px).tolist()
        lens_names = (*PINHOLE, *distortion_names(camera))
        parts.append(([f"cameras.{name}.{n}" for n in lens_names], np.diag(np.square(sigmas))))
        parts.append(([f"cameras.{name}.{n}" for n in POSE], np.diag(np.square(placed))))
    placed = [expected.screen_position_m] * 3 + [float(np.deg2rad(expected.screen_rotation_deg))] * 3
    parts += [([f"screens.{name}.{n}" for n in POSE], np.diag(np.square(placed))) for name in rig.screens]
    direction = np.deg2rad(expected.beam_direction_arcsec / 3600)
    for name, beam in rig.beams.items():
        # Errors along the beam have no effect: the covariances are singular in this direction.
        across = np.eye(3) - np.outer(beam.direction, beam.direction)
        parts.append(([f"beams.{name}.{n}" for n in DIRECTION], direction**2 * across))
        parts.append(([f"beams.{name}.{n}" for n in POINT], expected.beam_point_m**2 * across))
    return parts


def _distortion_sigmas(camera: Camera, at_corner_px: float) -> Array:
    """A sigma for each distortion coefficient (d,), which together displace the picture's corners by this many px.

    Each has the same share: an independent sigma of, for instance, k3 would have no practical meaning.
    """
    count = len(camera.distortion)
    if count == 0:
        return np.zeros(0)
    corners = _picture_grid(camera, 2, 2, inset=0.0)
    _, rays = camera.rays(corners)
    good = np.isfinite(rays).all(axis=-1)
    # If the lens model is not valid at the corners, its effect is evaluated half-way to them.
    half_way = np.append(0.25 * np.array(camera.image_size_px) / pinhole_numbers(camera)[:2], 1.0)[None]
    points = rays[good] @ camera.camera_from_world.rotation.T if good.any() else half_way
    projected = _projected(camera, points)
    moves = np.linalg.norm(projected.d_distortion[..., :count], axis=-2).max(axis=0)  # px per unit
    return at_corner_px / np.sqrt(count) / np.maximum(moves, 1e-12)


def _resection(camera: Camera, screen: Screen, expected: ExpectedErrors) -> tuple[Array, Array] | None:
    """The covariance (6, 6) of a camera's pose from dots of its screen, and d(pose)/d(lens) (6, 4 + d).

    None if the camera sees too little of the screen.
    """
    points = dots_on_screen(camera, screen, expected)
    if len(points) < _FEWEST_DOTS:
        return None
    in_camera = camera.camera_from_world.apply(points)
    projected = _projected(camera, in_camera)
    d_pose = np.concatenate(
        [np.broadcast_to(np.eye(3), (len(points), 3, 3)), -(camera.camera_from_world.rotation @ skew(points))], axis=-1
    )
    A = projected.d_point @ d_pose  # (m, 2, 6)
    count = len(camera.distortion)
    B = np.concatenate([projected.d_pinhole, projected.d_distortion[..., :count]], axis=-1)  # (m, 2, 4 + d)
    survey = projected.d_point @ np.swapaxes(projected.d_point, -1, -2) * expected.dot_survey_m**2
    W = np.linalg.inv(survey + expected.dot_px**2 * np.eye(2) + 1e-12 * np.eye(2))
    H = np.einsum("mia,mij,mjb->ab", A, W, A)
    size = np.sqrt(np.diagonal(H))
    if np.linalg.cond(H / np.outer(size, size)) > 1e12:
        return None
    noise = np.linalg.inv(H)
    return symmetric(noise), -noise @ np.einsum("mia,mij,mjb->ab", A, W, B)


def dots_on_screen(camera: Camera, screen: Screen, expected: ExpectedErrors) -> Array:
    """Points (m, 3) of the screen, in world, spread over the camera's picture."""
    columns = max(round(float(np.sqrt(1.25 * expected.dots))), 1)
    rows = max(round(expected.dots / columns), 1)
    origin, rays = camera.rays(_picture_grid(camera, columns, rows, inset=0.05))
    xy = intersect_plane(origin, np.nan_to_num(rays), screen.world_from_screen)
    good = np.isfinite(xy).all(axis=-1) & np.isfinite(rays).all(axis=-1)
    if screen.size_m is not None:
        good &= np.all(np.abs(np.nan_to_num(xy)) <= np.array(screen.size_m) / 2, axis=-1)
    xy = xy[good]
    return screen.world_from_screen.apply(np.concatenate([xy, np.zeros((len(xy), 1))], axis=1))


def _picture_grid(camera: Camera, columns: int, rows: int, inset: float) -> Array:
    """Pixels (columns * rows, 2) on a regular grid, from `inset` of the picture's size inside the edges."""
    width, height = camera.image_size_px
    u = np.linspace(inset * width, (1 - inset) * width, columns) - 0.5
    v = np.linspace(inset * height, (1 - inset) * height, rows) - 0.5
    return np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)


def _projected(camera: Camera, points_camera: Array) -> Projected:
    return project_points_full(
        points_camera,
        pinhole_numbers(camera),
        padded(camera.distortion),
        np.asarray(camera.fold_r2),
        np.asarray(camera.lens == FISHEYE),
    )
