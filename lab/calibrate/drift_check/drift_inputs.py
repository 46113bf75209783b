"""Measurements for a drift check: pixels of known points from CSV files, or the spots of a vehicle at rest."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from geometry.arrays import Array
from geometry.pose import Pose
from geometry.rig import Rig
from lab.errors import InputError
from lab.files.project.point_files import POINTS, pixels_in
from lab.files.run.results import read_poses, read_spots
from lab.files.run.truth import read_true_poses
from lab.files.text.csv_text import Table, check_coordinates, check_sigmas, read_table
from lab.files.text.error_text import suggest_name

PLACES = ("x_m", "y_m", "z_m", "sigma_x_m", "sigma_y_m", "sigma_z_m")
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
    coordinates on a screen), or from the same columns of the pixel file itself. Raises InputError: with file, line, the
    expected and the found content.
    """
    table = read_table(path, POINTS, ("sigma_px", *PLACES, "screen"))
    table.require_rows(POINTS)
    if survey is not None:
        coordinates = _coordinates(_survey_table(survey), rig)
    elif "x_m" in table:
        coordinates = _coordinates(table, rig)
    else:
        raise InputError(
            f"{path}: expected the coordinates of its points: columns x_m,y_m,z_m (or screen,x_m,y_m) in this file, or"
            " a survey file (--survey); got neither"
        )
    table.refuse_unknown("camera", rig.cameras, "a camera of the rig")
    cameras, points, pixels, sigma = pixels_in(table, {n: c.image_size_px for n, c in rig.cameras.items()}, {})
    for i, point in enumerate(points):
        if point not in coordinates:
            raise InputError(
                f"{survey or path}: expected the coordinates of point {point!r} ({path.name}, line {table.lines[i]}),"
                " got none" + suggest_name(point, coordinates)
            )
    found = [coordinates[point] for point in points]
    return KnownPoints(
        tuple(cameras), tuple(points), pixels, np.where(np.isnan(sigma), default_sigma_px, sigma),
        np.array([xyz for xyz, _, _ in found]), np.array([sigma_m for _, sigma_m, _ in found]),
        tuple(screen for _, _, screen in found), "sigma_px" in table,
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


def _survey_table(path: Path) -> Table:
    required = ("point", "x_m", "y_m")
    table = read_table(path, required, (*PLACES, "screen"))
    table.require_rows(required)
    return table


def _coordinates(table: Table, rig: Rig) -> dict[str, tuple[list[float], list[float], str]]:
    """Coordinates, sigmas and screen (empty: world) of each named point."""
    on_screens = "z_m" not in table
    if on_screens and "screen" not in table:
        raise InputError(
            f"{table.path}: expected a column 'z_m' (world) or 'screen' (x_m,y_m on a screen), got neither"
        )
    names = ("x_m", "y_m") if on_screens else ("x_m", "y_m", "z_m")
    places = table.finite_stack(*names)
    check_coordinates(table, names, _MAX_COORDINATE_M)
    for name in names:
        check_sigmas(table, f"sigma_{name}", (0.0, _MAX_COORDINATE_M), "m")
    sigmas = np.nan_to_num(np.stack([table.optional(f"sigma_{name}") for name in names], axis=1))
    screens = [""] * len(table)
    if on_screens:
        table.refuse_unknown("screen", rig.screens, "a screen of the rig")
        screens = table.names("screen")
    fill = [0.0] * (3 - len(names))
    out: dict[str, tuple[list[float], list[float], str]] = {}
    for i, point in enumerate(table.names("point")):
        place, sigma = places[i].tolist(), sigmas[i].tolist()
        entry = (place + fill, sigma + fill, screens[i])
        if out.setdefault(point, entry) != entry:
            raise table.error(i, f"point {point!r} has two different positions; give them different names")
    return out


def read_still_spots(run: Path, rig: Rig) -> StillSpots:
    """Mean spots of a vehicle at rest, from a folder of results, its spots.csv, or a run folder (processed first).

    Raises InputError: for errors in the files, or fewer than two frames of every spot; BeamposeError: whatever
    processing the run raises.
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
                f"{named}: camera: expected a camera of the rig, got {camera!r}{suggest_name(camera, rig.cameras)}"
            )
        if spot not in rig.spots:
            raise InputError(f"{named}: spot: expected a spot of the rig, got {spot!r}{suggest_name(spot, rig.spots)}")
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

    Raises InputError: if the file has no row or the pose is not constant.
    """
    true = read_true_poses(path)
    if not len(true.frame):
        raise InputError(f"{path}: expected one or more rows, got none")
    turns = true.quaternion_wxyz
    poses = Pose.from_quaternion(turns / np.linalg.norm(turns, axis=1, keepdims=True), true.position_m)
    change = poses[0].minus(poses)
    if np.abs(change[:, :3]).max() > 1e-4 or np.abs(change[:, 3:]).max() > 1e-4:
        raise InputError(
            f"{path}: expected one constant pose, got poses up to {1e3 * np.abs(change[:, :3]).max():.2g} mm and"
            f" {np.rad2deg(np.abs(change[:, 3:]).max()):.2g} deg from the first; a drift check needs a vehicle at rest"
        )
    return poses[0]
