"""Labelled spots at positions of a stand, from tables or run folders; frames at rest are averaged."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from calibration.beams.beams import StandModel
from calibration.terms.spot_term import SpotPixels
from geometry.arrays import Array, Ints
from geometry.pose import Pose
from geometry.rig import Rig
from lab.calibrate.beams.stationary_frames import SpotRows, average, positions_at_rest
from lab.errors import InputError
from lab.files.project.point_files import StandPoses, read_poses
from lab.files.project.project import Project, RecordingEntry
from lab.files.text.csv_table import Table
from lab.files.text.csv_text import read_table
from lab.files.text.error_text import printable_line, suggest_name
from lab.files.text.range_checks import SIGMA_RANGE_PX, check_pixels, check_sigmas

if TYPE_CHECKING:
    pass

SPOTS = ("camera", "spot", "u_px", "v_px")
DEFAULT_SPOT_SIGMA_PX = 0.1  # px, if the table states none: a laser spot on a matt screen, speckle included
MAX_UNKNOWN_POSES = 200  # positions without a pose that are used: each adds six unknowns, more add little information
_USED = ("matched", "turned")  # statuses in spots.csv that are measurements


@dataclass(frozen=True, slots=True)
class Recordings:
    """All recordings of a project: P positions of the stand."""

    names: tuple[str, ...]  # (P,) recording and frames, for messages
    spots: SpotPixels
    stand_from_body: Pose | None  # (P,); None if the poses are unknown
    pose_sigmas: Array  # (P, 6): m, rad
    notes: tuple[str, ...]  # assumptions made while reading


def stand_of(project: Project, recordings: Recordings) -> StandModel:
    """The stand model of recordings whose positions are known."""
    assert recordings.stand_from_body is not None
    stand = project.stand
    if stand is None or stand.world_from_stand is None:
        return StandModel(recordings.stand_from_body, recordings.pose_sigmas, None, None)
    covariance = np.diag([stand.sigma_m**2] * 3 + [stand.sigma_rad**2] * 3)
    return StandModel(recordings.stand_from_body, recordings.pose_sigmas, stand.world_from_stand.pose(), covariance)


def read_recordings(project: Project, rig: Rig) -> Recordings:
    """Read all recordings of a project. rig: calibrated cameras and screens with nominal beams and spots.

    Raises:
        InputError: with file, line, the expected and the found content.
    """
    if not project.recordings:
        raise InputError(
            f"{project.path}: recordings: expected spots at positions of the stand, got none; add"
            " recordings: [{spots: spots.csv, poses: poses.csv}] or [{run: RUN, poses: poses.csv}]"
        )
    with_poses = [r.poses is not None for r in project.recordings]
    if any(with_poses) and not all(with_poses):
        raise InputError(
            f"{project.path}: recordings.{with_poses.index(False)}.poses: expected poses for all recordings or for"
            " none; without poses only the angles between the beams can be found, so the two cannot be combined"
        )
    names: list[str] = []
    notes: list[str] = []
    spots: list[SpotPixels] = []
    poses: list[Pose] = []
    sigmas: list[Array] = []
    for recording in project.recordings:
        known = None if recording.poses is None else read_poses(recording.poses)
        rows = _rows(recording, known, project, rig, notes)
        if known is None:
            rows = limit_frames(rows, notes)
        frames = np.unique(rows.frame)
        if known is not None:
            at = np.searchsorted(known.frames, frames)
            recorded = known.stand_from_body[at]
            recorded_sigmas = _pose_sigmas(known, project)[at]
            position_of = positions_at_rest(recorded, recorded_sigmas)
            starts = np.unique(position_of, return_index=True)[1]
            poses.append(recorded[starts])
            sigmas.append(recorded_sigmas[starts])
        else:
            position_of = np.arange(len(frames))
        averaged = average(rows, position_of[np.searchsorted(frames, rows.frame)])
        spots.append(dataclasses.replace(averaged, position=averaged.position + len(names)))
        names += _names(recording, frames, position_of, len(project.recordings) > 1)
    joined = SpotPixels(*(np.concatenate([getattr(s, f) for s in spots]) for f in SpotPixels.__slots__))
    stand_from_body = None
    if poses:
        stand_from_body = Pose(
            np.concatenate([p.rotation for p in poses]), np.concatenate([p.translation for p in poses])
        )
    return Recordings(
        tuple(names),
        joined,
        stand_from_body,
        np.concatenate(sigmas) if sigmas else np.zeros((len(names), 6)),
        tuple(dict.fromkeys(notes)),
    )


def _rows(
    recording: RecordingEntry, known: StandPoses | None, project: Project, rig: Rig, notes: list[str]
) -> SpotRows:
    if recording.spots is not None:
        rows = read_spot_table(recording.spots, rig, notes)
        if known is not None:
            without = np.setdiff1d(rows.frame, known.frames)
            if len(without):
                raise InputError(
                    f"{recording.poses}: frame: expected a pose for each of {len(np.unique(rows.frame))} positions of"
                    f" {recording.spots.name}, got none for {without[0]}"
                    f"{f' and {len(without) - 1} more' if len(without) > 1 else ''}"
                )
        return rows
    from lab.calibrate.beams.recorded_runs import spots_of_run  # imports detection and tracking

    assert recording.run is not None
    stand = project.stand
    place = None if stand is None or stand.world_from_stand is None else stand.world_from_stand.pose()
    rows = spots_of_run(recording.run, rig, known, place)
    if not len(rows.frame):
        raise InputError(
            f"{recording.run}: expected spots near those of the nominal beams, found none; check target.beams, the"
            " stand's poses and the pictures"
        )
    return rows


def read_spot_table(path: Path, rig: Rig, notes: list[str]) -> SpotRows:
    """Read spots from a table `position,camera,spot,u_px,v_px[,sigma_px]` or from a run's spots.csv.

    Of a spots.csv (column `frame`) only matched spots are used. Assumptions are appended to `notes`.

    Raises:
        InputError: with file, line, the expected and the found content.
    """
    optional = ("position", "frame", "sigma_px", "sigma_u_px", "sigma_v_px", "cov_uv_px2", "status")
    table = read_table(path, SPOTS, optional)
    table.require_rows(("position", *SPOTS))
    key = "position" if "position" in table else "frame"
    if key not in table:
        raise InputError(
            f"{path}: expected a column 'position' (or 'frame'), got {printable_line(','.join(table.header))}"
        )
    table.whole(key)
    if "status" in table:
        table = table.select(np.isin(table.words["status"].tolist(), _USED))
        if not len(table):
            raise InputError(f"{path}: status: expected spots that are {' or '.join(_USED)}, got none")
    views = {view: i for i, view in enumerate(rig.views())}
    view = np.empty(len(table), dtype=np.int64)
    whole = table.whole(key)
    cameras, spots = table.words["camera"].tolist(), table.words["spot"].tolist()
    wanted = {"camera": "a calibrated camera", "spot": "a spot of the target"}
    for i, (camera, spot) in enumerate(zip(cameras, spots, strict=True)):
        for kind, name, names in (("camera", camera, rig.cameras), ("spot", spot, rig.spots)):
            if name not in names:
                raise table.error(i, f"{kind}: expected {wanted[kind]}, got {name!r}{suggest_name(name, names)}"[:200])
        if (camera, spot) not in views:
            raise table.error(
                i,
                f"camera {camera!r} observes screen {rig.cameras[camera].screen!r}, but spot {spot!r} is on"
                f" {rig.spots[spot].screen!r}; one of the two names is wrong",
            )
        view[i] = views[camera, spot]
    pixels = np.stack([table.finite(name) for name in ("u_px", "v_px")], axis=1)
    sizes = {name: c.image_size_px for name, c in rig.cameras.items()}
    check_pixels(table, sizes)
    pairs = np.stack([whole, view], axis=1)
    _, first, count = np.unique(pairs, axis=0, return_index=True, return_counts=True)
    if key == "frame" and np.any(count > 1):
        i = first[np.argmax(count > 1)]
        raise table.error(
            i,
            f"expected one row per frame, camera and spot, got spot {spots[i]!r} in frame {whole[i]} more than once",
        )
    return SpotRows(whole, view, pixels, _covariances(table, notes))


def _covariances(table: Table, notes: list[str]) -> Array:
    """(n, 2, 2), px^2, from whichever columns there are."""
    out = np.zeros((len(table), 2, 2))
    columns = ("sigma_u_px", "sigma_v_px") if "sigma_u_px" in table and "sigma_v_px" in table else ("sigma_px",) * 2
    for k, name in enumerate(columns):
        if name not in table:
            if k == 0:
                notes.append(f"{table.path.name}: no column sigma_px: {DEFAULT_SPOT_SIGMA_PX:g} px is assumed")
            out[:, k, k] = DEFAULT_SPOT_SIGMA_PX**2
            continue
        given = table.finite(name, "a number above 0", may_be_empty=True)
        check_sigmas(table, name, SIGMA_RANGE_PX, "px")
        out[:, k, k] = np.where(np.isnan(given), DEFAULT_SPOT_SIGMA_PX, given) ** 2
        if k == 0 and np.isnan(given).any():
            notes.append(
                f"{table.path.name}: {int(np.isnan(given).sum())} spots without a sigma: {DEFAULT_SPOT_SIGMA_PX:g} px"
                " is assumed"
            )
    if "cov_uv_px2" in table and columns[0] != columns[1]:
        cov = np.nan_to_num(table.finite("cov_uv_px2", may_be_empty=True))
        bound = 0.99 * np.sqrt(out[:, 0, 0] * out[:, 1, 1])
        out[:, 0, 1] = out[:, 1, 0] = np.clip(cov, -bound, bound)
    return out


def _pose_sigmas(known: StandPoses, project: Project) -> Array:
    """Sigmas (n, 6), m and rad, of the recorded poses: from the table, else from the stand, else 0."""
    stand = project.stand
    default = [0.0] * 6 if stand is None else [stand.pose_sigma_m] * 3 + [stand.pose_sigma_rad] * 3
    return np.where(np.isnan(known.sigmas), np.array(default), known.sigmas)


def limit_frames(rows: SpotRows, notes: list[str]) -> SpotRows:
    """The rows of at most MAX_UNKNOWN_POSES evenly spaced frames."""
    frames = np.unique(rows.frame)
    if len(frames) <= MAX_UNKNOWN_POSES:
        return rows
    notes.append(f"{MAX_UNKNOWN_POSES} of {len(frames)} frames without a pose were used, evenly spaced")
    used = np.isin(rows.frame, frames[np.linspace(0, len(frames) - 1, MAX_UNKNOWN_POSES).round().astype(np.int64)])
    return SpotRows(rows.frame[used], rows.view[used], rows.pixels[used], rows.covariance[used])


def _names(recording: RecordingEntry, frames: Ints, position_of: Ints, several: bool) -> list[str]:
    """Names of the positions: the frames, preceded by the recording's name if the project has several recordings."""
    label = ""
    if several:
        path = recording.run or recording.spots
        assert path is not None
        label = f"{path.name if recording.run else path.stem} "
    out = []
    for k in range(int(position_of[-1]) + 1):
        here = frames[position_of == k]
        out.append(f"{label}{here[0]}" + (f"-{here[-1]}" if len(here) > 1 else ""))
    return out
