"""The inputs of a refinement: runs are tracked and smoothed with a rig, and their labelled spots kept.

What is known of the rig before: the covariance of its file, and sigmas given for some of its parts.
"""

from __future__ import annotations

import contextlib
import tempfile
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice, takewhile
from pathlib import Path
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from calibration.model_check.faults import pixel_velocities
from calibration.model_check.linearised_frames import ModelCheckRecording, with_clocks
from calibration.terms.rig_blocks import BEAMS, CAMERAS, SCREENS
from geometry.arrays import Array, finite, skew
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.pose_solver.visibility import assumed_range, poses_within
from geometry.rig import Rig
from geometry.uncertainty.chi_square import chi2_limit
from geometry.uncertainty.rig_uncertainty import (
    CLOCK,
    DIRECTION,
    POINT,
    POSE,
    ROW_TIME,
    TIME_OFFSET,
    RigCovariance,
    RigUncertainty,
    independent,
    is_known,
    split_name,
    unlimited,
)
from lab.errors import CalibrationError, InputError
from lab.files.run.clocks import CameraClock, clocks_in
from lab.files.run.run_file import Run
from lab.files.run.truth import load_run_truth
from lab.files.text.error_text import suggest_name
from lab.findings.finding import Finding, Level, finding, sentence
from lab.runs.frames.frames import FrameSet
from lab.runs.frames.moments import Moment
from lab.runs.frames.pipeline import FrameRecord, Frames, Pipeline
from lab.runs.model_check.check import ModelCheck, check_model
from lab.runs.model_check.frame_sampler import FrameSampler
from lab.runs.model_check.symmetry import Recorded
from lab.runs.setup_check import (
    SampledFrames,
    compared_with_mistakes,
    findings_of,
    has_doubtful_pictures,
    mistakes_by_themselves,
    not_shown,
    unused_cameras,
    unused_finding,
)
from lab.runs.smoothing_pass import TrackingAndSmoothing
from lab.runs.verdict.run_statistics import CameraStatistics, FrameChecks, RunStatistics
from tracking.detections import Detections
from tracking.statuses import PoseStatus, SpotStatus

LEAST_MEASURED = 0.9  # share of frames with a measured pose, below which usual mistakes of the set-up are tested
# Share of the residuals that the errors of the rig cause, as sigma of the tracker's model: with all of it, or none,
# rigs that are off by 10 px keep fewer labels (measured: 0.1 to 0.3 of the whole error, half of what no pose absorbs).
_EXPECTED = 0.5
_POSES = 2000  # of the prior, the one that shows most spots gives the size of the residuals
_P_SPOT = 1e-6  # probability that a spot is farther from its prediction than its camera's stated errors allow
MOST_NAMED = 3  # mistakes that the recordings do not show
_IN_REACH = 0.5  # share of a camera's spots that have a point nearer: the others may be hidden


@dataclass(frozen=True, slots=True)
class LabelledRun:
    """A run whose spots have labels."""

    run: Run
    recording: ModelCheckRecording  # of the run's own cameras; long recordings are thinned
    pictures: SampledFrames
    unlabelled: tuple[str, ...] = ()  # cameras whose points may be spots, and of which none has a label
    searched: bool = False  # whether mistakes of the set-up have been searched for, and none was found

    def in_views_of(self, rig: Rig) -> ModelCheckRecording:
        """The recording with the views of a rig that has further cameras."""
        views, own = rig.views(), self.run.rig.views()
        if views == own:
            return self.recording
        place, old = [views.index(v) for v in own], self.recording

        def wider(values: Any, fill: float | bool) -> Any:
            if values is None:
                return None
            out = np.full((len(values), len(views), *values.shape[2:]), fill, dtype=values.dtype)
            out[:, place] = values
            return out

        return replace(
            old, seen=wider(old.seen, False), uv_px=wider(old.uv_px, np.nan), cov_px2=wider(old.cov_px2, np.nan),
            predicted_px=wider(old.predicted_px, np.nan), predicted_cov_px2=wider(old.predicted_cov_px2, np.nan),
            width_px=None if old.width_px is None else wider(old.width_px[None], np.nan)[0],
            velocity_px_s=wider(old.velocity_px_s, 0.0),
            clock_s=None if old.clock_s is None else wider(old.clock_s[None], 0.0)[0],
        )  # fmt: skip

    def check(self, rig: Rig, covariance: RigCovariance) -> ModelCheck:
        """The model check of this recording with another rig."""
        run = with_rig(self.run, rig, covariance)
        model = SpotModel.of(run.rig)
        recording = with_clocks(model, self.recording, _clocks_of(run.rig)[model.camera_of])
        return check_model(run.rig, recording, run.covariance)


