"""`python -m bench.related_measurements.light_tracker`: the light tracker against the detector in every frame.

Rendered sequences of 640 x 480 (drogue_sequences.py beside it). All methods get the same pictures; each one's process
time is measured without the rendering. The detector in every frame takes its best candidate, whatever its confidence.
OpenCV's trackers, those that the installed OpenCV has, start with the true box of the first frame.

A frame is right with a centre within a quarter of the drogue's diameter, and held with one within half of it: on the
drogue. `right` and `held` are shares of the frames in which less than half of the rim is hidden. The next three are
shares of the frames that are held, from the first right one of the sequence on: with nothing hidden, less than half,
and all frames.
`--calibrate` fits the coefficients of the confidence on other sequences.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import cv2
import numpy as np

from bench.related_measurements.drogue_sequences import SequenceFrame, moving_drogue
from bench.related_measurements.learned_detector import logistic, reliability
from geometry.arrays import Array
from tracking.learned_detector.detector import find_drogues, learned_detector
from tracking.light_tracker.frames import RIGHT_SHARE, LightParameters
from tracking.light_tracker.tracker import DrogueTracker
from tracking.statuses import PoseStatus

FEATURES = ("1", "support", "confirmed", "size", "size x support", "gap")
SIGNS = (0, 1, 1, -1, 1, -1)  # of the coefficients, as they must be

SMALL_PX, ALL_PX = (9.0, 9.0), (9.0, 150.0)
HELD_SHARE = 0.5
RIVALS = ("CSRT", "KCF", "MIL")
# Of the sequences for the calibration: ranges of the diameters, in turn, and one of so many has no drogue. Without the
# second range hardly a drogue of 12 to 20 px is doubtful, and false ones of this size are believed.
_CALIBRATED_PX, _EMPTY_EVERY = (SMALL_PX, (9.0, 20.0), ALL_PX), 5

Step = Callable[[SequenceFrame], tuple[Array, float, bool]]  # centre (2,) px, confidence, whether it is measured


@dataclass(slots=True)
class Record:
    """One method on all sequences."""

    errors: list[float] = field(default_factory=list)  # in diameters; inf without an answer
    hidden: list[float] = field(default_factory=list)
    confidence: list[float] = field(default_factory=list)
    measured: list[bool] = field(default_factory=list)
    followed: list[bool] = field(default_factory=list)  # frames from the first right one on
    process_s: float = 0.0

    def add(self, step: Step, frames: list[SequenceFrame]) -> None:
        """One sequence."""
        right_before = False
        for frame in frames:
            start = time.process_time()
            centre, confidence, measured = step(frame)
            self.process_s += time.process_time() - start
            away = np.hypot(*(centre - frame.centre_px)) / frame.diameter_px
            error = float(away) if np.isfinite(away) else float("inf")
            right_before |= error <= RIGHT_SHARE and measured
            self.errors.append(error)
            self.hidden.append(frame.hidden)
            self.confidence.append(confidence)
            self.measured.append(measured)
            self.followed.append(right_before)

    def line(self) -> str:
        """Figures of the method."""
        error, hidden = np.array(self.errors), np.array(self.hidden)
        right, held, followed = error <= RIGHT_SHARE, error <= HELD_SHARE, np.array(self.followed)
        seen = hidden < 0.5
        best = error[right & seen]
        median, most = (100 * np.quantile(best, (0.5, 0.95))).tolist() if len(best) else (np.nan, np.nan)
        shares = [right[seen], held[seen], *(held[followed & which] for which in (hidden == 0, seen, hidden <= 1))]
        texts = [f"{s.mean():7.4f}" if len(s) else "      -" for s in shares]
        return f"{' '.join(texts)}  {median:6.2f} {most:6.2f}  {1e3 * self.process_s / len(error):7.2f}"


def tracked(parameters: LightParameters) -> Step:
    """Detector and light tracker."""
    tracker = DrogueTracker(learned_detector(parameters.smallest_px / 2), parameters)

    def step(frame: SequenceFrame) -> tuple[Array, float, bool]:
        out = tracker.step(frame.picture)
        return out.centre_px, out.confidence, out.status is PoseStatus.MEASURED

    return step


def detected(frame: SequenceFrame) -> tuple[Array, float, bool]:
    """The detector's best candidate."""
    found = find_drogues(frame.picture)
    if not found:
        return np.full(2, np.nan), 0.0, False
    return np.array([found[0].u_px, found[0].v_px]), found[0].confidence, True


