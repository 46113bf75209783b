"""detections.csv: the points of light of all cameras and frames, read in one go."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from geometry.arrays import Array, Bools, Ints
from lab.errors import InputError
from lab.files.text.csv_text import found_at, is_whole, read_table
from tracking.detections import Detections
from tracking.input_validation import LARGEST_PX, LEAST_SIGMA_PX, TWIN_PX, twins

if TYPE_CHECKING:
    import pandas as pd

REQUIRED = ("frame", "camera", "u_px", "v_px")
DEFAULT_SIGMA_PX = 0.1  # px: where the file gives no sigma; a centroid of a clean laser spot is about this good
SHAPE = ("flux", "peak", "major_px", "minor_px", "angle_deg")
SPARSEST = 1000  # frame numbers per picture: more than that is a stray number, or a number that holds a time
MANY = 100_000  # frame numbers that a run may span however sparse it is
LONGEST_GAP = 10_000  # frame numbers, 100 s at 100 Hz: behind a longer one so few pictures are strays ...
MOST_ALONE = 3
STRAY = 0.1  # of the frames: a few far from all others are left out, but who shall say which half of a run is wrong?


@dataclass(frozen=True, slots=True)
class CameraPoints:
    """One camera's points, all frames after one another."""

    frames: Ints  # (m,) increasing: frames with a point
    starts: Ints  # (m + 1,) rows of frame i: starts[i] to starts[i + 1]
    points: Detections  # within a frame brightest first
    spoilt: Ints  # increasing: frames that have rows, of which none can be used

    def at(self, frame: int) -> Detections:
        """The points of one frame, which may be none."""
        i = int(np.searchsorted(self.frames, frame))
        if i == len(self.frames) or self.frames[i] != frame:
            return Detections.none()
        return self.points[slice(int(self.starts[i]), int(self.starts[i + 1]))]

    def says_nothing_of(self, frame: int) -> bool:
        """Whether there are rows of a frame, but none that can be used."""
        i = int(np.searchsorted(self.spoilt, frame))
        return i < len(self.spoilt) and self.spoilt[i] == frame

    def without(self, rows: Bools) -> CameraPoints:
        """The same without some of the points (m,). A frame that has none left is still one with a picture."""
        kept = np.concatenate([[0], np.cumsum(~rows)])
        return CameraPoints(self.frames, kept[self.starts], self.points[~rows], self.spoilt)


@dataclass(frozen=True, slots=True)
class DetectionsFile:
    """A whole detections.csv."""

    cameras: Mapping[str, CameraPoints]
    first: int  # the least and the largest frame number of any camera
    last: int
    notes: tuple[str, ...]  # what was left out or assumed, in plain words
    spoilt: Mapping[str, str]  # cameras of whose rows not one can be used, and why the first of them


def read_detections(path: Path) -> DetectionsFile:
    """The points of a detections.csv.

    Rows may stand in any order. Those that cannot be used are left out and counted in `notes`, each reason with its
    first example. Raises InputError where the file is no table, lacks a column of REQUIRED, or has no usable row.
    """
    optional = ("sigma_u_px", "sigma_v_px", "cov_uv_px2", *SHAPE)
    table = read_table(path, REQUIRED, numbers=("frame", "u_px", "v_px", *optional), damaged=True)
    n = len(table)

    def column(name: str, default: float) -> Array:
        return table[name].to_numpy(dtype=float) if name in table else np.full(n, default)

    rows = _Rows(path, table, table["camera"].str.strip().to_numpy(), np.ones(n, dtype=bool))
    missing = [c for c in ("sigma_u_px", "sigma_v_px") if c not in table]
    if missing:
        rows.notes.append(f"{path}: no column {' and '.join(missing)}: {DEFAULT_SIGMA_PX} px is assumed")
    frame, uv = column("frame", np.nan), np.stack([column("u_px", np.nan), column("v_px", np.nan)], -1)
    sigma = np.stack([column("sigma_u_px", DEFAULT_SIGMA_PX), column("sigma_v_px", DEFAULT_SIGMA_PX)], -1)
    # An empty field of an optional column means what the column's absence means.
    shared = column("cov_uv_px2", 0.0)
    shared = np.where(np.isnan(shared), 0.0, shared)

    rows.leave_out_misplaced(frame)
    placed = rows.good.copy()
    rows.leave_out_unmeasured(uv, sigma, shared)
    rows.leave_out_repeated(frame, uv, sigma)
    if table.attrs["malformed"]:
        rows.notes.append(f"{path}: {table.attrs['malformed']} lines left out: more fields than the header has")
    if not rows.good.any():
        because = "".join(f"; {note.removeprefix(f'{path}: ')}" for note in rows.notes[len(missing) > 0 :])
        raise InputError(f"{path}: expected rows with {', '.join(REQUIRED)}, got none that can be used{because}")

    cov = np.tile(np.eye(2), (n, 1, 1))
    good = rows.good
    cov[good, 0, 0], cov[good, 1, 1] = sigma[good, 0] ** 2, sigma[good, 1] ** 2
    cov[good, 0, 1] = cov[good, 1, 0] = shared[good]
    points = Detections(uv, cov, *(column(name, np.nan) for name in SHAPE))
    cameras = {}
    for name in dict.fromkeys(rows.camera[good]):
        of = rows.camera == name
        cameras[str(name)] = _camera_points(np.flatnonzero(good & of), frame, points, frame[placed & of])
    spoilt = {name: why for name, why in rows.why_of.items() if name and name not in cameras}
    return DetectionsFile(cameras, int(frame[good].min()), int(frame[good].max()), tuple(rows.notes), spoilt)


