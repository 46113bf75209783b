"""Which detection is which spot, given where the vehicle should be: a joint search over all spots, compiled.

Spots are decided one after the other, the best predicted first; each decision moves and narrows the pose, and so the
regions in which the others are looked for shrink: after two or three spots they are about as wide as the noise. A beam
of the best partial assignments is kept. The score is the logarithm of the likelihood of Bar-Shalom & Li (1995), sec.
6.2: detected or missed, a Gaussian about the prediction against the density of false points.

Source: ours (the search); the order is that of "most certain first".
"""

from __future__ import annotations

from math import erf
from typing import NamedTuple

import numpy as np

from geometry import compiled_linalg
from geometry.arrays import Array, Bools, Ints
from geometry.compilation.jit import compiled
from geometry.compiled_projection import Views, inside, project_view
from geometry.forward_model import SpotModel
from geometry.rig import Rig
from tracking.rigid_body.information import inverse2
from tracking.rigid_body.occlusion import MISSED

NOT_LOOKED_FOR, BLENDED = -2, 1 << 20  # beside MISSED
GATE = 25.0  # squared sigmas: beyond it a detection is not this spot (p = 4e-6)
# A step of s px is off by about s^2 / 1500 px where the projection is taken as straight (lenses of 1000 to 1500 px).
BEND_PX = 1500.0
NEIGHBOUR_PX2 = 100.0  # px^2: farther than any neighbour melts into a spot
CROWD_PX = 15.0  # of a spot: the disc in which tracking/rigid_body/clutter.py counts false points
# A neighbour of a fifth of the light that shifts a spot by 0.3 of its sigma makes it a tenth wider.
GROWN = 1.08
LEAST_IN_PICTURE = 1e-3  # a spot less likely than this to be in the picture is not looked for
BEHIND = 14.0  # nats: a partial assignment so far behind the best is dropped

LOG_2PI = np.log(2 * np.pi)

_moved, _put, _put_matrix, _best_first = (
    compiled_linalg.pose_plus,
    compiled_linalg.copy_into,
    compiled_linalg.copy_matrix_into,
    compiled_linalg.best_first,
)


class FrameDetections(NamedTuple):
    """One frame's detections, m of them, those of a camera together."""

    uv: Array  # (m, 2) px
    cov: Array  # (m, 2, 2) px^2
    blend_px: Array  # (m,) how far a neighbour that melts into it may pull it, 0: not at all
    first: Ints  # (cameras + 1,) where each camera's begin
    has_image: Bools  # (cameras,)
    log_clutter: Array  # (n,) of each view: log density of false points where it is looked for, 1/px^2
    log_static: Array  # (m,) log density of points that stay in their place, at each detection; -inf: none known there
    size_px: Array  # (m,) the detection's larger half axis; nan: not known
    usual_px: Array  # (n,) the same of each view's spot as it usually is; nan: not known
    log_crowding: Array  # (n,) of each view: log of how much denser false points are near a spot than in the picture


class ViewTable(NamedTuple):
    """What the search needs of the views beside their projection."""

    camera: Ints  # (n,)
    size: Array  # (n, 2) px: width, height of the picture
    group: Ints  # (n,) spots that may be hidden together: those of one screen

    @staticmethod
    def of(rig: Rig, model: SpotModel) -> ViewTable:
        """Those of a rig."""
        screens = list(dict.fromkeys(rig.spots[s].screen for _, s in model.views))
        group = np.array([screens.index(rig.spots[s].screen) for _, s in model.views], dtype=np.int64)
        return ViewTable(np.ascontiguousarray(model.camera_of), np.ascontiguousarray(model.image_size_px), group)


class DetectionModel(NamedTuple):
    """Probabilities of detection."""

    detect: float  # of a spot in the picture that is not hidden
    blend: float  # that a detected spot has melted into a neighbour


def distinct_spots(chosen: Bools, spot: Ints) -> Ints:
    """How many spots, each in one view or several, are among chosen views (..., n): numbers (...)."""
    return np.count_nonzero(np.stack([chosen[..., spot == s].any(axis=-1) for s in np.unique(spot)], axis=-1), axis=-1)


@compiled
def log_false(frame: FrameDetections, view: int, d: int) -> float:
    """Log density of false points, 1/px^2, where detection d is taken for a view's spot."""
    return max(frame.log_clutter[view], frame.log_static[d])


