"""Acquisition: motions that start with two detections of consecutive pictures and agree with the following ones.

Source: eq. (9) of Duan (2020) for the first vector; the confirmation is ours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from geometry.arrays import Array, Bools
from geometry.uncertainty.chi_square import chi2_limit
from tracking import kalman
from tracking.detections import Detections
from tracking.single_target.parameters import PointParameters

_MOST_TRACKS = 200  # candidate motions that are followed at once


@dataclass(frozen=True, slots=True)
class Step:
    """A detection of a candidate motion and the filter after it."""

    x: Array  # (4,) u, v, px, and their rates, px/frame; the first one has rates nan
    P: Array  # (4, 4)
    row: int  # of the detection in its picture
    flux: float  # nan where the detections have none


@dataclass(slots=True)
class CandidateTracks:
    """The candidate motions up to the last picture, and its detections that may start further ones."""

    parameters: PointParameters
    _tracks: list[tuple[Step, ...]]
    _last: list[Step]  # the detections of the last picture

    @staticmethod
    def none(parameters: PointParameters) -> CandidateTracks:
        """The state before the first picture."""
        return CandidateTracks(parameters, [], [])

    def step(
        self, dt: float, found: Detections, cov: Array, may_start: Bools, near: Array | None = None
    ) -> tuple[Step, ...] | None:
        """Continue with a picture's detections; cov (n, 2, 2), px^2. Returns the steps of a confirmed motion, or None.

        dt: frames since the last picture. may_start (n,): detections where a motion may begin. Of several motions that
        are confirmed, the brightest is chosen, or the one that is nearest to the place `near` (2,).
        """
        p, kept = self.parameters, min(len(found), self.parameters.most_candidates)
        continued = [c for track in self._tracks if (c := self._continued(track, dt, found, cov)) is not None]
        started = [
            (first, _second(first, found, cov, row, dt))
            for first in self._last
            for row in range(kept)
            if np.linalg.norm(found.uv_px[row] - first.x[:2]) <= p.max_speed_px * dt
        ]
        self._tracks = (continued + started)[:_MOST_TRACKS]
        self._last = [_first(found, cov, row) for row in np.flatnonzero(may_start[:kept]).tolist()]
        confirmed = [track for track in self._tracks if len(track) >= p.confirm]
        if not confirmed:
            return None
        if near is None:
            return _brightest(confirmed)
        return min(confirmed, key=lambda track: float(np.linalg.norm(track[-1].x[:2] - near)))

    def _continued(self, track: tuple[Step, ...], dt: float, found: Detections, cov: Array) -> tuple[Step, ...] | None:
        """A motion with the nearest detection in its gate; None: there is none."""
        p, last = self.parameters, track[-1]
        x, P = kalman.predict(last.x, last.P, dt, np.asarray(p.sigma_a_px))
        row, _ = nearest(x, P, found.uv_px, cov, p.p_gate)
        if row is None:
            return None
        x, P = kalman.update(x, P, found.uv_px[row], cov[row])
        return (*track, Step(x, P, row, float(found.flux[row])))


def nearest(x: Array, P: Array, uv_px: Array, cov_px2: Array, p_gate: float) -> tuple[int | None, float]:
    """The detection (n, 2) with the smallest normalised innovation, and that number; None where the gate is empty."""
    if not len(uv_px):
        return None, float("nan")
    _, _, nis = kalman.innovation(x, P, uv_px, cov_px2)
    row = int(np.argmin(nis))
    return (row if nis[row] <= chi2_limit(p_gate, 2) else None), float(nis[row])


def _first(found: Detections, cov: Array, row: int) -> Step:
    P = np.full((4, 4), np.nan)
    P[:2, :2] = cov[row]
    return Step(np.array([*found.uv_px[row], np.nan, np.nan]), P, row, float(found.flux[row]))


def _second(first: Step, found: Detections, cov: Array, row: int, dt: float) -> Step:
    """Eq. (9): the first vector from two pictures; its covariance from both positions."""
    x, P = kalman.restart(found.uv_px[row], cov[row], first.x[:2], first.P[:2, :2], dt)
    return Step(x, P, row, float(found.flux[row]))


def _brightest(tracks: Sequence[tuple[Step, ...]]) -> tuple[Step, ...]:
    """The motion whose faintest detection is brightest; without brightness the first detections of the table."""
    return max(tracks, key=lambda t: (min(float(np.nan_to_num(s.flux)) for s in t), -max(s.row for s in t)))
