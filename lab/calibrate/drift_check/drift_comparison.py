"""Pixels predicted by a stored calibration for known points or a vehicle at rest, compared with the measured ones.

Result of a drift check for cameras, points and lasers, the limits that decide on its verdict, and its history.
"""

from __future__ import annotations

import datetime
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calibration.changes import (
    LASER_MOVED,
    USUAL_SIZES,
    WRONG_POINT,
    CameraColumns,
    Change,
    ChangeCandidate,
    ExcessResidual,
    camera_columns,
)
from geometry.arrays import Array, Ints, skew
from geometry.camera import Camera, Projected, pinhole_numbers, project_points_full
from geometry.forward_model import SpotDerivatives, SpotModel
from geometry.pose import Pose
from geometry.pose_solver.gauss_newton import fit_pose
from geometry.rig import Rig
from geometry.uncertainty.rig_uncertainty import BOW, CLOCK, POSE, RigCovariance, Sensitivity, camera_column, split_name
from lab.calibrate.drift_check.drift_inputs import KnownPoints, StillSpots, check_points_match
from lab.errors import InputError
from lab.files.text.csv_text import read_table, write_table
from lab.files.text.error_text import printable_line
from lab.findings.finding import Level, level_above


@dataclass(frozen=True, slots=True)
class DriftLimits:
    """Limits and assumptions of a drift check."""

    p_false_alarm: float = 0.002  # probability per check of a false alarm: once in two years of working days
    warn_mm: float = 0.2  # mm at the screen, RMS: the error of a good spot; smaller drifts are lost in its noise
    fail_mm: float = 0.5  # mm at the screen: at 2.5 m from the vehicle 0.011 deg, more than the goal of 0.01 deg
    weak_mm: float = 2.0  # mm: a check that can miss such a shift (0.05 deg at 2.5 m) is too weak to confirm anything
    fail_px: float = 1.0  # px, if there is no value in mm because the camera's rays miss its screen
    point_sigma_px: float = 0.1  # px, of a known point without a stated sigma: a mark of some 10 px, centre fitted
    floor_px: float = 0.02  # px, of a mean spot: pixel locking and speckle do not average out while the vehicle rests
    still_px: float = 0.3  # px: largest motion of a spot in a static run; beyond it the vehicle moves
    pose_sigma_m: float = 5e-5  # m, of each coordinate of a stand's known pose: a good mechanical seat
    pose_sigma_deg: float = 0.003  # deg, about each axis: 11 arcsec, a good turntable
    power: float = 0.9  # probability with which a drift of the "detectable" size is found
    expiry_warning_days: int = 14  # days before the expiry date from which the check warns


@dataclass(frozen=True, slots=True)
class OtherChange:
    """A wrong point or a moved laser."""

    change: Change
    px: float  # RMS displacement of its pixels
    mm: float  # the same at the screen


@dataclass(frozen=True, slots=True)
class CameraDrift:
    """Result of a check for one camera with n points."""

    camera: str
    pixels: Array  # (n, 2)
    residual_px: Array  # (n, 2) measured minus predicted
    explained_px: Array  # (n, 2) part of the residual due to the camera's own change; 0 if it has none
    drift_px: float  # RMS of the fitted drift over the points
    noise_px: float  # expected RMS of the fitted drift without any change
    drift_mm: float  # at the camera's screen; nan if its rays miss it
    shift_px: Array  # (2,) mean of the fitted drift
    sigma_shift_px: Array  # (2,)
    turn_deg: Array  # (3,) rotation of the scene about the camera's x, y, z
    sigma_turn_deg: Array  # (3,)
    scale_ppm: float  # change of the focal length
    sigma_scale_ppm: float
    p_value: float  # probability of a drift of this size without any change
    detectable_px: float  # common shift that the check finds with probability DriftLimits.power
    detectable_mm: float
    change: Change | None  # the explanation of the residuals; None if nothing is significant
    unexplained_px: float  # RMS of the residuals that no explanation removes; nan if not significant
    unexplained_mm: float
    level: Level


