"""Spots that are longer along their motion than a shutter makes them show pictures that average over time."""

from __future__ import annotations

import numpy as np
import pytest

from tracking.noise_estimation.averaging import OPEN_SHUTTER, RowCounts, kept_of_the_last, stretch_by_motion


def seen(rng: np.random.Generator, growth: float, frames: int = 60) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Three spots on oblique screens: their shape changes with the place; one passes an edge in every other swing."""
    t = np.arange(frames + 2)[:, None]
    phase = rng.uniform(0, 2 * np.pi, (2, 3))
    uv = 200.0 + np.stack([30 * np.sin(0.06 * t + phase[0]), 20 * np.sin(0.11 * t + phase[1])], axis=-1)
    motion = (uv[2:] - uv[:-2]) / 2
    width = 2.0 + 0.005 * (uv[1:-1, :, 0] - 200.0)
    shape = (width**2)[..., None, None] * np.array([[1.3, 0.1], [0.1, 1.0]])
    shape = shape + growth * motion[..., :, None] * motion[..., None, :]
    noise = 0.1 * rng.normal(size=shape.shape)
    shape = shape + noise + np.swapaxes(noise, -1, -2)
    shape[7:11, 0] += [[3.0, 0.0], [0.0, 0.0]]
    sigma2 = np.full(shape.shape[:2], 0.02**2)
    return np.stack([uv[:-2], uv[1:-1], uv[2:]], axis=1), shape, sigma2


@pytest.mark.parametrize("growth", [0.0, OPEN_SHUTTER, 0.3, 2.0])
def test_the_growth_is_found_to_its_sigma(growth):
    """For no exposure, an open shutter, and filters that take a fifth and half of the picture before."""
    rng = np.random.default_rng(8)
    found = np.array([stretch_by_motion(*seen(rng, growth)) for _ in range(60)])
    off = (found[:, 0] - growth) / found[:, 1]
    assert 0.7 < np.sqrt(np.mean(off**2)) < 1.3
    assert np.abs(off).max() < 4.0
    assert np.median(found[:, 1]) < 0.05  # a fifth of the picture before is 0.31


def test_rest_and_few_pictures_say_nothing():
    uv, shape, sigma2 = seen(np.random.default_rng(1), 2.0)
    assert stretch_by_motion(uv[:9], shape[:9], sigma2[:9])[1] == np.inf
    assert stretch_by_motion(np.repeat(uv[:1, :1], 60, axis=0).repeat(3, axis=1), shape, sigma2)[1] == np.inf
    still = np.repeat(uv[:1, :1], 60, axis=0).repeat(3, axis=1) + 0.002 * np.random.default_rng(2).normal(size=uv.shape)
    growth, sigma = stretch_by_motion(still, shape, sigma2)
    assert growth - OPEN_SHUTTER < 3 * sigma


@pytest.mark.parametrize("share", [0.0, 0.2, 0.5])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_the_share_of_the_picture_before_is_found_in_the_noise(share, dtype):
    """Whatever stands in front of the camera, and while its light falls."""
    rng = np.random.default_rng(5)
    step = 1 if dtype == np.uint8 else 16  # 12 bits in the upper bits of 16
    room = step * rng.integers(20, 120, (30, 40)).repeat(12, axis=0).repeat(12, axis=1).astype(float)
    shown, pictures = room, []
    for k in range(12):
        shown = share * shown + (1 - share) * (room * (1 - 0.01 * k) + step * rng.normal(0.0, 2.0, room.shape))
        pictures.append((step * np.rint(shown / step)).astype(dtype))
    assert kept_of_the_last(pictures[-3:], step**2 / 12) == pytest.approx(share, abs=0.04)


def test_pictures_that_say_nothing_about_averages_are_none():
    rng = np.random.default_rng(6)
    noise = rng.normal(0.0, 2.0, (3, 160, 160))
    blocks = np.repeat(np.rint(noise[:1] + 50), 3, axis=0)  # a compressed video at rest
    for pictures in (blocks, np.rint(noise + 50)[:2], np.rint(50 + 0.1 * noise), np.rint(noise + 50)[:, :9, :9]):
        assert np.isnan(kept_of_the_last(list(pictures.astype(np.uint8)), 1 / 12))


def bars(seed: int, second_rows: slice, height: int = 120, width: int = 10) -> tuple[np.ndarray, np.ndarray]:
    """Two noisy pictures of a bar, 30 DN bright, that has moved by its width in these rows of the second one."""
    first = np.full((120, 160), 60.0)
    first[:height, 40 : 40 + width] += 30.0
    second = first.copy()
    second[:height][second_rows] = np.roll(first[:height][second_rows], width, axis=1)
    noise = np.random.default_rng(seed).normal(0.0, 2.0, (2, *first.shape))
    return tuple(np.rint(p).astype(np.uint8) for p in np.add(noise, (first, second)))


def counted(*pictures: tuple[np.ndarray, np.ndarray]) -> RowCounts:
    counts = RowCounts()
    for first, second in pictures:
        counts.add(first, second)
    return counts


def test_rows_of_two_instants_alternate_where_something_moves():
    """An edge of 7 sigmas of the noise is enough; the sum over pictures counts."""
    assert counted(bars(1, np.s_[::2])).interlaced
    assert not counted(bars(1, np.s_[:])).interlaced  # progressive
    few = bars(2, np.s_[::2], height=10, width=1)
    assert not counted(few).interlaced
    assert counted(*[few] * 8).interlaced
    assert not counted((few[0], few[1][:, :80])).interlaced  # of another size


def test_texture_that_appears_and_blocks_of_a_video_do_not_alternate_as_interlaced_rows_do():
    first, part = np.full((120, 160), 60, np.uint8), np.s_[:, 40:60]
    board, stripes = first.copy(), first.copy()
    board[part] += (40 * (np.indices(board[part].shape).sum(axis=0) % 2)).astype(np.uint8)  # in columns as well
    assert not counted((first, board)).interlaced
    for row in (0, 2, 11, 13):  # rows that alternate four times in turn, and no more
        stripes[row:100:22, 40:60] += 40
    stripes[[106, 108, 110], 40:60] += 40  # in one place six times
    assert not counted((first, stripes)).interlaced
