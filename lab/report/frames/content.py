"""What the annotated pictures of a result show: its tables, the pictures, and the content of one frame."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from itertools import repeat
from pathlib import Path

import numpy as np

from geometry.arrays import Array, Ints
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.pose_solver.gauss_newton import pixel_covariance
from geometry.uncertainty.rig_uncertainty import beam_image, scatter, uncertainty_tracks, unlimited
from lab.errors import BeamposeError, InputError
from lab.files.run.results import POSE_STATUSES, SPOT_STATUSES, PoseTrack, ResultFolder, SpotGrid, read_result_table
from lab.files.run.run_file import FramesFolder, Run, VideoFile
from lab.number_format import decimals_of
from lab.pictures.picture_file import GreyPicture, MissingPicture
from lab.runs.frames.frames import Recorded, pictures_of_rows
from tracking.detections import Detections
from tracking.statuses import PoseStatus, SpotStatus

# The tables of a results folder and the run behind them, as the annotated pictures need them.

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
            raise InputError(f"frame {frame}: expected a frame of the results, {frames[0]} to {frames[-1]}")
        return at


def read_result_data(results: Path, run_folder: Path | None = None) -> ResultData:
    """Read a results folder and what is there of its run folder (the one given, or the one that summary.json names).

    Raises InputError: the results cannot be read, or the given run folder is not theirs.
    """
    folder = ResultFolder(results, run_folder)
    spots, poses = folder.spots, folder.poses
    if not len(spots.frames) or not spots.views:
        path = results / "spots.csv"
        raise InputError(f"{path}: expected rows of at least one frame, got none; process the run again")
    if not np.array_equal(spots.frames, poses.frames):
        raise InputError(f"{results}: spots.csv and attitude.csv have different frames; process the run again")
    run, notes = _run_of(folder, run_folder is not None)
    if run is not None:
        known = SpotModel.of(run.rig).views
        unknown = [view for view in spots.views if view not in known]
        if unknown and run_folder is not None:
            raise InputError(
                f"{run.rig_path}: expected the cameras and spots of {results}, but it has no spot {unknown[0][1]!r} of"
                f" camera {unknown[0][0]!r}; name the run folder of these results"
            )
        if unknown:
            notes = (f"the rig of {run.folder} has other spots than the results: no pictures and no beam tracks",)
            run = None
    return result_data(folder.name, spots, poses, run, results, notes)


def result_data(
    name: str, spots: SpotGrid, poses: PoseTrack, run: Run | None, results: Path, notes: tuple[str, ...] = ()
) -> ResultData:
    """The tables of a results folder, which have been read, with its detections. run: its rig has all their spots."""
    model = None
    if run is not None:
        whole = SpotModel.of(run.rig)
        place = {view: i for i, view in enumerate(whole.views)}
        model = unlimited(whole.subset(np.array([place[view] for view in spots.views], dtype=np.int64)))
    detections = _detections(results / "detections.csv")
    return ResultData(name, spots, poses, run, model, _sizes(spots, run), detections, notes)


def _run_of(results: ResultFolder, given: bool) -> tuple[Run | None, tuple[str, ...]]:
    """The run of results and, where it cannot be read, why. Raises InputError where its folder is given."""
    try:
        return results.run(), ()
    except BeamposeError as error:
        if given:
            raise
        return None, (f"no pictures and no beam tracks: {error}",)


def _sizes(spots: SpotGrid, run: Run | None) -> dict[str, tuple[int, int]]:
    """The pictures' sizes; without a run from the places of measured spots."""
    if run is not None:
        return {name: run.rig.cameras[name].image_size_px for name in spots.cameras}
    out = {}
    for name in spots.cameras:
        mine = spots.views_of(name)
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


# What is drawn over the pictures of one frame: detections, labelled spots, predictions, and tracks of the others.


SIGMAS = 3.0  # of all ellipses and tracks
_NEIGHBOURS = 50  # frames on either side whose predictions show how well a spot is predicted
_NONE = np.zeros((0, 2))
_UNKNOWN = np.full((2, 2), np.nan)


