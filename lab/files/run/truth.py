"""What really happened, where a run folder says so: truth/pose.csv and truth/spots.csv, checked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from geometry.arrays import Array, Ints
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.rig import Rig
from lab.errors import InputError
from lab.files.rig.rig_file import QUATERNION_TOLERANCE
from lab.files.text import columns
from lab.files.text.csv_text import found_at, numbers_in, read_table, whole_numbers
from lab.files.text.yaml_text import did_you_mean

if TYPE_CHECKING:
    import pandas as pd

COMPARED = 500  # frames at most that `largest_disagreement_px` looks at, spread evenly: enough to show a wrong rig


@dataclass(frozen=True, slots=True)
class TruthTables:
    """The tables of a truth folder, columns as in lab/files/text/columns.py; one of them may be missing."""

    pose: pd.DataFrame | None  # TRUTH_POSE, rising frames, every field a number
    spots: pd.DataFrame | None  # TRUTH_SPOTS; u_px, v_px are nan where no projection exists


def load_truth(run_folder: Path, rig: Rig | None = None) -> TruthTables | None:
    """The truth of a run folder; None where it has none. With a rig, names that it does not have are mistakes.

    Raises InputError in one line: file, line, column, what was expected and what was found.
    """
    folder = Path(run_folder) / "truth"
    pose, spots = folder / "pose.csv", folder / "spots.csv"
    if not pose.exists() and not spots.exists():
        return None
    return TruthTables(
        load_pose_table(pose) if pose.exists() else None, _load_spots(spots, rig) if spots.exists() else None
    )


def load_pose_table(path: Path) -> pd.DataFrame:
    """A table of poses, columns TRUTH_POSE. Raises InputError in one line."""
    table = read_table(path, columns.TRUTH_POSE)
    frames = whole_numbers(table, "frame", path)
    _refuse(path, np.diff(frames, prepend=frames[:1] - 1) <= 0, "frame: expected rising numbers", frames)
    for name in columns.TRUTH_POSE[1:]:
        numbers_in(table, name, path)
    refuse_other_lengths(path, range(2, len(table) + 2), table[["qw", "qx", "qy", "qz"]].to_numpy())
    return table.assign(frame=frames)


def refuse_other_lengths(path: Path, lines: Sequence[int], quaternions: Array) -> None:
    """Raises InputError at the first of the quaternions (n, 4) whose length is not 1."""
    length = np.linalg.norm(quaternions, axis=1)
    bad = np.flatnonzero(~(np.abs(length - 1) <= QUATERNION_TOLERANCE))
    if bad.size:
        found = length[bad[0]]
        remedy = "give all digits, or divide each of the four numbers by that length"
        if found == 0:
            remedy = "where nothing is turned it is 1,0,0,0"
        raise InputError(
            f"{path}: line {lines[bad[0]]}: qw,qx,qy,qz: expected a quaternion of length 1, got one of length"
            f" {found:.7g}; {remedy}"
        )


def _load_spots(path: Path, rig: Rig | None) -> pd.DataFrame:
    table = read_table(path, columns.TRUTH_SPOTS)
    frames = whole_numbers(table, "frame", path)
    in_view = table["in_view"].to_numpy()
    for i in np.flatnonzero(~np.isin(in_view, (0, 1, 2)))[:1]:
        raise InputError(f"{path}: line {i + 2}: in_view: expected 0, 1 or 2, got {found_at(table, 'in_view', i)}")
    for name in ("u_px", "v_px"):
        for i in np.flatnonzero(~np.isfinite(table[name].to_numpy()) & (in_view > 0))[:1]:
            raise InputError(
                f"{path}: line {i + 2}: {name}: expected a number where in_view is 1 or 2, got"
                f" {found_at(table, name, i)}"
            )
    if rig is not None:
        for name, known in (("camera", rig.cameras), ("spot", rig.spots)):
            for word in table[name].unique():
                if word not in known:
                    raise InputError(
                        f"{path}: {name}: expected a {name} of the rig, got {word!r}{did_you_mean(word, known)}"
                    )
    twice = table.duplicated(["frame", "camera", "spot"]).to_numpy()
    _refuse(path, twice, "expected one row per frame, camera and spot, a second one for frame", frames)
    return table.assign(frame=frames, in_view=in_view.astype(np.int64))


def _refuse(path: Path, wrong: np.ndarray, expected: str, found: np.ndarray) -> None:
    """Raises InputError for the first row that is wrong."""
    bad = np.flatnonzero(wrong)
    if bad.size:
        raise InputError(f"{path}: line {bad[0] + 2}: {expected}, got {found[bad[0]]}")


def largest_disagreement_px(truth: TruthTables, rig: Rig) -> tuple[float, int] | None:
    """How far, px, the true spots lie from where the true poses put them through the rig, and in which frame.

    None where the two tables share nothing. Zero but for rounding if the truth was made with this rig.
    """
    if truth.pose is None or truth.spots is None:
        return None
    shared = np.intersect1d(truth.pose["frame"], truth.spots["frame"])
    if not shared.size:
        return None
    frames: Ints = shared[np.unique(np.linspace(0, len(shared) - 1, COMPARED).astype(np.int64))]
    poses = truth.pose.set_index("frame").loc[frames]
    model = SpotModel.of(rig)
    pixels, _ = model.project(
        Pose.from_quaternion(
            poses[["qw", "qx", "qy", "qz"]].to_numpy(dtype=float), poses[["x_m", "y_m", "z_m"]].to_numpy(dtype=float)
        )
    )
    given: Array = np.full_like(pixels, np.nan)
    places = {view: i for i, view in enumerate(model.views)}
    rows = truth.spots[truth.spots["frame"].isin(frames)]
    at = [places.get(view, -1) for view in zip(rows["camera"], rows["spot"], strict=True)]
    known = np.array(at) >= 0
    frame_at = np.searchsorted(frames, rows["frame"].to_numpy())
    given[frame_at[known], np.array(at)[known]] = rows[["u_px", "v_px"]].to_numpy()[known]
    distance = np.linalg.norm(pixels - given, axis=-1)
    if not np.isfinite(distance).any():
        return None
    worst = np.nanargmax(distance)
    return float(distance.flat[worst]), int(frames[np.unravel_index(worst, distance.shape)[0]])
