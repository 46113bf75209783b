"""detections.csv: the detected points of all cameras and frames, read at once."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from geometry.arrays import Array, Bools, Ints, evenly_spread
from lab.errors import InputError
from lab.files.text.csv_text import Table, is_whole, read_table
from lab.number_format import format_count
from tracking.detections import Detections
from tracking.input_validation import DUPLICATE_PX, LARGEST_PX, LEAST_SIGMA_PX, duplicates

REQUIRED = ("frame", "camera", "u_px", "v_px")
DEFAULT_SIGMA_PX = 0.1  # px, where the file gives no sigma: about the centroid noise of a clean laser spot
LARGEST_SHAPE = 1e15  # largest magnitude of a number of SHAPE
SHAPE = ("flux", "peak", "major_px", "minor_px", "angle_deg")
# More frame numbers per picture indicate a stray number, or time stamps as frame numbers.
MAX_NUMBERS_PER_PICTURE = 1000
LONG_SPAN = 100_000  # frame numbers: a run that spans fewer may be sparser
LONGEST_GAP = 10_000  # frame numbers, 100 s at 100 Hz: after a longer gap, MAX_STRAY_FRAMES or fewer are strays
MAX_STRAY_FRAMES = 3
MAX_STRAY_SHARE = 0.1  # largest share of the frames that is left out as strays; with more the run is refused


@dataclass(frozen=True, slots=True)
class CameraPoints:
    """One camera's points of all frames, concatenated."""

    frames: Ints  # (m,) increasing: frames with points
    starts: Ints  # (m + 1,) rows of frame i: starts[i] to starts[i + 1]
    points: Detections  # within a frame: brightest first
    unusable: Ints  # increasing: frames that have rows, none of them usable

    def at(self, frame: int) -> Detections:
        """The points of one frame, possibly none."""
        i = int(np.searchsorted(self.frames, frame))
        if i == len(self.frames) or self.frames[i] != frame:
            return Detections.none()
        return self.points[slice(int(self.starts[i]), int(self.starts[i + 1]))]

    def spread(self, most: int) -> list[tuple[Array, Array, Array]]:
        """The points (n, 2), px, of so many frames spread over the recording, each with those before and after it."""
        uv, starts = self.points.uv_px, self.starts
        out = []
        for i in evenly_spread(np.arange(1, len(self.frames) - 1), most):
            first, here, after, end = starts[i - 1 : i + 3]
            out.append((uv[first:here], uv[here:after], uv[after:end]))
        return out

    def has_only_unusable_rows(self, frame: int) -> bool:
        """Whether a frame has rows, none of them usable."""
        i = int(np.searchsorted(self.unusable, frame))
        return i < len(self.unusable) and self.unusable[i] == frame

    def without(self, rows: Bools) -> CameraPoints:
        """The same without some of the points: rows (m,). A frame without points left still has a picture."""
        kept = np.concatenate([[0], np.cumsum(~rows)])
        return CameraPoints(self.frames, kept[self.starts], self.points[~rows], self.unusable)


@dataclass(frozen=True, slots=True)
class DetectionsFile:
    """A whole detections.csv."""

    cameras: Mapping[str, CameraPoints]
    first: int  # the smallest and the largest frame number of all cameras
    last: int
    notes: tuple[str, ...]  # what was left out or assumed
    unusable: Mapping[str, str]  # cameras without a usable row -> the reason of the first one