@compiled
def log_clutter_ratio(views: Views, sights: ViewTable, frame: FrameDetections, R: Array, t: Array, P: Array) -> float:
    """Log-likelihood of where all points lie, spots and false ones, given that false points crowd near spots; nats.

    A point near a spot's place counts once: false points are expected there rather than elsewhere, the more so the
    better the place is known at this pose (R, t) with its P (6 or more, square). Without it a pose would be compared
    with "all of this is clutter" as if the clutter near spots filled the picture, and a vehicle that moves far between
    two frames would never be found.
    """
    total = 0.0
    n = sights.camera.shape[0]
    uv, J = np.empty(2), np.empty((2, 6))
    at, inverse, most = np.empty((n, 2)), np.empty((n, 3)), np.zeros(n)
    disc = 0.25 * CROWD_PX * CROWD_PX  # the variance per axis of a point spread evenly over it
    for i in range(n):
        if frame.log_crowding[i] <= 0.0:
            continue
        there, a, b, c = expected_at(views, i, R, t, P, uv, J)
        if not there:
            continue
        at[i, 0], at[i, 1] = uv[0], uv[1]
        inverse[i, 0], inverse[i, 1], inverse[i, 2], det = inverse2(a + disc, b, c + disc)
        # The excess over the picture's density at the middle of the region: that of the disc, spread over it.
        most[i] = (np.exp(frame.log_crowding[i]) - 1.0) * 2.0 * disc / np.sqrt(det)
    for c in range(frame.has_image.shape[0]):
        for d in range(frame.first[c], frame.first[c + 1]):
            best = 0.0
            for i in range(n):
                if sights.camera[i] != c or most[i] <= 0.0 or frame.log_static[d] > frame.log_clutter[i]:
                    continue
                x, y = at[i, 0] - frame.uv[d, 0], at[i, 1] - frame.uv[d, 1]
                far = x * (inverse[i, 0] * x + inverse[i, 1] * y) + y * (inverse[i, 1] * x + inverse[i, 2] * y)
                best = max(best, most[i] * np.exp(-0.5 * far))
            total += np.log(1.0 + best)
    return total


@compiled
def is_blended(frame: FrameDetections, view: int, d: int) -> bool:
    """Whether a detection is wider than the view's spot usually is, as two points of light that have merged are."""
    return bool(frame.size_px[d] > GROWN * frame.usual_px[view])


@compiled
def log_chance(
    views: Views,
    sights: ViewTable,
    frame: FrameDetections,
    chances: DetectionModel,
    shown: Array,
    assigned: Ints,
    R: Array,
    t: Array,
) -> float:
    """Log-likelihood of an assignment (n,) at a pose, without its Gaussian terms: detected, missed, blended.

    The spots that the pose puts in a picture count, and those that are labelled; shown (n,) as in `associate`.
    """
    uv, J = np.empty(2), np.empty((2, 6))
    total = 0.0
    for i in range(assigned.shape[0]):
        if not frame.has_image[sights.camera[i]]:
            continue
        p = chances.detect * shown[i]
        if assigned[i] >= 0:
            d = assigned[i] % BLENDED
            total += np.log(p) - log_false(frame, i, d)
            if assigned[i] >= BLENDED:
                r = frame.blend_px[d]
                total += np.log(chances.blend / (np.pi * r * r)) if r > 0.0 else -np.inf
        elif project_view(views, i, R, t, uv, J) and inside(uv, sights.size[i]):
            total += np.log(1.0 - p)
    return total


@compiled
def in_picture(u: float, v: float, var_u: float, var_v: float, width: float, height: float) -> float:
    """The probability that a spot predicted there, with these variances, lies in the picture."""
    su, sv = np.sqrt(2 * max(var_u, 1e-6)), np.sqrt(2 * max(var_v, 1e-6))
    across = 0.5 * (erf((width - 0.5 - u) / su) - erf((-0.5 - u) / su))
    down = 0.5 * (erf((height - 0.5 - v) / sv) - erf((-0.5 - v) / sv))
    return across * down


