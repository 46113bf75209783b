"""Runs processed from Python, and a results folder as an object: tables as pandas frames, poses, annotated pictures."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from geometry.arrays import Array, Bools, Ints
from geometry.pose_prior import PosePrior
from geometry.rig import Rig
from lab.errors import InputError
from lab.files.run.results import ResultFolder, read_result_table
from lab.files.run.run_file import Run
from lab.files.text import columns
from lab.files.text.csv_text import Categorical, Table
from lab.files.text.dataclass_fields import with_overrides
from lab.progress import Progress
from lab.report.frames.canvas import Pixels, png
from lab.report.run.report_data import pose_residuals
from lab.results.show import show_frame, write_picture
from lab.runs.process import process_run
from lab.simulate.scenarios import SCENARIOS
from tracking.parameters import TrackerParameters
from tracking.statuses import PoseStatus

_EVENT_COLUMNS = ("frame", "last_frame", "kind", "camera", "spot", "text")


@dataclass(frozen=True, slots=True)
class AnnotatedPicture:
    """A picture of one frame; a notebook displays it, `plt.imshow(picture.pixels)` does too."""

    pixels: Pixels  # (h, w, 3), 8 bit: red, green, blue

    def save(self, path: Path | str) -> Path:
        """Write a .png file; returns its path. Raises InputError."""
        write_picture(np.ascontiguousarray(self.pixels[..., ::-1]), Path(path))
        return Path(path)

    def _repr_png_(self) -> bytes:
        return png(np.ascontiguousarray(self.pixels[..., ::-1]))


class Results:
    """The results of one run. Tables are read when they are first used.

    >>> run = lab.load(results)
    >>> run.attitude[["frame", "t_s", "yaw_deg", "sigma_yaw_deg"]].shape
    (40, 4)
    >>> run.rotations.shape, run.covariance.shape
    ((40, 3, 3), (40, 6, 6))
    >>> bool(run.known.all())
    True
    """

    def __init__(
        self,
        folder: Path,
        run_folder: Path | None = None,
        keep: tempfile.TemporaryDirectory[str] | None = None,
    ) -> None:
        """keep: a temporary folder that lasts as long as this object."""
        self.folder = folder
        self._given = run_folder
        self._read = ResultFolder(folder, run_folder)
        self._keep = keep

    def __repr__(self) -> str:
        status = self.summary.get("verdict", {}).get("status", "no verdict")
        return f"<Results of {self.name}: {status}, {len(self.frames)} frames, {self.folder}>"

    @property
    def summary(self) -> dict[str, Any]:
        """summary.json: verdict, counts, parameters, versions, fingerprints."""
        return self._read.summary

    @property
    def name(self) -> str:
        """The name of the run."""
        return self._read.name

    @cached_property
    def attitude(self) -> pd.DataFrame:
        """attitude.csv: a row per frame with position, quaternion, angles, their sigmas, velocities and status."""
        return read_frame(self.folder / "attitude.csv", columns.ATTITUDE)

    @cached_property
    def attitude_causal(self) -> pd.DataFrame | None:
        """attitude_causal.csv, the poses as known at each instant; None where the results are not smoothed."""
        path = self.folder / f"attitude{columns.CAUSAL}.csv"
        return read_frame(path, columns.ATTITUDE) if path.is_file() else None

    @cached_property
    def spots(self) -> pd.DataFrame:
        """spots.csv: a row per frame, camera and spot with place (px), sigma, status and prediction."""
        return read_frame(self.folder / "spots.csv", columns.SPOTS)

    @cached_property
    def detections(self) -> pd.DataFrame:
        """detections.csv: a row per detected point of light."""
        return read_frame(self.folder / "detections.csv", columns.DETECTIONS)

    @cached_property
    def beams(self) -> pd.DataFrame:
        """beams.csv: direction and a point, in world, of each beam in each frame."""
        return read_frame(self.folder / "beams.csv", columns.BEAMS)

    @cached_property
    def events(self) -> pd.DataFrame:
        """What the run noted: frame, last_frame, kind, camera, spot (None: of the whole rig) and text."""
        listed = self.summary.get("events", [])
        rows = [{name: e.get(name) for name in _EVENT_COLUMNS} for e in listed if isinstance(e, dict)]
        return pd.DataFrame(rows, columns=list(_EVENT_COLUMNS))

    @property
    def frames(self) -> Ints:
        """Frame numbers (n,); all arrays below have a row for each."""
        return self._read.poses.frames

    @property
    def time_s(self) -> Array:
        """(n,), s since frame 0, at mid-exposure."""
        return self._read.poses.t_s

    @property
    def known(self) -> Bools:
        """(n,): whether there is a pose."""
        return self._read.poses.known

    @property
    def measured(self) -> Bools:
        """(n,): whether the pose is measured from the spots of the frame."""
        return self._read.poses.has(PoseStatus.MEASURED)

    @property
    def positions(self) -> Array:
        """(n, 3), m: the body's origin in world; nan where unknown."""
        return self._read.poses.world_from_body.translation

    @property
    def rotations(self) -> Array:
        """(n, 3, 3), world from body; nan where unknown."""
        return np.where(self.known[:, None, None], self._read.poses.world_from_body.rotation, np.nan)

    @property
    def covariance(self) -> Array:
        """(n, 6, 6) of the pose error [dt (m, in world), dtheta (rad, in body)]; nan where unknown."""
        return self._read.poses.covariance

    @property
    def systematic(self) -> Array:
        """(n, 6, 6), the calibration's share of the covariance, equal in all frames; nan where it is unknown."""
        return self._read.poses.systematic

    @cached_property
    def _run(self) -> Run:
        return self._read.run("name it: lab.load(folder, run=...)")

    @property
    def rig(self) -> Rig:
        """The rig of the run folder. Raises InputError where the run folder is not there."""
        return self._run.rig

    @property
    def prior(self) -> PosePrior | None:
        """The prior of the run folder's run.yaml. Raises InputError where the run folder is not there."""
        return self._run.prior

    @property
    def run_folder(self) -> Path:
        """The run folder that was processed. Raises InputError where it is not there."""
        return self._run.folder

    @cached_property
    def residuals(self) -> pd.DataFrame:
        """Measured minus projected place (px) of each measured spot: frame, t_s, camera, spot, du_px, dv_px.

        Projected from the pose of the frame, where that is measured; nan for cameras with clocks of their own. Raises
        InputError where the run folder is not there.
        """
        spots = self._read.spots
        residual = pose_residuals(spots, self._read.poses, self._run)[0]
        if residual is None:
            raise InputError(f"{self.run_folder}: expected the cameras and spots of {self.folder}, found another rig")
        frame, view = np.nonzero(spots.measured & self._read.poses.has(PoseStatus.MEASURED)[:, None])
        names = {"camera": [camera for camera, _ in spots.views], "spot": [spot for _, spot in spots.views]}
        return pd.DataFrame(
            {
                "frame": spots.frames[frame],
                "t_s": spots.t_s[frame],
                **{name: pd.Categorical(np.array(of, dtype=str)[view]) for name, of in names.items()},
                "du_px": residual[frame, view, 0],
                "dv_px": residual[frame, view, 1],
            }
        )

    def show(self, frame: int, camera: str | None = None) -> AnnotatedPicture:
        """The pictures of a frame with detections, labels, predictions and beams, as of the command `show`.

        Raises:
            InputError: there is no such frame or camera.
        """
        image = show_frame(self.folder, frame, camera=camera, run_folder=self._given).image
        return AnnotatedPicture(np.ascontiguousarray(image[..., ::-1]))


