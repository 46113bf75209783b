"""Measurements for a drift check: pixels of known points from CSV files, or the spots of a vehicle at rest."""

from __future__ import annotations

import csv
import math
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from geometry.arrays import Array
from geometry.pose import Pose
from geometry.rig import Rig
from lab.errors import InputError
from lab.files.run.results import read_poses, read_spots
from lab.files.run.truth import load_pose_table
from lab.files.text.csv_text import check_header, table_bytes
from lab.files.text.range_checks import SIGMAS_PX, refuse_far_pixels, refuse_sigmas
from lab.files.text.yaml_text import did_you_mean, shown

PIXELS = ("camera", "point", "u_px", "v_px")
_MAX_COORDINATE_M = 500.0  # larger coordinates are taken for millimetres: no lab is that large
_MAX_RESIDUAL_PX = 200.0  # a median residual above this means other points or another rig


@dataclass(frozen=True, slots=True)
class DriftInputs:
    """Files of a drift check: known points, or a static run."""

    points: Path | None = None  # CSV camera,point,u_px,v_px[,sigma_px]
    run: Path | None = None  # run folder, folder of results or spots.csv of a vehicle at rest
    survey: Path | None = None  # coordinates of the points; None: in the file `points`
    pose: Path | None = None  # pose of the vehicle at rest, as truth/pose.csv; None: unknown, to be fitted

    def check(self) -> None:
        """Raise InputError unless exactly one of points and run is given, with only its own additional file."""
        if (self.points is None) == (self.run is None):
            got = "neither" if self.points is None else "both"
            raise InputError(f"expected either known points (--points) or a static run (--run), got {got}")
        if self.points is None and self.survey is not None:
            raise InputError("expected --survey only together with --points: a static run needs no surveyed points")
        if self.run is None and self.pose is not None:
            raise InputError("expected --pose only together with --run: known points need no pose")

    def files(self) -> list[Path]:
        """The files, for the report; a folder is not one."""
        given = [p for p in (self.points, self.survey, self.pose) if p is not None]
        return [*given, *([self.run] if self.run is not None and self.run.is_file() else [])]


@dataclass(frozen=True, slots=True)
class KnownPoints:
    """n pixels of points with known coordinates."""

    camera: tuple[str, ...]  # (n,)
    point: tuple[str, ...]  # (n,)
    pixels: Array  # (n, 2)
    sigma_px: Array  # (n,) of each coordinate
    xyz: Array  # (n, 3), m: in world, or x, y, 0 in the frame of `screen`
    sigma_m: Array  # (n, 3)
    screen: tuple[str, ...]  # (n,) screen in whose frame xyz is; empty: world
    sigma_given: bool  # whether the file states the sigmas of the pixels


@dataclass(frozen=True, slots=True)
class _Place:
    """Position of a known point."""

    xyz: tuple[float, ...]  # m: in world, or x, y, 0 in the frame of `screen`
    sigma_m: tuple[float, ...]  # of each coordinate
    screen: str  # empty: world


@dataclass(frozen=True, slots=True)
class StillSpots:
    """Mean pixels of a vehicle at rest: n views."""

    views: tuple[tuple[str, str], ...]  # (n,) camera, spot
    pixels: Array  # (n, 2)
    scatter_px: Array  # (n, 2) of one frame
    sigma_px: Array  # (n, 2) of one frame, as stated by the tracker
    frames: Array  # (n,) number of frames in which each was measured
    drift_px: Array  # (n, 2) mean of the second half of the frames minus mean of the first
    start: Pose | None  # pose of the vehicle in the results, as start of the fit


