"""One frame's detections and what predicts them, in the form that the compiled functions take; their likelihood.

An assignment is an array (n,) of int: for each view the row of its detection in `FrameDetections`, that row plus
BLENDED, or one of the negative values MISSED and NOT_SEARCHED.
"""

from __future__ import annotations

from math import erf
from typing import NamedTuple

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.compilation.jit import compiled
from geometry.compiled_projection import Views, inside, project_view
from geometry.forward_model import SpotModel
from geometry.rig import Rig
from tracking.rigid_body.models.information import inverse_2x2
from tracking.rigid_body.models.occlusion import joint_log_likelihood

NOT_SEARCHED = -2  # the camera has no picture, or the spot is not expected in it; see also occlusion.MISSED
# Added to the row of a detection that has merged with a neighbour: it is labelled but excluded from the pose.
BLENDED = 1 << 20
# px: radius of the disc around an expected spot in which false points are counted (online_estimates.py).
CLUTTER_RADIUS_PX = 15.0


class FrameDetections(NamedTuple):
    """One frame's m detections, sorted by camera."""

    uv: Array  # (m, 2) px
    cov: Array  # (m, 2, 2) px^2
    blend_px: Array  # (m,) how far a neighbour that has merged with the spot may shift the detection; 0: not at all
    first: Ints  # (cameras + 1,) where the rows of each camera begin
    has_image: Bools  # (cameras,)
    log_clutter: Array  # (n,) log density of false points near each view's spot, 1/px^2
    log_static: Array  # (m,) log density of static points at each detection; -inf: none known there
    size_px: Array  # (m,) larger half axis of the detection; nan: not known
    usual_size_px: Array  # (n,) the usual larger half axis of each view's spot; nan: not known
    log_clutter_excess: Array  # (n,) log ratio of the density of false points near a spot to that of the whole picture
    log_shape: Array  # (m,) log ratio of the probabilities of its shape, for a spot and for a false point


class ViewTable(NamedTuple):
    """What the search needs of the n views besides their projection."""

    camera: Ints  # (n,)
    size: Array  # (n, 2) px: width, height of the picture
    group: Ints  # (n,) the spot's screen: spots of one screen may be occluded together

    @staticmethod
    def of(rig: Rig, model: SpotModel) -> ViewTable:
        """The table of a rig's views."""
        screens = list(dict.fromkeys(rig.spots[s].screen for _, s in model.views))
        group = np.array([screens.index(rig.spots[s].screen) for _, s in model.views], dtype=np.int64)
        return ViewTable(np.ascontiguousarray(model.camera_of), np.ascontiguousarray(model.image_size_px), group)


class DetectionModel(NamedTuple):
    """Probabilities of detection."""

    p_detect: float  # that a visible spot in the picture is detected
    p_blend: float  # that a detected spot has merged with a neighbour


class Observation(NamedTuple):
    """One frame's detections together with everything that their likelihood depends on besides the state."""

    views: Views  # (n,) for the projection
    view_table: ViewTable
    detection_model: DetectionModel
    # (n, 2, 2) px^2: covariance of the expected pixels due to calibration errors, and to the shift of `views`
    calibration_cov: Array
    frame: FrameDetections
    shift_cov: Array  # (n, 2, 2) px^2: the second part alone (models/information.py); 0 without pictures' clocks
    clocks: Array  # (cameras, 3) of the pictures, as PictureClock.numbers
    timed: bool  # some picture has a clock of its own


@compiled
def chosen_points(
    uv: Array, cov: Array, begin: int, assigned: Ints, calibration_cov: Array
) -> tuple[Bools, Array, Array]:
    """Detections of one assignment (n,): views used in the pose (n,), pixels (n, 2) and covariances (n, 2, 2).

    uv (m, 2), px, cov (m, 2, 2), px^2: detections, of which those of the assignment's frame begin at row `begin`;
    calibration_cov (n, 2, 2), px^2: is added.
    """
    n = assigned.shape[0]
    use, of_view, noise = np.zeros(n, np.bool_), np.zeros((n, 2)), np.zeros((n, 2, 2))
    for i in range(n):
        if 0 <= assigned[i] < BLENDED:
            d = begin + assigned[i]
            use[i] = True
            for a in range(2):
                of_view[i, a] = uv[d, a]
                for b in range(2):
                    noise[i, a, b] = cov[d, a, b] + calibration_cov[i, a, b]
    return use, of_view, noise


def distinct_spots(chosen: Bools, spot: Ints) -> Ints:
    """Number (...) of different spots among the chosen views (..., n); spot (n,): the spot of each view."""
    if chosen.ndim == 1:  # a frame's: ten times as fast
        return np.asarray(len(set(spot[chosen].tolist())))
    return np.count_nonzero(np.stack([chosen[..., spot == s].any(axis=-1) for s in np.unique(spot)], axis=-1), axis=-1)


# Likelihood of detections, misses and false points given a predicted pose, compiled.
#
# Log-likelihoods in nats, after Bar-Shalom & Li (1995), "Multitarget-Multisensor Tracking", sec. 6.2: a spot is
# detected or missed; a detection has a Gaussian density about its prediction, a false point a uniform one.

# Least ratio of a detection's half axis to the usual one that may mean two merged spots: a neighbour with a fifth of
# the light that shifts a spot by 0.3 of its sigma makes it a tenth wider.
MIN_BLEND_WIDENING = 1.08


