"""The tables of a results folder and the run behind them, as the annotated pictures need them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from geometry.arrays import Array, Ints
from geometry.forward_model import SpotModel
from geometry.uncertainty.spot_tracks import unlimited
from lab.errors import BeamposeError, InputError
from lab.files.run.results import PoseTrack, SpotGrid, read_poses, read_result_table, read_spots, read_summary
from lab.files.run.run_file import Run, load_run
from lab.files.text.error_text import name_of_path

MOST_OUTSIDE_PX = 50.0  # margin around the measured places where the size of a picture is unknown


@dataclass(frozen=True, slots=True)
class CameraTable:
    """The detections of one camera in a run, by frame."""

    frames: Ints  # (n,) rising
    uv_px: Array  # (n, 2)

    def at(self, frame: int) -> Array:
        """(k, 2): the detections of a frame."""
        a, b = np.searchsorted(self.frames, [frame, frame + 1])
        return self.uv_px[a:b]


@dataclass(frozen=True, slots=True)
class ResultData:
    """A results folder, and its run where the run folder can be read."""

    name: str
    spots: SpotGrid
    poses: PoseTrack  # of the same frames as the spots
    run: Run | None
    model: SpotModel | None  # the views in the order of `spots`, on screens without an edge; None without a run
    sizes_px: Mapping[str, tuple[int, int]]  # width and height of each camera's picture
    detections: Mapping[str, CameraTable]  # empty where the results have no detections.csv
    notes: tuple[str, ...]  # what is missing and why

    def index_of(self, frame: int) -> int:
        """Index of a frame. Raises InputError where the results do not have it."""
        frames = self.spots.frames
        at = int(np.searchsorted(frames, frame))
        if at >= len(frames) or frames[at] != frame:
            raise InputError(f"--frame {frame}: expected a frame of the results, {frames[0]} to {frames[-1]}")
        return at

    def views_of(self, camera: str) -> list[int]:
        """Indices of the views of a camera."""
        return [j for j, (c, _) in enumerate(self.spots.views) if c == camera]


def read_result_data(results: Path, run_folder: Path | None = None) -> ResultData:
    """Read a results folder and what is there of its run folder (the one given, or the one that summary.json names).

    Raises:
        InputError: the results cannot be read, or the given run folder is not theirs.
    """
    spots, poses = read_spots(results), read_poses(results)
    if not len(spots.frames) or not spots.views:
        raise InputError(
            f"{results / 'spots.csv'}: expected rows of at least one frame, got none; process the run again"
        )
    if not np.array_equal(spots.frames, poses.frames):
        raise InputError(f"{results}: spots.csv and attitude.csv have different frames; process the run again")
    summary = read_summary(results)
    run, notes = _run_of(results, run_folder, str(summary.get("run_folder") or ""))
    model = None
    if run is not None:
        whole = SpotModel.of(run.rig)
        place = {view: i for i, view in enumerate(whole.views)}
        unknown = [view for view in spots.views if view not in place]
        if unknown and run_folder is not None:
            raise InputError(
                f"{run.rig_path}: expected the cameras and spots of {results}, but it has no spot {unknown[0][1]!r} of"
                f" camera {unknown[0][0]!r}; name the run folder of these results"
            )
        if unknown:
            notes = (f"the rig of {run.folder} has other spots than the results: no pictures and no beam tracks",)
            run = None
        else:
            model = unlimited(whole.subset(np.array([place[view] for view in spots.views], dtype=np.int64)))
    return ResultData(
        name=str(summary.get("name") or name_of_path(results)),
        spots=spots,
        poses=poses,
        run=run,
        model=model,
        sizes_px=_sizes(spots, run),
        detections=_detections(results / "detections.csv"),
        notes=notes,
    )


def _run_of(results: Path, given: Path | None, named: str) -> tuple[Run | None, tuple[str, ...]]:
    """The run of results and, where it cannot be read, why. Raises InputError for a given folder that is no run."""
    if given is not None:
        return load_run(given), ()
    folder = next((p for p in (Path(named), results / named) if named and p.is_dir()), None)
    if folder is None:
        return None, ("the run folder is not there: no pictures and no beam tracks; name it with --run",)
    try:
        return load_run(folder), ()
    except BeamposeError as error:
        return None, (f"no pictures and no beam tracks: {error}",)


def _sizes(spots: SpotGrid, run: Run | None) -> dict[str, tuple[int, int]]:
    """The pictures' sizes; without a run from the places of measured spots."""
    if run is not None:
        return {name: run.rig.cameras[name].image_size_px for name in spots.cameras}
    out = {}
    for name in spots.cameras:
        mine = [j for j, (c, _) in enumerate(spots.views) if c == name]
        places = spots.uv_px[:, mine][spots.measured[:, mine]]
        far = np.ceil(places.max(axis=0) + MOST_OUTSIDE_PX) if len(places) else np.array([640.0, 480.0])
        out[name] = (int(far[0]), int(far[1]))
    return out


def _detections(path: Path) -> dict[str, CameraTable]:
    if not path.is_file():
        return {}
    table = read_result_table(path, ("frame", "camera", "u_px", "v_px"))
    frame, camera, uv = table.whole("frame"), table.words["camera"], table.stack("u_px", "v_px")
    out = {}
    for code, name in enumerate(camera.words):
        rows = np.flatnonzero(camera.codes == code)
        rows = rows[np.argsort(frame[rows], kind="stable")]
        out[name] = CameraTable(frame[rows], uv[rows])
    return out