@compiled
def expected_at(
    views: Views, i: int, R: Array, t: Array, P: Array, uv: Array, J: Array
) -> tuple[bool, float, float, float]:
    """Whether view i has a projection from here, and its covariance (uu, uv, vv), px^2, from P (6, 6)."""
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
def associate(
    views: Views,
    sights: ViewTable,
    frame: FrameDetections,
    chances: DetectionModel,
    R: Array,
    t: Array,
    P: Array,
    shown: Array,
    calibration_cov: Array,
) -> tuple[Ints, Array, Array, Array, Array, int]:
    """Assignments of a frame's detections to spots, best first, from a predicted pose (R, t) and its P (6, 6).

    shown (n,): probability of each spot to shine. extra (n, 2, 2): covariance to add to what is expected of
    each view's pixel (the calibration's errors), px^2. Returns assignments (b, n): a row of frame.uv, that plus
    BLENDED, MISSED or NOT_LOOKED_FOR; their scores (b,), nats, and these without the Gaussian terms; the poses
    R (b, 3, 3) and t (b, 3) they lead to; and b.
    """
    n = sights.camera.shape[0]
    uv, J = np.empty(2), np.empty((2, 6))
    # How vague the prediction is decides how many partial assignments must be kept.
    vague = 0.0
    for i in range(n):
        there, a, _, c = expected_at(views, i, R, t, P, uv, J)
        if there:
            vague = max(vague, a + c)
    width = 12 if vague < 30.0**2 else (48 if vague < 120.0**2 else 128)

    R_of, t_of, P_of = np.empty((width, 3, 3)), np.empty((width, 3)), np.empty((width, 6, 6))
    assigned, score, counted = np.empty((width, n), np.int64), np.empty(width), np.empty(width)
    score[0] = counted[0] = 0.0
    for i in range(n):
        assigned[0, i] = NOT_LOOKED_FOR
    _put_pose(R_of[0], t_of[0], P_of[0], R, t, P)
    count = 1
    score_next = np.empty(width)
    R_next, t_next, P_next = np.empty((width, 3, 3)), np.empty((width, 3)), np.empty((width, 6, 6))
    assigned_next = np.empty((width, n), dtype=np.int64)
    child_score, child_counted, counted_next = np.empty(width), np.empty(width), np.empty(width)
    child_node, child_choice = np.empty(width, np.int64), np.empty(width, np.int64)
    open_views = np.empty(n, dtype=np.bool_)
    for i in range(n):
        open_views[i] = frame.has_image[sights.camera[i]]

    for _ in range(n):
        # The view that the best partial assignment predicts best.
        view, least = -1, np.inf
        for i in range(n):
            if not open_views[i]:
                continue
            there, a, b, c = expected_at(views, i, R_of[0], t_of[0], P_of[0], uv, J)
            if not there:
                continue
            a, b, c = a + calibration_cov[i, 0, 0], b + calibration_cov[i, 0, 1], c + calibration_cov[i, 1, 1]
            size = a * c - b * b
            if in_picture(uv[0], uv[1], a, c, sights.size[i, 0], sights.size[i, 1]) < LEAST_IN_PICTURE:
                size += 1e12  # out of the picture: last, and mostly nothing is done about it
            if size < least:
                view, least = i, size
        if view < 0:
            break
        open_views[view] = False
        camera = sights.camera[view]
        children = 0
        worst = -np.inf
        for b_node in range(count):
            there, a, b, c = expected_at(views, view, R_of[b_node], t_of[b_node], P_of[b_node], uv, J)
            p_in = 0.0
            if there:
                bend = ((a + c) / BEND_PX) ** 2 if a + c > 1.0 else 0.0
                a, b, c = (
                    a + calibration_cov[view, 0, 0] + bend,
                    b + calibration_cov[view, 0, 1],
                    c + calibration_cov[view, 1, 1] + bend,
                )
                p_in = in_picture(uv[0], uv[1], a, c, sights.size[view, 0], sights.size[view, 1])
            if p_in < LEAST_IN_PICTURE:
                children, worst = _kept(
                    child_score, child_counted, child_node, child_choice, children, worst,
                    score[b_node], counted[b_node], b_node, NOT_LOOKED_FOR,
                )  # fmt: skip
                continue
            p_detect = chances.detect * shown[view] * p_in
            gain = np.log(1.0 - p_detect)
            children, worst = _kept(
                child_score, child_counted, child_node, child_choice, children, worst,
                score[b_node] + gain, counted[b_node] + gain, b_node, MISSED,
            )  # fmt: skip
            found = np.log(p_detect)
            for d in range(frame.first[camera], frame.first[camera + 1]):
                y0, y1 = frame.uv[d, 0] - uv[0], frame.uv[d, 1] - uv[1]
                near2 = y0 * y0 + y1 * y1
                if near2 > GATE * (a + c + frame.cov[d, 0, 0] + frame.cov[d, 1, 1]) + NEIGHBOUR_PX2:
                    continue  # a cheap test before the exact one
                taken = False
                for j in range(n):
                    if assigned[b_node, j] == d or assigned[b_node, j] == d + BLENDED:
                        taken = True
                if taken:
                    continue
                gain = found - log_false(frame, view, d)
                sa, sb, sc, det = inverse2(a + frame.cov[d, 0, 0], b + frame.cov[d, 0, 1], c + frame.cov[d, 1, 1])
                d2 = y0 * (sa * y0 + sb * y1) + y1 * (sb * y0 + sc * y1)
                if d2 < GATE:
                    children, worst = _kept(
                        child_score, child_counted, child_node, child_choice, children, worst,
                        score[b_node] + gain - 0.5 * d2 - 0.5 * np.log(det) - LOG_2PI,
                        counted[b_node] + gain, b_node, d,
                    )  # fmt: skip
                else:
                    r = frame.blend_px[d] if is_blended(frame, view, d) else 0.0
                    if r > 0.0 and near2 < (r + 2 * np.sqrt(max(a, c))) ** 2 and a + c < r * r:
                        apart = np.log(chances.blend / (np.pi * r * r))
                        children, worst = _kept(
                            child_score, child_counted, child_node, child_choice, children, worst,
                            score[b_node] + gain + apart, counted[b_node] + gain + apart, b_node, d + BLENDED,
                        )  # fmt: skip
        # The kept children become the nodes, best first.
        order = _best_first(child_score[:children])
        kept = 0
        for place in range(children):
            k = order[place]
            if child_score[k] < child_score[order[0]] - BEHIND:
                break
            node, choice = child_node[k], child_choice[k]
            _put(assigned_next[kept], assigned[node])
            assigned_next[kept, view] = choice
            _put_pose(R_next[kept], t_next[kept], P_next[kept], R_of[node], t_of[node], P_of[node])
            if 0 <= choice < BLENDED:
                _take(views, view, frame, choice, calibration_cov, R_next[kept], t_next[kept], P_next[kept])
            score_next[kept], counted_next[kept] = child_score[k], child_counted[k]
            kept += 1
        count = kept
        R_of, R_next = R_next, R_of
        t_of, t_next = t_next, t_of
        P_of, P_next = P_next, P_of
        assigned, assigned_next = assigned_next, assigned
        score, score_next = score_next, score
        counted, counted_next = counted_next, counted
    return assigned[:count], score[:count], counted[:count], R_of[:count], t_of[:count], count


