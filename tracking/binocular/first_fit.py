"""The pose of labelled markers without a start: Horn's pose of the triangulated points, then the joint fit.

Far away the triangulated points give a poor attitude, and a flat target has two. The fit starts from Horn's pose and
from poses of three markers each (P3P), each also with the normal reflected, and keeps the least misfit. Source: ours.
"""

from __future__ import annotations

import numpy as np

from geometry.pose import Pose
from geometry.pose_solver.three_spots import poses_from_three_spots
from tracking.binocular.acquisition import marker_triples, mirrored
from tracking.binocular.horn import pose_of_points
from tracking.binocular.joint_fit import JointFit, MarkerObservations, fit_pose
from tracking.binocular.marker_model import MarkerModel, StereoPair, project_markers
from tracking.binocular.triangulation import triangulate

_STARTS = 3  # poses of three markers that are tried
_TRIPLES = 4


def first_fit(pair: StereoPair, model: MarkerModel, observed: MarkerObservations) -> JointFit | None:
    """The pose with the least misfit; None where no start leads to one."""
    found: JointFit | None = None
    for start in _starts(pair, model, observed):
        for pose in (start, mirrored(pair, model, start)):
            fit = fit_pose(pair, model, observed, pose)
            if fit is not None and fit.observable and (found is None or fit.chi2 < found.chi2):
                found = fit
    return found


def _starts(pair: StereoPair, model: MarkerModel, observed: MarkerObservations) -> list[Pose]:
    both = np.flatnonzero(observed.seen.all(axis=0))
    starts = []
    if len(both) >= 3:
        points = triangulate(pair, observed.uv_px[:, both], observed.cov_px2[:, both])
        if np.isfinite(points.points).all():
            starts.append(pose_of_points(model.positions[both], points.points))
    return starts + _three_marker_poses(pair, model, observed)


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
