"""The model check's input: measured spots and poses of a recording."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.pose import Pose
from geometry.pose_solver.gauss_newton import whiten


@dataclass(frozen=True, slots=True)
class ModelCheckRecording:
    """T frames of n views, in the order of SpotModel.views. Values of spots that were not measured may be nan."""

    t_s: Array  # (T,) increasing
    seen: Bools  # (T, n) whether the spot was measured
    uv_px: Array  # (T, n, 2) measured
    cov_px2: Array  # (T, n, 2, 2) stated covariance of the measurement alone
    poses: Pose  # (T,) world_from_body, any good estimate; nan without one
    predicted_px: Array | None = None  # (T, n, 2) one-step predictions, made before the frame was processed
    predicted_cov_px2: Array | None = None  # (T, n, 2, 2) stated covariance of the predicted spot position
    pose_covariance: Array | None = None  # (T, 6, 6) stated by the run, [m in world, rad in body]
    width_px: Array | None = None  # (n,) usual sigma of each view's intensity profile; nan or None: unknown

    def __post_init__(self) -> None:
        T, n = self.seen.shape
        expected = {
            "t_s": (T,),
            "uv_px": (T, n, 2),
            "cov_px2": (T, n, 2, 2),
            "predicted_px": (T, n, 2),
            "predicted_cov_px2": (T, n, 2, 2),
            "pose_covariance": (T, 6, 6),
            "width_px": (n,),
        }
        for name, shape in expected.items():
            value = getattr(self, name)
            if value is not None and value.shape != shape:
                raise ValueError(f"{name}: expected shape {shape} as `seen` has {(T, n)}, got {value.shape}")
        if self.poses.translation.shape != (T, 3):
            raise ValueError(f"poses: expected {T} poses, got shape {self.poses.translation.shape}")

    @property
    def usable(self) -> Bools:
        """(T, n): measured, with finite pixels, a positive definite covariance and a pose of its frame."""
        a, b, c = self.cov_px2[..., 0, 0], self.cov_px2[..., 0, 1], self.cov_px2[..., 1, 1]
        known = finite(self.poses.translation, -1) & finite(self.poses.rotation, (-1, -2))
        with np.errstate(invalid="ignore"):
            positive = (a > 0) & (a * c - b * b > 0) & np.isfinite(a + b + c)
        return np.asarray(self.seen & finite(self.uv_px, -1) & positive & known[:, None])


def finite(values: Array, axes: int | tuple[int, ...]) -> Bools:
    """Whether all values along these axes are finite."""
    return np.asarray(np.isfinite(values).all(axis=axes), dtype=np.bool_)


def evenly_spaced(candidates: Ints, most: int) -> Ints:
    """At most `most` of the given frames, evenly spaced, including the first and the last."""
    if len(candidates) <= most:
        return candidates
    return candidates[np.unique(np.round(np.linspace(0, len(candidates) - 1, most)).astype(np.int64))]


def whitening(covariances: Array, where: Bools) -> Array:
    """W (..., 2, 2) with W C W^T = I where `where` (...) is true; 0 elsewhere."""
    safe = np.where(where[..., None, None], covariances, np.eye(2))
    return np.where(where[..., None, None], whiten(safe), 0.0)
