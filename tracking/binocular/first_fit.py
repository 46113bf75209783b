"""The pose of labelled markers without a start: Horn's pose of the triangulated points, then the joint fit.

Far away the triangulated points give a poor attitude, and a flat target has two. The fit starts from Horn's pose and
from poses of three markers each (P3P), each also with the normal reflected, and keeps the least misfit. Source: ours.
"""

from __future__ import annotations

import numpy as np

from geometry.pose import Pose
from geometry.pose_solver.three_spots import poses_from_three_spots
from geometry.uncertainty.chi_square import chi2_tail
from tracking.binocular.acquisition import marker_triples, mirrored, same_pose
from tracking.binocular.joint_fit import JointFit, MarkerObservations, fit_pose
from tracking.binocular.marker_model import MarkerModel, StereoPair, project_markers
from tracking.binocular.triangulation import pose_of_points, triangulate

_STARTS = 3  # poses of three markers that are tried
_TRIPLES = 4
_PLAUSIBLE_P, _CLEAR_CHI2 = 1e-3, 25.0  # misfit of a right pose, and how much larger that of a wrong one is


def first_fit(pair: StereoPair, model: MarkerModel, observed: MarkerObservations) -> JointFit | None:
    """The pose with the least misfit; None where no start leads to one."""
    both = np.flatnonzero(observed.seen.all(axis=0))
    found: list[JointFit] = []
    if len(both) >= 3:
        points = triangulate(pair, observed.uv_px[:, both], observed.cov_px2[:, both])
        if np.isfinite(points.points).all():
            found = _fits(pair, model, observed, pose_of_points(model.positions[both], points.points))
    if not _clear(found):
        for start in _three_marker_poses(pair, model, observed):
            found += _fits(pair, model, observed, start)
    return min(found, key=lambda fit: fit.chi2, default=None)


def _fits(pair: StereoPair, model: MarkerModel, observed: MarkerObservations, start: Pose) -> list[JointFit]:
    """The fits from a pose and from the one with the normal reflected."""
    fits = (fit_pose(pair, model, observed, pose) for pose in (start, mirrored(pair, model, start)))
    return [fit for fit in fits if fit is not None and fit.observable]


def _clear(found: list[JointFit]) -> bool:
    """Whether the best of two fits is plausible and the other one is another pose, much worse."""
    if len(found) < 2:
        return False
    best, other = sorted(found, key=lambda fit: fit.chi2)
    same = same_pose(best.pose, other.pose)
    plausible = best.dof > 0 and chi2_tail(best.chi2, best.dof) > _PLAUSIBLE_P
    return plausible and not same and other.chi2 - best.chi2 > _CLEAR_CHI2


def _three_marker_poses(pair: StereoPair, model: MarkerModel, observed: MarkerObservations) -> list[Pose]:
    """Poses of triples that one camera sees, those with the smallest residuals of all markers."""
    poses: list[Pose] = []
    for c, camera in enumerate(pair.cameras):
        triples = [t for t in marker_triples(model) if observed.seen[c, list(t)].all()][:_TRIPLES]
        for triple in triples:
            eye, rays = camera.rays(observed.uv_px[c, list(triple)])
            if not np.isfinite(rays).all():
                continue
            solved = poses_from_three_spots(np.broadcast_to(eye, (3, 3)), rays, model.positions[list(triple)])
            good = np.isfinite(solved.translation).all(axis=-1)
            poses += [solved[int(i)].inverse() for i in np.flatnonzero(good)]
    if not poses:
        return []
    stack = Pose(np.stack([p.rotation for p in poses]), np.stack([p.translation for p in poses]))
    apart = np.nan_to_num(project_markers(pair, model, stack)[0] - observed.uv_px, nan=0.0)
    order = np.argsort((apart**2).sum(axis=(1, 2, 3)))
    return [poses[int(i)] for i in order[:_STARTS]]