@dataclass(slots=True)
class _Rows:
    """The n rows of a table, of which fewer and fewer are good."""

    path: Path
    table: pd.DataFrame
    camera: np.ndarray  # (n,) names
    good: Bools  # (n,)
    notes: list[str] = field(default_factory=list)
    why_of: dict[str, str] = field(default_factory=dict)  # by camera: what is wrong with its first bad row

    def leave_out_misplaced(self, frame: Array) -> None:
        """Rows of which it is not known of what picture they are."""
        self._leave_out(~is_whole(frame), "the frame is no whole number", "frame")
        self._leave_out(frame < 0, "the frame is negative; frames count from 0", "frame")
        self._leave_out(self.camera == "", "no camera is named")
        far = f"the frame is more than {LONGEST_GAP} numbers away from the others"
        self._leave_out(_stray(frame, self.good), far, "frame")

    def leave_out_unmeasured(self, uv: Array, sigma: Array, shared: Array) -> None:
        """Rows whose point or covariance is none: uv (n, 2) px, sigma (n, 2) px, shared (n,) px^2."""
        with np.errstate(invalid="ignore", over="ignore"):
            self._leave_out(~np.isfinite(uv).all(-1), "u_px or v_px is no finite number", "u_px", "v_px")
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
        """Rows of a spot that has another row in the same picture: its label would be shared between them."""
        rows = np.flatnonzero(self.good)
        if not rows.size:
            return
        camera = np.unique(self.camera[rows].astype(str), return_inverse=True)[1]
        numbers, which = np.unique(frame[rows], return_inverse=True)
        picture = camera * len(numbers) + which
        uv, size = uv[rows], (sigma[rows] ** 2).sum(-1)
        again = np.zeros(len(self.good), dtype=bool)
        again[rows] = twins(picture, uv, np.lexsort((uv[:, 1], uv[:, 0], picture)), size)
        why = f"the same point a second time, or one less than {TWIN_PX} px from it"
        self._leave_out(again, why, "u_px", "v_px")

    def _leave_out(self, which: ArrayLike, why: str, *fields: str) -> None:
        """These rows (n,), if they were good until now. fields: what the example shows."""
        new = np.flatnonzero(np.asarray(which, dtype=bool) & self.good)
        if not new.size:
            return
        first = int(new[0])
        shown = " and ".join(f"{f} {found_at(self.table, f, first)}" for f in fields if f in self.table)
        example = f"the first near line {first + 2}{', with ' if shown else ''}{shown}"
        self.notes.append(f"{self.path}: {new.size} of {len(self.good)} rows left out: {why} ({example})")
        for name in dict.fromkeys(self.camera[new]):
            self.why_of.setdefault(str(name), f"{why} ({example})")
        self.good[new] = False


def too_sparse(span: int, pictures: int) -> bool:
    """Whether so many frame numbers for so few pictures cannot be a run: each of them would be written out."""
    return span > MANY and span > SPARSEST * pictures


def far_off(numbers: Array | Ints) -> Bools:
    """Which of the rising frame numbers (n,) are strays: a few behind a gap longer than all that is recorded.

    Every number in the gap would cost what a frame costs: a file named 090000.png beside 300 pictures, 90 s.
    """
    long = np.diff(numbers) > max(LONGEST_GAP, len(numbers))
    piece = np.concatenate([np.zeros(1, dtype=np.int64), np.cumsum(long)])[: len(numbers)]
    sizes = np.bincount(piece, minlength=1)
    few = sizes <= max(1, min(MOST_ALONE, int(0.01 * len(numbers))))
    few[int(np.argmax(sizes))] = False
    return np.asarray(few[piece])


def _stray(frame: Array, good: Bools) -> Bools:
    """Which rows (n,) stand for a few frames so far from all the others that the run would be too sparse with them."""
    out = np.zeros(len(frame), dtype=bool)
    numbers = np.unique(frame[good])
    if not numbers.size:
        return out
    if not too_sparse(int(numbers[-1] - numbers[0]) + 1, numbers.size):
        out[good] = np.isin(frame[good], numbers[far_off(numbers)])
        return out
    pieces = np.split(numbers, np.flatnonzero(np.diff(numbers) > MANY) + 1)
    longest = max(pieces, key=len)
    if longest.size < (1 - STRAY) * numbers.size:
        return out  # the reader of the run says that it cannot be
    out[good] = (frame[good] < longest[0]) | (frame[good] > longest[-1])
    return out


def _camera_points(rows: Ints, frame: Array, points: Detections, placed: Array) -> CameraPoints:
    """Sorts a camera's rows by frame, then by flux, the brightest first; without flux the file's order stays.

    placed: the frames of all the camera's rows, usable or not.
    """
    order = rows[np.lexsort((np.nan_to_num(-points.flux[rows], nan=np.inf), frame[rows]))]
    frames, starts = np.unique(frame[order].astype(np.int64), return_index=True)
    spoilt = np.setdiff1d(placed.astype(np.int64), frames)
    return CameraPoints(frames, np.append(starts, len(order)), points[order], spoilt)
