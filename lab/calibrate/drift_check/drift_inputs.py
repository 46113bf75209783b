"""What a daily check measures with: pixels of known points from CSV files, or the spots of a run that stands still."""

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
    rows = _rows(path, PIXELS)
    if survey is not None:
        places = _places(survey, _rows(survey, ("point", "x_m", "y_m")), rig)
    elif "x_m" in rows[0][1]:
        places = _places(path, rows, rig)
    else:
        raise InputError(
            f"{path}: expected the places of its points: columns x_m,y_m,z_m (or screen,x_m,y_m) in this file, or a"
            " survey file beside it (--survey); got neither"
        )
    camera, point, pixels, sigma, place, sigma_m, screen = [], [], [], [], [], [], []
    seen: dict[tuple[str, str], int] = {}
    for line, row in rows:
        name = row["camera"]
        if name not in rig.cameras:
            raise InputError(
                f"{path}: line {line}: camera: expected a camera of the rig, got {name!r}"
                + did_you_mean(name, rig.cameras)
            )
        if row["point"] not in places:
            near = did_you_mean(row["point"], places)
            raise InputError(
                f"{survey or path}: expected a place of point {row['point']!r} ({path.name}, line {line}), got none"
                + near
            )
        key = (name, row["point"])
        if key in seen:
            raise InputError(
                f"{path}: line {line}: expected each point once per camera, got {row['point']!r} of {name!r} again"
                f" (line {seen[key]} has it); give the mean of repeated readings"
            )
        seen[key] = line
        camera.append(name)
        point.append(row["point"])
        pixels.append([_number(path, line, row, c) for c in ("u_px", "v_px")])
        one = _number(path, line, row, "sigma_px") if row.get("sigma_px") else default_sigma_px
        refuse_sigmas(path, [line], "sigma_px", np.array([one]), SIGMAS_PX, "px")
        sigma.append(one)
        p, s, on = places[row["point"]]
        place.append(p)
        sigma_m.append(s)
        screen.append(on)
    sizes = {name: c.image_size_px for name, c in rig.cameras.items()}
    refuse_far_pixels(path, [line for line, _ in rows], camera, np.array(pixels), sizes)
    return KnownPoints(
        tuple(camera), tuple(point), np.array(pixels), np.array(sigma), np.array(place), np.array(sigma_m),
        tuple(screen), "sigma_px" in rows[0][1],
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


def _rows(path: Path, required: Sequence[str]) -> list[tuple[int, dict[str, str]]]:
    """Line number and fields, stripped, of each row of a CSV file; one or more. Raises InputError."""
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


def _places(
    path: Path, rows: Sequence[tuple[int, Mapping[str, str]]], rig: Rig
) -> dict[str, tuple[list[float], list[float], str]]:
    """Place, sigmas and screen (empty: world) of each named point."""
    on_screens = "z_m" not in rows[0][1]
    if on_screens and "screen" not in rows[0][1]:
        raise InputError(f"{path}: expected a column 'z_m' (world) or 'screen' (x_m,y_m on a screen), got neither")
    out: dict[str, tuple[list[float], list[float], str]] = {}
    for line, row in rows:
        names = ("x_m", "y_m") if on_screens else ("x_m", "y_m", "z_m")
        place = [_number(path, line, row, c) for c in names]
        if max(map(abs, place)) > _METRES:
            raise InputError(
                f"{path}: line {line}: {','.join(names)}: expected metres, got {max(place, key=abs):g};"
                " are these millimetres? divide by 1000"
            )
        sigma = [_number(path, line, row, f"sigma_{c}") if row.get(f"sigma_{c}") else 0.0 for c in names]
        if not 0 <= min(sigma) <= max(sigma) <= _METRES:
            raise InputError(
                f"{path}: line {line}: expected sigmas in metres, 0 to {_METRES:g}, got"
                f" {min(sigma) if min(sigma) < 0 else max(sigma):g}; correct it, or leave the field empty"
            )
        screen = row["screen"] if on_screens else ""
        if on_screens and screen not in rig.screens:
            raise InputError(
                f"{path}: line {line}: screen: expected a screen of the rig, got {screen!r}"
                f"{did_you_mean(screen, rig.screens)}"
            )
        fill = [0.0] * (3 - len(place))
        entry = (place + fill, sigma + fill, screen)
        if out.setdefault(row["point"], entry) != entry:
            raise InputError(f"{path}: line {line}: point {row['point']!r} has two different places; name them apart")
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
    table = load_pose_table(path)
    if not len(table):
        raise InputError(f"{path}: expected one or more rows, got none")
    positions = table[["x_m", "y_m", "z_m"]].to_numpy(dtype=float)
    turns = table[["qw", "qx", "qy", "qz"]].to_numpy(dtype=float)
    poses = Pose.from_quaternion(turns / np.linalg.norm(turns, axis=1, keepdims=True), positions)
    apart = poses[0].minus(poses)
    if np.abs(apart[:, :3]).max() > 1e-4 or np.abs(apart[:, 3:]).max() > 1e-4:
        raise InputError(
            f"{path}: expected one constant pose, got poses up to {1e3 * np.abs(apart[:, :3]).max():.2g} mm and"
            f" {np.rad2deg(np.abs(apart[:, 3:]).max()):.2g} deg from the first; a daily check needs a vehicle at rest"
        )
    return poses[0]
