"""Mistakes that a refinement absorbs: with one of them made, another rig within the stated sigmas fits as well."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from calibration.least_squares.adjustment import AdjustmentError
from calibration.model_check.linearised_frames import ModelCheckRecording
from calibration.rig.refinement import FEWEST_SPOTS, Refinement, refine
from geometry.arrays import Array, Ints, evenly_spaced, finite
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.pose_prior import PosePrior
from geometry.rig import Rig
from geometry.rotations import matrix_from_quaternion
from geometry.uncertainty.rig_uncertainty import RigCovariance, RigUncertainty
from lab.calibrate.refine.recordings import LabelledRun
from lab.files.run.run_file import Run
from lab.files.run.truth import load_run_truth
from lab.findings.finding import Finding, Level, finding, sentence
from lab.runs.setup_check import not_shown
from tracking.detections import Detections
from tracking.labelling.points import NO_POINT
from tracking.labelling.search import candidate_labellings
from tracking.parameters import LabelParameters
from tracking.setup_mistakes.evidence import Invisible, invisible_mistakes
from tracking.setup_mistakes.possible import Mistake, PictureChange

P_CHANGE = 1e-4  # p-value below which the stated sigmas do not explain the changes
NOISY = 1.5  # residuals over their sigmas: the limit of the model check
_FRAMES = 40  # of a recording, with which the rigs are compared
_LOST = 0.05  # share of the spots that may be outliers of the other rig
_FARTHER = 1.5, 0.05  # times the motion from one frame to the next, and m, rad: the body moves about another point


def hidden_mistakes(
    rig: Rig, covariance: RigCovariance, runs: Sequence[LabelledRun], stacks: Collection[str]
) -> tuple[Finding, ...]:
    """Findings on mistakes that a run does not show: without them, another rig and another first pose fit as well.

    rig, covariance: as stated. stacks: those that are refined. The other first pose is within the prior of the run. A
    pose in truth/pose.csv decides.
    """
    out: dict[str, Finding] = {}
    for labelled in runs:
        known = _KnownPose.of(labelled.run, labelled.recording)
        recording = _sample(labelled.in_views_of(rig), known)
        if not len(recording.seen):
            continue
        prior, parameters = labelled.run.prior or PosePrior.everywhere(rig), labelled.run.tracker.labels
        given = None
        for one in invisible_mistakes(rig, prior, parameters, recording.poses[0], covariance):
            if one.is_harmless or one.mistake.what in out:
                continue
            other = _without(one.mistake, rig, recording, (prior, parameters), covariance)
            given = given or _fit(rig, covariance, recording, stacks)
            if given is None or other is None:
                continue
            if not _as_good(_fit(one.mistake.rig, covariance, other, stacks), given, other):
                continue
            if known is None:
                out[one.mistake.what] = not_shown(one, labelled.run.name)
            elif known.is_nearer(other, recording):
                out[one.mistake.what] = _shown(one, labelled.run.name)
    return tuple(out.values())


def _shown(one: Invisible, run: str) -> Finding:
    what = f"{run}: {one.mistake.what}: with it the poses contradict truth/pose.csv, without it they agree"
    return finding("BP-M06", Level.FAIL, what, remedy=sentence(one.mistake.remedy))


@dataclass(frozen=True, slots=True)
class _KnownPose:
    """A pose of truth/pose.csv."""

    t_s: float
    pose: Pose

    @staticmethod
    def of(run: Run, recording: ModelCheckRecording) -> _KnownPose | None:
        """The one nearest in time to a frame with a pose; None without any."""
        truth, known = load_run_truth(run), finite(recording.poses.translation, -1)
        if truth is None or truth.pose is None or not len(truth.pose.t_s) or not known.any():
            return None
        away = np.abs(truth.pose.t_s - recording.t_s[known][:, None]).min(axis=0)
        i = int(np.argmin(away))
        place = Pose(matrix_from_quaternion(truth.pose.quaternion_wxyz[i]), truth.pose.position_m[i])
        return _KnownPose(float(truth.pose.t_s[i]), place)

    def is_nearer(self, one: ModelCheckRecording, other: ModelCheckRecording) -> bool:
        """Whether the poses of one recording are nearer to it than those of another one with the same frames."""
        k = int(np.argmin(np.abs(one.t_s - self.t_s)))
        a, b = (np.linalg.norm(r.poses[k].minus(self.pose)) for r in (one, other))
        return bool(a < b)


def _sample(recording: ModelCheckRecording, known: _KnownPose | None) -> ModelCheckRecording:
    """Evenly spaced frames with a pose that spots check, the first of them and that of a known pose included."""
    rows = np.flatnonzero(finite(recording.poses.translation, -1) & (recording.usable.sum(axis=1) >= FEWEST_SPOTS))
    chosen = [*rows[:1], *evenly_spaced(rows, _FRAMES)]
    if known is not None and len(rows):
        chosen.append(rows[np.argmin(np.abs(recording.t_s[rows] - known.t_s))])
    return recording.at(np.unique(np.array(chosen, dtype=np.int64)))


def _fit(
    rig: Rig, covariance: RigCovariance, recording: ModelCheckRecording, stacks: Collection[str]
) -> Refinement | None:
    """The rig refined by one recording; None where it does not converge."""
    try:
        return refine(rig, covariance, [recording], stacks=stacks, for_labels=True)
    except AdjustmentError:
        return None


def _as_good(one: Refinement | None, given: Refinement, recording: ModelCheckRecording) -> bool:
    """Whether another rig explains a recording within the limits that a refinement has, and as well as the given."""
    if one is None or one.p_change < min(P_CHANGE, given.p_change):
        return False
    noisier = max(one.noise[name] / given.noise[name] for name in given.noise)
    return noisier < NOISY and one.excluded - given.excluded <= _LOST * recording.seen.sum()


def _without(
    mistake: Mistake,
    given: Rig,
    recording: ModelCheckRecording,
    search: tuple[PosePrior, LabelParameters],
    covariance: RigCovariance,
) -> ModelCheckRecording | None:
    """The recording as it is without a mistake, with other labels and poses; None where a frame does not fit."""
    model, labelled = SpotModel.of(mistake.rig), SpotModel.of(given)
    calibration, (near, parameters) = RigUncertainty(mistake.rig, model, covariance), search
    used, poses = recording.usable, []
    source = np.full((len(used), len(model)), NO_POINT)  # the view as whose spot a spot has been labelled
    for k in range(len(used)):
        views = {name: np.flatnonzero(used[k] & (labelled.camera_of == c)) for c, name in enumerate(given.cameras)}
        found = {name: Detections.at(recording.uv_px[k, of], recording.cov_px2[k, of]) for name, of in views.items()}
        if k:
            step = recording.poses[k].minus(recording.poses[k - 1])
            size, turn = (_FARTHER[0] * float(np.linalg.norm(part)) + _FARTHER[1] for part in (step[:3], step[3:]))
            near = PosePrior(poses[-1], size, turn)
        points = mistake.points([{}, found, {}])
        best = candidate_labellings(mistake.rig, model, points, near, parameters, calibration, most=1)
        if not best or np.count_nonzero(best[0].point_of != NO_POINT) < np.count_nonzero(used[k]):
            return None
        poses.append(best[0].fit.world_from_body)
        for v in np.flatnonzero(best[0].point_of != NO_POINT):
            source[k, v] = views[_source(mistake, model.views[v][0])][best[0].point_of[v]]
    return _relabelled(mistake, model, recording, source, Pose.stack(poses))


def _source(mistake: Mistake, camera: str) -> str:
    """The camera under whose name the pictures of a camera are recorded."""
    return mistake.pictures[camera].source if camera in mistake.pictures else camera


def _relabelled(
    mistake: Mistake, model: SpotModel, recording: ModelCheckRecording, source: Ints, poses: Pose
) -> ModelCheckRecording:
    """The spots `source` (T, n) of a recording, with -1 for none, as those of n other views."""
    changes = [mistake.pictures.get(camera, PictureChange(camera)) for camera, _ in model.views]
    turn, shift = (np.stack([getattr(c, name) for c in changes]) for name in ("turn", "shift"))
    seen, rows = source != NO_POINT, np.arange(len(source))[:, None]

    def turned(values: Array) -> Array:
        return np.where(seen[..., None], np.einsum("nij,knj->kni", turn, values[rows, source]), np.nan)

    velocity, clocks = recording.velocity_px_s, recording.clock_s
    cameras = list(mistake.rig.cameras)
    views = [next(v for v, (camera, _) in enumerate(model.views) if camera == _source(mistake, c)) for c in cameras]
    return ModelCheckRecording(
        recording.t_s, seen, turned(recording.uv_px) + shift,
        turn @ recording.cov_px2[rows, source] @ np.swapaxes(turn, -1, -2), poses,
        velocity_px_s=None if velocity is None else np.nan_to_num(turned(velocity)),
        clock_s=None if clocks is None else clocks[np.array(views)[model.camera_of]],
    )  # fmt: skip
