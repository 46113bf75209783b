"""Online estimates of the rigid tracker: process noise, variance factor, false and static points, spot sizes."""

from __future__ import annotations

from collections import deque
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
from tracking.rigid_body.hypotheses.hypothesis_set import Dynamics
from tracking.shapes import log_shape_ratio

RANGE = (1e-4, 1e5)  # m/s^3 or rad/s^3 per sqrt(Hz)
_LOG_RANGE = 2 * np.log(RANGE)
# Change of the log density of the jerk per unit of the innovation score: at the start, and in the long run.
FIRST_GAIN, MIN_GAIN = 0.5, 0.1
GAIN_DECAY = 0.97  # per frame, from the first to the second
MIN_JUMP = np.array([0.2, 0.5])  # m/s, rad/s: sigma of a manoeuvre's velocity jump while the vehicle stands
JUMP_OF_SPEED = 1.2  # a reversal changes a velocity by twice itself, along one axis of three
MANOEUVRE_S = 0.1  # s: the accelerations jump by the velocities' jump over this time
SPEED_DECAY = 0.995  # per frame, of the recent largest speed
MANOEUVRE_MEMORY = 200.0  # frames: time constant of the manoeuvres' frequency
MIN_P, MAX_P = 0.002, 0.2  # of a manoeuvre, per frame


def jump_variance(speed: Array) -> Array:
    """Variances (..., 2) of a manoeuvre's velocity jump at speeds (..., 2), m/s and rad/s."""
    return (MIN_JUMP + JUMP_OF_SPEED * speed) ** 2


class AdaptiveProcessNoise:
    """Estimate of the vehicle's dynamics."""

    def __init__(self, parameters: TrackerParameters) -> None:
        self._adapt_jerk = parameters.learn_jerk
        self._log_jerk = 2 * np.log(np.repeat([parameters.jerk_m_s3, parameters.jerk_rad_s3], 3))
        self._gain = FIRST_GAIN
        self._p_manoeuvre = parameters.p_manoeuvre
        self._recent_speed = np.zeros(2)
        self.fastest = np.zeros(2)  # m/s, rad/s: largest speeds measured so far
        self.dynamics = self._dynamics()

    def _dynamics(self) -> Dynamics:
        jump = jump_variance(self._recent_speed)
        return Dynamics(np.exp(self._log_jerk), jump, jump / MANOEUVRE_S**2, self._p_manoeuvre)

    def update(self, velocities: Array, manoeuvre: bool, score: Array) -> None:
        """Take a measured frame.

        velocities (6,): of the vehicle, m/s and rad/s. manoeuvre: whether the frame began with one. score (6,):
        derivative of the innovation's log-likelihood by the log density of each axis' jerk (`innovation_score` in
        frame_summary.py); a step of stochastic gradient ascent follows it.
        """
        speed = np.sqrt([velocities[:3] @ velocities[:3], velocities[3:] @ velocities[3:]])
        self._recent_speed = np.maximum(SPEED_DECAY * self._recent_speed, speed)
        self.fastest = np.maximum(self.fastest, speed)
        self._p_manoeuvre += (float(manoeuvre) - self._p_manoeuvre) / MANOEUVRE_MEMORY
        self._p_manoeuvre = min(max(self._p_manoeuvre, MIN_P), MAX_P)
        if self._adapt_jerk and not manoeuvre:
            self._log_jerk += self._gain * np.minimum(np.maximum(score, -1.0), 3.0)
            self._log_jerk = np.minimum(np.maximum(self._log_jerk, _LOG_RANGE[0]), _LOG_RANGE[1])
            self._gain = max(MIN_GAIN, GAIN_DECAY * self._gain)
        self.dynamics = self._dynamics()


MEMORY = 100  # fits: time constant of the estimate, once it has seen so many
PRIOR_DOF = 30  # degrees of freedom that the stated sigmas count at the start: the first fits have more weight
DEADBAND = 1.3  # no effect below; if the stated sigmas are correct the estimate scatters by 0.06 about 1
MAX_RATIO = 3.0  # a single fit counts at most this many times the estimate
RECENT_FITS = 9  # if the median of so many exceeds the estimate by MAX_RATIO, the estimate jumps to it


