"""Two recordings of one smooth motion, with a known alignment and known noise."""

from __future__ import annotations

import numpy as np

from geometry import rotations
from geometry.arrays import Array
from tracking.comparison.frame_alignment import Alignment, PoseSeries

TRUTH = Alignment(
    offset_s=0.137,
    rate=2e-4,
    middle_s=3.0,
    world=rotations.exp(np.array([0.3, -0.5, 2.0])),
    body=rotations.exp(np.array([-0.2, 0.1, 0.4])),
    lever_m=np.array([0.1, -0.05, 0.2]),
    translation_m=np.array([1.0, 2.0, 3.0]),
)


def smooth(t: Array, axes: tuple[float, float, float] = (1, 1, 1), places: float = 1.0) -> tuple[Array, Array]:
    """Attitudes and positions at times (n,), without a period. axes: factors of yaw, pitch and roll."""
    yaw = np.deg2rad(20) * np.sin(1.4 * t) + 0.03 * t
    pitch, roll = np.deg2rad(8) * np.sin(2.1 * t + 1), np.deg2rad(6) * np.sin(2.9 * t + 2)
    rotation = rotations.matrix_from_ypr(np.stack([yaw, pitch, roll], -1) * np.array(axes))
    position = np.stack([0.1 * np.sin(0.9 * t), 0.2 * np.cos(0.7 * t), 0.05 * np.sin(1.7 * t)], -1)
    return rotation, places * position


def noisy(
    motion: PoseSeries, sigma_m: float, sigma_rad: float, rng: np.random.Generator, alike: float = 0.0
) -> PoseSeries:
    """The motion with noise, which its covariance states: white, or alike in frames up to so many apart (1 sigma)."""
    n = len(motion)
    noise = rng.standard_normal((n, 6))
    if alike:
        kernel = np.exp(-(np.arange(-4 * alike, 4 * alike + 1) ** 2) / alike**2)
        longer = rng.standard_normal((n + len(kernel) - 1, 6))
        noise = np.stack([np.convolve(x, kernel / np.linalg.norm(kernel), "valid") for x in longer.T], axis=-1)
    noise *= np.array([sigma_m] * 3 + [sigma_rad] * 3)
    covariance = np.zeros((n, 6, 6))
    covariance[:] = np.diag([sigma_m**2] * 3 + [sigma_rad**2] * 3)
    assert motion.rotation is not None
    assert motion.position_m is not None
    return PoseSeries(
        motion.t_s, motion.rotation @ rotations.exp(noise[:, 3:]), motion.position_m + noise[:, :3], covariance
    )


def recordings(
    seed: int,
    move=smooth,
    *,
    truth: Alignment = TRUTH,
    frames: int = 300,
    step_s: float = 0.02,
    reference_step_s: float = 0.025,
    result_sigmas: tuple[float, float] = (2e-4, 1e-4),
    reference_sigmas: tuple[float, float] = (1e-4, 5e-5),
    alike: float = 0.0,
) -> tuple[PoseSeries, PoseSeries]:
    """A result, and a reference that is aligned to it by `truth`. Sigmas: m and rad; alike: as in `noisy`."""
    rng = np.random.default_rng(seed)
    t = step_s * np.arange(frames)
    s = truth.offset_s - 0.3 + reference_step_s * np.arange(int((frames * step_s + 0.7) / reference_step_s))
    seen = (s - truth.offset_s + truth.rate * truth.middle_s) / (1 + truth.rate)
    aligned = truth.applied(PoseSeries(s, *move(seen), np.zeros((len(s), 6, 6))))
    result = PoseSeries(t, *move(t), np.zeros((len(t), 6, 6)))
    return noisy(result, *result_sigmas, rng, alike), noisy(aligned, *reference_sigmas, rng)
