"""Which sets of three spots to make candidate poses from: enough that any four visible spots hold a good one."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.spots import SpotModel

TIMES = 2  # triples in any four spots, where they have as many that fix the pose: noise may spoil one
FIXES = 1e-4  # least relative size of a singular value of the three spots' Jacobian; collinear spots have 1e-12


def conditioning(model: SpotModel, pixels: Array, J: Array, spots: Sequence[int]) -> dict[tuple[int, int, int], float]:
    """How well three spots fix the pose, for all sets of three: the median over poses of the least singular value.

    Relative to the largest, with pixels against metres and radians. pixels (k, n, 2), J (k, n, 2, 6): of k poses. Sets
    that never fix it, and sets with two spots of one beam end (a ray that may meet one of two screens), are left out.
    """
    first = {s: int(np.flatnonzero(model.spot_of == s)[0]) for s in spots}
    projected: Bools = np.isfinite(pixels[..., 0])
    out: dict[tuple[int, int, int], float] = {}
    for triple in combinations(spots, 3):
        rows = [first[s] for s in triple]
        if any(
            model.beam_of[a] == model.beam_of[b] and model.sign[a] == model.sign[b] for a, b in combinations(rows, 2)
        ):
            continue
        use = projected[:, rows].all(axis=1)
        if not use.any():
            use = np.ones(len(projected), dtype=bool)
        s = np.linalg.svd(J[use][:, rows].reshape(-1, 6, 6), compute_uv=False)
        value = float(np.median(s[:, -1] / np.maximum(s[:, 0], 1e-300)))
        if value > FIXES:
            out[triple] = value
    return out


def covering(triples: dict[tuple[int, int, int], float], spots: Sequence[int], least: int) -> Ints:
    """A few triples (k, 3), the best first, such that any `least` spots that hold good triples hold TIMES of them.

    Greedy: the triple that serves most sets of spots which still lack one, of equals the one that fixes the pose best.
    """
    sets = [frozenset(s) for s in combinations(spots, least)]
    holds: Array = np.array([[set(t) <= s for s in sets] for t in triples], dtype=float).reshape(
        len(triples), len(sets)
    )
    names = list(triples)
    quality = np.array([triples[t] for t in names])
    lacking = np.minimum(holds.sum(axis=0), TIMES)
    chosen: list[int] = []
    while lacking.any():
        served = holds @ np.minimum(lacking, 1.0)
        served[chosen] = 0.0
        if not served.max() > 0:
            break
        best = int(np.argmax(served + 0.5 * quality / max(quality.max(), 1e-300)))
        chosen.append(best)
        lacking = np.maximum(lacking - holds[best], 0.0)
    return np.array([names[i] for i in chosen], dtype=np.int64).reshape(-1, 3)
