"""Photographs of a calibration board from files, folders, patterns and videos; a few pictures are in memory at a time.

Tables of board corners that another program found: mrcal's corners.vnl, or a CSV file.
"""

from __future__ import annotations

import hashlib
import re
from collections import Counter, deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from calibration.boards.board_detection import find_board
from calibration.boards.board_types import Board, Chessboard
from calibration.boards.board_view import QUICK_SEARCH_FAILED, BoardView, GreyImage, NotFound
from geometry.arrays import Array, Ints
from lab.errors import InputError
from lab.files.text.csv_text import read_table
from lab.files.text.json_text import text_of_file
from lab.number_format import format_number
from lab.pictures import source
from lab.pictures.picture_file import PICTURE_SUFFIXES, UNREADABLE, GreyPicture, MissingPicture, read_picture
from lab.pictures.source import matching_files, pictures, pictures_in, video_at
from lab.progress import Progress

VIDEO_SUFFIXES = (".mp4", ".avi", ".mov", ".mkv", ".m4v", ".webm")
_SUFFIXES, _EXPECTED = PICTURE_SUFFIXES + VIDEO_SUFFIXES, "a picture, a folder or a pattern"
VIDEO_PICTURES = 120  # largest number of frames used of one video, evenly spaced: neighbouring frames differ little
_MAX_NAMES = 3  # file names shown in an error message
# Number of pictures without the board that get the thorough search, which takes seconds, while no picture has shown the
# board. After that the quick search is used until a picture shows it: a wrong type or dictionary fails in all pictures.
_THOROUGH_SEARCHES = 2
# Number of pictures without the board that get the thorough search once a board has been found, except for chessboards.
# For the other types the quick search misses no board; it only gives no reason, and three reasons are enough: ten took
# two thirds of the time of a video.
_REASONS = 3
_DUPLICATE = "the same picture as "
# RMS difference of their points below which two pictures count as one, however they were saved: copies of real
# photographs with JPEG qualities of 95 to 20 or more noise differ by .001 to .07 px, successive frames of moved boards
# by 1.4 px. Also pictures of a board at rest, whose errors, except the picture's noise, are the same each time.
_SAME_PX = 0.2


@dataclass(frozen=True, slots=True)
class PhotoSet:
    """Views of a board in the photographs of one camera."""

    board: Board
    image_size_px: tuple[int, int]  # width, height, of every picture that is used
    views: tuple[tuple[str, BoardView], ...]  # picture name and view, in the order of the pictures
    refused: tuple[tuple[str, str], ...]  # picture name and reason
    paths: dict[str, Path]  # file of each picture name (for a frame, the video's path)

    def line(self) -> str:
        """One line for the terminal, with the most frequent reason if pictures were refused."""
        total = len(self.views) + len(self.refused)
        text = f"{self.board.describe()}: found in {len(self.views)} of {total} pictures"
        return text + (f"; {most_frequent_reason(self.refused)}" if self.refused else "")


def load_photos(paths: Iterable[Path | str]) -> tuple[Path, ...]:
    """Picture and video files named by files, folders and patterns (`shots/*.png`), each once, in natural order.

    Raises InputError: if a path matches no file, or no path is given.
    """
    found: list[Path] = []
    for path in map(Path, paths):
        files = pictures_in(path, _SUFFIXES) if path.is_dir() else matching_files(path, _EXPECTED, _SUFFIXES)
        found += sorted(files, key=_natural)
    unique = tuple({path.resolve(): path for path in found}.values())
    if not unique:
        raise InputError("no pictures given; name picture files, a folder of them or a pattern such as shots/*.png")
    return unique


def _natural(path: Path) -> tuple[str, list[tuple[int, str]]]:
    """Sort key in natural order: shot-2 before shot-10."""
    parts = re.split(r"(\d+)", path.name)
    return str(path.parent), [(int(p), "") if p.isdigit() else (-1, p.lower()) for p in parts]


