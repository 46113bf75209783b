"""The truth of a run folder: truth/pose.csv and truth/spots.csv, read and checked.

A simulation or the record of a turntable provides it. `check`, `run`, the score and the report use this reader.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from geometry.arrays import Array, Bools, Ints, evenly_spread
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.rig import Rig
from lab.files.rig.pose_block import QUATERNION_TOLERANCE
from lab.files.run.run_file import Run
from lab.files.text import columns
from lab.files.text.csv_text import Categorical, Table, read_table, write_table

FARTHEST = 1e9  # px, m or s: a number beyond it is a mistake, and its square may not be finite
MAX_COMPARED_FRAMES = 500  # by `largest_disagreement_px`, evenly spread: enough to show a wrong rig


@dataclass(frozen=True, slots=True)
class TruePoses:
    """truth/pose.csv, n rows."""

    frame: Ints  # (n,) rising
    t_s: Array  # (n,)
    position_m: Array  # (n, 3), of the body origin, in world
    quaternion_wxyz: Array  # (n, 4), world_from_body, of length 1 within QUATERNION_TOLERANCE


@dataclass(frozen=True, slots=True)
class TrueSpots:
    """truth/spots.csv, n rows: one per frame, camera and spot, in any order."""

    frame: Ints  # (n,)
    camera: Categorical  # (n,)
    spot: Categorical  # (n,)
    uv_px: Array  # (n, 2), distorted pixels; nan where no projection exists
    in_view: Ints  # (n,): 1 in the picture, 2 hidden, 0 outside it


@dataclass(frozen=True, slots=True)
class TruthTables:
    """The tables of a truth folder; one of them may be missing."""

    pose: TruePoses | None
    spots: TrueSpots | None


def load_run_truth(run: Run) -> TruthTables | None:
    """The truth of a run, with the names of its rig. Cameras that the run leaves out may be in it.

    Raises InputError as `load_truth`.
    """
    return load_truth(run.folder, (*run.rig.cameras, *run.left_out), tuple(run.rig.spots))


def load_truth(
    run_folder: Path, cameras: Collection[str] | None = None, spots: Collection[str] | None = None
) -> TruthTables | None:
    """The truth of a run folder; None where it has none. cameras, spots: the rig's; other names are mistakes.

    Raises InputError in one line: file, line, column, what was expected and what was found.
    """
    folder = Path(run_folder) / "truth"
    pose_path, spots_path = folder / "pose.csv", folder / "spots.csv"
    if not pose_path.exists() and not spots_path.exists():
        return None
    return TruthTables(
        read_true_poses(pose_path) if pose_path.exists() else None,
        _read_true_spots(spots_path, {"camera": cameras, "spot": spots}) if spots_path.exists() else None,
    )


def read_true_poses(path: Path) -> TruePoses:
    """A table of poses, columns TRUTH_POSE. Raises InputError in one line."""
    table = read_table(path, columns.TRUTH_POSE)
    table.refuse_long_lines()
    frame = table.rising("frame")
    numbers = {name: table.finite(name) for name in columns.TRUTH_POSE[1:]}
    for name in ("t_s", "x_m", "y_m", "z_m"):
        for i in np.flatnonzero(np.abs(numbers[name]) > FARTHEST)[:1]:
            raise table.error(i, f"{name}: expected a number within {FARTHEST:g}, got {table.found(name, i)}")
    check_unit_quaternions(table)
    return TruePoses(frame, numbers["t_s"], table.stack("x_m", "y_m", "z_m"), table.stack("qw", "qx", "qy", "qz"))


def write_true_poses(path: Path, frames: Ints, t_s: Array, poses: Pose) -> None:
    """Write a table of poses, columns TRUTH_POSE."""
    rows = zip(frames, t_s, poses.translation, poses.quaternion_wxyz, strict=True)
    write_table(path, columns.TRUTH_POSE, ((k, f"{t:.9g}", *(f"{x:.12g}" for x in (*p, *q))) for k, t, p, q in rows))


def check_unit_quaternions(table: Table) -> None:
    """Raises InputError at the first quaternion (columns qw, qx, qy, qz) whose length is not 1."""
    length = np.linalg.norm(table.stack("qw", "qx", "qy", "qz"), axis=1)
    for i in np.flatnonzero(~(np.abs(length - 1) <= QUATERNION_TOLERANCE))[:1]:
        remedy = "give all digits, or divide each of the four numbers by that length"
        if length[i] == 0:
            remedy = "without rotation it is 1,0,0,0"
        raise table.error(
            i, f"qw,qx,qy,qz: expected a quaternion of length 1, got one of length {length[i]:.7g}; {remedy}"
        )


def _read_true_spots(path: Path, known: dict[str, Collection[str] | None]) -> TrueSpots:
    """truth/spots.csv. known: the rig's names by column; None: any name."""
    table = read_table(path, columns.TRUTH_SPOTS)
    table.refuse_long_lines()
    frame = table.whole("frame")
    in_view = table.numbers["in_view"]
    for i in np.flatnonzero(~np.isin(in_view, (0, 1, 2)))[:1]:
        raise table.error(i, f"in_view: expected 0, 1 or 2, got {table.found('in_view', i)}")
    for name in ("u_px", "v_px"):
        for i in np.flatnonzero(~np.isfinite(table.numbers[name]) & (in_view > 0))[:1]:
            raise table.error(i, f"{name}: expected a number where in_view is 1 or 2, got {table.found(name, i)}")
        for i in np.flatnonzero(np.abs(table.numbers[name]) > FARTHEST)[:1]:
            raise table.error(i, f"{name}: expected a pixel within {FARTHEST:g}, got {table.found(name, i)}")
    for column, names in known.items():
        if names is not None:
            table.refuse_unknown(column, names, f"a {column} of the rig")
    spots = TrueSpots(
        frame, table.words["camera"], table.words["spot"], table.stack("u_px", "v_px"), in_view.astype(np.int64)
    )
    for i in np.flatnonzero(_repeated(spots))[:1]:
        raise table.error(i, f"expected one row per frame, camera and spot, got a second one for frame {frame[i]}")
    return spots


