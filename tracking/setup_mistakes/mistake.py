"""One mistake of setting up: the rig, the pictures and the prior as they are without it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType

import numpy as np

from geometry.arrays import Array
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.pose_prior import PosePrior
from geometry.pose_solver.visibility import assumed_range, poses_within
from geometry.rig import Rig
from tracking.detections import Detections

FEW_POSES = 40
# The points of consecutive pictures by camera: of the frame before, the frame itself and the frame after. A camera
# without a picture is absent.
Block = Sequence[Mapping[str, Detections]]
HERE = 1  # index of the frame itself


@dataclass(frozen=True, slots=True)
class PictureChange:
    """How the picture that a camera of the rig took follows from a recorded one: uv_px = turn @ recorded + shift."""

    source: str  # the camera under whose name it is recorded
    turn: Array = field(default_factory=lambda: np.eye(2))  # (2, 2)
    shift: Array = field(default_factory=lambda: np.zeros(2))  # (2,) px
    later: int = 0  # frames: the number under which it is recorded minus its own; -1, 0 or 1

    def of(self, found: Detections) -> Detections:
        """The points of the camera's picture, from those of the recorded one."""
        uv = found.uv_px @ self.turn.T + self.shift
        return replace(found, uv_px=uv, cov_px2=self.turn @ found.cov_px2 @ self.turn.T)

    def recorded(self, uv_px: Array) -> Array:
        """Recorded pixels (..., 2) of pixels of the camera's picture."""
        return np.asarray((uv_px - self.shift) @ np.linalg.inv(self.turn).T)


@dataclass(frozen=True, slots=True)
class Mistake:
    """A mistake that may have been made."""

    kind: str  # a key of SHOWN_BY
    what: str
    remedy: str
    rig: Rig  # as it is without the mistake
    pictures: Mapping[str, PictureChange] = field(default_factory=dict)  # by camera; others are as recorded
    prior: PosePrior | None = None  # as it is without the mistake; None: as given
    by_itself: bool = False  # numbers of the files show it, without a recording

    def has_effect(self, given: Rig) -> bool:
        """Whether the mistake changes more than names: the pictures, the prior, or the points of some pose."""
        if self.pictures or self.prior is not None or self.by_itself:
            return True
        poses = poses_within(assumed_range(given), FEW_POSES)
        frames = zip(_points_of(self.rig, poses), _points_of(given, poses), strict=True)
        return not all(np.array_equal(a, b) for a, b in frames)

    def points(self, block: Block) -> dict[str, Detections]:
        """The points of the frame in the middle of a block, by camera, as they are without the mistake."""
        out = {}
        for name in self.rig.cameras:
            change = self.pictures.get(name)
            if change is None:
                found = block[HERE].get(name)
            else:
                found = block[HERE + change.later].get(change.source)
                found = None if found is None else change.of(found)
            if found is not None:
                out[name] = found
        return out


def _points_of(rig: Rig, poses: Pose) -> list[Array]:
    """The pixels at poses (k,) by camera and pose, sorted and rounded: which spots they are plays no part."""
    model = SpotModel.of(rig)
    pixels = np.round(model.project(poses)[0], 6)
    pixels = np.where(model.in_picture(pixels)[..., None], pixels, np.inf)
    keys = np.stack([np.broadcast_to(model.camera_of, pixels.shape[:2]), pixels[..., 0], pixels[..., 1]], axis=-1)
    return [frame[np.lexsort(frame.T)] for frame in keys]


# What shows a mistake of each kind that a recording cannot show, because the set-up is symmetric.
SHOWN_BY = MappingProxyType(
    {
        "exchanged": "cover the lens of one camera for some frames: the pictures of that camera must be empty",
        "turned": "film a page of text on the screen: it must be readable and upright as in the room",
        "size": "compare the size of the pictures with `image_size_px`, and both with those of the calibration",
        "pose": "measure the distance from that camera to two points of its screen with a tape",
        "unit": "measure the distance between two cameras with a tape",
        "focal": "compute the focal length in pixels: millimetres of the lens / millimetres of a pixel",
        "numbers": "film one flash with all cameras: it must be in the pictures of the same number",
        "target": "cover one beam at the vehicle: the spots of that beam must disappear",
        "lens": "photograph a board with that camera (`beampose calibrate camera`)",
        "prior": "measure the first pose with a tape",
    }
)
