"""Files of scanned point clouds: PLY and PCD by Open3D, XYZ as plain text."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np

from calibration.open3d_loader import MissingOpen3DError, open3d
from geometry.arrays import Array
from lab.errors import InputError
from lab.files.text.regular_file import require_regular_file

BY_OPEN3D = (".ply", ".pcd", ".pts", ".xyzn", ".xyzrgb")
AS_TEXT = (".xyz", ".txt", ".csv", ".asc")


def read_point_cloud(path: Path, unit_m: float) -> tuple[Array, tuple[str, ...]]:
    """The points (n, 3), m, of a scan, and notes of what was left out. unit_m: metres in one unit of the file.

    Raises:
        InputError: an unknown kind of file, an empty or damaged one, or no finite point.
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
