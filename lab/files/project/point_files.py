"""The tables of a calibration project: surveyed points, their pixels, poses of the stand."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from geometry.arrays import Array, Ints
from geometry.pose import Pose
from lab.errors import InputError
from lab.files.run.truth import refuse_other_lengths
from lab.files.text import columns
from lab.files.text.csv_text import numbers_in, read_table, whole_numbers
from lab.files.text.range_checks import (
    FARTHEST_M,
    SIGMAS_DEG,
    SIGMAS_M,
    SIGMAS_PX,
    refuse_far_pixels,
    refuse_far_places,
    refuse_sigmas,
)
from lab.files.text.yaml_text import did_you_mean

if TYPE_CHECKING:
    import pandas as pd

SURVEY = ("point", "x_m", "y_m", "z_m")
SURVEY_SIGMAS = ("sigma_x_m", "sigma_y_m", "sigma_z_m")
POINTS = ("camera", "point", "u_px", "v_px")
POSE_SIGMAS = ("sigma_x_m", "sigma_y_m", "sigma_z_m", "sigma_rot_x_deg", "sigma_rot_y_deg", "sigma_rot_z_deg")
DEFAULT_SURVEY_SIGMA_M = 0.001  # m: where a survey gives none; a total station with reflective tape does this at 10 m
DEFAULT_POINT_SIGMA_PX = 0.2  # px: where the table gives none; a printed dot's centroid, or a careful click refined


@dataclass(frozen=True, slots=True)
class Survey:
    """Surveyed points of one or several files."""

    names: tuple[str, ...]  # n, each once
    xyz: Array  # (n, 3), m, world
    covariance: Array  # (n, 3, 3), m^2
    screen: tuple[str, ...]  # n: the screen that a point lies on; empty: on none, or not said
    source: tuple[str, ...]  # n: the file that it comes from
    notes: tuple[str, ...] = ()  # what was assumed


@dataclass(frozen=True, slots=True)
class Observations:
    """Pixels of points, of one or several files."""

    camera: tuple[str, ...]  # n
    point: tuple[str, ...]  # n
    pixels: Array  # (n, 2)
    sigma_px: Array  # (n,), of each coordinate
    source: tuple[str, ...]  # n
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class StandPoses:
    """Where the stand carried the vehicle, by frame."""

    frames: Ints  # (n,), rising
    stand_from_body: Pose  # a stack of n
    sigmas: Array  # (n, 6): m along the stand's axes, rad about the body's; nan where the table gives none


def read_survey(paths: Sequence[Path], screens: Collection[str], farthest_m: float = FARTHEST_M) -> Survey:
    """The surveyed points of some files. screens: those of the project, for the column `screen`.

    farthest_m: from the origin, beyond which a coordinate counts as a mistake.

    Raises InputError in one line: file, line, what was expected and what was found.
    """
    names: list[str] = []
    where: dict[str, str] = {}
    xyz, covariance, screen, source, notes = [], [], [], [], []
    for path in paths:
        table = read_table(path, SURVEY, numbers=(*SURVEY[1:], *SURVEY_SIGMAS))
        _some_rows(path, table, SURVEY)
        points = _names(path, table, "point")
        for i, name in enumerate(points):
            if name in where:
                raise InputError(
                    f"{path}: line {i + 2}: point: expected each point once, got {name!r} again (first in"
                    f" {where[name]})"
                )
            where[name] = f"{path.name}, line {i + 2}"
        coordinates = _finite(path, table, SURVEY[1:])
        refuse_far_places(path, _lines(table), SURVEY[1:], coordinates, farthest_m)
        sigmas, note = _survey_sigmas(path, table)
        notes += note
        on = _names(path, table, "screen", empty=True) if "screen" in table else [""] * len(table)
        for i, s in enumerate(on):
            if s and s not in screens:
                raise InputError(
                    f"{path}: line {i + 2}: screen: expected a screen of the project, got {s!r}"
                    f"{did_you_mean(s, screens)}"
                )
        names += points
        xyz.append(coordinates)
        covariance.append(sigmas[:, :, None] ** 2 * np.eye(3))
        screen += on
        source += [str(path)] * len(points)
    return Survey(
        tuple(names),
        np.concatenate(xyz) if xyz else np.empty((0, 3)),
        np.concatenate(covariance) if xyz else np.empty((0, 3, 3)),
        tuple(screen),
        tuple(source),
        tuple(notes),
    )


def read_observations(
    paths: Sequence[Path], cameras: Mapping[str, tuple[int, int]], points: Collection[str]
) -> Observations:
    """Pixels of surveyed points. cameras (with the size of their pictures), points: the project's; others are mistakes.

    Raises InputError in one line.
    """
    camera: list[str] = []
    point: list[str] = []
    pixels, sigmas, source, notes = [], [], [], []
    for path in paths:
        table = read_table(path, POINTS, numbers=(*POINTS[2:], "sigma_px"))
        _some_rows(path, table, POINTS)
        of_camera, of_point = _names(path, table, "camera"), _names(path, table, "point")
        for kind, used, known in (("camera", of_camera, cameras), ("point", of_point, points)):
            for i, name in enumerate(used):
                if name not in known:
                    whose = "the project" if kind == "camera" else "the survey"
                    if not known:
                        raise InputError(
                            f"{path}: line {i + 2}: {kind}: expected a {kind} of {whose}, which has none, got {name!r};"
                            f" add {'`survey` with its points' if kind == 'point' else '`cameras`'} to the project"
                        )
                    raise InputError(
                        f"{path}: line {i + 2}: {kind}: expected a {kind} of {whose}, got {name!r}"
                        f"{did_you_mean(name, known)}"[:240]
                    )
        pairs = list(zip(of_camera, of_point, strict=True))
        for i, pair in enumerate(pairs):
            if pair in pairs[:i] or pair in zip(camera, point, strict=True):
                raise InputError(
                    f"{path}: line {i + 2}: expected each point once per camera, got point {pair[1]!r} of camera"
                    f" {pair[0]!r} a second time"
                )
        camera += of_camera
        point += of_point
        uv = _finite(path, table, POINTS[2:])
        refuse_far_pixels(path, _lines(table), of_camera, uv, cameras)
        pixels.append(uv)
        if "sigma_px" in table:
            given = numbers_in(table, "sigma_px", path, "a number above 0", may_be_empty=True)
            refuse_sigmas(path, _lines(table), "sigma_px", given, SIGMAS_PX, "px")
            sigma = np.where(np.isnan(given), DEFAULT_POINT_SIGMA_PX, given)
        else:
            notes.append(f"{path}: no column sigma_px: {DEFAULT_POINT_SIGMA_PX} px is assumed")
            sigma = np.full(len(table), DEFAULT_POINT_SIGMA_PX)
        sigmas.append(sigma)
        source += [str(path)] * len(table)
    return Observations(
        tuple(camera),
        tuple(point),
        np.concatenate(pixels) if pixels else np.empty((0, 2)),
        np.concatenate(sigmas) if sigmas else np.empty(0),
        tuple(source),
        tuple(notes),
    )


def read_poses(path: Path) -> StandPoses:
    """Poses of the stand: the columns of truth/pose.csv, and POSE_SIGMAS where known.

    Raises InputError in one line.
    """
    table = read_table(path, columns.TRUTH_POSE, numbers=(*columns.TRUTH_POSE, *POSE_SIGMAS))
    _some_rows(path, table, columns.TRUTH_POSE)
    frames = whole_numbers(table, "frame", path)
    falling = np.flatnonzero(np.diff(frames) <= 0) + 1
    if falling.size:
        raise InputError(
            f"{path}: line {falling[0] + 2}: frame: expected rising numbers, got {frames[falling[0]]} after"
            f" {frames[falling[0] - 1]}; sort the rows, and give each frame once"
        )
    numbers_in(table, "t_s", path, "seconds", may_be_empty=True)
    xyz = _finite(path, table, ("x_m", "y_m", "z_m"))
    refuse_far_places(path, _lines(table), ("x_m", "y_m", "z_m"), xyz)
    q = _finite(path, table, ("qw", "qx", "qy", "qz"))
    refuse_other_lengths(path, _lines(table), q)
    sigmas = np.full((len(table), 6), np.nan)
    for k, name in enumerate(POSE_SIGMAS):
        if name in table:
            value = numbers_in(table, name, path, "0 or more", may_be_empty=True)
            allowed, unit = ((0.0, SIGMAS_M[1]), "m") if k < 3 else (SIGMAS_DEG, "deg")
            refuse_sigmas(path, _lines(table), name, value, allowed, unit)
            sigmas[:, k] = value if k < 3 else np.radians(value)
    return StandPoses(frames, Pose.from_quaternion(q, xyz), sigmas)


def _some_rows(path: Path, table: pd.DataFrame, expected: Sequence[str]) -> None:
    if not len(table):
        raise InputError(f"{path}: expected rows {','.join(expected)} below the header, got none")
    if table.attrs["malformed"]:
        raise InputError(
            f"{path}: {table.attrs['malformed']} lines have more fields than the header; mend them (a comma too many,"
            " or a decimal comma)"
        )


def _names(path: Path, table: pd.DataFrame, column: str, empty: bool = False) -> list[str]:
    names = [str(v).strip() for v in table[column]]
    for i, name in enumerate(names):
        if not name and not empty:
            raise InputError(f"{path}: line {i + 2}: {column}: expected a name, got nothing")
    return names


def _finite(path: Path, table: pd.DataFrame, names: Sequence[str]) -> Array:
    return np.stack([numbers_in(table, name, path) for name in names], axis=1)


def _lines(table: pd.DataFrame) -> range:
    """The line of the file of each row."""
    return range(2, len(table) + 2)


def _survey_sigmas(path: Path, table: pd.DataFrame) -> tuple[Array, list[str]]:
    """Sigmas (n, 3), m, and what was assumed."""
    missing = [c for c in SURVEY_SIGMAS if c not in table]
    sigmas = np.full((len(table), 3), np.nan)
    for k, name in enumerate(SURVEY_SIGMAS):
        if name in table:
            sigmas[:, k] = numbers_in(table, name, path, "a number above 0", may_be_empty=True)
            refuse_sigmas(path, _lines(table), name, sigmas[:, k], SIGMAS_M, "m")
    none = np.isnan(sigmas)
    if not none.any():
        return sigmas, []
    what = f"no column {', '.join(missing)}" if missing else f"{int(none.any(axis=1).sum())} points without a sigma"
    return np.where(none, DEFAULT_SURVEY_SIGMA_M, sigmas), [
        f"{path}: {what}: {1e3 * DEFAULT_SURVEY_SIGMA_M:g} mm is assumed; give the instrument's figure"
    ]
