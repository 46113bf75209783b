"""What `beampose view` shows: a rig, and the poses of a run's truth or of results."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.pose import Pose
from geometry.rig import Rig
from lab.errors import InputError
from lab.files.rig.rig_file import load_rig
from lab.files.run.results import PoseTrack, read_poses, read_summary
from lab.files.run.run_file import load_run
from lab.files.run.truth import load_run_truth
from tracking.statuses import PoseStatus


@dataclass(frozen=True, slots=True)
class Content:
    """A rig and F poses of the vehicle; F is 0 for a rig alone."""

    name: str
    poses_from: str  # what the poses are, in words; empty without poses
    rig: Rig
    frames: Ints  # (F,), rising
    t_s: Array  # (F,), or frame numbers where times are missing
    world_from_body: Pose  # (F,); nan translation where unknown
    position_covariance: Array  # (F, 3, 3), m^2, in world; nan where unknown
    measured: Bools  # (F,)

    @property
    def known(self) -> Bools:
        """(F,): whether there is a pose."""
        return np.all(np.isfinite(self.world_from_body.translation), axis=-1)

    def at_frame(self, frame: int | None) -> int | None:
        """Index of a frame; None: the middle one of the known poses, or None without any.

        Raises:
            InputError: there is no such frame, or it has no pose.
        """
        known = np.flatnonzero(self.known)
        if frame is None:
            return int(known[len(known) // 2]) if len(known) else None
        if not len(known):
            raise InputError(f"--frame {frame}: {self.name} has no poses; leave --frame out")
        numbers = self.frames[known]
        if frame not in numbers:
            raise InputError(f"--frame {frame}: expected a frame with a pose, {numbers[0]} to {numbers[-1]}")
        return int(known[np.flatnonzero(numbers == frame)[0]])


def read_content(path: Path, rig_path: Path | None) -> Content:
    """A rig.yaml, a run folder (with the poses of its truth) or a results folder.

    rig_path: a rig.yaml in place of the one that the run names.

    Raises:
        InputError: the path is none of these, or a file is not as it should be.
    """
    path = Path(path)
    if not path.exists():
        raise InputError(f"{path}: expected a rig.yaml, a run folder or a folder of results, found nothing")
    if path.is_dir() and (path / "attitude.csv").is_file():
        return _of_results(path, rig_path)
    if path.is_dir() or path.name == "run.yaml":
        return _of_run(path, rig_path)
    rig = load_rig(path)
    if rig_path is not None:
        raise InputError(f"--rig: expected a run or results to combine it with, got the rig {path}; leave --rig out")
    return _without_poses(path.name, rig)


def _of_results(results: Path, rig_path: Path | None) -> Content:
    summary = read_summary(results)
    rig = load_rig(rig_path) if rig_path is not None else _rig_of_results(results, str(summary.get("run_folder") or ""))
    track = read_poses(results)
    return content_of_poses(str(summary.get("name") or results.resolve().name), rig, track)


def content_of_poses(name: str, rig: Rig, track: PoseTrack) -> Content:
    """The poses of attitude.csv with the covariances of their positions."""
    covariance = track.covariance[:, :3, :3].copy()
    without = ~np.isfinite(covariance).all(axis=(1, 2))
    covariance[without] = track.sigma_position_m[without][:, :, None] ** 2 * np.eye(3)
    measured = track.has(PoseStatus.MEASURED)
    t_s = _times(track.frames, track.t_s)
    return Content(name, "attitude.csv", rig, track.frames, t_s, track.world_from_body, covariance, measured)


def _rig_of_results(results: Path, run_folder: str) -> Rig:
    """The rig of the run that results are of."""
    for folder in (Path(run_folder), results / run_folder) if run_folder else ():
        if folder.is_dir():
            return load_run(folder).rig
    was = f"its run folder {run_folder} is not there" if run_folder else "summary.json names no run folder"
    raise InputError(f"{results}: the rig is unknown, because {was}; name it: --rig rig.yaml")


def _of_run(path: Path, rig_path: Path | None) -> Content:
    run = load_run(path)
    rig = run.rig if rig_path is None else load_rig(rig_path)
    truth = load_run_truth(run)
    if truth is not None and truth.pose is not None:
        t = truth.pose
        n = len(t.frame)
        poses = Pose.from_quaternion(t.quaternion_wxyz, t.position_m)
        unknown = np.full((n, 3, 3), np.nan)
        return Content(run.name, "truth/pose.csv", rig, t.frame, t.t_s, poses, unknown, np.ones(n, dtype=bool))
    if run.prior is None:
        return _without_poses(run.name, rig)
    centre = run.prior.centre
    poses = Pose(centre.rotation[None], centre.translation[None])
    # An even spread within a cube has this variance along each axis.
    covariance = np.eye(3)[None] * run.prior.within_m**2 / 3
    one = np.zeros(1, dtype=np.int64)
    return Content(run.name, "the prior of run.yaml", rig, one, np.zeros(1), poses, covariance, np.zeros(1, dtype=bool))


def _without_poses(name: str, rig: Rig) -> Content:
    none = Pose(np.zeros((0, 3, 3)), np.zeros((0, 3)))
    empty = np.zeros(0)
    return Content(name, "", rig, empty.astype(np.int64), empty, none, np.zeros((0, 3, 3)), empty.astype(bool))


def _times(frames: Ints, t_s: Array) -> Array:
    return t_s if np.isfinite(t_s).all() else frames.astype(float)
