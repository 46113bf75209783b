"""The paper's tracker: a filter per spot, three-step matching, and what one rigid body adds to it.

Source: Huo, Yang & Yang 2015, fig. 1: predict, recognise (in view: match; out of view: solve from the other beams), modify.
Ours: the pose from the matched spots is a witness. A match that contradicts the others is dropped, and spots that the
matching missed are looked for where the pose puts them (`rigid_check`).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.pose import Pose
from geometry.rig import Rig
from geometry.solve import EXPECTED_GATE, PoseFit, SolveLimits, fit_pose, fit_pose_robust, good_enough, point_covariance
from geometry.spots import SpotModel
from tracking import kalman, pose_filter
from tracking.detections import Detections
from tracking.labels import NO_POINT, LabelResult, PosePrior, find_labels
from tracking.match import UNMATCHED, match
from tracking.out_of_view import CoplanarViews, quadratic_positions
from tracking.parameters import TrackerParameters
from tracking.pose_filter import Motion
from tracking.statuses import PoseStatus, SpotStatus

RIGID_GATE = 20.0  # squared sigmas: a detection this near to where the pose puts a spot is that spot (p = 5e-5)
BENT_NIS = 25.0  # squared sigmas: a spot this far from its prediction has turned (p = 4e-6)
CLUTTER_NEAR_SPOTS = 2e-4  # 1/px^2: the paper's 20 % of false points within 15 px of a spot
SCALE_MEMORY = 100  # frames: memory of the misfit that scales claimed covariances ...
SCALE_DEADBAND = 1.3  # ... once it exceeds this: with honest sigmas it scatters by 0.06 about 1
SIGMA_A_RANGE = (50.0, 2e6)  # px/s^2
SIGMA_A_RATE = 0.03  # share by which one innovation may move the learnt acceleration
DARK_FACTOR = 3.0  # accelerations while nothing is seen: a reversal in the dark leaves no trace
RATE_KNOWN = 1.0  # m/s, rad/s: the sigma of the vehicle's rates under which they predict anything
LOST_SIGMA_M, LOST_SIGMA_RAD = 1.0, np.deg2rad(60.0)  # a predicted pose vaguer than this is `lost`


@dataclass(frozen=True, slots=True)
class Event:
    """Something that the report should tell: labels found, a tie, a re-acquisition, a spot dropped."""

    kind: str  # labelled | tie | relabelled (matching failed at a bend) | reacquired (after frames without) | dropped
    text: str
    view: int | None = None


@dataclass(frozen=True, slots=True)
class TrackedFrame:
    """What the tracker says of one frame. n views, in the order of the SpotModel."""

    uv_px: Array  # (n, 2), nan where nothing is known
    cov_px2: Array  # (n, 2, 2)
    status: tuple[SpotStatus, ...]  # (n,)
    predicted_px: Array  # (n, 2): before this frame's picture was looked at; nan without a track
    gain: Array  # (n,): g3 of the match; nan without
    point: Ints  # (n,): row of the detection in its camera's list, or UNMATCHED
    pose_status: PoseStatus
    pose: Pose | None
    pose_covariance: Array | None  # (6, 6)
    spots_used: int
    rms_px: float
    events: tuple[Event, ...]


@dataclass(slots=True)
class _Tracks:
    """The filters of all n views. Rows that are not `alive` mean nothing."""

    x: Array  # (n, 4)
    P: Array  # (n, 4, 4)
    alive: Bools  # (n,)
    rate_known: Bools  # (n,) a velocity stands behind the prediction: without one there is none to publish
    last: Array  # (n, 2) position at the frame before
    last_cov: Array  # (n, 2, 2) its covariance
    last_age_s: Array  # (n,) how long ago that was
    unseen_s: Array  # (n,) time since a detection or a measured pose stood behind it
    sigma_a: Array  # (n,) px/s^2


class SpotTracker:
    """Feed it the detections of one frame after the other."""

    def __init__(self, rig: Rig, parameters: TrackerParameters, prior: PosePrior) -> None:
        self.rig = rig
        self.model = SpotModel.of(rig)
        self.parameters = parameters
        self.prior = prior
        self.motion: Motion | None = None
        self.coplanar = CoplanarViews.of(rig, self.model)
        n = len(self.model)
        self.tracks = _Tracks(
            np.zeros((n, 4)),
            np.tile(np.eye(4), (n, 1, 1)),
            np.zeros(n, dtype=bool),
            np.zeros(n, dtype=bool),
            np.full((n, 2), np.nan),
            np.tile(np.eye(2), (n, 1, 1)),
            np.zeros(n),
            np.full(n, np.inf),
            np.full(n, parameters.sigma_a_px_s2),
        )
        self.limits = SolveLimits(parameters.max_sigma_m, np.deg2rad(parameters.max_sigma_deg))
        self._misfit = 1.0  # running mean of chi2 / dof
        self._recent: deque[float] = deque(maxlen=9)  # the last ones
        self._accelerations = np.array([parameters.pose_sigma_a_m_s2, parameters.pose_sigma_a_rad_s2])
        self._anchor: tuple[Pose, float] | None = None  # last measured pose and its age, s
        self._fastest = np.zeros(2)  # m/s and rad/s: the fastest that the vehicle was seen to move
        self._labelled = False
        self._frames_since_try = 0
        self._told_tie = False

    @property
    def noise_scale(self) -> float:
        """How much larger than claimed the spots' errors are; 1 while the misfit does not say otherwise."""
        return float(np.sqrt(self._misfit)) if self._misfit > SCALE_DEADBAND else 1.0

    def step(self, dt_s: float, found: Sequence[Detections | None]) -> TrackedFrame:
        """One frame. dt_s: time since the frame before (0 for the first); found: per camera, None without a picture."""
        self._predict(dt_s)
        events: list[Event] = []
        known = self.tracks.alive & self.tracks.rate_known
        predicted = np.where(known[:, None], self.tracks.x[:, :2], np.nan)
        n = len(self.model)
        point, gain = np.full(n, UNMATCHED), np.full(n, np.nan)
        turned = np.zeros(n, dtype=bool)
        fit: PoseFit | None = None
        found = [None if f is None else self._usable(f) for f in found]

        if not self._labelled:
            fit, point = self._acquire(found, self.prior, events, "labelled")
        else:
            point, turned, gain = self._match(found)
            fit, point, turned = self._pose(found, point, turned, events)
            if fit is None and self._should_search(found, point):
                recent = self._anchor is not None and self._anchor[1] <= 1.5 * dt_s
                kind = "relabelled" if recent else "reacquired"
                again, points = self._acquire(found, self._wide_prior(), events, kind)
                if again is not None:
                    fit, point = again, points
                    turned = self._far_from_prediction(found, point)
        return self._conclude(dt_s, found, predicted, point, turned, gain, fit, events)

    # -- prediction ---------------------------------------------------------------------------------------------------

    def _predict(self, dt_s: float) -> None:
        t = self.tracks
        if dt_s > 0:
            t.x, t.P = kalman.predict(t.x, t.P, dt_s, t.sigma_a)
            t.last_age_s = t.last_age_s + dt_s
            t.unseen_s = t.unseen_s + dt_s
            if self.motion is not None:
                a = self._accelerations
                self.motion = pose_filter.predict(self.motion, dt_s, float(a[0]), float(a[1]))
            if self._anchor is not None:
                self._anchor = (self._anchor[0], self._anchor[1] + dt_s)
            if self.parameters.method == "rigid" and self.motion is not None and self._pose_known():
                self._carry(np.ones(len(self.model), dtype=bool), self.motion)

    def _carry(self, views: Bools, motion: Motion) -> None:
        """Give tracks the position, the rate and their covariance that the vehicle's motion means for them."""
        t = self.tracks
        uv, J = self.model.project(motion.world_from_body)
        exists = ~np.isnan(uv[:, 0])
        rows = np.flatnonzero(views & exists)
        G = np.zeros((len(rows), 4, 12))
        G[:, :2, :6] = G[:, 2:, 6:] = J[rows]
        t.x[rows, :2], t.x[rows, 2:] = uv[rows], J[rows] @ motion.twist
        t.P[rows] = G @ motion.P @ np.swapaxes(G, -1, -2) + 1e-6 * np.eye(4)
        t.rate_known[rows] = bool(np.sqrt(np.max(np.diagonal(motion.P)[6:])) < RATE_KNOWN)
        t.alive = np.where(views, exists, t.alive)

    # -- matching -----------------------------------------------------------------------------------------------------

    def _usable(self, found: Detections) -> Detections:
        """Detections with the model's own error in their covariance."""
        floor = self.parameters.sigma_model_px**2 * np.eye(2)
        return replace(found, cov_px2=found.cov_px2 + floor)

    def _match(self, found: Sequence[Detections | None]) -> tuple[Ints, Bools, Array]:
        """The paper's matching in every camera: points, whether step 2 found them, gains, each (n,)."""
        t, p, model = self.tracks, self.parameters, self.model
        n = len(model)
        point, turned, gain = np.full(n, UNMATCHED), np.zeros(n, dtype=bool), np.full(n, np.nan)
        spread = np.sqrt(np.maximum(t.P[:, 0, 0], t.P[:, 1, 1]))
        r1 = np.clip(p.radius_sigmas * spread, p.r1_px, max(p.r1_px, p.max_radius_px))
        moved = np.linalg.norm(t.x[:, :2] - t.last, axis=-1)
        r2 = np.clip(1.5 * moved, p.r2_px, max(p.r2_px, p.max_radius_px))
        margin = p.image_margin_px + np.minimum(3 * spread, p.r1_px)
        in_view = t.alive & model.in_picture(t.x[:, :2], margin)
        for c, points in enumerate(found):
            rows = np.flatnonzero(in_view & (model.camera_of == c))
            if points is None or not len(rows):
                continue
            m = match(t.last[rows], t.x[rows, :2], r1[rows], r2[rows], points.uv_px, model.image_size_px[rows[0]], p)
            point[rows], turned[rows], gain[rows] = m.point, m.step == 2, m.gain
        return point, turned, gain

    def _far_from_prediction(self, found: Sequence[Detections | None], point: Ints) -> Bools:
        """Which matched views lie outside their first search region: the trajectory bent, or nobody looked."""
        uv, _ = self._pixels(found, point)
        gap = np.linalg.norm(uv - self.tracks.x[:, :2], axis=-1)
        return (point != UNMATCHED) & ~(self.tracks.alive & (gap <= self.parameters.r1_px))

    def _pixels(self, found: Sequence[Detections | None], point: Ints) -> tuple[Array, Array]:
        """Positions (n, 2) and covariances (n, 2, 2) of the matched points; nan without."""
        n = len(self.model)
        uv, cov = np.full((n, 2), np.nan), np.full((n, 2, 2), np.nan)
        for c, points in enumerate(found):
            rows = np.flatnonzero((self.model.camera_of == c) & (point != UNMATCHED))
            if points is not None and len(rows):
                uv[rows], cov[rows] = points.uv_px[point[rows]], points.cov_px2[point[rows]]
        return uv, cov

    # -- the pose as a witness ----------------------------------------------------------------------------------------

    def _start(self) -> Pose:
        return self.motion.world_from_body if self.motion is not None else self.prior.centre

    def _expected(self) -> tuple[Pose, Array] | None:
        return None if self.motion is None else (self.motion.world_from_body, self.motion.covariance)

    def _pose(
        self, found: Sequence[Detections | None], point: Ints, turned: Bools, events: list[Event]
    ) -> tuple[PoseFit | None, Ints, Bools]:
        """The pose from the matches, with the wrong ones dropped and the missed ones added. None: not observable."""
        rows = np.flatnonzero(point != UNMATCHED)
        if len(rows) < 3:
            return None, point, turned
        uv, cov = self._pixels(found, point)
        fit = fit_pose_robust(
            self.model,
            rows,
            uv[rows],
            cov[rows],
            self._start(),
            expected=self._expected(),
            limits=self.limits,
            noise_scale=self.noise_scale,
        )
        if fit is None:
            fit = self._blended_fit(rows, uv, cov)
        if fit is None or not good_enough(fit, self.limits):
            return None, point, turned
        if len(rows) < 4 and not self._plausible(fit):
            return None, point, turned
        if not self.parameters.rigid_check:
            return fit, point, turned
        before, point = point, point.copy()
        left_out = np.setdiff1d(rows, fit.rows)
        point[left_out] = UNMATCHED
        point, new = self._add_missed(found, point, fit)
        if new:
            rows = np.union1d(fit.rows, new)
            now, now_cov = self._pixels(found, point)
            wider = fit_pose(self.model, rows, now[rows], now_cov[rows], fit.world_from_body)
            if wider is not None and wider.consistent(self.limits.p_false_alarm):
                fit = wider
                turned = np.where(np.isin(np.arange(len(point)), new), self._far_from_prediction(found, point), turned)
            else:
                point[new] = UNMATCHED
        for view in left_out[point[left_out] == UNMATCHED]:
            taken = np.any((point == before[view]) & (self.model.camera_of == self.model.camera_of[view]))
            if not taken and np.linalg.norm(uv[view] - fit.projected_px[view]) < self.parameters.blend_px:
                # A neighbour that melts into a spot pulls its centre by a pixel or two: still it, but no witness.
                point[view] = before[view]
            else:
                events.append(Event("dropped", "contradicts the other spots: not this spot", int(view)))
        return fit, point, turned & (point != UNMATCHED)

    def _blended_fit(self, rows: Ints, uv: Array, cov: Array) -> PoseFit | None:
        """All spots, where none can be singled out but all lie near their places; the frame's own misfit widens it."""
        fit = fit_pose(self.model, rows, uv[rows], cov[rows], self._start())
        if fit is None or fit.dof <= 0 or np.linalg.norm(fit.residuals_px, axis=-1).max() > self.parameters.blend_px:
            return None
        return replace(fit, covariance=fit.covariance * max(1.0, fit.chi2 / fit.dof / self.noise_scale**2))

    def _plausible(self, fit: PoseFit) -> bool:
        """Whether three spots, which fit any labels, give a pose that the motion allows."""
        expected = self._expected()
        if expected is None:
            return False
        gap = fit.world_from_body.minus(expected[0])
        return float(gap @ np.linalg.solve(expected[1] + fit.covariance, gap)) < EXPECTED_GATE

    def _add_missed(self, found: Sequence[Detections | None], point: Ints, fit: PoseFit) -> tuple[Ints, list[int]]:
        """Detections where the pose puts spots that have none yet."""
        uv, J = fit.projected_px, fit.jacobian
        reach = point_covariance(J, fit.covariance)
        new: list[int] = []
        open_views = np.flatnonzero((point == UNMATCHED) & self.model.in_picture(uv, self.parameters.image_margin_px))
        for view in open_views:
            c = int(self.model.camera_of[view])
            points = found[c]
            if points is None or not len(points):
                continue
            taken = point[(self.model.camera_of == c) & (point != UNMATCHED)]
            gap = points.uv_px - uv[view]
            S = points.cov_px2 * self.noise_scale**2 + reach[view]
            d2 = np.sum(gap * np.linalg.solve(S, gap[..., None])[..., 0], axis=-1)
            d2[taken] = np.inf
            best = int(np.argmin(d2))
            if d2[best] < RIGID_GATE:
                point[view] = best
                new.append(int(view))
        return point, new

    # -- labels without a track ---------------------------------------------------------------------------------------

    def _should_search(self, found: Sequence[Detections | None], point: Ints) -> bool:
        """Whether to look for the whole vehicle anew: enough points are there, and the tracks give no pose."""
        if self._anchor is None or sum(len(f) for f in found if f is not None) < self.parameters.labels.min_spots:
            return False
        self._frames_since_try += 1
        # At once when light returns, then ever more rarely: what fails for long will fail in the next frame too.
        tries = self._frames_since_try
        return tries <= 10 or tries % 5 == 0

    def _wide_prior(self) -> PosePrior:
        """Around the last measured pose, as far as the vehicle may have got since."""
        assert self._anchor is not None
        pose, age = self._anchor
        p = self.parameters
        speed = p.reacquire_m_s + self._fastest[0]
        rate = np.deg2rad(p.reacquire_deg_s) + self._fastest[1]
        return PosePrior(
            pose,
            min(0.05 + speed * age, max(1.0, self.prior.within_m)),
            min(np.deg2rad(3.0) + rate * age, max(np.deg2rad(45.0), self.prior.within_rad)),
        )

    def _acquire(
        self, found: Sequence[Detections | None], prior: PosePrior, events: list[Event], kind: str
    ) -> tuple[PoseFit | None, Ints]:
        """Labels from a prior alone; the pose is refitted with the points' own covariances."""
        nothing = None, np.full(len(self.model), UNMATCHED)
        by_camera = {name: f for name, f in zip(self.model.camera_names, found, strict=True) if f is not None}
        result = find_labels(self.rig, self.model, by_camera, prior, self.parameters.labels)
        if result.chosen is None:
            if result.tie and not self._told_tie:
                events.append(Event("tie", self._tie_text(result)))
                self._told_tie = True
            return nothing
        point = np.where(result.chosen.point_of == NO_POINT, UNMATCHED, result.chosen.point_of)
        rows = np.flatnonzero(point != UNMATCHED)
        uv, cov = self._pixels(found, point)
        start = result.chosen.fit.world_from_body
        fit = fit_pose_robust(
            self.model, rows, uv[rows], cov[rows], start, limits=self.limits, noise_scale=self.noise_scale
        )
        if fit is None:
            # The labels hold within the model's error, the claimed sigmas do not: this frame's own misfit widens it.
            fit = fit_pose(self.model, rows, uv[rows], cov[rows], start)
            if fit is not None and fit.dof > 0:
                scale = max(1.0, fit.chi2 / fit.dof / self.noise_scale**2)
                fit = replace(fit, covariance=fit.covariance * scale)
        if fit is None or not good_enough(fit, self.limits):
            return nothing
        names = ", ".join(self.model.views[v][1] for v in rows)
        events.append(Event(kind, f"spots {names} found from the prior alone"))
        self._told_tie = False
        return fit, point

    def _tie_text(self, result: LabelResult) -> str:
        """Both candidates in words: which spots they name and where they put the vehicle."""
        parts = []
        for one in result.candidates[:2]:
            ypr = np.rad2deg(one.fit.world_from_body.ypr)
            x, y, z = one.fit.world_from_body.translation
            names = " ".join(self.model.views[v][1] for v in np.flatnonzero(one.point_of != NO_POINT))
            parts.append(
                f"spots {names} at x {x:.3f} y {y:.3f} z {z:.3f} m, yaw {ypr[0]:.2f} pitch {ypr[1]:.2f} roll {ypr[2]:.2f} deg"
            )
        return f"{result.reason}: " + " | ".join(parts)

    # -- modification -------------------------------------------------------------------------------------------------

    def _conclude(
        self,
        dt_s: float,
        found: Sequence[Detections | None],
        predicted: Array,
        point: Ints,
        turned: Bools,
        gain: Array,
        fit: PoseFit | None,
        events: list[Event],
    ) -> TrackedFrame:
        """Update filters and statuses from what was recognised."""
        n = len(self.model)
        measured_pose = fit is not None
        if fit is not None:
            self._labelled, self._frames_since_try = True, 0
            self._update_motion(fit, dt_s)
            if self._anchor is not None and self._anchor[1] > 0:
                move = fit.world_from_body.minus(self._anchor[0])
                moved = np.array([np.linalg.norm(move[:3]), np.linalg.norm(move[3:])]) / self._anchor[1]
                self._fastest = np.maximum(self._fastest, moved)
            self._anchor = (fit.world_from_body, 0.0)
        elif self.motion is not None:
            point = self._update_motion_partly(found, point)
            turned = turned & (point != UNMATCHED)

        uv, cov = self._pixels(found, point)
        seen = point != UNMATCHED
        cov = self._with_blends(fit, uv, cov, seen)
        estimate, estimate_cov, exists = self._estimates(fit, uv, cov)
        witness = seen if fit is None else np.isin(np.arange(n), fit.rows)
        self._update_tracks(uv, cov, witness, turned, estimate, estimate_cov, exists, measured_pose)
        t = self.tracks
        rest = ~seen
        uv = np.where(rest[:, None], np.where(exists[:, None], estimate, t.x[:, :2]), uv)
        cov = np.where(rest[:, None, None], np.where(exists[:, None, None], estimate_cov, t.P[:, :2, :2]), cov)
        status = self._statuses(found, seen, turned, uv, exists, fit)
        unknown = np.array([s in (SpotStatus.LOST, SpotStatus.OFF_SCREEN) for s in status])
        uv = np.where(unknown[:, None], np.nan, uv)
        t.alive = t.alive & ~unknown
        t.last = np.where(t.alive[:, None], uv, np.nan)
        t.last_cov = np.where(t.alive[:, None, None], cov, np.eye(2))
        t.last_age_s = np.zeros(n)
        pose_status, pose, covariance = self._pose_result(fit)
        return TrackedFrame(
            uv_px=uv,
            cov_px2=np.where(unknown[:, None, None], np.nan, cov),
            status=tuple(status),
            predicted_px=predicted,
            gain=np.where(seen, gain, np.nan),
            point=point,
            pose_status=pose_status,
            pose=pose,
            pose_covariance=covariance,
            spots_used=len(fit.rows) if fit is not None else (int(np.count_nonzero(seen)) if pose is not None else 0),
            rms_px=fit.rms_px if fit is not None else float("nan"),
            events=tuple(events),
        )

    def _update_motion(self, fit: PoseFit, dt_s: float) -> None:
        """The pose filter takes a measured pose, learns its accelerations, and the misfit is remembered."""
        covariance = fit.covariance * self.noise_scale**2
        if fit.dof > 0:
            self._learn_misfit(fit.chi2 / fit.dof)
        if self.motion is None:
            self.motion = pose_filter.begin(fit.world_from_body, covariance)
            return
        after, y, S = pose_filter.corrected_by_pose(self.motion, fit.world_from_body, covariance)
        nis = np.array([y[i] @ np.linalg.solve(S[i, i], y[i]) / 3 for i in (slice(0, 3), slice(3, 6))])
        if self._anchor is not None and self._anchor[1] <= 1.5 * dt_s:
            self._accelerations = self._accelerations * np.exp(SIGMA_A_RATE * (np.clip(nis, 0, 6) - 1))
            self._accelerations = np.clip(self._accelerations, 0.02, 2000.0)
        if nis.max() > 100.0:  # a bend or a return: the old velocities say nothing
            after = pose_filter.begin(fit.world_from_body, covariance)
        self.motion = after

    def _learn_misfit(self, misfit: float) -> None:
        """The slow mean; a blended spot now and then counts at most threefold, but when most fits misfit it jumps."""
        self._recent.append(misfit)
        usual = float(np.median(self._recent))
        if len(self._recent) == self._recent.maxlen and usual > 3 * max(self._misfit, 1.0):
            self._misfit = usual
        self._misfit *= 1 + (min(misfit / self._misfit, 3.0) - 1) / SCALE_MEMORY
        self._misfit = max(self._misfit, 0.1)

    def _update_motion_partly(self, found: Sequence[Detections | None], point: Ints) -> Ints:
        """Where the spots do not give the pose they still narrow its prediction; those beyond belief are let go."""
        assert self.motion is not None
        rows = np.flatnonzero(point != UNMATCHED)
        a = self._accelerations * np.sqrt(DARK_FACTOR**2 - 1)
        # The dark adds process noise on top of the ordinary prediction already made.
        grown = self.motion.P.copy()
        i = np.arange(6, 12)
        dt = self._anchor[1] if self._anchor is not None else 0.0
        grown[i, i] += np.repeat(a**2, 3) * min(dt, 0.1) ** 2 / 4
        motion = replace(self.motion, P=grown)
        if len(rows):
            uv, cov = self._pixels(found, point)
            projected, J = self.model.project(motion.world_from_body)
            y = uv[rows] - projected[rows]
            S = point_covariance(J[rows], motion.covariance) + cov[rows] * self.noise_scale**2
            nis = np.sum(y * np.linalg.solve(S, y[..., None])[..., 0], axis=-1)
            # With few spots a false point is as likely as a true one: it must be much more likely under the prediction.
            logdet = np.log(np.linalg.det(2 * np.pi * S))
            clutter = np.log(max(self.parameters.labels.clutter_per_px2, CLUTTER_NEAR_SPOTS))
            good = -0.5 * nis - 0.5 * logdet - clutter > self.parameters.labels.lead_nats
            point = point.copy()
            point[rows[~good]] = UNMATCHED
            rows, y = rows[good], y[good]
            if len(rows):
                R = np.zeros((2 * len(rows), 2 * len(rows)))
                for k, C in enumerate(cov[rows] * self.noise_scale**2):
                    R[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = C
                motion, _ = pose_filter.corrected(motion, y.ravel(), J[rows].reshape(-1, 6), R)
        self.motion = motion
        return point

    def _with_blends(self, fit: PoseFit | None, uv: Array, cov: Array, seen: Bools) -> Array:
        """Covariances, those of matched spots that the pose fit left out grown by how far they lie from it."""
        if fit is None:
            return cov
        blended = np.setdiff1d(np.flatnonzero(seen), fit.rows)
        if not len(blended):
            return cov
        gap2 = np.sum((uv[blended] - fit.projected_px[blended]) ** 2, axis=-1)
        cov = cov.copy()
        cov[blended] += gap2[:, None, None] * np.eye(2)
        return cov

    def _estimates(self, fit: PoseFit | None, uv: Array, cov: Array) -> tuple[Array, Array, Bools]:
        """Positions (n, 2) and covariances of all views from the others, and whether they exist."""
        n = len(self.model)
        if self.motion is None:
            return np.full((n, 2), np.nan), np.full((n, 2, 2), np.nan), np.zeros(n, dtype=bool)
        if fit is not None:
            position, J, covariance = fit.projected_px, fit.jacobian, fit.covariance * self.noise_scale**2
        else:
            position, J = self.model.project(self.motion.world_from_body)
            covariance = self.motion.covariance
        spread = point_covariance(J, covariance)
        exists = ~np.isnan(position[:, 0])
        if self.parameters.out_of_view == "quadratic":
            solved = quadratic_positions(self.rig, self.model, self.coplanar, uv)
            outside = exists & ~self.model.in_picture(position) & ~np.isnan(solved[:, 0])
            position = np.where(outside[:, None], solved, position)
        if self.parameters.estimate == "prediction":
            # The paper: a hidden spot's estimate is its own filter's prediction; outside the picture it is solved.
            hidden = self.tracks.alive & self.model.in_picture(position)
            position = np.where(hidden[:, None], self.tracks.x[:, :2], position)
            spread = np.where(hidden[:, None, None], self.tracks.P[:, :2, :2], spread)
        return position, spread, exists

    def _update_tracks(
        self,
        uv: Array,
        cov: Array,
        seen: Bools,
        turned: Bools,
        estimate: Array,
        estimate_cov: Array,
        exists: Bools,
        measured_pose: bool,
    ) -> None:
        """Matched: Kalman's update, or eq. (6) at a bend. Not matched: the estimate stands for the measurement."""
        t, p, motion = self.tracks, self.parameters, self.motion
        by_estimate = ~seen & exists & measured_pose
        if p.estimate == "prediction":
            by_estimate &= ~self.model.in_picture(estimate)
        use = seen | by_estimate
        z = np.where(seen[:, None], uv, estimate)
        R = np.where(seen[:, None, None], cov * self.noise_scale**2, estimate_cov)
        new = use & ~t.alive
        old = np.flatnonzero(use & t.alive)
        if len(old):
            t.rate_known[old] = True
            _, _, nis = kalman.innovation(t.x[old], t.P[old], z[old], R[old])
            # A bend too slight for the second search shows in the innovation, as it does outside the picture.
            bent = (turned[old] | (nis > BENT_NIS)) & p.curve_switch
            bent &= ~np.isnan(t.last[old, 0]) & (t.last_age_s[old] > 0)
            go, restart = old[~bent], old[bent]
            if len(go):
                t.x[go], t.P[go] = kalman.update(t.x[go], t.P[go], z[go], R[go])
            if len(restart):
                t.x[restart], t.P[restart] = kalman.restart(
                    z[restart], R[restart], t.last[restart], t.last_cov[restart], t.last_age_s[restart]
                )
            if p.learn_sigma_a:
                learn = seen[old] & ~turned[old]
                change = np.exp(SIGMA_A_RATE * (np.clip(nis / 2, 0, 6) - 1))
                t.sigma_a[old] = np.where(learn, np.clip(t.sigma_a[old] * change, *SIGMA_A_RANGE), t.sigma_a[old])
        # New tracks, and all that the pose filter alone carries, take position and rate from the vehicle's motion.
        carried = ~seen & exists & t.alive & ~np.asarray(measured_pose) & (p.estimate == "rigid")
        seed = new | carried
        if seed.any() and motion is not None:
            self._carry(seed, motion)
            at = np.where(use[:, None], z, estimate)
            here = seed & ~np.isnan(at[:, 0])
            t.x[here, :2], t.alive[here] = at[here], True
        t.unseen_s[use] = 0.0

    def _statuses(
        self,
        found: Sequence[Detections | None],
        seen: Bools,
        turned: Bools,
        uv: Array,
        exists: Bools,
        fit: PoseFit | None,
    ) -> list[SpotStatus]:
        """One word per view."""
        model, t = self.model, self.tracks
        inside = model.in_picture(uv)
        nothing = np.isnan(uv).any(axis=-1)
        known_pose = fit is not None or self._pose_known()
        out: list[SpotStatus] = []
        for i in range(len(model)):
            if seen[i]:
                out.append(SpotStatus.TURNED if turned[i] else SpotStatus.MATCHED)
            elif not self._labelled:
                out.append(SpotStatus.LOST)
            elif known_pose and not exists[i]:
                out.append(SpotStatus.OFF_SCREEN)
            elif nothing[i] or not (t.alive[i] and (known_pose or t.unseen_s[i] <= self.parameters.max_coast_s)):
                out.append(SpotStatus.LOST)
            elif found[int(model.camera_of[i])] is None:
                out.append(SpotStatus.NO_IMAGE)
            else:
                out.append(SpotStatus.OCCLUDED if inside[i] else SpotStatus.OUT_OF_VIEW)
        return out

    def _pose_known(self) -> bool:
        """Whether the predicted pose still says anything."""
        if self.motion is None:
            return False
        s = np.sqrt(np.maximum(np.diagonal(self.motion.covariance), 0))
        return bool(s[:3].max() < LOST_SIGMA_M and s[3:].max() < LOST_SIGMA_RAD)

    def _pose_result(self, fit: PoseFit | None) -> tuple[PoseStatus, Pose | None, Array | None]:
        if fit is not None:
            return PoseStatus.MEASURED, fit.world_from_body, fit.covariance * self.noise_scale**2
        if self.motion is not None and self._pose_known():
            return PoseStatus.PREDICTED, self.motion.world_from_body, self.motion.covariance
        return PoseStatus.LOST, None, None