def with_rig(run: Run, rig: Rig, covariance: RigCovariance) -> Run:
    """The run with another rig, of which it has some cameras."""
    own = replace(rig, cameras={n: rig.cameras[n] for n in run.rig.cameras})
    known = covariance.part([is_known(own, name) for name in covariance.names])
    return replace(run, rig=own, covariance=known, clocks=clocks_in(own, known, run.clocks, run.rig))


def _clocks_of(rig: Rig) -> Array:
    """Offset and row time (cameras, 2), s, that a rig states."""
    return np.array([[getattr(c, number) for number in CLOCK] for c in rig.cameras.values()])


def _clocks_in_use(run: Run) -> Array:
    """Offset and row time (cameras, 2), s, of the cameras of a run: of its rig and its own."""
    clocks = [run.clocks.get(name, CameraClock()) for name in run.rig.cameras]
    return np.array([(c.offset_s, c.row_time_s) for c in clocks])


def tolerant(run: Run, times: float = 1.0) -> Run:
    """The run with a tracker that expects the residuals that the errors of its rig cause. times: so many of them."""
    model = SpotModel.of(run.rig)
    if run.covariance is None:
        return run
    # The centre of a wide prior may show no spot at all.
    poses = poses_within(assumed_range(run.rig) if run.prior is None else run.prior, _POSES)
    pose = poses[int(np.argmax(model.in_picture(model.project(poses)[0]).sum(axis=1)))]
    C = RigUncertainty(run.rig, model, run.covariance).at(pose)
    J = unlimited(model).project(pose)[1].reshape(-1, 6)
    seen = (np.diagonal(C) > 0) & finite(J, -1)
    J, C = J[seen], C[np.ix_(seen, seen)]
    left = np.eye(len(J)) - J @ np.linalg.pinv(J)
    # Where the pose absorbs all errors, the rest is rounding, of either sign.
    px = times * _EXPECTED * float(np.sqrt(max(np.trace(left @ C @ left), 0.0) / max(np.trace(left), 1.0)))
    return replace(run, tracker=replace(run.tracker, sigma_model_px=max(px, run.tracker.sigma_model_px)))


@dataclass(slots=True)
class _FirstFrames:
    """The first frames of a recording, until so many of them have a measured pose."""

    reader: Frames
    most: int
    enough: int
    measured: int = 0

    @property
    def notes(self) -> list[str]:
        return self.reader.notes

    @property
    def expected_frames(self) -> int | None:
        return self.reader.expected_frames

    @property
    def moments(self) -> Sequence[Moment] | None:
        return self.reader.moments

    def __iter__(self) -> Iterator[FrameSet]:
        return takewhile(lambda _: self.measured < self.enough, islice(self.reader, self.most))

    def count(self, record: FrameRecord) -> None:
        """Count a tracked frame."""
        self.measured += record.tracked.pose_status is PoseStatus.MEASURED


