"""Laser light on a matt screen, as `beampose detect` sees it: fully developed speckle of resolved grains."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner

from cli import main

SIZE, FRAMES, FINE, FULL_E = (400, 480), 10, 3, 20_000.0  # FINE: samples per pixel and axis
PLACES = np.array([[90.0, 80.0], [240.0, 90.0], [380.0, 100.0], [110.0, 300.0], [250.0, 310.0], [390.0, 290.0]])


def speckle(rng: np.random.Generator, grain_px: float, patterns: int) -> np.ndarray:
    """FINE times as fine as the pixels, of mean 1: squares of fields of random phases behind a round aperture.

    grain_px: sigma of the aperture's own spot, 0.42 of wavelength times aperture number.
    """
    shape = (FINE * SIZE[0], FINE * SIZE[1])
    v, u = np.meshgrid(np.fft.fftfreq(shape[0]), np.fft.fftfreq(shape[1]), indexing="ij")
    passed = np.hypot(u, v) < 0.42 / (2 * grain_px * FINE)
    light = sum(np.abs(np.fft.ifft2(passed * np.exp(2j * np.pi * rng.random(shape)))) ** 2 for _ in range(patterns))
    return np.asarray(light / np.mean(light))


def recording(folder: Path, width_px: float, grain_px: float, patterns: int, step_px: float) -> np.ndarray:
    """Pictures of six spots that move over the screen; their centres (FRAMES, 6, 2), px."""
    rng = np.random.default_rng(7)
    field = speckle(rng, grain_px, patterns)
    v, u = (np.arange(FINE * n).reshape(shape) for n, shape in zip(SIZE, ((-1, 1), (1, -1)), strict=True))
    v, u = ((x + 0.5) / FINE - 0.5 for x in (v, u))
    centres = PLACES + step_px * np.arange(FRAMES)[:, None, None] * [1.0, 0.6]
    for k, spots in enumerate(centres):
        light = np.zeros(field.shape)
        for at in spots:
            light += np.exp(-0.5 * ((v - at[1]) / width_px) ** 2) * np.exp(-0.5 * ((u - at[0]) / width_px) ** 2)
        pixels = (light * field).reshape(SIZE[0], FINE, SIZE[1], FINE).mean(axis=(1, 3))
        electrons = rng.poisson(FULL_E * (0.06 + 0.25 * pixels)) + rng.normal(0.0, 4.0, SIZE)
        cv2.imwrite(
            str(folder / f"p_{k:03d}.png"), np.clip(np.rint(electrons * 255 / FULL_E + 8), 0, 255).astype(np.uint8)
        )
    return centres


@pytest.mark.parametrize(
    ("width_px", "grain_px", "patterns", "step_px"),
    [(4.0, 0.45, 1, 3.0), (4.0, 0.9, 2, 3.0), (3.0, 0.35, 1, 0.0), (7.0, 0.9, 1, 2.0), (1.3, 0.35, 1, 3.0)],
    ids=["wide", "coarse grains", "at rest", "very wide", "narrow"],
)
def test_a_laser_spot_is_one_point_however_grainy_it_is(tmp_path, width_px, grain_px, patterns, step_px):
    """Each spot is one point at its place, with a sigma that holds for the errors by speckle."""
    centres = recording(tmp_path, width_px, grain_px, patterns, step_px)
    done = CliRunner().invoke(main, ["detect", str(tmp_path), "--out", str(tmp_path / "out")])
    assert done.exit_code == 0, done.output
    table = pd.read_csv(tmp_path / "out" / "detections.csv")
    ratios = []
    for k, spots in enumerate(centres):
        found = table[table["frame"] == k]
        away = np.hypot(*(found[["u_px", "v_px"]].to_numpy()[:, None] - spots).T)  # (spots, points)
        assert len(found) == len(spots)
        assert (away.min(axis=1) < width_px).all()
        nearest = found.iloc[away.argmin(axis=1)]
        error = nearest[["u_px", "v_px"]].to_numpy() - spots
        ratios.append(error / nearest[["sigma_u_px", "sigma_v_px"]].to_numpy())
    assert 0.5 < np.sqrt(np.mean(np.square(ratios))) < 1.6


def test_flat_beams_without_speckle_are_measured_in_their_pixels(tmp_path):
    """No Gaussian fits them, but nothing in them is grainy: sums of pixels would only lose resolution."""
    rng = np.random.default_rng(8)
    v, u = np.ogrid[: SIZE[0], : SIZE[1]]
    for k in range(FRAMES):
        light = np.zeros(SIZE)
        for at in PLACES + k * np.array([3.1, 1.7]):
            light += np.clip(8.5 - np.hypot(v - at[1], u - at[0]), 0.0, 1.0)  # a disc with a radius of 8 px
        electrons = rng.poisson(FULL_E * (0.02 + 0.4 * light)) + rng.normal(0.0, 4.0, SIZE)
        grey = np.clip(np.rint(electrons * 255 / FULL_E + 8), 0, 255).astype(np.uint8)
        cv2.imwrite(str(tmp_path / f"p_{k:03d}.png"), grey)
    done = CliRunner().invoke(main, ["detect", str(tmp_path), "--out", str(tmp_path / "out")])
    assert done.exit_code == 0, done.output
    noise = json.loads((tmp_path / "out" / "summary.json").read_text())["noise"]
    assert [camera["summed_px"] for camera in noise] == [1]


def test_spots_too_narrow_in_sums_have_the_error_that_their_pixels_show(tmp_path):
    """In the pixels a fifth of a pixel, 0.06 of the width, is seen; in the sums no spot is wide enough to show it."""
    recording(tmp_path, 3.0, 0.35, 2, 3.0)
    done = CliRunner().invoke(main, ["detect", str(tmp_path), "--out", str(tmp_path / "out")])
    assert done.exit_code == 0, done.output
    noise = json.loads((tmp_path / "out" / "summary.json").read_text())["noise"][0]
    assert noise["summed_px"] == 2
    table = pd.read_csv(tmp_path / "out" / "detections.csv")
    share = table[["sigma_u_px", "sigma_v_px"]].min(axis=1) / np.sqrt(table["major_px"] * table["minor_px"])
    assert share.min() > 0.9 * noise["estimated"]["texture_shift"]["misfit_share"]
