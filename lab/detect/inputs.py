"""Input of `beampose detect`: a folder, picture files, or a video; each picture has a frame number."""

from __future__ import annotations

import glob
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from lab.errors import InputError
from lab.files.text.error_text import is_formula, name_of_path
from lab.pictures.picture_file import PICTURE_SUFFIXES, GreyPicture, MissingPicture, read_picture
from lab.runs.frames.frame_sources import VideoSource, header_picture_count, number_of, open_video
from lab.runs.frames.frames import AHEAD, THREADS
from lab.runs.frames.sensor_noise import VIDEO_PICTURES, noise_estimation_frames

_HINT = f"a picture ({', '.join(s[1:] for s in PICTURE_SUFFIXES)}), a folder of pictures, or a video"
_SHOWN = 3  # names in a message


@dataclass(frozen=True, slots=True)
class PictureFiles:
    """Pictures by increasing frame number."""

    camera: str  # the folder's or the file's name
    files: tuple[tuple[int, Path], ...]
    notes: tuple[str, ...] = ()

    def count(self, every: int) -> int | None:
        """Number of pictures if every `every`-th is read."""
        return -(-len(self.files) // every)

    def pictures(self, every: int) -> Iterator[tuple[int, GreyPicture | MissingPicture]]:
        """Every `every`-th picture with its frame number, read ahead in threads."""
        wanted = iter(self.files[::every])
        waiting: deque[tuple[int, Future[GreyPicture | MissingPicture]]] = deque()
        with ThreadPoolExecutor(THREADS, thread_name_prefix="decode") as pool:
            while True:
                while len(waiting) < AHEAD and (following := next(wanted, None)) is not None:
                    waiting.append((following[0], pool.submit(read_picture, following[1], None)))
                if not waiting:
                    return
                number, later = waiting.popleft()
                yield number, later.result()

    def noise_pictures(self) -> Iterator[GreyPicture | MissingPicture]:
        """Pairs of neighbouring pictures, for the estimate of the noise."""
        for i in noise_estimation_frames(len(self.files)):
            yield read_picture(self.files[i][1], None)


@dataclass(frozen=True, slots=True)
class Video:
    """A video; frame n is its n-th picture."""

    camera: str
    path: Path
    notes: tuple[str, ...] = ()

    def count(self, every: int) -> int | None:
        """Number of pictures if every `every`-th is read, by the header; None where it states none."""
        stated = header_picture_count(self.path)
        return None if stated is None else -(-stated // every)

    def pictures(self, every: int) -> Iterator[tuple[int, GreyPicture | MissingPicture]]:
        """Every `every`-th picture with its frame number."""
        video = VideoSource(self.path, None)
        try:
            number = 0
            while True:
                if number % every:
                    if not video.skip():
                        return
                else:
                    picture = video.next_picture()
                    if picture is None:
                        return
                    yield number, picture
                number += 1
        finally:
            video.close()

    def noise_pictures(self) -> Iterator[GreyPicture | MissingPicture]:
        """Pairs of neighbouring pictures at the start, for the estimate of the noise."""
        video = VideoSource(self.path, None)
        try:
            for number in range(VIDEO_PICTURES[-1] + 1):
                picture = video.next_picture()
                if picture is None:
                    return
                if number in VIDEO_PICTURES:
                    yield picture
        finally:
            video.close()


def open_inputs(given: Sequence[Path], camera: str | None = None) -> PictureFiles | Video:
    """Open the paths of the command line. camera: a name instead of the folder's or file's own.

    Raises:
        InputError: a path does not exist, a folder has no pictures, or pictures and videos are mixed.
    """
    if camera is not None and (not camera.isprintable() or is_formula(camera)):
        raise InputError(
            f"--camera: expected a name without control characters and without =, +, -, @ in front, got {camera!r}"
        )
    if len(given) == 1 and given[0].is_dir():
        files = _pictures_in(given[0])
        return _numbered(files, camera or name_of_path(given[0]))
    files = [file for path in given for file in _files_of(path)]
    files = list({file.resolve(): file for file in files}.values())
    others = [f for f in files if f.suffix.lower() not in PICTURE_SUFFIXES]
    if others and len(files) > 1:
        raise InputError(
            f"{others[0]}: expected pictures only, or a single video, got it among {len(files)} files; give the"
            " pictures in one call and each video in a separate one"
        )
    if others:
        _require_video(others[0])
        return Video(camera or name_of_path(others[0].with_suffix("")), others[0])
    folders = {file.resolve().parent for file in files}
    own = files[0].with_suffix("") if len(files) == 1 else folders.pop() if len(folders) == 1 else Path("pictures")
    return _numbered(files, camera or name_of_path(own))


def _files_of(path: Path) -> list[Path]:
    if path.is_dir():
        raise InputError(f"{path}: expected a folder alone, or files, got a folder among others; name one at a time")
    if path.exists():
        return [path]
    if any(c in str(path) for c in "*?["):
        matching = [Path(p) for p in sorted(glob.glob(str(path), recursive=True))]
        matching = [p for p in matching if p.is_file()]
        if not matching:
            raise InputError(f"{path}: no file matches this pattern")
        return matching
    raise InputError(f"{path}: expected {_HINT}, found nothing; check the path")


def _pictures_in(folder: Path) -> list[Path]:
    try:
        names = sorted(p for p in folder.iterdir() if not p.name.startswith("."))
    except OSError as error:
        raise InputError(f"{folder}: cannot be read: {error.strerror}") from None
    pictures = [p for p in names if p.suffix.lower() in PICTURE_SUFFIXES and p.is_file()]
    if pictures:
        return pictures
    below = [p.name for p in names if p.is_dir() and any(q.suffix.lower() in PICTURE_SUFFIXES for q in p.iterdir())]
    hint = f"; its folders {', '.join(below[:_SHOWN])} do: name one of them" if below else ""
    among = f" among {len(names)} files" if names and not below else ""
    raise InputError(
        f"{folder}: the folder holds no pictures ({', '.join(s[1:] for s in PICTURE_SUFFIXES)}){among}{hint}"
    )


def _require_video(path: Path) -> None:
    try:
        open_video(path).release()
    except InputError:
        raise InputError(f"{path}: expected {_HINT}, found a file that is none of them, or damaged") from None


def _numbered(files: Sequence[Path], camera: str) -> PictureFiles:
    """Numbered by their names, as in runs; in alphabetical order where the names have no distinct numbers."""
    numbers = [number_of(f.name) for f in files]
    known = [n for n in numbers if n is not None]
    if len(set(known)) == len(files):
        return PictureFiles(camera, tuple(sorted(zip(known, files, strict=True))))
    if len(files) == 1:
        return PictureFiles(camera, ((0, files[0]),))
    why = "some names have no number" if len(known) < len(files) else "some names have the same number"
    note = f"frames are numbered from 0 in alphabetical order: {why}"
    return PictureFiles(camera, tuple(enumerate(files)), (note,))