def find_in_photos(
    paths: Iterable[Path | str], board: Board, progress: Progress | None = None, fewest: int = 3
) -> PhotoSet:
    """Detect a board in every photograph; a few are searched at a time.

    Raises InputError: if no picture can be read, no size is that of most pictures, or fewer than `fewest` pictures of
    that size show the board.
    """
    files = load_photos(paths)
    names = _names(files)
    total = sum(_frame_count(path) for path in files)
    path_of: dict[str, Path] = {}
    sizes: dict[tuple[int, int], list[str]] = {}
    first_of: dict[bytes, str] = {}
    with _Search(board) as found:
        for done, (name, path, picture) in enumerate(_pictures(files, names), 1):
            path_of[name] = path
            if isinstance(picture, MissingPicture):
                found.refused.append((name, picture.reason))
            else:
                sizes.setdefault((picture.shape[1], picture.shape[0]), []).append(name)
                original = first_of.setdefault(hashlib.sha256(picture.tobytes()).digest(), name)
                if original != name:
                    found.refused.append((name, f"{_DUPLICATE}{original}: it would count twice"))
                else:
                    found.search(name, picture)
            if progress is not None:
                progress(done, max(total, done), name)
        found.settle()
        if not sizes:
            raise InputError(
                f"none of {len(found.refused)} pictures can be read; {most_frequent_reason(found.refused)}"
            )
        size = _usual_size(sizes)
        found.leave_out({name: made for made, names in sizes.items() if made != size for name in names}, size)
        quick = set(found.quick)
        if found.views and quick and isinstance(board, Chessboard):  # some show the board: search them thoroughly too
            found.quick.clear()
            for name, _, picture in _pictures(files, names):
                if name in quick and not isinstance(picture, MissingPicture):
                    found.search(name, picture)
            found.settle()
    order = {name: k for k, name in enumerate(path_of)}
    views = sorted(found.views, key=lambda view: order[view[0]])
    copies = _copies(views, board)
    views = [view for view in views if view[0] not in copies]
    refused = [*found.refused, *copies.items(), *((name, QUICK_SEARCH_FAILED.reason) for name in found.quick)]
    refused.sort(key=lambda item: order[item[0]])
    _refuse_too_few(views, refused, board, fewest)
    return PhotoSet(board, size, tuple(views), tuple(refused), path_of)


def _copies(views: Sequence[tuple[str, BoardView]], board: Board) -> dict[str, str]:
    """Names of the views that are copies of earlier ones, with the reason."""
    out: dict[str, str] = {}
    pixels = np.full((len(views), len(board.ids), 2), np.nan)
    for k, (name, view) in enumerate(views):
        own = np.searchsorted(board.ids, view.ids)
        squares = (pixels[:k, own] - view.pixels) ** 2
        common = np.isfinite(squares[..., 0])
        apart = np.sqrt(np.nansum(squares, axis=(1, 2)) / np.maximum(2 * common.sum(axis=1), 1))
        apart[common.mean(axis=1) < 0.5] = np.inf  # most of its points are not those of the other
        if k and apart.min() < _SAME_PX:
            original, px = views[int(apart.argmin())][0], format_number(apart.min(), 1)
            out[name] = f"{_DUPLICATE}{original}, points within {px} px: it would count twice"
        else:
            pixels[k, own] = view.pixels
    return out


@dataclass(slots=True)
class _Search:
    """Searches for a board in photographs, some at a time. Used as a context manager. Results are those of one by one.

    OpenCV's own threads would search one photograph a sixth faster, with a quarter more of process time.
    """

    board: Board
    views: list[tuple[str, BoardView]] = field(default_factory=list)
    refused: list[tuple[str, str]] = field(default_factory=list)
    quick: list[str] = field(default_factory=list)  # pictures without a board after the quick search alone
    _without: int = 0  # pictures without a board after the thorough search
    _waiting: deque[tuple[str, GreyImage, bool, Future[BoardView | NotFound]]] = field(default_factory=deque)
    _pool: ThreadPoolExecutor = field(default_factory=lambda: ThreadPoolExecutor(source.THREADS))
    _threads: int = field(default_factory=cv2.getNumThreads)  # of OpenCV

    def __enter__(self) -> _Search:
        cv2.setNumThreads(1)
        return self

    def __exit__(self, *_: object) -> None:
        self._pool.shutdown(cancel_futures=True)
        cv2.setNumThreads(self._threads)

    def search(self, name: str, picture: GreyPicture) -> None:
        """Search a picture; until one shows the board, one by one."""
        self.settle(source.THREADS - 1 if self.views else 0)
        image, thorough = as_8_bit(picture), self._is_thorough(sum(waiting[2] for waiting in self._waiting))
        self._waiting.append((name, image, thorough, self._pool.submit(find_board, image, self.board, thorough)))

    def settle(self, most: int = 0) -> None:
        """Wait until at most so many pictures are being searched."""
        while len(self._waiting) > most:
            name, image, thorough, later = self._waiting.popleft()
            found = later.result()
            if isinstance(found, NotFound) and not thorough and self._is_thorough():
                found = find_board(image, self.board)  # those before it show the board
            if isinstance(found, BoardView):
                self.views.append((name, found))
            elif found is QUICK_SEARCH_FAILED:
                self.quick.append(name)
            else:
                self.refused.append((name, found.reason))
                self._without += thorough

    def leave_out(self, other: Mapping[str, tuple[int, int]], size: tuple[int, int]) -> None:
        """Refuse the pictures of other sizes (w, h)."""
        self.views = [view for view in self.views if view[0] not in other]
        self.quick = [name for name in self.quick if name not in other]
        self.refused = [item for item in self.refused if item[0] not in other]
        self.refused += [
            (name, f"{w}x{h} px, most pictures have {size[0]}x{size[1]}: another camera or setting")
            for name, (w, h) in other.items()
        ]

    def _is_thorough(self, waiting: int = 0) -> bool:
        """Whether the next picture gets the thorough search, if so many that are being searched do not show it."""
        if self.views and isinstance(self.board, Chessboard):
            return True
        return self._without + waiting < (_REASONS if self.views else _THOROUGH_SEARCHES)