def read_detections(path: Path, named: str | None = None) -> DetectionsFile:
    """The points of a detections.csv. named: the camera of all rows, for a file that may lack the column.

    Rows may be in any order. Unusable rows are left out and counted in `notes`, each reason with its first example.
    Raises InputError: the file is not a table, lacks a column of REQUIRED, or has no usable row.
    """
    optional = ("sigma_u_px", "sigma_v_px", "cov_uv_px2", *SHAPE)
    required = tuple(name for name in REQUIRED if name != "camera" or named is None)
    table = read_table(path, required, (*optional, "camera"), damaged=True)
    n = len(table)

    def column(name: str, default: float) -> Array:
        return table.numbers[name] if name in table else np.full(n, default)

    names = table.words["camera"].tolist() if "camera" in table else [named] * n
    rows = _Rows(path, table, np.array(names, dtype=object), np.ones(n, dtype=bool))
    missing = [c for c in ("sigma_u_px", "sigma_v_px") if c not in table]
    if missing:
        rows.notes.append(f"{path}: no column {' and '.join(missing)}: {DEFAULT_SIGMA_PX} px is assumed")
    frame, uv = column("frame", np.nan), np.stack([column("u_px", np.nan), column("v_px", np.nan)], -1)
    sigma = np.stack([column("sigma_u_px", DEFAULT_SIGMA_PX), column("sigma_v_px", DEFAULT_SIGMA_PX)], -1)
    # An empty field of an optional column has the same meaning as a missing column.
    shared = column("cov_uv_px2", 0.0)
    shared = np.where(np.isnan(shared), 0.0, shared)

    rows.leave_out_misplaced(frame)
    placed = rows.good.copy()
    rows.leave_out_unmeasured(uv, sigma, shared)
    rows.leave_out_repeated(frame, uv, sigma)
    if table.long_lines:
        count = len(table.long_lines)
        why = "more fields than the header has (a comma too many, or a decimal comma)"
        rows.notes.append(f"{path}: {format_count(count, 'line')} left out: {why}")
    if (short := np.intersect1d(table.lines[rows.good], table.short_lines)).size:
        what = f"{format_count(len(short), 'line')} with fewer fields than the header, the first in line {short[0]}"
        rows.notes.append(f"{path}: {what}; their missing fields are taken as empty")
    if not rows.good.any():
        because = "".join(f"; {note.removeprefix(f'{path}: ')}" for note in rows.notes[len(missing) > 0 :])
        raise InputError(f"{path}: expected rows with {', '.join(required)}, got none that can be used{because}")

    cov = np.tile(np.eye(2), (n, 1, 1))
    good = rows.good
    cov[good, 0, 0], cov[good, 1, 1] = sigma[good, 0] ** 2, sigma[good, 1] ** 2
    cov[good, 0, 1] = cov[good, 1, 0] = shared[good]
    points = Detections(uv, cov, *(_stated(column(name, np.nan)) for name in SHAPE))
    cameras = {}
    for name in dict.fromkeys(rows.camera[good]):
        of = rows.camera == name
        cameras[str(name)] = _camera_points(np.flatnonzero(good & of), frame, points, frame[placed & of])
    unusable = {name: why for name, why in rows.why_of.items() if name and name not in cameras}
    return DetectionsFile(cameras, int(frame[good].min()), int(frame[good].max()), tuple(rows.notes), unusable)


def _stated(values: Array) -> Array:
    """A column (n,) of the points' shape; nan, as for an empty field, where no camera gives such a number."""
    return np.where(np.abs(values) <= LARGEST_SHAPE, values, np.nan)


