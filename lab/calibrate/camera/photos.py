"""Photographs of a calibration board: files, folders, patterns and videos, read one picture at a time."""

from __future__ import annotations

import glob
import hashlib
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calibration.boards.board_detection import find_board
from calibration.boards.board_types import Board, Chessboard
from calibration.boards.board_view import NO_CLOSE_LOOK, BoardView, GreyImage, NotFound
from lab.errors import InputError
from lab.pictures.opencv import quiet_cv2
from lab.pictures.picture_file import SUFFIXES, UNREADABLE, Grey, Missing, checked, read_picture

VIDEO_SUFFIXES = (".mp4", ".avi", ".mov", ".mkv", ".m4v", ".webm")
VIDEO_PICTURES = 120  # of one video at most, evenly spread: neighbouring frames show the same pose again
_SHOWN = 3  # names in one line of an error
# So many pictures without the board, and none with it, get a close look, that takes seconds; then a quick one must do
# until a picture shows the board. A wrong kind of board or dictionary is wrong in all pictures.
_CLOSE_LOOKS = 2
# Of boards other than chessboards a quick look misses none: it only spares the cause, which of so many is enough. A
# video of 111 frames, 63 without the board, then takes 6 s, not 25.
_CAUSES = 10
_TWIN = "the same picture as "

Progress = Callable[[int, int, str], None]  # pictures done, pictures in all, name of the last


@dataclass(frozen=True, slots=True)
class PhotoSet:
    """What a set of photographs of one camera shows of a board."""

    board: Board
    image_size_px: tuple[int, int]  # width, height, of every picture
    views: tuple[tuple[str, BoardView], ...]  # by name, in the pictures' order
    refused: tuple[tuple[str, str], ...]  # name and reason
    paths: dict[str, Path]  # where the picture of a name is (a video's path for its frames)

    def line(self) -> str:
        """One line for the user, with the commonest reason where pictures were refused."""
        total = len(self.views) + len(self.refused)
        text = f"{self.board.describe()}: found in {len(self.views)} of {total} pictures"
        return text + (f"; {commonest(self.refused)}" if self.refused else "")


def load_photos(paths: Iterable[Path | str]) -> tuple[Path, ...]:
    """The picture and video files that files, folders and patterns (`shots/*.png`) name, each once, in natural order.

    Raises InputError where a path names nothing, or there is none.
    """
    found: list[Path] = []
    for given in paths:
        found += _files_of(Path(given))
    unique = tuple({path.resolve(): path for path in found}.values())
    if not unique:
        raise InputError("no pictures given; name picture files, a folder of them or a pattern such as shots/*.png")
    return unique


def _files_of(path: Path) -> list[Path]:
    if path.is_dir():
        inside = sorted((p for p in path.iterdir() if _is_picture(p)), key=_natural)
        if not inside:
            below = [p.name for p in sorted(path.iterdir()) if p.is_dir() and any(map(_is_picture, p.iterdir()))]
            hint = f"; its folders {', '.join(below[:_SHOWN])} do, name one of them" if below else ""
            raise InputError(f"{path}: the folder holds no pictures ({', '.join(s[1:] for s in SUFFIXES)}){hint}")
        return inside
    if path.exists():
        return [path]
    if any(c in str(path) for c in "*?["):
        matching = sorted((Path(p) for p in glob.glob(str(path), recursive=True)), key=_natural)
        files = [p for p in matching if _is_picture(p)]
        if not files:
            raise InputError(f"{path}: no picture matches this pattern")
        return files
    raise InputError(f"{path}: expected a picture, a folder or a pattern, found nothing; check the path")


def _is_picture(path: Path) -> bool:
    return path.is_file() and path.suffix.lower() in SUFFIXES + VIDEO_SUFFIXES and not path.name.startswith(".")


def _natural(path: Path) -> tuple[str, list[tuple[int, str]]]:
    """shot-2 before shot-10."""
    parts = re.split(r"(\d+)", path.name)
    return str(path.parent), [(int(p), "") if p.isdigit() else (-1, p.lower()) for p in parts]


