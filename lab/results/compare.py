"""`beampose compare`: a result against another result or a reference, and what the comparison leaves open."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from geometry import rotations
from geometry.arrays import Array, Bools, Ints
from lab.errors import InputError
from lab.files.run.results import ResultFolder
from lab.files.text.csv_text import Table, read_table
from lab.files.text.error_text import name_of_path
from lab.findings.finding import Finding, Level, clause, finding, passed
from lab.number_format import format_number, format_percent, format_with_sigma
from tracking.comparison.differences import (
    LEAST_READINGS,
    AllanDeviation,
    ChiSquare,
    Differences,
    Statistic,
    allan_deviation,
    chi_square,
    differences,
    longest_still,
    statistic,
)
from tracking.comparison.estimation import Estimate, Free, Freedom, NotComparableError, estimate_alignment
from tracking.comparison.frame_alignment import BODY, GAP, LEVER, TRANSLATION, WORLD, Alignment, PoseSeries
from tracking.statuses import PoseStatus

# Reads the motion of a reference: a TUM file (`t x y z qx qy qz qw`) or a CSV table with named columns.

POSITION = ("x_m", "y_m", "z_m")
QUATERNION = ("qw", "qx", "qy", "qz")
ANGLES = ("yaw_deg", "pitch_deg", "roll_deg")
SIGMAS = tuple(f"sigma_{name}" for name in (*POSITION, *ANGLES))
_TUM = 8  # numbers in a line
FARTHEST = 1e6  # m, deg: a position, an angle or a sigma beyond it is a mistake, and squares lose all smaller numbers
LATEST_S = 1e12  # 30,000 years: times in ns are beyond it


def read_reference(path: Path, sigma_m: float = 0.0, sigma_deg: float = 0.0) -> tuple[PoseSeries, tuple[str, ...]]:
    """The motion of a file, and notes on how it was read. sigma_m, sigma_deg: sigmas where the file states none.

    Raises InputError: no such file, neither format, a field that is not a number, or times that do not rise.
    """
    path = Path(path)
    numbers = _tum_lines(path)
    motion, notes = _from_tum(path, numbers, sigma_m, sigma_deg) if numbers else _from_csv(path, sigma_m, sigma_deg)
    if not np.any(motion.covariance):
        notes = (*notes, "The reference states no sigmas: it counts as exact.")
    return motion, notes


def _tum_lines(path: Path) -> list[tuple[int, list[str]]]:
    """Line numbers and fields of a file separated by blanks whose first line holds numbers; else an empty list."""
    if not path.is_file():
        return []
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError):
        return []  # the CSV reader names what is wrong
    rows = [(i + 1, line.split()) for i, line in enumerate(lines) if line.strip() and not line.lstrip().startswith("#")]
    if not rows or "," in lines[rows[0][0] - 1]:
        return []
    try:
        [float(field) for field in rows[0][1]]
    except ValueError:
        return []
    return rows


def _from_tum(
    path: Path, rows: list[tuple[int, list[str]]], sigma_m: float, sigma_deg: float
) -> tuple[PoseSeries, tuple[str, ...]]:
    values = np.empty((len(rows), _TUM))
    for i, (line, fields) in enumerate(rows):
        try:
            numbers = [float(field) for field in fields]
        except ValueError:
            numbers = []
        if len(numbers) != _TUM or not all(map(math.isfinite, numbers)):
            raise InputError(
                f"{path}: line {line}: expected eight numbers t x y z qx qy qz qw, got {' '.join(fields)[:60]!r};"
                " correct the line, or save a CSV table with named columns"
            )
        values[i] = numbers
    lines = np.array([line for line, _ in rows])
    check_size(path, lines, "t", values[:, 0], LATEST_S)
    check_size(path, lines, "x y z", values[:, 1:4], FARTHEST)
    _check_times(path, values[:, 0], lines)
    rotation = _rotations(path, values[:, [7, 4, 5, 6]], lines)
    covariance = np.zeros((len(values), 6, 6))
    covariance[:] = np.diag([sigma_m**2] * 3 + [math.radians(sigma_deg) ** 2] * 3)
    return PoseSeries(values[:, 0], rotation, values[:, 1:4], covariance), ()


def _from_csv(path: Path, sigma_m: float, sigma_deg: float) -> tuple[PoseSeries, tuple[str, ...]]:
    table = read_table(path, ["t_s"], (*POSITION, *QUATERNION, *ANGLES, *SIGMAS))
    table.require_rows(["t_s", *QUATERNION])
    places = _all_or_none(table, POSITION)
    quaternions = _all_or_none(table, QUATERNION)
    angles = [name for name in ANGLES if name in table]
    if not places and not quaternions and not angles:
        raise InputError(
            f"{path}: expected columns {','.join(QUATERNION)} or {','.join(ANGLES)} or {','.join(POSITION)} beside t_s,"
            f" got {','.join(table.header)[:80]}; rename the columns"
        )
    for name in ("t_s", *(c for c in (*POSITION, *ANGLES, *SIGMAS) if c in table)):
        check_size(path, table.lines, name, table.optional(name), LATEST_S if name == "t_s" else FARTHEST)
    notes: list[str] = []
    used = [*(POSITION if places else ()), *(QUATERNION if quaternions else angles)]
    stacked = np.stack([table.finite("t_s"), *(table.optional(name) for name in used)], axis=1)
    complete: Bools = np.all(np.isfinite(stacked), axis=1)
    if not complete.all():
        notes.append(f"{int((~complete).sum())} of {len(complete)} rows of the reference are not complete: left out.")
    lines, stacked = table.lines[complete], stacked[complete]
    _check_times(path, stacked[:, 0], lines)
    position = stacked[:, 1:4] if places else None
    rotation: Array | None = None
    if quaternions:
        rotation = _rotations(path, stacked[:, -4:], lines)
    elif angles:
        ypr = np.zeros((len(stacked), 3))
        for k, name in enumerate(ANGLES):
            if name in angles:
                ypr[:, k] = np.deg2rad(stacked[:, stacked.shape[1] - len(angles) + angles.index(name)])
        rotation = rotations.matrix_from_ypr(ypr)
        absent = [name for name in ANGLES if name not in angles]
        if absent:
            notes.append(f"The reference has no {' and no '.join(absent)}: taken as 0.")
    covariance = _stated(table, complete, rotation, sigma_m, sigma_deg)
    return PoseSeries(stacked[:, 0], rotation, position, covariance), tuple(notes)


def check_size(path: Path, lines: Ints, names: str, values: Array, most: float) -> None:
    """Raises InputError with the first line where a magnitude of `values` (n, ...) is beyond `most`; nan is none."""
    far = np.abs(values.reshape(len(lines), -1)) > most
    for i in np.flatnonzero(far.any(axis=1))[:1].tolist():
        raise InputError(
            f"{path}: line {lines[i]}: {names}: expected numbers within {most:g},"
            f" got {values.reshape(len(lines), -1)[i][far[i]][0]:g}; check units and columns"
        )


def _all_or_none(table: Table, names: tuple[str, ...]) -> bool:
    """Whether a table has all of some columns. Raises InputError where it has some of them only."""
    there = [name for name in names if name in table]
    if there and len(there) < len(names):
        missing = next(name for name in names if name not in there)
        raise InputError(
            f"{table.path}: expected all of {','.join(names)}, found no {missing}; add the column, or remove the others"
        )
    return bool(there)


def _stated(table: Table, rows: Bools, rotation: Array | None, sigma_m: float, sigma_deg: float) -> Array:
    """Covariances (n, 6, 6) from the sigma columns, and from the given sigmas where a field is empty or absent."""
    covariance = np.zeros((int(rows.sum()), 6, 6))
    columns = [table.optional(name)[rows] for name in SIGMAS]
    for k, name in enumerate(SIGMAS):
        wrong = np.flatnonzero(columns[k] < 0)
        if wrong.size:
            raise table.error(int(np.flatnonzero(rows)[wrong[0]]), f"{name}: expected 0 or more, got a negative number")
    for k in range(3):
        covariance[:, k, k] = np.where(np.isfinite(columns[k]), columns[k], sigma_m) ** 2
    angles = np.deg2rad(np.stack([np.where(np.isfinite(c), c, sigma_deg) for c in columns[3:]], axis=1)) ** 2
    stated = np.any(np.isfinite(np.stack(columns[3:], axis=1)), axis=1)
    covariance[:, 3:, 3:] = np.eye(3) * math.radians(sigma_deg) ** 2
    if rotation is not None and stated.any():
        body_from_angles = np.linalg.pinv(rotations.ypr_jacobian(rotation[stated]), rcond=1e-6)
        covariance[stated, 3:, 3:] = (body_from_angles * angles[stated][:, None, :]) @ np.swapaxes(
            body_from_angles, -1, -2
        )
    return covariance


def _rotations(path: Path, quaternions: Array, lines: Ints) -> Array:
    length = np.linalg.norm(quaternions, axis=1)
    wrong = np.flatnonzero(np.abs(length - 1) > 0.01)
    if wrong.size:
        raise InputError(
            f"{path}: line {lines[wrong[0]]}: expected a quaternion of length 1, got {length[wrong[0]]:.4g}; check the"
            " order of the columns"
        )
    return rotations.matrix_from_quaternion(quaternions)


def _check_times(path: Path, t_s: Array, lines: Ints) -> None:
    if len(t_s) < 2:
        raise InputError(f"{path}: expected two complete rows or more, got {len(t_s)}")
    wrong = np.flatnonzero(np.diff(t_s) <= 0)
    if wrong.size:
        raise InputError(
            f"{path}: line {lines[wrong[0] + 1]}: expected rising times, got {t_s[wrong[0] + 1]:.9g} after"
            f" {t_s[wrong[0]]:.9g}; sort the rows and remove duplicates"
        )


# What a comparison found, as plain sentences and table rows.


_BAD_FIT = 25.0  # variance factor: five times the stated sigmas
_LOST_SHARE = 0.1  # of an undetermined direction in a component that counts as undetermined
UNDETERMINED = "not determined"


def alignment_rows(comparison: Comparison) -> list[tuple[str, str, str]]:
    """Quantity, value with sigma, unit of what was estimated."""
    e = comparison.estimate
    if e is None:
        return []
    a, s = e.alignment, e.sigmas
    lost = e.determined.undetermined
    rows = []
    if e.free[0]:
        offset = UNDETERMINED if "offset_s" in lost else format_with_sigma(a.offset_s, float(s[0]))
        rows.append(("time offset, reference minus result", offset, "s"))
    if e.free[1]:
        rate = UNDETERMINED if "rate" in lost else format_with_sigma(1e6 * a.rate, float(1e6 * s[1]))
        rows.append(("clock rate, reference against result", rate, "ppm"))
    none = np.zeros((0, 3))
    turns, lengths = e.determined.world_axes, e.determined.lever_axes
    for part, name, values, unit, axes in (
        (WORLD, "world rotation", np.rad2deg(rotations.log(a.world)), "deg", turns),
        (BODY, "body rotation", np.rad2deg(rotations.log(a.body)), "deg", none),
        (LEVER, "lever arm", 1e3 * a.lever_m, "mm", lengths),
        (TRANSLATION, "translation", 1e3 * a.translation_m, "mm", none),
    ):
        if e.free[part].all():
            sigmas = (np.rad2deg(s[part]) if unit == "deg" else 1e3 * s[part]).tolist()
            lost_share = np.linalg.norm(axes, axis=0).tolist()
            for axis, value, sigma, share in zip("xyz", values.tolist(), sigmas, lost_share, strict=True):
                known = share < _LOST_SHARE
                rows.append((f"{name} {axis}", format_with_sigma(value, sigma) if known else UNDETERMINED, unit))
    return rows


def undetermined_lines(e: Estimate | None) -> list[str]:
    """What the motion does not determine, one sentence each."""
    if e is None:
        return []
    lines = []
    if e.scale > _BAD_FIT:
        lines.append(
            f"The recordings do not fit: the differences are {format_number(float(np.sqrt(e.scale)))} times the stated"
            " sigmas. The alignment may be wrong: are both of the same motion, and are the units and the order of the"
            " columns right?"
        )
    if "offset_s" in e.determined.undetermined:
        lines.append(
            "The time offset is not determined: the recordings show no common motion that a shift in time would"
            f" change. The differences use {format_number(e.alignment.offset_s)} s."
        )
    elif "rate" in e.determined.undetermined:
        lines.append("The clock rate is not determined: the motion is too short or too slow. It counts as 0.")
    if e.other_offsets:
        others = ", ".join(f"{o:.3f} s" for o in e.other_offsets)
        lines.append(
            f"The time offset is ambiguous: {others} explain their common frames equally well. The differences use"
            f" {e.alignment.offset_s:.3f} s, which explains the most frames; give the right one with --offset."
        )
    if len(e.determined.world_axes) and e.free[BODY].all():
        lines.append(
            f"The world rotation and the body rotation are not distinguished about {_named(e.determined.world_axes)} of"
            " the reference's world: only their combined effect is known. The body rotation holds for a world"
            " rotation without that part."
        )
    elif len(e.determined.world_axes):
        lines.append(f"The world rotation is not determined about {_named(e.determined.world_axes)}.")
    if len(e.determined.lever_axes):
        lines.append(
            f"The lever arm is not determined along {_named(e.determined.lever_axes)} of the body: the attitude changes"
            " too little. Its part there counts as translation."
        )
    return lines


def _named(axes: Array) -> str:
    if len(axes) == 3:
        return "any axis"
    words = [f"({', '.join(f'{v:.2f}' for v in np.round(axis, 2) + 0.0)})" for axis in axes]
    return "the axis " + words[0] if len(words) == 1 else "the axes " + " and ".join(words)


# Per degree of freedom, less three of its sigmas, that stated uncertainties may be exceeded by; below its inverse, with
# three sigmas more, the differences are smaller than stated.
_MOST_CHI2 = 1.5
_MOST_EXCLUDED = 0.05  # share of the compared frames


def judged(comparison: Comparison) -> Finding:
    """Whether the differences agree with the stated uncertainties, of the noise or of that and the calibration."""
    found = comparison.differences
    excluded = float((found.known & ~comparison.used).sum()) / max(int(found.known.sum()), 1)
    tests = [c for c in (comparison.noise, comparison.total) if c is not None and np.isfinite(c.factor)]
    if not tests or excluded > _MOST_EXCLUDED:
        many = f"{format_percent(excluded)} of them were excluded as outliers"
        return finding("BP-X02", Level.WARN, f"{int(found.known.sum())} frames were compared; {many}.")
    good = [c for c in tests if c.factor - 3 * np.nan_to_num(c.sigma) <= _MOST_CHI2]
    test = min(good, key=_is_vague) if good else tests[0]
    figure = f"chi-square per degree of freedom {format_with_sigma(test.factor, test.sigma)}"
    if not good:
        return finding("BP-X01", Level.WARN, f"The differences are larger than the stated uncertainties: {figure}.")
    if _is_vague(test):
        return passed(f"The frames have too few independent errors to test the stated uncertainties: {figure}.")
    agree = test.factor + 3 * np.nan_to_num(test.sigma) >= 1 / _MOST_CHI2
    return passed(
        f"The differences {'agree with' if agree else 'are smaller than'} the stated uncertainties: {figure}."
    )


def _is_vague(test: ChiSquare) -> bool:
    """Whether a chi-square would not differ from one of no errors at all."""
    return bool(test.factor <= 3 * np.nan_to_num(test.sigma))


def lines_of(comparison: Comparison) -> list[str]:
    """What the command prints."""
    found, verdict = comparison.differences, judged(comparison)
    lines = [
        f"{verdict.level.word.upper()}: {clause(verdict.what)}{f'. {verdict.remedy}' if verdict.remedy else ''}",
        f"{int(found.known.sum())} of {len(comparison.frames)} measured frames compared,"
        f" {int((found.known & ~comparison.used).sum())} of them excluded as outliers",
    ]
    lines += [
        f"{name}: {value}{'' if value == UNDETERMINED else ' ' + unit}"
        for name, value, unit in alignment_rows(comparison)[:2]
    ]
    for axis in comparison.axes:
        if not axis.name.startswith("rotation"):
            f = axis.figures
            lines.append(
                f"{axis.name}: RMS {format_with_sigma(f.rms, f.rms_sigma)} {axis.unit},"
                f" largest {format_number(f.largest)} {axis.unit}"
            )
    if comparison.is_reference:
        c = comparison.noise
        lines.append(
            f"chi-square per degree of freedom: {format_with_sigma(c.factor, c.sigma)}"
            f" ({format_percent(c.within)} of the frames within the 95 % limit)"
        )
    return [*lines, *undetermined_lines(comparison.estimate), *comparison.notes]


# Compares a result with another result or with a reference.


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
    time minus result time, approximately. sigma_m, sigma_deg: the reference's sigmas where its file states none. Raises
    InputError: not results, not a reference, or nothing in common.
    """
    if (other is None) == (reference is None):
        raise InputError("expected a second result folder or --reference FILE, and not both")
    frames, mine, total = _motion_of(result)
    notes: tuple[str, ...] = ()
    gap = GAP
    if reference is not None:
        theirs, notes = read_reference(reference, sigma_m, sigma_deg)
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
    freedom = Freedom() if estimate is None else estimate.freedom
    stated_total = None
    if np.any(total.covariance != mine.covariance):
        with_total = differences(total, theirs, alignment, gap)
        stated_total = chi_square(with_total.chi2, found.freedom, used, freedom)
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
        chi_square(found.chi2, found.freedom, used, freedom),
        stated_total,
        _still(mine),
        notes,
    )


def _motion_of(folder: Path) -> tuple[Ints, PoseSeries, PoseSeries]:
    """Frames (n,), motion with the noise part of the covariances, and with all of them, of the measured frames."""
    track = ResultFolder.of_run(folder).poses
    good = track.known & track.has(PoseStatus.MEASURED) & np.isfinite(track.covariance).all(axis=(1, 2))
    rows = np.flatnonzero(good)
    if len(rows) < 4:
        raise InputError(
            f"{folder}: expected 4 measured frames with covariances or more, found {len(rows)} of {len(good)}"
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
        PoseSeries(track.t_s[rows], pose.rotation, pose.translation, noise),
        PoseSeries(track.t_s[rows], pose.rotation, pose.translation, total),
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


def _still(motion: PoseSeries) -> StillStand | None:
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
    summaries = [ResultFolder(folder).summary for folder in (first, second)]
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