@dataclass(slots=True)
class _Rows:
    """The n rows of a table. Each check marks further rows as unusable."""

    path: Path
    table: Table
    camera: np.ndarray  # (n,) names
    good: Bools  # (n,)
    notes: list[str] = field(default_factory=list)
    why_of: dict[str, str] = field(default_factory=dict)  # by camera: the reason of its first bad row

    def leave_out_misplaced(self, frame: Array) -> None:
        """Leaves out rows without a valid frame or camera."""
        self._leave_out(~is_whole(frame), "the frame is not a whole number", "frame")
        self._leave_out(frame < 0, "the frame is negative; frames count from 0", "frame")
        self._leave_out(self.camera == "", "the camera is empty")
        far = f"the frame is more than {LONGEST_GAP} numbers away from the others"
        self._leave_out(_stray(frame, self.good), far, "frame")

    def leave_out_unmeasured(self, uv: Array, sigma: Array, shared: Array) -> None:
        """Leaves out rows without a valid point or covariance: uv (n, 2) px, sigma (n, 2) px, shared (n,) px^2."""
        with np.errstate(invalid="ignore", over="ignore"):
            self._leave_out(~np.isfinite(uv).all(-1), "u_px or v_px is not a finite number", "u_px", "v_px")
            far = f"u_px or v_px is beyond {LARGEST_PX:.0f} px: no picture is so wide"
            self._leave_out((np.abs(uv) >= LARGEST_PX).any(-1), far, "u_px", "v_px")
            both = ("sigma_u_px", "sigma_v_px")
            self._leave_out(~(np.isfinite(sigma) & (sigma > 0)).all(-1), "a sigma is not above 0", *both)
            small = f"a sigma is below {LEAST_SIGMA_PX:g} px: no camera measures so well; is it in another unit?"
            self._leave_out((sigma < LEAST_SIGMA_PX).any(-1), small, *both)
            self._leave_out((sigma >= LARGEST_PX).any(-1), f"a sigma is beyond {LARGEST_PX:.0f} px", *both)
            largest = (1 - 1e-9) * sigma[:, 0] * sigma[:, 1]  # beyond it rounding makes the covariance singular
            singular = ~(np.abs(shared) < largest)
            self._leave_out(singular, "cov_uv_px2 is not below the product of the sigmas", "cov_uv_px2")

    def leave_out_repeated(self, frame: Array, uv: Array, sigma: Array) -> None:
        """Leaves out repeated rows of one spot in a picture: they would share its label."""
        rows = np.flatnonzero(self.good)
        if not rows.size:
            return
        camera = np.unique(self.camera[rows].astype(str), return_inverse=True)[1]
        numbers, which = np.unique(frame[rows], return_inverse=True)
        picture = camera * len(numbers) + which
        uv, size = uv[rows], (sigma[rows] ** 2).sum(-1)
        again = np.zeros(len(self.good), dtype=bool)
        again[rows] = duplicates(picture, uv, np.lexsort((uv[:, 1], uv[:, 0], picture)), size)
        why = f"the same point a second time, or one less than {DUPLICATE_PX} px from it"
        self._leave_out(again, why, "u_px", "v_px")

    def _leave_out(self, which: ArrayLike, why: str, *fields: str) -> None:
        """Leaves out these rows (n,), if not done already. fields: shown in the example."""
        new = np.flatnonzero(np.asarray(which, dtype=bool) & self.good)
        if not new.size:
            return
        first = int(new[0])
        shown = " and ".join(f"{f} {self.table.found(f, first)}" for f in fields if f in self.table)
        example = f"the first in line {self.table.lines[first]}{', with ' if shown else ''}{shown}"
        self.notes.append(f"{self.path}: {new.size} of {len(self.good)} rows left out: {why} ({example})")
        for name in dict.fromkeys(self.camera[new]):
            self.why_of.setdefault(str(name), f"{why} ({example})")
        self.good[new] = False


def is_too_sparse(span: int, pictures: int) -> bool:
    """Whether a span of frame numbers is too long for its pictures: the output has a row per frame number."""
    return span > LONG_SPAN and span > MAX_NUMBERS_PER_PICTURE * pictures


def stray_frames(numbers: Array | Ints) -> Bools:
    """Which of the rising frame numbers (n,) are strays: a few, separated by a gap longer than the recording.

    Every number in the gap costs as much as a frame: a file named 090000.png beside 300 pictures costs 90 s.
    """
    long = np.diff(numbers) > max(LONGEST_GAP, len(numbers))
    piece = np.concatenate([np.zeros(1, dtype=np.int64), np.cumsum(long)])[: len(numbers)]
    sizes = np.bincount(piece, minlength=1)
    few = sizes <= max(1, min(MAX_STRAY_FRAMES, int(0.01 * len(numbers))))
    few[int(np.argmax(sizes))] = False
    return np.asarray(few[piece])


def _stray(frame: Array, good: Bools) -> Bools:
    """Which rows (n,) belong to a few frames so far from all others that they would make the run too sparse."""
    out = np.zeros(len(frame), dtype=bool)
    numbers = np.unique(frame[good])
    if not numbers.size:
        return out
    if not is_too_sparse(int(numbers[-1] - numbers[0]) + 1, numbers.size):
        out[good] = np.isin(frame[good], numbers[stray_frames(numbers)])
        return out
    pieces = np.split(numbers, np.flatnonzero(np.diff(numbers) > LONG_SPAN) + 1)
    longest = max(pieces, key=len)
    if longest.size < (1 - MAX_STRAY_SHARE) * numbers.size:
        return out  # refused by the reader of the run
    out[good] = (frame[good] < longest[0]) | (frame[good] > longest[-1])
    return out


def _camera_points(rows: Ints, frame: Array, points: Detections, placed: Array) -> CameraPoints:
    """Sorts a camera's rows by frame, then by flux, brightest first; without flux in the order of the file.

    placed: the frames of all rows of the camera, usable or not.
    """
    order = rows[np.lexsort((np.nan_to_num(-points.flux[rows], nan=np.inf), frame[rows]))]
    frames, starts = np.unique(frame[order].astype(np.int64), return_index=True)
    unusable = np.setdiff1d(placed.astype(np.int64), frames)
    return CameraPoints(frames, np.append(starts, len(order)), points[order], unusable)