@dataclass(frozen=True, slots=True)
class DriftResult:
    """Result of a drift check."""

    cameras: tuple[CameraDrift, ...]
    others: tuple[OtherChange, ...]  # wrong points and moved lasers
    unchecked: tuple[str, ...]  # cameras of the rig without measurements


def is_weak(detectable_mm: float, limits: DriftLimits) -> bool:
    """Whether a check can miss so large a drift that a result without drift does not confirm the calibration."""
    return not detectable_mm <= limits.weak_mm  # nan counts as weak


def level_of(px: float, mm: float, limits: DriftLimits) -> Level:
    """Verdict on a significant change of this size, by its mm at the screen, else (mm is nan) by its pixels."""
    if np.isfinite(mm):
        return level_above(mm, limits.warn_mm, limits.fail_mm)
    return Level.FAIL if px > limits.fail_px else Level.WARN


# Drift history: a CSV with one row per camera and check, which shows a slow drift before it exceeds a limit.


HISTORY_COLUMNS = ("date", "camera", "drift_px", "noise_px", "drift_mm", "verdict")


@dataclass(frozen=True, slots=True)
class HistoryRow:
    """Drift of one camera in one check."""

    date: datetime.date
    camera: str
    drift_px: float
    noise_px: float
    drift_mm: float
    verdict: Level


def read_history(path: Path) -> list[HistoryRow]:
    """Rows of earlier checks; none if the file does not exist.

    Raises InputError: for a file that is not a drift history.
    """
    path = Path(path)
    if not path.exists():
        return []
    try:
        table = read_table(path, HISTORY_COLUMNS)
        table.refuse_long_lines()
    except InputError as error:
        raise InputError(f"{error}; name another --history") from None
    dates, cameras, verdicts = (table.words[c].tolist() for c in ("date", "camera", "verdict"))
    drift, noise, drift_mm = (table.optional(c).tolist() for c in ("drift_px", "noise_px", "drift_mm"))
    rows = []
    for i, (date, verdict) in enumerate(zip(dates, verdicts, strict=True)):
        try:
            day, level = datetime.date.fromisoformat(date), Level[verdict]
        except (ValueError, KeyError):
            raise table.error(
                i,
                f"expected a date and a verdict, got {printable_line(f'{date}, {verdict}')}; correct or delete the row",
            ) from None
        rows.append(HistoryRow(day, cameras[i], drift[i], noise[i], drift_mm[i], level))
    return rows


def write_history(rows: Sequence[HistoryRow], path: Path) -> None:
    """Write all rows atomically: an interrupted check leaves the history unchanged."""
    table: list[list[object]] = []
    for r in rows:
        numbers = ["" if math.isnan(v) else f"{v:.6g}" for v in (r.drift_px, r.noise_px, r.drift_mm)]
        table.append([r.date.isoformat(), r.camera, *numbers, r.verdict.name])
    write_table(Path(path), HISTORY_COLUMNS, table)


@dataclass(frozen=True, slots=True)
class PixelComparison:
    """n measured and predicted pixels, and the effect of each possible change on them. 2n rows: u, v of each pixel."""

    camera: tuple[str, ...]  # (n,)
    label: tuple[str, ...]  # (n,) name of the point or spot
    pixels: Array  # (n, 2) measured
    predicted: Array  # (n, 2)
    xyz: Array  # (n, 3), m, in world
    misfit: ExcessResidual
    columns: Mapping[str, CameraColumns]  # by camera, over all 2n rows
    others: Mapping[tuple[str, str], ChangeCandidate]  # changes of points and lasers, for find_changes
    measured_sigma_px: Array  # (n,) of the measurement
    calibration_sigma_px: Array  # (n,) of the prediction

    def rows_of(self, camera: str) -> Ints:
        """Indices (k,) of this camera's pixels."""
        return np.flatnonzero([c == camera for c in self.camera])


