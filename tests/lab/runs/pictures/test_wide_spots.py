"""Runs on a spot that is wider than the detector accepts by default, in the only camera that sees its beam's end."""

from __future__ import annotations

import json
import re
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest

from geometry.camera import Camera
from geometry.planes import intersect_plane
from geometry.rig import Screen
from lab.files.rig.rig_file import load_rig
from tests.lab.command import typed
from tests.marks import further_slow

SIZE, FRAMES, WIDE_PX = (512, 640), 30, 38.0
Y, X = np.mgrid[: SIZE[0], : SIZE[1]]
UNLIT = np.full(SIZE, 12.0)
# A room: squares, edges in other directions, a slope of its light, and fine texture.
ROOM = (
    24.0
    + 30.0 * (np.sin(X / 21.0 + 1.0) * np.sin(Y / 17.0) > 0.0)
    + 12.0 * (np.sin(X / 9.0 - Y / 31.0) > 0.8)
    + X / 80.0
    + cv2.GaussianBlur(np.random.default_rng(4).normal(0.0, 8.0, SIZE), (0, 0), 1.5)
)


def on_screen(camera: Camera, screen: Screen, uv: np.ndarray) -> np.ndarray:
    """Places (..., 2) on a screen, m, that pixels (..., 2) show."""
    return np.asarray(intersect_plane(*camera.rays(np.asarray(uv, float)), screen.world_from_screen))


def recording(folder: Path, ground: np.ndarray) -> Path:
    """A run folder with pictures of five spots: that of the left camera is wide, and all move over this ground (h, w).

    The ground modulates half of the light that falls on it.
    """
    made = typed("simulate", "four-skew-beams", "--frames", FRAMES, "--scale", "0.5", "--points", "--out", folder)
    assert made.exit_code == 0, made.output
    for path in (folder / "rig.yaml", folder / "truth" / "spots.csv"):
        text = path.read_text()
        kept = [s for s in text.splitlines() if not re.match(r"\s+'[13]':|\d+,left,[13],", s)]
        path.write_text("\n".join(kept) + "\n")
    run = folder / "run.yaml"
    run.write_text(re.sub(r"(left|right):\n +detections: detections.csv", r"\1: {frames: frames/\1}", run.read_text()))
    (folder / "detections.csv").unlink()
    truth = pd.read_csv(folder / "truth" / "spots.csv")
    rig = load_rig(folder / "rig.yaml")
    rng, response = np.random.default_rng(1), 0.5 + 0.5 * ground / ground.mean()
    for camera, sigma in (("left", WIDE_PX), ("right", 1.6)):
        (folder / "frames" / camera).mkdir(parents=True)
        view = rig.cameras[camera], rig.screens[camera]
        every = on_screen(*view, np.stack([X, Y], axis=-1))
        sigma_m = sigma * np.hypot(*(every[1:, :-1] - every[:-1, :-1]).mean(axis=(0, 1)))
        for frame in range(FRAMES):
            at = truth[(truth.camera == camera) & (truth.frame == frame)][["u_px", "v_px"]].to_numpy()
            light = np.zeros(SIZE)
            for (u, v), spot in zip(at, on_screen(*view, at), strict=True):
                near = tuple(slice(max(int(x - 12 * sigma), 0), max(int(x + 12 * sigma), 0)) for x in (v, u))
                x, y = np.moveaxis(every[near] - spot, -1, 0)
                light[near] += np.exp(-0.5 * (x**2 + y**2) / sigma_m**2)
            seen = ground + response * 90.0 * light + rng.normal(0.0, 1.0, SIZE)
            picture = np.clip(np.rint(seen), 0, 255).astype(np.uint8)
            cv2.imwrite(str(folder / "frames" / camera / f"{frame:06d}.png"), picture)
    return folder


@pytest.mark.parametrize("ground", further_slow([UNLIT, ROOM]), ids=["unlit", "room"])
def test_a_spot_that_is_too_wide_is_named_with_the_value_that_admits_it(tmp_path, ground):
    """Not used, it leaves no wrong pose behind; with the stated value it is measured, and its pose is right."""
    folder = recording(tmp_path / "run", ground)
    typed("run", folder, "--out", tmp_path / "plain")
    plain = json.loads((tmp_path / "plain" / "summary.json").read_text())["verdict"]
    codes = {finding["code"] for finding in plain["evidence"]}
    assert "BP-V21" in codes
    assert not codes & {"BP-V20", "BP-M06"}  # the truth contradicts no pose, and no mistake is suspected
    value = re.search(r"--set (detect.max_sigma_px=\d+)", " ".join(plain["reasons"]))
    assert value is not None
    wide = typed("run", folder, "--out", tmp_path / "wide", "--set", value[1])
    assert wide.exit_code == 0, wide.output
    spots = pd.read_csv(tmp_path / "wide" / "spots.csv").merge(
        pd.read_csv(folder / "truth" / "spots.csv"), on=["frame", "camera", "spot"], suffixes=("", "_true")
    )
    spots = spots[spots.status.isin(["matched", "turned"])]
    left = spots[spots.camera == "left"]
    assert len(left) > 0.95 * FRAMES
    away = np.hypot(left.u_px - left.u_px_true, left.v_px - left.v_px_true)
    assert away.max() < 0.02 * WIDE_PX
    assert (away < 3.5 * np.hypot(left.sigma_u_px, left.sigma_v_px)).all()
