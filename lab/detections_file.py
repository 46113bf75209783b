"""detections.csv: the points of light of all cameras and frames, read in one go."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from geometry.arrays import Array, Ints
from lab.csv_text import is_whole, read_table
from tracking.detections import Detections

REQUIRED = ("frame", "camera", "u_px", "v_px")
DEFAULT_SIGMA_PX = 0.1  # px: where the file gives no sigma; a centroid of a clean laser spot is about this good
SHAPE = ("flux", "peak", "major_px", "minor_px", "angle_deg")


@dataclass(frozen=True, slots=True)
class CameraPoints:
    """One camera's points, all frames after one another."""

    frames: Ints  # (m,) increasing: frames with a point
    starts: Ints  # (m + 1,) rows of frame i: starts[i] to starts[i + 1]
    points: Detections  # within a frame brightest first

    def at(self, frame: int) -> Detections:
        """The points of one frame, which may be none."""
        i = int(np.searchsorted(self.frames, frame))
        if i == len(self.frames) or self.frames[i] != frame:
            return Detections.none()
        return self.points[slice(int(self.starts[i]), int(self.starts[i + 1]))]


@dataclass(frozen=True, slots=True)
class DetectionsFile:
    """A whole detections.csv."""

    cameras: Mapping[str, CameraPoints]
    first: int  # the least and the largest frame number of any camera
    last: int
    notes: tuple[str, ...]  # what was left out or assumed, in plain words


def read_detections(path: Path) -> DetectionsFile | None:
    """The points of a detections.csv; None if it has no usable row.

    Rows that cannot be used are left out and counted in `notes`. Raises InputError where the file is no table or lacks
    frame, camera, u_px or v_px.
    """
    optional = ("sigma_u_px", "sigma_v_px", "cov_uv_px2", *SHAPE)
    table = read_table(path, REQUIRED, numbers=("frame", "u_px", "v_px", *optional), damaged=True)
    n = len(table)
    notes = []

    def column(name: str, default: float) -> Array:
        return table[name].to_numpy(dtype=float) if name in table else np.full(n, default)

    missing = [c for c in ("sigma_u_px", "sigma_v_px") if c not in table]
    if missing:
        notes.append(f"{path}: no column {' and '.join(missing)}: {DEFAULT_SIGMA_PX} px is assumed")
    frame, uv = column("frame", np.nan), np.stack([column("u_px", np.nan), column("v_px", np.nan)], -1)
    sigma = np.stack([column("sigma_u_px", DEFAULT_SIGMA_PX), column("sigma_v_px", DEFAULT_SIGMA_PX)], -1)
    # An empty field of an optional column means what the column's absence means.
    shared = column("cov_uv_px2", 0.0)
    shared = np.where(np.isnan(shared), 0.0, shared)
    camera = table["camera"].str.strip()

    bad = np.zeros(n, dtype=bool)

    def leave_out(which: ArrayLike, why: str) -> None:
        new = np.asarray(which, dtype=bool) & ~bad
        if new.any():
            line = int(np.flatnonzero(new)[0]) + 2
            notes.append(f"{path}: {new.sum()} of {n} rows left out: {why} (the first near line {line})")
        bad[new] = True

    with np.errstate(invalid="ignore"):
        leave_out(~is_whole(frame), "the frame is no whole number")
        leave_out((camera == "").to_numpy(), "no camera is named")
        leave_out(~np.isfinite(uv).all(-1), "u_px or v_px is no finite number")
        leave_out(~(np.isfinite(sigma) & (sigma > 0)).all(-1), "a sigma is not above 0")
        largest = (1 - 1e-9) * sigma[:, 0] * sigma[:, 1]  # beyond it rounding makes the covariance singular
        leave_out(~(np.abs(shared) < largest), "cov_uv_px2 is not below the product of the sigmas")
    keys = table.assign(camera=camera)[["frame", "camera", "u_px", "v_px"]]
    repeated = np.zeros(n, dtype=bool)
    repeated[~bad] = keys[~bad].duplicated().to_numpy()
    leave_out(repeated, "the same point a second time")
    if table.attrs["malformed"]:
        notes.append(f"{path}: {table.attrs['malformed']} lines left out: more fields than the header has")
    if bad.all():
        return None

    cov = np.empty((n, 2, 2))
    cov[:, 0, 0], cov[:, 1, 1] = sigma[:, 0] ** 2, sigma[:, 1] ** 2
    cov[:, 0, 1] = cov[:, 1, 0] = shared
    points = Detections(uv, cov, *(column(name, np.nan) for name in SHAPE))
    names = camera.to_numpy()
    cameras = {
        str(name): _camera_points(np.flatnonzero(~bad & (names == name)), frame, points)
        for name in dict.fromkeys(names[~bad])
    }
    return DetectionsFile(cameras, int(frame[~bad].min()), int(frame[~bad].max()), tuple(notes))


def _camera_points(rows: Ints, frame: Array, points: Detections) -> CameraPoints:
    """Sorts a camera's rows by frame, then by flux, the brightest first; without flux the file's order stays."""
    order = rows[np.lexsort((np.nan_to_num(-points.flux[rows], nan=np.inf), frame[rows]))]
    frames, starts = np.unique(frame[order].astype(np.int64), return_index=True)
    return CameraPoints(frames, np.append(starts, len(order)), points[order])
