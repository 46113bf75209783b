"""Input and output of the two linkers, trackpy and laptrack: a table of points, and linked tracks."""

from __future__ import annotations

import numpy as np
import pandas as pd

from bench.peers.scenes import Scene

SHORTEST = 3  # frames: shorter tracks count as clutter


def points_table(scene: Scene, camera: int) -> pd.DataFrame:
    """One camera's points: columns frame, x, y (px)."""
    points = [found[camera] for found in scene.detections]
    frame = np.repeat(np.arange(len(points)), [len(p) for p in points])
    xy = np.concatenate(points)
    return pd.DataFrame({"frame": frame, "x": xy[:, 0], "y": xy[:, 1]})


def named_rows(linked: pd.DataFrame, camera: int) -> list[tuple[int, int, int, float, float]]:
    """Rows of the tracks that are long enough, from columns frame, piece, x, y."""
    long_enough = linked.groupby("piece")["piece"].transform("size") >= SHORTEST
    kept = linked[long_enough]
    columns = (kept[name].tolist() for name in ("frame", "piece", "x", "y"))
    return [(int(k), camera, int(piece), x, y) for k, piece, x, y in zip(*columns, strict=True)]
