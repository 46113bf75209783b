"""Error budget of a pose measured with a rig: noise, and each group of calibration errors.

For the design of a rig. The pose is estimated as in geometry/pose_solver/gauss_newton.py, by least squares with the
spots' noise and the calibration's errors weighted together: with J = d(pixels)/d(pose), S = d(pixels)/d(rig) and the
rig's covariance C, the pixels have the covariance V = sigma^2 I + S C S^T, the estimator is
G = (J^T V^-1 J)^-1 J^T V^-1, and the pose error is G times the error of the pixels. Source: ours; generalised least
squares, first-order error propagation.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from geometry.arrays import Array, Bools, symmetric
from geometry.camera import in_picture
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.pose_solver.gauss_newton import RANK_TOLERANCE
from geometry.uncertainty.rig_uncertainty import BOW, DIRECTION, POSE, Sensitivity, split_name

INTRINSICS, CAMERA_POSES, SCREEN_POSES = "camera intrinsics", "camera poses", "screen poses"
SCREEN_SHAPES, BEAM_DIRECTIONS, BEAM_POINTS = "screen shapes", "beam directions", "beam points"
GROUPS = (INTRINSICS, CAMERA_POSES, SCREEN_POSES, SCREEN_SHAPES, BEAM_DIRECTIONS, BEAM_POINTS)


def group_of(name: str) -> str:
    """The group of `GROUPS` that a rig's parameter belongs to."""
    kind, _, parameter = split_name(name)
    if kind == "cameras":
        return CAMERA_POSES if parameter in POSE else INTRINSICS
    if kind == "screens":
        return SCREEN_SHAPES if parameter in BOW else SCREEN_POSES
    return BEAM_DIRECTIONS if parameter in DIRECTION else BEAM_POINTS


@dataclass(frozen=True, slots=True)
class RigErrors:
    """Uncertainty of the p parameters of a rig, by source."""

    names: tuple[str, ...]  # (p,) as in geometry/uncertainty/rig_uncertainty.py
    covariance: Array  # (p, p)
    groups: Mapping[str, Array]  # by group (p, p): its part of the covariance; cross-covariance is not included
    moves: Array  # (p, q) joint change of the parameters by one sigma of each of q errors
    move_names: tuple[str, ...]  # (q,)
    move_sigmas: Array  # (q,) in the units of the names
    things: Sequence[tuple[str, str, Array]]  # `cameras.left`, its group, (p, p): the groups' parts by device


@dataclass(frozen=True, slots=True)
class Budget:
    """Error budgets of k poses. Covariances are of [dt (m, world), dtheta (rad, body)]; nan if not observable."""

    pixels: Array  # (k, n, 2) of the n views; nan where there is no projection
    seen: Bools  # (k, n) in the picture, not at its edge
    observable: Bools  # (k,)
    condition: Array  # (k,) condition number of J with columns of length 1; inf where not observable
    total: Array  # (k, 6, 6)
    noise: Array  # (k, 6, 6) from the spots' noise
    groups: Array  # (k, g, 6, 6) from each group alone; cross-covariance of groups is in the total only
    effects: Array  # (k, 6, q) effect of one sigma of each error alone
    things: Array  # (k, t, 6, 6) from each device's errors of one group alone


