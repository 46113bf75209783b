"""Reads the motion of a reference: a TUM file (`t x y z qx qy qz qw`) or a CSV table with named columns."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from geometry import rotations
from geometry.arrays import Array, Bools, Ints
from lab.errors import InputError
from lab.files.text.csv_table import Table
from lab.files.text.csv_text import read_table
from tracking.comparison.motion import Motion

POSITION = ("x_m", "y_m", "z_m")
QUATERNION = ("qw", "qx", "qy", "qz")
ANGLES = ("yaw_deg", "pitch_deg", "roll_deg")
SIGMAS = tuple(f"sigma_{name}" for name in (*POSITION, *ANGLES))
_TUM = 8  # numbers in a line
FARTHEST = 1e6  # m, deg: a position, an angle or a sigma beyond it is a mistake, and squares lose all smaller numbers
LATEST_S = 1e12  # 30,000 years: times in ns are beyond it


@dataclass(frozen=True, slots=True)
class ReferenceMotion:
    """A motion with notes about how its file was read."""

    motion: Motion
    notes: tuple[str, ...]


def read_reference(path: Path, sigma_m: float = 0.0, sigma_deg: float = 0.0) -> ReferenceMotion:
    """The motion of a file. sigma_m, sigma_deg: standard deviations where the file states none.

    Raises:
        InputError: no such file, neither format, a field that is not a number, or times that do not rise.
    """
    path = Path(path)
    numbers = _tum_lines(path)
    motion, notes = _from_tum(path, numbers, sigma_m, sigma_deg) if numbers else _from_csv(path, sigma_m, sigma_deg)
    if not np.any(motion.covariance):
        notes = (*notes, "The reference states no sigmas: it counts as exact.")
    return ReferenceMotion(motion, notes)


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
) -> tuple[Motion, tuple[str, ...]]:
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
    return Motion(values[:, 0], rotation, values[:, 1:4], covariance), ()


def _from_csv(path: Path, sigma_m: float, sigma_deg: float) -> tuple[Motion, tuple[str, ...]]:
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
    return Motion(stacked[:, 0], rotation, position, covariance), tuple(notes)


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
