"""Labels by continuity in the picture, where too few spots are left to say where the vehicle is.

With two or three spots in view for long the pose grows vague, and with it the places where the pose expects the spots,
although each spot's own path in the picture goes on without a break. Each view's labelled path is continued into such
frames, from both of its ends, as a tracker of single spots does. Such labels are no evidence of the pose.

Source: ours; the prediction from a spot's own last places is that of Huo, Yang & Yang (2015) in its simplest form. How
far it can be trusted is measured on the labelled part of the same path.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np

from geometry.arrays import Array, Bools, Ints
from tracking.rigid_body.association import BLENDED
from tracking.smoothing.reassociation import AllDetections

FORMS = ((1, 2), (1, 4), (2, 3), (2, 5))  # polynomials in time: degree, number of points they are fitted to
MOST_AHEAD = 4  # frames that a path is predicted over
REACH = 8  # frames, within which a polynomial's points must lie
LEAST_HISTORY = 12  # errors that a form's spread is estimated from
# The errors' distribution is taken for a mixture: of each part the weight, and the quantile of the measured errors that
# gives its spread. Smooth motion makes the first, bends the last.
PARTS = ((0.6, 0.5), (0.35, 0.95), (0.05, 0.995))
P_GONE = 0.1  # probability per frame that the spot shows no more
POSE_GATE = 25.0  # squared Mahalanobis distance from where the pose has the spot
SURE, SURER = 0.99, 0.995  # label probability; where the path from the other side does not go through the point
LONG_CHAIN = 5  # frames in a row in which one spot alone is followed


class Surroundings(NamedTuple):
    """What is known of a run's pictures beside the labels: T frames, n views."""

    camera: Ints  # (n,)
    expected: Array  # (T, n, 2) where the smoothed poses have the spots, px; nan without
    spread: Array  # (T, n, 2, 2) and the covariance, px^2
    log_clutter: Array  # (T, n) log density of false points, 1/px^2
    open: Bools  # (T,) frames that may be given labels


def continued(every: AllDetections, assigned: Ints, around: Surroundings) -> tuple[Ints, Array]:
    """Assignments (T, n) with the labels that continuity adds, and the probabilities (T, n) of those; nan of others."""
    out, probability = assigned.copy(), np.full(assigned.shape, np.nan)
    for view in range(assigned.shape[1]):
        path = _Path.of(every, assigned, around, view)
        if path is None:
            continue
        ahead, back = path.chain(1), path.chain(-1)
        for k in ahead.keys() | back.keys():
            # Where both ends reach they must agree, or one be surer; None: looked for in vain.
            sides = [side[k] for side in (ahead, back) if k in side]
            found = [s for s in sides if s is not None]
            p = max((p for _, p in found), default=0.0)
            if len({row for row, _ in found}) == 1 and (len(found) == len(sides) or p >= SURER):
                out[k, view], probability[k, view] = found[0][0], p
    _undo_shared(out, probability, assigned)
    lone = _lone(out, assigned)
    out[lone], probability[lone] = assigned[lone], np.nan
    return out, probability


def _lone(out: Ints, before: Ints) -> Bools:
    """(T, n): new labels in frames that show no other spot, unless so many frames in a row have them.

    Where everything is hidden for a frame or two, a false point near one of the paths is not rare.
    """
    new = out != before
    alone = new & (np.count_nonzero(out >= 0, axis=1) == 1)[:, None]
    for view in range(new.shape[1]):
        for run in np.split(np.arange(len(new)), np.flatnonzero(np.diff(new[:, view].astype(np.int8))) + 1):
            if len(run) >= LONG_CHAIN:
                alone[run, view] = False
    return np.asarray(alone)


def _undo_shared(out: Ints, probability: Array, before: Ints) -> None:
    """Take away new labels by which one point would be two spots, in place."""
    for k in np.flatnonzero(np.any(out != before, axis=1)):
        for i in np.flatnonzero(out[k] != before[k]):
            others = (np.arange(out.shape[1]) != i) & (out[k] >= 0)
            if np.any(out[k][others] % BLENDED == out[k, i]):
                out[k, i], probability[k, i] = before[k, i], np.nan


class _Prediction(NamedTuple):
    """Where one form of a path expects the spot."""

    at: Array  # (2,) px
    sigma: Array  # (parts,) px per axis, of each part of its errors

    def density(self, place: Array, cov: Array) -> Array:
        """(m,) 1/px^2, of the spot's being at places (m, 2) with covariances (m, 2, 2)."""
        S = cov[:, None] + self.sigma[:, None, None] ** 2 * np.eye(2)  # (m, parts, 2, 2)
        e = place - self.at
        d2 = np.einsum("mi,mpij,mj->mp", e, np.linalg.inv(S), e)
        parts = np.exp(-0.5 * d2) / (2 * np.pi * np.sqrt(np.linalg.det(S)))
        return np.asarray(parts @ np.array([w for w, _ in PARTS]))


