"""The parameters of a rig that a calibration determines, their covariance, and where it and the pose put the spots.

Names are those of rig.yaml's covariance blocks: `cameras.left.fx`, `screens.right.rot_x_rad`, `beams.A.direction_y`.
Cameras have fx, fy, cx, cy (px), as many of k1 ... tau_y as their lens model uses, the error of camera_from_world, and
the numbers of their clocks, whose effect on the pixels depends on the motion and is not part of `Sensitivity`;
screens have the error of world_from_screen and the bow; beams have a direction and a point in body, whose components
along the beam have no effect.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from geometry.arrays import Array, Bools, Ints, robust_sigma, symmetric
from geometry.camera import FISHEYE, Camera
from geometry.forward_model import SpotDerivatives, SpotModel
from geometry.pose import Pose
from geometry.rig import Rig, Screen

PINHOLE = ("fx", "fy", "cx", "cy")
DISTORTION = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tau_x", "tau_y")
FISHEYE_DISTORTION = ("k1", "k2", "k3", "k4")
POSE = ("x_m", "y_m", "z_m", "rot_x_rad", "rot_y_rad", "rot_z_rad")
TIME_OFFSET, ROW_TIME = CLOCK = ("time_offset_s", "row_time_s")
BOW = ("bow_xx_per_m", "bow_xy_per_m", "bow_yy_per_m")
DIRECTION = ("direction_x", "direction_y", "direction_z")
POINT = ("point_x_m", "point_y_m", "point_z_m")


@dataclass(frozen=True, slots=True)
class RigCovariance:
    """The joint covariance of the errors of a rig's parameters, or of those of one camera or screen."""

    names: tuple[str, ...]  # p names, as in the module's docstring; of one part without its place: fx, k1, x_m ...
    matrix: Array  # (p, p), in the parameters' units; may be singular

    def part(self, keep: Sequence[bool] | Bools) -> RigCovariance:
        """That of some of the p parameters."""
        rows = np.flatnonzero(keep)
        return RigCovariance(tuple(self.names[i] for i in rows), self.matrix[np.ix_(rows, rows)])


def independent(parts: Iterable[RigCovariance]) -> RigCovariance:
    """The joint covariance of the parameters of parts without correlations between them."""
    names: tuple[str, ...] = ()
    matrix = np.zeros((0, 0))
    for part in parts:
        matrix = np.pad(matrix, (0, len(part.names)))
        matrix[len(names) :, len(names) :] = part.matrix
        names += part.names
    return RigCovariance(names, matrix)


def with_variances(covariance: RigCovariance | None, variances: Mapping[str, float]) -> RigCovariance:
    """A covariance of a rig, or of an exact one, with more variance of some parameters, in their units squared."""
    names, matrix = ((), np.zeros((0, 0))) if covariance is None else (covariance.names, covariance.matrix)
    new = tuple(name for name in variances if name not in names)
    every = (*names, *new)
    wider = np.pad(matrix, (0, len(new))) + np.diag([variances.get(name, 0.0) for name in every])
    return RigCovariance(every, wider)


def distortion_names(camera: Camera) -> tuple[str, ...]:
    """The names of a camera's distortion coefficients, in order."""
    names = FISHEYE_DISTORTION if camera.lens == FISHEYE else DISTORTION
    return names[: len(camera.distortion)]


def camera_names(camera: Camera) -> tuple[str, ...]:
    """The names of the parameters of a camera that place its spots, without its own name."""
    return (*PINHOLE, *distortion_names(camera), *POSE)


def rig_names(rig: Rig, bow: bool = False) -> tuple[str, ...]:
    """The names of all parameters of a rig: cameras, screens (optionally with their bows), beams."""
    names = [f"cameras.{n}.{p}" for n, c in rig.cameras.items() for p in camera_names(c)]
    names += [f"screens.{n}.{p}" for n in rig.screens for p in ((*POSE, *BOW) if bow else POSE)]
    names += [f"beams.{n}.{p}" for n in rig.beams for p in (*DIRECTION, *POINT)]
    return tuple(names)


def split_name(name: str) -> tuple[str, str, str]:
    """Kind, item and parameter: `cameras.left.fx` gives cameras, left, fx; the item's own name may contain dots."""
    kind, rest = name.split(".", 1)
    item, parameter = rest.rsplit(".", 1)
    return kind, item, parameter


