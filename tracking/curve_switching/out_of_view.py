"""Positions of spots outside the image, for rigs with coplanar beams that meet in one point (the paper's).

Source: Huo, Yang & Yang 2015, section 4.2; the formulas, eqs. (10) to (14), are in
geometry/pose_solver/closed_form.py.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geometry.arrays import Array
from geometry.forward_model import SpotModel, points_on_screens
from geometry.planes import common_perpendicular
from geometry.pose_solver.closed_form import meeting_point, middle_spot, outer_spot
from geometry.rig import Rig

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
    def of(model: SpotModel) -> CoplanarViews:
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
        world = points_on_screens(rig, np.arange(len(model)), uv_px) if world is None else world
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
