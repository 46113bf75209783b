"""What may be wrong with a set-up: each possible fault as a few numbers that stay the same over a recording.

The vehicle as a whole is not among them, nor a wrong scale of everything, nor an error of the clock that all cameras
share: the poses follow these completely, and no residual shows them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibration.drift import UsualSizes
from geometry.arrays import Array, Bools, Ints, normalised, skew
from geometry.forward_model import SpotModel
from geometry.rig import Rig
from geometry.uncertainty.rig_parameters import DIRECTION, POINT, POSE, RigCovariance, Sensitivity, is_known
from lab.runs.model_check.linear import LinearisedFrames
from lab.runs.model_check.recording import ModelCheckRecording, finite

CAMERA, SCREEN, BEAM, VIEW, CLOCK = "camera", "screen", "beam", "spot", "clock"  # what a fault is of
TURNED, MOVED, SHIFTED, ZOOMED = "turned", "moved and turned", "picture shifted", "focal length changed"
ALONG_NORMAL, TILTED = "moved along its normal", "moved and tilted"
POINTS_ELSEWHERE, POINT_OFF, LASER_MOVED = "points elsewhere", "moved beside itself", "moved and points elsewhere"
BESIDE, LATE = "seen beside its place", "not at the same instant"

USUAL = UsualSizes()
USUAL_SHIFT_PX = 2.0  # a sensor or a lens that sits elsewhere in its mount
USUAL_LATE_S = 3e-3  # a trigger or a clock that is not common
_NEAR_FRAMES = 1.5  # usual frame intervals: neighbours farther away in time tell no velocity


@dataclass(frozen=True, slots=True)
class PossibleFault:
    """One possible fault of k numbers among the p of a `FaultColumns`."""

    thing: str  # CAMERA ... CLOCK
    name: str  # of it; of a spot `camera/spot`
    kind: str  # TURNED ... LATE
    numbers: Array  # (p, k) what each of its numbers does to those of the columns
    size: Array  # (k,) how large it usually is, 1 sigma, in the numbers' units (rad, m, px, s, or relative)
    views: Bools  # (n,) those that it moves


@dataclass(frozen=True, slots=True)
class FaultColumns:
    """Names of p numbers that may be off, and how they move the pixels."""

    names: tuple[
        str, ...
    ]  # as geometry.uncertainty.rig_parameters, then `clock.CAMERA`, then `view.CAMERA/SPOT.u`, `... .v`
    sensitivity: Sensitivity  # of the first of them
    model: SpotModel
    covariance: Array  # (p, p) what the calibration claims of them; 0 where it claims nothing

    @staticmethod
    def of(rig: Rig, model: SpotModel, calibration: RigCovariance | None) -> FaultColumns:
        """All numbers that a fault or the calibration's covariance speaks of. KeyError: a name that the rig lacks."""
        names = [f"cameras.{c}.{p}" for c in rig.cameras for p in ("fx", "fy", "cx", "cy", *POSE)]
        names += [f"screens.{s}.{p}" for s in rig.screens for p in POSE]
        names += [f"beams.{b}.{p}" for b in rig.beams for p in (*DIRECTION, *POINT)]
        known = () if calibration is None else calibration.names
        for name in known:
            if not is_known(rig, name):
                raise KeyError(name)
        names += [n for n in known if n not in set(names)]
        sensitivity = Sensitivity(rig, model, names)
        names += [f"clock.{c}" for c in rig.cameras]
        names += [f"view.{c}/{s}.{axis}" for c, s in model.views for axis in "uv"]
        covariance = np.zeros((len(names), len(names)))
        if calibration is not None:
            place = [names.index(n) for n in known]
            covariance[np.ix_(place, place)] = calibration.matrix
        return FaultColumns(tuple(names), sensitivity, model, covariance)

    def at(self, recording: ModelCheckRecording, lin: LinearisedFrames) -> Array:
        """What each number does to the whitened pixels of these frames: (K, n, 2, p)."""
        K, n = lin.used.shape
        derivatives = self.model.derivatives(lin.poses)
        out = np.zeros((K, n, 2, len(self.names)))
        first = len(self.sensitivity.names)
        out[..., :first] = np.where(lin.used[..., None, None], self.sensitivity.of(derivatives), 0.0)
        speed = np.nan_to_num(_speeds(self.model, recording, lin.frames))
        clocks = len(self.model.camera_names)
        of_camera = self.model.camera_of[:, None] == np.arange(clocks)
        out[..., first : first + clocks] = speed[..., None] * of_camera[:, None, :]
        rows = np.arange(n)
        for axis in (0, 1):
            out[:, rows, axis, first + clocks + 2 * rows + axis] = 1.0
        return np.asarray(lin.W @ out)


def _speeds(model: SpotModel, recording: ModelCheckRecording, frames: Ints) -> Array:
    """How fast the spots move by the poses of the neighbouring frames, (K, n, 2), px/s; nan where these are unknown.

    A neighbour that is missing or far away in time is replaced by the frame itself.
    """
    t, known = recording.t_s, finite(recording.poses.translation, -1)
    last = len(t) - 1
    usual = float(np.median(np.diff(t))) if last > 0 else 0.0

    def neighbour(step: int) -> Ints:
        there = np.clip(frames + step, 0, last)
        return np.where(known[there] & (np.abs(t[there] - t[frames]) <= _NEAR_FRAMES * usual), there, frames)

    before, after = neighbour(-1), neighbour(1)
    elapsed = (t[after] - t[before])[:, None, None]
    moved = model.project(recording.poses[after])[0] - model.project(recording.poses[before])[0]
    return np.where(elapsed > 0, moved / np.where(elapsed > 0, elapsed, 1.0), np.nan)


