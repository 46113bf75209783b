"""Corners of the boards of a calibration project, both portable boards and boards fixed to a screen."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calibration.boards.board_detection import find_board
from calibration.boards.board_types import Board
from calibration.boards.board_view import BoardView, NotFound
from calibration.terms.board_on_screen import BoardOnScreenTerm
from calibration.terms.circle_images import radius_by_areas
from calibration.terms.corners import CornerTerm
from geometry.arrays import Array, Bools
from geometry.camera import FISHEYE
from geometry.rig import Rig
from lab.calibrate.camera.photos import as_8_bit
from lab.errors import CalibrationError
from lab.files.project.project import FixedBoard, Project
from lab.pictures.picture_file import MissingPicture, read_picture

START_CORNER_SIGMA_PX = 0.2  # initial value; the adjustment estimates it from the residuals


@dataclass(frozen=True, slots=True)
class BoardViews:
    """Measured board corners, and the boards that are fixed to screens."""

    corners: CornerTerm | None  # None: no board
    placements: tuple[str, ...]  # names of the board placements, indexed by `corners.placement`
    fixed: BoardOnScreenTerm | None
    photo_of: Mapping[tuple[int, int], Path]  # (camera, placement) -> photograph
    notes: tuple[str, ...]  # excluded photographs, each with the reason
    radii_m: Array | None = None  # (boards,) radius of each board's circles, 0 for other boards; None: no circles


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

    A photograph of a portable board without the board is noted and excluded.

    Raises:
        CalibrationError: if a board that is fixed to a screen is not found in its photograph.
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
        return BoardViews(None, (), None, {}, tuple(notes))
    cameras = list(rig.cameras)
    photo_of = {(cameras.index(c), i): p.photos[c] for i, (p, views) in enumerate(found) for c in views}
    n_boards = len(project.boards) + sum(p.fixed is not None for p in placements)
    return BoardViews(
        _corners(found, rig),
        tuple(p.name for p, _ in found),
        _fixed_boards(found),
        photo_of,
        tuple(notes),
        _radii(found, rig, n_boards),
    )


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
    pixels, points, from_middle, camera_of, placement_of, board_of = [], [], [], [], [], []
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
    return CornerTerm(
        pixels=np.concatenate(pixels),
        points=np.concatenate(points),
        from_middle=np.concatenate(from_middle),
        camera=np.concatenate(camera_of),
        placement=np.concatenate(placement_of),
        board=np.concatenate(board_of),
        sigma_px=np.full(sum(map(len, pixels)), START_CORNER_SIGMA_PX),
        fisheye=_fisheye(rig),
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


def _radii(found: _Found, rig: Rig, n_boards: int) -> Array | None:
    """Radius (n_boards,), m, of each board's circles, the median over its views; None if no board has circles."""
    radii: dict[int, list[float]] = {}
    for placement, views in found:
        for camera, view in views.items():
            if view.areas_px2 is not None:
                xy = placement.board.points[np.searchsorted(placement.board.ids, view.ids)][:, :2]
                radius = radius_by_areas(xy, view.pixels, view.areas_px2, rig.cameras[camera])
                radii.setdefault(placement.board_index, []).append(radius)
    return np.array([float(np.median(radii.get(b, [0.0]))) for b in range(n_boards)]) if radii else None


def _fisheye(rig: Rig) -> Bools:
    return np.array([c.lens == FISHEYE for c in rig.cameras.values()], dtype=bool)


def _view(path: Path, board: Board, size_px: tuple[int, int]) -> BoardView | str:
    """The view of a board in a photograph, or the reason why there is none."""
    picture = read_picture(path, size_px)
    if isinstance(picture, MissingPicture):
        return picture.reason.replace("the rig says", "the camera's calibration says")
    found = find_board(as_8_bit(picture), board)
    return found.reason if isinstance(found, NotFound) else found
