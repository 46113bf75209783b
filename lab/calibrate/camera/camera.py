"""`calibrate camera`: calibrates a camera from photographs of a board; writes camera.yaml and a report."""

from __future__ import annotations

import datetime
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calibration.boards.board_types import Board, CircleGrid
from calibration.lens.fit.corner_table import CircleAreas, CornerTable
from calibration.lens.fit.lens_models import LENS_MODELS, named
from calibration.lens.intrinsics import (
    FEWEST_VIEWS,
    Intrinsics,
    IntrinsicsError,
    IntrinsicsOptions,
    TooFewViewsError,
    calibrate_intrinsics,
)
from geometry.arrays import Array
from geometry.camera import FISHEYE, PERSPECTIVE
from geometry.uncertainty.rig_uncertainty import RigCovariance
from lab.calibrate.camera.camera_page import findings_of, next_photographs, page_of
from lab.calibrate.camera.photos import TABLE_SUFFIXES, PhotoSet, find_in_photos, origins_of, read_corner_table
from lab.calibrate.step import Solved, Step, run_step
from lab.errors import CalibrationError, InputError
from lab.files.rig.board_file import load_board_or_text
from lab.files.rig.camera_file import CameraCalibration, CameraFile, save_camera
from lab.files.text.csv_text import write_table
from lab.files.text.error_text import require_one_of
from lab.findings.finding import Finding, Level, Outcome, verdict
from lab.number_format import format_number
from lab.progress import Progress

CAMERA, FAILED, CORNERS = "camera.yaml", "camera.failed.yaml", "corners.csv"
CORNER_COLUMNS = ("view", "id", "u_px", "v_px", "residual_u_px", "residual_v_px", "used")  # measured minus model
LENSES = ("auto", *(m.title for m in LENS_MODELS))
WARPS = {"auto": None, "on": True, "off": False}
_STEP = Step("camera", (CORNERS,), CAMERA)


@dataclass(frozen=True, slots=True)
class CameraOptions:
    """Options of a camera calibration."""

    name: str = "camera"
    distance_m: float | None = None  # distance of the screen, for figures in mm; None: median distance of the boards
    image_size_px: tuple[int, int] | None = None  # width, height, of the pictures of a table of corners
    valid_days: int | None = 365  # a run warns after that; None: no expiry. One year: mounts and lenses creep
    lens: str = "auto"  # or 0, 4, 5, 8, 12, fisheye: fixed lens model in place of the selected one
    warp: str = "auto"  # or on, off: estimation of the board's bend
    stretch: str = "auto"  # or on, off: estimation of the board's scale along rows and columns, and of its point errors

    def __post_init__(self) -> None:
        require_one_of("lens", self.lens, LENSES)
        require_one_of("warp", self.warp, WARPS)
        require_one_of("stretch", self.stretch, WARPS)
        if self.distance_m is not None and not (np.isfinite(self.distance_m) and self.distance_m > 0):
            raise InputError(f"distance: expected metres above 0, got {self.distance_m:g}")
        if self.valid_days is not None and self.valid_days < 1:
            raise InputError(f"valid days: expected 1 or more, got {self.valid_days}")

    def intrinsics(self, photos: PhotoSet) -> IntrinsicsOptions:
        """The options of the solver."""
        lens = None if self.lens == "auto" else named(self.lens)
        warp, stretch = WARPS[self.warp], WARPS[self.stretch]
        names = tuple(name for name, _ in photos.views)
        return IntrinsicsOptions(self.distance_m, lens, warp, stretch, origins_of(photos), names)


def calibrate_camera(
    photos: Iterable[Path | str],
    board: Board | str | Path,
    out: Path,
    options: CameraOptions | None = None,
    today: datetime.date | None = None,
    progress: Progress | None = None,
) -> Outcome[Intrinsics]:
    """Calibrate a camera from photographs (files, folders, patterns, videos) of a board (value, text or board.yaml).

    photos may also be one table of corners, see `corner_tables`, with the size of its pictures in the options.

    Writes camera.yaml, corners.csv and report.html. If the verdict is FAIL, the camera file is called
    camera.failed.yaml so that no program reads it by mistake. Raises InputError: for pictures or a board that cannot be
    used; CalibrationError: if the photographs do not determine the camera.
    """
    return run_step(_STEP, out, lambda: _solve(list(photos), board, options or CameraOptions(), today, progress))


def _solve(
    photos: list[Path | str],
    board: Board | str | Path,
    options: CameraOptions,
    today: datetime.date | None,
    progress: Progress | None,
) -> Solved[Intrinsics]:
    day = today or datetime.date.today()
    known = load_board_or_text(board) if isinstance(board, str | Path) else board
    found = _views(photos, known, options, progress)
    try:
        r = calibrate_intrinsics(corner_table(found), options.intrinsics(found))
    except TooFewViewsError as error:
        raise InputError(f"{options.name} ({found.line()}): {error}") from None
    except IntrinsicsError as error:
        raise CalibrationError(f"{options.name} ({found.line()}): {error}") from None
    findings = findings_of(r)
    failed = verdict(findings) is Level.FAIL
    until = None if options.valid_days is None or failed else day + datetime.timedelta(options.valid_days)
    file = camera_file(r, found.board.describe(), findings, options.name, day, until)

    def write(folder: Path) -> None:
        save_camera(file, folder / (FAILED if failed else CAMERA))
        _write_corners(r, found, folder / CORNERS)

    px, mm = (np.nanmedian(m) for m in (r.map.sigma_px(r.covariance), r.map.sigma_mm(r.covariance)))
    return Solved(
        name=options.name,
        result=r,
        findings=findings,
        figures=f"fx {r.fit.lens[0]:.2f} ± {format_number(r.sigmas[0], 2)} px, {r.model.words}, RMS {r.rms_px:.3f} px,"
        f" directions to {format_number(px, 2)} px / {format_number(mm, 2)} mm at {r.distance_m:.3g} m",
        write=write,
        page=lambda: page_of(r, found, "must not be used" if failed else str(until or "")),
        day=day,
        inputs=list(dict.fromkeys(found.paths[name] for name, _ in found.views)),
        title=f"{options.name}, {r.table.image_size_px[0]} x {r.table.image_size_px[1]} px",
        advice=next_photographs(r),
    )


