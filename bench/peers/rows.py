"""The output of every tracker: labelled points, and the process time of its loop."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from geometry.arrays import Array, Bools, Ints


@dataclass(frozen=True, slots=True)
class Tracked:
    """m rows over one scene. Identities are those of the tracker, with any values; scoring assigns them to spots."""

    frame: Ints  # (m,)
    camera: Ints  # (m,)
    identity: Ints  # (m,)
    uv_px: Array  # (m, 2)
    measured: Bools  # (m,) True: a detection of this frame; False: a prediction
    spent_s: float  # process time of the tracking loop: from arrays of points to identities, without imports

    @staticmethod
    def of(rows: Iterable[tuple[int, int, int, float, float]], spent_s: float) -> Tracked:
        """From rows (frame, camera, identity, u, v), all of them measured."""
        table = np.array(list(rows), dtype=float).reshape(-1, 5)
        frame, camera, identity = table[:, :3].astype(np.int64).T
        return Tracked(frame, camera, identity, table[:, 3:], np.ones(len(table), dtype=bool), spent_s)
