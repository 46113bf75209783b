"""Boards of a calibration project: carried about or fixed to a screen, found in their photographs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calibration.boards.board_detection import BoardView, NotFound, find_board
from calibration.boards.board_types import Board
from calibration.terms.board_on_screen import BoardOnScreenTerm
from calibration.terms.circle_images import radius_by_areas
from calibration.terms.corners import CornerTerm
from geometry.arrays import Array, Bools
from geometry.camera import FISHEYE
from geometry.rig import Rig
from lab.calibrate.camera.photos import as_8_bit
from lab.errors import CalibrationError
from lab.files.project.project_types import FixedBoard, Project
from lab.pictures.picture_file import Missing, read_picture

START_CORNER_SIGMA_PX = 0.2  # until their residuals say better


@dataclass(frozen=True, slots=True)
class BoardViews:
    """The corners that cameras saw, and which of the boards lie on screens."""

    corners: CornerTerm | None  # None: no board
    placements: tuple[str, ...]  # the boards' places by name, as the corners count them
    fixed: BoardOnScreenTerm | None
    photo_of: Mapping[tuple[int, int], Path]  # (camera, placement) -> photograph
    notes: tuple[str, ...]  # photographs that were left out, and why
    radii_m: Array | None = None  # (boards,): of the circles of each, 0 for boards of corners; None: no circles


def board_views(project: Project, rig: Rig) -> BoardViews:
    """Corners of all boards of a project in their photographs.

    A photograph without its board is noted and left out; CalibrationError where it is of a board fixed to a screen.
    """
    places: list[tuple[str, Board, Mapping[str, Path], int]] = []  # name, board, photos, which physical board
    for i, shared in enumerate(project.boards):
        places += [(f"boards.{i}.{p}", shared.board, photos, i) for p, photos in shared.photos.items()]
    carried, physical = len(places), len(project.boards)
    fixed_rows: list[tuple[int, int, FixedBoard]] = []
    for k, screen in enumerate(project.screens.values()):
        for i, lying in enumerate(screen.boards):
            fixed_rows.append((len(places), k, lying))
            places.append((f"screens.{screen.name}.boards.{i}", lying.board, lying.photos, physical))
            physical += 1
    cameras = list(rig.cameras)
    pixels, points, middle, camera_of, placement_of, board_of = [], [], [], [], [], []
    photo_of: dict[tuple[int, int], Path] = {}
    notes: list[str] = []
    used: list[int] = []
    radii: dict[int, list[float]] = {}
    for p, (name, board, photos, which) in enumerate(places):
        views = {}
        for camera, path in photos.items():
            view = _view(path, board, rig.cameras[camera].image_size_px)
            if isinstance(view, str):
                if p >= carried:
                    raise CalibrationError(f"{path}: {view}; a board that is fixed to a screen must be found")
                notes.append(f"{path}: {view}")
            else:
                views[camera] = view
        if not views or (p < carried and len(views) < 2):
            if views:
                notes.append(f"{name}: only one camera shows this board: it says nothing of the cameras' places")
            continue
        for camera, view in views.items():
            ids, found = view.ids, view.pixels
            rows = np.searchsorted(board.ids, ids)
            pixels.append(found)
            if view.areas_px2 is not None:
                seen_radius = radius_by_areas(board.points[rows][:, :2], found, view.areas_px2, rig.cameras[camera])
                radii.setdefault(which, []).append(seen_radius)
            points.append(board.points[rows])
            middle.append(board.points[rows][:, :2] - board.middle[:2])
            camera_of.append(np.full(len(ids), cameras.index(camera)))
            placement_of.append(np.full(len(ids), len(used)))
            board_of.append(np.full(len(ids), which))
            photo_of[cameras.index(camera), len(used)] = photos[camera]
        used.append(p)
    if not used:
        return BoardViews(None, (), None, photo_of, tuple(notes))
    corners = CornerTerm(
        pixels=np.concatenate(pixels),
        points=np.concatenate(points),
        from_middle=np.concatenate(middle),
        camera=np.concatenate(camera_of),
        placement=np.concatenate(placement_of),
        board=np.concatenate(board_of),
        sigma_px=np.full(sum(map(len, pixels)), START_CORNER_SIGMA_PX),
        fisheye=_fisheye(rig),
    )
    fixed = None
    if fixed_rows:
        fixed = BoardOnScreenTerm(
            screen_of=np.array([k for _, k, _ in fixed_rows], dtype=np.int64),
            placement_of=np.array([used.index(p) for p, _, _ in fixed_rows], dtype=np.int64),
            middle=np.array([b.board.middle for _, _, b in fixed_rows]),
            offset_m=np.array([b.offset_m for _, _, b in fixed_rows]),
            sigma_m=np.array([b.sigma_m for _, _, b in fixed_rows]),
            tilt_sigma_rad=np.array([b.tilt_sigma_rad for _, _, b in fixed_rows]),
        )
    of_boards = np.array([float(np.median(radii.get(b, [0.0]))) for b in range(physical)]) if radii else None
    return BoardViews(corners, tuple(places[p][0] for p in used), fixed, photo_of, tuple(notes), of_boards)


def _fisheye(rig: Rig) -> Bools:
    return np.array([c.lens == FISHEYE for c in rig.cameras.values()], dtype=bool)


def _view(path: Path, board: Board, size_px: tuple[int, int]) -> BoardView | str:
    """A board's points in a photograph, or why there are none."""
    picture = read_picture(path, size_px)
    if isinstance(picture, Missing):
        return picture.reason.replace("the rig says", "the camera's calibration says")
    found = find_board(as_8_bit(picture), board)
    return found.reason if isinstance(found, NotFound) else found
