"""Possible faults of a set-up, each a few parameters that are constant over a recording.

Errors that the poses absorb completely leave no residual and are not among them: a displacement of the vehicle or of
the whole rig, a wrong overall scale, and an offset of the clock that is common to all cameras.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibration.changes import USUAL_SIZES
from calibration.model_check.linearised_frames import LinearisedFrames, ModelCheckRecording
from geometry.arrays import Array, Bools, Ints, finite, perpendicular, skew
from geometry.forward_model import SpotModel
from geometry.rig import Rig
from geometry.uncertainty.rig_uncertainty import DIRECTION, POINT, POSE, RigCovariance, Sensitivity, is_known

CAMERA, SCREEN, BEAM, VIEW, CLOCK = "camera", "screen", "beam", "spot", "clock"  # the faulty component
TURNED, MOVED, SHIFTED, ZOOMED = "turned", "moved and turned", "picture shifted", "focal length changed"
ALONG_NORMAL, TILTED = "moved along its normal", "moved and tilted"
DIRECTION_WRONG, POINT_WRONG, LASER_MOVED = "direction wrong", "shifted sideways", "moved and direction wrong"
PIXEL_OFFSET, LATE = "constant pixel offset", "not synchronous"

USUAL_SHIFT_PX = 2.0  # shift of a sensor or a lens in its mount
USUAL_LATE_S = 3e-3  # delay without a common trigger or clock
_NEAR_FRAMES = 1.5  # in usual frame intervals: a velocity is estimated from neighbours no farther away in time


@dataclass(frozen=True, slots=True)
class PossibleFault:
    """One possible fault with k parameters, expressed by the p parameters of `FaultParameters`."""

    component: str  # CAMERA ... CLOCK
    name: str  # of the component; `camera/spot` for a view
    kind: str  # TURNED ... LATE
    directions: Array  # (p, k) derivatives of the p parameters by the fault's own
    prior_sigma: Array  # (k,) usual size, 1 sigma, in the parameters' units (rad, m, px, s, or relative)
    views: Bools  # (n,) views that it affects


@dataclass(frozen=True, slots=True)
class FaultParameters:
    """Names of the p parameters that may be wrong, and the derivatives of the pixels by them."""

    # As in geometry.uncertainty.rig_uncertainty, then `clock.CAMERA`, then `view.CAMERA/SPOT.u` and `.v`.
    names: tuple[str, ...]
    sensitivity: Sensitivity  # to the parameters of the rig, which come first
    model: SpotModel
    covariance: Array  # (p, p) stated by the calibration; 0 where it states nothing

    @staticmethod
    def of(rig: Rig, model: SpotModel, calibration: RigCovariance | None) -> FaultParameters:
        """All parameters of the possible faults and of the calibration's covariance.

        Raises KeyError: the covariance names a parameter that the rig does not have.
        """
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
        return FaultParameters(tuple(names), sensitivity, model, covariance)

    def jacobian(self, recording: ModelCheckRecording, lin: LinearisedFrames) -> Array:
        """Derivatives of the whitened pixels by the parameters: (K, n, 2, p)."""
        K, n = lin.used.shape
        derivatives = self.model.derivatives(lin.poses)
        out = np.zeros((K, n, 2, len(self.names)))
        first = len(self.sensitivity.names)
        out[..., :first] = np.where(lin.used[..., None, None], self.sensitivity.of(derivatives), 0.0)
        clocks = len(self.model.camera_names)
        velocity = np.nan_to_num(pixel_velocities(self.model, recording, lin.frames))
        of_camera = self.model.camera_of[:, None] == np.arange(clocks)
        out[..., first : first + clocks] = velocity[..., None] * of_camera[:, None, :]
        rows = np.arange(n)
        for axis in (0, 1):
            out[:, rows, axis, first + clocks + 2 * rows + axis] = 1.0
        return np.asarray(lin.W @ out)


def pixel_velocities(model: SpotModel, recording: ModelCheckRecording, frames: Ints) -> Array:
    """Velocities of the spots (K, n, 2), px/s, from the poses of the neighbouring frames; nan where unknown.

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


def possible_faults(rig: Rig, parameters: FaultParameters) -> tuple[PossibleFault, ...]:
    """All faults that are considered for this rig."""
    model = parameters.model
    index = {name: i for i, name in enumerate(parameters.names)}
    faults = [*_camera_faults(rig, model, index), *_delayed_cameras(model, index), *_screen_faults(rig, model, index)]
    faults += [*_beam_faults(rig, model, index), *_view_faults(model, index)]
    return tuple(f for f in faults if f.views.any())


def _directions(index: dict[str, int], prefix: str, names: Sequence[str], effect: Array) -> Array:
    """(p, k) from the derivatives (len(names), k) of some parameters of one component."""
    out = np.zeros((len(index), effect.shape[1]))
    out[[index[f"{prefix}.{name}"] for name in names]] = effect
    return out