def as_8_bit(picture: GreyPicture) -> GreyImage:
    """A picture as 8 bits; 16 bits are scaled from the 0.1 to the 99.9 percentile of the picture."""
    if picture.dtype == np.uint8:
        return np.asarray(picture, dtype=np.uint8)
    low, high = np.percentile(picture, [0.1, 99.9])
    stretched = (picture.astype(np.float32) - low) * (255.0 / max(high - low, 1.0))
    return np.clip(np.round(stretched), 0, 255).astype(np.uint8)


def origins_of(photos: PhotoSet) -> tuple[str, ...]:
    """Source of each view, from its file name: folder and name without the running number, or the video's name."""
    paths = [photos.paths[name] for name, _ in photos.views]
    one_folder = len({path.parent for path in paths}) < 2
    out = []
    for path in paths:
        # cam0_001 becomes cam0, left01 left, IMG_0001_left IMG_left: a running number has two digits or is at the end.
        word = path.name if path.suffix.lower() in VIDEO_SUFFIXES else re.sub(r"_?\d{2,}|\d+$", "", path.stem)
        out.append(word if one_folder else f"{path.resolve().parent.name}/{word}")
    return tuple(out)


def _names(files: Sequence[Path]) -> dict[Path, str]:
    """File names, with as many parent folders as are needed to make the names unique."""
    for depth in range(1, 20):
        names = {path: "/".join(path.resolve().parts[-depth:]) for path in files}
        if len(set(names.values())) == len(files):
            break
    return names


def _pictures(
    files: Sequence[Path], names: dict[Path, str]
) -> Iterator[tuple[str, Path, GreyPicture | MissingPicture]]:
    for path in files:
        if path.suffix.lower() in VIDEO_SUFFIXES:
            yield from ((f"{names[path]}#{k}", path, picture) for k, picture in _frames(path))
        else:
            yield names[path], path, read_picture(path, None)


def _frame_count(path: Path) -> int:
    if path.suffix.lower() not in VIDEO_SUFFIXES:
        return 1
    try:
        return min(video_at(path).count or 1, VIDEO_PICTURES)
    except InputError:
        return 1


