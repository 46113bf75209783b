"""The inputs of `calibrate screen`: tables, boards and scans, and the network of surveyed points checked.

Corners of the boards of a calibration project, both portable boards and boards fixed to a screen.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from calibration.boards.board_detection import find_board
from calibration.boards.board_types import Board
from calibration.boards.board_view import BoardView, NotFound
from calibration.least_squares.adjustment import AdjustmentError, Prior
from calibration.screens.clouds import FEWEST, MissingOpen3DError, align, on_surfaces, register, scan_of
from calibration.screens.network import ControlPoints, Network, PointObservations, fisheye
from calibration.screens.network_start import NotConnectedError
from calibration.screens.screens import (
    ApproximatePosition,
    FittedScreens,
    Scan,
    ScreenSetup,
    SurveyError,
    calibrate,
    diagnose_survey,
    misfit_of,
    wrong_unit,
)
from calibration.terms.corners import CornerTerm
from calibration.terms.rig_blocks import prior_of
from calibration.terms.surveyed import BoardOnScreenTerm
from geometry.arrays import Array, Bools, Ints
from geometry.pose import Pose
from geometry.rig import Rig, Screen
from geometry.uncertainty.rig_uncertainty import RigCovariance, independent
from lab.calibrate.camera.photos import as_8_bit
from lab.errors import CalibrationError, InputError
from lab.files.project.point_files import Observations, Survey, read_observations, read_point_cloud, read_survey
from lab.files.project.project import Cloud, FixedBoard, Project, ProjectScreen
from lab.files.text.csv_text import MAX_SCAN_COORDINATE
from lab.files.text.error_text import suggest_name
from lab.pictures.picture_file import MissingPicture, read_picture
from lab.progress import Progress

START_CORNER_SIGMA_PX = 0.2  # initial value; the adjustment estimates it from the residuals


@dataclass(frozen=True, slots=True)
class BoardViews:
    """Measured board corners, and the boards that are fixed to screens."""

    corners: CornerTerm | None  # None: no board
    placements: tuple[str, ...]  # names of the board placements, indexed by `corners.placement`
    fixed: BoardOnScreenTerm | None
    notes: tuple[str, ...]  # excluded photographs, each with the reason


@dataclass(frozen=True, slots=True)
class _Placement:
    """A board at one place, with its photographs."""

    name: str
    board: Board
    photos: Mapping[str, Path]  # by camera
    board_index: int  # of the physical board
    screen: int = -1  # index of the screen to which the board is fixed; -1: portable
    fixed: FixedBoard | None = None


_Found = list[tuple[_Placement, dict[str, BoardView]]]  # placements with the views of each by camera


def board_views(project: Project, rig: Rig) -> BoardViews:
    """Detect the boards of a project in their photographs.

    A photograph of a portable board without the board is noted and excluded. Raises CalibrationError: if a board that
    is fixed to a screen is not found in its photograph.
    """
    placements = _placements(project)
    notes: list[str] = []
    found: _Found = []
    for placement in placements:
        views = _views(placement, rig, notes)
        if placement.fixed is None and len(views) == 1:
            notes.append(f"{placement.name}: only one camera sees this board: it does not constrain the cameras' poses")
        elif views:
            found.append((placement, views))
    if not found:
        return BoardViews(None, (), None, tuple(notes))
    return BoardViews(_corners(found, rig), tuple(p.name for p, _ in found), _fixed_boards(found), tuple(notes))


def _placements(project: Project) -> list[_Placement]:
    """All placements of a project's boards: portable ones first, then those fixed to screens."""
    out = [
        _Placement(f"boards.{i}.{p}", shared.board, photos, i)
        for i, shared in enumerate(project.boards)
        for p, photos in shared.placements.items()
    ]
    index = len(project.boards)
    for k, (on, screen) in enumerate(project.screens.items()):
        for i, fixed in enumerate(screen.boards):
            name = f"screens.{on}.boards.{i}"
            out.append(_Placement(name, fixed.board, fixed.photos, index, k, fixed))
            index += 1
    return out