def read_points(path: Path, survey: Path | None, rig: Rig, default_sigma_px: float) -> KnownPoints:
    """Read pixels from a CSV camera,point,u_px,v_px[,sigma_px] and the coordinates of their points.

    The coordinates come from `survey` (point,x_m,y_m,z_m[,sigma_x_m,sigma_y_m,sigma_z_m], or point,screen,x_m,y_m for
    coordinates on a screen), or from the same columns of the pixel file itself.

    Raises:
        InputError: with file, line, the expected and the found content.
    """
    rows = _rows(path, PIXELS)
    if survey is not None:
        coordinates = _coordinates(survey, _rows(survey, ("point", "x_m", "y_m")), rig)
    elif "x_m" in rows[0][1]:
        coordinates = _coordinates(path, rows, rig)
    else:
        raise InputError(
            f"{path}: expected the coordinates of its points: columns x_m,y_m,z_m (or screen,x_m,y_m) in this file, or"
            " a survey file (--survey); got neither"
        )
    camera, point, pixels, sigma, xyz, sigma_m, screen = [], [], [], [], [], [], []
    line_of: dict[tuple[str, str], int] = {}
    for line, row in rows:
        name = row["camera"]
        if name not in rig.cameras:
            raise InputError(
                f"{path}: line {line}: camera: expected a camera of the rig, got {name!r}"
                + did_you_mean(name, rig.cameras)
            )
        if row["point"] not in coordinates:
            near = did_you_mean(row["point"], coordinates)
            raise InputError(
                f"{survey or path}: expected the coordinates of point {row['point']!r} ({path.name}, line {line}),"
                f" got none{near}"
            )
        key = (name, row["point"])
        if key in line_of:
            raise InputError(
                f"{path}: line {line}: expected each point once per camera, got {row['point']!r} of {name!r} again"
                f" (first in line {line_of[key]}); give the mean of repeated measurements"
            )
        line_of[key] = line
        camera.append(name)
        point.append(row["point"])
        pixels.append([_number(path, line, row, c) for c in ("u_px", "v_px")])
        one = _number(path, line, row, "sigma_px") if row.get("sigma_px") else default_sigma_px
        refuse_sigmas(path, [line], "sigma_px", np.array([one]), SIGMAS_PX, "px")
        sigma.append(one)
        place = coordinates[row["point"]]
        xyz.append(place.xyz)
        sigma_m.append(place.sigma_m)
        screen.append(place.screen)
    sizes = {name: c.image_size_px for name, c in rig.cameras.items()}
    refuse_far_pixels(path, [line for line, _ in rows], camera, np.array(pixels), sizes)
    return KnownPoints(
        tuple(camera), tuple(point), np.array(pixels), np.array(sigma), np.array(xyz), np.array(sigma_m),
        tuple(screen), "sigma_px" in rows[0][1],
    )  # fmt: skip


def check_points_match(known: KnownPoints, predicted: Array, path: Path) -> None:
    """Raise InputError if the pixels are so far from the predicted ones (n, 2) that no drift explains it."""
    for i, name in enumerate(known.point):
        where = f"{path}: point {name!r} of camera {known.camera[i]!r}"
        if not np.isfinite(predicted[i]).all():
            raise InputError(
                f"{where}: this camera cannot see the point (it is behind the camera or outside of the lens model's"
                " range); check the survey's axes and frame, and the camera's name"
            )
    residuals = np.linalg.norm(known.pixels - predicted, axis=1)
    if np.median(residuals) > _MAX_RESIDUAL_PX:
        i = int(np.argmax(residuals))
        raise InputError(
            f"{path}: expected pixels near those predicted by the rig, got them {np.median(residuals):.0f} px off"
            f" (point {known.point[i]!r} of camera {known.camera[i]!r}: {residuals[i]:.0f} px); check the survey's"
            " unit, axes and frame, the points' names, and that this is the right rig.yaml"
        )


def _rows(path: Path, required: Sequence[str]) -> list[tuple[int, dict[str, str]]]:
    """Line number and stripped fields of each row of a CSV file. Raises InputError if there is none."""
    text = table_bytes(path, required).decode("utf-8-sig").lstrip("\r\n")
    check_header(path, text.splitlines()[0], required)
    lines = list(csv.reader(text.splitlines(), skipinitialspace=True))
    header = [f.strip() for f in lines[0]]
    rows = []
    for number, fields in enumerate(lines[1:], 2):
        if not any(f.strip() for f in fields):
            continue
        if len(fields) != len(header):
            raise InputError(f"{path}: line {number}: expected {len(header)} fields, got {len(fields)}")
        rows.append((number, dict(zip(header, (f.strip() for f in fields), strict=True))))
    if not rows:
        raise InputError(f"{path}: expected one or more points below the header, got none")
    return rows


def _number(path: Path, line: int, row: Mapping[str, str], column: str) -> float:
    try:
        value = float(row[column])
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InputError(f"{path}: line {line}: {column}: expected a finite number, got {shown(row[column] or None)}")
    return value


def _coordinates(path: Path, rows: Sequence[tuple[int, Mapping[str, str]]], rig: Rig) -> dict[str, _Place]:
    """The position of each named point."""
    on_screens = "z_m" not in rows[0][1]
    if on_screens and "screen" not in rows[0][1]:
        raise InputError(f"{path}: expected a column 'z_m' (world) or 'screen' (x_m,y_m on a screen), got neither")
    out: dict[str, _Place] = {}
    for line, row in rows:
        names = ("x_m", "y_m") if on_screens else ("x_m", "y_m", "z_m")
        xyz = [_number(path, line, row, c) for c in names]
        if max(map(abs, xyz)) > _MAX_COORDINATE_M:
            raise InputError(
                f"{path}: line {line}: {','.join(names)}: expected metres, got {max(xyz, key=abs):g};"
                " are these millimetres? divide by 1000"
            )
        sigma = [_number(path, line, row, f"sigma_{c}") if row.get(f"sigma_{c}") else 0.0 for c in names]
        if not 0 <= min(sigma) <= max(sigma) <= _MAX_COORDINATE_M:
            raise InputError(
                f"{path}: line {line}: expected sigmas in metres, 0 to {_MAX_COORDINATE_M:g}, got"
                f" {min(sigma) if min(sigma) < 0 else max(sigma):g}; correct it, or leave the field empty"
            )
        screen = row["screen"] if on_screens else ""
        if on_screens and screen not in rig.screens:
            raise InputError(
                f"{path}: line {line}: screen: expected a screen of the rig, got {screen!r}"
                f"{did_you_mean(screen, rig.screens)}"
            )
        fill = (0.0,) * (3 - len(xyz))
        entry = _Place((*xyz, *fill), (*sigma, *fill), screen)
        if out.setdefault(row["point"], entry) != entry:
            raise InputError(
                f"{path}: line {line}: point {row['point']!r} has two different positions; give them different names"
            )
    return out