@compiled
def predicted_pixel(
    views: Views, i: int, R: Array, t: Array, P: Array, uv: Array, J: Array
) -> tuple[bool, float, float, float]:
    """Prediction of view i at a pose (R, t): whether it has a projection, and its covariance (uu, uv, vv), px^2.

    P (6 or more, square): covariance of the pose. The pixel goes into uv (2,), its Jacobian into J (2, 6).
    """
    if not project_view(views, i, R, t, uv, J):
        return False, 0.0, 0.0, 0.0
    a = b = c = 0.0
    for j in range(6):
        h0 = h1 = 0.0
        for k in range(6):
            h0 += J[0, k] * P[k, j]
            h1 += J[1, k] * P[k, j]
        a += h0 * J[0, j]
        b += h0 * J[1, j]
        c += h1 * J[1, j]
    return True, a, b, c


@compiled
def p_in_picture(u: float, v: float, var_u: float, var_v: float, width: float, height: float) -> float:
    """Probability that a spot predicted at (u, v), px, with these variances, px^2, lies in the picture."""
    su, sv = np.sqrt(2 * max(var_u, 1e-6)), np.sqrt(2 * max(var_v, 1e-6))
    across = 0.5 * (erf((width - 0.5 - u) / su) - erf((-0.5 - u) / su))
    down = 0.5 * (erf((height - 0.5 - v) / sv) - erf((-0.5 - v) / sv))
    return across * down


@compiled
def log_false_density(frame: FrameDetections, view: int, d: int) -> float:
    """Log density of false points, 1/px^2, that competes with detection d being a view's spot."""
    return max(frame.log_clutter[view] - frame.log_shape[d], frame.log_static[d])


@compiled
def is_blended(frame: FrameDetections, view: int, d: int) -> bool:
    """Whether a detection is so much wider than the view's spot usually is that it may be two merged spots."""
    return bool(frame.size_px[d] > MIN_BLEND_WIDENING * frame.usual_size_px[view])


@compiled
def in_picture(obs: Observation, assigned: Ints, R: Array, t: Array) -> Array:
    """(n,): 1 for the views that an assignment (n,) labels or that a pose projects into a picture, else 0."""
    uv, J = np.empty(2), np.empty((2, 6))
    out = np.zeros(assigned.shape[0])
    for i in range(assigned.shape[0]):
        shown = obs.frame.has_image[obs.view_table.camera[i]] and project_view(obs.views, i, R, t, uv, J)
        if assigned[i] >= 0 or (shown and inside(uv, obs.view_table.size[i])):
            out[i] = 1.0
    return out


@compiled
def detection_log_likelihood(obs: Observation, p_visible: Array, assigned: Ints, p_in: Array) -> float:
    """Log-likelihood of an assignment (n,) without its Gaussian terms: detections, misses, blends.

    p_visible (n + groups,): as in models/occlusion.py. p_in (n,): probability that each spot is in the picture. It
    counts for the spots that are found as well: the more of a prediction lies outside, the less its Gaussian means.
    Without it three false points were followed while all spots were hidden.
    """
    frame, detection_model = obs.frame, obs.detection_model
    total = joint_log_likelihood(p_visible, obs.view_table.group, assigned, detection_model.p_detect * p_in)
    for i in range(assigned.shape[0]):
        if assigned[i] >= 0:
            d = assigned[i] % BLENDED
            total -= log_false_density(frame, i, d)
            if assigned[i] >= BLENDED:
                r = frame.blend_px[d]
                total += np.log(detection_model.p_blend / (np.pi * r * r)) if r > 0.0 else -np.inf
    return total


@compiled
def log_clutter_ratio(obs: Observation, R: Array, t: Array, P: Array) -> float:
    """Log-likelihood ratio, nats, of the places of all points: false points concentrated near spots against uniform.

    P (6 or more, square): covariance of the pose (R, t). Each point near the expected place of a spot counts once:
    false points are more frequent there, the more so the better the place is known. Without this term a pose would be
    compared with "all points are clutter" as if the high density near spots filled the whole picture, and a vehicle
    that moves far between two frames would never be found.
    """
    frame, view_table = obs.frame, obs.view_table
    total = 0.0
    n = view_table.camera.shape[0]
    uv, J = np.empty(2), np.empty((2, 6))
    at, inverse, excess = np.empty((n, 2)), np.empty((n, 3)), np.zeros(n)
    disc = (
        0.25 * CLUTTER_RADIUS_PX * CLUTTER_RADIUS_PX
    )  # variance per axis of a point uniformly distributed in the disc
    for i in range(n):
        if frame.log_clutter_excess[i] <= 0.0:
            continue
        projected, a, b, c = predicted_pixel(obs.views, i, R, t, P, uv, J)
        if not projected:
            continue
        at[i, 0], at[i, 1] = uv[0], uv[1]
        inverse[i, 0], inverse[i, 1], inverse[i, 2], det = inverse_2x2(a + disc, b, c + disc)
        # Excess density at the centre of the region, in units of the picture's density: that of the disc, spread out.
        excess[i] = (np.exp(frame.log_clutter_excess[i]) - 1.0) * 2.0 * disc / np.sqrt(det)
    for c in range(frame.has_image.shape[0]):
        for d in range(frame.first[c], frame.first[c + 1]):
            largest = 0.0
            for i in range(n):
                if view_table.camera[i] != c or excess[i] <= 0.0 or frame.log_static[d] > frame.log_clutter[i]:
                    continue
                x, y = at[i, 0] - frame.uv[d, 0], at[i, 1] - frame.uv[d, 1]
                chi2 = x * (inverse[i, 0] * x + inverse[i, 1] * y) + y * (inverse[i, 1] * x + inverse[i, 2] * y)
                largest = max(largest, excess[i] * np.exp(-0.5 * chi2))
            total += np.log(1.0 + largest)
    return total
