"""Which single error of the pair's calibration explains the residuals of a recording; the offset of the two clocks.

A rigid target of known size that moves through depth determines more than its poses. The distance follows from its size
in each picture and from the disparity; a wrong baseline scales the disparity, a turned camera or a shifted principal
point adds to it, and a wrong focal length of one camera scales one picture. Each such error is fitted together with all
poses, the covariance of the calibration and the survey of the markers as a prior, and compared by its chi-square.
Errors whose chi-squares are within three sigma of the best are not separated by the recording, and all of them are
named: a turn about the vertical axis and a shift of a principal point along the rows differ only at the edge of the
picture, and the same error of both focal lengths is nearly a change of the distance. With cameras side by side it is
one for points: Z (1 + e) under f (1 + e) has the same images. Only the depth within the target contradicts it, by
e B f d / Z^2 px for markers d apart in depth and a baseline B: what that does not show rests on the calibration alone.

Source: ours; a test of single hypotheses by generalised least squares, as in calibration/model_check.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from geometry.arrays import Array, Bools
from geometry.pose import Pose
from geometry.pose_solver.gauss_newton import PoseFit
from geometry.uncertainty.rig_uncertainty import POSE, perturbed_camera, split_name
from tracking.binocular.acquisition import Images, acquire, labelled_pose, near_pose, observations
from tracking.binocular.joint_fit import MarkerObservations
from tracking.binocular.marker_model import (
    MarkerImages,
    MarkerModel,
    MatchParameters,
    StereoPair,
    calibration_jacobian,
    project,
    project_markers,
)

# Frames that are used, evenly over the recording: the sigma of each error falls with the square root of their number
# (of both focal lengths .35 % with 24, .09 % with 400, which take 1 s more); with the fewest nothing is concluded.
MOST_FRAMES, FEWEST_FRAMES = 400, 5
MOST_ALONE = 24  # frames whose pictures are labelled each alone
_FEWEST_MARKERS = 4  # of each picture: three have several poses
_STEPS = 6  # of Gauss-Newton
_CERTAIN_CHI2 = 20.0  # that an error explains: 4.5 sigma
_SEPARATED_CHI2 = 9.0  # that the best error explains more than another one: 3 sigma
_BOTH = "focal length of both cameras"


@dataclass(frozen=True, slots=True)
class LabelledFrame:
    """The images of one frame, labelled, and a pose near the right one."""

    observed: MarkerObservations
    pose: Pose


@dataclass(frozen=True, slots=True)
class SuspectedError:
    """One error of the calibration that explains the residuals."""

    name: str  # in words
    value: float  # to be added to the stated calibration, in `unit`
    sigma: float
    unit: str
    chi2: float  # that it explains, in units of the variance that is left


@dataclass(frozen=True, slots=True)
class CalibrationCheck:
    """The result for a recording."""

    suspects: tuple[SuspectedError, ...]  # the best first, with all that the recording does not separate from it
    change_sigmas: float  # RMS of the changes of the poses by the best one, per number, in the stated sigmas
    change_m: float  # RMS change of the position
    left: float  # chi-square per degree of freedom with the best one
    frames: int
    hidden_focal_percent: float  # the largest common error of both focal lengths that the recording would not show

    @property
    def certain(self) -> bool:
        """Whether the recording shows an error, be it small or not."""
        return bool(self.suspects) and self.suspects[0].chi2 > _CERTAIN_CHI2

    @property
    def significant(self) -> bool:
        """Whether an error is certain, and changes the poses by more than their sigmas."""
        return self.certain and self.change_sigmas > 1


def labelled_by_each(
    pair: StereoPair, model: MarkerModel, images: Images, start: Pose | None, p: MatchParameters
) -> LabelledFrame | None:
    """The markers labelled in each picture alone, so that an error between the cameras does not matter; None: unknown.

    start: a pose near the right one, where it is known.
    """
    index = np.full((2, len(model)), -1, dtype=np.int64)
    for c in (0, 1):
        own: Images = (images[0], MarkerImages.none()) if c == 0 else (MarkerImages.none(), images[1])
        found = None
        if start is not None:
            found = labelled_pose(pair, model, own, start, near_pose(start), p)
        if found is None or found.markers < min(_FEWEST_MARKERS, len(images[c])):
            found = next(iter(acquire(pair, model, own, p)), None)
        if found is None or found.markers < _FEWEST_MARKERS:
            return None
        index[c] = found.index[c]
        start = found.fit.world_from_body
    assert start is not None
    return LabelledFrame(observations(images, index), start)


@dataclass(frozen=True, slots=True)
class _Hypothesis:
    name: str
    unit: str
    per_unit: Array  # (p,): change of the parameters of `_names` by one unit


def check_calibration(pair: StereoPair, model: MarkerModel, frames: Sequence[LabelledFrame]) -> CalibrationCheck | None:
    """Tests each error of the calibration; None with too few frames, or where they do not determine the poses."""
    if len(frames) < FEWEST_FRAMES:
        return None
    stated = _Adjustment(pair, model, frames)
    base = stated.solved(None)
    if base is None:
        return None
    tried = [(h, found) for h in _hypotheses(pair) if (found := stated.solved(h)) is not None]
    tried.sort(key=lambda t: t[1].chi2)
    if not tried:
        return None
    best = tried[0][1]
    left = best.chi2 / max(stated.dof - 1, 1)
    variance = max(left, 1.0)
    suspects = tuple(
        SuspectedError(h.name, f.value, f.sigma * float(np.sqrt(variance)), h.unit, (base.chi2 - f.chi2) / variance)
        for h, f in tried
        if f.chi2 - best.chi2 <= _SEPARATED_CHI2 * variance
    )
    change = best.poses.minus(base.poses)
    sigmas2 = np.einsum("ni,nij,nj->n", change, np.linalg.inv(base.covariances), change)
    moved = float(np.sqrt(np.mean(np.sum(change[:, :3] ** 2, axis=1))))
    hidden = next((f.sigma * float(np.sqrt(_CERTAIN_CHI2 * variance)) for h, f in tried if h.name == _BOTH), np.inf)
    return CalibrationCheck(suspects, float(np.sqrt(np.mean(sigmas2) / 6)), moved, left, len(frames), hidden)


def _names(pair: StereoPair) -> list[str]:
    """The parameters that the hypotheses change."""
    left, right = (camera.name for camera in pair.cameras)
    lens = [f"cameras.{name}.{p}" for name in (left, right) for p in ("fx", "fy", "cx", "cy")]
    return lens + [f"cameras.{right}.{p}" for p in ("x_m", "y_m", "z_m", "rot_x_rad", "rot_y_rad", "rot_z_rad")]


def _hypotheses(pair: StereoPair) -> list[_Hypothesis]:
    """Single errors of a pair: of the baseline's length, of the turn between the cameras, of each lens."""
    left, right = pair.cameras
    names = _names(pair)

    def change(camera: str, values: dict[str, float]) -> Array:
        out = np.zeros(len(names))
        for parameter, value in values.items():
            out[names.index(f"cameras.{camera}.{parameter}")] = value
        return out

    R, t = right.camera_from_world.rotation, right.camera_from_world.translation
    apart = right.camera_from_world.inverse().translation - left.camera_from_world.inverse().translation
    longer = dict(zip(POSE[:3], (-R @ apart / 100).tolist(), strict=True))
    out = [_Hypothesis("baseline", "%", change(right.name, longer))]
    for words, axis in (("pitch", 0), ("yaw", 1), ("roll", 2)):
        turn = np.deg2rad(np.eye(3)[axis])  # in the camera, about its own centre
        moved = np.concatenate([np.cross(turn, t), R.T @ turn])
        values = dict(zip(POSE, moved.tolist(), strict=True))
        out.append(_Hypothesis(f"{words} between the cameras", "deg", change(right.name, values)))
    focal = [change(c.name, {"fx": c.matrix[0, 0] / 100, "fy": c.matrix[1, 1] / 100}) for c in pair.cameras]
    out.append(_Hypothesis(_BOTH, "%", focal[0] + focal[1]))
    for camera, longer_focus in zip(pair.cameras, focal, strict=True):
        out.append(_Hypothesis(f"focal length of {camera.name}", "%", longer_focus))
        out += [
            _Hypothesis(f"principal point {p} of {camera.name}", "px", change(camera.name, {p: 1.0}))
            for p in ("cx", "cy")
        ]
    return out


