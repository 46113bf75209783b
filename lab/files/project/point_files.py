"""Tables of a calibration project: surveyed points, their pixels, and poses of the stand.

Files of scanned point clouds: PLY and PCD by Open3D, XYZ as plain text.
"""

from __future__ import annotations

import warnings
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calibration.screens.clouds import MissingOpen3DError, open3d
from geometry.arrays import Array, Ints
from geometry.pose import Pose
from lab.errors import InputError
from lab.files.run.truth import check_unit_quaternions
from lab.files.text import columns
from lab.files.text.csv_text import (
    MAX_COORDINATE_M,
    SIGMA_RANGE_DEG,
    SIGMA_RANGE_M,
    SIGMA_RANGE_PX,
    Table,
    check_coordinates,
    check_pixels,
    check_sigmas,
    read_table,
)
from lab.files.text.error_text import suggest_name
from lab.files.text.json_text import require_regular_file

BY_OPEN3D = (".ply", ".pcd", ".pts", ".xyzn", ".xyzrgb")
AS_TEXT = (".xyz", ".txt", ".csv", ".asc")


def read_point_cloud(path: Path, unit_m: float) -> tuple[Array, tuple[str, ...]]:
    """The points (n, 3), m, of a scan, and notes of what was left out. unit_m: metres in one unit of the file.

    Raises InputError: an unknown kind of file, an empty or damaged one, or no finite point.
    """
    path = Path(path)
    kind = path.suffix.lower()
    if kind not in (*BY_OPEN3D, *AS_TEXT):
        known = ", ".join(k[1:] for k in (*BY_OPEN3D, *AS_TEXT))
        raise InputError(f"{path}: expected a point cloud ({known}), got {kind or 'no ending'}; export it as PLY")
    require_regular_file(path)
    try:
        if path.stat().st_size == 0:
            raise InputError(f"{path}: expected points, got an empty file; export the scan again")
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    points = _by_open3d(path) if kind in BY_OPEN3D else _as_text(path)
    finite = np.isfinite(points).all(axis=1)
    if not finite.any():
        raise InputError(f"{path}: expected points, got {len(points)}, none with three finite numbers")
    lost = int(np.sum(~finite))
    notes = (f"{path.name}: {lost} of {len(points)} points left out: not finite",) if lost else ()
    return points[finite] * unit_m, notes


def _by_open3d(path: Path) -> Array:
    try:
        o3d = open3d()
    except MissingOpen3DError as error:
        raise InputError(f"{path}: {error}") from None
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        cloud = o3d.io.read_point_cloud(str(path), remove_nan_points=False, remove_infinite_points=False)
    points = np.asarray(cloud.points, dtype=float).reshape(-1, 3)
    if not len(points):
        raise InputError(f"{path}: expected points, found none; the file is damaged or holds no vertices")
    return points


def _as_text(path: Path) -> Array:
    try:
        lines = path.read_text("utf-8-sig", "replace").splitlines()
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    first = next((i for i, line in enumerate(lines) if _numbers(line) is not None), None)
    if first is None:
        raise InputError(f"{path}: expected lines `x y z`, found none")
    delimiter = "," if "," in lines[first] else ";" if ";" in lines[first] else None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            return np.loadtxt(lines[first:], delimiter=delimiter, usecols=(0, 1, 2), ndmin=2, comments=("#", "//"))
        except ValueError as error:
            raise InputError(f"{path}: expected lines `x y z`, got {str(error).splitlines()[0]}") from None


def _numbers(line: str) -> list[float] | None:
    """The first three numbers of a line; None where it does not start with three numbers."""
    try:
        values = [float(w) for w in line.replace(",", " ").replace(";", " ").split()[:3]]
    except ValueError:
        return None
    return values if len(values) == 3 else None


