"""The pose of a target with lamps in the pictures of one camera: their corners, labels and pose, frame by frame.

Source: Fu et al. (2016), section 2: Harris corners and RANSAC on the lamps of the tanker. The labels and the pose are
those of the binocular measurement with one of its pictures missing: poses of three lamps, tested against all corners.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from geometry.arrays import Array
from geometry.camera import Camera
from geometry.pose import Pose
from geometry.uncertainty.rig_uncertainty import RigCovariance
from tracking.binocular import pose_tracker
from tracking.binocular.marker_model import MarkerImages, MarkerModel, MatchParameters, StereoPair, project_markers
from tracking.binocular.pose_tracker import BinocularFrame, BinocularTracker
from tracking.noise import Picture
from tracking.statuses import Cause, PoseStatus

EXTRA_PX = 0.02  # of a lamp's place beside its noise: edges of the body and structure behind it

CAUSES = {
    pose_tracker.NO_PICTURES: Cause.NO_IMAGE,
    pose_tracker.TOO_FEW: Cause.NOT_FOUND,
    pose_tracker.NO_POSE: Cause.NO_MATCH,
    pose_tracker.CONTRADICTED: Cause.NO_MATCH,
    pose_tracker.AMBIGUOUS: Cause.AMBIGUOUS,
}


@dataclass(frozen=True, slots=True)
class LampFrame:
    """One frame."""

    tracked: BinocularFrame  # its second camera sees nothing
    lights: MarkerImages | None  # candidates in the picture; None: no picture
    place: Array  # (3,): u, v of the lamps' mean, px, and nan: a pose has no size in the picture
    sigmas: Array  # (3,) of `place`
    event: str = ""

    @property
    def status(self) -> PoseStatus:
        """Measured, predicted or lost."""
        return self.tracked.status

    @property
    def cause(self) -> Cause:
        """Why it is not measured."""
        return CAUSES.get(self.tracked.reason, Cause.UNCERTAIN) if self.tracked.reason else Cause.NONE

    @property
    def found(self) -> int:
        """Poses that explain the lights: two or more of an ambiguous frame."""
        return 2 if self.cause is Cause.AMBIGUOUS else int(self.status is PoseStatus.MEASURED)


class LampTracker:
    """Labels and poses of the lamps, picture by picture.

    find: the lights of a picture, all of one colour. interval_s: between two frames.
    """

    def __init__(
        self,
        camera: Camera,
        model: MarkerModel,
        find: Callable[[Picture], MarkerImages],
        interval_s: float,
        covariance: RigCovariance | None = None,
    ) -> None:
        aside = Pose(camera.camera_from_world.rotation, camera.camera_from_world.translation + np.array([1.0, 0, 0]))
        blind = replace(camera, name=f"{camera.name} (none)", camera_from_world=aside)
        self.pair, self.model = StereoPair((camera, blind), covariance), model
        self._find, self._interval_s = find, interval_s
        self._mean = replace(  # of the lamps, as a marker
            model, names=("",), positions=model.positions.mean(axis=0, keepdims=True), colour=model.colour[:1],
            radius_m=np.full(1, np.nan),
        )  # fmt: skip
        self._tracker = BinocularTracker(self.pair, model, MatchParameters())
        self._count, self._was, self._seen = -1, PoseStatus.LOST, False

    def step(self, picture: Picture | None) -> LampFrame:
        """The next frame; None where there is no usable picture."""
        self._count += 1
        lights = None if picture is None else self._find(picture)
        if lights is not None:
            lights = replace(lights, cov_px2=lights.cov_px2 + EXTRA_PX**2 * np.eye(2))
        tracked = self._tracker.step(self._count * self._interval_s, (lights, None))
        event = ""
        if tracked.status is PoseStatus.MEASURED and self._was is PoseStatus.LOST:
            event, self._seen = ("reacquired" if self._seen else "acquired"), True
        elif tracked.status is PoseStatus.LOST and self._was is not PoseStatus.LOST:
            event = "lost"
        self._was = tracked.status
        return LampFrame(tracked, lights, *self._middle(tracked), event)

    def _middle(self, tracked: BinocularFrame) -> tuple[Array, Array]:
        """The image (3,) of the lamps' mean, and its sigmas."""
        place, sigmas = np.full(3, np.nan), np.full(3, np.nan)
        if tracked.pose is not None and tracked.covariance is not None:
            pixels, J = project_markers(self.pair, self._mean, tracked.pose)
            place[:2] = pixels[0, 0]
            sigmas[:2] = np.sqrt(np.diagonal(J[0, 0] @ tracked.covariance @ J[0, 0].T))
        return place, sigmas
