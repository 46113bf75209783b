"""Selection of the sets of three spots for candidate poses: any set of visible spots contains enough of them."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from geometry.arrays import Array, Ints

TIMES = 2  # triples in any set of visible spots, if it has that many that determine the pose: noise may affect one
MOST_SETS = 5000  # sets of one size that are considered: a random sample if there are more (above 12 spots)


def covering(
    triples: dict[tuple[int, int, int], float], spots: Sequence[int], least: int
) -> tuple[Ints, dict[int, int]]:
    """Triples (k, 3) such that any set of at least `least` spots contains TIMES of them, if possible; and stages.

    triples: the quality with which each determines the pose. The larger sets of spots are covered first: the first
    `stages[m]` triples cover all sets of m or more spots. Greedy set cover: the next triple is the one that covers most
    of the sets that still lack one; of equals the one with the best quality.
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
        covers: Array = np.array([[s.issuperset(t) for s in sets] for t in names], dtype=float).reshape(-1, len(sets))
        lacking = np.minimum(covers.sum(axis=0), TIMES)
        lacking = np.maximum(lacking - covers[chosen].sum(axis=0), 0.0)
        while lacking.any():
            covered = covers @ np.minimum(lacking, 1.0)
            covered[chosen] = 0.0
            best = int(np.argmax(covered + 0.5 * quality / quality.max()))
            if not covered[best] > 0:
                break
            chosen.append(best)
            lacking = np.maximum(lacking - covers[best], 0.0)
        stages[size] = len(chosen)
    return np.array([names[i] for i in chosen], dtype=np.int64).reshape(-1, 3), stages