@dataclass(slots=True)
class _SpotsInReach:
    """Whether the points of cameras without labels may be their spots."""

    views: tuple[tuple[str, str], ...]  # camera and spot
    expected: Counter[str] = field(default_factory=Counter)  # spots that the pose puts into the camera's pictures
    near: Counter[str] = field(default_factory=Counter)  # of these, with a point where the stated errors allow it

    def count(self, record: FrameRecord, points: Mapping[str, Detections | None]) -> None:
        """Count the next frame."""
        tracked = record.tracked
        if tracked.pose_status is not PoseStatus.MEASURED or tracked.predicted_cov_px2 is None:
            return
        for v in (v for v, status in enumerate(tracked.status) if status is SpotStatus.OCCLUDED):
            name = self.views[v][0]
            found = points[name]
            if found is None or not len(found) or not np.isfinite(tracked.predicted_px[v]).all():
                continue
            off = found.uv_px - tracked.predicted_px[v]
            z2 = np.sum(
                off * np.linalg.solve(tracked.predicted_cov_px2[v] + found.cov_px2, off[..., None])[..., 0], axis=1
            )
            self.expected[name] += 1
            self.near[name] += bool(z2.min() < chi2_limit(_P_SPOT, 2))

    def allows(self, name: str) -> bool:
        """Whether the points of a camera may be its spots."""
        return self.expected[name] > 0 and self.near[name] >= _IN_REACH * self.expected[name]


def labelled(run: Run, most: int | None = None, enough: int = 0, *, given: Run | None = None) -> LabelledRun:
    """Track and smooth a run with its rig. most: number of frames after which it ends, or after `enough` with poses.

    given: with the rig as given, for which mistakes of the set-up are searched for where few frames have a pose or a
    camera has few labels; None: they are not.
    Raises CalibrationError: the recording shows a mistake in the set-up, such as exchanged cameras, which no refinement
    may absorb, or a camera without a spot where its stated errors allow it, or there is no frame at all.
    """
    camera_of = SpotModel.of(run.rig).camera_of
    sampler, pictures = FrameSampler(with_predicted=most is not None), SampledFrames()
    cameras = {name: CameraStatistics() for name in run.rig.cameras}
    statistics = RunStatistics(cameras, SpotModel.of(run.rig).views, run.tracker.labels.min_spots)
    reach = _SpotsInReach(statistics.views)
    with tempfile.TemporaryDirectory(prefix="beampose-refine-") as work:
        passes = TrackingAndSmoothing.of(Pipeline.of(run), Path(work))
        if most is not None:
            first = _FirstFrames(passes.pipeline.reader, most, enough)
            passes.pipeline.reader, passes.pipeline.on_record = first, first.count
        with contextlib.closing(passes.records()) as records:
            for record, _ in FrameChecks(run.rig, run.covariance).passed(records):
                points = dict(zip(run.rig.cameras, record.detections, strict=True))
                sampler.add_record(record, camera_of, run.tracker)
                pictures.add(record.frame, points)
                statistics.add(record)
                if most is None:
                    reach.count(record, points)
    recording = sampler.recording()
    if recording is None:
        raise CalibrationError(f"{run.folder}: there is no frame at all")
    # A camera without labels in the first frames may have them later, with a better rig.
    unused = unused_cameras(statistics) if most is None and statistics.measured else []
    wrong = [n for n in unused if not reach.allows(n)]
    few = statistics.measured <= LEAST_MEASURED * statistics.frames
    doubtful = most is None and has_doubtful_pictures(statistics)
    found, searched = mistakes_by_themselves(run.rig, run.prior), False
    if given is not None and (few or wrong or doubtful):
        more, searched = _searched(given, pictures)
        found = (*found, *more)
    _refuse(run, (*found, *(unused_finding(n, cameras[n].points, cameras[n].pictures) for n in wrong)))
    if passes.clocks is not None:
        model, estimated = SpotModel.of(run.rig), passes.pipeline.run
        clock_s = _clocks_of(run.rig) + (_clocks_in_use(estimated) - _clocks_in_use(run))
        velocity = np.nan_to_num(pixel_velocities(model, recording, np.arange(len(recording.seen))))
        recording = replace(recording, velocity_px_s=velocity, clock_s=clock_s[model.camera_of])
    return LabelledRun(run, recording, pictures, tuple(unused), searched)


def refuse_mistakes(used: LabelledRun, given: Run) -> None:
    """Raises CalibrationError: a run shows a mistake in the set-up. given: this run with the rig as given."""
    if not used.searched:
        _refuse(given, _searched(given, used.pictures)[0])