def compare_points(rig: Rig, known: KnownPoints, covariance: RigCovariance | None, path: Path) -> list[PixelComparison]:
    """Compare the points of each camera with the rig: one comparison per camera, in the rig's order.

    Raises InputError: if the pixels cannot be those of these points.
    """
    world, predicted = np.zeros((len(known.point), 3)), np.full((len(known.point), 2), np.nan)
    for i in range(len(known.point)):
        world[i] = _world(rig, known, i)
        predicted[i] = rig.cameras[known.camera[i]].project(world[i])
    check_points_match(known, predicted, path)
    out = []
    for name, camera in rig.cameras.items():
        rows = np.flatnonzero([c == name for c in known.camera])
        if len(rows):
            out.append(_compare_camera(rig, camera, known, rows, world[rows], covariance))
    return out


def _world(rig: Rig, known: KnownPoints, i: int) -> Array:
    """World coordinates (3,), m, of known point i."""
    if not known.screen[i]:
        return known.xyz[i]
    screen = rig.screens[known.screen[i]]
    return screen.world_from_screen.apply(_on_surface(known.xyz[i], screen.bow))


def _on_surface(xyz: Array, bow: tuple[float, float, float]) -> Array:
    """The point (3,), m, of a curved screen at x and y, in the screen's frame."""
    x, y = float(xyz[0]), float(xyz[1])
    return np.array([x, y, bow[0] * x * x + bow[1] * x * y + bow[2] * y * y])


def _compare_camera(
    rig: Rig, camera: Camera, known: KnownPoints, rows: Ints, world: Array, covariance: RigCovariance | None
) -> PixelComparison:
    """Compare the points of one camera. rows: (k,) indices into `known`; world: (k, 3), m."""
    in_camera = camera.camera_from_world.apply(world)
    lens = project_points_full(in_camera, *camera.lens_numbers)
    n = len(rows)
    R_c = camera.camera_from_world.rotation
    noise = np.zeros((n, 2, n, 2))
    axes_of = [rig.screens[s].world_from_screen.rotation if s else np.eye(3) for s in (known.screen[i] for i in rows)]
    d_xyz = lens.d_point @ R_c @ np.array(axes_of)  # px per m along the axes of the given coordinates
    survey = (d_xyz * known.sigma_m[rows][:, None, :] ** 2) @ np.swapaxes(d_xyz, -1, -2)
    noise[np.arange(n), :, np.arange(n)] = survey + known.sigma_px[rows][:, None, None] ** 2 * np.eye(2)
    C_noise = noise.reshape(2 * n, 2 * n)
    C_calibration = np.zeros((2 * n, 2 * n))
    if covariance is not None:
        J = _by_parameters(rig, camera, known, rows, world, lens, covariance.names)
        C_calibration = J @ covariance.matrix @ J.T
    pixels = known.pixels[rows]
    columns = camera_columns(in_camera, lens.d_point, lens.d_pinhole, pinhole_numbers(camera)[:2])
    labels = tuple(known.point[i] for i in rows)
    return PixelComparison(
        camera=(camera.name,) * n,
        label=labels,
        pixels=pixels,
        predicted=lens.pixels,
        xyz=world,
        misfit=ExcessResidual.of((pixels - lens.pixels).ravel(), C_noise + C_calibration),
        columns={camera.name: columns},
        others={(WRONG_POINT, label): _one_point(n, i) for i, label in enumerate(labels)},
        measured_sigma_px=_sigma(C_noise),
        calibration_sigma_px=_sigma(C_calibration),
    )


def _sigma(covariance: Array) -> Array:
    """RMS over u and v (n,) of the sigmas on the diagonal of a covariance (2n, 2n)."""
    return np.sqrt(np.diagonal(covariance).reshape(-1, 2).mean(axis=1))


