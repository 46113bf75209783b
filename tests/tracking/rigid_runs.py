"""Recordings as points, the answers of tracker and smoother, and their errors. For the tests."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.pose_prior import PosePrior
from geometry.rig import Rig
from geometry.uncertainty.rig_uncertainty import RigCovariance
from lab.simulate.points import CLUTTER, PointRun
from lab.simulate.scenarios import PriorRegion
from lab.simulate.scene import OCCLUDED, OUTSIDE, VISIBLE
from tracking.detections import UNMATCHED, Detections
from tracking.parameters import TrackerParameters
from tracking.rigid_body.rigid_tracker import RigidTracker
from tracking.smoothing.recording import TrackedRecording
from tracking.smoothing.smoothed import Smoothed
from tracking.smoothing.smoother import smooth
from tracking.statuses import PoseStatus, TrackedFrame

START = 10  # number of frames until the velocities are known
RIGID = TrackerParameters()
NEAR_THE_ORIGIN = PriorRegion((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.3, 15.0)


def prior_of(run: PointRun) -> PosePrior:
    """The prior that the recording states."""
    p = run.prior
    centre = Pose.from_ypr(np.deg2rad(p.yaw_pitch_roll_deg), np.array(p.position_m))
    return PosePrior(centre, p.within_m, float(np.deg2rad(p.within_deg)))


def found_in(run: PointRun, k: int) -> list[Detections | None]:
    return [d if run.has_image[k, c] else None for c, d in enumerate(run.detections[k])]


def dt_of(run: PointRun, k: int) -> float:
    return float(run.t_s[k] - run.t_s[k - 1]) if k else 0.0


def tracked(
    run: PointRun,
    parameters: TrackerParameters = RIGID,
    rig: Rig | None = None,
    covariance: RigCovariance | None = None,
    prior: PosePrior | None = None,
) -> list[TrackedFrame]:
    """The rigid tracker's answers for a recording; rig: the one given to the tracker, if not the true one."""
    tracker = RigidTracker(rig or run.rig, parameters, prior or prior_of(run), covariance)
    return [tracker.step(dt_of(run, k), found_in(run, k)) for k in range(len(run.frame))]


def smoothed_frames(
    run: PointRun,
    frames: list[TrackedFrame],
    parameters: TrackerParameters = RIGID,
    rig: Rig | None = None,
    covariance: RigCovariance | None = None,
) -> tuple[list[TrackedFrame], Smoothed]:
    """The smoother's answers, from the tracker's."""
    recording = TrackedRecording(rig or run.rig, parameters, covariance)
    for k, frame in enumerate(frames):
        recording.append(dt_of(run, k), found_in(run, k), frame)
    smoothed = smooth(recording)
    return [smoothed.frame(k, frame, found_in(run, k)) for k, frame in enumerate(frames)], smoothed


@dataclass(frozen=True, slots=True)
class Assessment:
    """Answers compared with the truth: T frames, n views."""

    labelled: Bools  # (T, n) a detection was labelled
    right: Bools  # (T, n) and is that spot
    visible: Bools  # (T, n) the spot was detected
    errors: Array  # (T, 6) of the poses; nan without
    nees: Array  # (T,) e^T P^-1 e of the poses (normalised estimation error squared); nan without
    bound: Array  # (T, 6) Cramer-Rao variances from the frame's own spots; nan where they do not determine the pose
    prediction: Array  # (T, n, 2) px: errors of the predicted pixels
    measured: Bools  # (T,) the pose is measured, not predicted

    @property
    def identity(self) -> float:
        """Share of the visible spots that are labelled correctly."""
        return float(np.sum(self.right & self.visible) / np.sum(self.visible))

    @property
    def wrong(self) -> int:
        return int(np.sum(self.labelled & ~self.right))

    @property
    def observable(self) -> Bools:
        """Frames that determine the pose by themselves, after the start."""
        return ~np.isnan(self.bound[:, 0]) & ~np.isnan(self.errors[:, 0]) & (np.arange(len(self.nees)) >= START)

    def missed(self) -> int:
        return int(np.sum(self.visible & ~self.right))


