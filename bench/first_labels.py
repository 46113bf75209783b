"""First labels of single frames, with and without a prior: `python -m bench.first_labels` prints the table.

Monte Carlo on simulated points. A frame has at least four spots in the pictures; 2 % of them are missed, 20 % have a
false point within 15 px, and further false points are anywhere. The last rows use frames whose pose is determined by
four spots (sigmas below 0.2 m and 4 deg).
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from bench.tracking import FIRST_SEED, Row, one_picture, random_poses
from geometry import rotations
from geometry.arrays import Array
from geometry.camera import Camera
from geometry.forward_model import SpotModel
from geometry.pose import Pose, look_at
from geometry.pose_prior import PosePrior
from geometry.rig import Beam, Rig, Screen, Spot
from lab.simulate.scenarios import DISTORTION, RIGS
from tracking.detections import Detections
from tracking.labelling.first_labels import NO_POINT, FirstLabels, find_labels

PRIOR = PosePrior(Pose.identity(), 1.0, float(np.deg2rad(30.0)))
GOAL = ">= 0.97; <= 0.01; <= 3 s"


@dataclass(slots=True)
class Count:
    """Counts of the results over the frames."""

    right: int = 0
    wrong: int = 0
    tie: int = 0
    none: int = 0
    tie_with_truth: int = 0
    spent: list[float] | None = None

    def take(self, result: FirstLabels, model: SpotModel, origin: dict[str, Array], seconds: float) -> None:
        """Add a frame; origin: by camera, the view of each point."""
        self.spent = [*(self.spent or []), seconds]
        if result.chosen is not None:
            good = _right(result.chosen.point_of, model, origin)
            self.right, self.wrong = self.right + good, self.wrong + (not good)
        elif result.tie:
            self.tie += 1
            self.tie_with_truth += any(_right(c.point_of, model, origin) for c in result.candidates)
        else:
            self.none += 1

    def __str__(self) -> str:
        n = self.right + self.wrong + self.tie + self.none
        ms = 1e3 * np.array(self.spent or [np.nan])
        return (
            f"right {self.right / n:.3f}, wrong {self.wrong / n:.3f}, tie {self.tie / n:.3f} (the truth among them in"
            f" {self.tie_with_truth} of {self.tie}), none {self.none / n:.3f} of {n}; median {np.median(ms):.0f},"
            f" largest {ms.max():.0f} ms"
        )


def _right(point_of: Array, model: SpotModel, origin: dict[str, Array]) -> bool:
    return all(origin[model.views[v][0]][point_of[v]] == v for v in np.flatnonzero(point_of != NO_POINT))


def labelled(
    rig: Rig,
    poses: Callable[[np.random.Generator], Pose],
    prior: Callable[[Pose], PosePrior | None],
    count: int,
    seed: int,
    false_points: int = 5,
    noise_px: float = 0.1,
) -> Count:
    """The results for a number of frames of a rig."""
    model, rng, out = SpotModel.of(rig), np.random.default_rng(seed), Count()
    done = 0
    while done < count:
        pose = poses(rng)
        uv, J = model.project(pose)
        visible = model.in_picture(uv)
        if len({int(s) for s in model.spot_of[visible]}) < 4:
            continue
        if not _determined(J[visible], noise_px):
            continue
        done += 1
        found, origin = {}, {}
        for c, name in enumerate(model.camera_names):
            mine = visible & (model.camera_of == c)
            size = model.image_size_px[model.camera_of == c][0]
            points, of = one_picture(rng, uv, mine, size, noise_px, false_points, 0.2 if false_points else 0.0)
            found[name] = Detections.at(points, np.tile(np.eye(2) * noise_px**2, (len(points), 1, 1)))
            origin[name] = of
        before = time.process_time()
        result = find_labels(rig, model, found, prior(pose))
        out.take(result, model, origin, time.process_time() - before)
    return out


def _determined(J: Array, noise_px: float) -> bool:
    A = J.reshape(-1, 6) / noise_px
    H = A.T @ A
    if np.linalg.cond(H) > 1e14:
        return False
    sigma = np.sqrt(np.diagonal(np.linalg.inv(H)))
    return bool(sigma[:3].max() < 0.2 and np.rad2deg(sigma[3:].max()) < 4.0)


def figures(poses: int) -> Iterator[Row]:
    """The rows with goals, and the time with a narrow prior."""
    for name in ("unequal-fan", "four-skew-beams"):
        rig = RIGS[name]()
        count = labelled(rig, lambda rng: random_poses(rng, 1, 1.0, 30.0)[0], lambda _: None, poses, FIRST_SEED + 10)
        yield Row(f"{name}, no prior", str(count), GOAL)
    for name in ("fan", "unequal-fan", "four-skew-beams"):
        rig = RIGS[name]()
        count = labelled(rig, lambda rng: random_poses(rng, 1, 1.0, 30.0)[0], lambda _: PRIOR, poses, FIRST_SEED + 11)
        yield Row(f"{name}, prior 1 m, 30 deg", str(count), ">= 0.97; <= 0.01")
    for name in ("unequal-fan", "four-skew-beams", "two-cameras-per-screen"):
        rig = RIGS[name]()
        count = labelled(
            rig,
            lambda rng: random_poses(rng, 1, 0.3, 15.0)[0],
            lambda pose: PosePrior(pose.plus(np.full(6, 0.03)), 0.1, 0.1),
            poses // 4,
            FIRST_SEED + 12,
            false_points=1,
        )
        yield Row(f"{name}, prior 0.1 m, 6 deg, one false point", str(count), "")


def false_points_only(frames: int) -> Iterator[Row]:
    """Frames in which all points are false."""
    rig = RIGS["unequal-fan"]()
    model = SpotModel.of(rig)
    for false_points in (5, 8):
        for what, prior in (("no prior", None), ("prior 1 m, 30 deg", PRIOR)):
            rng = np.random.default_rng(FIRST_SEED + 13)
            poses = 0
            for _ in range(frames):
                found = {
                    name: Detections.at(
                        rng.uniform([0, 0], model.image_size_px[0] - 1, (false_points, 2)),
                        np.tile(np.eye(2) * 0.01, (false_points, 1, 1)),
                    )
                    for name in model.camera_names
                }
                poses += find_labels(rig, model, found, prior).chosen is not None
            yield Row(f"no vehicle, {false_points} false points per picture, {what}", f"{poses} poses of {frames}", "")


def any_rig(kind: str, f_px: float, rng: np.random.Generator) -> tuple[Rig, float]:
    """A rig with beams that fill the pictures of two oblique cameras of this focal length; its widest angle, deg."""
    screens = {
        name: Screen(name, Pose.from_quaternion(np.full(4, 0.5), np.array([x, 0.0, 0.0])))
        for name, x in (("left", -2.5), ("right", 2.5))
    }
    size = (1280, 1024) if f_px >= 800 else (640, 480)
    matrix = np.array([[f_px, 0, (size[0] - 1) / 2], [0, f_px, (size[1] - 1) / 2], [0, 0, 1]])
    seats = {"left": (1.6, 0.6, 1.5), "right": (-1.6, -0.6, 1.5)}
    if kind == "two cameras per screen":
        seats |= {"left-b": (1.2, -1.5, 1.3), "right-b": (-1.2, 1.5, 1.3)}
    cameras = {}
    for name, seat in seats.items():
        screen = name.removesuffix("-b")
        there = screens[screen].world_from_screen.translation
        cameras[name] = Camera(name, screen, size, matrix, DISTORTION, look_at(np.array(seat), there))
    widest = float(0.6 * np.rad2deg(np.arctan(0.5 * min(size) / f_px * 4.4 / 2.5)))
    slope = np.tan(np.deg2rad(widest))
    across = {
        "two beams": [(-0.5, 0.0), (0.5, 0.0)],
        "two cameras per screen": [(-0.8, 0.0), (0.0, 0.0), (1.0, 0.0)],
        "skew beams": [(-0.9, 0.1), (0.1, 0.6), (0.8, -0.1), (-0.3, -0.8)],
        "one end each": [(-0.8, 0.1), (0.2, 0.5), (0.7, -0.5), (-0.7, 0.3), (0.1, -0.7), (0.9, 0.2)],
    }[kind]
    meet = kind in ("two beams", "two cameras per screen")
    beams, spots = {}, {}
    for i, (y, z) in enumerate(across):
        name = "ABCDEF"[i]
        side = -1.0 if kind == "one end each" and i < 3 else 1.0
        point = np.zeros(3) if meet else rng.normal(0, 0.06, 3)
        beams[name] = Beam(name, np.array([side, slope * y, slope * z]), point)
        if kind == "one end each":
            spots[name] = Spot(name, name, 1, "left" if side < 0 else "right")
        else:
            spots[f"{name}-"] = Spot(f"{name}-", name, -1, "left")
            spots[f"{name}+"] = Spot(f"{name}+", name, 1, "right")
    return Rig(screens, cameras, beams, spots), widest


def variety(frames: int) -> Iterator[Row]:
    """Rigs, lenses and noise of all kinds, five false points per picture. Two beams are a tie without a prior."""
    for kind in ("two beams", "skew beams", "one end each", "two cameras per screen"):
        for f_px, noise_px in ((300.0, 0.1), (1180.0, 0.005), (2500.0, 0.3), (6000.0, 0.005), (6000.0, 0.3)):
            rig, widest = any_rig(kind, f_px, np.random.default_rng(FIRST_SEED))
            reach = min(1.0, 2.5 * np.tan(np.deg2rad(widest)))

            def near(rng: np.random.Generator, widest: float = widest, reach: float = reach) -> Pose:
                turn = rng.normal(0, np.deg2rad(min(12.0, 0.5 * widest)), 3)
                return Pose(rotations.exp(turn), 0.3 * reach * rng.uniform(-1, 1, 3))

            def prior(pose: Pose, alone: bool = kind == "two beams") -> PosePrior | None:
                return PosePrior(pose.plus(np.full(6, 0.05)), 0.3, float(np.deg2rad(30.0))) if alone else None

            count = labelled(rig, near, prior, frames, FIRST_SEED + 14, noise_px=noise_px)
            what = "prior 0.3 m, 30 deg" if kind == "two beams" else "no prior"
            yield Row(f"{kind}, f {f_px:.0f} px, {noise_px} px, {what}", str(count), "")


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--poses", type=int, default=1000)
    a = parser.parse_args()
    print("| what | measured | goal |\n| --- | --- | --- |")
    for part in (figures(a.poses), false_points_only(a.poses), variety(max(1, a.poses // 10))):
        for row in part:
            print(f"| {row.what} | {row.measured} | {row.goal} |", flush=True)


if __name__ == "__main__":
    main()
