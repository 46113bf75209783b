"""Which sets of three spots to make candidate poses from: enough that any four visible spots hold a good one."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from geometry.arrays import Array, Ints

TIMES = 2  # triples in any set of visible spots, where it has as many that fix the pose: noise may spoil one
MOST_SETS = 5000  # of one size: of more spots than 12 a sample will do


def covering(
    triples: dict[tuple[int, int, int], float], spots: Sequence[int], least: int
) -> tuple[Ints, dict[int, int]]:
    """A few triples (k, 3) such that any `least` spots that hold triples hold TIMES of them; and their stages.

    triples: how well each fixes the pose. The order is such that the larger sets of spots are served first: the
    first `stages[m]` triples serve all sets of m spots and more. Greedy: next comes the triple that serves most sets
    which still lack one, of equals the one that fixes the pose best.
    """
    names = list(triples)
    quality = np.array([triples[t] for t in names])
    rng = np.random.default_rng(0)
    chosen: list[int] = []
    stages: dict[int, int] = {}
    for size in range(len(spots), least - 1, -1):
        sets = [frozenset(s) for s in combinations(spots, size)]
        if len(sets) > MOST_SETS:
            sets = [sets[i] for i in rng.choice(len(sets), MOST_SETS, replace=False)]
        holds: Array = np.array([[s.issuperset(t) for s in sets] for t in names], dtype=float).reshape(-1, len(sets))
        lacking = np.minimum(holds.sum(axis=0), TIMES)
        lacking = np.maximum(lacking - holds[chosen].sum(axis=0), 0.0)
        while lacking.any():
            served = holds @ np.minimum(lacking, 1.0)
            served[chosen] = 0.0
            best = int(np.argmax(served + 0.5 * quality / quality.max()))
            if not served[best] > 0:
                break
            chosen.append(best)
            lacking = np.maximum(lacking - holds[best], 0.0)
        stages[size] = len(chosen)
    return np.array([names[i] for i in chosen], dtype=np.int64).reshape(-1, 3), stages
