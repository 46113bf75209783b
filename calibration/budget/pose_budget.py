"""What a pose measured with a rig would be known to, and which error makes how much of it: noise, and each calibration.

For designing a rig before it stands. The pose is taken to be solved as geometry/pose_solver/gauss_newton.py does it, by
least squares with the spots' noise and the calibration's errors weighed together: with J = d(pixels)/d(pose), S =
d(pixels)/d(rig) and the rig's covariance C, the pixels err by V = sigma^2 I + S C S^T, the solution is G = (J^T V^-1
J)^-1 J^T V^-1, and the pose errs by G of whatever the pixels err by. Source: ours; generalised least squares, error
propagation to first order.
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
from geometry.uncertainty.rig_parameters import BOW, DIRECTION, POSE, Sensitivity, split

INTRINSICS, CAMERA_POSES, SCREEN_POSES = "camera intrinsics", "camera poses", "screen poses"
SCREEN_SHAPES, BEAM_DIRECTIONS, BEAM_POINTS = "screen shapes", "beam directions", "beam points"
GROUPS = (INTRINSICS, CAMERA_POSES, SCREEN_POSES, SCREEN_SHAPES, BEAM_DIRECTIONS, BEAM_POINTS)


def group_of(name: str) -> str:
    """Which of `GROUPS` a rig's parameter belongs to."""
    kind, _, parameter = split(name)
    if kind == "cameras":
        return CAMERA_POSES if parameter in POSE else INTRINSICS
    if kind == "screens":
        return SCREEN_SHAPES if parameter in BOW else SCREEN_POSES
    return BEAM_DIRECTIONS if parameter in DIRECTION else BEAM_POINTS


@dataclass(frozen=True, slots=True)
class RigErrors:
    """What the p numbers of a rig are known to, and which sources of error make it."""

    names: tuple[str, ...]  # (p,) as in geometry/uncertainty/rig_parameters.py
    covariance: Array  # (p, p)
    groups: Mapping[str, Array]  # by group (p, p): its share of the covariance; what joins groups is in none of them
    moves: Array  # (p, q) how the numbers move together when one of q errors is one sigma
    move_names: tuple[str, ...]  # (q,)
    move_sigmas: Array  # (q,) in the units of the names
    things: Sequence[tuple[str, str, Array]]  # `cameras.left`, its group, (p, p): the groups' shares thing by thing


@dataclass(frozen=True, slots=True)
class Budget:
    """Of k poses. Covariances are of [dt (m, world), dtheta (rad, body)]; nan where the pose is not observable."""

    pixels: Array  # (k, n, 2) of the n views; nan where there is no projection
    seen: Bools  # (k, n) in the picture, clear of its edge
    observable: Bools  # (k,)
    condition: Array  # (k,) largest over least singular value of J, each column at length 1; inf where not observable
    total: Array  # (k, 6, 6)
    noise: Array  # (k, 6, 6) from the spots' noise
    groups: Array  # (k, g, 6, 6) from each group alone; what joins groups is in the total only
    effects: Array  # (k, 6, q) what one sigma of each error alone does
    things: Array  # (k, t, 6, 6) from each thing's errors of one group alone


class PoseBudget:
    """Asked for poses, answers with budgets. Prepared once per rig and its errors."""

    def __init__(
        self, model: SpotModel, sensitivity: Sensitivity, errors: RigErrors, sigma_px: float, edge_px: float
    ) -> None:
        """sigma_px: of a spot's coordinates. edge_px: a spot nearer to its picture's edge does not count as seen.

        sensitivity: of the errors' names, in their order.
        """
        self._model, self._sensitivity, self._errors = model, sensitivity, errors
        self._sigma_px, self._edge_px = sigma_px, edge_px

    def of(self, poses: Pose) -> Budget:
        """The budgets of a stack (k,) of poses."""
        derivatives = self._model.derivatives(poses)
        pixels = derivatives.pixels
        seen: Bools = in_picture(pixels, self._model.image_size_px, -self._edge_px)
        k, n = seen.shape
        # A view that is not seen says nothing: its rows vanish, and its own noise stays as a harmless 1.
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
    """Whether Jacobians (k, 2n, 6) have full rank, by the solver's own tolerance; and their scaled condition (k,)."""
    H = np.swapaxes(J, -1, -2) @ J
    eigenvalues = np.linalg.eigvalsh(symmetric(H))
    observable: Bools = eigenvalues[:, 0] > RANK_TOLERANCE**2 * eigenvalues[:, -1]
    size = np.sqrt(np.maximum(np.diagonal(H, axis1=-2, axis2=-1), 1e-300))
    scaled = np.linalg.eigvalsh(symmetric(H / (size[:, :, None] * size[:, None, :])))
    with np.errstate(divide="ignore", invalid="ignore"):
        condition = np.sqrt(scaled[:, -1] / np.maximum(scaled[:, 0], 0.0))
    return observable, np.where(observable, condition, np.inf)


def worst_direction(covariance: Array) -> tuple[Array, Array]:
    """The largest sigma (k,) of covariances (k, 3, 3), and its direction (k, 3), unit; nan stay nan.

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
