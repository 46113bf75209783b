"""Detection of ChArUco boards, also inverted, legacy and partly hidden ones, and the reasons for a failure."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from calibration.boards import corner_refinement
from calibration.boards.board_types import DICTIONARIES, Charuco, dictionary_size
from calibration.boards.board_view import (
    QUICK_SEARCH_FAILED,
    BoardView,
    GreyImage,
    NotFound,
    if_sharp,
    low_contrast,
    scaled,
    scales,
)
from calibration.boards.grid_shape import straightened
from geometry.arrays import Array, Ints

_FEWEST = 6  # corners that do not all lie on one line: fewer do not contribute to the lens
_FEWEST_REPEATED = 3  # markers that occur twice: so many by chance, where others resemble them
_FITS = 0.7  # share of the markers at their places on the board; of a wrong board at most half are
_LARGEST = (  # one dictionary of each family; the others consist of its first markers
    "DICT_4X4_1000",
    "DICT_5X5_1000",
    "DICT_6X6_1000",
    "DICT_7X7_1000",
    "DICT_ARUCO_ORIGINAL",
    "DICT_APRILTAG_16h5",
    "DICT_APRILTAG_25h9",
    "DICT_APRILTAG_36h10",
    "DICT_APRILTAG_36h11",
    "DICT_ARUCO_MIP_36h12",
)


@dataclass(frozen=True, slots=True)
class Markers:
    """Markers of one dictionary in a picture."""

    ids: Ints  # (n,)
    corners: Array  # (n, 4, 2), px, clockwise from the marker's top left
    repeated: int = 0  # further numbers, which occur more than once in the picture

    def two_boards(self) -> NotFound | None:
        """The rejection of a picture in which most markers occur more than once."""
        if self.repeated <= max(len(self.ids), _FEWEST_REPEATED):
            return None
        return NotFound(
            f"{self.repeated} markers occur more than once: two boards of this kind are in the picture; cover one"
        )


def find_charuco(image: GreyImage, board: Charuco, thorough: bool = True) -> BoardView | NotFound:
    """The visible inner corners, or the reason why there are too few. A part of the board is sufficient.

    thorough: if False, the reason for missing markers is not determined.
    """
    printed, markers = _as_printed(image, board)
    if len(markers.ids) == 0:
        return markers.two_boards() or (_why_no_markers(image, board) if thorough else QUICK_SEARCH_FAILED)
    true, share = _fitting(board, markers, (image.shape[1], image.shape[0]))
    if isinstance(true, NotFound):
        return markers.two_boards() or _mirrored(image, board, len(markers.ids)) or true
    notes = []
    if printed != board.inverted:
        notes.append(
            "the board is inverted (white markers)" if printed else "the board is not inverted (black markers)"
        )
    if true.legacy != board.legacy:
        notes.append(f"the board has OpenCV's {'older pattern (legacy)' if true.legacy else 'pattern since 4.6'}")
    if share is not None and abs(share - board.marker_m / board.square_m) > 0.08:
        notes.append(
            f"markers measure {share:.2f} of a square, according to the text {board.marker_m / board.square_m:.2f}"
        )
        true = replace(true, marker_m=share * true.square_m)
    found = _corners(255 - image if printed else image, true, markers, tuple(notes))
    return found if isinstance(found, BoardView) else markers.two_boards() or found


def _as_printed(image: GreyImage, board: Charuco) -> tuple[bool, Markers]:
    """Whether the board has white markers, and the markers found: as stated, unless more are found the other way."""
    stated = find_markers(255 - image if board.inverted else image, board.dictionary, board.markers)
    if len(stated.ids) >= 4:
        return board.inverted, stated
    other = find_markers(image if board.inverted else 255 - image, board.dictionary, board.markers)
    if len(other.ids) + other.repeated > len(stated.ids) + stated.repeated:
        return not board.inverted, other
    return board.inverted, stated


def find_markers(image: GreyImage, dictionary: str, below: int | None = None) -> Markers:
    """Black markers of a dictionary that occur once in the picture, with numbers under `below` only."""
    parameters = cv2.aruco.DetectorParameters()
    # Of 120 markers of 24 px with a blur of 1 to 1.5 px, 113 are read with these two, 99 with OpenCV's 4 and 0.13.
    parameters.perspectiveRemovePixelPerCell = 10
    parameters.perspectiveRemoveIgnoredMarginPerCell = 0.25
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(DICTIONARIES[dictionary]), parameters)
    corners, ids, _ = detector.detectMarkers(image)
    if ids is None or len(ids) == 0:
        return Markers(np.empty(0, dtype=np.int64), np.empty((0, 4, 2)))
    numbers = np.asarray(ids, dtype=np.int64).ravel()
    places = np.asarray(corners, dtype=float).reshape(-1, 4, 2)
    numbers, first, counts = np.unique(numbers, return_index=True, return_counts=True)
    known = numbers < (below if below is not None else 1 << 30)
    keep = known & (counts == 1)
    return Markers(numbers[keep], places[first[keep]], int(np.sum(known & (counts > 1))))


def _fitting(
    board: Charuco, markers: Markers, image_size_px: tuple[int, int]
) -> tuple[Charuco | NotFound, float | None]:
    """The board with the pattern (current or legacy) that the markers fit, and the side of a marker over a square's.

    A few markers that do not fit the board are mostly false: bookshelves sometimes resemble 4x4 bits.
    """
    if len(markers.ids) < 2:
        return NotFound(f"only one marker of {board.dictionary} found: the board is mostly hidden, or absent"), None
    stated = _fit(board, markers, image_size_px)
    if stated.share >= _FITS:
        return board, stated.marker_over_square
    other = replace(board, legacy=not board.legacy)
    fit = _fit(other, markers, image_size_px)
    if fit.share >= _FITS:
        return other, fit.marker_over_square
    if len(markers.ids) < 4:
        return NotFound(f"no board: {len(markers.ids)} shapes resemble its markers but are not arranged as on it"), None
    words = f"{len(markers.ids)} markers of {board.dictionary} were found but are not arranged as on this board"
    if board.columns != board.rows:
        for legacy in (False, True):
            turned = replace(board, columns=board.rows, rows=board.columns, legacy=legacy)
            if _fit(turned, markers, image_size_px).share >= _FITS:
                return NotFound(f"{words}: they fit {turned.columns}x{turned.rows} squares; exchange the two"), None
    return NotFound(f"{words}; check the number of columns and rows of squares"), None


@dataclass(frozen=True, slots=True)
class _Fit:
    share: float  # of the markers that are at their places on the board
    marker_over_square: float | None


def _fit(board: Charuco, markers: Markers, image_size_px: tuple[int, int]) -> _Fit:
    """How well markers fit a board, for the best of lenses from a pinhole to a fisheye of 180 deg."""
    best = _Fit(0.0, None)
    for plane in straightened(markers.corners.reshape(-1, 2), image_size_px):
        fit = _fit_by_pinhole(board, Markers(markers.ids, plane.reshape(-1, 4, 2)))
        best = fit if fit.share > best.share else best
        if best.share >= _FITS:
            break
    return best


def _fit_by_pinhole(board: Charuco, markers: Markers) -> _Fit:
    """By a RANSAC homography of their centres, with a tolerance of 0.3 squares.

    Centres do not depend on the size of the markers.
    """
    squares, corners = _marker_places(board)
    known = markers.ids < len(squares)
    if known.sum() < 2:
        return _Fit(0.0, None)
    seen, on_board = markers.corners[known], squares[markers.ids[known]]
    if known.sum() < 4:  # few centres fit any board, so that the corners are used
        from_px, to = seen.reshape(-1, 2), (on_board[:, None] + corners).reshape(-1, 2)
    else:
        from_px, to = seen.mean(axis=1), on_board
    found, _ = cv2.findHomography(from_px, to, cv2.RANSAC, 0.3)
    if found is None:
        return _Fit(0.0, None)
    H = np.asarray(found, dtype=float)
    centres = _mapped(H, seen.mean(axis=1))
    good = np.linalg.norm(centres - on_board, axis=1) < 0.3
    share = float(good.sum() / max(len(markers.ids), 1))
    if good.sum() < 2:
        return _Fit(0.0, None)
    shape = _mapped(H, seen[good].reshape(-1, 2)).reshape(-1, 4, 2)
    # The corners must be in the board's sense of rotation; a mirrored numbering has another homography.
    way = shape - shape.mean(axis=1, keepdims=True)
    agree = np.sum(way * corners, axis=(1, 2)) / (np.linalg.norm(way, axis=(1, 2)) * np.linalg.norm(corners))
    sides = np.linalg.norm(np.roll(shape, -1, axis=1) - shape, axis=-1)
    return _Fit(share * float(np.mean(agree > 0.8)), float(np.median(sides)))


def _marker_places(board: Charuco) -> tuple[Array, Array]:
    """Centres (markers, 2) in squares from the outer corner, and the corners (4, 2) of a marker about its centre."""
    known = _cv_board(board)
    places = np.array([np.asarray(p).reshape(4, 3)[:, :2] for p in known.getObjPoints()]) / board.square_m
    centres = places.mean(axis=1)
    return centres, places[0] - centres[0]


def _cv_board(board: Charuco) -> cv2.aruco.CharucoBoard:
    dictionary = cv2.aruco.getPredefinedDictionary(DICTIONARIES[board.dictionary])
    made = cv2.aruco.CharucoBoard((board.columns, board.rows), board.square_m, board.marker_m, dictionary)
    made.setLegacyPattern(board.legacy)
    return made


def _corners(image: GreyImage, board: Charuco, markers: Markers, notes: tuple[str, ...]) -> BoardView | NotFound:
    detector = cv2.aruco.CharucoDetector(_cv_board(board))
    corners, ids, _, _ = detector.detectBoard(
        image,
        markerCorners=[c.reshape(1, 4, 2).astype(np.float32) for c in markers.corners],
        markerIds=markers.ids.reshape(-1, 1).astype(np.int32),
    )
    columns, rows = board.columns - 1, board.rows - 1
    grid = np.full((rows, columns, 2), np.nan)
    if ids is not None and len(ids):
        grid.reshape(-1, 2)[np.asarray(ids).ravel()] = np.asarray(corners, dtype=float).reshape(-1, 2)
    # The window must not include the markers, at a distance of (square - marker) / 2 from the corner. Measured with
    # markers of 0.5, 0.7 and 0.8 squares: 1.3 times that distance gives 2 to 20 times the error, 0.8 times up to 1.3.
    reach = min(0.4, (1 - board.marker_m / board.square_m) / 2)
    fine = corner_refinement.refined(image, grid, np.isfinite(grid).all(axis=-1), reach)
    seen = np.isfinite(fine.pixels).all(axis=-1).ravel()
    places = board.points[seen, :2] / board.square_m
    if seen.sum() < _FEWEST or np.linalg.matrix_rank(places - places.mean(axis=0), tol=0.1) < 2:
        return NotFound(
            f"only {seen.sum()} of {columns * rows} corners found, {_FEWEST} that span an area are needed: the board is"
            " mostly hidden or outside the picture, too far away, blurred, or absent"
        )
    apart = corner_refinement.spacing(fine.pixels)
    pixels, sigmas = fine.pixels.reshape(-1, 2)[seen], fine.sigmas_px.ravel()[seen]
    return if_sharp(BoardView(board.ids[seen], pixels, apart, fine.blur_px, notes, sigmas_px=sigmas))


def _mirrored(image: GreyImage, board: Charuco, seen: int) -> NotFound | None:
    """The rejection of a mirrored picture: its mirror image shows many more of the board's markers than `seen`.

    Some mirrored markers of 4x4 bits resemble others: of 37 to 49 markers up to 4 did in rendered photographs.
    """
    for shown in (image, 255 - image):
        flipped = np.ascontiguousarray(shown[:, ::-1])
        if len(find_markers(flipped, board.dictionary, board.markers).ids) >= max(3, 3 * seen):
            return NotFound("the picture is mirrored: switch off the mirroring of the camera or its software")
    return None


def _why_no_markers(image: GreyImage, board: Charuco) -> NotFound:
    pale = low_contrast(image)
    if pale is not None:
        return pale
    mirrored = _mirrored(image, board, 0)
    if mirrored is not None:
        return mirrored
    best, name, most = 0, "", 0
    small = scaled(image, next((s for s in scales(image) if s * max(image.shape) <= 1000), 1.0))
    for shown in (small, 255 - small):
        for other in _LARGEST:
            found = find_markers(shown, other)
            if len(found.ids) > best:
                best, name, most = len(found.ids), other, int(found.ids.max())
    if best >= 4 and name.rsplit("_", 1)[0] == board.dictionary.rsplit("_", 1)[0]:
        return NotFound(
            f"{best} markers of this dictionary with numbers up to {most}, but none of this board's 0 to"
            f" {board.markers - 1}: another board, or more columns and rows than stated"
        )
    if best >= 4:
        return NotFound(
            f"no markers of {board.dictionary} with numbers below {board.markers}, but {best} of"
            f" {_smallest(name, most)} with numbers up to {most}; check the dictionary"
        )
    for scale in scales(image)[1:]:
        if len(find_markers(scaled(image, scale), board.dictionary, board.markers).ids) >= 3:
            return NotFound("too blurred for reading markers; focus, hold the board still or use a shorter exposure")
    return NotFound(f"no marker of {board.dictionary} found: no board, or it is too far away, blurred or in glare")


def _mapped(H: Array, xy: Array) -> Array:
    """H applied to points (..., 2)."""
    p = xy @ H[:, :2].T + H[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):  # a wrong board can have points at infinity
        return np.asarray(p[..., :2] / p[..., 2:], dtype=float)


def _smallest(name: str, number: int) -> str:
    """The smallest dictionary of the same family that contains this marker."""
    family = [n for n in DICTIONARIES if n.rsplit("_", 1)[0] == name.rsplit("_", 1)[0]]
    enough = [n for n in family if dictionary_size(n) > number]
    return min(enough, key=dictionary_size) if name.endswith("_1000") and enough else name