SURVEY = ("point", "x_m", "y_m", "z_m")
SURVEY_SIGMAS = ("sigma_x_m", "sigma_y_m", "sigma_z_m")
POINTS = ("camera", "point", "u_px", "v_px")
POSE_SIGMAS = ("sigma_x_m", "sigma_y_m", "sigma_z_m", "sigma_rot_x_deg", "sigma_rot_y_deg", "sigma_rot_z_deg")
DEFAULT_SURVEY_SIGMA_M = 0.001  # m, where a survey gives none: a total station with reflective tape at 10 m
DEFAULT_POINT_SIGMA_PX = 0.2  # px, where the table gives none: a printed dot's centroid, or a refined manual pick


@dataclass(frozen=True, slots=True)
class Survey:
    """Surveyed points from one or several files."""

    names: tuple[str, ...]  # n, each once
    xyz: Array  # (n, 3), m, world
    covariance: Array  # (n, 3, 3), m^2
    screen: tuple[str, ...]  # n: the screen on which a point lies; empty: none, or not stated
    source: tuple[str, ...]  # n: the file of each point
    notes: tuple[str, ...] = ()  # assumptions made


@dataclass(frozen=True, slots=True)
class Observations:
    """Pixels of points from one or several files."""

    camera: tuple[str, ...]  # n
    point: tuple[str, ...]  # n
    pixels: Array  # (n, 2)
    sigma_px: Array  # (n,), of each coordinate
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class StandPoses:
    """Poses of the vehicle on the stand, by frame."""

    frames: Ints  # (n,), rising
    stand_from_body: Pose  # a stack of n
    sigmas: Array  # (n, 6): m along the stand's axes, rad about the body's; nan where the table gives none


def read_survey(paths: Sequence[Path], screens: Collection[str], farthest_m: float = MAX_COORDINATE_M) -> Survey:
    """The surveyed points of some files. screens: the project's, for the column `screen`.

    farthest_m: the largest accepted coordinate.

    Raises InputError in one line: file, line, what was expected and what was found.
    """
    names: list[str] = []
    where: dict[str, str] = {}
    xyz, covariance, screen, source, notes = [], [], [], [], []
    for path in paths:
        table = read_table(path, SURVEY, (*SURVEY_SIGMAS, "screen"))
        table.require_rows(SURVEY)
        points = table.names("point")
        for i, name in enumerate(points):
            if name in where:
                raise table.error(i, f"point: expected each point once, got {name!r} again (first in {where[name]})")
            where[name] = f"{path.name}, line {table.lines[i]}"
        coordinates = table.finite_stack(*SURVEY[1:])
        check_coordinates(table, SURVEY[1:], farthest_m)
        sigmas, note = _survey_sigmas(table)
        notes += note
        on = table.names("screen", may_be_empty=True) if "screen" in table else [""] * len(table)
        for i, s in enumerate(on):
            if s and s not in screens:
                raise table.error(i, f"screen: expected a screen of the project, got {s!r}{suggest_name(s, screens)}")
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
    """Pixels of surveyed points. cameras (with picture sizes) and points: the project's; other names are mistakes.

    Raises InputError in one line.
    """
    camera: list[str] = []
    point: list[str] = []
    seen: dict[tuple[str, str], str] = {}
    pixels, sigmas, notes = [], [], []
    for path in paths:
        table = read_table(path, POINTS, ("sigma_px",))
        table.require_rows(POINTS)
        for kind, known, whose, key in (
            ("camera", cameras, "project", "`cameras`"), ("point", points, "survey", "`survey` with its points"),
        ):  # fmt: skip
            if not known:
                missing = f"which has none, got {table.names(kind)[0]!r}; add {key} to the project"
                raise table.error(0, f"{kind}: expected a {kind} of the {whose}, {missing}")
            table.refuse_unknown(kind, known, f"a {kind} of the {whose}")
        of_camera, of_point, uv, sigma = pixels_in(table, cameras, seen)
        camera += of_camera
        point += of_point
        pixels.append(uv)
        if "sigma_px" not in table:
            notes.append(f"{path}: no column sigma_px: {DEFAULT_POINT_SIGMA_PX} px is assumed")
        sigmas.append(np.where(np.isnan(sigma), DEFAULT_POINT_SIGMA_PX, sigma))
    return Observations(
        tuple(camera),
        tuple(point),
        np.concatenate(pixels) if pixels else np.empty((0, 2)),
        np.concatenate(sigmas) if sigmas else np.empty(0),
        tuple(notes),
    )


