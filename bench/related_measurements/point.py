"""The tracker of one target on simulated scenes, a real flight and a real video with a published track.

    python -m bench.related_measurements.point --seeds 5000:5040
    python -m bench.related_measurements.point --flight UAV_Rot.csv
    python -m bench.related_measurements.point --video spider_video.mp4 --published spider_video_tracked.csv

--flight: longitude and latitude of a flight at 1 Hz, as east and north in metres, with added noise and hidden
intervals; the recorded positions are the reference. --video: two black targets, A and B, each tracked on its own from
its first published position; the table shows the differences to the published positions (those of another program).
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
import pandas as pd

from lab.targets.point import PointOptions, PointTarget
from lab.targets.track import track_target
from studies.duan2020 import FILTERS, QUANTITIES, figures_of, simulate, track

EARTH_RADIUS_M = 6_371_000.0
FLIGHT_NOISE_M = 3.0
HIDDEN_S, EVERY_S = 10, 60  # hidden for 10 s in each minute


def scenes(seeds: range) -> None:
    """Median and worst figures of each filter."""
    for clutter in (False, True):
        for name in FILTERS:
            of = np.array([figures_of(s, track(s, name)) for s in (simulate(seed, 0, clutter) for seed in seeds)])
            shown = ", ".join(
                f"{q} {np.nanmedian(v):.3g} (worst {np.nanmax(np.abs(v)):.3g}) {unit}"
                for (q, unit, _), v in zip(QUANTITIES, of.T, strict=True)
                if np.isfinite(v).any()
            )
            print(f"{'clutter' if clutter else 'clean':8s}{name:12s}{shown}")


def flight(path: Path, seed: int) -> None:
    """A recorded flight as the positions of a target."""
    table = pd.read_csv(path)
    north = np.deg2rad(table["latitude"].to_numpy() - table["latitude"].iloc[0]) * EARTH_RADIUS_M
    east = np.deg2rad(table["longitude"].to_numpy() - table["longitude"].iloc[0]) * EARTH_RADIUS_M
    east = east * np.cos(np.deg2rad(table["latitude"].iloc[0]))
    truth = np.stack([east, -north], axis=1)
    t = table["timestamp"].to_numpy() - table["timestamp"].iloc[0]
    frame = np.round(t).astype(int)
    rng = np.random.default_rng(seed)
    seen = frame % EVERY_S >= HIDDEN_S
    seen[:20] = True
    noisy = truth + FLIGHT_NOISE_M * rng.standard_normal(truth.shape)
    points = pd.DataFrame({"frame": frame, "u_px": noisy[:, 0], "v_px": noisy[:, 1]})
    points["sigma_u_px"] = points["sigma_v_px"] = FLIGHT_NOISE_M
    with tempfile.TemporaryDirectory() as folder:
        points[seen].to_csv(Path(folder) / "points.csv", index=False)
        outcome = track_target(
            PointTarget(
                PointOptions(rate_hz=1.0, overrides={"track.max_speed_px": 100.0, "track.lost_sigma_px": 300.0})
            ),
            Path(folder) / "points.csv",
            Path(folder) / "track",
        )
    at = frame - int(outcome.result.recording.numbers[0])
    inside = (at >= 0) & (at < len(outcome.result.frames))
    frames = [outcome.result.frames[k] for k in at[inside]]
    e = np.array([np.linalg.norm(f.place[:2] - true) for f, true in zip(frames, truth[inside], strict=True)])
    words = np.array([f.status.value for f in frames])
    speed = np.linalg.norm(np.diff(truth, axis=0), axis=1)
    print(outcome.line().partition(" ->")[0])
    print(f"flight: {len(frame)} s, median speed {np.median(speed):.1f} m/s, {FLIGHT_NOISE_M:g} m noise per coordinate")
    for word in ("measured", "predicted", "lost"):
        some = e[(words == word) & np.isfinite(e)]
        if len(some):
            rms, worst = np.sqrt(np.mean(some**2) / 2), some.max()
            print(f"  {word}: {np.sum(words == word)} s, RMS {rms:.2f} m per coordinate, largest {worst:.1f} m")
        else:
            print(f"  {word}: {np.sum(words == word)} s")


def video(path: Path, published: Path, limit: int | None) -> None:
    """The two targets of a video against their published positions."""
    table = pd.read_csv(published)
    for name, positions in table.groupby("id"):
        first = positions.iloc[0]
        options = PointOptions(
            detector="darker",
            near_px=(float(first.pos_x), float(first.pos_y)),
            limit=limit,
            overrides={"track.sigma_model_px": 1.0},
        )
        with tempfile.TemporaryDirectory() as folder:
            outcome = track_target(PointTarget(options), path, Path(folder) / "track")
        positions = positions[positions.frame <= len(outcome.result.frames)]
        # The published table counts frames from 1.
        estimates = [outcome.result.frames[int(k) - 1] for k in positions.frame]
        difference = np.array([e.place[:2] for e in estimates]) - positions[["pos_x", "pos_y"]].to_numpy()
        known = np.isfinite(difference[:, 0])
        named = f"  target {name}: {known.sum()} of {len(positions)} published frames have a position"
        distance = np.linalg.norm(difference[known], axis=1)
        about = np.linalg.norm(difference[known] - np.median(difference[known], axis=0), axis=1)
        print(outcome.line().partition(" ->")[0])
        print(
            f"{named}; difference median {np.median(distance):.2f} px, 95 % {np.percentile(distance, 95):.2f} px,"
            f" largest {distance.max():.1f} px; about its median {np.median(about):.2f} px,"
            f" 95 % {np.percentile(about, 95):.2f} px"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", help="FIRST:LAST of simulated scenes")
    parser.add_argument("--flight", type=Path)
    parser.add_argument("--video", type=Path)
    parser.add_argument("--published", type=Path)
    parser.add_argument("--limit", type=int, help="pictures of the video")
    a = parser.parse_args()
    if a.seeds:
        scenes(range(*map(int, a.seeds.split(":"))))
    if a.flight:
        flight(a.flight, seed=1)
    if a.video and a.published:
        video(a.video, a.published, a.limit)


if __name__ == "__main__":
    main()