def _refuse(run: Run, found: Sequence[Finding]) -> None:
    if found:
        raise CalibrationError(f"{run.folder}: {found[0].what}. {found[0].remedy}")


def _searched(run: Run, pictures: SampledFrames) -> tuple[tuple[Finding, ...], bool]:
    """Mistakes of the set-up that sampled frames show, and whether all were tested and none found."""
    compared = compared_with_mistakes(run, pictures.blocks)
    if compared is None:
        return (), False
    found = tuple(f for f in findings_of(compared, run.rig) if f.level is Level.FAIL)
    return found, not found and not compared.given.is_certain


def hidden_mistakes(
    rig: Rig, prior: RigCovariance, runs: Sequence[LabelledRun], stacks: set[str]
) -> tuple[Finding, ...]:
    """Findings on mistakes that a run does not show; a pose in its truth decides."""
    out: dict[str, Finding] = {}
    for labelled in runs:
        run, known = labelled.run, _known_pose(labelled)
        at_s = None if known is None else known[0]
        given = Recorded.of(rig, prior, run.prior, run.tracker.labels, labelled.in_views_of(rig), at_s)
        for one, other in given.hidden(stacks):
            if known is None:
                out.setdefault(one.mistake.what, not_shown(one, run.name))
            elif other is not None:
                near = (r.poses[int(np.argmin(np.abs(r.t_s - known[0])))] for r in (other, given.recording))
                off = [np.linalg.norm(known[1].minus(pose)) for pose in near]
                if off[0] < off[1]:
                    what = f"{run.name}: {one.mistake.what}: only without this the poses agree with truth/pose.csv"
                    out[one.mistake.what] = finding("BP-M06", Level.FAIL, what, remedy=sentence(one.mistake.remedy))
    return tuple(sorted(out.values(), key=lambda f: -f.level)[:MOST_NAMED])


def _known_pose(labelled: LabelledRun) -> tuple[float, Pose] | None:
    """The time and pose in the truth of a run that are nearest to a frame with a pose; None without truth."""
    truth, recording = load_run_truth(labelled.run), labelled.recording
    if truth is None or truth.pose is None or not len(truth.pose.t_s):
        return None
    ours, known = recording.t_s[finite(recording.poses.translation, -1)], truth.pose
    i = int(np.argmin(np.abs(known.t_s - ours[:, None]).min(axis=0, initial=np.inf)))
    return float(known.t_s[i]), Pose.from_quaternion(known.quaternion_wxyz[i], known.position_m[i])


# What is known of a rig before a refinement: the covariance of its file, and sigmas given for some of its parts.


LENS, CLOCKS, SHUTTER = "lens", "clocks", "shutter"
GROUPS = (CAMERAS, SCREENS, BEAMS, LENS, CLOCKS, SHUTTER)
_OF_PARAMETER = {TIME_OFFSET: CLOCKS, ROW_TIME: SHUTTER}
_WHAT = {
    CAMERAS: ("position_m", "rotation_deg"),
    SCREENS: ("position_m", "rotation_deg"),
    BEAMS: ("point_m", "direction_deg"),
}


def free_group(name: str) -> str:
    """The group of `--free` to which a parameter belongs."""
    kind, _, parameter = split_name(name)
    if parameter in _OF_PARAMETER:
        return _OF_PARAMETER[parameter]
    return LENS if kind == CAMERAS and parameter not in POSE else kind


