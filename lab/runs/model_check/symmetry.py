"""Mistakes that a recording does not show: with one of them made, another rig within the stated sigmas fits as well."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from calibration.least_squares.adjustment import AdjustmentError
from calibration.model_check.linearised_frames import ModelCheckRecording
from calibration.rig.recordings import STACKS
from calibration.rig.refinement import FEWEST_SPOTS, Refinement, refine
from geometry.arrays import Array, Ints, evenly_spaced, finite
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.pose_prior import PosePrior
from geometry.rig import Rig
from geometry.uncertainty.rig_uncertainty import RigCovariance, RigUncertainty
from tracking.detections import Detections
from tracking.labelling.points import NO_POINT
from tracking.labelling.search import candidate_labellings
from tracking.parameters import LabelParameters
from tracking.setup_mistakes.evidence import Invisible, invisible_mistakes
from tracking.setup_mistakes.possible import Mistake, PictureChange

_FRAMES = 40  # of a recording, with which the rigs are compared
_LESS_NATS = 4.0  # by which a rig may be less likely: of twenty that mirror the given one, the worst by 2.4
_FITTING = 0.8  # share of the frames that another rig must explain: others may have a wrong label
_LOST = 0.05  # share of the spots that may be outliers of the other rig
_FARTHER = 1.5, 0.05  # times the motion from one frame to the next, and m, rad: the body moves about another point


@dataclass(frozen=True, slots=True)
class Recorded:
    """A recording, and the rig and the first pose with which it has been labelled."""

    rig: Rig
    covariance: RigCovariance
    prior: PosePrior
    parameters: LabelParameters
    recording: ModelCheckRecording  # a few frames, the first of them that of the prior

    @staticmethod
    def of(
        rig: Rig,
        covariance: RigCovariance,
        prior: PosePrior | None,
        parameters: LabelParameters,
        recording: ModelCheckRecording,
        at_s: float | None = None,
    ) -> Recorded:
        """Of evenly spaced frames with a pose that spots check, with the one nearest to a time."""
        known = finite(recording.poses.translation, -1)
        rows = np.flatnonzero(known & (recording.usable.sum(axis=1) >= FEWEST_SPOTS))
        chosen = [*rows[:1], *evenly_spaced(rows, _FRAMES)]
        if at_s is not None and len(rows):
            chosen.append(rows[np.argmin(np.abs(recording.t_s[rows] - at_s))])
        some = recording.at(np.unique(np.array(chosen, dtype=np.int64)))
        return Recorded(rig, covariance, prior or PosePrior.everywhere(rig), parameters, some)

    def hidden(
        self, stacks: Collection[str] = STACKS, least: int = 0
    ) -> Iterator[tuple[Invisible, ModelCheckRecording | None]]:
        """Mistakes without which another rig and another first pose fit as well, and the recording without them.

        stacks: of the rig's numbers, those that are not as they are stated. least: of directions of these that must
        change the recording if the rig as stated is not symmetric.
        """
        if not len(self.recording.seen):
            return
        given = None
        for one in invisible_mistakes(self.rig, self.prior, self.parameters, self.recording.poses[0], self.covariance):
            if one.is_harmless:
                continue
            other = self._without(one.mistake)
            if not one.is_exact:
                if other is None:
                    continue
                given = given or _fit(self.rig, self.covariance, self.recording, stacks)
                if given is None or len(given.data[0].y) < least:
                    return
                if not _as_good(_fit(one.mistake.rig, self.covariance, other, stacks), given, other):
                    continue
            yield one, other

    def _without(self, mistake: Mistake) -> ModelCheckRecording | None:
        """The frames that fit without a mistake, with other labels and poses; None where many do not."""
        model, recorded, recording = SpotModel.of(mistake.rig), SpotModel.of(self.rig), self.recording
        calibration, near = RigUncertainty(mistake.rig, model, self.covariance), self.prior
        changes = [mistake.pictures.get(camera, PictureChange(camera)) for camera, _ in model.views]
        poses: list[Pose] = []
        rows: list[int] = []
        source = np.full((len(recording.seen), len(model)), NO_POINT)  # the view as whose spot a spot has been labelled
        for k, used in enumerate(recording.usable):
            views = {name: np.flatnonzero(used & (recorded.camera_of == c)) for c, name in enumerate(self.rig.cameras)}
            found = {n: Detections.at(recording.uv_px[k, of], recording.cov_px2[k, of]) for n, of in views.items()}
            if rows:
                step = recording.poses[k].minus(recording.poses[rows[-1]])
                size, turn = (_FARTHER[0] * float(np.linalg.norm(part)) + _FARTHER[1] for part in (step[:3], step[3:]))
                near = PosePrior(poses[-1], size, turn)
            points = mistake.points([{}, found, {}])
            best = candidate_labellings(mistake.rig, model, points, near, self.parameters, calibration, most=1)
            if not best or np.count_nonzero(best[0].point_of != NO_POINT) < np.count_nonzero(used):
                if not rows:
                    return None
                continue
            rows.append(k)
            poses.append(best[0].fit.world_from_body)
            for v in np.flatnonzero(best[0].point_of != NO_POINT):
                source[k, v] = views[changes[v].source][best[0].point_of[v]]
        as_recorded = np.array([camera not in mistake.pictures for camera, _ in model.views])
        same = (as_recorded & (source[rows] == np.arange(len(model)))) | (source[rows] == NO_POINT)
        if len(rows) < _FITTING * len(recording.seen) or same.all():
            return None  # the stated sigmas of the same spots are what a refinement tests
        clocks = recording.clock_s
        if clocks is not None:
            clocks = clocks[[recorded.camera_of.tolist().index(recorded.camera_names.index(c.source)) for c in changes]]
        return _relabelled(recording.at(np.array(rows)), source[rows], changes, Pose.stack(poses), clocks)


def _fit(
    rig: Rig, covariance: RigCovariance, recording: ModelCheckRecording, stacks: Collection[str]
) -> Refinement | None:
    """The rig refined by one recording; None where it does not converge."""
    try:
        return refine(rig, covariance, [recording], stacks=stacks, for_labels=True)
    except AdjustmentError:
        return None


def _as_good(one: Refinement | None, given: Refinement, recording: ModelCheckRecording) -> bool:
    """Whether another rig within the stated sigmas explains a recording as well as the given one."""
    if one is None or one.excluded - given.excluded > _LOST * recording.seen.sum():
        return False
    return _misfit(one, given) < _misfit(given, given) + 2 * _LESS_NATS


def _misfit(one: Refinement, given: Refinement) -> float:
    """Chi-square of the recordings and of the changes of the rig, with the noise of the given one."""
    white = one.before.excess(one.data)[0].white
    wider, usual = (r.correlation_frames * max(r.noise.values()) ** 2 for r in (one, given))
    return float(white @ white) + wider / usual * sum(d.rest for d in one.data)


def _relabelled(
    old: ModelCheckRecording, source: Ints, changes: Sequence[PictureChange], poses: Pose, clock_s: Array | None
) -> ModelCheckRecording:
    """The spots `source` (T, n) of a recording, with -1 for none, as those of n other views with changed pictures."""
    turn, shift = (np.stack([getattr(c, name) for c in changes]) for name in ("turn", "shift"))
    seen, rows, velocity = source != NO_POINT, np.arange(len(source))[:, None], old.velocity_px_s

    def turned(values: Array) -> Array:
        return np.where(seen[..., None], np.einsum("nij,knj->kni", turn, values[rows, source]), np.nan)

    return ModelCheckRecording(
        old.t_s, seen, turned(old.uv_px) + shift, turn @ old.cov_px2[rows, source] @ np.swapaxes(turn, -1, -2), poses,
        velocity_px_s=None if velocity is None else np.nan_to_num(turned(velocity)), clock_s=clock_s,
    )  # fmt: skip