def load(folder: Path | str, *, run: Path | str | None = None) -> Results:
    """The results that `beampose run` wrote into a folder. run: its run folder, if that has moved.

    >>> lab.load(results).spots.columns[:4].tolist()
    ['frame', 't_s', 'camera', 'spot']
    >>> lab.load("nowhere")
    Traceback (most recent call last):
    lab.errors.InputError: nowhere: expected a folder that `beampose run` wrote, found no summary.json of one

    Raises:
        InputError: the folder holds no results. (A damaged table raises it when it is first used.)
    """
    return Results(ResultFolder.of_run(folder).folder, None if run is None else Path(run))


# Tables of results as pandas frames, with the names of the CSV files, which contain the units.


def read_frame(path: Path, names: Iterable[str]) -> pd.DataFrame:
    """A CSV file of results: numbers are float64, frame numbers int64, names and statuses categories.

    Raises InputError.
    """
    return frame_of(read_result_table(path, names), names)


def frame_of(table: Table, names: Iterable[str]) -> pd.DataFrame:
    """The named columns of a table."""
    return pd.DataFrame({name: _column(table, name) for name in names})


def _column(table: Table, name: str) -> object:
    if name in table.words:
        return category(table.words[name])
    values = table.numbers[name]
    return values.astype(np.int64) if name in columns.WHOLE and np.isfinite(values).all() else values


def category(column: Categorical) -> pd.Categorical[str]:
    """A column of words as categories, in the order in which the file names them."""
    return pd.Categorical.from_codes(column.codes, categories=pd.Index(column.words, dtype=str))


# Runs processed from Python.


def process(
    run_folder: Path | str,
    out: Path | str | None = None,
    *,
    causal: bool = False,
    progress: Progress | None = None,
    **settings: Any,
) -> Results:
    """Process a run folder as `beampose run` does, and return its results.

    out: the results folder, which is replaced; None: a temporary folder that lasts as long as the returned object.
    causal: without the smoothing pass. settings: tracker parameters in place of those of run.yaml; of inner blocks as
    `**{"detect.threshold_sigma": 5}`. progress: called with frames done, frames in all (or None) and the stage.

    >>> run = lab.process(run_folder, causal=True, r1_px=12)
    >>> run.summary["parameters"]["tracker"]["r1_px"]
    12.0

    Raises:
        InputError: the run folder or a setting is wrong.
        CalibrationError: the rig's calibration must not be used.
        RunError: the run could not be processed.
    """
    with_overrides(TrackerParameters(), settings, "settings")  # a mistake is named in terms of this call
    keep = tempfile.TemporaryDirectory(prefix="beampose-") if out is None else None
    folder = Path(keep.name) / "results" if keep is not None else Path(str(out))
    process_run(Path(run_folder), folder, overrides=settings, causal=causal, progress=progress)
    return Results(folder, Path(run_folder).resolve(), keep)


def scenarios() -> pd.Series:
    """The scenarios of the simulator: what each is, by name.

    >>> "sharp-turns" in lab.scenarios()
    True
    """
    return pd.Series({s.name: s.summary for s in SCENARIOS.values()}, name="scenario")
