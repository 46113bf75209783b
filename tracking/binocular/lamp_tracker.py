"""The pose of a target with lamps in the pictures of one camera: their corners, labels and pose, frame by frame.

Source: Fu et al. (2016), section 2: Harris corners and RANSAC on the lamps of the tanker. The labels and the pose are
those of the binocular measurement with one of its pictures missing: poses of three lamps, tested against all corners.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.camera import Camera
from geometry.pose import Pose
from geometry.uncertainty.rig_uncertainty import RigCovariance
from tracking.binocular import pose_tracker
from tracking.binocular.marker_model import MarkerImages, MarkerModel, MatchParameters, StereoPair, project_markers
from tracking.binocular.pose_tracker import BinocularFrame, BinocularTracker
from tracking.noise import Picture, guess_noise
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


# Corners of lamps in a picture by the Harris method, with the response and the window of Fu (2016), and the centroid of
# the light at each.
#
# Source: Fu et al. (2016), eqs. (6) and (7); the response det(M) / (tr(M) + epsilon) is Noble's form, "Finding
# corners", Image and Vision Computing 6(2), 1988, of Harris & Stephens (1988).

GROUND_PERCENTILE = 95.0  # of the window's edge: above the noise of the sky, below a neighbouring lamp
LEAST_LIGHT_SIGMAS = 6.0  # of a lamp's middle above it, in sigmas of the noise


@dataclass(frozen=True, slots=True)
class HarrisParameters:
    """Finding corners in one picture."""

    window_px: int = 5  # side of the Gaussian window; the paper: 5
    threshold_sigma: float = 40.0  # least response, in multiples of its median, which noise and sky determine
    threshold_share: float = 0.01  # ... and as a share of the largest response
    most: int = 60  # corners that are kept; the strongest
    centroid_px: int = 3  # half side of the window in which a lamp's centroid is measured


def harris_response(picture: Picture, window_px: int = 5) -> Array:
    """The response det(M) / (tr(M) + epsilon) of every pixel (h, w), DN^2.

    M is the window's mean of the products of the first derivatives; eq. (6) prints the elements without the mean.
    """
    grey = picture.astype(np.float32)
    du = cv2.Sobel(grey, cv2.CV_32F, 1, 0, ksize=3, scale=1 / 8)
    dv = cv2.Sobel(grey, cv2.CV_32F, 0, 1, ksize=3, scale=1 / 8)
    side = (window_px, window_px)
    uu, uv, vv = (cv2.GaussianBlur(product, side, 0) for product in (du * du, du * dv, dv * dv))
    return np.asarray((uu * vv - uv * uv) / (uu + vv + 1e-6), dtype=float)


def harris_corners(picture: Picture) -> MarkerImages:
    """The lamps of a picture (h, w), strongest first: local maxima of the response above the threshold.

    Corners that are not brighter than their surroundings are none. Areas are nan, all have colour 0.
    """
    p = HarrisParameters()
    response = harris_response(picture, p.window_px)
    limit = max(p.threshold_sigma * float(np.median(response)), p.threshold_share * float(response.max()), 1e-9)
    peaks = (response >= cv2.dilate(response, np.ones((p.window_px, p.window_px)))) & (response > limit)
    margin = p.centroid_px + 1
    peaks[:margin], peaks[-margin:], peaks[:, :margin], peaks[:, -margin:] = False, False, False, False
    v, u = np.nonzero(peaks)
    order = np.argsort(-response[v, u], kind="stable")
    places, covariances, good = _centroids(picture, u[order], v[order], p)
    places, covariances = places[good][: p.most], covariances[good][: p.most]
    n = len(places)
    return MarkerImages(places, covariances, np.full(n, np.nan), np.zeros(n, dtype=np.int64))


def _centroids(picture: Picture, u: Ints, v: Ints, p: HarrisParameters) -> tuple[Array, Array, Bools]:
    """Centroids (n, 2) of the light above the window's edge, covariances (n, 2, 2), and whether a light is there.

    The level is a high percentile of the edge: a lamp in front of a darker body has bright sky on one side only.
    """
    half, variance = p.centroid_px, guess_noise(picture).floor_dn2
    offsets = np.arange(-half, half + 1)
    windows = picture[(v[:, None, None] + offsets[:, None]), (u[:, None, None] + offsets)].astype(float)
    edge = np.ones((len(offsets), len(offsets)), dtype=bool)
    edge[1:-1, 1:-1] = False
    ground = np.percentile(windows[:, edge], GROUND_PERCENTILE, axis=1)
    light = np.maximum(windows - ground[:, None, None], 0.0)
    total = light.sum(axis=(1, 2))
    good = (windows[:, half, half] > ground + LEAST_LIGHT_SIGMAS * np.sqrt(variance)) & (total > 0)
    safe = np.where(good, total, 1.0)[:, None, None]
    grid = np.stack(np.broadcast_arrays(offsets, offsets[:, None]), -1)
    shift = np.einsum("nij,ijk->nk", light, grid) / safe[..., 0]
    # Each lit pixel has the noise; it moves the centroid by its distance from it over the total.
    lever = np.where((light > 0)[..., None], grid - shift[:, None, None], 0.0) / safe[..., None]
    covariance = variance * np.einsum("nijk,nijl->nkl", lever, lever)
    return np.stack([u, v], -1) + shift, covariance, good