class _Path:
    """One view's path in its picture."""

    def __init__(self, every: AllDetections, assigned: Ints, around: Surroundings, view: int) -> None:
        self.every, self.assigned, self.around, self.view = every, assigned, around, view
        self.camera = int(around.camera[view])
        k = np.flatnonzero((assigned[:, view] >= 0) & (assigned[:, view] < BLENDED))
        self.uv = np.full((len(assigned), 2), np.nan)
        self.uv[k] = every.uv[every.begin[k] + assigned[k, view]]
        self.spreads = [[_spread(self.uv, *form, h) for h in range(1, MOST_AHEAD + 1)] for form in FORMS]

    @staticmethod
    def of(every: AllDetections, assigned: Ints, around: Surroundings, view: int) -> _Path | None:
        """None where there is nothing to continue."""
        missing = (assigned[:, view] < 0) & around.open & every.has_image[:, around.camera[view]]
        if not missing.any() or np.count_nonzero(assigned[:, view] >= 0) < LEAST_HISTORY:
            return None
        return _Path(every, assigned, around, view)

    def chain(self, way: int) -> dict[int, tuple[int, float] | None]:
        """Labels of unlabelled frames, from the earlier to the later ones (way 1) or back (-1): row, probability; None
        where the path goes through a frame but no point is on it.

        A path that ends has its last label taken away: what was found just where a spot vanished may be a false point.
        """
        out: dict[int, tuple[int, float] | None] = {}
        uv, latest = self.uv.copy(), -1
        frames = range(len(uv)) if way == 1 else range(len(uv) - 1, -1, -1)
        for k in frames:
            if np.isfinite(self.uv[k, 0]):
                latest = -1  # the chain before has reached a label: it stands
                continue
            if self.assigned[k, self.view] < 0 and self.around.open[k]:
                predicted = self._predicted(k, uv, way)
                if predicted:
                    out[k] = found = self._found(k, predicted)
                    if found is not None:
                        uv[k] = self.every.uv[self.every.begin[k] + found[0]]
                        latest = k
                        continue
            if latest >= 0 and abs(k - latest) >= MOST_AHEAD:
                out[latest] = None
                latest = -1
        if latest >= 0:
            out[latest] = None
        return out

    def _found(self, k: int, predicted: list[_Prediction]) -> tuple[int, float] | None:
        """The point of frame k that continues a path, and the probability that it does; None: none."""
        every, around, view = self.every, self.around, self.view
        rows = np.arange(every.first[k, self.camera], every.first[k, self.camera + 1])
        rows = rows[~np.isin(rows, self.assigned[k][self.assigned[k] >= 0] % BLENDED)]
        if not len(rows):
            return None
        place, cov = every.uv[every.begin[k] + rows], every.cov[every.begin[k] + rows]
        likelihood = np.mean([p.density(place, cov) for p in predicted], axis=0)
        false = np.exp(np.maximum(around.log_clutter[k, view], every.log_static[every.begin[k] + rows]))
        odds = likelihood * (1 - P_GONE) / false
        best = int(np.argmax(odds))
        p = float(odds[best] / (odds.sum() + P_GONE))
        y = place[best] - around.expected[k, view]
        far = y @ np.linalg.solve(around.spread[k, view] + cov[best], y)
        if p < SURE or not far < POSE_GATE:
            return None
        return int(rows[best]), p

    def _predicted(self, k: int, uv: Array, way: int) -> list[_Prediction]:
        """Where the path goes on in frame k: after a bend a short form is right, on a smooth path a long one."""
        near = k - way * np.arange(1, REACH + MOST_AHEAD)
        near = near[(near >= 0) & (near < len(uv))]
        near = near[np.isfinite(uv[near, 0])]
        if not len(near) or abs(k - near[0]) > MOST_AHEAD:
            return []
        ahead = int(abs(k - near[0]))
        out = []
        for (degree, points), spreads in zip(FORMS, self.spreads, strict=True):
            sigma = spreads[ahead - 1]
            if sigma is None or len(near) < points or abs(near[points - 1] - near[0]) >= REACH:
                continue
            weights = _weights(tuple(np.abs(k - near[:points]).tolist()), degree)
            usual = _weights(tuple(range(ahead, ahead + points)), degree)
            # Points farther apart than in the labelled path that the spread is of make it larger with their weights.
            wider = max(float(np.linalg.norm(weights) / np.linalg.norm(usual)), 1.0)
            out.append(_Prediction(weights @ uv[near[:points]], sigma * wider))
        return out


@cache
def _weights(ago: tuple[int, ...], degree: int) -> Array:
    """(m,) of the points of a polynomial so many frames ago, m of them, for its value now, by least squares."""
    at = -np.array(ago, dtype=float)
    return np.asarray(np.linalg.pinv(np.vander(at, degree + 1, increasing=True))[0])


def _spread(uv: Array, degree: int, points: int, ahead: int) -> Array | None:
    """(parts,) sigmas per axis, px, of predictions so many frames ahead along a labelled path uv (T, 2); None: too few
    labels to know.
    """
    weights = _weights(tuple(range(ahead, ahead + points)), degree)
    n = len(uv) - ahead - points + 1
    if n < LEAST_HISTORY:
        return None
    predicted = sum(w * uv[points - 1 - j : points - 1 - j + n] for j, w in enumerate(weights))
    squared = np.sum((uv[points - 1 + ahead :][:n] - predicted) ** 2, axis=1)
    squared = squared[np.isfinite(squared)]
    if len(squared) < LEAST_HISTORY:
        return None
    # Of a Gaussian the squared distance of two axes is exponential; the tail's part is as wide as its quantile.
    core = [np.quantile(squared, q) / (-2 * np.log(1 - q)) for _, q in PARTS[:-1]]
    return np.asarray(np.sqrt([*core, np.quantile(squared, PARTS[-1][1]) / 2]))
