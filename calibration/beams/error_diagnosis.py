"""Diagnosis of inconsistent recordings: a common mistake in the stand's record or in the spots' labels.

The spots of a position and the nominal beams give the vehicle's pose without the stand's record. A changed record is
therefore scored by its agreement with these poses, which is fast; changed labels by the residuals of the poses' own
spots. The best candidates are then used in a calibration: only if most spots agree with it is the mistake reported.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from calibration.beams.beams import StandModel, calibrate_beams
from calibration.beams.spot_fit import body_poses, stand_of
from calibration.least_squares.adjustment import AdjustmentError, Poses
from calibration.terms.rig_blocks import SpotPixels
from geometry.arrays import Array, Ints
from geometry.pose import Pose
from geometry.rig import Rig
from geometry.uncertainty.rig_uncertainty import RigCovariance

_MOST_POSITIONS = 60  # positions used; more do not improve the diagnosis
_FOR_LABELS = 12  # positions whose spots are fitted with each exchange of labels
_FAR_BETTER = 0.3  # misfit of a candidate over the present one, below which it is used in a calibration
_AGREE = 0.8  # share of spots that must agree after the correction
_TRIED = 4  # candidates used in a calibration
_FEWEST = 6  # positions that a shifted record must share with the spots


@dataclass(frozen=True, slots=True)
class RecordingError:
    """A mistake whose correction makes the spots consistent."""

    in_labels: bool  # otherwise in the stand's record
    words: str  # the correction
    remedy: str


def diagnose_error(
    rig: Rig, spots: SpotPixels, stand: StandModel, knowledge: RigCovariance | None = None
) -> RecordingError | None:
    """The mistake that explains inconsistent spots; None if none of the common ones does.

    Arguments as of calibrate_beams, which found too few consistent spots. rig: beams as drawn, which are required.
    """
    likely = [*_of_records(rig, spots, stand), *_of_labels(rig, spots, stand)]
    likely.sort(key=lambda change: change.misfit)
    fits = ((c, _agreeing(rig, c, knowledge)) for c in likely[:_TRIED])
    best = max(fits, key=lambda pair: pair[1], default=None)
    return best[0].of if best is not None and best[1] >= _AGREE else None


@dataclass(frozen=True, slots=True)
class _Candidate:
    of: RecordingError
    misfit: float  # relative to the present one
    spots: SpotPixels
    stand: StandModel


def _agreeing(rig: Rig, change: _Candidate, knowledge: RigCovariance | None) -> float:
    """Share of the spots that agree after a change; 0 if the calibration fails."""
    try:
        return float(np.mean(calibrate_beams(rig, change.spots, change.stand, knowledge).fit.kept))
    except AdjustmentError:
        return 0.0


# The stand's record -----------------------------------------------------------------------------------------------


def _of_records(rig: Rig, spots: SpotPixels, stand: StandModel) -> list[_Candidate]:
    count = len(stand.stand_from_body.translation)
    tried = np.arange(min(count, _MOST_POSITIONS))
    fits = body_poses(rig, spots.pick(spots.position < len(tried)), len(tried))
    usable = np.array([k for k in tried if fits[k] is not None], dtype=np.int64)
    if len(usable) < _FEWEST:
        return []
    bodies = Poses.of([f.world_from_body for f in fits if f is not None]).pose
    present = _median_difference(bodies, stand.stand_from_body[usable])
    out = []
    for of, poses in _other_records(stand.stand_from_body):
        misfit = _median_difference(bodies, poses[usable])
        if misfit < _FAR_BETTER * present:
            out.append(_Candidate(of, misfit / present, spots, replace(stand, stand_from_body=poses)))
    sigmas = np.broadcast_to(np.asarray(stand.pose_sigmas, dtype=float), (count, 6))
    for n in (k for k in range(-(count // 2), count // 2 + 1) if k):
        both = (usable + n >= 0) & (usable + n < count)
        if np.sum(both) < _FEWEST:
            continue
        misfit = _median_difference(bodies[both], stand.stand_from_body[usable[both] + n])
        if misfit < _FAR_BETTER * present:
            there = (spots.position + n >= 0) & (spots.position + n < count)
            moved = spots.pick(there)
            moved = replace(moved, position=moved.position + n)
            out.append(_Candidate(_shifted(n), misfit / present, moved, replace(stand, pose_sigmas=sigmas)))
    return out


def _other_records(poses: Pose) -> Iterator[tuple[RecordingError, Pose]]:
    """The record with each common mistake corrected."""
    q, t = poses.quaternion_wxyz, poses.translation
    turned, swapped = Pose(np.swapaxes(poses.rotation, -1, -2), t), Pose.from_quaternion(np.roll(q, 1, axis=-1), t)
    order = "with their quaternions read in the order x, y, z, w", "write them in the order qw, qx, qy, qz"
    yield RecordingError(False, *order), swapped
    inverse = "inverted", "write stand_from_body, the body's pose in the stand, and not its inverse"
    yield RecordingError(False, *inverse), poses.inverse()
    way = "with their rotations inverted", "write quaternions that rotate from the body to the stand"
    yield RecordingError(False, *way), turned
    for factor, unit in ((1e-3, "millimetres"), (1e-2, "centimetres"), (1e3, "kilometres")):
        words = f"with their positions times {factor:g} ({unit} were written)"
        yield RecordingError(False, words, "write x_m, y_m, z_m in metres"), Pose(poses.rotation, factor * t)


def _shifted(n: int) -> RecordingError:
    rows = f"{abs(n)} row{'' if abs(n) == 1 else 's'} {'above' if n < 0 else 'below'}"
    return RecordingError(
        False,
        f"when each position has the pose {rows}",
        "the numbering of positions differs between spots and poses: number both alike",
    )


def _median_difference(bodies: Pose, records: Pose) -> float:
    """Median difference between poses from spots and records, m and rad combined, with a free stand pose."""
    differences = (stand_of(bodies, records) @ records).minus(bodies)
    return float(np.median(np.linalg.norm(differences, axis=-1)))


# Labels -----------------------------------------------------------------------------------------------------------


def _of_labels(rig: Rig, spots: SpotPixels, stand: StandModel) -> list[_Candidate]:
    """Pairs of spots with labels exchanged in every picture of one camera."""
    few = spots.pick(spots.position < _FOR_LABELS)
    count = min(_FOR_LABELS, len(stand.stand_from_body.translation))
    present = _own_misfit(rig, few, count)
    views, out = rig.views(), []
    for a, b in combinations(range(len(views)), 2):
        if views[a][0] != views[b][0]:
            continue
        misfit = _own_misfit(rig, swap_views(few, a, b), count)
        if misfit < _FAR_BETTER * present:
            camera, first, second = views[a][0], views[a][1], views[b][1]
            of = RecordingError(
                True,
                f"with the labels {first} and {second} of camera {camera!r} exchanged everywhere",
                "exchange them in the table of spots, or in target.spots",
            )
            out.append(_Candidate(of, misfit / present, swap_views(spots, a, b), stand))
    return out


def swap_views(spots: SpotPixels, a: int, b: int) -> SpotPixels:
    """The spots with two views exchanged."""
    view: Ints = np.where(spots.view == a, b, np.where(spots.view == b, a, spots.view))
    return replace(spots, view=view)


def _own_misfit(rig: Rig, spots: SpotPixels, count: int) -> float:
    """Median misfit, sigmas, of the spots of a position with the nominal beams; inf if no pose is found."""
    fits = body_poses(rig, spots, count)
    each: Array = np.array([np.inf if f is None or f.dof <= 0 else np.sqrt(f.chi2 / f.dof) for f in fits])
    return float(np.median(each)) if len(each) else float("inf")