@dataclass(frozen=True, slots=True)
class _Solved:
    chi2: float  # with that of the prior
    value: float  # of the hypothesis
    sigma: float
    poses: Pose  # (n,)
    covariances: Array  # (n, 6, 6) of the poses, with the stated errors of the calibration


class _Adjustment:
    """All frames together: their poses, one free error of the calibration, and the stated ones as a prior."""

    def __init__(self, pair: StereoPair, model: MarkerModel, frames: Sequence[LabelledFrame]) -> None:
        self._pair, self._model, self._names = pair, model, _names(pair)
        self._start = Pose.stack(f.pose for f in frames)
        uv = np.stack([f.observed.uv_px for f in frames])
        seen = np.isfinite(uv[..., 0])
        self._uv_px = np.nan_to_num(uv)
        # Whitening of each image; images that are not seen have no weight.
        self._W = np.linalg.inv(np.linalg.cholesky(np.stack([f.observed.cov_px2 for f in frames])))
        self._W = np.where(seen[..., None, None], self._W, 0.0)
        self.dof = int(2 * seen.sum()) - 6 * len(frames)

    def solved(self, hypothesis: _Hypothesis | None) -> _Solved | None:
        """Gauss-Newton from the given poses; None where it does not end at finite numbers."""
        pair, poses, value = self._pair, self._start, 0.0
        for step in range(_STEPS + 1):
            J, r, A = self._system(pair, poses, hypothesis)
            if not (np.isfinite(J).all() and np.isfinite(r).all() and np.isfinite(A).all()):
                return None
            Q, R = np.linalg.qr(J)
            Qt = np.swapaxes(Q, -1, -2)
            A_free, r_free = A - Q @ (Qt @ A), r - (Q @ (Qt @ r[..., None]))[..., 0]
            prior = np.ones(A.shape[-1])
            prior[: int(hypothesis is not None)] = 0.0  # the hypothesis is free, the others are of unit variance
            N = np.einsum("nmi,nmj->ij", A_free, A_free) + np.diag(prior)
            z = np.linalg.lstsq(N, np.einsum("nmi,nm->i", A_free, r_free), rcond=None)[0]
            if step == _STEPS:
                break
            inverse = np.linalg.inv(R)
            poses = poses.plus((inverse @ (Qt @ (r - A @ z)[..., None]))[..., 0])
            if hypothesis is not None:
                value += float(z[0])
                pair = self._changed(value * hypothesis.per_unit)
        left = r_free - A_free @ z
        inverse = np.linalg.inv(R)
        common = inverse @ Qt @ A[..., int(hypothesis is not None) :]
        covariances = inverse @ np.swapaxes(inverse, -1, -2) + common @ np.swapaxes(common, -1, -2)
        sigma = float(np.sqrt(np.linalg.pinv(N)[0, 0])) if hypothesis is not None else 0.0
        return _Solved(float(np.sum(left**2) + np.sum(prior * z**2)), value, sigma, poses, covariances)

    def _system(self, pair: StereoPair, poses: Pose, hypothesis: _Hypothesis | None) -> tuple[Array, Array, Array]:
        """Whitened derivatives by the pose (n, m, 6), residuals (n, m) and derivatives by the errors (n, m, e)."""
        n, K = len(self._uv_px), len(self._model)
        pixels, J = project_markers(pair, self._model, poses)
        points = (self._model.positions @ np.swapaxes(poses.rotation, -1, -2) + poses.translation[:, None]).reshape(
            -1, 3
        )
        columns: list[Array] = []
        if hypothesis is not None:
            columns.append(calibration_jacobian(pair, points, self._names) @ hypothesis.per_unit[:, None])
        if self._pair.covariance is not None:
            values, vectors = np.linalg.eigh(self._pair.covariance.matrix)
            root = vectors * np.sqrt(np.maximum(values, 0.0))
            columns.append(calibration_jacobian(self._pair, points) @ root)
        by_error = [np.moveaxis(c.reshape(2, n, K, 2, -1), 0, 1) for c in columns]
        if self._model.sigma_m > 0:
            by_place = (
                J[..., :3] @ poses.rotation[:, None, None] * self._model.sigma_m
            )  # (n, 2, K, 2, 3), of one marker
            of_marker = np.einsum("nckij,kl->nckilj", by_place, np.eye(K))
            by_error.append(of_marker.reshape(n, 2, K, 2, 3 * K))
        A = np.concatenate(by_error, axis=-1) if by_error else np.zeros((n, 2, K, 2, 0))
        rows = 4 * K
        r = (self._W @ (self._uv_px - pixels)[..., None])[..., 0]
        return (self._W @ J).reshape(n, rows, 6), r.reshape(n, rows), (self._W @ A).reshape(n, rows, -1)

    def _changed(self, delta: Array) -> StereoPair:
        left, right = self._pair.cameras
        values = [(split_name(name), value) for name, value in zip(self._names, delta.tolist(), strict=True)]
        changed = (
            perturbed_camera(camera, {p: value for (_, item, p), value in values if item == camera.name})
            for camera in (left, right)
        )
        return StereoPair((next(changed), next(changed)), self._pair.covariance)


