"""Who kept whose identity: shares of right labels, gaps and re-entries, from a scene's truth.

A tracker may use any identities. An identity is taken for a spot if it fits that spot most often in the first frames;
from then on only rows under that identity count: a spot that comes back under a new one is wrong for ever.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bench.peers.rows import Tracked
from bench.peers.scenes import CAMERA_OF, DETECTED, OUTSIDE, SPOTS, Scene
from geometry.arrays import Array, Bools, Ints

NEAR_PX = 5.0  # a row within this of a spot's true place is of that spot: 33 sigmas, an eighth of the clutter's reach
NAMING_FRAMES = 20  # the first labels are read from these; they are not scored
GAP_FRAMES = 5  # shorter gaps within the picture are bridged by everyone
AFTER_FRAMES = 20  # within so many frames after a gap ...
AFTER_SEEN = 10  # ... the first so many in which the spot is detected tell whether it kept its identity ...
LEAST_AFTER = 5  # ... of which there must be so many
NOBODY = -1


@dataclass(frozen=True, slots=True)
class Identity:
    """Counts over one scene, detected spots after the naming frames only."""

    detected: int  # spot-frames
    right: int  # of them within NEAR_PX of a row under the spot's first label
    labelled: int  # rows under a spot's first label that claim a detection
    wrong: int  # of them farther than NEAR_PX from the spot, or where it was not detected at all
    gaps: int  # times that a spot was hidden in the picture for GAP_FRAMES or longer
    gaps_kept: int  # of them with the same identity before and after
    reentries: int  # times that a spot left the picture and came back
    reentries_kept: int

    @property
    def share(self) -> float:
        """Identity under the first label, 0 to 1."""
        return self.right / self.detected if self.detected else float("nan")


def distances(scene: Scene, rows: Tracked) -> Array:
    """From each row to the true places of all spots, (m, 6), px; inf to those of the other camera."""
    gap = np.linalg.norm(rows.uv_px[:, None] - scene.uv_px[rows.frame], axis=-1)
    return np.where(rows.camera[:, None] == CAMERA_OF, gap, np.inf)


def first_labels(scene: Scene, rows: Tracked) -> list[int | None]:
    """The identity that fits each spot most often in the naming frames; None where none does."""
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
    """(T, 6): the identity of the measured row nearest to each spot, within NEAR_PX; NOBODY without."""
    out = np.full((frames, SPOTS), NOBODY)
    for s in range(SPOTS):
        near = np.flatnonzero(rows.measured & (gap[:, s] < NEAR_PX))
        near = near[np.argsort(-gap[near, s])]  # the nearest is written last and stays
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
            before = before[before != NOBODY]
            kept = len(before) > 0 and bool(np.mean(identity[after, s] == before[-1]) >= 0.5)
            count[left][0] += 1
            count[left][1] += kept
    return count[False][0], count[False][1], count[True][0], count[True][1]


def _absences(detected: Bools) -> list[tuple[int, int]]:
    """First frame and end of every stretch without the spot, (T,), that begins after a frame with it."""
    change = np.diff(detected.astype(int))
    starts = np.flatnonzero(change < 0) + 1
    ends = np.flatnonzero(change > 0) + 1
    return [(int(k), int(next((e for e in ends if e > k), len(detected)))) for k in starts]