def _camera_faults(rig: Rig, model: SpotModel, index: dict[str, int]) -> list[PossibleFault]:
    faults = []
    for i, (name, camera) in enumerate(rig.cameras.items()):
        views = model.camera_of == i
        if not views.any():
            continue
        R, t = camera.camera_from_world.rotation, camera.camera_from_world.translation
        # A rotation phi about the camera's own centre changes R, t to Exp(phi) R, Exp(phi) t.
        turn = _directions(index, f"cameras.{name}", POSE, np.concatenate([-skew(t), R.T]))
        move = _directions(index, f"cameras.{name}", POSE[:3], np.eye(3))
        focal = np.array([[camera.matrix[0, 0]], [camera.matrix[1, 1]]])
        turn_size, move_size = np.full(3, USUAL_SIZES.turn_rad), np.full(3, USUAL_SIZES.move_m)
        shift = _directions(index, f"cameras.{name}", ("cx", "cy"), np.eye(2))
        zoom = _directions(index, f"cameras.{name}", ("fx", "fy"), focal)
        for kind, directions, size in (
            (TURNED, turn, turn_size),
            (SHIFTED, shift, np.full(2, USUAL_SHIFT_PX)),
            (ZOOMED, zoom, np.full(1, USUAL_SIZES.zoom)),
            (MOVED, np.concatenate([turn, move], axis=1), np.concatenate([turn_size, move_size])),
        ):
            faults.append(PossibleFault(CAMERA, name, kind, directions, size, views))
    return faults


def _delayed_cameras(model: SpotModel, index: dict[str, int]) -> list[PossibleFault]:
    """Each camera against the others; of two cameras only the second, since a delay of one is a lead of the other."""
    filming = [c for i, c in enumerate(model.camera_names) if (model.camera_of == i).any()]
    if len(filming) < 2:
        return []
    out = []
    for name in filming[1:] if len(filming) == 2 else filming:
        directions = np.zeros((len(index), 1))
        directions[index[f"clock.{name}"]] = 1.0
        views = model.camera_of == model.camera_names.index(name)
        out.append(PossibleFault(CLOCK, name, LATE, directions, np.array([USUAL_LATE_S]), views))
    return out


def _screen_faults(rig: Rig, model: SpotModel, index: dict[str, int]) -> list[PossibleFault]:
    """Only displacements out of the screen's own plane: others do not change the pixels."""
    faults = []
    for i, (name, screen) in enumerate(rig.screens.items()):
        views = model.screen_of == i
        forward = _directions(index, f"screens.{name}", POSE[:3], screen.world_from_screen.rotation[:, 2:])
        tilt = _directions(index, f"screens.{name}", POSE[3:5], np.eye(2))
        sizes = np.array([USUAL_SIZES.move_m, USUAL_SIZES.turn_rad, USUAL_SIZES.turn_rad])
        faults.append(PossibleFault(SCREEN, name, ALONG_NORMAL, forward, sizes[:1], views))
        faults.append(PossibleFault(SCREEN, name, TILTED, np.concatenate([forward, tilt], axis=1), sizes, views))
    return faults


def _beam_faults(rig: Rig, model: SpotModel, index: dict[str, int]) -> list[PossibleFault]:
    """Only displacements perpendicular to the beam: a displacement along it does not change the pixels."""
    faults = []
    for i, (name, beam) in enumerate(rig.beams.items()):
        views = model.beam_of == i
        across = perpendicular(beam.direction)
        aim = _directions(index, f"beams.{name}", DIRECTION, across)
        sideways = _directions(index, f"beams.{name}", POINT, across)
        aim_size, sideways_size = np.full(2, USUAL_SIZES.laser_rad), np.full(2, USUAL_SIZES.laser_m)
        faults.append(PossibleFault(BEAM, name, DIRECTION_WRONG, aim, aim_size, views))
        faults.append(PossibleFault(BEAM, name, POINT_WRONG, sideways, sideways_size, views))
        both, size = np.concatenate([aim, sideways], axis=1), np.concatenate([aim_size, sideways_size])
        faults.append(PossibleFault(BEAM, name, LASER_MOVED, both, size, views))
    return faults


def _view_faults(model: SpotModel, index: dict[str, int]) -> list[PossibleFault]:
    faults = []
    for i, (camera_name, spot) in enumerate(model.views):
        name = f"{camera_name}/{spot}"
        directions = _directions(index, f"view.{name}", ("u", "v"), np.eye(2))
        only = np.arange(len(model)) == i
        faults.append(PossibleFault(VIEW, name, PIXEL_OFFSET, directions, np.full(2, USUAL_SIZES.point_px), only))
    return faults