class PoseBudget:
    """Computes the budgets of poses for one rig and its errors."""

    def __init__(
        self, model: SpotModel, sensitivity: Sensitivity, errors: RigErrors, sigma_px: float, edge_px: float
    ) -> None:
        """sigma_px: of a spot's coordinates. edge_px: distance from the edge below which a spot is not visible.

        sensitivity: of the errors' names, in their order.
        """
        self._model, self._sensitivity, self._errors = model, sensitivity, errors
        self._sigma_px, self._edge_px = sigma_px, edge_px

    def of(self, poses: Pose) -> Budget:
        """The budgets of a batch (k,) of poses."""
        derivatives = self._model.derivatives(poses)
        pixels = derivatives.pixels
        seen: Bools = in_picture(pixels, self._model.image_size_px, -self._edge_px)
        k, n = seen.shape
        # A view without a visible spot does not contribute: its rows are 0, and its noise is 1.
        J = np.where(seen[..., None, None], derivatives.pose, 0.0).reshape(k, 2 * n, 6) / self._sigma_px
        S = np.where(seen[..., None, None], self._sensitivity.of(derivatives), 0.0).reshape(k, 2 * n, -1)
        S = S / self._sigma_px
        observable, condition = _rank(J)
        V = np.eye(2 * n) + S @ self._errors.covariance @ np.swapaxes(S, -1, -2)
        weighted = np.linalg.solve(V, J)  # V^-1 J
        H = symmetric(np.swapaxes(J, -1, -2) @ weighted)
        H = np.where(observable[:, None, None], H, np.eye(6))
        total: Array = np.asarray(np.linalg.inv(H), dtype=np.float64)
        G: Array = total @ np.swapaxes(weighted, -1, -2)  # (k, 6, 2n), of pixels in units of sigma_px
        K = G @ S  # (k, 6, p)
        parts = _carried(K, list(self._errors.groups.values()))
        things = _carried(K, [C for _, _, C in self._errors.things])
        blank = np.where(observable, 1.0, np.nan)[:, None, None]
        return Budget(
            pixels=pixels,
            seen=seen,
            observable=observable,
            condition=condition,
            total=symmetric(total) * blank,
            noise=G @ np.swapaxes(G, -1, -2) * blank,
            groups=parts * blank[:, None],
            effects=K @ self._errors.moves * blank,
            things=things * blank[:, None],
        )


def _carried(K: Array, covariances: Sequence[Array]) -> Array:
    """K C K^T (k, c, 6, 6) of Jacobians (k, 6, p) and covariances (p, p), which are mostly empty."""
    out = np.zeros((len(K), len(covariances), 6, 6))
    for i, C in enumerate(covariances):
        used = np.flatnonzero(C.any(axis=0))
        part = K[..., used]
        out[:, i] = part @ C[np.ix_(used, used)] @ np.swapaxes(part, -1, -2)
    return out


def _rank(J: Array) -> tuple[Bools, Array]:
    """Whether Jacobians (k, 2n, 6) have full rank, with the solver's tolerance; and their scaled condition (k,)."""
    H = np.swapaxes(J, -1, -2) @ J
    eigenvalues = np.linalg.eigvalsh(symmetric(H))
    observable: Bools = eigenvalues[:, 0] > RANK_TOLERANCE**2 * eigenvalues[:, -1]
    size = np.sqrt(np.maximum(np.diagonal(H, axis1=-2, axis2=-1), 1e-300))
    scaled = np.linalg.eigvalsh(symmetric(H / (size[:, :, None] * size[:, None, :])))
    with np.errstate(divide="ignore", invalid="ignore"):
        condition = np.sqrt(scaled[:, -1] / np.maximum(scaled[:, 0], 0.0))
    return observable, np.where(observable, condition, np.inf)


def worst_direction(covariance: Array) -> tuple[Array, Array]:
    """The largest sigma (k,) of covariances (k, 3, 3), and its direction (k, 3), a unit vector; nan for nan.

    The direction's largest coordinate is positive.
    """
    bad = np.asarray(np.isnan(covariance).any(axis=(-2, -1)))
    values, vectors = np.linalg.eigh(np.where(bad[:, None, None], np.eye(3), symmetric(covariance)))
    direction = vectors[..., -1]
    largest = np.take_along_axis(direction, np.argmax(np.abs(direction), axis=-1)[:, None], axis=-1)
    direction = direction * np.where(largest < 0, -1.0, 1.0)
    sigma = np.sqrt(np.maximum(values[:, -1], 0.0))
    return np.where(bad, np.nan, sigma), np.where(bad[:, None], np.nan, direction)


def along(covariances: Array, directions: Array) -> Array:
    """Variances (k, ...) of covariances (k, ..., 3, 3) along directions (k, 3)."""
    return np.einsum("ki,k...ij,kj->k...", directions, covariances, directions)
