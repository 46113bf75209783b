"""A camera that was moved during a run: the frame, and which camera.

Two signs show the frame. From it on spots are not found where the poses put them, although the camera shows as many
points elsewhere; or a camera's attitude has a step in the residuals (`movement_of_a_camera`). The camera is the one
whose points are off all predictions in that frame, while those of the others are where they were predicted. Source:
ours.
"""

from __future__ import annotations

from array import array
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from geometry.arrays import Array, Ints
from tracking.detections import Detections
from tracking.statuses import SpotStatus, TrackedFrame

FEWEST_FRAMES = 5  # before the movement and after it
_ASTRAY = 0.2  # share of the expected spots that are shown elsewhere, which is between those before and after
_BEFORE, _AFTER = 0.05, 0.25  # largest share of them before the movement, least share after it
_FEWEST_ASTRAY = 8.0  # spots
_USED = 0.1  # share of the expected spots that the poses after the movement still use, from which on they are wrong
_OFF = 2.0  # how many times farther than usual, and than those of the other cameras, its points are off the predictions
_LEAST_OFF_PX = 0.1  # what counts as usual at least
_FAR_OFF = 5.0  # the same in other frames than that of the first sign
_NEAR = 10  # frames around it: a tracker that follows the wrong camera hides it at first


@dataclass(slots=True)
class ShownSpots:
    """What one camera showed of its spots in each frame with a picture and a pose: 24 bytes each."""

    frames: array[int] = field(default_factory=lambda: array("q"))
    expected: array[float] = field(default_factory=lambda: array("f"))  # spots that the pose puts inside the picture
    used: array[float] = field(default_factory=lambda: array("f"))  # those that were found and took part in the pose
    points: array[float] = field(default_factory=lambda: array("f"))  # detected
    off_px: array[float] = field(default_factory=lambda: array("f"))  # see `off_prediction_px`

    def add(self, frame: int, tracked: TrackedFrame, views: Sequence[int], found: Detections) -> None:
        """Add the next frame: the camera's views, and the points in its picture. Spots that have merged do not count.

        Of these one has the label of a point that is not used, and the other one is hidden.
        """
        used = np.array([tracked.status[v].measured for v in views], dtype=bool)
        hidden = sum(tracked.status[v] is SpotStatus.OCCLUDED for v in views)
        if tracked.used_in_pose is not None:
            merged = used & ~tracked.used_in_pose[list(views)]
            used, hidden = used & ~merged, max(hidden - int(merged.sum()), 0)
        self.frames.append(frame)
        self.expected.append(int(used.sum()) + hidden)
        self.used.append(int(used.sum()))
        self.points.append(len(found))
        self.off_px.append(off_prediction_px(tracked.predicted_px[list(views)], found.uv_px))

    def astray(self) -> Array:
        """(T,): spots that are not found where the pose puts them and are shown elsewhere.

        As many as there are points beyond those of the frames in which all spots are found.
        """
        expected, used, points = (np.asarray(a, dtype=float) for a in (self.expected, self.used, self.points))
        whole = (expected > 0) & (used >= expected)
        if np.count_nonzero(whole) < FEWEST_FRAMES:
            return np.zeros(len(expected))
        clutter = float(np.mean((points - used)[whole]))
        return np.clip(points - used - clutter, 0.0, expected - used)

    def moved_from(self) -> int:
        """Index of the first frame of those up to the end in which spots are astray; -1: there is no such frame."""
        astray, expected = self.astray(), np.asarray(self.expected, dtype=float)
        if len(astray) < 2 * FEWEST_FRAMES:
            return -1
        k = int(np.argmax(np.cumsum((astray - _ASTRAY * expected)[::-1])[::-1]))
        before, after = expected[:k].sum(), expected[k:].sum()
        clear = astray[:k].sum() <= _BEFORE * before and astray[k:].sum() >= max(_AFTER * after, _FEWEST_ASTRAY)
        return k if clear and FEWEST_FRAMES <= k <= len(astray) - FEWEST_FRAMES else -1

    def frames_astray(self) -> Ints:
        """The frames from `moved_from` on in which spots are astray; none without such a frame."""
        k = self.moved_from()
        return np.array(self.frames[k:], dtype=np.int64)[self.astray()[k:] > 0] if k >= 0 else np.zeros(0, np.int64)

    def is_used_after(self, frame: int) -> bool:
        """Whether poses from a frame on use spots of this camera."""
        k = int(np.searchsorted(self.frames, frame))
        return sum(self.used[k:]) > _USED * sum(self.expected[k:])

    def how_far_off(self, frame: int) -> float:
        """How many times farther than usual the points were off their predictions in a frame and in the next one.

        0 where not known. In a single frame a spot may be missing.
        """
        k = int(np.searchsorted(self.frames, frame))
        off = np.array(self.off_px)
        before, now = off[:k][np.isfinite(off[:k])], off[k : k + 2]
        if len(before) < FEWEST_FRAMES or len(now) < 2 or self.frames[k] != frame:
            return 0.0
        return float(np.nan_to_num(now.min()) / max(float(np.median(before)), _LEAST_OFF_PX))


def off_prediction_px(predicted_px: Array, uv_px: Array) -> float:
    """Median over predicted places (n, 2) of the distance, px, of the nearest of some points (m, 2); nan for none."""
    known = predicted_px[np.isfinite(predicted_px).all(axis=-1)]
    if not len(known) or not len(uv_px):
        return float("nan")
    return float(np.median(np.linalg.norm(known[:, None] - uv_px, axis=-1).min(axis=1)))


@dataclass(frozen=True, slots=True)
class MovedCamera:
    """A movement during a run."""

    frame: int  # the first one after it
    camera: str  # "": not known
    left_out: bool = False  # whether the tables are those without this camera's pictures from that frame on


def moved_camera(cameras: Mapping[str, ShownSpots], step: int | None) -> MovedCamera | None:
    """The movement that makes poses of a run wrong; None: there is none.

    step: the first frame after a movement that the residuals show.
    """
    starts = [s.frames[k] for s in cameras.values() if (k := s.moved_from()) >= 0 and s.is_used_after(s.frames[k])]
    if not starts and step is None:
        return None
    sign = min([*starts, *([] if step is None else [step])])
    for frame in sorted(range(sign - _NEAR, sign + _NEAR), key=lambda f: abs(f - sign)):
        least = _OFF if frame == sign else _FAR_OFF
        off = {name: s.how_far_off(frame) for name, s in cameras.items()}
        *others, most = sorted(off, key=lambda name: off[name])
        if not others or (off[most] > least and all(off[most] > least * off[other] for other in others)):
            return MovedCamera(frame, most)
    return MovedCamera(sign, "")
