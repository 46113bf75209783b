"""Recordings that fit nothing: which one usual mistake in the stand's record, or in the spots' labels, explains it.

The spots of a position give the vehicle's pose by the beams as drawn, without the stand's record. So a changed record
is judged by whether it moves as these poses do, which is fast; and labels by whether the poses fit their own spots.
What looks right is then calibrated with: only a calibration that most spots agree with is a diagnosis.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from calibration.beams.beam_start import body_poses, stand_of
from calibration.beams.beams import StandModel, calibrate_beams
from calibration.least_squares.adjustment import AdjustmentError
from calibration.least_squares.parameter_blocks import Poses
from calibration.terms.spot_term import SpotPixels
from geometry.arrays import Array, Ints
from geometry.pose import Pose
from geometry.rig import Rig
from geometry.uncertainty.rig_parameters import RigCovariance

_MOST_POSITIONS = 60  # looked at: more tell no more
_FOR_LABELS = 12  # positions whose spots are fitted with each exchange of labels
_FAR_BETTER = 0.3  # times the misfit now, at most, for a change to be tried in earnest
_AGREE = 0.8  # share of the spots that must agree once the mistake is mended
_TRIED = 4  # changes tried in earnest, the most likely first
_FEWEST = 6  # positions that a shifted record must share with the spots


@dataclass(frozen=True, slots=True)
class SuspectPose:
    """A mistake that, once mended, lets the spots agree."""

    in_labels: bool  # or else in the stand's record
    words: str  # what was done so that they fit
    remedy: str


def suspect(
    rig: Rig, spots: SpotPixels, stand: StandModel, knowledge: RigCovariance | None = None
) -> SuspectPose | None:
    """The mistake that explains why the spots do not agree; None where none of the usual ones does.

    Arguments as of calibrate_beams, which did not find enough spots that agree. rig: beams as drawn, which are needed.
    """
    likely = [*_of_records(rig, spots, stand), *_of_labels(rig, spots, stand)]
    likely.sort(key=lambda change: change.misfit)
    fits = ((c, _agreeing(rig, c, knowledge)) for c in likely[:_TRIED])
    best = max(fits, key=lambda pair: pair[1], default=None)
    return best[0].of if best is not None and best[1] >= _AGREE else None


@dataclass(frozen=True, slots=True)
class _Change:
    of: SuspectPose
    misfit: float  # against the one as it is
    spots: SpotPixels
    stand: StandModel


def _agreeing(rig: Rig, change: _Change, knowledge: RigCovariance | None) -> float:
    """Share of the spots that agree after a change; 0 where nothing is found."""
    try:
        return float(np.mean(calibrate_beams(rig, change.spots, change.stand, knowledge).fit.kept))
    except AdjustmentError:
        return 0.0


# The stand's record -----------------------------------------------------------------------------------------------


def _of_records(rig: Rig, spots: SpotPixels, stand: StandModel) -> list[_Change]:
    count = len(stand.stand_from_body.translation)
    looked = np.arange(min(count, _MOST_POSITIONS))
    fits = body_poses(rig, spots.pick(spots.position < len(looked)), len(looked))
    usable = np.array([k for k in looked if fits[k] is not None], dtype=np.int64)
    if len(usable) < _FEWEST:
        return []
    bodies = Poses.of([f.world_from_body for f in fits if f is not None]).pose
    now = _apart(bodies, stand.stand_from_body[usable])
    out = []
    for of, poses in _other_records(stand.stand_from_body):
        miss = _apart(bodies, poses[usable])
        if miss < _FAR_BETTER * now:
            out.append(_Change(of, miss / now, spots, replace(stand, stand_from_body=poses)))
    sigmas = np.broadcast_to(np.asarray(stand.pose_sigmas, dtype=float), (count, 6))
    for n in _shifts(count):
        both = (usable + n >= 0) & (usable + n < count)
        if np.sum(both) < _FEWEST:
            continue
        miss = _apart(bodies[both], stand.stand_from_body[usable[both] + n])
        if miss < _FAR_BETTER * now:
            there = (spots.position + n >= 0) & (spots.position + n < count)
            moved = spots.pick(there)
            moved = replace(moved, position=moved.position + n)
            out.append(_Change(_shifted(n), miss / now, moved, replace(stand, pose_sigmas=sigmas)))
    return out


def _other_records(poses: Pose) -> Iterator[tuple[SuspectPose, Pose]]:
    """The record with a usual mistake mended."""
    q, t = poses.quaternion_wxyz, poses.translation
    yield (
        SuspectPose(
            False, "with their quaternions read in the order x, y, z, w", "write them in the order qw, qx, qy, qz"
        ),
        Pose.from_quaternion(np.roll(q, 1, axis=-1), t),
    )
    yield (
        SuspectPose(False, "inverted", "write stand_from_body, the body's pose in the stand, and not its inverse"),
        poses.inverse(),
    )
    turned = np.swapaxes(poses.rotation, -1, -2)
    yield (
        SuspectPose(False, "with their turns reversed", "write quaternions that turn from the body into the stand"),
        Pose(turned, t),
    )
    for factor, unit in ((1e-3, "millimetres"), (1e-2, "centimetres"), (1e3, "kilometres")):
        remedy = "write x_m, y_m, z_m in metres"
        words = f"with their positions times {factor:g} ({unit} were written)"
        yield SuspectPose(False, words, remedy), Pose(poses.rotation, factor * t)


def _shifts(count: int) -> Sequence[int]:
    return [n for n in range(-(count // 2), count // 2 + 1) if n]


def _shifted(n: int) -> SuspectPose:
    rows = f"{abs(n)} row{'' if abs(n) == 1 else 's'} {'above' if n < 0 else 'below'}"
    return SuspectPose(
        False,
        f"when each position takes the pose {rows}",
        "the positions' numbers in spots and poses are shifted against each other: number both alike",
    )


def _apart(bodies: Pose, records: Pose) -> float:
    """How far the poses by the spots are from the records, by the median, m and rad together; the stand anywhere."""
    away = (stand_of(bodies, records) @ records).minus(bodies)
    return float(np.median(np.linalg.norm(away, axis=-1)))


# Labels -----------------------------------------------------------------------------------------------------------


def _of_labels(rig: Rig, spots: SpotPixels, stand: StandModel) -> list[_Change]:
    """Pairs of spots whose labels are exchanged in every picture of one camera."""
    few = spots.pick(spots.position < _FOR_LABELS)
    count = min(_FOR_LABELS, len(stand.stand_from_body.translation))
    now = _own_misfit(rig, few, count)
    views, out = rig.views(), []
    for a, b in combinations(range(len(views)), 2):
        if views[a][0] != views[b][0]:
            continue
        miss = _own_misfit(rig, exchanged(few, a, b), count)
        if miss < _FAR_BETTER * now:
            camera, first, second = views[a][0], views[a][1], views[b][1]
            of = SuspectPose(
                True,
                f"with the labels {first} and {second} of camera {camera!r} exchanged everywhere",
                "exchange them in the table of spots, or in target.spots",
            )
            out.append(_Change(of, miss / now, exchanged(spots, a, b), stand))
    return out


def exchanged(spots: SpotPixels, a: int, b: int) -> SpotPixels:
    """The spots with two views exchanged."""
    view: Ints = np.where(spots.view == a, b, np.where(spots.view == b, a, spots.view))
    return replace(spots, view=view)


def _own_misfit(rig: Rig, spots: SpotPixels, count: int) -> float:
    """How badly the spots of a position fit the beams as drawn, by the median position, sigmas; inf for not at all."""
    fits = body_poses(rig, spots, count)
    each: Array = np.array([np.inf if f is None or f.dof <= 0 else np.sqrt(f.chi2 / f.dof) for f in fits])
    return float(np.median(each)) if len(each) else float("inf")