def _one_point(n: int, i: int) -> ChangeCandidate:
    out = np.zeros((2 * n, 2))
    out[2 * i, 0] = out[2 * i + 1, 1] = 1.0
    return ChangeCandidate(out, np.full(2, USUAL_SIZES.point_px))


def _by_parameters(
    rig: Rig, camera: Camera, known: KnownPoints, rows: Ints, world: Array, lens: Projected, names: tuple[str, ...]
) -> Array:
    """d(pixels)/d(parameters) (2n, p) of points with known coordinates, in the order of the names."""
    n, R_c = len(rows), camera.camera_from_world.rotation
    pose = np.concatenate([lens.d_point, lens.d_point @ -(R_c @ skew(world))], axis=-1)
    screens = {}
    for name in {known.screen[i] for i in rows} - {""}:
        screen = rig.screens[name]
        here = np.array([known.screen[i] == name for i in rows])
        R_s = screen.world_from_screen.rotation
        local = np.array([_on_surface(known.xyz[i], screen.bow) for i in rows])
        x, y = local[:, 0], local[:, 1]
        moves = np.concatenate([np.broadcast_to(np.eye(3), (n, 3, 3)), -(R_s @ skew(local))], axis=-1)
        bulge = R_s[:, 2:] * np.stack([x * x, x * y, y * y], axis=-1)[:, None, :]
        d_world = (lens.d_point @ R_c) * here[:, None, None]
        screens[name] = np.concatenate([d_world @ moves, d_world @ bulge], axis=-1)
    J = np.zeros((n, 2, len(names)))
    by_camera = {"camera": pose, "pinhole": lens.d_pinhole, "distortion": lens.d_distortion}
    for k, full in enumerate(names):
        kind, thing, parameter = split_name(full)
        if kind == "cameras" and thing == camera.name and parameter not in CLOCK:  # the points do not move
            field, column = camera_column(camera, parameter)
            J[..., k] = by_camera[field][..., column]
        elif kind == "screens" and thing in screens:
            J[..., k] = screens[thing][..., (*POSE, *BOW).index(parameter)]
    return J.reshape(2 * n, len(names))


def compare_still(
    rig: Rig,
    still: StillSpots,
    covariance: RigCovariance | None,
    pose: tuple[Pose, Array] | None,
    floor_px: float,
    path: Path,
) -> PixelComparison:
    """Compare the mean spots of a vehicle at rest with the rig.

    pose: its pose with covariance (6, 6); None: unknown. floor_px: error of a mean spot that averaging over frames does
    not reduce. An unknown pose is fitted, and a change that has the same effect as another pose is not detected. Raises
    InputError: if the spots do not determine an unknown pose, or a spot is not visible at the pose.
    """
    model = SpotModel.of(rig)
    rows = np.array([model.views.index(v) for v in still.views], dtype=np.int64)
    part = model.subset(rows)
    n = len(rows)
    variance = np.maximum(still.scatter_px, still.sigma_px) ** 2 / still.frames[:, None] + floor_px**2
    world_from_body = _fitted_pose(part, still, variance, path) if pose is None else pose[0]
    d = part.derivatives(world_from_body)
    if not np.isfinite(d.pixels).all():
        missing = part.views[int(np.flatnonzero(~np.isfinite(d.pixels).all(axis=1))[0])]
        raise InputError(f"{path}: at this pose camera {missing[0]!r} does not see spot {missing[1]!r}; check the pose")
    C_calibration = np.zeros((2 * n, 2 * n))
    if covariance is not None:
        J = Sensitivity(rig, part, covariance.names).of(d).reshape(2 * n, -1)
        C_calibration = J @ covariance.matrix @ J.T
    C = np.diag(variance.ravel()) + C_calibration
    by_pose = d.pose.reshape(2 * n, 6)
    if pose is not None:
        C = C + by_pose @ pose[1] @ by_pose.T
    hits = part.hits(world_from_body)
    residual = (still.pixels - d.pixels).ravel()
    return PixelComparison(
        camera=tuple(c for c, _ in part.views),
        label=tuple(s for _, s in part.views),
        pixels=still.pixels,
        predicted=d.pixels,
        xyz=hits,
        misfit=ExcessResidual.of(residual, C, by_pose if pose is None else None),
        columns=_columns_of_cameras(rig, part, d, hits),
        others=_changes_of_spots(rig, part, d),
        measured_sigma_px=np.sqrt(variance.mean(axis=1)),
        calibration_sigma_px=_sigma(C_calibration),
    )


