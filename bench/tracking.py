"""The accuracy table of single frames and of the `spots` tracker: `python -m bench.tracking` prints it.

bench/rigid.py prints that of the rigid tracker and the smoother, `make bench-tracking` both.

Every row is a Monte Carlo on simulated points (lab/simulate/points.py). No parameter was chosen with these seeds (but
with 100 to 103). bench/throughput has the rows for pictures.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from geometry import rotations
from geometry.arrays import Array
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.pose_prior import PosePrior
from geometry.pose_solver.gauss_newton import fit_pose
from lab.simulate.points import PointRun, simulate_points
from lab.simulate.scenarios import RIGS
from tracking.curve_switching.out_of_view import CoplanarViews, quadratic_positions
from tracking.curve_switching.spot_tracker import SpotTracker
from tracking.detections import Detections
from tracking.labelling.first_labels import NO_POINT, find_labels
from tracking.parameters import TrackerParameters
from tracking.rigid_body.rigid_tracker import RigidTracker
from tracking.statuses import PoseStatus, SpotStatus, TrackedFrame

FIRST_SEED = 9000
START_FRAMES = 2  # the rate is not yet known, so there is no prediction
TURN_FRAMES = 2  # the bend and the next frame, whose rate includes it


@dataclass(frozen=True, slots=True)
class Row:
    """One line of the table."""

    what: str
    measured: str
    goal: str


def track(run: PointRun, parameters: TrackerParameters) -> tuple[list[TrackedFrame], float]:
    """The tracker over one recording, and its process time per frame, ms."""
    p = run.prior
    centre = Pose.from_ypr(np.deg2rad(p.yaw_pitch_roll_deg), np.array(p.position_m))
    kind = RigidTracker if parameters.method == "rigid" else SpotTracker
    tracker = kind(run.rig, parameters, PosePrior(centre, p.within_m, float(np.deg2rad(p.within_deg))))
    start = time.process_time()
    out = [
        tracker.step(float(run.t_s[k] - run.t_s[k - 1]) if k else 0.0, found_in(run, k)) for k in range(len(run.frame))
    ]
    return out, (time.process_time() - start) / len(out) * 1e3


def found_in(run: PointRun, k: int) -> list[Detections | None]:
    """The detections of frame k by camera; None without a picture."""
    return [d if run.has_image[k, c] else None for c, d in enumerate(run.detections[k])]


@dataclass(frozen=True, slots=True)
class Tally:
    """Sums over one recording, to be pooled."""

    seen: int  # spot-frames with a visible spot in the picture
    right: int  # these with the correct detection
    wrong: int  # detections with a wrong label
    prediction2: Array  # (2,) sum of squared errors per axis
    predictions: int
    outside2: float
    outsides: int
    outside_max: float
    nees: float
    poses: int
    ms: float


def tally(run: PointRun, out: list[TrackedFrame], ms: float) -> Tally:
    """Identity by the origin of each detection, prediction and out-of-view errors against truth, NEES."""
    frames, views = run.in_view.shape
    point = np.array([o.point for o in out])
    origin = np.full((frames, views), NO_POINT)
    for k, v in zip(*np.nonzero(point >= 0), strict=True):
        origin[k, v] = run.origin[k][run.model.camera_of[v]][point[k, v]]
    taken = point >= 0
    right = taken & (origin == np.arange(views))
    shining = run.in_view == 1
    bend = np.zeros(frames, dtype=bool)
    for later in range(TURN_FRAMES):
        bend[later:] |= run.turned[: frames - later]
    error = np.array([o.predicted_px for o in out]) - run.uv_px
    use = shining & right & ~np.isnan(error[..., 0]) & ~bend[:, None]
    use[:START_FRAMES] = False
    outside = np.array([[s is SpotStatus.OUT_OF_VIEW for s in o.status] for o in out]) & (run.in_view == 0)
    gap = np.linalg.norm(np.array([o.uv_px for o in out]) - run.uv_px, axis=-1)[outside]
    nees, poses = 0.0, 0
    for k, o in enumerate(out):
        if o.pose_status is PoseStatus.MEASURED and o.pose is not None and o.pose_covariance is not None:
            d = run.poses[k].minus(o.pose)
            nees, poses = nees + float(d @ np.linalg.solve(o.pose_covariance, d)), poses + 1
    return Tally(
        int(shining.sum()),
        int((right & shining).sum()),
        int((taken & ~right).sum()),
        np.sum(error[use] ** 2, axis=0),
        int(use.sum()),
        float(np.sum(gap**2)),
        len(gap),
        float(gap.max(initial=0.0)),
        nees,
        poses,
        ms,
    )


def tracker_rows(seeds: int, frames: int) -> Iterator[Row]:
    """Identity and prediction of the `spots` tracker, with goals where there are any."""
    spots = TrackerParameters(method="spots")
    paper = TrackerParameters(method="spots", rigid_check=False, estimate="prediction", out_of_view="quadratic")
    cases: list[tuple[str, str, TrackerParameters, dict[str, float], str]] = [
        ("smooth, 20 % clutter", "smooth", spots, {}, "<= 0.30 px; >= 0.999"),
        ("sharp turns, 20 % clutter", "sharp-turns", spots, {}, "<= 0.40 px; >= 0.995"),
        ("sharp turns, 100 % clutter", "sharp-turns", spots, {"clutter": 1.0}, ""),
        ("smooth, 0.3 px noise", "smooth", spots, {"noise_px": 0.3}, ""),
        ("one spot occluded 10 frames in a turn", "hidden-in-turn", spots, {}, ""),
        ("all spots occluded 10 frames", "blackout", spots, {}, ""),
        ("four times as fast", "fast", spots, {}, ""),
        ("four skew beams", "four-skew-beams", spots, {}, ""),
        ("the method of the paper alone, smooth", "smooth", paper, {}, ""),
        ("the method of the paper alone, sharp turns", "sharp-turns", paper, {}, ""),
    ]
    for name, scenario, parameters, options, goal in cases:
        all_of = []
        for seed in range(FIRST_SEED, FIRST_SEED + seeds):
            run = simulate_points(scenario, seed, frames=frames, **options)  # type: ignore[arg-type]
            all_of.append(tally(run, *track(run, parameters)))
        yield Row(name, pooled(all_of), goal)


def pooled(all_of: list[Tally]) -> str:
    """One line of figures over several recordings."""
    predictions = sum(t.predictions for t in all_of)
    rms = np.sqrt(sum((t.prediction2 for t in all_of), np.zeros(2)) / max(predictions, 1))
    seen, right, wrong = (sum(getattr(t, n) for t in all_of) for n in ("seen", "right", "wrong"))
    nees = sum(t.nees for t in all_of) / max(sum(t.poses for t in all_of), 1)
    outside = np.sqrt(sum(t.outside2 for t in all_of) / max(sum(t.outsides for t in all_of), 1))
    return (
        f"prediction {rms[0]:.3f} / {rms[1]:.3f} px; identity {right / seen:.5f};"
        f" wrong {wrong / max(right + wrong, 1):.1e};"
        f" outside RMS {outside:.2f} max {max(t.outside_max for t in all_of):.2f} px; NEES {nees:.2f};"
        f" {np.median([t.ms for t in all_of]):.1f} ms/frame"
    )


def random_poses(rng: np.random.Generator, count: int, within_m: float, within_deg: float) -> Pose:
    """Poses uniform in the cube of positions and in the ball of rotation vectors."""
    axis = rng.normal(size=(count, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    angle = np.deg2rad(within_deg) * rng.random((count, 1)) ** (1 / 3)
    return Pose(rotations.exp(axis * angle), rng.uniform(-within_m, within_m, (count, 3)))


def out_of_view_rows(poses: int) -> Iterator[Row]:
    """The quadratic equation of the paper and the rigid solution for an invisible spot, from four others."""
    rig = RIGS["fan"]()
    model = SpotModel.of(rig)
    rows = np.array([0, 1, 3, 4])
    recipes = CoplanarViews.of(model)
    for noise in (0.0, 0.1):
        rng = np.random.default_rng(FIRST_SEED)
        quadratic, rigid, between = [], [], []
        for pose in (random_poses(rng, poses, 1.0, 30.0)[i] for i in range(poses)):
            true = model.project(pose)[0]
            if np.isnan(true).any():
                continue
            seen = np.full_like(true, np.nan)
            seen[rows] = true[rows] + noise * rng.standard_normal((4, 2))
            solved = quadratic_positions(rig, model, recipes, seen)
            fit = fit_pose(model, rows, seen[rows], np.tile(np.eye(2) * 0.01, (4, 1, 1)), pose)
            if fit is None or np.isnan(solved[[2, 5]]).any():
                continue
            there = model.project(fit.world_from_body)[0]
            quadratic.append(np.linalg.norm(solved[[2, 5]] - true[[2, 5]], axis=1))
            rigid.append(np.linalg.norm(there[[2, 5]] - true[[2, 5]], axis=1))
            between.append(np.abs(solved[[2, 5]] - there[[2, 5]]).max())
        q, r = np.array(quadratic), np.array(rigid)
        if noise == 0.0:
            text = f"max {q.max():.1e} (quadratic), {r.max():.1e} (rigid), between them {max(between):.1e} px"
            yield Row("out of view, noise-free", text, "<= 1e-6 px")
        else:
            text = f"RMS {np.sqrt(np.mean(q**2)):.2f} (quadratic), {np.sqrt(np.mean(r**2)):.2f} px (rigid)"
            yield Row("out of view, 0.1 px, four other spots", text, "")


def single_frame_row(poses: int) -> Row:
    """The pose of one frame compared with the Cramer-Rao bound, six spots with 0.1 px."""
    model = SpotModel.of(RIGS["fan"]())
    rng = np.random.default_rng(FIRST_SEED + 1)
    rows, covariances = np.arange(6), np.tile(np.eye(2) * 0.01, (6, 1, 1))
    ratio2, nees = [], []
    many = random_poses(rng, poses, 1.0, 30.0)
    for i in range(poses):
        true, J = model.project(many[i])
        if np.isnan(true).any():
            continue
        A = J.reshape(-1, 6) / 0.1
        bound = np.linalg.inv(A.T @ A)
        start = many[i].plus(np.concatenate([rng.normal(0, 0.05, 3), rng.normal(0, 0.05, 3)]))
        fit = fit_pose(model, rows, true + 0.1 * rng.standard_normal(true.shape), covariances, start)
        if fit is None:
            continue
        d = many[i].minus(fit.world_from_body)
        nees.append(d @ np.linalg.solve(fit.covariance, d))
        ratio2.append(d**2 / np.diagonal(bound))
    worst = np.sqrt(np.mean(ratio2, axis=0)).max()
    text = f"RMS {worst:.3f} x bound (worst of six); mean NEES {np.mean(nees):.2f}; {len(nees)} poses"
    return Row("pose of a single frame", text, "<= 1.05; 5.5 to 6.5")


def label_row(poses: int) -> Row:
    """First labels from a prior of +-1 m and 30 deg, 20 % clutter, 5 false points per picture, 2 % misses."""
    rig = RIGS["fan"]()
    model = SpotModel.of(rig)
    rng = np.random.default_rng(FIRST_SEED + 2)
    prior = PosePrior(Pose.identity(), 1.0, float(np.deg2rad(30.0)))
    right = wrong = nothing = done = 0
    spent = []
    while done < poses:
        pose = random_poses(rng, 1, 1.0, 30.0)[0]
        uv = model.project(pose)[0]
        visible = model.in_picture(uv)
        if visible.sum() < 4:
            continue
        done += 1
        found, origin = {}, {}
        for c, name in enumerate(model.camera_names):
            points, of = one_picture(rng, uv, visible & (model.camera_of == c), model.image_size_px[0])
            found[name] = Detections.at(points, np.tile(np.eye(2) * 0.01, (len(points), 1, 1)))
            origin[c] = of
        start = time.process_time()
        result = find_labels(rig, model, found, prior)
        spent.append(time.process_time() - start)
        if result.chosen is None:
            nothing += 1
            continue
        labels = result.chosen.point_of
        used = np.flatnonzero(labels != NO_POINT)
        good = all(origin[int(model.camera_of[v])][labels[v]] == v for v in used)
        right, wrong = right + good, wrong + (not good)
    text = (
        f"right {right / done:.3f}, wrong {wrong / done:.3f}, none or tie {nothing / done:.3f} of {done};"
        f" median {np.median(spent) * 1e3:.0f} ms"
    )
    return Row("first labels, prior +-1 m 30 deg, clutter", text, ">= 0.97; <= 0.01")


def one_picture(
    rng: np.random.Generator,
    uv: Array,
    visible: Array,
    size: Array,
    noise_px: float = 0.1,
    false_points: int = 5,
    clutter: float = 0.2,
) -> tuple[Array, Array]:
    """Noisy points of one picture in random order, and the view of each (NO_POINT: none)."""
    points, of = [], []
    for v in np.flatnonzero(visible):
        if rng.random() < 0.98:
            points.append(uv[v] + rng.normal(0, noise_px, 2))
            of.append(v)
        if rng.random() < clutter:
            turn = rng.uniform(0, 2 * np.pi)
            points.append(uv[v] + 15 * np.sqrt(rng.random()) * np.array([np.cos(turn), np.sin(turn)]))
            of.append(NO_POINT)
    for _ in range(false_points):
        points.append(rng.uniform([0, 0], size - 1))
        of.append(NO_POINT)
    order = rng.permutation(len(points))
    return np.array(points).reshape(-1, 2)[order], np.array(of, dtype=np.int64)[order]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=8)
    parser.add_argument("--frames", type=int, default=600)
    parser.add_argument("--poses", type=int, default=1000)
    a = parser.parse_args()
    parts: list[Callable[[], Iterator[Row]]] = [
        lambda: out_of_view_rows(2 * a.poses),
        lambda: iter([single_frame_row(a.poses)]),
        lambda: iter([label_row(a.poses)]),
        lambda: tracker_rows(a.seeds, a.frames),
    ]
    print("| what | measured | goal |\n| --- | --- | --- |")
    for part in parts:
        for row in part():
            print(f"| {row.what} | {row.measured} | {row.goal} |", flush=True)


if __name__ == "__main__":
    main()