def _views(placement: _Placement, rig: Rig, notes: list[str]) -> dict[str, BoardView]:
    """The views of a board by camera. Photographs without the board are noted; for a fixed board they are an error."""
    views = {}
    for camera, path in placement.photos.items():
        view = _view(path, placement.board, rig.cameras[camera].image_size_px)
        if not isinstance(view, str):
            views[camera] = view
        elif placement.fixed is not None:
            raise CalibrationError(f"{path}: {view}; a board that is fixed to a screen must be found")
        else:
            notes.append(f"{path}: {view}")
    return views


def _corners(found: _Found, rig: Rig) -> CornerTerm:
    """The corners of all views, in the order of the placements."""
    cameras = list(rig.cameras)
    pixels, points, from_middle, camera_of, placement_of, board_of, areas = [], [], [], [], [], [], []
    for i, (placement, views) in enumerate(found):
        board = placement.board
        for camera, view in views.items():
            rows = np.searchsorted(board.ids, view.ids)
            pixels.append(view.pixels)
            points.append(board.points[rows])
            from_middle.append(board.points[rows][:, :2] - board.middle[:2])
            camera_of.append(np.full(len(rows), cameras.index(camera)))
            placement_of.append(np.full(len(rows), i))
            board_of.append(np.full(len(rows), placement.board_index))
            areas.append(np.full(len(rows), np.nan) if view.areas_px2 is None else view.areas_px2)
    circles = any(view.areas_px2 is not None for _, views in found for view in views.values())
    return CornerTerm(
        pixels=np.concatenate(pixels),
        points=np.concatenate(points),
        from_middle=np.concatenate(from_middle),
        camera=np.concatenate(camera_of),
        placement=np.concatenate(placement_of),
        board=np.concatenate(board_of),
        sigma_px=np.full(sum(map(len, pixels)), START_CORNER_SIGMA_PX),
        fisheye=fisheye(rig),
        areas_px2=np.concatenate(areas) if circles else None,
    )


def _fixed_boards(found: _Found) -> BoardOnScreenTerm | None:
    """The boards that are fixed to screens; None if there is none."""
    fixed = [(i, p.screen, p.fixed) for i, (p, _) in enumerate(found) if p.fixed is not None]
    if not fixed:
        return None
    return BoardOnScreenTerm(
        screen_of=np.array([k for _, k, _ in fixed], dtype=np.int64),
        placement_of=np.array([i for i, _, _ in fixed], dtype=np.int64),
        middle=np.array([b.board.middle for _, _, b in fixed]),
        offset_m=np.array([b.offset_m for _, _, b in fixed]),
        sigma_m=np.array([b.sigma_m for _, _, b in fixed]),
        tilt_sigma_rad=np.array([b.tilt_sigma_rad for _, _, b in fixed]),
    )


def _view(path: Path, board: Board, size_px: tuple[int, int]) -> BoardView | str:
    """The view of a board in a photograph, or the reason why there is none."""
    picture = read_picture(path, size_px)
    if isinstance(picture, MissingPicture):
        return picture.reason.replace("the rig says", "the camera's calibration says")
    found = find_board(as_8_bit(picture), board)
    return found.reason if isinstance(found, NotFound) else found


# Reads and checks the tables, boards and scans of a calibration project and builds the network to be adjusted.

LARGEST_SCREEN_M = 100.0  # a larger screen is taken for an error of the unit
SMALLEST_SCREEN_M = 0.02
_MAX_EXTENT = 1.3  # extent of the control points relative to the screen's diagonal above which the unit is suspect
_TARGET_SIGMA_M = 0.001  # m: coordinate of a target in a scan, if the project gives no point_sigma_m


@dataclass(frozen=True, slots=True)
class ScreenInputs:
    """Input of the screen adjustment, with notes for the report."""

    network: Network
    setups: tuple[ScreenSetup, ...]  # one per screen
    near: Mapping[int, ApproximatePosition]
    held_screen: int | None  # screen whose frame defines the world frame if there is no survey
    notes: tuple[str, ...]  # assumptions and exclusions, shown as warnings
    remarks: tuple[str, ...] = ()  # properties of the scans


