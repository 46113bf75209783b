"""Mistakes that no recording shows: the rig as given explains what is recorded with them, by other poses.

Each mistake is made in a simulation without noise: the points of poses within the prior, as they would be recorded, are
labelled with the rig as given. A symmetric rig fits them all. Source: ours.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from geometry import rotations
from geometry.arrays import Array
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.pose_prior import PosePrior
from geometry.pose_solver.visibility import assumed_range, poses_within
from geometry.rig import Rig
from tracking.detections import Detections
from tracking.labelling.points import NO_POINT
from tracking.labelling.search import Labelling, candidate_labellings
from tracking.parameters import LabelParameters
from tracking.setup_mistakes.mistake import Mistake
from tracking.setup_mistakes.possible import possible_mistakes

NAMES = "target"  # the kind of mistakes that may exchange names only
POSES = 200  # of which the TRIED with the most visible spots are tried
TRIED = 2
SIGMA_PX = 0.1  # of the simulated points; they are exact, and fit a symmetric rig ...
LARGEST_RMS_PX = 0.02  # ... to less than this
SAME_M, SAME_DEG = 1e-3, 0.01  # poses that differ by less are the same


@dataclass(frozen=True, slots=True)
class Invisible:
    """A mistake that no recording shows, and by how much the poses would be wrong."""

    mistake: Mistake
    off_m: float
    off_deg: float

    @property
    def is_harmless(self) -> bool:
        """Whether the poses are the same: only names are exchanged."""
        return self.off_m < SAME_M and self.off_deg < SAME_DEG


def invisible_mistakes(rig: Rig, prior: PosePrior | None, parameters: LabelParameters) -> Iterator[Invisible]:
    """The mistakes that a rig hides, over the poses of a prior (without one: of a usual range)."""
    model = SpotModel.of(rig)
    prior = assumed_range(rig) if prior is None else prior
    poses = poses_within(prior, POSES)
    views = np.count_nonzero(model.in_picture(model.project(poses)[0]).any(axis=0))
    for mistake in possible_mistakes(rig):
        late = any(change.later for change in mistake.pictures.values())
        if mistake.by_itself or late or not (mistake.kind == NAMES or mistake.has_effect(rig)):
            continue
        true = SpotModel.of(mistake.rig)
        pixels = true.project(poses)[0]
        seen = true.in_picture(pixels)
        if np.count_nonzero(seen.any(axis=0)) < views:
            continue  # such a rig would have spots that it never sees
        recorded = _recorded(mistake, true, pixels)
        off: list[Array] = []
        for k in np.argsort(-seen.sum(axis=1), kind="stable")[:TRIED]:
            points = _detections(mistake, true, recorded[k], seen[k])
            if sum(map(len, points.values())) < max(parameters.min_spots, 1):
                break
            found = candidate_labellings(rig, model, points, prior, parameters, most=1)
            if not found or not _explains_all(found[0], points):
                break
            off.append(_off(found[0].fit.world_from_body, poses[int(k)]))
        if len(off) == TRIED:
            worst = np.max(off, axis=0)
            yield Invisible(mistake, float(worst[0]), float(np.rad2deg(worst[1])))


def _recorded(mistake: Mistake, model: SpotModel, pixels: Array) -> Array:
    """Pixels (..., n, 2) as they are recorded with the mistake."""
    out = pixels.copy()
    for name, change in mistake.pictures.items():
        mine = model.camera_of == model.camera_names.index(name)
        out[..., mine, :] = change.recorded(pixels[..., mine, :])
    return out


def _detections(mistake: Mistake, model: SpotModel, recorded: Array, seen: Array) -> dict[str, Detections]:
    """The recorded points of one pose, by the camera under whose name they are recorded."""
    out = {}
    for c, name in enumerate(model.camera_names):
        uv = recorded[(model.camera_of == c) & seen]
        change = mistake.pictures.get(name)
        out[name if change is None else change.source] = Detections.at(
            uv, np.tile(SIGMA_PX**2 * np.eye(2), (len(uv), 1, 1))
        )
    return out


def _explains_all(one: Labelling, points: dict[str, Detections]) -> bool:
    """Whether every point has a label, and lies where the pose puts its spot."""
    labelled = int(np.count_nonzero(one.point_of != NO_POINT))
    return labelled == sum(map(len, points.values())) and one.fit.dof > 0 and one.fit.rms_px < LARGEST_RMS_PX


def _off(one: Pose, other: Pose) -> Array:
    """Distance, m, and angle, rad, between two poses (2,)."""
    turn = rotations.angle(one.rotation.T @ other.rotation)
    return np.array([np.linalg.norm(one.translation - other.translation), float(turn)])
