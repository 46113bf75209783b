"""Colour pictures of a recording, and the colour that the user names."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np

from geometry.arrays import Array, Ints
from lab.detect.inputs import PictureFiles, Video, open_inputs
from lab.errors import InputError
from lab.files.run.detections_file import is_too_sparse, read_detections
from lab.files.text.csv_text import read_table
from lab.files.text.error_text import name_of_path
from lab.pictures.colour import ColourPicture, colour_of, read_colour
from lab.pictures.opencv import load_cv2
from lab.pictures.picture_file import DROPPED, UNREADABLE, MissingPicture
from lab.runs.frames.frame_sources import open_video
from lab.runs.frames.sensor_noise import CameraNoise
from tracking.detections import Detections
from tracking.noise import Picture
from tracking.parameters import DetectParameters
from tracking.single_target.blobs import find_blobs
from tracking.single_target.colour import HUES, find_coloured, has_colour, hue_of
from tracking.single_target.parameters import BlobParameters

COLOUR = "colour"  # the detector


def hue_named(name: str | None) -> float:
    """Hue, degrees, of a name or of #rrggbb.

    Raises:
        InputError: there is no such colour, or it is a grey.
    """
    known = f"{', '.join(HUES)}, or #rrggbb such as #d02030"
    if name is None:
        raise InputError(f"--detector {COLOUR}: expected --colour with {known}, got none")
    if name in HUES:
        return HUES[name]
    digits = name.removeprefix("#")
    if not (name.startswith("#") and len(digits) == 6 and all(c in "0123456789abcdefABCDEF" for c in digits)):
        raise InputError(f"--colour: expected {known}, got {name!r}")
    red, green, blue = (float(int(digits[i : i + 2], 16)) for i in (0, 2, 4))
    hue = hue_of((blue, green, red))
    if hue is None:
        raise InputError(f"--colour: expected a colour, got the grey {name}; use --detector darker or brighter")
    return hue


def colour_pictures(inputs: PictureFiles | Video) -> Iterator[tuple[int, ColourPicture | MissingPicture]]:
    """All pictures with their frame numbers, (h, w, 3), BGR, 8 bits."""
    if isinstance(inputs, PictureFiles):
        for number, path in inputs.files:
            yield number, read_colour(path, None)
        return
    capture = open_video(inputs.path, colour=True)
    try:
        number = 0
        while capture.grab():
            decoded, picture = capture.retrieve()
            usable = decoded and picture is not None
            yield number, colour_of(picture, None) if usable else MissingPicture(f"{UNREADABLE}: damaged")
            number += 1
    finally:
        capture.release()


# The input of `beampose track point`: detections by frame, from pictures, a video or a table.


DETECTORS = ("spots", "darker", "brighter", COLOUR)
TABLE = "table"  # in place of a detector, for a CSV file
_COMPLETE_SHARE = 0.98  # of the pictures that a video's header states
LARGEST_RATE_HZ = 1e6  # a larger rate in a video's header is not one

Progress = Callable[[int, int | None], None]  # pictures done, total number of pictures where known


@dataclass(slots=True)
class PointRecording:
    """All frame numbers from the first to the last (T,), with the detections of each."""

    name: str
    path: Path
    detector: str  # one of DETECTORS, or TABLE
    frames: Ints  # (T,)
    found: list[Detections | None]  # None: no usable picture
    rate_hz: float | None
    t_s: Array | None  # (T,) None: the rate is not known
    size_px: tuple[int, int] | None  # width, height of the pictures
    missing: dict[str, int] = field(default_factory=dict)  # reason -> number of frames
    notes: list[str] = field(default_factory=list)

    @property
    def steps(self) -> Array:
        """Time from the frame before (T,), in frames: not whole numbers where the times are irregular."""
        if self.t_s is None or self.rate_hz is None:
            return np.diff(self.frames.astype(float), prepend=float(self.frames[0]))
        return np.diff(self.t_s, prepend=self.t_s[0]) * self.rate_hz


def read_recording(
    path: Path,
    detector: str,
    detect: DetectParameters,
    blobs: BlobParameters,
    rate_hz: float | None = None,
    camera: str | None = None,
    limit: int | None = None,
    progress: Progress | None = None,
    colour: str | None = None,
) -> PointRecording:
    """The detections of a folder of pictures, a video or a CSV file with frame,u_px,v_px.

    rate_hz: frames per second; None: that of a video's header or of the table's t_s, where there is one. camera: of a
    table with several. limit: largest number of pictures. colour: of the detector "colour", a name or #rrggbb.

    Raises:
        InputError: the path or an option cannot be used, or no picture can be read.
    """
    if path.suffix.lower() == ".csv":
        return _of_table(path, rate_hz, camera)
    if camera is not None:
        raise InputError(f"--camera: expected a table with a column camera, got {path}; leave the option out")
    inputs = open_inputs([path])
    if rate_hz is None and isinstance(inputs, Video):
        rate_hz = _header_rate(path)
    pictures = _searched(detector, inputs, detect, blobs, colour)
    by_frame: dict[int, Detections | None] = {}
    missing: dict[str, int] = {}
    size: tuple[int, int] | None = None
    total = inputs.count(1) if limit is None else limit
    done = 0
    for done, (frame, found) in enumerate(pictures, start=1):
        if isinstance(found, MissingPicture):
            by_frame[frame] = None
            missing[found.reason] = missing.get(found.reason, 0) + 1
        else:
            own, by_frame[frame] = found
            size = size or own
            if own != size:
                by_frame[frame] = None  # its pixels are not comparable
                why = f"another size: {own[0]}x{own[1]} px, the first picture has {size[0]}x{size[1]}"
                missing[why] = missing.get(why, 0) + 1
        if progress is not None:
            progress(done, total)
        if limit is not None and done >= limit:
            break
    if size is None:
        why = f": {max(missing, key=lambda r: missing[r])}" if missing else ""
        raise InputError(f"{path}: expected pictures, got none that can be read{why}")
    out = _filled(path, detector, by_frame, rate_hz, size)
    for reason, count in missing.items():
        out.missing[reason] = out.missing.get(reason, 0) + count
    out.notes += inputs.notes
    if isinstance(inputs, Video) and limit is None and total is not None and done < _COMPLETE_SHARE * total:
        out.notes.append(f"the video ends after {done} of the {total} pictures that its header states")
    return out


_Searched = Iterator[tuple[int, tuple[tuple[int, int], Detections] | MissingPicture]]


def _searched(
    detector: str, inputs: PictureFiles | Video, detect: DetectParameters, blobs: BlobParameters, colour: str | None
) -> _Searched:
    """Frame numbers with the width and height of the picture and its detections."""
    if detector == COLOUR:
        return _searched_for_colour(inputs, hue_named(colour), blobs)
    if colour is not None:
        raise InputError(f"--colour: belongs to --detector {COLOUR}, got --detector {detector}")
    search: Callable[[Picture], Detections] = partial(find_blobs, parameters=blobs)
    if detector == "spots":
        noise = CameraNoise(inputs.camera)
        noise.estimate_from([p for p in inputs.noise_pictures() if not isinstance(p, MissingPicture)])
        search = partial(noise.detect, parameters=detect)
    return (
        (frame, p if isinstance(p, MissingPicture) else ((p.shape[1], p.shape[0]), search(p)))
        for frame, p in inputs.pictures(1)
    )


def _searched_for_colour(inputs: PictureFiles | Video, hue_deg: float, blobs: BlobParameters) -> _Searched:
    """As `_searched`. Raises InputError at the end if no picture has colour: then the target cannot be seen."""
    coloured, shown = False, False
    for frame, picture in colour_pictures(inputs):
        if isinstance(picture, MissingPicture):
            yield frame, picture
            continue
        shown, coloured = True, coloured or has_colour(picture)
        yield frame, ((picture.shape[1], picture.shape[0]), find_coloured(picture, hue_deg, blobs))
    if shown and not coloured:
        raise InputError(f"{inputs.camera}: expected colour pictures, got grey ones; use --detector darker or brighter")


def _filled(
    path: Path, detector: str, by_frame: dict[int, Detections | None], rate_hz: float | None, size: tuple[int, int]
) -> PointRecording:
    """Every frame number from the first to the last; those between without a picture are dropped ones."""
    first, last = min(by_frame), max(by_frame)
    if is_too_sparse(last - first + 1, len(by_frame)):
        raise InputError(
            f"{path}: expected numbered pictures of one recording, got {len(by_frame)} with numbers from {first} to"
            f" {last}; move the strays out of the folder"
        )
    frames = np.arange(first, last + 1)
    dropped = len(frames) - len(by_frame)
    t_s = None if rate_hz is None else (frames - first) / rate_hz
    found = [by_frame.get(k) for k in frames.tolist()]
    missing = {DROPPED: dropped} if dropped else {}
    return PointRecording(
        name_of_path(path.with_suffix("")), path, detector, frames, found, rate_hz, t_s, size, missing
    )


def _header_rate(path: Path) -> float | None:
    """The frame rate in a video's header; None where it states none."""
    capture = open_video(path)
    rate = float(capture.get(load_cv2().CAP_PROP_FPS))
    capture.release()
    return rate if 0 < rate < LARGEST_RATE_HZ else None


