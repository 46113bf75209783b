"""`python -m bench.clocks --seeds 1:201`: attitude errors with clocks of the cameras' own over those with one clock.

With --estimate: errors with clocks that are estimated over those with the same clocks known.

Each row: kind of clocks; ratio of the RMS attitude errors, also away from corners of the motion; ratio of their stated
sigmas; with --control the ratio of two recordings with one clock that differ in their noise alone; NEES/6, wrong labels
and found spots of both recordings.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from bench.clocks.recording import KINDS, Recording, Truth, random_recording, write_recording
from bench.random_scenes.scene import view_indices
from geometry.arrays import Array
from lab.files.run.results import SpotGrid, read_poses, read_spots
from lab.runs.process import process_run
from tracking.smoothing.motion.clocks import DETERMINED
from tracking.statuses import PoseStatus

SAME_SPOT_PX, SAME_SPOT_SIGMAS = 3.0, 5.0
SAME_POINT_PX, NEAR_PICTURES = 1e-3, 7  # of the tables; where a point's picture is: offsets of up to three frames
WRONG_POSE = 100.0  # NEES
CORNER = 3  # frames about a corner of the motion that "away from corners" leaves out
OTHER_NOISE = 1_000_000  # added to the seed
EDGE = 3  # frames at both ends that are not compared: not all cameras have pictures there


@dataclass(frozen=True, slots=True)
class Figures:
    """Of one run."""

    attitude_deg: Array  # (T,) error of the measured poses; nan elsewhere
    stated_deg: Array  # (T,) its sigma as stated
    nees: Array  # (T,) / 6, of all poses
    wrong: int  # labels
    found: float  # share of the visible spots that have their label
    wrong_poses: int
    status: str
    # By number of a clock that was estimated: error and sigma, s, and the sigma of its prior.
    clocks: tuple[tuple[float, float, float], ...] = ()


def figures(r: Recording, folder: Path, estimate: bool = False) -> Figures:
    """Write, process and compare one recording. estimate: its clocks are not given."""
    truth = write_recording(r, folder / "run", estimate)
    outcome = process_run(folder / "run", folder / "out")
    poses, spots = read_poses(folder / "out"), read_spots(folder / "out")
    true = r.pose_at(r.rows_s)[poses.frames]
    known = ~poses.has(PoseStatus.LOST)
    delta = true.minus(poses.world_from_body)
    attitude, stated, nees = (np.full(len(r.hidden), np.nan) for _ in range(3))
    measured = poses.has(PoseStatus.MEASURED)
    attitude[poses.frames[measured]] = np.rad2deg(np.linalg.norm(delta[measured, 3:], axis=1))
    turns = np.trace(poses.covariance[measured][:, 3:, 3:], axis1=1, axis2=2)
    stated[poses.frames[measured]] = np.rad2deg(np.sqrt(turns))
    whole = np.linalg.solve(poses.covariance[known], delta[known][..., None])[..., 0]
    nees[poses.frames[known]] = np.sum(delta[known] * whole, axis=1) / 6
    wrong, right, visible = _labels(r, truth, spots)
    return Figures(
        attitude, stated, nees, wrong, right / max(visible, 1), int(np.sum(nees > WRONG_POSE / 6)),
        outcome.verdict.status, _estimated(r, folder / "out"),
    )  # fmt: skip


def _estimated(r: Recording, out: Path) -> tuple[tuple[float, float, float], ...]:
    """Errors, sigmas and priors' sigmas of the clocks that a run has estimated."""
    stated = json.loads((out / "summary.json").read_text())["parameters"].get("clocks", {})
    found = []
    for name, clock in zip(r.rig.cameras, r.clocks, strict=True):
        for key, true in (("time_offset", clock.late_s), ("row_time", clock.row_time_s)):
            one = stated.get(name, {})
            if f"{key}_sigma_s" in one:
                sigma, prior = one[f"{key}_sigma_s"], one[f"{key}_prior_sigma_s"]
                found.append((one[f"{key}_s"] - true, sigma, prior))
    return tuple(found)


def _labels(r: Recording, truth: Truth, spots: SpotGrid) -> tuple[int, int, int]:
    """Wrong labels, correct labels and visible spots; these in the pictures that the rows are about.

    A run that does not know its clocks takes the picture beside: a label is compared with the picture of its point.
    """
    camera_of, _ = view_indices(r.rig)
    views = r.rig.views()
    wrong = right = visible = 0
    place = {view: list(spots.views).index(view) for view in views if view in spots.views}
    for i, frame in enumerate(spots.frames.tolist()):
        for v, view in enumerate(views):
            clock = r.clocks[camera_of[v]]
            away = np.abs(clock.instants_s - frame / r.rate_hz) if clock.own else np.abs(clock.numbers - frame)
            near = [(camera_of[v], int(clock.numbers[n])) for n in np.argsort(away)[:NEAR_PICTURES]]
            if view not in place or away.min() > (0.5 / r.rate_hz if clock.own else 0):
                continue
            visible += int(truth[near[0]][1][v])
            if not spots.measured[i, place[view]]:
                continue
            uv = spots.uv_px[i, place[view]]
            own = next((key for key in near if (np.abs(truth[key][2] - uv) < SAME_POINT_PX).all(axis=1).any()), near[0])
            at, shining, _ = truth[own]
            limit = max(SAME_SPOT_PX, SAME_SPOT_SIGMAS * r.sigma_px[v])
            good = shining[v] and np.linalg.norm(uv - at[v]) <= limit
            right, wrong = right + int(good), wrong + int(not good)
    return wrong, right, visible