@dataclass(frozen=True, slots=True)
class SpotMark:
    """One spot in one picture. Places are in distorted pixels, nan where unknown."""

    spot: str
    status: SpotStatus | None  # None: the results have no row of it
    uv_px: Array  # (2,), measured or estimated
    cov_px2: Array  # (2, 2) of it
    predicted_px: Array  # (2,)
    predicted_cov_px2: Array  # (2, 2) of the detection about it: the scatter of this spot's predictions nearby
    label_probability: float
    track_px: Array  # (k, 2): where the spot can lie within 3 sigma of the pose; empty for a measured spot
    beam_px: Array  # (m, 2): the image of its beam; empty for a measured spot
    tail_px: Array  # (n, 2): its places in the frames before, the last one first; for videos


@dataclass(frozen=True, slots=True)
class CameraFrame:
    """One camera's picture and marks."""

    camera: str
    size_px: tuple[int, int]
    picture: GreyPicture | None
    reason: str  # why there is no picture
    detections: Array  # (n, 2), px
    marks: tuple[SpotMark, ...]


@dataclass(frozen=True, slots=True)
class DrawnFrame:
    """One frame of all cameras."""

    name: str
    frame: int
    t_s: float  # nan where unknown
    pose_status: PoseStatus | None
    pose_words: str  # the pose with its sigmas
    beams_of_frame: int | None  # the frame whose pose the beams are drawn with; None: no beams are drawn
    cameras: tuple[CameraFrame, ...]


def frame_content(
    data: ResultData, index: int, shown_by: Mapping[str, Recorded], cameras: list[str], tail: int = 0
) -> DrawnFrame:
    """What is drawn of the frame with this index. shown_by: by camera. tail: frames of each spot's past."""
    poses = data.poses
    code = int(poses.status[index])
    near = index if poses.known[index] else _nearest_known(poses, index)
    marks = _marks(data, index, near, tail)
    shown = []
    for camera in cameras:
        picture, table = shown_by.get(camera), data.detections.get(camera)
        grey = picture if isinstance(picture, np.ndarray) else None
        reason = "" if grey is not None else _reason(picture)
        detections = _NONE if table is None else table.at(int(poses.frames[index]))
        own = tuple(marks[j] for j in data.spots.views_of(camera))
        shown.append(CameraFrame(camera, data.sizes_px[camera], grey, reason, detections, own))
    return DrawnFrame(
        name=data.name,
        frame=int(poses.frames[index]),
        t_s=float(poses.t_s[index]),
        pose_status=POSE_STATUSES[code] if code >= 0 else None,
        pose_words=pose_words(poses, index),
        beams_of_frame=None if near is None or data.model is None else int(poses.frames[near]),
        cameras=tuple(shown),
    )


def pose_words(poses: PoseTrack, index: int) -> str:
    """Position and angles of a frame with their sigmas in ASCII, since not every OpenCV draws other characters."""
    if not poses.known[index]:
        return "no pose"
    mm = 1e3 * poses.world_from_body.translation[index], 1e3 * poses.sigma_position_m[index]
    deg = poses.yaw_pitch_roll_deg[index], poses.sigma_ypr_deg[index]
    position, angles = (list(map(_with_sigma, values, sigmas)) for values, sigmas in (mm, deg))
    used, rms = poses.spots_used[index], poses.rms_px[index]
    fit = f"   {int(used)} spots" if np.isfinite(used) else ""
    fit += f", rms {rms:.2g} px" if np.isfinite(rms) else ""
    place = f"x {position[0]}, y {position[1]}, z {position[2]} mm"
    return f"{place}   yaw {angles[0]}, pitch {angles[1]}, roll {angles[2]} deg{fit}"


def _with_sigma(value: float, sigma: float) -> str:
    if not (np.isfinite(sigma) and sigma > 0):
        return f"{value:.4g}"
    decimals = decimals_of(sigma)
    return f"{value:.{decimals}f} +- {sigma:.{decimals}f}"


def _reason(picture: Recorded | None) -> str:
    if picture is None or isinstance(picture, Detections):
        return "no picture: detected points"
    reason = str(getattr(picture, "reason", ""))
    return reason if reason.startswith("no picture") else f"no picture: {reason}"


def _nearest_known(poses: PoseTrack, index: int) -> int | None:
    known = np.flatnonzero(poses.known)
    return int(known[np.argmin(np.abs(known - index))]) if len(known) else None


