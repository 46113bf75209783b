"""One camera's recorded pictures: numbered files, or a video; grey or in colour. All commands read series here.

Orientation flags are not applied: pixels stay in the sensor's order. A video's grey is that of the decoder: the luma of
YUV videos, all channels of RGB videos. Files are regular files. Live cameras: live_source.py beside it.
"""

from __future__ import annotations

import glob
import math
import os
import re
from collections import deque
from collections.abc import Generator, Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from itertools import count, islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias

import numpy as np

from geometry.arrays import Ints, evenly_spread
from lab.errors import InputError
from lab.files.text.error_text import is_formula, name_of_path
from lab.files.text.json_text import require_regular_file
from lab.pictures.opencv import load_cv2, opened
from lab.pictures.picture_file import (
    DROPPED,
    PICTURE_SUFFIXES,
    UNREADABLE,
    ColourPicture,
    GreyPicture,
    MissingPicture,
    as_colour,
    read_picture,
    require_format,
)

if TYPE_CHECKING:
    import cv2

AHEAD = 8  # pictures of a camera read before they are requested: 10 MB of 1280x1024, whatever the recording's length
KEPT_BYTES = 1 << 25  # of a camera's pictures that are read before the others
THREADS = min(4, os.cpu_count() or 1)  # pictures decoded or searched for boards, and cameras prepared, at once: memory
_LARGEST_COUNT = 2**40  # of pictures in a video's header; a larger one is wrong
_RATE_RANGE_HZ = (0.01, 1e6)  # a rate outside it in a video's header is not one
_LAST_NUMBER = re.compile(r"([0-9]+)[^0-9]*$")
_HINT = f"a picture ({', '.join(s[1:] for s in PICTURE_SUFFIXES)}), a folder of pictures, or a video"
_SHOWN = 3  # names in a message
_DEPTH_PICTURES = 9  # whose values show the bits of the sensor

Read: TypeAlias = GreyPicture | ColourPicture | MissingPicture


