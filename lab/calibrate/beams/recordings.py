"""Labelled spots at positions of a stand, from tables or run folders; frames at rest are averaged."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.optimize import linear_sum_assignment

from calibration.beams.beams import StandModel
from calibration.terms.rig_blocks import SpotPixels
from geometry.arrays import Array, Ints, evenly_spaced
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.pose_prior import PosePrior
from geometry.rig import Rig
from lab.errors import InputError
from lab.files.project.point_files import StandPoses, read_poses
from lab.files.project.project import Project, ProjectRecording
from lab.files.run.clocks import ESTIMATE
from lab.files.run.run_file import load_run
from lab.files.text.csv_text import SIGMA_RANGE_PX, Table, check_pixels, check_sigmas, read_table
from lab.files.text.error_text import printable_line
from lab.runs.frames.pipeline import Pipeline
from tracking.detections import Detections
from tracking.statuses import SpotStatus

AT_REST = 1e-7  # m and rad: poses that differ by less than this, or by less than half their sigma, are one position


@dataclass(frozen=True, slots=True)
class SpotRows:
    """n labelled spots, each from one frame."""

    frame: Ints  # (n,)
    view: Ints  # (n,) in the order of Rig.views()
    pixels: Array  # (n, 2)
    covariance: Array  # (n, 2, 2)


def positions_at_rest(stand_from_body: Pose, sigmas: Array) -> Ints:
    """Index (n,) of the stand position of each of n frames; a new position starts where the recorded pose changes.

    sigmas: (n, 6), m and rad, of each recorded pose. Frames of one position share the stand's error and count as one
    measurement of the stand.
    """
    out = np.zeros(len(sigmas), dtype=np.int64)
    start = 0
    for k in range(1, len(out)):
        change = np.abs(stand_from_body[k].minus(stand_from_body[start]))
        moved = bool(np.any(change > np.maximum(AT_REST, 0.5 * sigmas[k])))
        out[k] = out[k - 1] + moved
        start = k if moved else start
    return out


def average(rows: SpotRows, position: Ints) -> SpotPixels:
    """Average the rows of each stand position and view.

    rows: n rows; position: (n,) index of the stand position of each row. Averaging reduces only the part of the noise
    that varies between frames, and less so where successive frames are correlated. The rest of the stated covariance
    (speckle, pixel locking, blooming, which are constant while the vehicle is at rest) remains.
    """
    keys, which = np.unique(np.stack([position, rows.view], axis=1), axis=0, return_inverse=True)
    pixels, covariance = np.empty((len(keys), 2)), np.empty((len(keys), 2, 2))
    for k in range(len(keys)):
        here = np.flatnonzero(which.ravel() == k)
        here = here[np.argsort(rows.frame[here], kind="stable")]
        pixels[k], covariance[k] = mean_of_frames(rows.pixels[here], rows.covariance[here])
    return SpotPixels(keys[:, 0], keys[:, 1], pixels, covariance)


def mean_of_frames(pixels: Array, covariance: Array) -> tuple[Array, Array]:
    """Mean (2,) of a spot at rest and its covariance (2, 2).

    pixels: (n, 2) in the order of the frames; covariance: (n, 2, 2), stated for each frame. Ours.
    """
    n = len(pixels)
    stated = covariance.mean(axis=0)
    if n < 3:
        return pixels.mean(axis=0), stated
    # Exclude single outliers, such as a hand in front of the camera.
    distance = np.linalg.norm(pixels - np.median(pixels, axis=0), axis=1)
    inlier = distance <= max(5 * float(np.median(distance)), 5 * float(np.sqrt(np.trace(stated))))
    used = pixels[inlier]
    n = len(used)
    residual = used - used.mean(axis=0)
    scatter = residual.T @ residual / max(n - 1, 1)
    variance = float(np.trace(scatter))
    lag_one = float(np.sum(residual[1:] * residual[:-1])) / max(float(np.sum(residual**2)), 1e-30)
    rho = float(np.clip(lag_one + 1 / n, 0.0, 0.95))  # subtracting the mean biases the autocorrelation by -1 / n
    varying = scatter * (1 + rho) / (1 - rho) / n
    common = stated * max(1.0 - variance / float(np.trace(stated)), 0.0)
    return used.mean(axis=0), varying + common


# Largest difference of a beam from its nominal line for which its spots are found: together 64 mm on a screen at 2.5 m
# from the vehicle. Spots of different beams closer than this may be confused; the robust fit then excludes them.
MAX_NOMINAL_ERROR_RAD = np.deg2rad(1.0)
MAX_NOMINAL_ERROR_M = 0.02
Labelled = list[tuple[int, Array, Array]]  # view, pixel (2,), covariance (2, 2)


def spots_of_run(folder: Path, rig: Rig, known: StandPoses | None, world_from_stand: Pose | None) -> SpotRows:
    """Labelled spots of all frames of a run.

    rig: calibrated cameras and screens with nominal beams, used in place of the rig in run.yaml. If the stand's place
    and its poses are known, each detection gets the label of the nearest spot predicted by the nominal beams. Otherwise
    the tracker labels the detections, starting from the run's own prior. Frames without a pose are skipped. Raises
    InputError: if the run cannot be read or has a camera that is not in `rig`.
    """
    run = load_run(folder)
    missing = [c for c in run.cameras if c not in rig.cameras]
    if missing:
        raise InputError(
            f"{run.path}: cameras.{missing[0]}: expected a camera of the calibration, got {missing[0]!r}; it has"
            f" {', '.join(rig.cameras)}"
        )
    if any(c.wide(run.frame_rate_hz, rig.cameras[n].image_size_px[1]) for n, c in run.clocks.items()):
        raise InputError(
            f"{run.path}: cameras: expected clocks that are known, got `{ESTIMATE}`; a stand at rest shows no clock:"
            f" remove `{ESTIMATE}`, and record while the stand is at rest"
        )
    rig_of_run = dataclasses.replace(rig, cameras={n: c for n, c in rig.cameras.items() if n in run.cameras})
    run = dataclasses.replace(run, rig=rig_of_run, covariance=None)
    view_index = {view: i for i, view in enumerate(rig.views())}
    model = SpotModel.of(rig_of_run)
    view_of = np.array([view_index[v] for v in model.views], dtype=np.int64)
    poses: dict[int, Pose] = {}
    if known is not None:
        poses = {int(f): known.stand_from_body[i] for i, f in enumerate(known.frames)}
        if world_from_stand is not None:
            start = PosePrior(world_from_stand @ known.stand_from_body[0], 0.1, float(np.deg2rad(10.0)))
            run = dataclasses.replace(run, prior=start)
    frame, view, pixels, covariance = [], [], [], []
    for number, found in _labelled(Pipeline.of(run), model, poses, world_from_stand):
        if known is not None and number not in poses:
            continue
        for v, uv, cov in found:
            frame.append(number)
            view.append(view_of[v])
            pixels.append(uv)
            covariance.append(cov)
    return SpotRows(
        np.array(frame, dtype=np.int64),
        np.array(view, dtype=np.int64),
        np.array(pixels, dtype=float).reshape(-1, 2),
        np.array(covariance, dtype=float).reshape(-1, 2, 2),
    )


def label(model: SpotModel, world_from_body: Pose, detections: tuple[Detections | None, ...]) -> Labelled:
    """Assign detections (one entry per camera) to the spots that the nominal beams predict at a pose.

    Returns view, pixel and covariance of each assigned detection. The assignment of a camera has the least total
    distance, where each distance is divided by the largest error that its spot may have from the nominal beam.
    """
    d = model.derivatives(world_from_body)
    gate_px = np.hypot(
        MAX_NOMINAL_ERROR_RAD * np.linalg.norm(d.direction, axis=(-2, -1)),
        MAX_NOMINAL_ERROR_M * np.linalg.norm(d.point, axis=(-2, -1)),
    )
    out = []
    for c, found in enumerate(detections):
        views = np.flatnonzero((model.camera_of == c) & np.isfinite(d.pixels).all(axis=1))
        if found is None or not len(found) or not len(views):
            continue
        distance = np.linalg.norm(found.uv_px[None] - d.pixels[views][:, None], axis=2) / gate_px[views][:, None]
        # Distances are capped well above the gate: pairs outside of it are assigned last, and dropped below.
        rows, columns = linear_sum_assignment(np.minimum(distance, 1e3))
        out += [
            (int(views[r]), found.uv_px[k], found.cov_px2[k])
            for r, k in zip(rows, columns, strict=True)
            if distance[r, k] <= 1.0
        ]
    return out


def _labelled(
    pipeline: Pipeline, model: SpotModel, poses: dict[int, Pose], world_from_stand: Pose | None
) -> Iterator[tuple[int, Labelled]]:
    """Frame numbers with their labelled spots: from known poses, else from the tracker."""
    if poses and world_from_stand is not None:
        for number, detections in pipeline.detections():
            if number in poses:
                yield number, label(model, world_from_stand @ poses[number], detections)
    else:
        for record in pipeline.records():
            t = record.tracked
            yield record.frame, [(v, t.uv_px[v], t.cov_px2[v]) for v, s in enumerate(t.status) if s.measured]


SPOTS = ("camera", "spot", "u_px", "v_px")
DEFAULT_SPOT_SIGMA_PX = 0.1  # px, if the table states none: a laser spot on a matt screen, speckle included
MAX_UNKNOWN_POSES = 200  # positions without a pose that are used: each adds six unknowns, more add little information
_USED = [status.value for status in SpotStatus if status.measured]  # in spots.csv


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

    Raises InputError: with file, line, the expected and the found content.
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
    recording: ProjectRecording, known: StandPoses | None, project: Project, rig: Rig, notes: list[str]
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

    Of a spots.csv (column `frame`) only matched spots are used. Assumptions are appended to `notes`. Raises InputError:
    with file, line, the expected and the found content.
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
    table.refuse_unknown("camera", rig.cameras, "a calibrated camera")
    table.refuse_unknown("spot", rig.spots, "a spot of the target")
    for i, (camera, spot) in enumerate(zip(cameras, spots, strict=True)):
        if (camera, spot) not in views:
            raise table.error(
                i,
                f"camera {camera!r} observes screen {rig.cameras[camera].screen!r}, but spot {spot!r} is on"
                f" {rig.spots[spot].screen!r}; one of the two names is wrong",
            )
        view[i] = views[camera, spot]
    pixels = table.finite_stack("u_px", "v_px")
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
    default = [0.0] * 6 if stand is None else [stand.pose_sigma_m] * 3 + [np.radians(stand.pose_sigma_deg)] * 3
    return np.where(np.isnan(known.sigmas), np.array(default), known.sigmas)


def limit_frames(rows: SpotRows, notes: list[str]) -> SpotRows:
    """The rows of at most MAX_UNKNOWN_POSES evenly spaced frames."""
    frames = np.unique(rows.frame)
    if len(frames) <= MAX_UNKNOWN_POSES:
        return rows
    notes.append(f"{MAX_UNKNOWN_POSES} of {len(frames)} frames without a pose were used, evenly spaced")
    used = np.isin(rows.frame, evenly_spaced(frames, MAX_UNKNOWN_POSES))
    return SpotRows(rows.frame[used], rows.view[used], rows.pixels[used], rows.covariance[used])


def _names(recording: ProjectRecording, frames: Ints, position_of: Ints, several: bool) -> list[str]:
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