def _views(photos: list[Path | str], board: Board, options: CameraOptions, progress: Progress | None) -> PhotoSet:
    table = Path(photos[0]) if len(photos) == 1 and Path(photos[0]).suffix.lower() in TABLE_SUFFIXES else None
    if table is None and options.image_size_px is None:
        return find_in_photos(photos, board, progress, fewest=FEWEST_VIEWS)
    if table is None:
        raise InputError("image size: expected with a table of corners only; photographs have their own size")
    if options.image_size_px is None:
        raise InputError(f"{table}: a table of corners does not state the size of its pictures; add --image-size WxH")
    return read_corner_table(table, board, options.image_size_px)


def corner_table(photos: PhotoSet) -> CornerTable:
    """The corners of all views, as input of the solver."""
    board = photos.board
    views = [view for _, view in photos.views]
    circles = None
    if isinstance(board, CircleGrid):
        circles = CircleAreas(_joined([view.areas_px2 for view in views]), board.stated_diameter_m)
    rows = [(np.searchsorted(board.ids, view.ids), view.pixels) for view in views]
    sigmas = _joined([view.sigmas_px for view in views])
    return CornerTable.of(rows, board.points, board.middle, photos.image_size_px, circles, sigmas)


def _joined(of_views: Sequence[Array | None]) -> Array | None:
    """One array of all views; None if one of them has none."""
    known = [one for one in of_views if one is not None]
    return np.concatenate(known) if len(known) == len(of_views) else None


def camera_file(
    r: Intrinsics,
    board: str,
    findings: Sequence[Finding],
    name: str,
    day: datetime.date,
    valid_until: datetime.date | None,
) -> CameraFile:
    """The content of camera.yaml. board: in words."""
    calibration = CameraCalibration(
        date=day,
        verdict=verdict(findings).name,
        rms_px=r.rms_px,
        sigma_px=r.fit.sigma_px,
        hold_out_rms_px=r.held_out_rms_px,
        views=int(np.sum(r.table.counts(r.fit.used) > 0)),
        corners=int(r.fit.used.sum()),
        board=board,
        distance_m=r.distance_m,
        valid_until=valid_until,
        reasons=tuple(f"{f.level.name}: {f.what}" for f in findings if f.level > Level.PASS),
        figures=figures_of(r),
    )
    return CameraFile(
        name=name,
        image_size_px=r.table.image_size_px,
        camera_matrix=r.matrix,
        distortion=r.distortion,
        lens=FISHEYE if r.model.fisheye else PERSPECTIVE,
        covariance=RigCovariance(r.parameters, r.covariance),
        calibration=calibration,
    )


def figures_of(r: Intrinsics) -> dict[str, float]:
    """Further key figures for camera.yaml, by name with unit."""
    px, mm = r.map.sigma_px(r.covariance), r.map.sigma_mm(r.covariance)
    out = {
        "uncertainty_median_px": float(np.nanmedian(px)),
        "uncertainty_worst_px": float(np.nanmax(px)),
        "uncertainty_median_mm": float(np.nanmedian(mm)),
        "uncertainty_worst_mm": float(np.nanmax(mm)),
        "scatter_between_photographs": r.scatter.factor,
        "sigmas_raised_by": r.correlated_noise,
        "sigmas_raised_for_model_by": r.model_uncertainty.factor,
        "residuals_together_px": r.model_uncertainty.left_px,
        "lens_models_differ_px": r.model_uncertainty.between_px,
        "picture_covered": r.coverage.filled,
        "tilts_differ_by_deg": r.coverage.spread_deg,
    }
    if r.halves is not None:
        out |= {"halves_differ_px": r.halves.rms_px, "halves_expected_px": r.halves.expected_rms_px}
    if r.warp is not None:
        out |= {"board_bend_mm": 1000 * r.warp.rise_m, "board_bend_corrected": float(r.warp.corrected)}
    if r.board is not None and r.board.stretch is not None:
        s = r.board.stretch
        out |= {"board_stretch_percent": 100 * s.stretch, "board_stretch_sigma_percent": 100 * s.sigma[0]}
        out |= {"board_stretch_corrected": float(s.corrected)}
    if r.board is not None and r.board.points.corrected:
        out |= {"board_points_off_mm": 1000 * r.board.points.rms_m}
    if r.table.circles is not None:
        out |= {"circle_diameter_mm": 2000 * r.fit.radius_m, "circle_diameter_sigma_mm": 2000 * r.fit.radius_sigma_m}
    return out


def _write_corners(r: Intrinsics, photos: PhotoSet, path: Path) -> None:
    """Write corners.csv, one row per corner; residuals are empty in excluded views."""
    names, ids = [name for name, _ in photos.views], photos.board.ids
    rows = []
    for k in range(len(r.table)):
        miss = ["" if np.isnan(v) else f"{-v:.4f}" for v in r.fit.residuals[k].tolist()]
        u, v = r.table.pixels[k].tolist()
        point = int(ids[r.table.point[k]])
        rows.append([names[r.table.view[k]], point, f"{u:.4f}", f"{v:.4f}", *miss, int(r.fit.used[k])])
    write_table(path, CORNER_COLUMNS, rows)
