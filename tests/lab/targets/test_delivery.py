"""Pictures that do not show one instant each: the verdict names them."""

from __future__ import annotations

import json
import re

import cv2
import numpy as np
import pandas as pd
import pytest

from tests.lab.command import typed

SIZE, FRAMES = (320, 240), 40


def centre(k):
    return np.array([160 + 90 * np.sin(k / 9), 120 + 60 * np.sin(k / 13)])


def clean(k):
    """A black disc before a grey field (h, w) at time k, frames."""
    v, u = np.mgrid[: SIZE[1], : SIZE[0]]
    inside = np.clip(8.5 - np.hypot(u - centre(k)[0], v - centre(k)[1]), 0, 1)
    return cv2.GaussianBlur(150 - 100 * inside, (0, 0), 0.8)


def recorded(folder, delivered):
    """The pictures that a camera delivers of FRAMES instants; delivered: (noise, the one before, k) to a picture."""
    rng, folder, before = np.random.default_rng(5), folder / "frames", None
    folder.mkdir()
    for k in range(FRAMES):
        before = delivered(rng.normal(0, 2, SIZE[::-1]), before, k)
        cv2.imwrite(str(folder / f"{k:03d}.png"), np.clip(np.rint(before), 0, 255).astype(np.uint8))
    return folder


def plain(noise, before, k):
    return clean(k) + noise


def averaged(noise, before, k):
    return clean(k) + noise if before is None else 0.5 * before + 0.5 * (clean(k) + noise)


def interlaced(noise, before, k):
    picture = clean(k)
    picture[1::2] = clean(k + 0.5)[1::2]
    return picture + noise


def repeated(noise, before, k):
    return before if k in AGAIN else clean(k) + noise


AGAIN = (12, 20, 21, 33)


def tracked(folder, out):
    arguments = ["track", "point", str(folder), "--detector", "darker", "--out", str(out)]
    assert typed(*arguments).exit_code == 0
    summary = json.loads((out / "summary.json").read_text())
    return summary, pd.read_csv(out / "track.csv")


@pytest.mark.parametrize(("delivered", "codes"), [(plain, set()), (averaged, {"BP-U01"}), (interlaced, {"BP-U02"})])
def test_pictures_that_mix_instants_are_named(delivered, codes, tmp_path):
    summary, _ = tracked(recorded(tmp_path, delivered), tmp_path / "out")
    evidence = summary["verdict"]["evidence"]
    assert {e["code"] for e in evidence if e["code"].startswith("BP-U")} == codes
    assert summary["verdict"]["status"] == ("check" if codes else "pass")
    if delivered is averaged:
        what = next(e["what"] for e in evidence if e["code"] == "BP-U01")
        assert 35 <= int(re.search(r"at least (\d+)%", what)[1]) <= 55  # half of each is the one before


def test_a_picture_that_comes_again_is_none_of_the_target_at_its_instant(tmp_path):
    summary, rows = tracked(recorded(tmp_path, repeated), tmp_path / "out")
    assert sum(summary["counts"]["no_image_reasons"].values()) == len(AGAIN)
    assert (rows.status[list(AGAIN)] != "measured").all()
    measured = rows[rows.status == "measured"]
    away = measured[["u_px", "v_px"]].to_numpy() - [centre(k) for k in measured.frame]
    assert np.abs(away / measured[["sigma_u_px", "sigma_v_px"]].to_numpy()).max() < 6