def read_still_spots(run: Path, rig: Rig) -> StillSpots:
    """Mean spots of a vehicle at rest, from a folder of results, its spots.csv, or a run folder (processed first).

    Raises:
        InputError: for errors in the files, or fewer than two frames of every spot.
        BeamposeError: whatever processing the run raises.
    """
    if not run.exists():
        raise InputError(f"{run}: expected a run folder, a folder of results or a spots.csv, found nothing")
    if run.is_dir() and (run / "run.yaml").is_file() and not (run / "spots.csv").is_file():
        from lab.runs.process import process_run  # imports the tracker

        with tempfile.TemporaryDirectory(prefix="beampose-check-") as work:
            process_run(run, Path(work) / "results")
            return _still(Path(work) / "results", rig, run)
    if run.is_file() and run.name != "spots.csv":
        raise InputError(f"{run}: expected a file named spots.csv, or the folder that holds it")
    folder = run if run.is_dir() else run.parent
    if not (folder / "spots.csv").is_file():
        raise InputError(f"{folder}: expected a run.yaml or a spots.csv in this folder, found neither")
    return _still(folder, rig, run)


def _still(results: Path, rig: Rig, named: Path) -> StillSpots:
    grid = read_spots(results)
    known = set(rig.views())
    for camera, spot in grid.views:
        if camera not in rig.cameras:
            raise InputError(
                f"{named}: camera: expected a camera of the rig, got {camera!r}{did_you_mean(camera, rig.cameras)}"
            )
        if spot not in rig.spots:
            raise InputError(f"{named}: spot: expected a spot of the rig, got {spot!r}{did_you_mean(spot, rig.spots)}")
        if (camera, spot) not in known:
            raise InputError(f"{named}: camera {camera!r} does not observe the screen of spot {spot!r} in this rig")
    views, pixels, scatter, sigma, frames, drift = [], [], [], [], [], []
    for i, view in enumerate(grid.views):
        seen = grid.measured[:, i] & np.isfinite(grid.uv_px[:, i]).all(axis=1)
        uv = grid.uv_px[seen, i]
        if len(uv) < 2:
            continue
        half = len(uv) // 2
        views.append(view)
        pixels.append(uv.mean(axis=0))
        scatter.append(uv.std(axis=0, ddof=1))
        sigma.append(np.sqrt(np.nanmean(grid.sigma_px[seen, i] ** 2, axis=0)))
        frames.append(len(uv))
        drift.append(uv[half:].mean(axis=0) - uv[:half].mean(axis=0))
    if not views:
        raise InputError(f"{named}: expected spots measured in two frames or more, got none; record longer")
    start = None
    if (results / "attitude.csv").is_file():
        track = read_poses(results)
        if track.known.any():
            start = track.world_from_body[int(np.flatnonzero(track.known)[0])]
    return StillSpots(
        tuple(views), np.array(pixels), np.array(scatter), np.array(sigma), np.array(frames, dtype=float),
        np.array(drift), start,
    )  # fmt: skip


def read_still_pose(path: Path) -> Pose:
    """Pose of a vehicle at rest from a pose.csv (columns of truth/pose.csv).

    Raises:
        InputError: if the file has no row or the pose is not constant.
    """
    table = load_pose_table(path)
    if not len(table):
        raise InputError(f"{path}: expected one or more rows, got none")
    positions = table[["x_m", "y_m", "z_m"]].to_numpy(dtype=float)
    turns = table[["qw", "qx", "qy", "qz"]].to_numpy(dtype=float)
    poses = Pose.from_quaternion(turns / np.linalg.norm(turns, axis=1, keepdims=True), positions)
    change = poses[0].minus(poses)
    if np.abs(change[:, :3]).max() > 1e-4 or np.abs(change[:, 3:]).max() > 1e-4:
        raise InputError(
            f"{path}: expected one constant pose, got poses up to {1e3 * np.abs(change[:, :3]).max():.2g} mm and"
            f" {np.rad2deg(np.abs(change[:, 3:]).max()):.2g} deg from the first; a drift check needs a vehicle at rest"
        )
    return poses[0]