def screen_inputs(project: Project) -> ScreenInputs:
    """Read all measurements of a project's screens.

    Raises InputError: for errors in the files; CalibrationError: if a board that is fixed to a screen is not found.
    """
    survey = read_survey(project.survey, project.screens)
    observations = read_observations(
        project.points, {n: c.lens.image_size_px for n, c in project.cameras.items()}, survey.names
    )
    rig = Rig(
        screens={n: Screen(n, Pose.identity(), s.size_m) for n, s in project.screens.items()},
        cameras={n: replace(c.lens.camera(c.screen), name=n) for n, c in project.cameras.items()},
        beams={},
        spots={},
    )
    screen_of = _screens_of_points(project, survey, observations)
    _check_extent(project, survey, screen_of)
    control_points = ControlPoints(survey.names, survey.xyz, survey.covariance, screen_of)
    cameras, index = list(rig.cameras), {n: i for i, n in enumerate(survey.names)}
    point_observations = PointObservations(
        np.array([cameras.index(c) for c in observations.camera], dtype=np.int64),
        np.array([index[p] for p in observations.point], dtype=np.int64),
        observations.pixels,
        observations.sigma_px,
    )
    boards = board_views(project, rig)
    prior, lens_free = _lens_prior(project, rig)
    network = Network(
        rig=rig,
        control_points=control_points,
        point_observations=point_observations,
        corners=boards.corners,
        placements=boards.placements,
        fixed=boards.fixed,
        lens_priors=() if prior is None else (prior,),
        lens_free=lens_free,
    )
    held = None if len(control_points) and len(point_observations) else _held_screen(project)
    scans = {n: _scan(s.cloud, s, survey, project) for n, s in project.screens.items() if s.cloud is not None}
    setups = tuple(_setup(n, s, survey, project, scans.get(n)) for n, s in project.screens.items())
    near = {
        i: ApproximatePosition(np.array(c.near_m), c.within_m)
        for i, c in enumerate(project.cameras.values())
        if c.near_m is not None
    }
    scan_notes = [note for _, ns in scans.values() for note in ns]
    noted = (*survey.notes, *observations.notes, *boards.notes)
    return ScreenInputs(network, setups, near, held, noted, tuple(scan_notes))


def _screens_of_points(project: Project, survey: Survey, observations: Observations) -> Ints:
    """Screen index (n,) of each control point, -1 for none.

    From the column `screen`; else the screen of the cameras that observe the point, if they share one.
    """
    names = list(project.screens)
    out = np.full(len(survey.names), -1, dtype=np.int64)
    observed_on: dict[str, set[str]] = {}
    for camera, point in zip(observations.camera, observations.point, strict=True):
        observed_on.setdefault(point, set()).add(project.cameras[camera].screen)
    for i, (name, screen) in enumerate(zip(survey.names, survey.screen, strict=True)):
        candidates = observed_on.get(name, set())
        if screen:
            out[i] = names.index(screen)
        elif len(candidates) == 1:
            out[i] = names.index(next(iter(candidates)))
        elif len(names) == 1 and not any(survey.screen):
            out[i] = 0
    return out


def _check_extent(project: Project, survey: Survey, screen_of: Ints) -> None:
    """Raise InputError for a survey in a wrong unit: its extent does not match the screen's size, or any screen."""
    for k, (name, screen) in enumerate(project.screens.items()):
        mine = np.flatnonzero(screen_of == k)
        if len(mine) < 3:
            continue
        where = survey.source[mine[0]]
        xyz = survey.xyz[mine]
        reach = float(np.max(np.linalg.norm(xyz[:, None] - xyz[None], axis=2)))
        if screen.size_m is not None:
            diagonal = float(np.hypot(*screen.size_m))
            if reach > _MAX_EXTENT * diagonal or reach < 0.02 * diagonal:
                # Control points rarely reach the corners: typically they span 50 to 90 % of the diagonal.
                unit = next((u for s in (0.9, 0.7, 0.5) for u in [wrong_unit(reach, s * diagonal)] if u), "")
                hint = f"; {unit}?" if unit else "; check the unit, size_m and which points lie on it"
                raise InputError(
                    f"{where}: the control points of screen {name!r} extend over {reach:.4g} m, its size_m is"
                    f" {screen.size_m[0]:g} m x {screen.size_m[1]:g} m{hint}"
                )
        elif not SMALLEST_SCREEN_M < reach < LARGEST_SCREEN_M:
            raise InputError(
                f"{where}: the control points of screen {name!r} extend over {reach:.4g} m; expected"
                f" {SMALLEST_SCREEN_M:g} to {LARGEST_SCREEN_M:g} m: are they in millimetres? coordinates are in metres"
            )


