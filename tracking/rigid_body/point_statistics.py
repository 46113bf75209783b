"""Online estimates about the points in the pictures: density of clutter, static points, and the spots' usual sizes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.compilation.jit import compiled
from geometry.forward_model import SpotModel
from tracking.detections import Detections
from tracking.parameters import TrackerParameters
from tracking.rigid_body.association.frame_detections import BLENDED, CLUTTER_RADIUS_PX, FrameDetections
from tracking.rigid_body.frame_summary import FrameSummary

# Static points: reflections and lamps, which stay in their place in the picture. They are not labelled as spots.
#
# Each camera has a list of places at which unlabelled points were found repeatedly. The density of false points there
# is much higher than elsewhere, and that density is all that the search for labels uses. Source: ours.

MAX_PLACES = 64  # per camera
RADIUS_SIGMAS, MIN_RADIUS_PX = 5.0, 0.4  # radius of a place in sigmas of a point, and at least
MIN_SEEN = 4.0  # count from which on a place is taken for static
SURE_LOG_DENSITY = -float(np.log(np.pi * MIN_RADIUS_PX**2))  # 1/px^2, of points that are known to be static
DECAY = 0.99  # of the counts per frame while tracking: a place is forgotten some hundred frames after its point is gone
NEAR_PX = 3.0  # a point this near to an expected spot may be that spot, labelled or not


class StaticPlaces(NamedTuple):
    """Places of c cameras, up to MAX_PLACES each."""

    uv: Array  # (c, MAX_PLACES, 2) px
    seen: Array  # (c, MAX_PLACES) decaying count of unlabelled points there; 0: no place
    frames: Array  # (c,) count of frames that decays likewise


class PicturePoints(NamedTuple):
    """One frame's m detections, sorted by camera."""

    uv: Array  # (m, 2) px
    cov: Array  # (m, 2, 2) px^2
    first: Ints  # (c + 1,) where the rows of each camera begin
    has_image: Bools  # (c,)


def no_places(cameras: int) -> StaticPlaces:
    """The empty lists of so many cameras."""
    return StaticPlaces(np.zeros((cameras, MAX_PLACES, 2)), np.zeros((cameras, MAX_PLACES)), np.zeros(cameras))


@compiled
def radius2_px2(cov: Array) -> float:
    """Squared radius of a place, px^2, for a point of covariance (2, 2)."""
    return max(RADIUS_SIGMAS * RADIUS_SIGMAS * 0.5 * (cov[0, 0] + cov[1, 1]), MIN_RADIUS_PX * MIN_RADIUS_PX)


@compiled
def static_log_density(places: StaticPlaces, uv: Array, cov: Array, first: Ints) -> Array:
    """Log density of static points, 1/px^2, at each of a frame's detections (m,); -inf where no place is known.

    uv (m, 2), cov (m, 2, 2); first (c + 1,): where the rows of each camera begin.
    """
    out = np.full(uv.shape[0], -np.inf)
    for c in range(first.shape[0] - 1):
        if places.frames[c] <= 0.0:
            continue
        for d in range(first[c], first[c + 1]):
            r2 = radius2_px2(cov[d])
            count = 0.0
            for k in range(MAX_PLACES):
                a, b = places.uv[c, k, 0] - uv[d, 0], places.uv[c, k, 1] - uv[d, 1]
                if places.seen[c, k] > 0.0 and a * a + b * b < r2:
                    count += places.seen[c, k]
            if count >= MIN_SEEN:
                out[d] = np.log(min(count / places.frames[c], 1.0) / (np.pi * r2))
    return out


@compiled
def update_places(
    places: StaticPlaces, points: PicturePoints, assigned: Ints, expected: Array, camera_of: Ints, decay: float
) -> None:
    """Add one frame whose pose is known, in place.

    Points that are labelled, or lie near an expected spot, are left out. assigned (n,): row of each view's detection,
    -1 without a label; expected (n, 2), px: pixels of the spots at the frame's pose; decay: 1 or DECAY.
    """
    uv, cov, first = points.uv, points.cov, points.first
    for c in range(first.shape[0] - 1):
        if not points.has_image[c]:
            continue
        places.frames[c] = decay * places.frames[c] + 1.0
        for k in range(MAX_PLACES):
            places.seen[c, k] *= decay
        for d in range(first[c], first[c + 1]):
            is_spot = False
            for i in range(assigned.shape[0]):
                if camera_of[i] == c:
                    a, b = expected[i, 0] - uv[d, 0], expected[i, 1] - uv[d, 1]
                    is_spot |= assigned[i] == d or a * a + b * b < NEAR_PX * NEAR_PX
            if is_spot:
                continue
            r2 = radius2_px2(cov[d])
            best, nearest = -1, r2
            weakest = 0
            for k in range(MAX_PLACES):
                if places.seen[c, k] < places.seen[c, weakest]:
                    weakest = k
                a, b = places.uv[c, k, 0] - uv[d, 0], places.uv[c, k, 1] - uv[d, 1]
                if places.seen[c, k] > 0.0 and a * a + b * b < nearest:
                    best, nearest = k, a * a + b * b
            if best >= 0:
                places.seen[c, best] += 1.0
                share = 1.0 / places.seen[c, best]
                for a in range(2):
                    places.uv[c, best, a] += share * (uv[d, a] - places.uv[c, best, a])
            elif places.seen[c, weakest] < 1.5:
                places.seen[c, weakest] = 1.0
                places.uv[c, weakest, 0], places.uv[c, weakest, 1] = uv[d, 0], uv[d, 1]


