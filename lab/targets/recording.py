"""The recording of one camera in which a target is tracked: its pictures by frame number, its rate and its times."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from geometry.arrays import Array, Ints
from lab.errors import InputError
from lab.files.run.detections_file import is_too_sparse, read_detections
from lab.files.text.csv_text import read_table
from lab.files.text.error_text import name_of_path, require_one_of
from lab.pictures.delivery import Delivery, without_repeats
from lab.pictures.picture_file import DROPPED, MissingPicture
from lab.pictures.source import PictureFiles, PictureSource, Video, pictures
from lab.progress import Progress
from tracking.detections import Detections

DEFAULT_RATE_HZ = 25.0  # of a folder of pictures, whose rate is not known
_COMPLETE_SHARE = 0.98  # of the pictures that a video's header states

Looked = TypeVar("Looked")
P = TypeVar("P", bound=np.ndarray)


@dataclass(frozen=True, slots=True)
class Recording:
    """The n frames of a recording, from the first number to the last, dropped ones too."""

    name: str
    path: Path
    rate_hz: float | None  # None: not known
    numbers: Ints  # (n,)
    t_s: Array | None  # (n,) None: the rate is not known
    size_px: tuple[int, int] | None  # width, height of the first picture; None: a table
    missing: Mapping[str, int] = field(default_factory=dict)  # frames without a usable picture by reason
    notes: tuple[str, ...] = ()
    delivery: Delivery = field(default_factory=Delivery)  # of its pictures

    @property
    def pictures(self) -> int:
        """Number of usable pictures."""
        return len(self.numbers) - sum(self.missing.values())

    @property
    def steps(self) -> Array:
        """Time from the frame before (n,), in frames: not whole numbers where the times are irregular."""
        if self.t_s is None or self.rate_hz is None:
            return np.diff(self.numbers.astype(float), prepend=float(self.numbers[0]))
        return np.diff(self.t_s, prepend=self.t_s[0]) * self.rate_hz


def every_frame(source: PictureSource, limit: int | None = None, *, colour: bool = False) -> Iterator[tuple[int, Any]]:
    """All frame numbers from the first to the last with their pictures; a gap in the numbers is dropped frames.

    limit: of the pictures. colour: as for `pictures`. Pictures that repeat the one before are missing, and those of
    another size than the first: their pixels would not be comparable. Raises InputError: the numbers in the names of
    the pictures are not those of frames.
    """
    _require_frame_numbers(source, limit)
    return _without_gaps(islice(without_repeats(pictures(source, colour=colour)), limit))


def _require_frame_numbers(inputs: PictureSource, limit: int | None) -> None:
    """Raises InputError where the numbers in the names of the pictures are not those of frames."""
    if isinstance(inputs, PictureFiles):
        numbers = list(inputs.files)[:limit]
        if is_too_sparse(numbers[-1] - numbers[0] + 1, len(numbers)):
            raise InputError(
                f"{inputs.camera}: expected pictures numbered by frame, got {len(numbers)} with numbers from"
                f" {numbers[0]} to {numbers[-1]}; rename them, or move the strays out of the folder"
            )


def _without_gaps(pictures: Iterator[tuple[int, P | MissingPicture]]) -> Iterator[tuple[int, P | MissingPicture]]:
    last: int | None = None
    size: tuple[int, int] | None = None
    for number, picture in pictures:
        for dropped in range(number if last is None else last + 1, number):
            yield dropped, MissingPicture(DROPPED)
        own = None if isinstance(picture, MissingPicture) else (picture.shape[1], picture.shape[0])
        size = size or own
        if own is None or size is None or own == size:
            yield number, picture
        else:
            words = f"another size: {own[0]}x{own[1]} px, the first picture has {size[0]}x{size[1]}"
            yield number, MissingPicture(words)
        last = number


def read_pictures(
    inputs: PictureSource,
    path: Path,
    frames: Iterator[tuple[int, P | MissingPicture]],
    look: Callable[[P | None], Looked],
    rate_hz: float | None,
    *,
    limit: int | None,
    smallest_px: int = 1,
    progress: Progress | None = None,
) -> tuple[Recording, list[Looked], float]:
    """Look at every frame of a recording; with what was seen in each, and the process time of that, s.

    frames: of `every_frame`. look: gets the picture, or None where there is no usable one. smallest_px: least side of
    the pictures. Raises InputError: no picture could be read, or they are too small.
    """
    numbers: list[int] = []
    looked: list[Looked] = []
    missing: Counter[str] = Counter()
    size: tuple[int, int] | None = None
    stated, process_s = inputs.count, 0.0
    delivery = Delivery()
    total = stated if limit is None or stated is None else min(stated, limit)
    for number, picture in frames:
        usable = None if isinstance(picture, MissingPicture) else picture
        if isinstance(picture, MissingPicture):
            missing[picture.reason] += 1
        else:
            size = picture.shape[1], picture.shape[0]
        begun = time.process_time()
        looked.append(look(usable))
        delivery.add(usable)
        process_s += time.process_time() - begun
        numbers.append(number)
        if progress is not None:
            progress(len(numbers), total)
    if size is None:
        reason = missing.most_common(1)[0][0] if missing else "the file ends before its first picture"
        raise InputError(f"{path}: expected pictures, got none that can be read: {reason}")
    if min(size) < smallest_px:
        raise InputError(
            f"{path}: expected pictures of {smallest_px} x {smallest_px} px or more, got {size[0]} x {size[1]}"
        )
    notes = list(inputs.notes)
    if isinstance(inputs, Video) and limit is None and stated is not None and len(numbers) < _COMPLETE_SHARE * stated:
        notes.append(f"the video ends after {len(numbers)} of the {stated} pictures that its header states")
    of_frames = np.array(numbers)
    t_s = None if rate_hz is None else of_frames / rate_hz
    recording = Recording(inputs.camera, path, rate_hz, of_frames, t_s, size, missing, tuple(notes), delivery)
    return recording, looked, process_s


def read_points(path: Path, rate_hz: float | None, camera: str | None) -> tuple[Recording, list[Detections | None]]:
    """The points of one camera in a CSV file with frame,u_px,v_px; None where no row of a frame can be used.

    rate_hz: None: that of the column t_s, where there is one. camera: of a table with several. Raises InputError: the
    table cannot be used, or has other cameras.
    """
    file = read_detections(path, named="target")
    names = list(file.cameras)
    if camera is None and len(names) > 1:
        raise InputError(f"{path}: expected points of one camera, got {', '.join(names)}; choose one with --camera")
    chosen = names[0] if camera is None else camera
    require_one_of("--camera", chosen, names)
    points = file.cameras[chosen]
    if is_too_sparse(file.last - file.first + 1, len(points.frames)):
        raise InputError(
            f"{path}: frame: expected numbers of one recording, got {file.first} to {file.last} with"
            f" {len(points.frames)} frames; are these time stamps?"
        )
    frames = np.arange(file.first, file.last + 1)
    found = [None if points.has_only_unusable_rows(k) else points.at(k) for k in frames.tolist()]
    unusable = sum(f is None for f in found)
    rate, t_s = _times(path, frames, rate_hz)
    missing = {"no usable row": unusable} if unusable else {}
    name = name_of_path(path.with_suffix(""))
    return Recording(name, path, rate, frames, t_s, None, missing, tuple(file.notes)), found


def _times(path: Path, frames: Ints, rate_hz: float | None) -> tuple[float | None, Array | None]:
    """Frame rate and times (n,) of a table: those of its column t_s, where it has one and no rate is given.

    Raises InputError: t_s does not rise with the frame.
    """
    if rate_hz is not None:
        return rate_hz, (frames - frames[0]) / rate_hz
    table = read_table(path, ("frame",), ("t_s",), damaged=True)
    good = np.isfinite(table.numbers["t_s"]) & np.isfinite(table.numbers["frame"])
    good &= (table.numbers["frame"] >= frames[0]) & (table.numbers["frame"] <= frames[-1])
    numbers, first = np.unique(table.numbers["frame"][good], return_index=True)
    t = table.numbers["t_s"][good][first]
    if len(numbers) < 2:
        return None, None
    rates = np.diff(numbers) / np.where(np.diff(t) > 0, np.diff(t), np.nan)
    if np.isnan(rates).any():
        at = int(numbers[int(np.flatnonzero(np.isnan(rates))[0]) + 1])
        raise InputError(f"{path}: t_s: expected times that rise with the frame, got one that does not at frame {at}")
    rate = float(np.median(rates))
    known = np.interp(frames, numbers, t)
    outside = np.clip(frames, numbers[0], numbers[-1])
    return rate, known + (frames - outside) / rate  # beyond the first and last time: at the median rate