@dataclass(frozen=True, slots=True)
class PictureFiles:
    """Picture files by frame number."""

    camera: str  # the folder's or the file's name
    files: dict[int, Path]  # by increasing frame number
    notes: tuple[str, ...] = ()
    ignored: tuple[str, ...] = ()  # names in the folder that are not pictures
    # Grey pictures that have been read already; the next reader takes them out instead of decoding them again.
    kept: dict[int, GreyPicture | MissingPicture] = field(default_factory=dict, compare=False, repr=False)

    def keep(self, read: Mapping[int, GreyPicture | MissingPicture]) -> None:
        """Keep pictures for the next reader, as many as may be in memory."""
        size = max((p.nbytes for p in read.values() if isinstance(p, np.ndarray)), default=1)
        self.kept.update(islice(read.items(), KEPT_BYTES // size))

    @property
    def numbers(self) -> Ints:
        """Frame numbers (n,), increasing."""
        return np.fromiter(self.files, dtype=np.int64, count=len(self.files))

    @property
    def count(self) -> int:
        """Number of pictures."""
        return len(self.files)


@dataclass(frozen=True, slots=True)
class Video:
    """A video; frame n is its n-th picture, from 0."""

    camera: str
    path: Path
    count: int | None = None  # number of pictures by the header, which may be wrong; None: not stated
    rate_hz: float | None = None  # pictures per second by the header, which may be wrong; None: not stated
    notes: tuple[str, ...] = field(default=(), init=False)


PictureSource: TypeAlias = PictureFiles | Video


# Opening -------------------------------------------------------------------------------------------------------------


def number_of(name: str) -> int | None:
    """The frame number in a picture's file name: the last group of digits before the suffix. None: not a picture."""
    stem, suffix = os.path.splitext(name)
    match = _LAST_NUMBER.search(stem)
    if (
        name.startswith(".")
        or suffix.lower() not in PICTURE_SUFFIXES
        or match is None
        or len(match[1].lstrip("0")) > 15
    ):
        return None
    return int(match[1])


def list_folder(folder: Path, camera: str = "") -> PictureFiles:
    """The pictures in a folder, with the frame number from their names (see `number_of`).

    Raises InputError: two pictures have the same number, or the folder has none or cannot be read.
    """
    files: dict[int, Path] = {}
    ignored = []
    try:
        with os.scandir(folder) as entries:
            found = sorted(e.name for e in entries if e.is_file())
    except OSError as error:
        raise InputError(f"{folder}: cannot be read: {error.strerror}") from None
    for name in found:
        number = number_of(name)
        if number is None:
            ignored.append(name)
            continue
        if number in files:
            raise InputError(
                f"{folder}: expected one picture per frame, got {files[number].name} and {name} for frame {number};"
                " remove one"
            )
        files[number] = folder / name
    if not files:
        others = f" among {len(ignored)} files" if ignored else ""
        raise InputError(
            f"{folder}: expected pictures with a number ({', '.join(PICTURE_SUFFIXES)}), found none{others}"
        )
    return PictureFiles(camera or name_of_path(folder), dict(sorted(files.items())), ignored=tuple(ignored))


def video_at(path: Path, camera: str = "") -> Video:
    """A video with what its header states. Raises InputError: OpenCV cannot read it."""
    capture = open_video(path)
    cv2 = load_cv2()
    pictures, rate = capture.get(cv2.CAP_PROP_FRAME_COUNT), capture.get(cv2.CAP_PROP_FPS)
    capture.release()
    low, high = _RATE_RANGE_HZ
    return Video(
        camera or name_of_path(path.with_suffix("")),
        path,
        int(pictures) if 0 < pictures < _LARGEST_COUNT else None,
        float(rate) if low <= rate <= high else None,
    )


def open_inputs(given: Sequence[Path], camera: str | None = None) -> PictureSource:
    """Open the paths of the command line: a folder, picture files or a video.

    camera: a name instead of the folder's or file's own. Raises InputError: a path does not exist, a folder has no
    pictures, or pictures and videos are mixed.
    """
    if camera is not None and (not camera.isprintable() or is_formula(camera)):
        raise InputError(
            f"--camera: expected a name without control characters and without =, +, -, @ in front, got {camera!r}"
        )
    if len(given) == 1 and given[0].is_dir():
        return _numbered(pictures_in(given[0]), camera or name_of_path(given[0]))
    files = [file for path in given for file in _files_of(path)]
    files = list({file.resolve(): file for file in files}.values())
    others = [f for f in files if f.suffix.lower() not in PICTURE_SUFFIXES]
    if others and len(files) > 1:
        raise InputError(
            f"{others[0]}: expected pictures only, or a single video, got it among {len(files)} files; give the"
            " pictures in one call and each video in a separate one"
        )
    if others:
        try:
            return video_at(others[0], camera or "")
        except InputError:
            raise InputError(f"{others[0]}: expected {_HINT}, found a file that is none of them, or damaged") from None
    folders = {file.resolve().parent for file in files}
    own = files[0].with_suffix("") if len(files) == 1 else folders.pop() if len(folders) == 1 else Path("pictures")
    return _numbered(files, camera or name_of_path(own))


def _files_of(path: Path) -> list[Path]:
    if path.is_dir():
        raise InputError(f"{path}: expected a folder alone, or files, got a folder among others; name one at a time")
    return matching_files(path, _HINT)


def matching_files(path: Path, expected: str, suffixes: tuple[str, ...] = ("",)) -> list[Path]:
    """A file, or those with one of these suffixes that a pattern finds, sorted. Raises InputError: there is none."""
    if path.exists():
        return [path]
    if any(c in str(path) for c in "*?["):
        matching = [Path(p) for p in sorted(glob.glob(str(path), recursive=True)) if p.lower().endswith(suffixes)]
        matching = [p for p in matching if p.is_file()]
        if not matching:
            raise InputError(f"{path}: no file matches this pattern")
        return matching
    raise InputError(f"{path}: expected {expected}, found nothing; check the path")


def pictures_in(folder: Path, suffixes: tuple[str, ...] = PICTURE_SUFFIXES) -> list[Path]:
    """The pictures in a folder, sorted; without hidden files. Raises InputError: there is none."""
    try:
        names = sorted(p for p in folder.iterdir() if not p.name.startswith("."))
    except OSError as error:
        raise InputError(f"{folder}: cannot be read: {error.strerror}") from None
    pictures = [p for p in names if p.suffix.lower() in suffixes and p.is_file()]
    if pictures:
        return pictures
    below = [p.name for p in names if p.is_dir() and any(q.suffix.lower() in suffixes for q in p.iterdir())]
    hint = f"; its folders {', '.join(below[:_SHOWN])} do: name one of them" if below else ""
    among = f" among {len(names)} files" if names and not below else ""
    raise InputError(
        f"{folder}: the folder holds no pictures ({', '.join(s[1:] for s in PICTURE_SUFFIXES)}){among}{hint}"
    )


def _numbered(files: Sequence[Path], camera: str) -> PictureFiles:
    """Numbered by their names, as in runs; in alphabetical order where the names have no distinct numbers."""
    numbers = [number_of(f.name) for f in files]
    known = [n for n in numbers if n is not None]
    if len(set(known)) == len(files):
        return PictureFiles(camera, dict(sorted(zip(known, files, strict=True))))
    if len(files) == 1:
        return PictureFiles(camera, {0: files[0]})
    why = "some names have no number" if len(known) < len(files) else "some names have the same number"
    note = f"frames are numbered from 0 in alphabetical order: {why}"
    return PictureFiles(camera, dict(enumerate(files)), (note,))


def open_video(path: Path, colour: bool = False) -> cv2.VideoCapture:
    """Open a video. colour: its pictures come as BGR; else grey videos stay as they are, and most others come as grey.

    Raises InputError: OpenCV cannot read it.
    """
    require_regular_file(path)
    cv2 = load_cv2()
    capture = opened(str(path))
    if not capture.isOpened():
        raise InputError(
            f"{path}: expected a video that OpenCV can read; it cannot open this file (damaged, no video?)"
        )
    if not colour:
        # Keeps grey videos, of 8 or 16 bits, unchanged; of YUV videos only the luma comes, of RGB videos all channels.
        capture.set(cv2.CAP_PROP_CONVERT_RGB, 0)
    return capture


# Reading -------------------------------------------------------------------------------------------------------------


def pictures(
    source: PictureSource,
    size_px: tuple[int, int] | None = None,
    colour: bool = False,
    *,
    every: int = 1,
    wanted: Iterable[int] | None = None,
) -> Generator[tuple[int, Any], None, None]:
    """Pictures with their frame numbers, read and decoded ahead in threads; at most `AHEAD` are in memory.

    size_px: width and height of the pictures; None: any. colour: (h, w, 3), BGR, 8 bits, instead of grey (h, w). every:
    only each so many pictures. wanted: frame numbers, increasing, instead of all; a number without a file is a dropped
    frame. The pictures end where a video ends.
    """
    reader: _Reader = (
        _FileReader(source, size_px, colour)
        if isinstance(source, PictureFiles)
        else _VideoReader(source.path, size_px, colour)
    )
    if wanted is None:
        wanted = list(source.files)[::every] if isinstance(source, PictureFiles) else count(0, every)
    following = iter(wanted)
    waiting: deque[tuple[int, Future[Any]]] = deque()
    with ExitStack() as stack:
        stack.callback(reader.close)
        while True:
            while len(waiting) < AHEAD and (number := next(following, None)) is not None:
                waiting.append((number, reader.request(number)))
            if not waiting:
                return
            number, later = waiting.popleft()
            picture = later.result()
            if picture is None:
                return
            yield number, picture


def pictures_of_frames(
    source: PictureSource, frames: Iterable[int], size_px: tuple[int, int] | None = None
) -> dict[int, GreyPicture | MissingPicture]:
    """Some grey pictures by frame number, increasing; those after the end of a video are dropped frames.

    A video is read from its start, so all pictures should be requested in one call.
    """
    wanted = sorted(set(frames))
    out: dict[int, GreyPicture | MissingPicture] = dict.fromkeys(wanted, MissingPicture(DROPPED))
    with closing(pictures(source, size_px, wanted=wanted)) as found:
        out.update(found)
    return out


class _Reader(Protocol):
    """Reads pictures in threads. Frame numbers are requested in increasing order."""

    def request(self, frame: int) -> Future[Any]:
        """A future of this frame's picture; of None: the pictures have ended."""

    def close(self) -> None:
        """Close files and threads."""


class _FileReader:
    def __init__(self, source: PictureFiles, size_px: tuple[int, int] | None, colour: bool) -> None:
        self._source, self._size_px, self._colour = source, size_px, colour
        self._used_bits = _used_bits(source) if colour else 16
        self._pool = ThreadPoolExecutor(THREADS, thread_name_prefix="decode")

    def request(self, frame: int) -> Future[Read]:
        return self._pool.submit(self._read, frame)

    def _read(self, frame: int) -> Read:
        if not self._colour and (kept := self._source.kept.pop(frame, None)) is not None:
            return kept
        path = self._source.files.get(frame)
        if path is None:
            return MissingPicture(DROPPED)
        return read_picture(path, self._size_px, self._colour, self._used_bits)

    def close(self) -> None:
        self._pool.shutdown(cancel_futures=True)


def _used_bits(source: PictureFiles) -> int:
    """Bits that the sensor has in colour files of 16 bits, 8 to 16, an even number.

    Pictures from all of the series are looked at: it has one number, so that a colour stays the same.
    """
    from tracking.noise_estimation.grey_values import full_scale, grey_step

    paths, wide = list(source.files.values()), []
    for k in evenly_spread(np.arange(len(paths)), _DEPTH_PICTURES).tolist():
        picture = read_picture(paths[k], None, True, None)
        if isinstance(picture, MissingPicture):
            continue
        if picture.dtype == np.uint8:
            return 16
        wide.append(picture)
    if not wide:
        return 16
    step = grey_step(wide)
    return 2 * math.ceil(math.log2(full_scale(wide, step) + step) / 2)


class _VideoReader:
    """A video, decoded picture by picture in its own thread; pictures that are not requested are skipped."""

    def __init__(self, path: Path, size_px: tuple[int, int] | None, colour: bool) -> None:
        self._capture = open_video(path, colour)
        self._size_px, self._colour = size_px, colour
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="decode-video")
        self._at = 0  # number of the next picture

    def request(self, frame: int) -> Future[Read | None]:
        return self._pool.submit(self._read, frame)

    def _read(self, frame: int) -> Read | None:
        if frame < self._at:
            return MissingPicture(DROPPED)
        while self._capture.grab():
            self._at += 1
            if self._at > frame:
                return retrieved(self._capture, self._size_px, self._colour)
        return None

    def close(self) -> None:
        self._pool.shutdown(cancel_futures=True)
        self._capture.release()


class Grabbed(Protocol):
    """An OpenCV capture that has grabbed a picture."""

    def retrieve(self) -> Any: ...


def retrieved(capture: Grabbed, size_px: tuple[int, int] | None, colour: bool = False) -> Any:
    """The picture that a capture has grabbed, of this (width, height): grey values, or BGR with `colour`.

    The array may be the capture's own buffer, which the next picture overwrites.
    """
    good, picture = capture.retrieve()
    if not good or picture is None:
        return MissingPicture(f"{UNREADABLE}: damaged")
    return formatted(picture, size_px, colour)


def formatted(picture: Any, size_px: tuple[int, int] | None, colour: bool = False) -> Any:
    """A picture, grey or BGR, of this (width, height): grey values, or BGR with `colour`; else Missing."""
    checked = require_format(picture, size_px)
    if colour:
        return checked if isinstance(checked, MissingPicture) else as_colour(checked)
    if picture.ndim == 3 and not isinstance(checked, MissingPicture):
        cv2 = load_cv2()
        to_grey = {3: cv2.COLOR_BGR2GRAY, 4: cv2.COLOR_BGRA2GRAY}.get(picture.shape[2])
        return picture[..., 0] if to_grey is None else cv2.cvtColor(picture, to_grey)
    return checked