class VarianceFactor:
    """Running mean of chi-square per degree of freedom, robust to outliers."""

    def __init__(self) -> None:
        self._mean = 1.0
        self._seen = float(PRIOR_DOF)  # degrees of freedom
        self._deadband = DEADBAND
        self._recent: deque[float] = deque(maxlen=RECENT_FITS)

    @property
    def noise_scale(self) -> float:
        """Ratio of the spots' errors to their stated sigmas; 1 while the estimate is within the deadband."""
        return float(np.sqrt(self._mean)) if self._mean > self._deadband else 1.0

    def update(self, chi2: float, dof: int, systematic_share: float = 0.0) -> None:
        """Take one fit.

        systematic_share: share of the expected misfit that comes from calibration errors. These are the same in every
        frame, so that no mean reduces their scatter; the deadband is widened by it.
        """
        if dof <= 0:
            return
        factor = chi2 / dof
        self._recent.append(factor)
        median = sorted(self._recent)[len(self._recent) // 2]
        if len(self._recent) == self._recent.maxlen and median > MAX_RATIO * max(self._mean, 1.0):
            self._mean = median
        self._seen += dof
        self._mean *= 1 + (min(factor / self._mean, MAX_RATIO) - 1) * max(dof / self._seen, 1 / MEMORY)
        self._mean = max(self._mean, 0.1)
        self._deadband = DEADBAND + 3 * systematic_share * np.sqrt(2 / dof)

    def raise_to(self, chi2: float, dof: int) -> None:
        """Raise the estimate at once to the misfit of a frame whose labels are certain for other reasons."""
        if dof > 0:
            self._mean = max(self._mean, chi2 / dof)


# Static points: reflections and lamps, which stay in their place in the picture. They are not labelled as spots.
#
# Each camera has a list of places at which unlabelled points were found repeatedly. The density of false points there
# is much higher than elsewhere, and that density is all that the search for labels uses. Source: ours.

MAX_PLACES = 256  # per camera; photographs show some 70 points at rest
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
    noise_px2: Array  # (m,): variances of a coordinate, without errors of their places, which repeat
    first: Ints  # (c + 1,) where the rows of each camera begin
    has_image: Bools  # (c,)


def no_places(cameras: int) -> StaticPlaces:
    """The empty lists of so many cameras."""
    return StaticPlaces(np.zeros((cameras, MAX_PLACES, 2)), np.zeros((cameras, MAX_PLACES)), np.zeros(cameras))


@compiled
def radius2_px2(noise_px2: float) -> float:
    """Squared radius of a place, px^2, for a point with this variance of its noise."""
    return max(RADIUS_SIGMAS * RADIUS_SIGMAS * noise_px2, MIN_RADIUS_PX * MIN_RADIUS_PX)


@compiled
def static_log_density(places: StaticPlaces, uv: Array, noise_px2: Array, first: Ints) -> Array:
    """Log density of static points, 1/px^2, at each of a frame's detections (m,); -inf where no place is known.

    uv (m, 2), noise_px2 (m,), first (c + 1,): as in PicturePoints.
    """
    out = np.full(uv.shape[0], -np.inf)
    for c in range(first.shape[0] - 1):
        if places.frames[c] <= 0.0:
            continue
        for d in range(first[c], first[c + 1]):
            r2 = radius2_px2(noise_px2[d])
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
    -1 without a label; expected (n, 2), px: pixels of the spots at the frame's pose. decay: of the counts; 1: none.
    """
    uv, first = points.uv, points.first
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
            r2 = radius2_px2(points.noise_px2[d])
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
_DISCS_MEMORY = 300.0  # discs: time constant of the estimate
MIN_COUNT = 0.5  # false points that a picture without any is assumed to have


class ClutterNearSpots:
    """Density of false points by camera: as counted near spots, or that of the whole picture if it is higher."""

    def __init__(self, model: SpotModel, min_per_px2: float) -> None:
        self._camera_of = model.camera_of
        cameras = len(model.camera_names)
        self._area = np.ones(cameras)  # px^2; not used for a camera that observes no spot
        self._area[model.camera_of] = np.prod(model.image_size_px, axis=-1)
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
        share = discs / _DISCS_MEMORY
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
        self._noise_px2 = np.zeros(0)  # of the last frame's points

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
            place = [np.zeros(len(f)) if f.place_px2 is None else f.place_px2 for f in some]
            self._noise_px2 = 0.5 * np.trace(cov, axis1=1, axis2=2) - np.concatenate(place) * noise_scale**2
        else:
            uv, cov, blend, self._noise_px2 = np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0), np.zeros(0)
        has_image = np.array([f is not None for f in found])
        static = static_log_density(self._static, uv, self._noise_px2, first_rows)
        if any(f.at_rest is not None for f in some):
            at_rest = np.concatenate([np.zeros(len(f)) if f.at_rest is None else f.at_rest for f in some]) > 0
            static[at_rest] = np.maximum(static[at_rest], SURE_LOG_DENSITY)
        elsewhere = np.concatenate([[0], np.cumsum(static == -np.inf)])[first_rows]  # those at no static place
        log_clutter, log_excess = self._clutter.log_density(elsewhere)
        shape = np.zeros(len(uv))
        if first:
            # Of a light that is known, its shape is the same in each frame.
            spots = np.bincount(self._camera, minlength=len(found))
            shapes = [log_shape_ratio(f, n) for f, n in zip(found, spots.tolist(), strict=True) if f is not None]
            shape = np.concatenate([np.zeros(0), *shapes])
            # The excess of clutter near spots must not make points without any spot evidence of a vehicle.
            log_clutter, log_excess = log_clutter - log_excess, np.zeros_like(log_excess)
        return FrameDetections(
            uv, cov, blend, first_rows, has_image, log_clutter, static, major, self._usual_size_px, log_excess, shape
        )

    def update(self, frame: FrameDetections, assigned: Ints, summary: FrameSummary, measured: bool) -> None:
        """Take a frame with a pose and its assignment (n,); measured: its spots determine the pose."""
        self._clutter.update(summary.false_points, summary.discs)
        if measured:
            labels = np.where(assigned >= 0, assigned % BLENDED, -1)
            points = PicturePoints(frame.uv, self._noise_px2, frame.first, frame.has_image)
            update_places(self._static, points, labels, summary.expected_px, self._camera, DECAY)
        for v in np.flatnonzero(summary.use):
            size = frame.size_px[assigned[v]]
            if np.isfinite(size):
                old = self._usual_size_px[v]
                self._usual_size_px[v] = size if np.isnan(old) else old + SIZE_GAIN * (size - old)
