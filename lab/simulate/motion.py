"""Motions of the vehicle as functions of time, which give the exact pose at any instant of an exposure."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from geometry.arrays import Array
from geometry.pose import Pose

AXES = ("x", "y", "z", "yaw", "pitch", "roll")
SHAPES = ("sine", "triangle", "plateau", "steps")
_STEPNESS = 2.5  # of "plateau": tanh(2.5 sin) stays within 10 % of its end value for two thirds of each half cycle
_STEPS = 6  # of "steps": number of steps from end to end
_MOVING = 0.4  # of "steps": share of the time of each step in motion


@dataclass(frozen=True, slots=True)
class Wave:
    """One periodic part of the motion of one axis."""

    axis: str  # one of AXES
    amplitude: float  # m for x, y, z; deg for yaw, pitch, roll
    frequency_hz: float
    shape: str = "sine"  # one of SHAPES
    phase: float | None = None  # cycles at t = 0; None: drawn per seed

    def __post_init__(self) -> None:
        if self.axis not in AXES or self.shape not in SHAPES:
            raise ValueError(f"a wave has an axis of {AXES} and a shape of {SHAPES}, got {self.axis!r}, {self.shape!r}")

    def at(self, t_s: Array) -> Array:
        """The wave at times (...), in its axis' unit."""
        return self.amplitude * _unit_wave(self.shape, self.frequency_hz * np.asarray(t_s) + (self.phase or 0.0))


def _unit_wave(shape: str, cycles: Array) -> Array:
    """A wave between -1 and 1 with period 1. All start at 0 or -1 and rise."""
    if shape == "sine":
        return np.sin(2 * np.pi * cycles)
    if shape == "plateau":
        return np.tanh(_STEPNESS * np.sin(2 * np.pi * cycles)) / np.tanh(_STEPNESS)
    up_and_down = 1 - np.abs(2 * (cycles - np.floor(cycles)) - 1)  # 0 at whole cycles, 1 half way
    if shape == "triangle":
        return 2 * up_and_down - 1
    level = up_and_down * _STEPS
    whole = np.floor(level)
    # Each step: rest, then a move with a sinusoidal speed, so that the speed has no jumps.
    moved = np.clip((level - whole - (1 - _MOVING) / 2) / _MOVING, 0.0, 1.0)
    return 2 * (whole + 0.5 * (1 - np.cos(np.pi * moved))) / _STEPS - 1


@dataclass(frozen=True, slots=True)
class Motion:
    """The sum of waves about a mean pose."""

    middle: tuple[float, float, float, float, float, float]  # x, y, z (m), yaw, pitch, roll (deg)
    waves: tuple[Wave, ...]

    def drawn(self, rng: np.random.Generator, frame_rate_hz: float) -> Motion:
        """This motion with the missing phases drawn.

        The corners of triangles coincide with frames, so that a constant-velocity prediction fails in exactly one frame
        after each corner.
        """
        waves = []
        for w in self.waves:
            phase = rng.random()
            frames_per_cycle = frame_rate_hz / w.frequency_hz
            if w.shape == "triangle":
                phase = np.round(phase * frames_per_cycle) / frames_per_cycle
            waves.append(w if w.phase is not None else replace(w, phase=float(phase)))
        return Motion(self.middle, tuple(waves))

    def faster(self, factor: float) -> Motion:
        """The same path in less time."""
        return Motion(self.middle, tuple(replace(w, frequency_hz=w.frequency_hz * factor) for w in self.waves))

    def at(self, t_s: Array) -> Array:
        """x, y, z (m), yaw, pitch, roll (rad), (..., 6), at times (...), s."""
        t_s = np.asarray(t_s, dtype=float)
        out = np.broadcast_to(np.array(self.middle, dtype=float), (*t_s.shape, 6)).copy()
        for w in self.waves:
            out[..., AXES.index(w.axis)] += w.at(t_s)
        out[..., 3:] = np.deg2rad(out[..., 3:])
        return out

    def pose(self, t_s: Array) -> Pose:
        """world_from_body, stacked (...), at times (...), s."""
        q = self.at(t_s)
        return Pose.from_ypr(q[..., 3:], q[..., :3])

    def bends_s(self, end_s: float) -> Array:
        """The sorted times (n,) in (0, end_s] of the corners of triangles, where the velocity jumps."""
        times = [np.zeros(0)]
        for w in self.waves:
            if w.shape == "triangle":
                halves = np.arange(np.floor(2 * (w.frequency_hz * end_s + (w.phase or 0.0))) + 1)
                times.append((halves / 2 - (w.phase or 0.0)) / w.frequency_hz)
        bends: Array = np.unique(np.round(np.concatenate(times), 9))
        return np.asarray(bends[(bends > 0) & (bends <= end_s)], dtype=np.float64)