def main() -> None:
    """Run the seeds and print the table."""
    parser = argparse.ArgumentParser(prog="bench.clocks", description=__doc__)
    parser.add_argument("--seeds", default="1:201", metavar="A:B")
    parser.add_argument("--frames", type=int, default=200)
    parser.add_argument("--estimate", action="store_true", help="clocks to be estimated, against the known ones")
    parser.add_argument("--control", action="store_true", help="one clock with other noise, over one clock")
    a = parser.parse_args()
    first, _, last = a.seeds.partition(":")
    seeds = range(int(first), int(last) if last else int(first) + 1)
    table: dict[str, list[tuple[float, ...]]] = {}
    clocks: list[tuple[float, float, float]] = []
    for seed in seeds:
        r = random_recording(seed, a.frames)
        with tempfile.TemporaryDirectory() as name:
            with_clocks = figures(r, Path(name) / "clocks", a.estimate)
            one = figures(r if a.estimate else r.with_one_clock(), Path(name) / "one")
            other = replace(r.with_one_clock(), seed=r.seed + OTHER_NOISE)
            again = figures(other, Path(name) / "again") if a.control else None
        clocks += with_clocks.clocks
        both = np.isfinite(with_clocks.attitude_deg) & np.isfinite(one.attitude_deg)
        both[:EDGE] = both[-EDGE:] = False
        smooth = both & (np.abs(np.arange(len(both))[:, None] - r.corners).min(axis=1, initial=np.inf) > CORNER)
        rms, away = ([_rms(f.attitude_deg[rows]) for f in (with_clocks, one)] for rows in (both, smooth))
        nees = [float(np.nanmean(f.nees)) if np.isfinite(f.nees).any() else np.nan for f in (with_clocks, one)]
        sigmas = [_rms(f.stated_deg[both]) for f in (with_clocks, one)]
        chance = _rms(again.attitude_deg[both]) / rms[1] if again is not None else np.nan
        ratio, off_corners, stated = (float(pair[0] / max(pair[1], 1e-12)) for pair in (rms, away, sigmas))
        row = (ratio, off_corners, stated, chance, nees[0], nees[1])
        table.setdefault(KINDS[seed % len(KINDS)], []).append(row)
        print(
            f"{seed}: ratio {ratio:.3f}, away from corners {off_corners:.3f}, stated {stated:.3f}, by chance"
            f" {chance:.3f} ({rms[0]:.3g} / {rms[1]:.3g} deg,"
            f" {both.sum()} of {np.isfinite(one.attitude_deg).sum()}), NEES/6 {nees[0]:.2f} ({nees[1]:.2f}), wrong"
            f" {with_clocks.wrong} ({one.wrong}), found {with_clocks.found:.4f} ({one.found:.4f}), wrong poses"
            f" {with_clocks.wrong_poses} ({one.wrong_poses}), {with_clocks.status} ({one.status})"
            f"{_in_words(with_clocks)}: {r.text}",
            flush=True,
        )
    for kind, rows in [*table.items(), ("all", [row for of_kind in table.values() for row in of_kind])]:
        ratio, off_corners, stated_ratio, chances, nees, nees_one = np.array(rows).T
        print(
            f"{kind}: {len(rows)} recordings, ratio median {np.nanmedian(ratio):.3f},"
            f" 95 % {np.nanquantile(ratio, 0.95):.3f}; away from corners {np.nanmedian(off_corners):.3f},"
            f" {np.nanquantile(off_corners, 0.95):.3f}; stated {np.nanmedian(stated_ratio):.3f},"
            f" {np.nanquantile(stated_ratio, 0.95):.3f}; by chance {np.nanmedian(chances):.3f},"
            f" {np.nanquantile(chances, 0.95):.3f}; NEES/6 mean {np.nanmean(nees):.2f}, median"
            f" {np.nanmedian(nees):.2f} (compared {np.nanmean(nees_one):.2f}, {np.nanmedian(nees_one):.2f})"
        )
    if clocks:
        error, sigma, prior = np.array(clocks).T
        away, known = np.abs(error / sigma), sigma < DETERMINED * prior
        print(
            f"clocks: {len(clocks)} numbers, {known.sum()} determined; error over sigma of these within 1:"
            f" {100 * np.mean(away[known] < 1):.0f} %, beyond 3: {100 * np.mean(away[known] > 3):.1f} %, of all:"
            f" {100 * np.mean(away < 1):.0f} %, {100 * np.mean(away > 3):.1f} %"
        )


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else float("nan")


def _in_words(f: Figures) -> str:
    """The errors of estimated clocks over their sigmas, and these as shares of the priors'."""
    return "".join(f", {e / s:+.2f} ({s / p:.2g} of prior)" for e, s, p in f.clocks)


if __name__ == "__main__":
    main()