def pixels_in(
    table: Table, sizes: Mapping[str, tuple[int, int]], seen: dict[tuple[str, str], str]
) -> tuple[list[str], list[str], Array, Array]:
    """Cameras, points, pixels (n, 2) and sigmas (n,), px, of the rows of a table; nan where it states no sigma.

    sizes: of the pictures by camera. seen: camera and point of rows that were read before; gets these. Raises
    InputError.
    """
    cameras, points = table.names("camera"), table.names("point")
    for i, pair in enumerate(zip(cameras, points, strict=True)):
        where = f"{table.path.name}, line {table.lines[i]}"
        if seen.setdefault(pair, where) != where:
            raise table.error(
                i,
                f"expected each point once per camera, got {pair[1]!r} of {pair[0]!r} again (first in {seen[pair]});"
                " give the mean of repeated measurements",
            )
    pixels, sigma = table.finite_stack(*POINTS[2:]), table.finite("sigma_px", "a number above 0", may_be_empty=True)
    check_pixels(table, sizes)
    check_sigmas(table, "sigma_px", SIGMA_RANGE_PX, "px")
    return cameras, points, pixels, sigma


def read_poses(path: Path) -> StandPoses:
    """Poses of the stand: the columns of truth/pose.csv, and optionally POSE_SIGMAS.

    Raises InputError in one line.
    """
    table = read_table(path, columns.TRUTH_POSE, POSE_SIGMAS)
    table.require_rows(columns.TRUTH_POSE)
    frames = table.rising("frame")
    table.finite("t_s", "seconds", may_be_empty=True)
    xyz = table.finite_stack("x_m", "y_m", "z_m")
    check_coordinates(table, ("x_m", "y_m", "z_m"))
    q = table.finite_stack("qw", "qx", "qy", "qz")
    check_unit_quaternions(table)
    sigmas = np.full((len(table), 6), np.nan)
    for k, name in enumerate(POSE_SIGMAS):
        if name in table:
            value = table.finite(name, "0 or more", may_be_empty=True)
            allowed, unit = ((0.0, SIGMA_RANGE_M[1]), "m") if k < 3 else (SIGMA_RANGE_DEG, "deg")
            check_sigmas(table, name, allowed, unit)
            sigmas[:, k] = value if k < 3 else np.radians(value)
    return StandPoses(frames, Pose.from_quaternion(q, xyz), sigmas)


def _survey_sigmas(table: Table) -> tuple[Array, list[str]]:
    """Sigmas (n, 3), m, and a note of what is assumed."""
    missing = [c for c in SURVEY_SIGMAS if c not in table]
    sigmas = np.full((len(table), 3), np.nan)
    for k, name in enumerate(SURVEY_SIGMAS):
        if name in table:
            sigmas[:, k] = table.finite(name, "a number above 0", may_be_empty=True)
            check_sigmas(table, name, SIGMA_RANGE_M, "m")
    none = np.isnan(sigmas)
    if not none.any():
        return sigmas, []
    what = f"no column {', '.join(missing)}" if missing else f"{int(none.any(axis=1).sum())} points without a sigma"
    return np.where(none, DEFAULT_SURVEY_SIGMA_M, sigmas), [
        f"{table.path}: {what}: {1e3 * DEFAULT_SURVEY_SIGMA_M:g} mm is assumed; give the instrument's figure"
    ]