def possible_faults(rig: Rig, columns: FaultColumns) -> tuple[PossibleFault, ...]:
    """Every fault that this rig may have."""
    model = columns.model
    index = {name: i for i, name in enumerate(columns.names)}

    def made(prefix: str, parameters: Sequence[str], effect: Array) -> Array:
        """(p, k) from the effects (parameters, k) on some numbers of one thing."""
        out = np.zeros((len(index), effect.shape[1]))
        out[[index[f"{prefix}.{p}"] for p in parameters]] = effect
        return out

    faults: list[PossibleFault] = []
    for i, (name, camera) in enumerate(rig.cameras.items()):
        views = model.camera_of == i
        if not views.any():
            continue
        R, t = camera.camera_from_world.rotation, camera.camera_from_world.translation
        # A turn phi about the camera's own centre takes R, t to Exp(phi) R, Exp(phi) t.
        turn = made(f"cameras.{name}", POSE, np.concatenate([-skew(t), R.T]))
        move = made(f"cameras.{name}", POSE[:3], np.eye(3))
        focal = np.array([[camera.matrix[0, 0]], [camera.matrix[1, 1]]])
        turn_size, move_size = np.full(3, USUAL.turn_rad), np.full(3, USUAL.move_m)
        for kind, numbers, size in (
            (TURNED, turn, turn_size),
            (SHIFTED, made(f"cameras.{name}", ("cx", "cy"), np.eye(2)), np.full(2, USUAL_SHIFT_PX)),
            (ZOOMED, made(f"cameras.{name}", ("fx", "fy"), focal), np.full(1, USUAL.zoom)),
            (MOVED, np.concatenate([turn, move], axis=1), np.concatenate([turn_size, move_size])),
        ):
            faults.append(PossibleFault(CAMERA, name, kind, numbers, size, views))
    faults += _late_cameras(model, index)
    screen_of = [rig.spots[s].screen for _, s in model.views]
    for name, screen in rig.screens.items():
        views = np.array([s == name for s in screen_of])
        # In its own plane a screen may move as it likes: a plane stays what it is.
        forward = made(f"screens.{name}", POSE[:3], screen.world_from_screen.rotation[:, 2:])
        tilt = made(f"screens.{name}", POSE[3:5], np.eye(2))
        sizes = np.array([USUAL.move_m, USUAL.turn_rad, USUAL.turn_rad])
        faults.append(PossibleFault(SCREEN, name, ALONG_NORMAL, forward, sizes[:1], views))
        faults.append(PossibleFault(SCREEN, name, TILTED, np.concatenate([forward, tilt], axis=1), sizes, views))
    for i, (name, beam) in enumerate(rig.beams.items()):
        views = model.beam_of == i
        across = _across(beam.direction)  # along itself a beam may move as it likes
        aim, beside = made(f"beams.{name}", DIRECTION, across), made(f"beams.{name}", POINT, across)
        aim_size, beside_size = np.full(2, USUAL.laser_rad), np.full(2, USUAL.laser_m)
        faults.append(PossibleFault(BEAM, name, POINTS_ELSEWHERE, aim, aim_size, views))
        faults.append(PossibleFault(BEAM, name, POINT_OFF, beside, beside_size, views))
        both, size = np.concatenate([aim, beside], axis=1), np.concatenate([aim_size, beside_size])
        faults.append(PossibleFault(BEAM, name, LASER_MOVED, both, size, views))
    for i, (camera_name, spot) in enumerate(model.views):
        name = f"{camera_name}/{spot}"
        numbers = made(f"view.{name}", ("u", "v"), np.eye(2))
        faults.append(
            PossibleFault(VIEW, name, BESIDE, numbers, np.full(2, USUAL.point_px), np.arange(len(model)) == i)
        )
    return tuple(f for f in faults if f.views.any())


def _late_cameras(model: SpotModel, index: dict[str, int]) -> list[PossibleFault]:
    """Each camera against the others; of two only the second, since one late is the other early."""
    filming = [c for i, c in enumerate(model.camera_names) if (model.camera_of == i).any()]
    if len(filming) < 2:
        return []
    out = []
    for name in filming[1:] if len(filming) == 2 else filming:
        numbers = np.zeros((len(index), 1))
        numbers[index[f"clock.{name}"]] = 1.0
        views = model.camera_of == model.camera_names.index(name)
        out.append(PossibleFault(CLOCK, name, LATE, numbers, np.array([USUAL_LATE_S]), views))
    return out


def _across(direction: Array) -> Array:
    """Two unit vectors (3, 2) across a direction (3,) and each other."""
    aside = normalised(np.cross(direction, np.eye(3)[np.argmin(np.abs(direction))]))
    return np.stack([aside, np.cross(direction, aside)], axis=1)