def _repeated(spots: TrueSpots) -> Bools:
    """(n,): an earlier row has the same frame, camera and spot."""
    keys = np.stack([spots.frame, spots.camera.codes, spots.spot.codes], axis=1)
    order = np.lexsort(keys.T[::-1])  # stable
    again = np.zeros(len(keys), dtype=bool)
    again[order[1:]] = np.all(keys[order[1:]] == keys[order[:-1]], axis=1)
    return again


def largest_disagreement_px(truth: TruthTables, rig: Rig) -> tuple[float, int] | None:
    """Largest distance, px, between the true spots and the projections of the true poses by the rig, and its frame.

    None where the two tables have nothing in common. Zero except for rounding if the truth was made with this rig.
    """
    if truth.pose is None or truth.spots is None:
        return None
    shared = np.intersect1d(truth.pose.frame, truth.spots.frame)
    if not shared.size:
        return None
    frames = evenly_spread(shared, MAX_COMPARED_FRAMES)
    at = np.searchsorted(truth.pose.frame, frames)
    model = SpotModel.of(rig)
    pixels, _ = model.project(Pose.from_quaternion(truth.pose.quaternion_wxyz[at], truth.pose.position_m[at]))
    given: Array = np.full_like(pixels, np.nan)
    places = {view: i for i, view in enumerate(model.views)}
    spots = truth.spots
    views = zip(spots.camera.tolist(), spots.spot.tolist(), strict=True)
    place = np.array([places.get(view, -1) for view in views], dtype=np.int64)
    rows = np.flatnonzero((place >= 0) & np.isin(spots.frame, frames))
    given[np.searchsorted(frames, spots.frame[rows]), place[rows]] = spots.uv_px[rows]
    distance = np.linalg.norm(pixels - given, axis=-1)
    if not np.isfinite(distance).any():
        return None
    worst = np.nanargmax(distance)
    return float(distance.flat[worst]), int(frames[np.unravel_index(worst, distance.shape)[0]])