def assess(run: PointRun, frames: list[TrackedFrame]) -> Assessment:
    shape = run.in_view.shape
    origin: Ints = np.full(shape, CLUTTER)
    labelled = np.array([f.point != UNMATCHED for f in frames])
    for k, v in zip(*np.nonzero(labelled), strict=True):
        origin[k, v] = run.origin[k][run.model.camera_of[v]][frames[k].point[v]]
    visible = (run.in_view == VISIBLE) & run.has_image[:, run.model.camera_of]
    _, J = run.model.project(run.poses)
    errors, nees, bound = np.full((shape[0], 6), np.nan), np.full(shape[0], np.nan), np.full((shape[0], 6), np.nan)
    for k, f in enumerate(frames):
        A = J[k][visible[k]].reshape(-1, 6) / run.noise_px
        scale = np.maximum(np.linalg.norm(A, axis=0), 1e-9)
        if visible[k].sum() >= 3 and np.linalg.cond(A / scale) < 1e4:
            bound[k] = np.diagonal(np.linalg.inv(A.T @ A))
        if f.pose is not None and f.pose_covariance is not None:
            errors[k] = run.poses[k].minus(f.pose)
            nees[k] = errors[k] @ np.linalg.solve(f.pose_covariance, errors[k])
    prediction = np.array([f.predicted_px for f in frames]) - run.uv_px
    views = np.arange(shape[1])
    measured = np.array([f.pose_status is PoseStatus.MEASURED for f in frames])
    return Assessment(labelled, labelled & (origin == views), visible, errors, nees, bound, prediction, measured)


@dataclass(frozen=True, slots=True)
class Pooled:
    """Several recordings together."""

    some: list[Assessment]

    @property
    def identity(self) -> float:
        return float(sum(np.sum(j.right & j.visible) for j in self.some) / sum(np.sum(j.visible) for j in self.some))

    @property
    def wrong_share(self) -> float:
        return sum(j.wrong for j in self.some) / sum(int(np.sum(j.labelled)) for j in self.some)

    def nees(self, observable: bool = False) -> float:
        """Mean NEES / 6 of all poses, or of those in observable frames."""
        values = np.concatenate([j.nees[j.observable] if observable else j.nees for j in self.some])
        return float(np.nanmean(values) / 6)

    def over_bound(self, rotation: bool = True) -> float:
        """Ratio of the root mean square error of attitude or position to that of the single-frame bound.

        Of measured poses: one that is predicted across a corner may be far from the bound of spots that it leaves out.
        """
        part = slice(3, 6) if rotation else slice(0, 3)
        use = [j.observable & j.measured for j in self.some]
        squares = sum(
            (np.sum(j.errors[u][:, part] ** 2, axis=0) for j, u in zip(self.some, use, strict=True)), np.zeros(3)
        )
        bounds = sum((np.sum(j.bound[u][:, part], axis=0) for j, u in zip(self.some, use, strict=True)), np.zeros(3))
        return float(np.sqrt(np.mean(squares / bounds)))

    def prediction_px(self) -> Array:
        """Root mean square errors (2,) per axis of the pixels predicted for visible spots, after the start."""
        values = np.concatenate([j.prediction[START:][j.visible[START:] & j.right[START:]] for j in self.some])
        return np.asarray(np.sqrt(np.nanmean(values**2, axis=0)))


def around_jumps(run: PointRun, which: str, frames: int, seed: int) -> Bools:
    """Occlusions (T, n) of so many frames about each velocity jump: of `one` spot, `two`, a `screen` or `all`."""
    rng = np.random.default_rng([seed, 7])
    hide = np.zeros(run.in_view.shape, dtype=bool)
    views, free = np.arange(hide.shape[1]), START
    for jump in np.flatnonzero(run.turned).tolist():
        first = jump - frames // 2 - int(rng.integers(0, 2))
        if first < free:
            continue
        free = first + frames + START
        if which == "screen":
            hidden_views = views[run.model.camera_of == rng.integers(len(run.model.camera_names))]
        else:
            hidden_views = rng.choice(views, {"one": 1, "two": 2, "all": len(views)}[which], replace=False)
        hide[first : first + frames, hidden_views] = True
    return hide