def _lens_prior(project: Project, rig: Rig) -> tuple[Prior | None, Bools | None]:
    """Prior on the lens parameters from the camera calibrations, and which parameters are free in the adjustment."""
    known = {name: entry.lens.covariance for name, entry in project.cameras.items()}
    joint = independent(
        RigCovariance(tuple(f"cameras.{name}.{p}" for p in c.names), c.matrix) for name, c in known.items() if c
    )
    if not joint.names:
        return None, None
    prior, free = prior_of(rig, joint)
    return prior, free.get("intrinsics")


# Screens ----------------------------------------------------------------------------------------------------------


def _held_screen(project: Project) -> int:
    """Index of the screen whose frame defines the world frame if no surveyed point is observed."""
    names = list(project.screens)
    if project.world is not None:
        return names.index(project.world)
    with_boards = [n for n, s in project.screens.items() if s.boards]
    if not with_boards:
        raise InputError(
            f"{project.path}: no measurement connects the cameras to the screens: expected a survey with `points`, or"
            " boards fixed to screens (`screens.NAME.boards`)"
        )
    return names.index(with_boards[0])


def _setup(
    on: str, entry: ProjectScreen, survey: Survey, project: Project, scan: tuple[Scan, list[str]] | None
) -> ScreenSetup:
    control_points = None
    if entry.frame is not None:
        for key in ("origin", "x", "y"):
            name = getattr(entry.frame, key)
            if name not in survey.names:
                raise InputError(
                    f"{project.path}: screens.{on}.frame.{key}: expected a point of the survey, got {name!r}"
                    f"{suggest_name(name, survey.names)}"[:240]
                )
        control_points = tuple(survey.names.index(getattr(entry.frame, k)) for k in ("origin", "x", "y"))
    return ScreenSetup(
        frame_points=None if control_points is None else (control_points[0], control_points[1], control_points[2]),
        origin_at=(0.0, 0.0) if entry.frame is None else entry.frame.origin_at_m,
        bow=entry.bow,
        scatter_m=entry.surface_sigma_m,
        scan=None if scan is None else scan[0],
    )


def _scan(cloud: Cloud, entry: ProjectScreen, survey: Survey, project: Project) -> tuple[Scan, list[str]]:
    """The scan of a screen in the world frame, and notes on it."""
    pose, covariance = None if cloud.world_from_cloud is None else cloud.world_from_cloud.pose(), None
    try:
        points, words = _points(cloud)
        if cloud.targets is not None:
            targets = read_survey([cloud.targets], project.screens, MAX_SCAN_COORDINATE)
            both = [n for n in targets.names if n in survey.names]
            a = [targets.names.index(n) for n in both]
            b = [survey.names.index(n) for n in both]
            sigma = cloud.point_sigma_m or _TARGET_SIGMA_M
            at, note = _in_metres(targets.xyz[a], survey.xyz[b], cloud)
            words += note
            found = register(both, at, survey.xyz[b], survey.covariance[b], sigma)
            pose, covariance = found.world_from_cloud, found.covariance
            misses = 1e3 * float(np.sqrt(np.mean(np.sum(found.residuals_m**2, axis=1))))
            words.append(f"{cloud.path.name}: {len(both)} targets fit the survey to {misses:.2g} mm RMS")
        scan = scan_of(points, entry.size_m, cloud.point_sigma_m, entry.bow, pose, covariance)
    except MissingOpen3DError as error:
        raise InputError(f"{cloud.path}: {error}") from None
    except ValueError as error:
        raise InputError(f"{cloud.path}: {error}") from None
    return scan, [*words, f"{cloud.path.name}: {scan.words}"]


def _in_metres(targets: Array, survey: Array, cloud: Cloud) -> tuple[Array, list[str]]:
    """Targets of a scan (n, 3), m, and a note where the file has them in the unit of the scan.

    survey (n, 3), m: the same points. A factor of 10 and more between the two units shows which one fits.
    """

    def misfit(unit_m: float) -> float:
        sizes = [np.linalg.norm(xyz - xyz.mean(axis=0)) for xyz in (targets * unit_m, survey)]
        return float(abs(np.log(sizes[0] / sizes[1]))) if min(sizes) > 0 else 0.0

    if cloud.unit_m == 1.0 or not len(targets) or misfit(1.0) <= misfit(cloud.unit_m):
        return targets, []
    note = f"{cloud.targets}: x_m, y_m, z_m are in the unit of the scan ({cloud.unit_m:g} m), not in metres: converted"
    return targets * cloud.unit_m, [note]