def rival(name: str) -> Step | None:
    """A tracker of OpenCV; None where the installed OpenCV does not have it."""
    maker = getattr(cv2, f"Tracker{name}_create", None)
    if maker is None:
        return None
    tracker = maker()
    started = False

    def step(frame: SequenceFrame) -> tuple[Array, float, bool]:
        nonlocal started
        colour = cv2.cvtColor(frame.picture, cv2.COLOR_GRAY2BGR)
        if not started:
            started = True
            size = round(frame.diameter_px) + 2
            corner = np.rint(frame.centre_px - (size - 1) / 2).astype(int).tolist()
            tracker.init(colour, (*corner, size, size))
            return frame.centre_px, 1.0, True
        found, (u, v, w, h) = tracker.update(colour)
        centre = np.array([u + (w - 1) / 2, v + (h - 1) / 2]) if found else np.full(2, np.nan)
        return centre, 1.0, bool(found)

    return step


def sequences(seed: int, count: int, frames: int, diameters_px: tuple[float, float]) -> Iterator[list[SequenceFrame]]:
    """Rendered sequences."""
    for i in range(count):
        yield list(moving_drogue(1000 * seed + i, frames, diameters_px))


def compare(seed: int, count: int, frames: int, diameters_px: tuple[float, float], every: int, rivals: bool) -> Record:
    """Print the table of one range of diameters. Returns the record of the light tracker."""
    records: dict[str, Record] = {}
    parameters = LightParameters(check_every=every)
    for pictures in sequences(seed, count, frames, diameters_px):
        steps: dict[str, Step | None] = {"detector + light": tracked(parameters), "detector": detected}
        if rivals:
            steps |= {name: rival(name) for name in RIVALS}
        for name, step in steps.items():
            if step is not None:
                records.setdefault(name, Record()).add(step, pictures)
    low, high = diameters_px
    print(f"{count} sequences of {frames} frames, seed {seed}, diameters {low:g} to {high:g} px, checks every {every}:")
    print(f"{'':17}   right    held   clear    seen     all  centre, % of diameter: median, 95 %; ms")
    for name, record in records.items():
        print(f"{name:17} {record.line()}")
    ratio = records["detector"].process_s / records["detector + light"].process_s
    print(f"{ratio:.2f} times as fast as the detector in every frame")
    return records["detector + light"]


def reliability_of(records: list[Record]) -> None:
    """Print the reliability of the confidence, over all measured frames."""
    confidence = np.concatenate([np.array(r.confidence)[np.array(r.measured)] for r in records])
    right = np.concatenate([(np.array(r.errors) <= RIGHT_SHARE)[np.array(r.measured)] for r in records])
    print("reliability (confidence, share right, number):")
    for mean, share, number in reliability(confidence, right):
        print(f"  {mean:.3f} {share:.3f} {number}")
    print(f"  all: {confidence.mean():.4f} {right.mean():.4f} {len(right)}")
    wrong = (confidence > 0.9) & ~right
    print(f"  wrong with a confidence above 0.9: {wrong.sum()} of {len(right)}")


def calibrated(seed: int, count: int, frames: int) -> None:
    """Fit the coefficients of the confidence by maximum likelihood; print their line of tracking/light_tracker."""
    inputs: list[Array] = []
    right: list[bool] = []
    for i in range(count):
        empty = i % _EMPTY_EVERY == 0
        tracker = DrogueTracker(learned_detector(4.0), trace=[])
        for frame in moving_drogue(1000 * seed + i, frames, _CALIBRATED_PX[i % 3], empty=empty):
            assert tracker.trace is not None
            tracker.trace.clear()
            tracker.step(frame.picture)
            if tracker.trace:
                values, centre = tracker.trace[-1]
                away = float(np.hypot(*(centre - frame.centre_px))) / frame.diameter_px
                inputs.append(values)
                right.append(away <= RIGHT_SHARE)
    x, y = np.array(inputs), np.array(right)
    print(f"{len(y)} matches, {y.mean():.4f} right")
    coefficients = logistic(x, y, SIGNS)
    print(f"COEFFICIENTS = {tuple(coefficients.round(2).tolist())}  # of {FEATURES}")
    p = 1 / (1 + np.exp(-x @ coefficients))
    for mean, share, number in reliability(p, y):
        print(f"  {mean:.3f} {share:.3f} {number}")


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sequences", type=int, default=20, help="of each range of diameters")
    parser.add_argument("--frames", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--every", type=int, default=LightParameters().check_every)
    parser.add_argument("--rivals", action="store_true", help="also OpenCV's trackers")
    parser.add_argument("--calibrate", action="store_true")
    a = parser.parse_args()
    cv2.setNumThreads(1)
    if a.calibrate:
        calibrated(a.seed, a.sequences, a.frames)
        return
    small = compare(a.seed, a.sequences, a.frames, SMALL_PX, a.every, a.rivals)
    all_sizes = compare(a.seed + 1, a.sequences, a.frames, ALL_PX, a.every, a.rivals)
    reliability_of([small, all_sizes])


if __name__ == "__main__":
    main()