AREA_PX2 = np.pi * CLUTTER_RADIUS_PX**2
START_PER_PX2 = 2e-4  # the paper's 20 % of false points within 15 px of a spot
MEMORY = 300.0  # discs: time constant of the estimate
MIN_COUNT = 0.5  # false points that a picture without any is assumed to have


class ClutterNearSpots:
    """Density of false points by camera: as counted near spots, or that of the whole picture if it is higher."""

    def __init__(self, model: SpotModel, min_per_px2: float) -> None:
        self._camera_of = model.camera_of
        cameras = len(model.camera_names)
        self._area = np.array(
            [np.prod(model.image_size_px[model.camera_of == c][0]) if np.any(model.camera_of == c) else np.inf
             for c in range(cameras)]
        )  # fmt: skip
        self._min = min_per_px2
        self._near = np.full(cameras, START_PER_PX2)

    def log_density(self, first: Ints) -> tuple[Array, Array]:
        """Log density (n,) of false points near each view's spot, 1/px^2; its log ratio (n,) to the whole picture's.

        first (cameras + 1,): where the rows of each camera begin among the frame's detections.
        """
        whole = np.maximum(np.diff(first), MIN_COUNT) / self._area
        density = np.maximum(np.maximum(self._near, whole), self._min)
        return np.log(density)[self._camera_of], np.log(density / whole)[self._camera_of]

    def update(self, false_points: Array, discs: Array) -> None:
        """Take one frame: false points (cameras,) within CLUTTER_RADIUS_PX of so many expected spots (cameras,)."""
        share = discs / MEMORY
        self._near += share * (false_points / (np.maximum(discs, 1.0) * AREA_PX2) - self._near)


SIZE_GAIN = 0.1  # weight of one frame in the usual size of a spot


class PointStatistics:
    """What is known of the points in the pictures of all cameras."""

    def __init__(self, model: SpotModel, parameters: TrackerParameters) -> None:
        self._parameters = parameters
        self._camera = np.ascontiguousarray(model.camera_of)
        self._clutter = ClutterNearSpots(model, parameters.labels.clutter_per_px2)
        self._static = no_places(len(model.camera_names))
        self._usual_size_px = np.full(len(model), np.nan)

    def frame(self, found: Sequence[Detections | None], noise_scale: float, first: bool) -> FrameDetections:
        """All cameras' detections in one list, with the errors and densities that are known so far.

        noise_scale: ratio of the spots' errors to their stated sigmas. first: no pose has been measured yet.
        """
        counts = [0 if f is None else len(f) for f in found]
        first_rows = np.zeros(len(found) + 1, dtype=np.int64)
        np.cumsum(counts, out=first_rows[1:])
        some = [f for f in found if f is not None]
        major = np.zeros(0)
        if some:
            uv = np.concatenate([f.uv_px for f in some])
            major = np.concatenate([f.major_px for f in some])
            # Contiguous in any case: numba compiles each function once per memory layout.
            cov = np.ascontiguousarray(np.concatenate([f.cov_px2 for f in some]) * noise_scale**2)
            cov[:, [0, 1], [0, 1]] += self._parameters.sigma_model_px**2
            blend = np.where(np.isnan(major), 0.0, self._parameters.blend_px)
        else:
            uv, cov, blend = np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0)
        has_image = np.array([f is not None for f in found])
        static = static_log_density(self._static, uv, cov, first_rows)
        if any(f.at_rest is not None for f in some):
            at_rest = np.concatenate([np.zeros(len(f)) if f.at_rest is None else f.at_rest for f in some]) > 0
            static[at_rest] = np.maximum(static[at_rest], SURE_LOG_DENSITY)
        log_clutter, log_excess = self._clutter.log_density(first_rows)
        if first:
            # The excess of clutter near spots must not make points without any spot evidence of a vehicle.
            log_clutter, log_excess = log_clutter - log_excess, np.zeros_like(log_excess)
        return FrameDetections(
            uv, cov, blend, first_rows, has_image, log_clutter, static, major, self._usual_size_px, log_excess
        )

    def update(self, frame: FrameDetections, assigned: Ints, summary: FrameSummary, measured: bool) -> None:
        """Take a frame with a pose and its assignment (n,); measured: its spots determine the pose."""
        self._clutter.update(summary.false_points, summary.discs)
        if measured:
            labels = np.where(assigned >= 0, assigned % BLENDED, -1)
            points = PicturePoints(frame.uv, frame.cov, frame.first, frame.has_image)
            update_places(self._static, points, labels, summary.expected_px, self._camera, DECAY)
        for v in np.flatnonzero(summary.use):
            size = frame.size_px[assigned[v]]
            if np.isfinite(size):
                old = self._usual_size_px[v]
                self._usual_size_px[v] = size if np.isnan(old) else old + SIZE_GAIN * (size - old)
