"""Reads a results folder: summary.json, its tables as arrays by frame and view, and the run that it is of."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import numpy as np

from geometry.arrays import Array, Bools, Ints, true_ranges
from geometry.pose import Pose
from lab.errors import InputError
from lab.files.run.run_file import Run, load_run
from lab.files.text import columns
from lab.files.text.columns import CAUSAL
from lab.files.text.csv_text import MAX_TIME_S, Categorical, Table, read_table
from lab.files.text.error_text import name_of_path
from lab.files.text.json_text import has_schema, read_json
from tracking.statuses import PoseStatus, SpotStatus

SPOT_STATUSES = tuple(SpotStatus)
POSE_STATUSES = tuple(PoseStatus)
REFINED = "refined"  # block of summary.json: the rig was refined by the run before it was processed
ABSENT = -1  # the status code where the file has no row
SUMMARY_SCHEMA = "beampose/summary/1"  # of a run's summary.json


@dataclass(slots=True)
class ListedEvent:
    """An event as summary.json lists it; one that continues in the next frames has a later last frame."""

    frame: int
    last_frame: int | None = None
    kind: str = "noted"
    camera: str | None = None  # None: of the whole rig
    spot: str | None = None
    text: str = ""


def read_result_table(path: Path, names: Iterable[str]) -> Table:
    """The named columns of a table of results; those beyond the contract are nan where the file does not have them.

    Raises InputError where it is not as a run writes it.
    """
    names = tuple(names)
    table = read_table(path, [n for n in names if n not in columns.ADDED], [n for n in names if n in columns.ADDED])
    damaged = [*table.long_lines, *table.short_lines, *(line for of in table.texts.values() for line in of)]
    if damaged:
        raise InputError(
            f"{path}: line {min(damaged)}: expected {len(table.header)} fields as in the header, and numbers in number"
            " columns; process the run again"
        )
    _check_frames(table)
    return table


def _check_frames(table: Table) -> None:
    """Raises InputError at a frame that is no whole number or less than the one before, and at a time out of range.

    In detections.csv with the pictures' times the numbers are those of each camera's own pictures.
    """
    if "frame" in table.numbers:
        frames = table.whole("frame")
        rows = [np.arange(len(frames))]
        if "camera" in table.words and columns.PICTURE_TIME in table.header and "spot" not in table.header:
            camera = np.array(table.words["camera"].tolist())
            rows = [np.flatnonzero(camera == name) for name in np.unique(camera)]
        for of_camera in rows:
            for i in np.flatnonzero(np.diff(frames[of_camera]) < 0)[:1]:
                before, at = of_camera[i : i + 2]
                mistake = (
                    f"frame: expected frames in rising order, got {table.found('frame', at)} after"
                    f" {table.found('frame', before)}; process the run again"
                )
                raise table.error(at, mistake)
    if "t_s" in table.numbers:
        for i in np.flatnonzero(np.abs(table.numbers["t_s"]) > MAX_TIME_S)[:1]:
            raise table.error(i, f"t_s: expected seconds, got {table.found('t_s', i)}; process the run again")


@dataclass(frozen=True, slots=True)
class SpotGrid:
    """spots.csv by frame and view: F frame numbers, V views."""

    frames: Ints  # (F,), rising
    t_s: Array  # (F,)
    views: tuple[tuple[str, str], ...]  # (V,) camera, spot
    uv_px: Array  # (F, V, 2), distorted pixels; nan where nothing is known
    sigma_px: Array  # (F, V, 2)
    predicted_px: Array  # (F, V, 2), predicted before the detection
    label_probability: Array  # (F, V) probability that the label is right; nan without a label, or where not stated
    status: Ints  # (F, V) index into SPOT_STATUSES, or ABSENT
    cov_uv_px2: Array  # (F, V)

    @property
    def measured(self) -> Bools:
        """(F, V): the position comes from a detection."""
        return self.has(SpotStatus.MATCHED, SpotStatus.TURNED)

    def has(self, *statuses: SpotStatus) -> Bools:
        """(F, V): whether the status is one of these."""
        return np.isin(self.status, [SPOT_STATUSES.index(s) for s in statuses])

    @property
    def cameras(self) -> tuple[str, ...]:
        """The cameras, in order of first appearance in the file."""
        return tuple(dict.fromkeys(camera for camera, _ in self.views))

    def views_of(self, camera: str) -> list[int]:
        """Indices of the views of a camera."""
        return [j for j, (c, _) in enumerate(self.views) if c == camera]

    def without_picture(self, camera: str) -> list[tuple[int, int]]:
        """First index and one past the last index of each run of frames without a usable picture of a camera."""
        return true_ranges(np.any(self.has(SpotStatus.NO_IMAGE)[:, self.views_of(camera)], axis=1))


@dataclass(frozen=True, slots=True)
class PoseTrack:
    """attitude.csv, covariance.csv and systematic.csv by frame: F frames."""

    frames: Ints  # (F,), rising
    t_s: Array  # (F,)
    world_from_body: Pose  # (F,); identity and nan translation where lost
    yaw_pitch_roll_deg: Array  # (F, 3)
    sigma_position_m: Array  # (F, 3)
    sigma_ypr_deg: Array  # (F, 3)
    spots_used: Array  # (F,)
    rms_px: Array  # (F,)
    status: Ints  # (F,) index into POSE_STATUSES, or ABSENT
    covariance: Array  # (F, 6, 6), of [dt (m, world), dtheta (rad, body)]; nan where the file has none
    systematic: Array  # (F, 6, 6), the calibration's share of it; nan where there is none
    velocity_m_s: Array  # (F, 3), of the body origin, in world; nan where unknown
    rate_rad_s: Array  # (F, 3), about the body's axes
    sigma_velocity_m_s: Array  # (F, 3)
    sigma_rate_rad_s: Array  # (F, 3)

    def has(self, status: PoseStatus) -> Bools:
        """(F,): whether the pose has this status."""
        return np.equal(self.status, POSE_STATUSES.index(status))

    @property
    def known(self) -> Bools:
        """(F,): whether there is a pose."""
        return np.all(np.isfinite(self.world_from_body.translation), axis=-1)


def on_grid(
    frame: Array | Ints, camera: Categorical, spot: Categorical, views: tuple[tuple[str, str], ...], frames: Ints
) -> tuple[Ints, Ints, Ints]:
    """Row numbers of a long table and their places on a grid: rows (k,), frame index (k,), view index (k,).

    Rows of other frames or views are left out.
    """
    cameras = tuple(dict.fromkeys(c for c, _ in views))
    spots = tuple(dict.fromkeys(s for _, s in views))
    place = np.full((len(cameras) + 1, len(spots) + 1), -1, dtype=np.int64)
    for i, (c, s) in enumerate(views):
        place[cameras.index(c), spots.index(s)] = i
    view = place[camera.recoded(cameras), spot.recoded(spots)]
    at = np.searchsorted(frames, frame)
    inside = at < len(frames)
    here = inside & (frames[np.where(inside, at, 0)] == frame) if len(frames) else inside
    rows = np.flatnonzero(here & (view >= 0))
    return rows, at[rows], view[rows]


def read_spots(results: Path) -> SpotGrid:
    """spots.csv of a results folder. Raises InputError."""
    table = read_result_table(results / "spots.csv", columns.SPOTS)
    frame, camera, spot = table.numbers["frame"], table.words["camera"], table.words["spot"]
    frames = np.unique(frame).astype(np.int64)
    pairs = np.unique(np.stack([camera.codes, spot.codes], -1), axis=0) if len(table) else np.zeros((0, 2), np.int64)
    views = tuple((camera.words[c], spot.words[s]) for c, s in pairs)
    rows, i, j = on_grid(frame, camera, spot, views, frames)

    def grid(*names: str) -> Array:
        out = np.full((len(frames), len(views), len(names)), np.nan)
        out[i, j] = table.stack(*names)[rows]
        return out

    status = np.full((len(frames), len(views)), ABSENT, dtype=np.int64)
    status[i, j] = table.words["status"].recoded(SPOT_STATUSES)[rows]
    t_s = np.full(len(frames), np.nan)
    t_s[i] = table.numbers["t_s"][rows]
    return SpotGrid(
        frames=frames,
        t_s=t_s,
        views=views,
        uv_px=grid("u_px", "v_px"),
        sigma_px=grid("sigma_u_px", "sigma_v_px"),
        predicted_px=grid("predicted_u_px", "predicted_v_px"),
        label_probability=grid("label_probability")[..., 0],
        status=status,
        cov_uv_px2=grid("cov_uv_px2")[..., 0],
    )


def pose_stack(position_m: Array, quaternion_wxyz: Array) -> Pose:
    """A stack of poses (n,) from (n, 3) m and (n, 4); nan translation, identity rotation where a number is missing."""
    known = np.all(np.isfinite(position_m), axis=-1) & np.all(np.isfinite(quaternion_wxyz), axis=-1)
    quaternion = np.where(known[:, None], quaternion_wxyz, [1.0, 0.0, 0.0, 0.0])
    return Pose.from_quaternion(quaternion, np.where(known[:, None], position_m, np.nan))


def read_poses(results: Path, causal: bool = False) -> PoseTrack:
    """attitude.csv of a results folder, with covariance.csv and systematic.csv where they exist.

    causal: attitude_causal.csv and covariance_causal.csv (the filter's poses, not smoothed) instead.
    """
    which = CAUSAL if causal else ""
    table = read_result_table(results / f"attitude{which}.csv", columns.ATTITUDE)
    frames = table.numbers["frame"].astype(np.int64)
    return PoseTrack(
        frames=frames,
        t_s=table.numbers["t_s"],
        world_from_body=pose_stack(table.stack("x_m", "y_m", "z_m"), table.stack("qw", "qx", "qy", "qz")),
        yaw_pitch_roll_deg=table.stack("yaw_deg", "pitch_deg", "roll_deg"),
        sigma_position_m=table.stack("sigma_x_m", "sigma_y_m", "sigma_z_m"),
        sigma_ypr_deg=table.stack("sigma_yaw_deg", "sigma_pitch_deg", "sigma_roll_deg"),
        spots_used=table.numbers["spots_used"],
        rms_px=table.numbers["rms_px"],
        status=table.words["status"].recoded(POSE_STATUSES),
        covariance=_read_covariance(results / f"covariance{which}.csv", frames),
        systematic=_read_covariance(results / "systematic.csv", frames),
        velocity_m_s=table.stack(*columns.MOTION[0:3]),
        rate_rad_s=table.stack(*columns.MOTION[3:6]),
        sigma_velocity_m_s=table.stack(*columns.MOTION[6:9]),
        sigma_rate_rad_s=table.stack(*columns.MOTION[9:12]),
    )


def _read_covariance(path: Path, frames: Ints) -> Array:
    out = np.full((len(frames), 6, 6), np.nan)
    if not path.exists() or not len(frames):
        return out
    table = read_result_table(path, columns.COVARIANCE)
    at = np.searchsorted(frames, table.numbers["frame"])
    here = (at < len(frames)) & (frames[np.minimum(at, len(frames) - 1)] == table.numbers["frame"])
    for name in columns.COVARIANCE[1:]:
        i, j = int(name[1]), int(name[2])
        out[at[here], i, j] = out[at[here], j, i] = table.numbers[name][here]
    return out


def read_summary(results: Path) -> dict[str, Any]:
    """summary.json of a results folder; an empty mapping where there is none. Raises InputError."""
    path = results / "summary.json"
    if not path.exists():
        return {}
    try:
        summary = read_json(path)
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: expected a JSON object ({error})") from error
    if not isinstance(summary, dict):
        raise InputError(f"{path}: expected a JSON object, found {type(summary).__name__}")
    return summary


def are_results(folder: Path) -> bool:
    """Whether `beampose run` wrote this folder; a new run may then replace it."""
    return has_schema(folder, SUMMARY_SCHEMA)


class ResultFolder:
    """A folder of results, and the run that it is of.

    Files are read when they are first used; a missing or damaged one raises InputError.
    """

    def __init__(self, folder: Path | str, run_folder: Path | str | None = None) -> None:
        """run_folder: where the run is now; None: where summary.json names it."""
        self.folder = Path(folder)
        self._given = None if run_folder is None else Path(run_folder)

    @classmethod
    def of_run(cls, folder: Path | str, run_folder: Path | str | None = None) -> Self:
        """A folder that `beampose run` wrote."""
        if not are_results(Path(folder)):
            raise InputError(f"{folder}: expected a folder that `beampose run` wrote, found no summary.json of one")
        return cls(folder, run_folder)

    @cached_property
    def summary(self) -> dict[str, Any]:
        """summary.json: verdict, counts, parameters, versions, fingerprints; empty where there is none."""
        return read_summary(self.folder)

    @property
    def name(self) -> str:
        """The name of the run."""
        return str(self.summary.get("name") or name_of_path(self.folder))

    @cached_property
    def spots(self) -> SpotGrid:
        """spots.csv."""
        return read_spots(self.folder)

    @cached_property
    def poses(self) -> PoseTrack:
        """attitude.csv with its covariances."""
        return read_poses(self.folder)

    @cached_property
    def causal(self) -> PoseTrack | None:
        """attitude_causal.csv, the poses as known at each instant; None where the results are not smoothed."""
        return read_poses(self.folder, causal=True) if (self.folder / f"attitude{CAUSAL}.csv").is_file() else None

    @property
    def run_folder(self) -> Path | None:
        """The run folder, given or named by summary.json (from here or the results); None where it is not there."""
        named = self._named
        places = [Path(named), self.folder / named] if self._given is None else [self._given]
        return next((place for place in places if named and place.is_dir()), None)

    @property
    def _named(self) -> str:
        return str(self._given or self.summary.get("run_folder") or "")

    def run(self, remedy: str = "name it with --run") -> Run:
        """The run. remedy: where its folder is not there."""
        if self.run_folder is None:
            raise InputError(f"{self.folder}: its run folder {self._named} is not there; {remedy}")
        return load_run(self.run_folder, self._refined_rig)

    @property
    def _refined_rig(self) -> Path | None:
        """The rig of the results of `run --refined`; None: that of the run. Raises InputError: it is not there."""
        if not self.summary.get(REFINED):
            return None
        path = Path(str(self.summary.get("rig")))
        if not path.is_file():
            raise InputError(f"{path}: expected the refined rig of these results, found none; process the run again")
        return path
