"""Random vehicles: two to six beams, and the ends that emit light."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geometry import rotations
from geometry.arrays import Array

LEFT, RIGHT, THIRD = "left", "right", "third"  # the screens
LEAST_BETWEEN = np.deg2rad(4.0)  # between two beams
LEAST_SPOTS = 4


@dataclass(frozen=True, slots=True)
class Vehicle:
    """Beams in the vehicle frame and the ends that emit light: (beam, sign, screen)."""

    beams: dict[str, tuple[Array, Array]]  # direction (3,), point (3,), m
    ends: tuple[tuple[str, int, str], ...]
    text: str


def draw_vehicle(rng: np.random.Generator, third: Array | None) -> Vehicle:
    """Two to six beams. third: the unit direction (3,) to a third screen, which one or two of them point to."""
    while True:
        count = int(rng.choice([2, 3, 4, 5, 6], p=[0.2, 0.35, 0.2, 0.15, 0.1]))
        aside = 0 if third is None else int(rng.integers(1, min(2, count - 1) + 1))
        along = max(count - aside, 1)
        kind = str(rng.choice(["equal fan", "unequal fan", "skew", "apart", "rolled fan"]))
        directions, points = _lines(rng, kind, along)
        side = [_within_cone(rng, third, np.deg2rad(25)) for _ in range(aside)] if third is not None else []
        all_of = [*directions, *side]
        points = [*points, *(rng.uniform(-0.15, 0.15, 3) for _ in side)]
        if _closest(all_of) < LEAST_BETWEEN:
            continue
        names = [chr(ord("A") + i) for i in range(len(all_of))]
        ends = [(n, sign, s) for sign, s in ((-1, LEFT), (1, RIGHT)) for n in names[:along]]
        ends += [(n, 1, THIRD) for n in names[along:]]
        single = rng.random() < 0.25
        if single:
            kept = [e for e in ends if e[2] == THIRD or rng.random() > 0.3]
            used = {n for n, _, _ in kept}
            if len(kept) < LEAST_SPOTS or used != set(names):
                continue
            ends = kept
        if len(ends) < LEAST_SPOTS:
            continue
        beams = {n: (d, p) for n, d, p in zip(names, all_of, points, strict=True)}
        text = f"{len(all_of)} beams ({kind}{', single-ended' * single}{f', {aside} aside' if aside else ''})"
        return Vehicle(beams, tuple(ends), text)


def _lines(rng: np.random.Generator, kind: str, count: int) -> tuple[list[Array], list[Array]]:
    """Directions and points of beams roughly along x."""
    if kind == "skew":
        skew = [_within_cone(rng, np.array([1.0, 0, 0]), np.deg2rad(28)) for _ in range(count)]
        return skew, [rng.uniform(-0.2, 0.2, 3) for _ in range(count)]
    if kind == "equal fan":
        angles = np.deg2rad(rng.uniform(5, min(25, 70 / max(count - 1, 1)))) * (np.arange(count) - (count - 1) / 2)
    else:
        steps = np.deg2rad(rng.uniform(4, 20, max(count - 1, 0)))
        angles = np.concatenate([[0.0], np.cumsum(steps)])
        angles = (angles - angles.mean()) * min(1.0, np.deg2rad(70) / max(np.ptp(angles), 1e-9))
    directions = np.stack([np.cos(angles), np.sin(angles), np.zeros(count)], axis=-1)
    points = np.zeros((count, 3))
    if kind == "apart":
        points = rng.uniform(-0.3, 0.3, (count, 3))
    elif rng.random() < 0.3:
        points += rng.uniform(-0.3, 0.3, 3)
    if kind == "rolled fan":
        roll = rotations.exp(np.array([rng.uniform(-np.pi, np.pi), 0, 0]))
        directions, points = directions @ roll.T, points @ roll.T
    return list(directions), list(points)


def _closest(directions: list[Array]) -> float:
    """The smallest angle between two lines, rad."""
    D = np.array(directions)
    c = np.abs(D @ D.T) - np.eye(len(D))
    return float(np.arccos(np.clip(c.max(), 0, 1)))


def _within_cone(rng: np.random.Generator, axis: Array, half_angle: float) -> Array:
    """A unit vector (3,) at most half_angle from the axis."""
    turn = rng.normal(size=3)
    turn -= axis * (turn @ axis)
    turn *= half_angle * np.sqrt(rng.random()) / np.linalg.norm(turn)
    return np.asarray(rotations.exp(turn) @ axis)
