"""Motions for a rig of one's own: a scenario's motion where that rig sees the vehicle, or a recorded one."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from geometry.arrays import Array
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.pose_solver.visibility import middle_of_view
from geometry.rig import Rig
from lab.errors import InputError
from lab.files.run.truth import read_true_poses
from lab.simulate.scenarios import Motion, PriorRegion, Scenario
from lab.simulate.scene import has_motion, spots_in_view

_SMALLER = 0.8  # each further size of a motion, until it keeps the spots in view
_SIZES = 15  # the last one has a twentieth of the amplitude
_LEAST_SPOTS = 3  # that a pose needs
_NEAR_FIRST_M, _NEAR_FIRST_DEG = 0.3, 15.0  # the prior of a trajectory: what an engineer knows of the first pose
_DRAWS = 1000  # of a motion as it is; one in 75 suits the rig of "four-skew-beams", the least of all scenarios
_DRAWS_OF_A_SIZE = 40  # one in 40 is enough for the 3000 draws of any seed to find one


def placed(scenario: Scenario, rig: Rig, start: Pose | None = None) -> Scenario:
    """The scenario with its motion where a rig sees the vehicle, as large as keeps half of the spots in view.

    A rig whose spots allow the scenario as it is keeps it. start: the middle of the motion; default: that of the rig's
    view. Raises InputError: too few spots are in view there.
    """
    model = SpotModel.of(rig)
    if start is None and has_motion(scenario, model, _DRAWS):
        return scenario
    middle = middle_of_view(rig) if start is None else start
    seen = spots_in_view(model, middle)
    if len(seen) < _LEAST_SPOTS:
        raise InputError(
            f"{'rig' if start is None else 'start'}: expected {_LEAST_SPOTS} spots or more in view at"
            f" {_in_words(middle)}, got {', '.join(seen) if seen else 'none'}; `beampose check` says where each"
            " spot is in view"
        )
    prior = _about(middle, scenario.prior.within_m, scenario.prior.within_deg)
    base = scenario.motion
    if not isinstance(base, Motion):
        raise InputError("start: a recorded motion has its own; omit the start")
    out = replace(
        scenario,
        prior=prior,
        all_in_view_at_start=len(seen) == len(model.spot_names),
        always_in_view=(),
        leaves_and_returns=(),
        spots_in_view=max(_LEAST_SPOTS, (len(seen) + 1) // 2),
    )
    for size in _SMALLER ** np.arange(_SIZES):
        trial = replace(out, motion=base.about((*prior.position_m, *prior.yaw_pitch_roll_deg), float(size)))
        if has_motion(trial, model, _DRAWS_OF_A_SIZE):
            return trial
    raise InputError(
        f"scenario {scenario.name!r}: even with {100 * _SMALLER ** (_SIZES - 1):.0f} % of its motion about"
        f" {_in_words(middle)}, fewer than {out.spots_in_view} spots stay in view; use a wider lens, or state --start"
    )


@dataclass(frozen=True, slots=True)
class RecordedMotion:
    """The motion through stated poses: a cubic spline of the position, and one of the rotation."""

    duration_s: float
    position: CubicSpline
    rotation: RotationSpline

    def drawn(self, rng: np.random.Generator, frame_rate_hz: float) -> RecordedMotion:
        """This motion: nothing of it is random."""
        return self

    def pose(self, t_s: Array) -> Pose:
        """world_from_body, stacked (...), at times (...), s; beyond the ends the vehicle rests there."""
        t = np.clip(np.asarray(t_s, dtype=float), 0.0, self.duration_s)
        turned = self.rotation(t.ravel()).as_matrix().reshape(*t.shape, 3, 3)
        return Pose(turned, self.position(t))

    def bends_s(self, end_s: float) -> Array:
        """The times of corners: none."""
        return np.zeros(0)


def along(scenario: Scenario, path: Path, rig: Rig, frame_rate_hz: float | None = None) -> tuple[Scenario, list[str]]:
    """The scenario along the poses of a table with the columns of truth/pose.csv; and which spots leave the view when.

    The first pose is at the time 0 of the recording, which is as long as the table and has its rate, unless another one
    is stated. Raises InputError: the table is no trajectory, or no spot of the rig is ever in view.
    """
    table = read_true_poses(path)
    if len(table.frame) < 2:
        raise InputError(f"{path}: expected two poses or more, got {len(table.frame)}")
    steps = np.diff(table.t_s)
    if np.any(steps <= 0):
        line = int(np.argmax(steps <= 0)) + 3  # the table's first line is its header
        raise InputError(f"{path}: line {line}: t_s: expected rising times, got {table.t_s[line - 2]:g}")
    t = table.t_s - table.t_s[0]
    rate = 1 / float(np.median(steps)) if frame_rate_hz is None else frame_rate_hz
    turns = Rotation.from_quat(table.quaternion_wxyz[:, [1, 2, 3, 0]])
    motion = RecordedMotion(float(t[-1]), CubicSpline(t, table.position_m), RotationSpline(t, turns))
    out = replace(
        scenario,
        motion=motion,
        frames=int(np.floor(t[-1] * rate + 1e-6)) + 1,
        frame_rate_hz=rate,
        prior=_about(motion.pose(np.zeros(())), _NEAR_FIRST_M, _NEAR_FIRST_DEG),
        all_in_view_at_start=False,
        always_in_view=(),
        leaves_and_returns=(),
        spots_in_view=0,
    )
    return out, _leaving(SpotModel.of(rig), motion, out.frames, rate, path, rig)


def _leaving(model: SpotModel, motion: RecordedMotion, frames: int, rate: float, path: Path, rig: Rig) -> list[str]:
    """A line for each spot that is not in view throughout: when it leaves first, and its share of the frames."""
    t = np.arange(frames) / rate
    seen = model.in_picture(model.project(motion.pose(t))[0])
    if not seen.any():
        raise InputError(
            f"{path}: no spot is in any picture along this trajectory; the rig sees the vehicle best at"
            f" {_in_words(middle_of_view(rig))}"
        )
    out = []
    for i, name in enumerate(model.spot_names):
        views = seen[:, model.spot_of == i].any(axis=1)
        if not views.any():
            out.append(f"spot {name}: never in view")
        elif not views.all():
            k = int(np.argmin(views))
            out.append(f"spot {name}: out of view in frame {k} ({t[k]:.3g} s) and {100 * np.mean(~views):.0f} % of all")
    return out


def _about(pose: Pose, within_m: float, within_deg: float) -> PriorRegion:
    """The region of the first pose about a pose."""
    (x, y, z), (yaw, pitch, roll) = pose.translation.tolist(), np.rad2deg(pose.ypr).tolist()
    return PriorRegion((x, y, z), (yaw, pitch, roll), within_m, within_deg)


def _in_words(pose: Pose) -> str:
    p, ypr = pose.translation + 0.0, np.rad2deg(pose.ypr) + 0.0
    return (
        f"({p[0]:.3g}, {p[1]:.3g}, {p[2]:.3g}) m with yaw, pitch, roll ({ypr[0]:.3g}, {ypr[1]:.3g}, {ypr[2]:.3g}) deg"
    )
