"""The measurements behind `beampose study zhou2014`: stills, a full occlusion, cost. Ours; the paper has none of them.

Each method gets the same pictures. OpenCV's HoughCircles searches the whole picture for its strongest circle; the
paper's method and ours search the window around the same uncertain prediction.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from geometry.arrays import Array
from lab.drogue_circle.options import CircleOptions
from lab.drogue_circle.stills import SIZE, ring_still, textured
from tracking.drogue_circle.candidates import CircleCandidate, Picture, Window
from tracking.drogue_circle.classical import classical_detector
from tracking.drogue_circle.parameters import CircleParameters
from tracking.drogue_circle.printed import printed_measurement
from tracking.drogue_circle.rim import smooth_crop
from tracking.drogue_circle.rim_fit import RimFit, fit_rim

RADII_PX = (12.0, 45.0)
BLUR_PX, NOISE_DN = (0.7, 1.8), (2.0, 8.0)
HIDDEN = (0.0, 0.2, 0.4)  # shares of the rim
PREDICTION_PX = 1.5  # 1 sigma of the predicted centre; a third of it for the radius
_FAILED_PX = 8.0  # a centre farther away is a failure: the gate of the paper
_LARGE = (1280, 1024)
_WARM_UP = 8  # pictures before the time is measured


@dataclass(frozen=True, slots=True)
class StillErrors:
    """Errors of the centre, px, n stills; nan where a method finds nothing."""

    hidden: Array  # (n,) share of the rim
    opencv: Array
    printed: Array
    ours: Array
    nees_centre: Array  # (n,) squared error of our centre over its covariance, 2 degrees of freedom
    nees: Array  # (n,) the same with the radius, 3 degrees of freedom

    def median(self, method: str, hidden: float | None = None) -> float:
        """Median error of a method (`opencv`, `printed`, `ours`); failures count as infinite."""
        errors: Array = getattr(self, method)
        chosen = errors if hidden is None else errors[self.hidden == hidden]
        return float(np.median(np.where(np.isfinite(chosen), chosen, np.inf)))

    def failures(self, method: str) -> float:
        """Share of the stills without a centre within 8 px."""
        errors: Array = getattr(self, method)
        return float(np.mean(~(errors < _FAILED_PX)))


def still_errors(seed: int, count: int) -> StillErrors:
    """`count` stills of each hidden share."""
    rng = np.random.default_rng([seed, 1])
    parameters = CircleParameters()
    rows = []
    for hidden in HIDDEN:
        for _ in range(count):
            blur, noise = float(rng.uniform(*BLUR_PX)), float(rng.uniform(*NOISE_DN))
            still = ring_still(rng, float(rng.uniform(*RADII_PX)), hidden, blur_px=blur, noise_dn=noise)
            prior = still.circle + PREDICTION_PX * rng.standard_normal(3) * [1, 1, 1 / 3]
            fit = measured_once(still.picture, prior, parameters)
            away = np.full(3, np.nan) if fit is None else fit.centre_and_radius - still.circle
            nees = [np.nan, np.nan] if fit is None else [_nees(away, fit.covariance_px2, n) for n in (2, 3)]
            errors = [_distance(c, still.circle) for c in (strongest(still.picture), _printed(still.picture, prior))]
            rows.append([hidden, *errors, float(np.hypot(*away[:2])), *nees])
    return StillErrors(*np.array(rows).T)


def measured_once(picture: Picture, prior: Array, parameters: CircleParameters) -> RimFit | None:
    """Our measurement without a filter: the best rim in the window around a predicted circle (3,)."""
    u, v, radius = (float(x) for x in prior)
    change = parameters.radius_gate * radius
    half = max(0.5 * parameters.window_radii * radius, 1.15 * radius + parameters.gate_px)
    window = Window(u, v, half, parameters.gate_px, radius - change, radius + change)
    crop = smooth_crop(picture, window, parameters.blur_px)
    coarse = [CircleCandidate(u, v, radius, np.inf), *classical_detector(parameters)(picture, window)]
    fits = [fit_rim(crop, c, parameters.min_coverage) for c in coarse[: 1 + parameters.candidates]]
    good = [f for f in fits if f is not None and abs(f.rim.radius_px / radius - 1) < parameters.radius_gate]
    return max(good, key=lambda f: f.score - abs(f.rim.radius_px / radius - 1), default=None)


def strongest(picture: Picture, radii_px: tuple[int, int] = (10, 60)) -> Array | None:
    """The strongest circle (3,) of cv2.HoughCircles; its threshold is lowered until it finds one."""
    for threshold in (60, 40, 25, 15, 8):
        found = cv2.HoughCircles(
            picture, cv2.HOUGH_GRADIENT, 1, 20, param1=100, param2=threshold, minRadius=radii_px[0],
            maxRadius=radii_px[1],
        )  # fmt: skip
        if found is not None:
            return np.asarray(found, dtype=float).reshape(-1, 3)[0]
    return None


def _nees(away: Array, covariance: Array, n: int) -> float:
    return float(away[:n] @ np.linalg.solve(covariance[:n, :n], away[:n]))


def _printed(picture: Picture, prior: Array) -> Array | None:
    return printed_measurement(picture, prior, CircleParameters())


def _distance(circle: Array | None, truth: Array) -> float:
    return np.nan if circle is None else float(np.hypot(*(circle[:2] - truth[:2])))


@dataclass(frozen=True, slots=True)
class HiddenRun:
    """A circle that is fully hidden for some frames: the error of the centre over time."""

    frame: Array  # (n,)
    hidden: Array  # (n,) 1 where it is fully hidden
    ours_px: Array  # (n,) error of the reported centre
    printed_px: Array

    def largest(self, errors_px: Array) -> float:
        """The largest error of the fully hidden frames; infinite where a frame has no position."""
        chosen = errors_px[self.hidden > 0]
        return float(np.where(np.isfinite(chosen), chosen, np.inf).max())


def hidden_run(seed: int, frames: int = 60, first: int = 40, count: int = 8) -> HiddenRun:
    """A ring on a smooth path, behind a plate for `count` frames."""
    rng = np.random.default_rng([seed, 2])
    background = textured(rng, SIZE)
    phase, radius = rng.uniform(0, 2 * np.pi, 4), float(rng.uniform(16, 30))
    trackers = [CircleOptions(form=form).tracker() for form in ("sound", "printed")]
    look = int(rng.integers(2**31))
    errors = np.full((frames, 2), np.nan)
    for k in range(frames):
        t = k / 25  # s; a pendulum of 4 s and a faster sway; a slow approach
        u = SIZE[0] / 2 + 18 * np.sin(2 * np.pi * 0.25 * t + phase[0]) + np.sin(2 * np.pi * 0.6 * t + phase[1])
        v = SIZE[1] / 2 + 12 * np.sin(2 * np.pi * 0.2 * t + phase[2]) + np.sin(2 * np.pi * 0.5 * t + phase[3])
        still = ring_still(
            np.random.default_rng(look), radius * (1 + 0.004 * k), 0.0, centre_px=(u, v), background=background
        )
        # The look is that of one random state; the noise is another one in each frame.
        picture = still.picture.astype(float) + rng.normal(0, 2.0, still.picture.shape)
        if first <= k < first + count:
            half = 1.7 * still.circle[2]
            rows = slice(max(int(v - half), 0), int(v + half))
            picture[rows, max(int(u - half), 0) : int(u + half)] = 95 + rng.normal(0, 2.0)
        image = np.clip(np.rint(picture), 0, 255).astype(np.uint8)
        for i, tracker in enumerate(trackers):
            errors[k, i] = np.hypot(*(tracker.step(image).state[:2] - [u, v]))
    frame = np.arange(frames, dtype=float)
    hidden = ((frame >= first) & (frame < first + count)).astype(float)
    return HiddenRun(frame, hidden, errors[:, 0], errors[:, 1])


def cost_ratio(seed: int, pictures: Sequence[Picture] | None = None, rounds: int = 5) -> tuple[float, float]:
    """Process time, ms per frame of 1280 x 1024 px, of the tracker and of HoughCircles on the whole picture.

    One thread for both, since idle threads of OpenCV count as process time. pictures: consecutive ones with a circle,
    of which the first eight are not timed; None: a ring on a textured background.
    """
    given = list(_large_pictures(seed) if pictures is None else pictures)
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    times = []
    try:
        for _ in range(rounds):
            tracker = CircleOptions().tracker()
            for picture in given[:_WARM_UP]:
                tracker.step(picture)
            begun = time.process_time()
            for picture in given[_WARM_UP:]:
                tracker.step(picture)
            middle = time.process_time()
            for picture in given[_WARM_UP:]:
                cv2.HoughCircles(picture, cv2.HOUGH_GRADIENT, 1, 50, param1=100, param2=30, minRadius=10, maxRadius=60)
            times.append((middle - begun, time.process_time() - middle))
    finally:
        cv2.setNumThreads(threads)
    ours, opencv = 1000 * np.median(times, axis=0) / (len(given) - _WARM_UP)
    return float(ours), float(opencv)


def _large_pictures(seed: int, count: int = 24) -> list[NDArray[np.uint8]]:
    rng = np.random.default_rng([seed, 3])
    below = textured(rng, _LARGE)
    look, radius = int(rng.integers(2**31)), float(rng.uniform(*RADII_PX))
    left, top = 500, 400
    patch = below[top : top + SIZE[1], left : left + SIZE[0]]
    out = []
    for k in range(count):
        centre = (SIZE[0] / 2 + 0.5 * k, SIZE[1] / 2 + 0.3 * k)
        still = ring_still(np.random.default_rng(look), radius, 0.0, centre_px=centre, background=patch)
        picture = np.clip(np.rint(below + rng.normal(0, 2.0, below.shape)), 0, 255).astype(np.uint8)
        picture[top : top + SIZE[1], left : left + SIZE[0]] = still.picture
        out.append(picture)
    return out
