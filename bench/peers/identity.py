"""Identity scores from the truth of a scene: correct labels, gaps and re-entries.

A tracker may use any identities. The identity that matches a spot most often in the first frames is its label; later
only rows with this identity count, so that a spot that returns with a new identity stays wrong.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bench.peers.rows import Tracked
from bench.peers.scenes import CAMERA_OF, DETECTED, OUTSIDE, SPOTS, Scene
from geometry.arrays import Array, Bools, Ints

NEAR_PX = 5.0  # largest distance of a row from its spot: 33 sigmas, an eighth of the radius of the clutter
NAMING_FRAMES = 20  # frames that define the first labels; they are not scored
GAP_FRAMES = 5  # shorter gaps within the picture are bridged by all trackers
AFTER_FRAMES = 20  # in this number of frames after a gap ...
AFTER_SEEN = 10  # ... the first detections of the spot, at most this number, decide whether it kept its identity ...
LEAST_AFTER = 5  # ... and at least this number is needed
NO_IDENTITY = -1


@dataclass(frozen=True, slots=True)
class Identity:
    """Counts over one scene, for detected spots after the naming frames."""

    detected: int  # spot-frames
    right: int  # spot-frames within NEAR_PX of a row with the first label of the spot
    labelled: int  # rows with the first label of a spot and a detection
    wrong: int  # these rows farther than NEAR_PX from the spot, or without a detection of it
    gaps: int  # occlusions of a spot in the picture for GAP_FRAMES or more
    gaps_kept: int  # gaps with the same identity before and after
    reentries: int  # times that a spot left the picture and returned
    reentries_kept: int

    @property
    def share(self) -> float:
        """Share of spot-frames with the first label, 0 to 1."""
        return self.right / self.detected if self.detected else float("nan")


def distances(scene: Scene, rows: Tracked) -> Array:
    """Distances of each row from the true positions of all spots, (m, 6), px; inf for the other camera."""
    gap = np.linalg.norm(rows.uv_px[:, None] - scene.uv_px[rows.frame], axis=-1)
    return np.where(rows.camera[:, None] == CAMERA_OF, gap, np.inf)


def first_labels(scene: Scene, rows: Tracked) -> list[int | None]:
    """The identity that matches each spot most often in the naming frames; None without a match."""
    near = (distances(scene, rows) < NEAR_PX) & (rows.measured & (rows.frame < NAMING_FRAMES))[:, None]
    labels: list[int | None] = []
    for s in range(SPOTS):
        names, count = np.unique(rows.identity[near[:, s]], return_counts=True)
        labels.append(int(names[count.argmax()]) if len(names) else None)
    return labels


def score_identity(scene: Scene, rows: Tracked) -> Identity:
    """All counts."""
    labels = first_labels(scene, rows)
    gap = distances(scene, rows)
    detected = scene.state == DETECTED
    scored = detected.copy()
    scored[:NAMING_FRAMES] = False
    right = np.zeros_like(detected)
    labelled = wrong = 0
    for s, label in enumerate(labels):
        if label is None:
            continue
        mine = rows.measured & (rows.identity == label) & (rows.camera == CAMERA_OF[s])
        good = mine & (gap[:, s] < NEAR_PX)
        right[rows.frame[good], s] = True
        late = mine & (rows.frame >= NAMING_FRAMES)
        labelled += int(late.sum())
        wrong += int((late & ~(good & detected[rows.frame, s])).sum())
    kept = _kept(detected, scene.state == OUTSIDE, _nearest_identity(rows, gap, len(scene)))
    return Identity(int(scored.sum()), int((right & scored).sum()), labelled, wrong, *kept)


def _nearest_identity(rows: Tracked, gap: Array, frames: int) -> Ints:
    """(T, 6): the identity of the measured row nearest to each spot, within NEAR_PX; NO_IDENTITY without one."""
    out = np.full((frames, SPOTS), NO_IDENTITY)
    for s in range(SPOTS):
        near = np.flatnonzero(rows.measured & (gap[:, s] < NEAR_PX))
        near = near[np.argsort(-gap[near, s])]  # the nearest is written last
        out[rows.frame[near], s] = rows.identity[near]
    return out


def _kept(detected: Bools, outside: Bools, identity: Ints) -> tuple[int, int, int, int]:
    """Gaps, gaps kept, re-entries, re-entries kept, from arrays (T, 6)."""
    count = {False: [0, 0], True: [0, 0]}
    for s in range(SPOTS):
        for first, end in _absences(detected[:, s]):
            left = bool(outside[first:end, s].any())
            after = end + np.flatnonzero(detected[end : end + AFTER_FRAMES, s])[:AFTER_SEEN]
            if len(after) < LEAST_AFTER or not (left or end - first >= GAP_FRAMES):
                continue
            before = identity[max(0, first - GAP_FRAMES) : first, s]
            before = before[before != NO_IDENTITY]
            kept = len(before) > 0 and bool(np.mean(identity[after, s] == before[-1]) >= 0.5)
            count[left][0] += 1
            count[left][1] += kept
    return count[False][0], count[False][1], count[True][0], count[True][1]


def _absences(detected: Bools) -> list[tuple[int, int]]:
    """First frame and end of every interval without the spot, (T,), that starts after a frame with it."""
    change = np.diff(detected.astype(int))
    starts = np.flatnonzero(change < 0) + 1
    ends = np.flatnonzero(change > 0) + 1
    return [(int(k), int(next((e for e in ends if e > k), len(detected)))) for k in starts]