def _of_table(path: Path, rate_hz: float | None, camera: str | None) -> PointRecording:
    file = read_detections(path, named="target")
    names = list(file.cameras)
    if camera is None and len(names) > 1:
        raise InputError(f"{path}: expected points of one camera, got {', '.join(names)}; choose one with --camera")
    chosen = names[0] if camera is None else camera
    if chosen not in file.cameras:
        raise InputError(f"--camera: expected one of {', '.join(names)}, got {chosen!r}")
    if is_too_sparse(file.last - file.first + 1, len(file.cameras[chosen].frames)):
        raise InputError(
            f"{path}: frame: expected numbers of one recording, got {file.first} to {file.last} with"
            f" {len(file.cameras[chosen].frames)} frames; are these time stamps?"
        )
    points = file.cameras[chosen]
    frames = np.arange(file.first, file.last + 1)
    found = [None if points.has_only_unusable_rows(k) else points.at(k) for k in frames.tolist()]
    unusable = sum(f is None for f in found)
    rate, t_s = _times(path, frames, rate_hz)
    missing = {"no usable row": unusable} if unusable else {}
    return PointRecording(
        name_of_path(path.with_suffix("")), path, TABLE, frames, found, rate, t_s, None, missing, list(file.notes)
    )


def _times(path: Path, frames: Ints, rate_hz: float | None) -> tuple[float | None, Array | None]:
    """Frame rate and times (T,) of a table: those of its column t_s, where it has one and no rate is given.

    Raises:
        InputError: t_s does not rise with the frame.
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