def stated_covariance(rig: Rig, stated: RigCovariance | None, sigmas: Mapping[str, Any], path: Path) -> RigCovariance:
    """The covariance of the file with the parts for which sigmas are given replaced.

    sigmas: by `cameras.position_m` (of all cameras), `cameras.left.rotation_deg` (of one), and so on; per axis, of a
    camera or screen about its own place, of a beam across its direction; `cameras.time_offset_s` and
    `cameras.row_time_s`. A part with sigmas has no correlation with others. Where the offset of every camera has one,
    that of the first is known: recordings show offsets from each other only. Raises InputError: for a name or value
    that is none, or if nothing is stated at all.
    """
    chosen = _chosen(rig, sigmas)
    parts = [_with_sigmas(rig, kind, part, values) for (kind, part), values in chosen.items()]
    if stated is not None:
        free = zip(stated.names, np.diagonal(stated.matrix), strict=True)
        parts.insert(0, stated.part([variance > 0 and _part_of(n) not in chosen for n, variance in free]))
    joint, offsets = independent(parts), [f"{CAMERAS}.{name}.{TIME_OFFSET}" for name in rig.cameras]
    if set(offsets) <= set(joint.names):
        joint = joint.part([n != offsets[0] for n in joint.names])
    if not joint.names:
        raise InputError(
            f"{path}: expected the covariance of its parameters, or sigmas, got neither; write the covariances, or add"
            " options such as --sigma cameras.position_m=0.005 --sigma cameras.rotation_deg=0.2"
        )
    return joint


def _part_of(name: str) -> tuple[str, str]:
    """The part to whose sigmas a parameter belongs: a kind and a name, or a number and the name of its camera."""
    kind, part, parameter = split_name(name)
    return (LENS if free_group(name) == LENS else parameter if parameter in CLOCK else kind), part


def _chosen(rig: Rig, sigmas: Mapping[str, Any]) -> dict[tuple[str, str], dict[str, float]]:
    """The sigmas of each part, by kind and name; those of one part replace those of all."""
    parts: dict[str, Sequence[str]] = {CAMERAS: list(rig.cameras), SCREENS: list(rig.screens), BEAMS: list(rig.beams)}
    out: dict[tuple[str, str], dict[str, float]] = {}
    for name, value in sorted(sigmas.items(), key=lambda item: item[0].count(".")):
        kind, _, rest = name.partition(".")
        part, _, what = rest.rpartition(".")
        clock = kind == CAMERAS and what in CLOCK
        if kind not in parts or (what not in _WHAT[kind] and not clock):
            known = [f"{k}.{w}" for k, of in (*_WHAT.items(), (CAMERAS, CLOCK)) for w in of]
            raise InputError(f"--sigma: expected one of {', '.join(known)}, got {name!r}{suggest_name(name, known)}")
        if part and part not in parts[kind]:
            raise InputError(
                f"--sigma {name}: expected one of the rig's {kind}, got {part!r}{suggest_name(part, parts[kind])}"
            )
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < 100:
            raise InputError(f"--sigma {name}: expected a number above 0 in m, deg or s, got {value!r}")
        for one in [part] if part else parts[kind]:
            out.setdefault((what if clock else kind, one), {})[what] = float(value)
    for (kind, part), values in out.items():
        missing = [w for w in _WHAT.get(kind, ()) if w not in values]
        if missing:
            raise InputError(
                f"--sigma: expected {kind}.{missing[0]} beside {kind}.{next(iter(values))}, got none for {part!r}"
            )
    return out


def _with_sigmas(rig: Rig, kind: str, part: str, values: Mapping[str, float]) -> RigCovariance:
    """The covariance of one part with these sigmas."""
    if kind in CLOCK:
        return RigCovariance((f"{CAMERAS}.{part}.{kind}",), np.array([[values[kind] ** 2]]))
    length, angle = (values[w] for w in _WHAT[kind])
    angle = float(np.deg2rad(angle))
    if kind == BEAMS:
        d = rig.beams[part].direction
        across = np.eye(3) - np.outer(d, d)
        matrix = block_diag(angle**2 * across, length**2 * across)
        return RigCovariance(tuple(f"beams.{part}.{n}" for n in (*DIRECTION, *POINT)), matrix)
    own = np.diag(np.repeat([length**2, angle**2], 3))
    if kind == CAMERAS:
        pose = rig.cameras[part].camera_from_world
        # The camera turns about its own centre, as in calibration/model_check/faults.py.
        D = np.block([[np.eye(3), -skew(pose.translation)], [np.zeros((3, 3)), pose.rotation.T]])
        own = D @ own @ D.T
    return RigCovariance(tuple(f"{kind}.{part}.{n}" for n in POSE), own)
