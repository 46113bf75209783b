"""Compares a result with another result or with a reference."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from geometry import rotations
from geometry.arrays import Array, Bools, Ints
from lab.compare.reference_file import FARTHEST, LATEST_S, read_reference
from lab.errors import InputError
from lab.files.run.results import PoseTrack, read_poses, read_summary
from lab.files.text.error_text import name_of_path
from lab.runs.process import are_results
from tracking.comparison.allan import LEAST_READINGS, AllanDeviation, allan_deviation
from tracking.comparison.differences import (
    ChiSquare,
    Differences,
    Statistic,
    chi_square,
    differences,
    longest_still,
    statistic,
)
from tracking.comparison.estimation import Estimate, Free, NotComparableError, estimate_alignment
from tracking.comparison.frame_alignment import Alignment
from tracking.comparison.motion import GAP, Motion
from tracking.statuses import PoseStatus

ALIGN = ("time", "rate", "world", "body")
LEAST_STILL = 4 * LEAST_READINGS
_SAME_FRAMES_GAP = 1.5  # nothing is interpolated between frames of two results


@dataclass(frozen=True, slots=True)
class AxisStatistic:
    """One axis of the differences."""

    name: str
    unit: str
    values: Array  # (n,)
    sigmas: Array | None  # (n,)
    figures: Statistic


@dataclass(frozen=True, slots=True)
class StillStand:
    """Allan deviations of the angles of a stationary stretch."""

    first_s: float
    last_s: float
    count: int
    of_result: tuple[tuple[str, AllanDeviation], ...]  # by angle, degrees


@dataclass(frozen=True, slots=True)
class Comparison:
    """What is compared, and what was found."""

    result: Path
    other: Path
    is_reference: bool
    frames: Ints  # (n,): compared frames of the result
    t_s: Array  # (n,)
    estimate: Estimate | None  # None: nothing was aligned
    alignment: Alignment
    free: Free
    differences: Differences
    used: Bools  # (n,)
    axes: tuple[AxisStatistic, ...]
    noise: ChiSquare  # against the noise part of the stated covariances
    total: ChiSquare | None  # against the total ones, where the calibration's part is stated
    still: StillStand | None
    notes: tuple[str, ...]


def compare(
    result: Path,
    other: Path | None = None,
    reference: Path | None = None,
    *,
    align: Sequence[str] | None = None,
    offset_s: float | None = None,
    sigma_m: float = 0.0,
    sigma_deg: float = 0.0,
) -> Comparison:
    """Compare a result folder with another one, or with a reference file.

    align: what is estimated, of ALIGN; None: everything for a reference, nothing for two results. offset_s: reference
    time minus result time, approximately. sigma_m, sigma_deg: the reference's sigmas where its file states none.

    Raises:
        InputError: not results, not a reference, or nothing in common.
    """
    if (other is None) == (reference is None):
        raise InputError("expected a second result folder or --reference FILE, and not both")
    frames, mine, total = _motion_of(result)
    notes: tuple[str, ...] = ()
    gap = GAP
    if reference is not None:
        read = read_reference(reference, sigma_m, sigma_deg)
        theirs, notes = read.motion, read.notes
    else:
        assert other is not None
        other_frames, theirs, _ = _motion_of(other)
        gap = _SAME_FRAMES_GAP
        if not align:
            common, i, j = np.intersect1d(frames, other_frames, return_indices=True)
            if len(common) < 4:
                raise InputError(f"{other}: expected frames of {result}, found {len(common)} measured in both")
            frames, mine, total, theirs = common, mine.select(i), total.select(i), theirs.select(j)
        notes = (_of_the_same_run(result, other),)
    wanted = (ALIGN if reference is not None else ()) if align is None else tuple(align)
    free = Free(*(name in wanted for name in ALIGN))
    estimate, alignment = None, Alignment.identity(offset_s or 0.0, float(0.5 * (mine.t_s[0] + mine.t_s[-1])))
    if wanted:
        try:
            estimate = estimate_alignment(mine, theirs, free, offset_s, gap)
        except NotComparableError as error:
            remedy = "give the offset of its clock with --offset, or record both at the same time"
            raise InputError(f"{reference or other}: cannot be compared with {result}: {error}; {remedy}") from None
        except np.linalg.LinAlgError:
            raise InputError(
                f"{reference or other}: cannot be compared with {result}: its numbers or their sigmas differ too"
                " much in size; check units, columns and outliers"
            ) from None
        alignment = estimate.alignment
    found = differences(mine, theirs, alignment, gap)
    if found.known.sum() < 4:
        raise InputError(
            f"{reference or other}: expected times in common with {result}, found {int(found.known.sum())}; give the"
            " offset of its clock with --offset, or allow it to be estimated (--align time)"
        )
    used = found.known if estimate is None else estimate.inliers & found.known
    parameters = 0 if estimate is None else estimate.determined.basis.shape[1]
    stated_total = None
    if np.any(total.covariance != mine.covariance):
        with_total = differences(total, theirs, alignment, gap)
        stated_total = chi_square(with_total.chi2, found.freedom, used, parameters)
    return Comparison(
        result,
        reference or other or result,
        reference is not None,
        frames,
        mine.t_s,
        estimate,
        alignment,
        free,
        found,
        used,
        _axes(found, used),
        chi_square(found.chi2, found.freedom, used, parameters),
        stated_total,
        _still(mine),
        notes,
    )


def _motion_of(folder: Path) -> tuple[Ints, Motion, Motion]:
    """Frames (n,), motion with the noise part of the covariances, and with all of them, of the measured frames."""
    if not are_results(folder):
        raise InputError(f"{folder}: expected a folder that `beampose run` wrote, found no summary.json of one")
    track: PoseTrack = read_poses(folder)
    good = track.known & track.has(PoseStatus.MEASURED) & np.isfinite(track.covariance).all(axis=(1, 2))
    rows = np.flatnonzero(good)
    if len(rows) < 4:
        raise InputError(
            f"{folder}: expected measured frames with covariances, found {len(rows)}; process the run again"
        )
    pose, total = track.world_from_body[rows], track.covariance[rows]
    beyond = np.abs(pose.translation).max(axis=1) > FARTHEST
    beyond |= (np.abs(track.t_s[rows]) > LATEST_S) | (np.linalg.eigvalsh(total)[:, 0] <= 0)
    beyond |= total.max(axis=(1, 2)) > FARTHEST**2
    if beyond.any():
        raise InputError(
            f"{folder}: frame {track.frames[rows[beyond][0]]}: expected a pose within {FARTHEST:g} m with a positive"
            " definite covariance, found others; process the run again"
        )
    systematic = np.nan_to_num(track.systematic[rows])
    rest = total - systematic
    separable = np.linalg.eigvalsh(rest)[:, 0] > 0
    noise = np.where(separable[:, None, None], rest, total)
    return (
        track.frames[rows],
        Motion(track.t_s[rows], pose.rotation, pose.translation, noise),
        Motion(track.t_s[rows], pose.rotation, pose.translation, total),
    )


def _axes(found: Differences, used: Bools) -> tuple[AxisStatistic, ...]:
    """Statistics of the used times: positions in mm, rotations in degrees."""
    out = []
    columns = [
        *((f"position {a}", "mm", 1e3 * found.values[:, k], 1e3 * found.sigmas[:, k]) for k, a in enumerate("xyz")),
        *(
            (f"rotation {a}", "deg", np.rad2deg(found.values[:, 3 + k]), np.rad2deg(found.sigmas[:, 3 + k]))
            for k, a in enumerate("xyz")
        ),
        *((name, "deg", np.rad2deg(found.ypr[:, k]), None) for k, name in enumerate(("yaw", "pitch", "roll"))),
    ]
    for name, unit, values, sigmas in columns:
        figures = statistic(np.where(used, values, np.nan))
        if figures is not None:
            out.append(AxisStatistic(name, unit, values, sigmas, figures))
    return tuple(out)


def _still(motion: Motion) -> StillStand | None:
    """Allan deviations of yaw, pitch and roll over the longest stationary stretch; None where none is long enough."""
    where = longest_still(motion, LEAST_STILL)
    if where is None or motion.rotation is None:
        return None
    angles = np.rad2deg(np.unwrap(rotations.ypr_from_matrix(motion.rotation[where]), axis=0))
    of_result = tuple(
        (name, allan_deviation(angles[:, k], motion.step_s)) for k, name in enumerate(("yaw", "pitch", "roll"))
    )
    return StillStand(float(motion.t_s[where][0]), float(motion.t_s[where][-1]), len(angles), of_result)


def _of_the_same_run(first: Path, second: Path) -> str:
    """A note on the recordings of two results. Raises InputError where a summary.json is damaged."""
    summaries = [read_summary(folder) for folder in (first, second)]
    recorded = [_recorded(summary) for summary in summaries]
    if not all(recorded):
        return "Both results may rest on the same pictures: their errors are then not independent."
    if recorded[0] & recorded[1]:
        return "Both results rest on the same pictures or points: their errors are not independent."
    names = " and ".join(name_of_path(Path(str(summary.get("run_folder") or "?"))) for summary in summaries)
    return f"The results are of different recordings, {names}: the differences are errors only of equal motions."


def _recorded(summary: Mapping[str, Any]) -> set[str]:
    """Digests of the pictures and tables that a result rests on; empty where summary.json has none."""
    inputs = summary.get("inputs")
    listed = [entry for entry in inputs if isinstance(entry, Mapping)] if isinstance(inputs, list) else []
    paths = [(Path(str(entry.get("path"))), str(entry.get("sha256"))) for entry in listed]
    return {digest for path, digest in paths if path.suffix != ".yaml" and path.parent.name != "truth"}