def is_known(rig: Rig, name: str) -> bool:
    """Whether this rig has a parameter of this name."""
    if name.count(".") < 2:
        return False
    kind, item, parameter = split_name(name)
    if kind == "cameras" and item in rig.cameras:
        return parameter in CLOCK or parameter in camera_names(rig.cameras[item])
    if kind == "screens" and item in rig.screens:
        return parameter in (*POSE, *BOW)
    return kind == "beams" and item in rig.beams and parameter in (*DIRECTION, *POINT)


def perturbed_camera(camera: Camera, change: Mapping[str, float]) -> Camera:
    """The camera with some parameters, by their names without its own, changed by so much."""
    d = _changes_of(change, PINHOLE)
    matrix = camera.matrix + np.array([[d[0], 0, d[2]], [0, d[1], d[3]], [0, 0, 0]])
    distortion = tuple((np.array(camera.distortion) + _changes_of(change, distortion_names(camera))).tolist())
    place = _perturbed_pose(camera.camera_from_world, change)
    clock = {n: getattr(camera, n) + change.get(n, 0.0) for n in CLOCK}
    return replace(camera, matrix=matrix, distortion=distortion, camera_from_world=place, **clock)


def perturbed_rig(rig: Rig, names: Sequence[str], delta: Array) -> Rig:
    """The rig with each named parameter changed by delta (p,), in the parameters' units.

    Raises KeyError: the rig has no parameter of this name.
    """
    changes: dict[tuple[str, str], dict[str, float]] = {}
    for name, value in zip(names, delta, strict=True):
        if not is_known(rig, name):
            raise KeyError(name)
        kind, item, parameter = split_name(name)
        changes.setdefault((kind, item), {})[parameter] = float(value)
    cameras, screens, beams = dict(rig.cameras), dict(rig.screens), dict(rig.beams)
    for (kind, item), change in changes.items():
        if kind == "cameras":
            cameras[item] = perturbed_camera(cameras[item], change)
        elif kind == "screens":
            screens[item] = _perturbed_screen(screens[item], change)
        else:
            way, point = _changes_of(change, DIRECTION), _changes_of(change, POINT)
            beams[item] = replace(beams[item], direction=beams[item].direction + way, point=beams[item].point + point)
    return Rig(screens, cameras, beams, rig.spots)


def _changes_of(change: Mapping[str, float], names: Sequence[str]) -> Array:
    """The changes of the named parameters (k,), 0 for those that do not change."""
    return np.array([change.get(n, 0.0) for n in names])


def _perturbed_pose(pose: Pose, change: Mapping[str, float]) -> Pose:
    delta = _changes_of(change, POSE)
    return pose.plus(delta) if delta.any() else pose


def _perturbed_screen(screen: Screen, change: Mapping[str, float]) -> Screen:
    a, b, c = (np.array(screen.bow) + _changes_of(change, BOW)).tolist()
    return replace(screen, world_from_screen=_perturbed_pose(screen.world_from_screen, change), bow=(a, b, c))


class Sensitivity:
    """Derivatives of the pixels of a rig's n views by the named parameters.

    Prepared once per rig: which parameter acts on which view does not depend on the pose.
    """

    def __init__(self, rig: Rig, model: SpotModel, names: Sequence[str]) -> None:
        """model: of this rig, possibly of a subset of its views.

        Raises KeyError: the rig has no parameter of this name.
        """
        self.names = tuple(names)
        cameras, screens, beams = list(rig.cameras), list(rig.screens), list(rig.beams)
        camera_of = model.camera_of
        # Per field of SpotDerivatives: views, columns in it, and indices of parameters (m,) that act on them.
        self._actions: dict[str, Ints] = {}
        for i, name in enumerate(self.names):
            if not is_known(rig, name):
                raise KeyError(name)
            kind, item, parameter = split_name(name)
            if parameter in CLOCK:
                continue
            if kind == "cameras":
                field, column = camera_column(rig.cameras[item], parameter)
                views = camera_of == cameras.index(item)
            elif kind == "screens":
                field, column = ("bow", BOW.index(parameter)) if parameter in BOW else ("screen", POSE.index(parameter))
                views = model.screen_of == screens.index(item)
            else:
                is_direction = parameter in DIRECTION
                field = "direction" if is_direction else "point"
                column = (DIRECTION if is_direction else POINT).index(parameter)
                views = model.beam_of == beams.index(item)
            own = np.array([(v, column, i) for v in np.flatnonzero(views)], dtype=np.int64).reshape(-1, 3).T
            self._actions[field] = np.concatenate([self._actions.get(field, own[:, :0]), own], axis=1)
        self.of_lens = not {"pinhole", "distortion"}.isdisjoint(self._actions)  # of some camera's lens

    def of(self, derivatives: SpotDerivatives) -> Array:
        """d(pixels)/d(parameters) (..., n, 2, p), px per unit."""
        out = np.zeros((*derivatives.pixels.shape, len(self.names)))
        for field, (view, column, parameter) in self._actions.items():
            out[..., view, :, parameter] = getattr(derivatives, field)[..., view, :, column]
        return out