def _fitted_pose(part: SpotModel, still: StillSpots, variance: Array, path: Path) -> Pose:
    """Pose of a vehicle at rest from its mean spots. variance: (n, 2), px^2. Raises InputError if none fits."""
    n = len(part)
    if 2 * n <= 6:
        raise InputError(f"{path}: expected four spots or more of a vehicle at an unknown pose, got {n}; give --pose")
    if still.start is None:
        raise InputError(f"{path}: expected an attitude.csv beside spots.csv, or the pose (--pose); got neither")
    each = np.zeros((n, 2, 2))
    each[:, 0, 0], each[:, 1, 1] = variance.T
    fit = fit_pose(part, np.arange(n), still.pixels, each, still.start)
    if fit is None:
        raise InputError(f"{path}: no pose fits these spots; check that this is the right rig.yaml")
    return fit.world_from_body


def _columns_of_cameras(rig: Rig, part: SpotModel, d: SpotDerivatives, hits: Array) -> dict[str, CameraColumns]:
    """Effect of a change of each camera on the spots of a vehicle at rest. hits: (n, 3), m, spots in world."""
    columns = {}
    for name, camera in rig.cameras.items():
        mine = np.array([c == name for c, _ in part.views])
        if not mine.any():
            continue
        in_camera = camera.camera_from_world.apply(hits)
        d_point = d.camera[..., :3] * mine[:, None, None]
        one = camera_columns(in_camera, d_point, d.pinhole * mine[:, None, None], pinhole_numbers(camera)[:2])
        columns[name] = one
    return columns


def _changes_of_spots(rig: Rig, part: SpotModel, d: SpotDerivatives) -> dict[tuple[str, str], ChangeCandidate]:
    """The candidates besides the cameras: one wrong spot, or one moved laser."""
    n = len(part)
    changes = {(WRONG_POINT, f"{s} ({c})"): _one_point(n, i) for i, (c, s) in enumerate(part.views)}
    laser = np.repeat([USUAL_SIZES.laser_rad, USUAL_SIZES.laser_m], 3)
    for b, beam in enumerate(rig.beams):
        on_beam = (part.beam_of == b)[:, None, None]
        moves = np.concatenate([d.direction * on_beam, d.point * on_beam], axis=-1).reshape(2 * n, 6)
        if on_beam.sum() > 1:  # a laser with a single view is the same candidate as the wrong point of this view
            changes[(LASER_MOVED, beam)] = ChangeCandidate(moves, laser)
    return changes


def check_at_rest(still: StillSpots, limit_px: float, path: Path) -> None:
    """Raise InputError if the spots move during the run: the check needs a vehicle at rest."""
    sigma = np.sqrt(still.scatter_px**2 * 4 / still.frames[:, None])
    drifting = np.abs(still.drift_px) > np.maximum(limit_px, 5 * sigma)
    scattering = still.scatter_px > np.maximum(limit_px, 10 * still.sigma_px)
    for kind, amount, bad in (
        ("drifted by", np.abs(still.drift_px), drifting),
        ("scattered by", still.scatter_px, scattering),
    ):
        if bad.any():
            i = int(np.argmax(np.where(bad, amount, 0).max(axis=1)))
            camera, spot = still.views[i]
            raise InputError(
                f"{path}: expected a vehicle at rest, got spot {spot!r} of camera {camera!r} that {kind}"
                f" {amount[i].max():.2f} px during the run (limit {limit_px:g} px); record the vehicle at rest"
            )
