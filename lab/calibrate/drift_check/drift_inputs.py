"""What a daily check measures with: pixels of known points from CSV files, or the spots of a run that stands still."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from geometry.arrays import Array
from geometry.pose import Pose
from geometry.rig import Rig
from lab.errors import InputError
from lab.files.run.results import read_poses, read_spots
from lab.files.run.truth import read_true_poses
from lab.files.text.csv_table import Table
from lab.files.text.csv_text import read_table
from lab.files.text.error_text import did_you_mean
from lab.files.text.range_checks import SIGMAS_PX, refuse_far_pixels, refuse_sigmas

PIXELS = ("camera", "point", "u_px", "v_px")
PLACES = ("x_m", "y_m", "z_m", "sigma_x_m", "sigma_y_m", "sigma_z_m")
_METRES = 500.0  # a coordinate beyond it is taken for millimetres: no lab is that large
_LARGEST_GAP_PX = 200.0  # a point that far from where it should be is another point, or another rig


@dataclass(frozen=True, slots=True)
class KnownPoints:
    """n pixels of points whose place is known."""

    camera: tuple[str, ...]  # (n,)
    point: tuple[str, ...]  # (n,)
    pixels: Array  # (n, 2)
    sigma_px: Array  # (n,), of each coordinate
    place: Array  # (n, 3), m: in world, or x, y, 0 in the frame of `screen`
    sigma_m: Array  # (n, 3)
    screen: tuple[str, ...]  # (n,): the screen in whose frame the place is; empty: world
    sigma_given: bool  # whether the file said how good the pixels are


@dataclass(frozen=True, slots=True)
class StillSpots:
    """The mean pixels of a vehicle that stands still: n views."""

    views: tuple[tuple[str, str], ...]  # (n,) camera, spot
    pixels: Array  # (n, 2)
    scatter_px: Array  # (n, 2), of one frame
    sigma_px: Array  # (n, 2), of one frame, as the tracker claims
    frames: Array  # (n,) in which each was measured
    drift_px: Array  # (n, 2): second half of the frames minus the first
    start: Pose | None  # where the run says the vehicle stood


def read_points(path: Path, survey: Path | None, rig: Rig, default_sigma_px: float) -> KnownPoints:
    """Pixels from a CSV camera,point,u_px,v_px[,sigma_px] and the places of its points.

    The places come from `survey` (point,x_m,y_m,z_m[,sigma_x_m,sigma_y_m,sigma_z_m], or point,screen,x_m,y_m for
    coordinates on a screen), or from the same columns of the pixel file itself. Raises InputError.
    """
    table = read_table(path, PIXELS, ("sigma_px", *PLACES, "screen"))
    table.require_rows(PIXELS)
    if survey is not None:
        places = _places(_survey_table(survey), rig)
    elif "x_m" in table:
        places = _places(table, rig)
    else:
        raise InputError(
            f"{path}: expected the places of its points: columns x_m,y_m,z_m (or screen,x_m,y_m) in this file, or a"
            " survey file beside it (--survey); got neither"
        )
    cameras, points = table.names("camera"), table.names("point")
    pixels = np.stack([table.finite(c) for c in ("u_px", "v_px")], axis=1)
    seen: dict[tuple[str, str], int] = {}
    for i, (camera, point) in enumerate(zip(cameras, points, strict=True)):
        if camera not in rig.cameras:
            raise table.error(
                i, f"camera: expected a camera of the rig, got {camera!r}{did_you_mean(camera, rig.cameras)}"
            )
        if point not in places:
            raise InputError(
                f"{survey or path}: expected a place of point {point!r} ({path.name}, line {table.lines[i]}), got none"
                + did_you_mean(point, places)
            )
        if (camera, point) in seen:
            raise table.error(
                i,
                f"expected each point once per camera, got {point!r} of {camera!r} again (line {seen[camera, point]}"
                " has it); give the mean of repeated readings",
            )
        seen[camera, point] = int(table.lines[i])
    sigma = table.optional("sigma_px")
    refuse_sigmas(table, "sigma_px", SIGMAS_PX, "px")
    refuse_far_pixels(table, {name: c.image_size_px for name, c in rig.cameras.items()})
    found = [places[point] for point in points]
    return KnownPoints(
        tuple(cameras), tuple(points), pixels, np.where(np.isnan(sigma), default_sigma_px, sigma),
        np.array([place for place, _, _ in found]), np.array([sigma_m for _, sigma_m, _ in found]),
        tuple(screen for _, _, screen in found), "sigma_px" in table,
    )  # fmt: skip


def refuse_other_points(known: KnownPoints, foretold: Array, path: Path) -> None:
    """Raise InputError where pixels lie so far from the foretold (n, 2) ones that no drift explains it."""
    for i, name in enumerate(known.point):
        where = f"{path}: point {name!r} of camera {known.camera[i]!r}"
        if not np.isfinite(foretold[i]).all():
            raise InputError(
                f"{where}: its place cannot be seen by this camera (behind it, or beyond its lens model);"
                " check the survey's axes and frame, and the camera's name"
            )
    gaps = np.linalg.norm(known.pixels - foretold, axis=1)
    if np.median(gaps) > _LARGEST_GAP_PX:
        i = int(np.argmax(gaps))
        raise InputError(
            f"{path}: expected pixels near those that the rig foretells, got them {np.median(gaps):.0f} px off"
            f" (point {known.point[i]!r} of camera {known.camera[i]!r}: {gaps[i]:.0f} px); check the survey's unit,"
            " axes and frame, the points' names, and that this is the right rig.yaml"
        )


def _survey_table(path: Path) -> Table:
    required = ("point", "x_m", "y_m")
    table = read_table(path, required, (*PLACES, "screen"))
    table.require_rows(required)
    return table


def _places(table: Table, rig: Rig) -> dict[str, tuple[list[float], list[float], str]]:
    """Place, sigmas and screen (empty: world) of each named point."""
    on_screens = "z_m" not in table
    if on_screens and "screen" not in table:
        raise InputError(
            f"{table.path}: expected a column 'z_m' (world) or 'screen' (x_m,y_m on a screen), got neither"
        )
    names = ("x_m", "y_m") if on_screens else ("x_m", "y_m", "z_m")
    places = np.stack([table.finite(c) for c in names], axis=1)
    sigmas = np.nan_to_num(np.stack([table.optional(f"sigma_{name}") for name in names], axis=1))
    screens = table.names("screen", may_be_empty=True) if on_screens else [""] * len(table)
    fill = [0.0] * (3 - len(names))
    out: dict[str, tuple[list[float], list[float], str]] = {}
    for i, point in enumerate(table.names("point")):
        place, sigma = places[i].tolist(), sigmas[i].tolist()
        if max(map(abs, place)) > _METRES:
            raise table.error(
                i,
                f"{','.join(names)}: expected metres, got {max(place, key=abs):g}; are these millimetres? divide by"
                " 1000",
            )
        if not 0 <= min(sigma) <= max(sigma) <= _METRES:
            raise table.error(
                i,
                f"expected sigmas in metres, 0 to {_METRES:g}, got {min(sigma) if min(sigma) < 0 else max(sigma):g};"
                " correct it, or leave the field empty",
            )
        if on_screens and screens[i] not in rig.screens:
            raise table.error(
                i,
                f"screen: expected a screen of the rig, got {screens[i]!r}{did_you_mean(screens[i], rig.screens)}",
            )
        entry = (place + fill, sigma + fill, screens[i])
        if out.setdefault(point, entry) != entry:
            raise table.error(i, f"point {point!r} has two different places; name them apart")
    return out


def read_still(run: Path, rig: Rig) -> StillSpots:
    """The mean spots of a still vehicle: from a folder of results, its spots.csv, or a run folder (processed first).

    Raises InputError, and what processing a run raises.
    """
    run = Path(run)
    if not run.exists():
        raise InputError(f"{run}: expected a run folder, a folder of results or a spots.csv, found nothing")
    if run.is_dir() and (run / "run.yaml").is_file() and not (run / "spots.csv").is_file():
        from lab.runs.process import process_run  # only here: it brings the tracker with it

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
    """The pose of a vehicle that stands still, from a pose.csv (columns of truth/pose.csv). Raises InputError."""
    true = read_true_poses(path)
    if not len(true.frame):
        raise InputError(f"{path}: expected one or more rows, got none")
    turns = true.quaternion_wxyz
    poses = Pose.from_quaternion(turns / np.linalg.norm(turns, axis=1, keepdims=True), true.position_m)
    apart = poses[0].minus(poses)
    if np.abs(apart[:, :3]).max() > 1e-4 or np.abs(apart[:, 3:]).max() > 1e-4:
        raise InputError(
            f"{path}: expected one constant pose, got poses up to {1e3 * np.abs(apart[:, :3]).max():.2g} mm and"
            f" {np.rad2deg(np.abs(apart[:, 3:]).max()):.2g} deg from the first; a daily check needs a vehicle at rest"
        )
    return poses[0]
