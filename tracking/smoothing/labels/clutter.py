"""Density of false and static points over a whole run; compiled where it counts."""

from __future__ import annotations

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.compilation.jit import compiled
from geometry.compiled_projection import Views, inside, project_all, project_view
from geometry.forward_model import SpotModel
from tracking.rigid_body.association.frame_detections import BLENDED, CLUTTER_RADIUS_PX, ViewTable
from tracking.rigid_body.point_statistics import PicturePoints, no_places, static_log_density, update_places
from tracking.smoothing.motion.run_detections import Reference, RunDetections


@compiled
def clutter_density(
    views: Views, view_table: ViewTable, detections: RunDetections, assigned: Ints, ref: Reference, known: Bools
) -> Array:
    """False points per px^2 (cameras,) within CLUTTER_RADIUS_PX of the expected spots, over the known (T,) frames."""
    cameras = detections.has_image.shape[1]
    count, discs = np.zeros(cameras), np.zeros(cameras)
    uv, J = np.empty(2), np.empty((2, 6))
    radius2 = CLUTTER_RADIUS_PX * CLUTTER_RADIUS_PX
    for k in range(assigned.shape[0]):
        if not known[k]:
            continue
        for i in range(assigned.shape[1]):
            c = view_table.camera[i]
            if not detections.has_image[k, c] or not project_view(views, i, ref.R[k], ref.t[k], uv, J):
                continue
            if not inside(uv, view_table.size[i]):
                continue
            discs[c] += 1
            for d in range(detections.first[k, c], detections.first[k, c + 1]):
                row = detections.begin[k] + d
                a, b = detections.uv[row, 0] - uv[0], detections.uv[row, 1] - uv[1]
                taken = False
                for j in range(assigned.shape[1]):
                    taken |= assigned[k, j] == d or assigned[k, j] == d + BLENDED
                if not taken and a * a + b * b < radius2:
                    count[c] += 1
    for c in range(cameras):
        count[c] /= max(discs[c], 1.0) * np.pi * CLUTTER_RADIUS_PX**2
    return count


def run_log_clutter(
    model: SpotModel, view_table: ViewTable, detections: RunDetections, assigned: Ints, ref: Reference,
    known: Bools, min_per_px2: float,
) -> Array:  # fmt: skip
    """Log density (T, n) of false points, 1/px^2, by frame and view.

    The density near spots over the run, that of the frame's whole picture if it is higher, and at least min_per_px2.
    """
    near = clutter_density(model.numbers, view_table, detections, assigned, ref, known)
    area = np.array([np.prod(model.image_size_px[model.camera_of == c][:1]) for c in range(len(near))])
    density = np.maximum(np.maximum(near, np.diff(detections.first, axis=1) / area), min_per_px2)
    return np.ascontiguousarray(np.log(density)[:, model.camera_of])


def run_log_static(
    views: Views, view_table: ViewTable, detections: RunDetections, assigned: Ints, ref: Reference, known: Bools
) -> Array:
    """Log density (m,) of static points, 1/px^2, at each detection, from the known (T,) frames of the whole run."""
    places = no_places(detections.has_image.shape[1])
    expected, _ = project_all(views, ref.R, ref.t)
    rows = [slice(int(detections.begin[k]), int(detections.begin[k + 1])) for k in range(len(known))]
    for k in np.flatnonzero(known):
        labels = np.where(assigned[k] >= 0, assigned[k] % BLENDED, -1)
        points = PicturePoints(
            detections.uv[rows[k]], detections.cov[rows[k]], detections.first[k], detections.has_image[k]
        )
        update_places(places, points, labels, expected[k], view_table.camera, 1.0)
    parts = [
        static_log_density(places, detections.uv[r], detections.cov[r], detections.first[k]) for k, r in enumerate(rows)
    ]
    return np.concatenate([np.zeros(0), *parts])