def camera_column(camera: Camera, parameter: str) -> tuple[str, int]:
    """Field of SpotDerivatives and column in it of a camera's parameter."""
    if parameter in PINHOLE:
        return "pinhole", PINHOLE.index(parameter)
    if parameter in POSE:
        return "camera", POSE.index(parameter)
    return "distortion", distortion_names(camera).index(parameter)


# Effect of a calibration's errors on the pixels of all spots together; the errors are the same in every frame.
#
# A calibration that is wrong by a draw of its covariance moves the spots of one frame jointly, and those of the next
# frame in the same way. The pose is therefore solved with this covariance beside the noise (generalised least
# squares), which keeps the consistency tests correct, and its share of the pose's covariance is reported separately:
# averaging over frames does not reduce it. Source: ours.


class RigUncertainty:
    """The joint covariance of the pixels of all views that the covariance of a rig's calibration implies."""

    def __init__(self, rig: Rig, model: SpotModel, covariance: RigCovariance) -> None:
        """model: of this rig. Raises KeyError: the covariance names a number that the rig does not have."""
        self._model = model
        self._sensitivity = Sensitivity(rig, model, covariance.names)
        self._root = covariance_root(covariance.matrix)
        self._last: tuple[Pose | None, Array] = None, np.empty(0)  # of a single pose: a search fits it several times

    def at(self, world_from_body: Pose) -> Array:
        """Covariance (..., 2n, 2n), px^2, of the pixels of the n views, ordered u, v; 0 for views without projection.

        The pose may be a stack (...): 0.6 ms of CPU time for a pose, 0.03 ms for each of a stack.
        """
        if world_from_body is self._last[0]:
            return self._last[1]
        spread = self.root_at(world_from_body)
        out = np.asarray(spread @ np.swapaxes(spread, -1, -2))
        if out.ndim == 2:
            self._last = world_from_body, out
        return out

    def root_at(self, world_from_body: Pose) -> Array:
        """A (..., 2n, r) with A A^T the covariance: displacements by r independent errors of the rig, 1 sigma each."""
        derivatives = self._model.derivatives(world_from_body, self._sensitivity.of_lens)
        moves = self._sensitivity.of(derivatives)
        moves[np.isnan(derivatives.pixels)] = 0.0
        *stack, n, two, p = moves.shape
        return np.asarray(moves.reshape(*stack, n * two, p) @ self._root)  # the stack may be empty


def covariance_root(covariance: Array) -> Array:
    """A (p, r) with A A^T the covariance (p, p), which may be singular and of numbers of very different units."""
    unit = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
    safe = np.where(unit > 0, unit, 1.0)
    eigenvalues, vectors = np.linalg.eigh(symmetric(covariance / np.outer(safe, safe)))
    real = eigenvalues > 1e-12 * max(float(eigenvalues[-1]), 1e-300)
    return (vectors[:, real] * np.sqrt(eigenvalues[real])) * unit[:, None]


# Covariance of a smoother whose measurements have errors that do not change from frame to frame.


# Share of the measurements' noise in the variance of an optimal estimate of a motion with white jerk; the rest comes
# from the jerk. The variance grows as R^(5/6) q^(1/6) with the variances R of the noise and q of the jerk.
NOISE_OF_ESTIMATE = 5 / 6