def _points(cloud: Cloud) -> tuple[Array, list[str]]:
    """The points (n, 3), m, of all scans of a cloud that lie on surfaces, in the frame of the first; and notes.

    Raises InputError: a scan cannot be read, or a further one cannot be aligned with the first; MissingOpen3DError:
    Open3D cannot be loaded.
    """
    scans: list[Array] = []
    words: list[str] = []
    for path in (cloud.path, *cloud.also):
        points, notes = read_point_cloud(path, cloud.unit_m)
        words += notes
        if len(points) >= FEWEST:
            kept = on_surfaces(points)
            if not kept.all():
                words.append(f"{path.name}: {np.sum(~kept)} of {len(points)} points left out: far from all others")
            points = points[kept]
        if scans:
            try:
                found = align(points, scans[0])
            except ValueError as error:
                raise InputError(f"{path}: {error}") from None
            points = found.fixed_from_moving.apply(points)
            words.append(
                f"{path.name}: aligned with {cloud.path.name} with a scatter of {1e3 * found.sigma_m:.2g} mm;"
                f" {100 * found.overlap:.0f} % of it overlaps"
            )
        scans.append(points)
    return np.concatenate(scans), words


# Checks of a survey: swapped axes, wrong units, cameras far from their `near_m`, points that are not on their screen.
#
# The pixels alone cannot detect a rotated or mirrored world frame; `calibrate screen` and `calibrate rig` start here.


_SUSPICIOUS_MISFIT = 4.0  # of calibration/screens/screens.py: above it, swapped axes and wrong units are tested
_ACCEPTED_MISFIT = 2.0  # misfit below which a change to the survey is accepted as the explanation


def adjusted_screens(project: Project, inputs: ScreenInputs, progress: Progress | None = None) -> FittedScreens:
    """Adjust cameras and screens to the survey; if they do not fit, find the mistake in the survey.

    progress: called with the number of changes to the survey that have been tried, and of all. Raises InputError: for a
    survey that fits with other axes, signs or units, or parts without common measurements; CalibrationError: if the
    measurements do not determine a calibration.
    """
    where = ", ".join(str(p) for p in project.survey) or str(project.path)
    problem: Exception | None = None
    misfit = float("inf")
    try:
        result = calibrate(inputs.network, inputs.setups, inputs.near, inputs.held_screen)
        misfit = misfit_of(result, inputs.near)
    except (NotConnectedError, AdjustmentError, ValueError) as error:
        problem = error
    enough = len(inputs.network.point_observations) >= 4
    if enough and misfit > _SUSPICIOUS_MISFIT and not _too_few_points(problem):
        changes = diagnose_survey(inputs.network, inputs.setups, inputs.near, inputs.held_screen, misfit, progress)
        explanations = [c for c in changes if c.factor < _ACCEPTED_MISFIT]
        if explanations:
            raise InputError(_explained(where, explanations))
    if isinstance(problem, AdjustmentError):
        raise CalibrationError(f"{project.path}: the measurements do not determine a calibration: {problem}") from None
    if problem is not None:
        raise InputError(f"{where}: {problem}") from None
    return result


def _too_few_points(problem: Exception | None) -> bool:
    """Whether a camera or a screen has too few control points, which no change of axes or unit can correct."""
    text = str(problem or "")
    return any(words in text for words in ("expected 4 or more", "expected 3 or more", "on one line", "found none"))


def _explained(where: str, explanations: Sequence[SurveyError]) -> str:
    """The message that names the change with which the survey fits."""
    best = explanations[0]
    others = [c for c in explanations[1:] if c.factor < 1.2 * best.factor]
    text = f"{where}: does not fit the pixels as it is, but {best.words} does"
    if others:
        text += (
            f" (so do {len(others)} other changes, such as {others[0].words}: a mirrored survey fits the same with any"
            " two axes swapped; give a camera's position as `near_m` to distinguish them)"
        )
    return f"{text}; correct the file"