# Whether the two cameras expose at the same time, from residuals that grow with the velocity in the picture.
#
# If the right picture is taken a time d after the left one, each of its images is shifted by d times its velocity.
# Part of the shift is absorbed by the pose; the rest (across the epipolar lines, and in the size of the target) is a
# residual. All frames together give d by least squares, beside a rotation of the right camera, which shifts all frames
# equally. Source: ours.

FEWEST_CLOCK_FRAMES = 8  # with a pose and markers in both pictures: two per unknown
_UNKNOWNS = 4  # the time and three rotations of the right camera


@dataclass(frozen=True, slots=True)
class FittedFrame:
    """One frame with a fitted pose."""

    t_s: float
    fit: PoseFit
    observed: MarkerObservations


@dataclass(frozen=True, slots=True)
class ClockOffset:
    """The result for a recording."""

    offset_s: float  # right after left
    sigma_s: float
    rotation_rad: Array  # (3,) of the right camera about its axes, beside the calibration
    rotation_sigma_rad: Array  # (3,)
    jitter_s: float  # scatter of the offsets of single frames beyond their sigmas
    jitter_significance: float  # chi-square of the offsets of single frames over its degrees of freedom, in its sigmas
    shift_px: float  # RMS shift of the right images by the offset (or by the jitter, whichever is larger)
    frames: int

    @property
    def significant(self) -> bool:
        """Whether the offset is certain (5 sigma) and shifts the images by more than 0.05 px."""
        certain = abs(self.offset_s) > 5 * self.sigma_s or self.jitter_significance > 8
        return certain and self.shift_px > 0.05