def find_in_photos(
    paths: Iterable[Path | str], board: Board, progress: Progress | None = None, fewest: int = 3
) -> PhotoSet:
    """Look for a board in every photograph. One picture at a time is held in memory.

    Raises InputError where there is no readable picture, where sizes differ, and where fewer than `fewest` pictures
    show the board.
    """
    files = load_photos(paths)
    names = _names(files)
    total = sum(_frame_count(path) for path in files)
    views: list[tuple[str, BoardView]] = []
    refused: list[tuple[str, str]] = []
    quick: set[str] = set()
    where: dict[str, Path] = {}
    sizes: dict[tuple[int, int], list[str]] = {}
    seen: dict[bytes, str] = {}
    for done, (name, path, picture) in enumerate(_pictures(files, names), 1):
        where[name] = path
        if isinstance(picture, Missing):
            refused.append((name, picture.reason))
        else:
            sizes.setdefault((picture.shape[1], picture.shape[0]), []).append(name)
            twin = seen.setdefault(hashlib.sha256(picture.tobytes()).digest(), name)
            if twin != name:
                refused.append((name, f"{_TWIN}{twin}: it would count twice"))
            elif len(sizes) == 1:  # with two sizes there will be no calibration: only sizes are still collected
                found = find_board(as_8_bit(picture), board, _closely(board, bool(views), refused))
                if found is NO_CLOSE_LOOK:
                    quick.add(name)
                elif isinstance(found, NotFound):
                    refused.append((name, found.reason))
                else:
                    views.append((name, found))
        if progress is not None:
            progress(done, max(total, done), name)
    if not sizes:
        raise InputError(f"none of {len(refused)} pictures can be read; {commonest(refused)}")
    if len(sizes) > 1:
        raise InputError(_mixed(sizes))
    if views and quick and isinstance(board, Chessboard):  # it is in some: so the others are looked at closely too
        for name, _, picture in _pictures(files, names):
            if name in quick and not isinstance(picture, Missing):
                found = find_board(as_8_bit(picture), board)
                if isinstance(found, NotFound):
                    refused.append((name, found.reason))
                else:
                    views.append((name, found))
    else:
        refused += [(name, NO_CLOSE_LOOK.reason) for name in quick]
    order = {name: k for k, name in enumerate(where)}
    views.sort(key=lambda view: order[view[0]])
    refused.sort(key=lambda item: order[item[0]])
    _enough(views, refused, board, fewest)
    return PhotoSet(board, next(iter(sizes)), tuple(views), tuple(refused), where)


def as_8_bit(picture: Grey) -> GreyImage:
    """A picture of 16 bits stretched by its own range; one pixel in a thousand may lie outside on each side."""
    if picture.dtype == np.uint8:
        return np.asarray(picture, dtype=np.uint8)
    low, high = np.percentile(picture, [0.1, 99.9])
    stretched = (picture.astype(np.float32) - low) * (255.0 / max(high - low, 1.0))
    return np.clip(np.round(stretched), 0, 255).astype(np.uint8)


def origins_of(photos: PhotoSet) -> tuple[str, ...]:
    """Of each view, what its file's name tells of the camera: folder and name without the running number, or video."""
    paths = [photos.paths[name] for name, _ in photos.views]
    one_folder = len({path.parent for path in paths}) < 2
    out = []
    for path in paths:
        # cam0_001 is of cam0, left01 of left, IMG_0001_left of IMG_left: a number's own digits are two, or at the end.
        word = path.name if path.suffix.lower() in VIDEO_SUFFIXES else re.sub(r"_?\d{2,}|\d+$", "", path.stem)
        out.append(word if one_folder else f"{path.resolve().parent.name}/{word}")
    return tuple(out)


def _names(files: Sequence[Path]) -> dict[Path, str]:
    """File names; with as many of the folders above as tell equal names apart."""
    for depth in range(1, 20):
        names = {path: "/".join(path.resolve().parts[-depth:]) for path in files}
        if len(set(names.values())) == len(files):
            break
    return names