def share_without_calibration(H: Array, noise: Array) -> Array:
    """Share (k,) of estimates' covariances that is left without the calibration's errors, which their weights include.

    A smoother that weights m points with noise and calibration errors takes both for noise. The calibration's errors,
    which no averaging reduces, are stated separately, so that they would count twice. H (k, 6, 6): normal matrices with
    the weights W of both; noise (k, 6, 6): the sums of J^T W N W J, N, px^2, the noise. 1 where the points do not
    determine the pose. Source: ours.
    """
    determined = np.linalg.cond(H) < 1 / np.finfo(float).eps
    both = np.linalg.solve(np.where(determined[:, None, None], H, np.eye(6)), noise)
    own = np.where(determined, np.trace(both, axis1=1, axis2=2) / 6, 1.0)
    return np.asarray(1 - NOISE_OF_ESTIMATE * (1 - own))


_OUTLIER2 = 4.5**2  # squared distance, in sigmas, beyond which a difference does not count as scatter
_FEWEST = 10  # differences from which a scatter is computed
_NEAREST, _FARTHEST = 0.5, 1.5  # ends of a beam's image, over the lengths to the nearest and to the farthest screen


def unlimited(model: SpotModel) -> SpotModel:
    """The model with screens that have no edge: a beam that misses its screen has a place beside it."""
    return replace(model, half_size=np.full_like(model.half_size, np.inf))


def uncertainty_tracks(
    model: SpotModel, world_from_body: Pose, covariance: Array, sigmas: float = 3.0, steps: int = 61
) -> Array:
    """The curves (n, steps, 2), px, on which the spots of n views lie if the pose is wrong by up to so many sigmas.

    With the pixel's Jacobian J and the unit vector a of the largest variance of J P J^T, the curve is the projection
    (with all its bends) of the poses moved by s P J^T a / sqrt(a^T J P J^T a), s from -sigmas to sigmas: the expected
    pose for a spot that lies s sigmas along a. nan where a pose has no projection.
    """
    J = model.project(world_from_body)[1]
    spread = J @ covariance @ np.swapaxes(J, -1, -2)
    out = np.full((len(model), steps, 2), np.nan)
    for i in np.flatnonzero(np.isfinite(spread).all(axis=(1, 2))):
        values, vectors = np.linalg.eigh(spread[i])
        if not values[-1] > 0:
            continue
        direction = covariance @ J[i].T @ vectors[:, -1] / np.sqrt(values[-1])
        moved = world_from_body.plus(np.linspace(-sigmas, sigmas, steps)[:, None] * direction)
        out[i] = model.subset(np.array([i])).project(moved)[0][:, 0]
    return out


def beam_image(rig: Rig, camera: Camera, spot: str, world_from_body: Pose, steps: int = 81) -> Array:
    """The image (steps, 2), px, of the ray of a spot: where the spot would lie if its screen stood nearer or farther.

    The ray is taken from half its length to the nearest of the rig's screens to 1.5 times that to the farthest, with
    even steps of the inverse length, which the picture shows about evenly. nan where there is no projection.
    """
    of = rig.spots[spot]
    beam = rig.beams[of.beam]
    start, along = world_from_body.apply(beam.point), world_from_body.turn(of.sign * beam.direction)
    lengths = []
    for screen in rig.screens.values():
        normal, origin = screen.world_from_screen.rotation[:, 2], screen.world_from_screen.translation
        facing = float(normal @ along)
        length = float(normal @ (origin - start)) / facing if abs(facing) > 1e-9 else -1.0
        if 0 < length < 10 * float(np.linalg.norm(origin - start)):  # a ray along a screen meets it nowhere near
            lengths.append(length)
    if not lengths:
        lengths = [float(np.linalg.norm(s.world_from_screen.translation - start)) for s in rig.screens.values()]
    near, far = max(_NEAREST * min(lengths), 1e-6), max(_FARTHEST * max(lengths), 1e-6)
    samples = 1.0 / np.linspace(1 / near, 1 / far, steps)
    return camera.project(start + samples[:, None] * along)


def scatter(differences: Array) -> Array:
    """Covariance (2, 2), px^2, about zero of differences (n, 2), px, without outliers; nan for fewer than ten.

    Outliers lie farther from zero than 4.5 sigmas of the median absolute deviation of their axis.
    """
    known = differences[np.isfinite(differences).all(axis=1)]
    if len(known) < _FEWEST:
        return np.full((2, 2), np.nan)
    sigma = np.maximum(robust_sigma(known, axis=0), 1e-9)
    near = known[((known / sigma) ** 2 < _OUTLIER2).all(axis=1)]
    if len(near) < _FEWEST:
        return np.full((2, 2), np.nan)
    return near.T @ near / len(near)