def clock_offset(pair: StereoPair, model: MarkerModel, frames: Sequence[FittedFrame]) -> ClockOffset | None:
    """The offset of the right camera's clock; None with fewer than eight moving frames that determine it."""
    N, b = np.zeros((_UNKNOWNS, _UNKNOWNS)), np.zeros(_UNKNOWNS)
    left, dof, used = 0.0, 0, []
    for before, frame, after in zip(frames, frames[1:], frames[2:], strict=False):
        rate = after.fit.world_from_body.minus(before.fit.world_from_body) / (after.t_s - before.t_s)
        part = _reduced(pair, model, frame, rate)
        if part is None:
            continue
        A, r, free, moved2 = part
        N, b, left, dof = N + A.T @ A, b + A.T @ r, left + float(r @ r), dof + free
        used.append((A, r, moved2))
    if len(used) < FEWEST_CLOCK_FRAMES:
        return None
    scale = np.sqrt(np.maximum(np.diagonal(N), 1e-300))
    values, vectors = np.linalg.eigh(N / np.outer(scale, scale))
    if values[0] < 1e-10:
        return None
    covariance = (vectors / values) @ vectors.T / np.outer(scale, scale)
    x = covariance @ b
    factor = max(1.0, (left - float(b @ x)) / max(dof - _UNKNOWNS, 1))
    sigma = np.sqrt(np.diagonal(covariance) * factor)
    moved = float(np.sqrt(np.mean([m for _, _, m in used])))
    jitter, significance = _jitter(x, used, factor)
    shift = moved * max(abs(float(x[0])), jitter if significance > 8 else 0.0)
    return ClockOffset(float(x[0]), float(sigma[0]), x[1:], sigma[1:], jitter, significance, shift, len(used))


