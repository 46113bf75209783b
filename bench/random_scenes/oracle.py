"""The result with the true labels: the pose of each frame, and whether the first frame has a unique solution."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bench.random_scenes.scene import CLUTTER, SHINING, Scene
from geometry.arrays import Array, Bools
from geometry.forward_model import SpotModel
from geometry.pose_prior import PosePrior
from geometry.pose_solver.gauss_newton import SolveLimits, fit_pose, is_measurement
from geometry.pose_solver.visibility import symmetries
from tracking.detections import Detections
from tracking.labelling.first_labels import find_labels

FIRST_FRAMES = 3  # first frames, each of which must determine a pose ...
LEAST_SPOTS = 4  # ... from at least this number of spots
LEAST_SOLVABLE = 0.5  # share of all frames that must determine one
EXACT_SIGMA = 0.005  # px, noise of the points that are searched for a tie
TIE_CHI2 = 30.0  # of a wrong pose that the first frame's noise cannot exclude


@dataclass(frozen=True, slots=True)
class Oracle:
    """The result that a tracker can be expected to reach."""

    solvable: Bools  # (T,) the spots of the frame determine a pose
    nees: Array  # (T,) of that pose; nan without
    tie: bool  # the first frame has another solution within the prior
    first_solvable: bool  # or this is not required

    @property
    def counts(self) -> bool:
        """A tracker can be expected to solve the scene."""
        return self.first_solvable and not self.tie and float(self.solvable.mean()) >= LEAST_SOLVABLE

    @property
    def why_not(self) -> str:
        """The reason why the scene does not count; empty if it counts."""
        if not self.first_solvable:
            return "first frames give no pose"
        if self.solvable.mean() < LEAST_SOLVABLE:
            return "most frames give no pose"
        return "tie in the first frame" if self.tie else ""


def ask_oracle(scene: Scene) -> Oracle:
    """Fit every frame with its true labels, from the true pose."""
    model = SpotModel.of(scene.rig)
    limits = SolveLimits()
    solvable, nees = np.zeros(len(scene), dtype=bool), np.full(len(scene), np.nan)
    shining = scene.shining
    for k in range(len(scene)):
        rows = np.flatnonzero(shining[k])
        if len(np.unique(scene.spot_of[rows])) < 3:
            continue
        uv = measured_pixels(scene, k)[rows]
        covariances = scene.sigma_px[rows, None, None] ** 2 * np.eye(2)
        fit = fit_pose(model, rows, uv, covariances, scene.poses[k])
        if fit is None or not is_measurement(fit, limits):
            continue
        d = scene.poses[k].minus(fit.world_from_body)
        solvable[k], nees[k] = True, float(d @ np.linalg.solve(fit.covariance, d))
    spots = [len(np.unique(scene.spot_of[shining[k]])) for k in range(FIRST_FRAMES)]
    first = bool(solvable[:FIRST_FRAMES].all() and min(spots) >= LEAST_SPOTS)
    return Oracle(solvable, nees, first and _ties(scene, model), first or scene.late_start)


def measured_pixels(scene: Scene, k: int) -> Array:
    """The detected position of each view (n, 2), px; nan without a point."""
    out = np.full((len(scene.camera_of), 2), np.nan)
    for found, origin in zip(scene.detections[k], scene.origin[k], strict=True):
        of_spot = origin != CLUTTER
        out[origin[of_spot]] = found.uv_px[of_spot]
    return out


def _ties(scene: Scene, model: SpotModel) -> bool:
    """The noise-free first frame without false points has another solution that its noise cannot exclude.

    Without a prior: the vehicle is symmetric.
    """
    if scene.prior is None:
        return bool(symmetries(model))
    return another_pose(scene, model, scene.prior)


def another_pose(scene: Scene, model: SpotModel, prior: PosePrior) -> bool:
    """As `_ties`, within a given prior."""
    found = {}
    for c, name in enumerate(model.camera_names):
        rows = np.flatnonzero((scene.camera_of == c) & (scene.in_view[0] == SHINING))
        found[name] = Detections.at(scene.uv_px[0][rows], np.tile(EXACT_SIGMA**2 * np.eye(2), (len(rows), 1, 1)))
    for other in find_labels(scene.rig, model, found, prior).candidates:
        used = np.flatnonzero(other.point_of >= 0)
        at = np.array([found[model.camera_names[scene.camera_of[v]]].uv_px[other.point_of[v]] for v in used])
        if len(used) == len(np.flatnonzero(scene.in_view[0] == SHINING)) and np.allclose(
            at, scene.uv_px[0][used], atol=1e-6
        ):
            continue  # the true labels
        covariances = scene.sigma_px[used, None, None] ** 2 * np.eye(2)
        fit = fit_pose(model, used, at, covariances, other.fit.world_from_body)
        if fit is not None and fit.chi2 < TIE_CHI2 and len(used) >= min(LEAST_SPOTS, model.spot_of.max() + 1):
            return True
    return False
