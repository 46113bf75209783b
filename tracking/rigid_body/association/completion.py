"""Labels of the spots that a pose explains although the joint search did not reach them; compiled.

The joint search linearises the projection. Where the prediction is far off, the linearised places of the last spots are
too, and a spot beyond the edge of its screen is not searched for at all. The pose of the labelled spots shows where
they are. Source: ours.
"""

from __future__ import annotations

import numpy as np

from geometry.arrays import Array, Ints
from geometry.compilation.jit import compiled
from tracking.rigid_body.association.frame_detections import Observation
from tracking.rigid_body.association.joint_search import GATE_CHI2, LOG_2PI, is_taken
from tracking.rigid_body.association.likelihood import log_false_density, predicted_pixel
from tracking.rigid_body.models.information import inverse_2x2

MAX_SIGMA_PX = 8.0  # of a spot's place at the pose; with a larger one the search has alternatives of its own


@compiled
def complete(obs: Observation, assigned: Ints, R: Array, t: Array, P: Array, p_unoccluded: Array) -> bool:
    """Label the spots of an assignment (n,), in place, that a pose (R, t) with its P explains; whether there are any.

    P (6 or more, square); p_unoccluded (n,): marginal probability that each spot is not occluded.
    """
    frame, found = obs.frame, False
    uv, J = np.empty(2), np.empty((2, 6))
    for i in range(assigned.shape[0]):
        camera = obs.view_table.camera[i]
        if assigned[i] >= 0 or not frame.has_image[camera]:
            continue
        projected, a, b, c = predicted_pixel(obs.views, i, R, t, P, uv, J)
        if not projected or 0.5 * (a + c) > MAX_SIGMA_PX * MAX_SIGMA_PX:
            continue
        cov, p = obs.calibration_cov[i], obs.detection_model.p_detect * p_unoccluded[i]
        a, b, c = a + cov[0, 0], b + cov[0, 1], c + cov[1, 1]
        best = np.log(1.0 - p)
        for d in range(frame.first[camera], frame.first[camera + 1]):
            y0, y1 = frame.uv[d, 0] - uv[0], frame.uv[d, 1] - uv[1]
            if y0 * y0 + y1 * y1 > GATE_CHI2 * (a + c + frame.cov[d, 0, 0] + frame.cov[d, 1, 1]):
                continue
            sa, sb, sc, det = inverse_2x2(a + frame.cov[d, 0, 0], b + frame.cov[d, 0, 1], c + frame.cov[d, 1, 1])
            chi2 = y0 * (sa * y0 + sb * y1) + y1 * (sb * y0 + sc * y1)
            gain = np.log(p) - log_false_density(frame, i, d) - 0.5 * chi2 - 0.5 * np.log(det) - LOG_2PI
            if chi2 < GATE_CHI2 and gain > best and not is_taken(assigned, d):
                best, assigned[i], found = gain, d, True
    return found


@compiled
def explainable(obs: Observation, assigned: Ints) -> float:
    """Upper bound, nats, of what `complete` can add to the log-likelihood of an assignment (n,)."""
    frame, total = obs.frame, 0.0
    for c in range(frame.has_image.shape[0]):
        open_views = 0
        log_clutter = np.inf
        for i in range(assigned.shape[0]):
            if obs.view_table.camera[i] == c and assigned[i] < 0:
                open_views += 1
                log_clutter = min(log_clutter, frame.log_clutter[i])
        for d in range(frame.first[c], frame.first[c + 1]):
            if open_views > 0 and not is_taken(assigned, d):
                open_views -= 1
                det = frame.cov[d, 0, 0] * frame.cov[d, 1, 1] - frame.cov[d, 0, 1] ** 2
                p = obs.detection_model.p_detect
                total += max(-np.log(1.0 - p) - log_clutter - 0.5 * np.log(det) - LOG_2PI, 0.0)
    return total