def _marks(data: ResultData, index: int, near: int | None, tail: int) -> list[SpotMark]:
    """The marks of all views. near: index of the pose that the beams are drawn with."""
    spots, model = data.spots, data.model
    tracks: Array | None = None
    covariance: Array | None = None
    if model is not None and near == index:
        pose, P = data.poses.world_from_body[index], data.poses.covariance[index]
        if np.isfinite(P).all():
            rows = np.flatnonzero(~spots.measured[index])
            tracks, covariance = np.full((len(spots.views), 0, 2), np.nan), np.full((len(spots.views), 2, 2), np.nan)
            if len(rows):
                hidden = model.subset(rows)
                found = uncertainty_tracks(hidden, pose, P, SIGMAS)
                tracks = np.full((len(spots.views), *found.shape[1:]), np.nan)
                tracks[rows], covariance[rows] = found, pixel_covariance(hidden.project(pose)[1], P)
    out = []
    for j, (_, spot) in enumerate(spots.views):
        code = int(spots.status[index, j])
        status = SPOT_STATUSES[code] if code >= 0 else None
        measured = status is not None and status.measured
        uv = spots.uv_px[index, j]
        cov = _stated(data, index, j)
        if not measured and covariance is not None and not np.isfinite(cov).all():
            cov = covariance[j]
        out.append(
            SpotMark(
                spot=spot,
                status=status,
                uv_px=uv,
                cov_px2=cov,
                predicted_px=spots.predicted_px[index, j],
                predicted_cov_px2=_scatter_near(data, index, j),
                label_probability=float(spots.label_probability[index, j]),
                track_px=_NONE if measured or tracks is None else tracks[j],
                beam_px=_NONE if measured or near is None else _beam(data, j, data.poses.world_from_body[near]),
                tail_px=spots.uv_px[max(index - tail, 0) : index + 1, j][::-1] if tail else _NONE,
            )
        )
    return out


def _stated(data: ResultData, index: int, j: int) -> Array:
    """The covariance of a spot's place as spots.csv states it."""
    s = data.spots
    cov = np.diag(s.sigma_px[index, j] ** 2)
    mixed = float(s.cov_uv_px2[index, j])
    cov[0, 1] = cov[1, 0] = mixed if np.isfinite(mixed) else 0.0
    return cov if np.isfinite(cov).all() else _UNKNOWN


def _scatter_near(data: ResultData, index: int, j: int) -> Array:
    """The scatter of a spot's detections about its predictions in the frames around this one, without this one."""
    s = data.spots
    part = slice(max(index - _NEIGHBOURS, 0), index + _NEIGHBOURS + 1)
    differences = np.where(s.measured[part, j, None], s.uv_px[part, j] - s.predicted_px[part, j], np.nan)
    differences[index - part.start] = np.nan
    return scatter(differences)


def _beam(data: ResultData, j: int, world_from_body: Pose) -> Array:
    if data.run is None:
        return _NONE
    camera, spot = data.spots.views[j]
    return beam_image(data.run.rig, data.run.rig.cameras[camera], spot, world_from_body)


# The pictures of several frames, one after the other, with a few read ahead.


def pictures_of(run: Run | None, cameras: Sequence[str], frames: Sequence[int]) -> Iterator[dict[str, Recorded]]:
    """For each of the rising frame numbers the pictures of the cameras; those of points are left out.

    A camera whose pictures cannot be read has none, with the reason. Memory does not grow with the number of frames.
    """
    recorded = {} if run is None else {n: s for n, s in run.cameras.items() if isinstance(s, FramesFolder | VideoFile)}
    with ExitStack() as stack:
        streams: dict[str, Iterator[Recorded]] = {}
        for camera in cameras:
            if run is not None and camera in recorded:
                streams[camera] = stack.enter_context(closing(pictures_of_rows(run, camera, frames)))
        for _ in frames:
            shown: dict[str, Recorded] = {}
            for camera, stream in streams.items():
                try:
                    shown[camera] = next(stream)
                except BeamposeError as error:
                    shown[camera] = MissingPicture(str(error))
                    streams[camera] = repeat(shown[camera])
            yield shown
