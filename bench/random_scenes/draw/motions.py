"""Motions of the vehicle: shapes (T, 6) between -1 and 1 over time, and the times of their corners."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from geometry.arrays import Array


@dataclass(frozen=True, slots=True)
class Motion:
    """x, y, z, yaw, pitch, roll in units of their amplitudes."""

    shape: Array  # (T, 6)
    corners_s: Array  # (c,) times at which the velocity jumps, or a manoeuvre begins or ends
    text: str


def draw_motion(rng: np.random.Generator, t_s: Array) -> Motion:
    """One of MOTIONS over the times (T,)."""
    names = list(MOTIONS)
    return MOTIONS[names[int(rng.choice(len(names), p=WEIGHTS))]](rng, t_s)


def sines(rng: np.random.Generator, t_s: Array) -> Motion:
    """Two sines per coordinate, all within two octaves."""
    middle = float(np.exp(rng.uniform(np.log(0.05), np.log(8.0))))
    return Motion(_sines(rng, t_s, middle), np.zeros(0), f"sines about {middle:.2g} Hz")


def _sines(rng: np.random.Generator, t_s: Array, middle_hz: float) -> Array:
    hz = middle_hz * 2 ** rng.uniform(-1, 1, (2, 6))
    phase = rng.uniform(0, 2 * np.pi, (2, 6))
    share = np.array([[0.7], [0.3]])
    return np.asarray(np.sum(share * np.sin(2 * np.pi * t_s[:, None, None] * hz + phase), axis=1))


def zigzag(rng: np.random.Generator, t_s: Array) -> Motion:
    """Straight segments in all six coordinates; corners at random times, in one of five scenes at frames."""
    frame_s = t_s[1] - t_s[0]
    mean = float(np.exp(rng.uniform(np.log(6), np.log(70))))
    at_frames = rng.random() < 0.2
    corners = [t_s[0] - frame_s * rng.uniform(0, mean)]
    while corners[-1] < t_s[-1]:
        gap = max(2.0, mean * (0.4 + rng.exponential(0.6)))
        corners.append(corners[-1] + frame_s * (round(gap) if at_frames else gap))
    if at_frames:
        corners = [round(c / frame_s) * frame_s for c in corners]
    values = rng.uniform(-1, 1, (len(corners), 6))
    shape = np.stack([np.interp(t_s, corners, v) for v in values.T], axis=-1)
    inside = np.array([c for c in corners if t_s[0] < c < t_s[-1]])
    return Motion(shape, inside, f"zig-zag, corners every {mean:.0f} frames{' at frames' * at_frames}")


def rest_then_motion(rng: np.random.Generator, t_s: Array) -> Motion:
    """At rest for 15 to 70 % of the time; then a straight motion or a swing, abrupt or eased."""
    start = rng.uniform(0.15, 0.7) * t_s[-1]
    since = np.maximum(t_s - start, 0.0)
    way = rng.uniform(-1, 1, 6)
    how = int(rng.integers(3))
    if how == 0:
        shape = since[:, None] / max(t_s[-1] - start, 1e-9) * way
        text = "rest, then straight on"
    else:
        hz = float(np.exp(rng.uniform(np.log(0.2), np.log(6.0))))
        shape = np.sin(2 * np.pi * hz * since)[:, None] * way
        text = f"rest, then a swing of {hz:.2g} Hz"
    if how == 2:
        ease = rng.uniform(0.05, 0.6) * (t_s[-1] - start)
        shape = shape * smooth_step(since / ease)[:, None]
        text += ", eased"
    return Motion(shape, np.array([start]), text)


def excursions(rng: np.random.Generator, t_s: Array) -> Motion:
    """Occasional excursions."""
    frame_s = t_s[1] - t_s[0]
    shape = np.zeros((len(t_s), 6))
    abrupt = rng.random() < 0.4
    at = rng.uniform(10, 50) * frame_s
    corners = []
    while at < t_s[-1]:
        out, stay, back = frame_s * np.exp(rng.uniform(np.log([3, 1, 3]), np.log([40, 30, 40])))
        times = np.cumsum([at, out, stay, back])
        level = np.interp(t_s, times, [0, 1, 1, 0])
        shape += (level if abrupt else smooth_step(level))[:, None] * rng.uniform(-1, 1, 6)
        corners += times.tolist()
        at = times[-1] + rng.uniform(5, 60) * frame_s
    return Motion(shape, np.array([c for c in corners if c < t_s[-1]]), f"excursions{', abrupt' * abrupt}")


def steps(rng: np.random.Generator, t_s: Array) -> Motion:
    """A stepping turntable, which turns fast between stops; about one axis, or slightly about all."""
    frame_s = t_s[1] - t_s[0]
    lead = np.full(6, 0.0 if rng.random() < 0.5 else 0.1)
    lead[3 + rng.integers(3)] = 1.0
    abrupt = rng.random() < 0.5
    turn = np.exp(rng.uniform(np.log(1), np.log(20)))
    at, level = rng.uniform(5, 30) * frame_s, 0.0
    times, levels = [0.0], [0.0]
    while at < t_s[-1]:
        new = rng.uniform(-1, 1)
        times += [at, at + turn * frame_s]
        levels += [level, new]
        at, level = times[-1] + rng.uniform(8, 45) * frame_s, new
    if abrupt:
        path = np.interp(t_s, times, levels)
    else:
        path = np.full(len(t_s), levels[-1])
        for a, b, u, v in zip(times[1::2], times[2::2], levels[1::2], levels[2::2], strict=True):
            now = (t_s >= a) & (t_s < b)
            path[now] = u + (v - u) * smooth_step((t_s[now] - a) / (b - a))
        for b, a, u in zip([-np.inf, *times[2::2]], [*times[1::2], np.inf], levels[::2], strict=True):
            path[(t_s >= b) & (t_s < a)] = u
    corners = np.array([c for c in times[1:] if c < t_s[-1]])
    return Motion(path[:, None] * lead, corners, f"turntable steps of {turn:.0f} frames{', abrupt' * abrupt}")


def uniform(rng: np.random.Generator, t_s: Array) -> Motion:
    """Uniform motion."""
    a, b = rng.uniform(-1, 1, (2, 6))
    return Motion(a + (t_s / t_s[-1])[:, None] * (b - a), np.zeros(0), "uniform")


def rest(rng: np.random.Generator, t_s: Array) -> Motion:
    """Always at rest."""
    return Motion(np.zeros((len(t_s), 6)) + rng.uniform(-1, 1, 6), np.zeros(0), "at rest")


def slow(rng: np.random.Generator, t_s: Array) -> Motion:
    """Sines slower than 0.2 Hz."""
    return Motion(_sines(rng, t_s, float(rng.uniform(0.02, 0.1))), np.zeros(0), "slow")


def smooth_step(x: Array) -> Array:
    """0 below 0, 1 above 1, and between them x^3 (10 - 15 x + 6 x^2), whose second derivative is continuous."""
    x = np.clip(x, 0, 1)
    return np.asarray(x**3 * (10 - 15 * x + 6 * x**2))


MOTIONS: dict[str, Callable[[np.random.Generator, Array], Motion]] = {
    "sines": sines,
    "zigzag": zigzag,
    "rest then motion": rest_then_motion,
    "excursions": excursions,
    "steps": steps,
    "uniform": uniform,
    "rest": rest,
}
WEIGHTS = (0.34, 0.24, 0.12, 0.1, 0.1, 0.05, 0.05)