@compiled
def _put_pose(R_out: Array, t_out: Array, P_out: Array, R: Array, t: Array, P: Array) -> None:
    _put_matrix(R_out, R)
    _put(t_out, t)
    _put_matrix(P_out, P)


@compiled
def _kept(
    child_score: Array,
    child_counted: Array,
    child_node: Ints,
    child_choice: Ints,
    children: int,
    worst: float,
    score: float,
    counted: float,
    node: int,
    choice: int,
) -> tuple[int, float]:
    """Put a child into the list if it is full of worse ones, or has room; how many there are, and the worst's score."""
    room = child_score.shape[0]
    if children < room:
        place = children
        children += 1
    elif score <= worst:
        return children, worst
    else:
        place = 0
        for k in range(room):
            if child_score[k] < child_score[place]:
                place = k
    child_score[place], child_counted[place] = score, counted
    child_node[place], child_choice[place] = node, choice
    if children == room:
        worst = child_score[0]
        for k in range(room):
            worst = min(worst, child_score[k])
    return children, worst


@compiled
def _take(
    views: Views, view: int, frame: FrameDetections, d: int, calibration_cov: Array, R: Array, t: Array, P: Array
) -> None:
    """Move and narrow a pose by the detection d of a view, in place."""
    uv, J = np.empty(2), np.empty((2, 6))
    _, a, b, c = expected_at(views, view, R, t, P, uv, J)
    bend = ((a + c) / BEND_PX) ** 2 if a + c > 1.0 else 0.0
    a, b, c = a + frame.cov[d, 0, 0] + bend, b + frame.cov[d, 0, 1], c + frame.cov[d, 1, 1] + bend
    a, b, c = a + calibration_cov[view, 0, 0], b + calibration_cov[view, 0, 1], c + calibration_cov[view, 1, 1]
    sa, sb, sc, _ = inverse2(a, b, c)
    H = np.zeros((6, 2))
    for i in range(6):
        for j in range(6):
            H[i, 0] += P[i, j] * J[0, j]
            H[i, 1] += P[i, j] * J[1, j]
    y0, y1 = frame.uv[d, 0] - uv[0], frame.uv[d, 1] - uv[1]
    z0, z1 = sa * y0 + sb * y1, sb * y0 + sc * y1
    step = np.empty(6)
    for i in range(6):
        step[i] = H[i, 0] * z0 + H[i, 1] * z1
        for j in range(6):
            P[i, j] -= H[i, 0] * (sa * H[j, 0] + sb * H[j, 1]) + H[i, 1] * (sb * H[j, 0] + sc * H[j, 1])
    R_new, t_new = _moved(R, t, step)
    _put_matrix(R, R_new)
    _put(t, t_new)
