"""What has changed since a calibration: the explanation that a misfit of pixels asks for, and how sure it is.

All of it is linear: a misfit r (m,) between pixels measured and pixels foretold, its covariance C (m, m) under "nothing
has changed" (noise of the pixels AND of the calibration), and for each possible change a matrix A (m, k) of what it
does to the pixels. Whether something has changed is told by chi-square tests; what it was by the evidence (MacKay
1992, "Bayesian interpolation", Neural Computation 4) of r ~ N(0, C + A P A^T), P: how large such changes usually are.
Without P, dots on one plane make a lens refocused by 0.3 % a camera that moved by 700 mm AND zoomed (measured: BIC
chose that), as the two look alike there.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cholesky, solve_triangular

from geometry.arrays import Array, skew
from geometry.uncertainty.chi_square import chi2_limit, chi2_tail

TURNED, MOVED, ZOOMED = "turned", "moved and turned", "focus changed"
TURNED_ZOOMED, ALL_CHANGED = "turned and focus changed", "moved, turned and focus changed"
CAMERA_KINDS = (TURNED, MOVED, ZOOMED, TURNED_ZOOMED, ALL_CHANGED)
WRONG_POINT, LASER_MOVED = "point wrong", "laser moved"
_RANK = 1e-6  # of a change's largest effect: what a nuisance leaves below this is rounding, not evidence


@dataclass(frozen=True, slots=True)
class UsualSizes:
    """How large changes are, 1 sigma, that labs meet. They weigh explanations; data outdo them by far when sure."""

    turn_rad: float = float(np.deg2rad(0.1))  # a mount that was knocked or has crept
    move_m: float = 5e-3  # likewise
    zoom: float = 3e-3  # relative: a focus ring touched
    point_px: float = 3.0  # a dot mistaken or moved
    laser_rad: float = 1e-3  # a laser's mount that has crept
    laser_m: float = 1e-3


@dataclass(frozen=True, slots=True)
class ChangeCandidate:
    """What a possible change does to the pixels."""

    columns: Array  # (m, k), px per unit
    size: Array  # (k,), the change's unit: how large it usually is

    def beside(self, other: ChangeCandidate) -> ChangeCandidate:
        """Both at once."""
        both = np.concatenate([self.columns, other.columns], axis=1)
        return ChangeCandidate(both, np.concatenate([self.size, other.size]))


@dataclass(frozen=True, slots=True)
class CameraColumns:
    """What changes of one camera do to m pixel coordinates, px per unit; rows of other cameras are 0."""

    turn: Array  # (m, 3), px/rad: about its own centre, in the camera frame
    move: Array  # (m, 3), px/m: the scene moves by this in the camera frame
    zoom: Array  # (m, 1), px: relative change of the focal length

    @property
    def model(self) -> Array:
        """(m, 4): turn and zoom, a similarity of the picture: what the drift is tested by."""
        return np.concatenate([self.turn, self.zoom], axis=1)

    def kinds(self, sizes: UsualSizes) -> dict[str, ChangeCandidate]:
        """The explanations that a camera can give."""
        turn = ChangeCandidate(self.turn, np.full(3, sizes.turn_rad))
        move = ChangeCandidate(self.move, np.full(3, sizes.move_m))
        zoom = ChangeCandidate(self.zoom, np.full(1, sizes.zoom))
        return {
            TURNED: turn,
            ZOOMED: zoom,
            TURNED_ZOOMED: turn.beside(zoom),
            MOVED: turn.beside(move),
            ALL_CHANGED: turn.beside(move).beside(zoom),
        }


def camera_columns(points_camera: Array, d_point: Array, d_pinhole: Array, focal: Array) -> CameraColumns:
    """The columns of a camera from its derivatives at n points; m = 2 n.

    points_camera (n, 3), m; d_point (n, 2, 3), px/m, of the pixel by that point; d_pinhole (n, 2, 4); focal (2,), px.
    """
    n = len(points_camera)
    turn = d_point @ -skew(points_camera)  # the point moves by phi x p
    zoom = d_pinhole[..., 0] * focal[0] + d_pinhole[..., 1] * focal[1]
    return CameraColumns(turn.reshape(2 * n, 3), d_point.reshape(2 * n, 3), zoom.reshape(2 * n, 1))


@dataclass(frozen=True, slots=True)
class Change:
    """A fitted explanation."""

    kind: str  # TURNED ... LASER_MOVED
    subject: str  # the camera, the point or the laser
    columns: Array  # (m, k)
    delta: Array  # (k,) the most probable size
    covariance: Array  # (k, k) of that: as wide as such changes usually are where the pixels do not tell
    noise: Array  # (k, k) how far it scatters when nothing has changed
    evidence: float  # 2 ln of how much more probable the pixels are with it than without
    explained: float  # chi-square that it takes away
    rank: int  # degrees of freedom that it takes

    @property
    def displacement(self) -> Array:
        """(m,), px: what it did to the pixels."""
        return self.columns @ self.delta

    @property
    def p_value(self) -> float:
        """How probable so good an explanation is when nothing has changed."""
        return chi2_tail(self.explained, self.rank) if self.rank else 1.0


@dataclass(frozen=True, slots=True)
class ExcessResidual:
    """A whitened misfit from which everything that needs no explanation has been projected out."""

    white: Array  # (m,)
    factor: Array  # (m, m), lower Cholesky factor of C
    basis: Array  # (m, q), orthonormal: the whitened nuisances
    dof: int  # m - q
    is_unit: bool = False  # C is 1: columns need no whitening, which is nearly all the work of a fit

    @staticmethod
    def of(residual: Array, covariance: Array, nuisance: Array | None = None) -> ExcessResidual:
        """residual (m,), measured minus foretold, px; covariance (m, m); nuisance (m, k): free, of no interest.

        Raises ValueError where the covariance is not positive definite.
        """
        try:
            factor = cholesky(covariance, lower=True)
        except np.linalg.LinAlgError:
            raise ValueError("the pixels' covariance is not positive definite") from None
        white = solve_triangular(factor, residual, lower=True)
        start = ExcessResidual(white, factor, np.zeros((len(white), 0)), len(white))
        return start if nuisance is None else start.freed(nuisance)

    @staticmethod
    def of_white(residual: Array) -> ExcessResidual:
        """Of a residual (m,) whose errors are independent and of size 1; columns must be whitened in the same way."""
        return ExcessResidual(residual, np.eye(len(residual)), np.zeros((len(residual), 0)), len(residual), True)

    @property
    def chi2(self) -> float:
        """What is left to explain."""
        return float(self.white @ self.white)

    @property
    def p_value(self) -> float:
        """How probable so large a misfit is when nothing has changed."""
        return chi2_tail(self.chi2, self.dof) if self.dof > 0 else 1.0

    def _whitened(self, columns: Array) -> Array:
        return columns if self.is_unit else solve_triangular(self.factor, columns, lower=True)

    def _projected(self, columns: Array) -> Array:
        white = self._whitened(columns)
        return white - self.basis @ (self.basis.T @ white)

    def _basis_of(self, columns: Array) -> Array:
        """Orthonormal basis (m, r) of what columns (m, k) can still do."""
        white = self._whitened(columns)
        # Columns to one scale first: metres, radians and relative focal lengths have nothing to do with each other.
        scale = np.linalg.norm(white, axis=0)
        left = (white - self.basis @ (self.basis.T @ white)) / np.where(scale > 0, scale, 1.0)
        U, s, _ = np.linalg.svd(left, full_matrices=False)
        return U[:, s > _RANK]

    def freed(self, columns: Array) -> ExcessResidual:
        """With these changes free: the misfit that they cannot explain."""
        U = self._basis_of(columns)
        white = self.white - U @ (U.T @ self.white)
        basis = np.concatenate([self.basis, U], axis=1)
        return replace(self, white=white, basis=basis, dof=self.dof - U.shape[1])

    def without(self, changes: Iterable[Change]) -> ExcessResidual:
        """With all these changes free."""
        out = self
        for change in changes:
            out = out.freed(change.columns)
        return out

    def fit(self, kind: str, subject: str, candidate: ChangeCandidate) -> Change:
        """How well a change explains the misfit."""
        U = self._basis_of(candidate.columns)
        explained = float(np.sum((U.T @ self.white) ** 2))
        V, s, W = np.linalg.svd(self._projected(candidate.columns) * candidate.size, full_matrices=False)
        along, W = V.T @ self.white, W * candidate.size  # rows: what one usual size along this way is
        shrunk = s / (1 + s**2)
        unseen = np.diag(candidate.size**2) - W.T @ W  # 0 unless there are more changes than pixels
        return Change(
            kind=kind,
            subject=subject,
            columns=candidate.columns,
            delta=W.T @ (shrunk * along),
            covariance=(W.T / (1 + s**2)) @ W + unseen,
            noise=(W.T * shrunk**2) @ W,
            evidence=float(np.sum(along**2 * s * shrunk) - np.sum(np.log1p(s**2))),
            explained=explained,
            rank=U.shape[1],
        )

    def p_value_of(self, columns: Array) -> float:
        """How probable so much in the ways of these columns is when nothing has changed."""
        U = self._basis_of(columns)
        return chi2_tail(float(np.sum((U.T @ self.white) ** 2)), U.shape[1]) if U.shape[1] else 1.0

    def detectable(self, directions: Array, columns: Array, p_false_alarm: float, power: float) -> float:
        """The length, px, of the least visible of some displacements that a test of `columns` finds with this power.

        directions (m, d): displacements of length 1. inf where one cannot be seen at all.
        """
        U = self._basis_of(columns)
        if not U.shape[1]:
            return float("inf")
        seen = U.T @ self._projected(directions)
        weakest = float(np.linalg.eigvalsh(seen.T @ seen)[0])
        if weakest <= 0:
            return float("inf")
        return float(np.sqrt(_noncentrality(U.shape[1], p_false_alarm, power) / weakest))


def _noncentrality(dof: int, p_false_alarm: float, power: float) -> float:
    """Lambda at which a chi-square test of this size finds a change with this power."""
    from scipy.optimize import brentq  # 0.3 s to import: a run without a fault does not ask
    from scipy.special import chndtr

    limit = chi2_limit(p_false_alarm, dof)
    return float(brentq(lambda x: 1 - chndtr(limit, dof, x) - power, 1e-6, 10 * limit + 200))


@dataclass(frozen=True, slots=True)
class Verdicts:
    """What was found to have changed, and the tests behind it."""

    changes: tuple[Change, ...]  # in the order of their weight
    left: ExcessResidual  # what they leave
    p_values: Mapping[str, float]  # per camera, of the first test: before anything was explained
    p_rest: float  # of the first test of what no camera explains
    unexplained: bool  # what is left is still significant


def find_changes(
    misfit: ExcessResidual,
    cameras: Mapping[str, CameraColumns],
    others: Mapping[tuple[str, str], ChangeCandidate],
    p_false_alarm: float,
    sizes: UsualSizes | None = None,
) -> Verdicts:
    """What has changed, one thing after another, the best explanation first.

    others: what else may have changed, by kind and subject: one point that is wrong (WRONG_POINT,
    its name), one laser (LASER_MOVED, its name). p_false_alarm: that anything at all is found when nothing has
    changed. Half of it is spent on the cameras, evenly; half on what no camera explains. Where nothing is
    significant nothing is explained.
    """
    sizes = sizes or UsualSizes()
    each = p_false_alarm / 2 / max(len(cameras), 1)

    def tests(left: ExcessResidual, names: list[str]) -> tuple[dict[str, float], float]:
        models = [cameras[n].model for n in names]
        rest = left.freed(np.concatenate(models, axis=1)) if models else left
        return {n: left.p_value_of(cameras[n].model) for n in names}, rest.p_value

    p_values, p_rest = tests(misfit, list(cameras))
    # No more wrong points than a third of all: then nothing is known any more.
    most = max(1, len(cameras) + len(misfit.white) // 6)
    changes: list[Change] = []
    while True:
        left = misfit.without(changes)
        taken = {c.subject for c in changes if c.kind in CAMERA_KINDS}
        of_cameras, of_rest = tests(left, [n for n in cameras if n not in taken])
        significant = min(of_cameras.values(), default=1.0) < each or of_rest < p_false_alarm / 2
        more = _best(misfit, changes, cameras, others, sizes) if significant and len(changes) < most else None
        if more is None:
            return Verdicts(tuple(changes), left, p_values, p_rest, significant)
        changes = _chosen_anew(misfit, [*changes, more], cameras, others, sizes)


def _chosen_anew(
    misfit: ExcessResidual,
    changes: list[Change],
    cameras: Mapping[str, CameraColumns],
    others: Mapping[tuple[str, str], ChangeCandidate],
    sizes: UsualSizes,
) -> list[Change]:
    """Each change chosen and fitted again with the others free: the first was picked while they were not known.

    A camera that turned while one dot was wrong looks like one that moved; with the dot free it does not.
    """
    for _ in range(3):
        before = [(c.kind, c.subject) for c in changes]
        for i in range(len(changes)):
            apart = changes[:i] + changes[i + 1 :]
            best = _best(misfit, apart, cameras, others, sizes)
            if best is not None:
                changes = [*changes[:i], best, *changes[i + 1 :]]
        if before == [(c.kind, c.subject) for c in changes]:
            break
    return changes


def _best(
    misfit: ExcessResidual,
    known: list[Change],
    cameras: Mapping[str, CameraColumns],
    others: Mapping[tuple[str, str], ChangeCandidate],
    sizes: UsualSizes,
) -> Change | None:
    """The most probable explanation of what the known changes leave; None where none is better than none.

    A kind counts as one however many may be its subject: of n points each is an n-th as probable.
    """
    left = misfit.without(known)
    taken = {c.subject if c.kind in CAMERA_KINDS else (c.kind, c.subject) for c in known}
    weighed: list[tuple[float, Change]] = []
    for name, columns in cameras.items():
        if name in taken:
            continue
        for kind, candidate in columns.kinds(sizes).items():
            change = left.fit(kind, name, candidate)
            weighed.append((change.evidence - 2 * np.log(len(cameras)), change))
    for (kind, name), candidate in others.items():
        if (kind, name) in taken:
            continue
        alike = sum(k == kind for k, _ in others)
        change = left.fit(kind, name, candidate)
        weighed.append((change.evidence - 2 * np.log(alike), change))
    weight, best = max(weighed, key=lambda w: w[0], default=(0.0, None))
    return best if weight > 0 else None


def rms_length(displacement: Array) -> float:
    """Root mean square length, px, of displacements (2 n,) given as u, v, u, v ..."""
    return (
        float(np.sqrt(np.mean(np.sum(displacement.reshape(-1, 2) ** 2, axis=1)))) if len(displacement) else float("nan")
    )


def expected_rms(columns: Array, covariance: Array) -> float:
    """The RMS length, px, that an estimated displacement (columns (2n, k)) has by its noise alone."""
    spread = np.einsum("ij,jk,ik->i", columns, covariance, columns)
    return float(np.sqrt(2 * np.mean(spread))) if len(columns) else float("nan")