def _pictures(files: Sequence[Path], names: dict[Path, str]) -> Iterator[tuple[str, Path, Grey | Missing]]:
    for path in files:
        if path.suffix.lower() in VIDEO_SUFFIXES:
            yield from ((f"{names[path]}#{k}", path, picture) for k, picture in _frames(path))
        else:
            yield names[path], path, read_picture(path, None)


def _frame_count(path: Path) -> int:
    if path.suffix.lower() not in VIDEO_SUFFIXES:
        return 1
    cv2 = quiet_cv2()
    video = cv2.VideoCapture(str(path))
    count = int(video.get(cv2.CAP_PROP_FRAME_COUNT))
    video.release()
    return min(max(count, 1), VIDEO_PICTURES)


def _frames(path: Path) -> Iterator[tuple[int, Grey | Missing]]:
    """Evenly spread frames of a video with their numbers."""
    cv2 = quiet_cv2()
    video = cv2.VideoCapture(str(path))
    try:
        count = int(video.get(cv2.CAP_PROP_FRAME_COUNT))
        step = max(1, -(-count // VIDEO_PICTURES))
        number = 0
        while video.grab():
            if number % step == 0:
                good, frame = video.retrieve()
                if good:
                    grey = frame if frame.ndim == 2 else cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)
                    yield number, checked(grey, None)
            number += 1
        if number == 0:
            yield 0, Missing("unreadable: no video, or of a kind that OpenCV cannot decode")
    finally:
        video.release()


def commonest(refused: Sequence[tuple[str, str]]) -> str:
    """The commonest reason among (name, reason), how often it came, and where first. Numbers in it may differ."""
    if not refused:
        return "nothing was refused"
    twins = [item for item in refused if item[1].startswith(_TWIN)]
    quick = [item for item in refused if item[1] == NO_CLOSE_LOOK.reason]
    telling = [item for item in refused if item not in twins and item not in quick] or quick or twins
    kinds = Counter(_kind(reason) for _, reason in telling)
    kind, count = kinds.most_common(1)[0]
    name, reason = next((n, r) for n, r in telling if _kind(r) == kind)
    text = f"refused most often ({count} of {len(telling)}, first {name}): {reason}"
    if quick and telling is not quick:
        text += f"; in {len(quick)} more no board was seen at a quick look"
    if twins and telling is not twins:
        text += f"; {len(twins)} more are copies of others"
    return text


def _kind(reason: str) -> str:
    """A reason without its numbers."""
    return re.sub(r"\d+(\.\d+)?", "#", reason)


def _closely(board: Board, seen: bool, refused: Sequence[tuple[str, str]]) -> bool:
    """Whether the next picture deserves a close look. seen: the board is in some picture."""
    if seen and isinstance(board, Chessboard):
        return True
    looked_at = sum(not reason.startswith((_TWIN, UNREADABLE)) for _, reason in refused)
    return looked_at < (_CAUSES if seen else _CLOSE_LOOKS)


def _mixed(sizes: dict[tuple[int, int], list[str]]) -> str:
    by_count = sorted(sizes.items(), key=lambda item: -len(item[1]))
    parts = []
    for (width, height), names in by_count:
        more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
        parts.append(f"{width}x{height} ({', '.join(names[:_SHOWN])}{more})")
    turned = {(w, h) for w, h in sizes} == {(h, w) for w, h in sizes}
    remedy = "; some are turned on their side: keep the camera's own orientation" if turned else ""
    return (
        f"the pictures have different sizes: {', '.join(parts)}; one calibration is for one camera at one size{remedy}"
    )


def _enough(views: Sequence[object], refused: Sequence[tuple[str, str]], board: Board, fewest: int) -> None:
    total = len(views) + len(refused)
    if not views:
        raise InputError(f"{board.describe()}: found in none of {total} pictures; {commonest(refused)}")
    if len(views) < fewest:
        tail = f"; {commonest(refused)}" if refused else "; take more pictures"
        raise InputError(
            f"{board.describe()}: found in {len(views)} of {total} pictures, {fewest} or more are needed{tail}"
        )