def _jitter(x: Array, used: Sequence[tuple[Array, Array, float]], factor: float) -> tuple[float, float]:
    """Scatter, s, of the offsets of single frames around the common one, and its significance."""
    single, weight = [], []
    for A, r, _ in used:
        information = float(A[:, 0] @ A[:, 0])
        if information > 0:
            single.append(float(A[:, 0] @ (r - A @ x)) / information)
            weight.append(information)
    d, w = np.array(single), np.array(weight)
    if not len(d):
        return 0.0, 0.0
    chi2 = float(np.sum(d * d * w)) / min(factor, 2.0)
    excess = (chi2 - len(d)) / float(np.sum(w))
    return float(np.sqrt(max(excess, 0.0))), (chi2 - len(d)) / float(np.sqrt(2 * len(d)))


def _reduced(
    pair: StereoPair, model: MarkerModel, frame: FittedFrame, rate: Array
) -> tuple[Array, Array, int, float] | None:
    """Design (m, 4), residuals (m,), degrees of freedom and mean squared velocity (px/s)^2 of one frame.

    Whitened, and without the directions that a change of the pose explains.
    """
    uv = frame.observed.uv_px
    residuals = uv - frame.fit.projected_px.reshape(uv.shape)
    seen: Bools = np.isfinite(residuals[..., 0])
    if seen[0].sum() < 2 or seen[1].sum() < 2:
        return None
    J = frame.fit.jacobian.reshape(*uv.shape, 6)
    velocity = J[1] @ rate
    camera = pair.cameras[1].camera_from_world
    world = frame.fit.world_from_body.apply(model.positions)
    by_point = project(pair, world)[1][1]
    by_turn = np.cross(camera.apply(world)[:, None, :], by_point @ camera.rotation.T)  # Exp(theta) x in the camera
    A = np.zeros((2, len(model), 2, _UNKNOWNS))
    A[1, :, :, 0], A[1, :, :, 1:] = velocity, by_turn
    W = np.linalg.inv(np.linalg.cholesky(frame.observed.cov_px2[seen]))
    J_w = (W @ J[seen]).reshape(-1, 6)
    A_w = (W @ A[seen]).reshape(-1, _UNKNOWNS)
    r_w = (W @ residuals[seen][..., None]).reshape(-1)
    Q = np.linalg.qr(J_w)[0]
    free = len(r_w) - 6
    if free < 1:
        return None
    moved2 = float(np.mean(np.sum(velocity[seen[1]] ** 2, axis=-1)))
    return A_w - Q @ (Q.T @ A_w), r_w - Q @ (Q.T @ r_w), free, moved2