def _frames(path: Path) -> Iterator[tuple[int, GreyPicture | MissingPicture]]:
    """Evenly spaced frames of a video with their numbers."""
    try:
        video = video_at(path)
    except InputError:
        yield 0, MissingPicture(f"{UNREADABLE}: not a video, or in a format that OpenCV cannot decode")
        return
    yield from pictures(video, every=max(1, -(-(video.count or 0) // VIDEO_PICTURES)))


def most_frequent_reason(refused: Sequence[tuple[str, str]]) -> str:
    """The most frequent reason among (name, reason), ignoring numbers, with its count and the first picture."""
    if not refused:
        return "no picture was refused"
    duplicates = [item for item in refused if item[1].startswith(_DUPLICATE)]
    quick = [item for item in refused if item[1] == QUICK_SEARCH_FAILED.reason]
    specific = [item for item in refused if item not in duplicates and item not in quick] or quick or duplicates
    kinds = Counter(_kind(reason) for _, reason in specific)
    kind, count = kinds.most_common(1)[0]
    name, reason = next((n, r) for n, r in specific if _kind(r) == kind)
    text = f"most frequent reason ({count} of {len(specific)}, first {name}): {reason}"
    if quick and specific is not quick:
        text += f"; in {len(quick)} more the quick search found no board"
    if duplicates and specific is not duplicates:
        text += f"; {len(duplicates)} more are copies of others"
    return text


def _kind(reason: str) -> str:
    """A reason without its numbers."""
    return re.sub(r"\d+(\.\d+)?", "#", reason)


def _usual_size(sizes: dict[tuple[int, int], list[str]]) -> tuple[int, int]:
    """The size of more than half of the pictures. Raises InputError if there is none."""
    by_count = sorted(sizes.items(), key=lambda item: -len(item[1]))
    size, names = by_count[0]
    if 2 * len(names) > sum(len(n) for n in sizes.values()):
        return size
    parts = []
    for (width, height), names in by_count:
        more = f" and {len(names) - _MAX_NAMES} more" if len(names) > _MAX_NAMES else ""
        parts.append(f"{width}x{height} ({', '.join(names[:_MAX_NAMES])}{more})")
    rotated = {(w, h) for w, h in sizes} == {(h, w) for w, h in sizes}
    remedy = "; some are rotated by 90 degrees: keep the camera's own orientation" if rotated else ""
    raise InputError(
        f"the pictures have different sizes: {', '.join(parts)}; a calibration needs pictures of one camera at one"
        f" size{remedy}"
    )


def _refuse_too_few(views: Sequence[object], refused: Sequence[tuple[str, str]], board: Board, fewest: int) -> None:
    total = len(views) + len(refused)
    if not views:
        raise InputError(f"{board.describe()}: found in none of {total} pictures; {most_frequent_reason(refused)}")
    if len(views) < fewest:
        tail = f"; {most_frequent_reason(refused)}" if refused else "; take more pictures"
        raise InputError(
            f"{board.describe()}: found in {len(views)} of {total} pictures, {fewest} or more are needed{tail}"
        )


TABLE_SUFFIXES = (".vnl", ".csv")
CSV_COLUMNS = ("view", "id", "u_px", "v_px")


def read_corner_table(path: Path, board: Board, image_size_px: tuple[int, int]) -> PhotoSet:
    """The views of a board in a table of corners.

    vnl: `filename x y [weight]`, one row per point of the board in the order of the rows, `-` where it was not found;
    rows with a weight of 0 or less are left out, other weights are not used. CSV: columns view, id, u_px, v_px, with
    the numbers of the points from 0 row by row, as in corners.csv. Pixels refer to the centre of the first pixel.
    Raises InputError: the table cannot be read, or is not of this board or picture size.
    """
    views = _read_vnl(path, board) if path.suffix.lower() == ".vnl" else _read_csv(path)
    size = np.array(image_size_px)
    found: list[tuple[str, BoardView]] = []
    for name, (ids, pixels) in views.items():
        if not np.isin(ids, board.ids).all() or len(np.unique(ids)) != len(ids):
            raise InputError(
                f"{path}: {name}: expected each of the points 0 to {len(board.ids) - 1} of {board.describe()} at most"
                f" once, got {len(ids)} with numbers up to {ids.max()}"
            )
        if np.any(pixels < -0.5) or np.any(pixels > size - 0.5):
            raise InputError(
                f"{path}: {name}: expected corners inside {size[0]}x{size[1]} px, got {np.max(pixels[:, 0]):.0f},"
                f" {np.max(pixels[:, 1]):.0f}; check --image-size"
            )
        order = np.argsort(ids)
        if len(ids):
            found.append((name, BoardView(ids[order], pixels[order], np.nan, np.nan)))
    if not found:
        raise InputError(f"{path}: expected corners of {board.describe()}, got none")
    copies = _copies(found, board)
    kept = tuple(view for view in found if view[0] not in copies)
    return PhotoSet(board, image_size_px, kept, tuple(copies.items()), {name: path for name, _ in found})


def _read_vnl(path: Path, board: Board) -> dict[str, tuple[Ints, Array]]:
    try:
        lines = text_of_file(path).splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read: {error}") from None
    rows: dict[str, list[tuple[float, float, float]]] = {}
    for number, line in enumerate(lines, 1):
        fields = line.split()
        if not fields or line.startswith("#"):
            continue
        try:
            x, y, weight = (float("nan") if f == "-" else float(f) for f in (*fields[1:3], *fields[3:4], "1")[:3])
        except ValueError:
            raise InputError(f"{path}: line {number}: expected `filename x y [weight]`, got {line[:60]!r}") from None
        rows.setdefault(fields[0], []).append((x, y, weight))
    out = {}
    for name, points in rows.items():
        values = np.array(points)
        if len(values) == 1 and np.isnan(values[0, 0]):  # a picture without the board
            continue
        if len(values) != len(board.ids):
            raise InputError(
                f"{path}: {name}: expected {len(board.ids)} rows, one per point of {board.describe()}, got"
                f" {len(values)}"
            )
        good = np.isfinite(values).all(axis=1) & (values[:, 2] > 0)
        out[name] = (board.ids[good], values[good, :2])
    return out


def _read_csv(path: Path) -> dict[str, tuple[Ints, Array]]:
    table = read_table(path, CSV_COLUMNS)
    table.require_rows(CSV_COLUMNS)
    ids = table.finite("id", "the number of a point of the board")
    pixels = table.finite_stack("u_px", "v_px")
    view = table.words["view"]
    return {name: (ids[view.codes == k].astype(np.int64), pixels[view.codes == k]) for k, name in enumerate(view.words)}