def recording_of(
    rig: Rig,
    poses: Pose,
    t_s: Array,
    noise_px: float,
    seed: int,
    turned: Bools | None = None,
    hide: Bools | None = None,
    prior: PriorRegion = NEAR_THE_ORIGIN,
) -> PointRun:
    """A recording of a motion (T poses at t_s) as points, without false ones. hide (T, n): occluded spots."""
    model, frames = SpotModel.of(rig), len(t_s)
    uv = model.project(poses)[0]
    rng = np.random.default_rng([seed, 3])
    detected = model.in_picture(uv) & ~(np.zeros(uv.shape[:2], dtype=bool) if hide is None else hide)
    noisy = uv + noise_px * rng.normal(size=uv.shape)
    detections, origin = [], []
    for k in range(frames):
        rows = [np.flatnonzero(detected[k] & (model.camera_of == c)) for c in range(len(model.camera_names))]
        cov = noise_px**2 * np.eye(2)
        detections.append(tuple(Detections.at(noisy[k, r], np.tile(cov, (len(r), 1, 1))) for r in rows))
        origin.append(tuple(rows))
    return PointRun(
        seed=seed,
        rig=rig,
        model=model,
        prior=prior,
        noise_px=noise_px,
        frame=np.arange(frames),
        t_s=t_s,
        poses=poses,
        uv_px=uv,
        in_view=np.where(model.in_picture(uv), np.where(detected, VISIBLE, OCCLUDED), OUTSIDE),
        has_image=np.ones((frames, len(model.camera_names)), dtype=bool),
        turned=np.zeros(frames, dtype=bool) if turned is None else turned,
        detections=tuple(detections),
        origin=tuple(origin),
    )


def zig_zag(
    seed: int, frames: int, frame_rate_hz: float, every: int, rate_rad_s: float, start: Pose
) -> tuple[Pose, Array, Bools]:
    """Uniform motion between corners at random moments of a step: poses (T), times (T,), frames after a corner (T,).

    A corner every so many frames, forth and back; rate_rad_s: 1 sigma of the angular rate about each axis; that of the
    velocities is a third of it, m/s.
    """
    rng = np.random.default_rng([seed, 5])
    t_s = np.arange(frames) / frame_rate_hz
    before = np.arange(every, frames - every // 2, every)  # the bend lies between this frame and the next
    knots = np.concatenate([[0.0], (before + rng.random(len(before))) / frame_rate_hz])
    velocities = rate_rad_s * rng.normal(size=(len(knots), 6)) * np.repeat([1 / 3, 1.0], 3)
    velocities = np.abs(velocities) * np.sign(velocities[0]) * (-1.0) ** np.arange(len(knots))[:, None]
    at_knots = [start]
    for length, velocity in zip(np.diff(knots), velocities, strict=False):
        at_knots.append(at_knots[-1].plus(velocity * length))
    piece = np.searchsorted(knots, t_s, side="right") - 1
    poses = Pose.stack(at_knots)[piece].plus(velocities[piece] * (t_s - knots[piece])[:, None])
    return poses, t_s, np.isin(np.arange(frames), before + 1)


def selected_frames(run: PointRun, frames: Ints) -> PointRun:
    """The same recording with only these frames, as if the others had been dropped."""
    return replace(
        run,
        frame=run.frame[frames],
        t_s=run.t_s[frames],
        poses=run.poses[frames],
        uv_px=run.uv_px[frames],
        in_view=run.in_view[frames],
        has_image=run.has_image[frames],
        turned=run.turned[frames],
        detections=tuple(run.detections[k] for k in frames),
        origin=tuple(run.origin[k] for k in frames),
    )


def without_pictures(run: PointRun, frames: slice, camera: int) -> PointRun:
    """The recording without this camera's pictures in some frames."""
    has_image = run.has_image.copy()
    has_image[frames, camera] = False
    return replace(run, has_image=has_image)


def with_occlusions(run: PointRun, hide: Bools) -> PointRun:
    """The recording with the spots of `hide` (T, n) occluded. False points are not changed."""
    detections, origins = [], []
    for k in range(len(run.frame)):
        keep = [np.array([o == CLUTTER or not hide[k, o] for o in of], dtype=bool) for of in run.origin[k]]
        detections.append(tuple(d[rows] for d, rows in zip(run.detections[k], keep, strict=True)))
        origins.append(tuple(of[rows] for of, rows in zip(run.origin[k], keep, strict=True)))
    in_view = np.where(hide & (run.in_view == VISIBLE), OCCLUDED, run.in_view)
    return replace(run, in_view=in_view, detections=tuple(detections), origin=tuple(origins))
