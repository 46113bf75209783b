"""Changes since a calibration: the most probable explanation of pixel residuals, and its significance.

Everything is linear: the residual r (m,) between measured and predicted pixels, its covariance C (m, m) under the
hypothesis that nothing has changed (noise of the pixels and of the calibration), and for each possible change the
derivatives A (m, k) of the pixels. Chi-square tests decide whether something has changed. The evidence (MacKay 1992,
"Bayesian interpolation", Neural Computation 4) of r ~ N(0, C + A P A^T) decides what it was; P is the prior covariance
of the sizes of such changes. P is necessary: with dots on one plane, a lens refocused by 0.3 % and a camera that moved
by 700 mm AND zoomed have almost the same effect, and BIC, which has no P, chose the latter (measured).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from geometry.arrays import Array, skew
from geometry.uncertainty.chi_square import chi2_limit, chi2_tail

# What a possible change explains of a residual. scipy is imported where it is used: the model check of a run whitens
# its residuals itself, and the import takes 0.1 s.

_RANK = 1e-6  # relative size below which a projected column is rounding


@dataclass(frozen=True, slots=True)
class ChangeCandidate:
    """A possible change: the derivatives of the pixels by its k parameters, and their prior sigmas."""

    columns: Array  # (m, k), px per unit
    size: Array  # (k,), prior sigmas

    def combined_with(self, other: ChangeCandidate) -> ChangeCandidate:
        """Both changes together."""
        both = np.concatenate([self.columns, other.columns], axis=1)
        return ChangeCandidate(both, np.concatenate([self.size, other.size]))


@dataclass(frozen=True, slots=True)
class Change:
    """A change fitted to the residuals."""

    kind: str  # TURNED ... LASER_MOVED of calibration/changes.py
    subject: str  # name of the camera, point or laser
    columns: Array  # (m, k) derivatives of the pixels
    delta: Array  # (k,) most probable size
    covariance: Array  # (k, k) posterior covariance of delta; the prior one where the pixels do not observe it
    noise: Array  # (k, k) covariance of delta when nothing has changed
    evidence: float  # 2 ln of the ratio of the residuals' probabilities with and without this change
    explained: float  # reduction of chi-square
    rank: int  # degrees of freedom of that reduction

    @property
    def displacement(self) -> Array:
        """The effect (m,), px, of the change on the pixels."""
        return self.columns @ self.delta

    @property
    def p_value(self) -> float:
        """Probability of at least this reduction of chi-square when nothing has changed."""
        return chi2_tail(self.explained, self.rank) if self.rank else 1.0


@dataclass(frozen=True, slots=True)
class ExcessResidual:
    """A whitened residual, with the effects of free (nuisance) parameters projected out."""

    white: Array  # (m,) in sigmas
    factor: Array  # (m, m), lower Cholesky factor of C
    basis: Array  # (m, q), orthonormal: the whitened effects of the free parameters
    dof: int  # m - q
    is_unit: bool = False  # C is the identity: columns need no whitening, which is nearly all the work of a fit

    @staticmethod
    def of(residual: Array, covariance: Array, nuisance: Array | None = None) -> ExcessResidual:
        """From a residual (m,), measured minus predicted, px, its covariance (m, m) and nuisance columns (m, k).

        Raises ValueError: the covariance is not positive definite.
        """
        from scipy.linalg import cholesky

        try:
            factor = cholesky(covariance, lower=True)
        except np.linalg.LinAlgError:
            raise ValueError("the pixels' covariance is not positive definite") from None
        white = _solved(factor, residual)
        start = ExcessResidual(white, factor, np.zeros((len(white), 0)), len(white))
        return start if nuisance is None else start.with_free(nuisance)

    @staticmethod
    def of_white(residual: Array) -> ExcessResidual:
        """From a residual (m,) with independent errors of sigma 1; all columns must be whitened in the same way."""
        return ExcessResidual(residual, np.eye(len(residual)), np.zeros((len(residual), 0)), len(residual), True)

    @property
    def chi2(self) -> float:
        """Chi-square of the residual."""
        return float(self.white @ self.white)

    @property
    def p_value(self) -> float:
        """Probability of at least this chi-square when nothing has changed."""
        return chi2_tail(self.chi2, self.dof) if self.dof > 0 else 1.0

    def _whitened(self, columns: Array) -> Array:
        return columns if self.is_unit else _solved(self.factor, columns)

    def _projected(self, columns: Array) -> Array:
        white = self._whitened(columns)
        return white - self.basis @ (self.basis.T @ white)

    def _basis_of(self, columns: Array) -> Array:
        """Orthonormal basis (m, r) of the effects of columns (m, k) that the free parameters do not cover."""
        white = self._whitened(columns)
        # The columns are scaled to unit length first, since they have different units.
        scale = np.linalg.norm(white, axis=0)
        left = (white - self.basis @ (self.basis.T @ white)) / np.where(scale > 0, scale, 1.0)
        U, s, _ = np.linalg.svd(left, full_matrices=False)
        return U[:, s > _RANK]

    def with_free(self, columns: Array) -> ExcessResidual:
        """The residual that remains if the parameters of these columns (m, k) are free too."""
        U = self._basis_of(columns)
        white = self.white - U @ (U.T @ self.white)
        basis = np.concatenate([self.basis, U], axis=1)
        return replace(self, white=white, basis=basis, dof=self.dof - U.shape[1])

    def without(self, changes: Iterable[Change]) -> ExcessResidual:
        """The residual that remains if all these changes are free."""
        out = self
        for change in changes:
            out = out.with_free(change.columns)
        return out

    def fit(self, kind: str, subject: str, candidate: ChangeCandidate) -> Change:
        """The fit of a possible change to the residual."""
        U = self._basis_of(candidate.columns)
        explained = float(np.sum((U.T @ self.white) ** 2))
        V, s, W = np.linalg.svd(self._projected(candidate.columns) * candidate.size, full_matrices=False)
        along, W = V.T @ self.white, W * candidate.size  # rows of W: one prior sigma along each singular direction
        shrunk = s / (1 + s**2)
        unobserved = np.diag(candidate.size**2) - W.T @ W  # 0 unless there are more parameters than pixels
        return Change(
            kind=kind,
            subject=subject,
            columns=candidate.columns,
            delta=W.T @ (shrunk * along),
            covariance=(W.T / (1 + s**2)) @ W + unobserved,
            noise=(W.T * shrunk**2) @ W,
            evidence=float(np.sum(along**2 * s * shrunk) - np.sum(np.log1p(s**2))),
            explained=explained,
            rank=U.shape[1],
        )

    def p_value_of(self, columns: Array) -> float:
        """Probability of at least this chi-square in the space of these columns when nothing has changed."""
        U = self._basis_of(columns)
        return chi2_tail(float(np.sum((U.T @ self.white) ** 2)), U.shape[1]) if U.shape[1] else 1.0

    def detectable(self, directions: Array, columns: Array, p_false_alarm: float, power: float) -> float:
        """The smallest length, px, at which a test of `columns` detects every displacement in a space with this power.

        directions (m, d): displacements of length 1 that span the space. inf if one of them has no effect.
        """
        U = self._basis_of(columns)
        if not U.shape[1]:
            return float("inf")
        observed = U.T @ self._projected(directions)
        weakest = float(np.linalg.eigvalsh(observed.T @ observed)[0])
        if weakest <= 0:
            return float("inf")
        return float(np.sqrt(_noncentrality(U.shape[1], p_false_alarm, power) / weakest))


def _solved(factor: Array, columns: Array) -> Array:
    from scipy.linalg import solve_triangular

    return np.asarray(solve_triangular(factor, columns, lower=True))


def _noncentrality(dof: int, p_false_alarm: float, power: float) -> float:
    """Noncentrality at which a chi-square test with this false alarm probability detects a change with this power."""
    from scipy.optimize import brentq  # imported here because the import takes 0.3 s
    from scipy.special import chndtr

    limit = chi2_limit(p_false_alarm, dof)
    return float(brentq(lambda x: 1 - chndtr(limit, dof, x) - power, 1e-6, 10 * limit + 200))


TURNED, MOVED, ZOOMED = "turned", "moved and turned", "focus changed"
TURNED_ZOOMED, ALL_CHANGED = "turned and focus changed", "moved, turned and focus changed"
CAMERA_KINDS = (TURNED, MOVED, ZOOMED, TURNED_ZOOMED, ALL_CHANGED)
WRONG_POINT, LASER_MOVED = "point wrong", "laser moved"


@dataclass(frozen=True, slots=True)
class PriorSizes:
    """Prior sigmas of the changes that occur in laboratories. They decide between equally good fits."""

    turn_rad: float = float(np.deg2rad(0.1))  # rotation of a camera whose mount was knocked or has crept
    move_m: float = 5e-3  # shift of such a camera
    zoom: float = 3e-3  # relative change of the focal length after a touch of the focus ring
    point_px: float = 3.0  # error of a dot that was moved or mistaken for another one
    laser_rad: float = 1e-3  # rotation of a laser whose mount has crept
    laser_m: float = 1e-3  # shift of such a laser


USUAL_SIZES = PriorSizes()


@dataclass(frozen=True, slots=True)
class CameraColumns:
    """Derivatives of m pixel coordinates by changes of one camera, px per unit; 0 for those of other cameras."""

    turn: Array  # (m, 3), px/rad: rotation about the camera's centre, in the camera frame
    move: Array  # (m, 3), px/m: shift of the scene in the camera frame
    zoom: Array  # (m, 1), px: relative change of the focal length

    @property
    def model(self) -> Array:
        """The columns (m, 4) that the test for drift uses: turn and zoom, a similarity of the picture."""
        return np.concatenate([self.turn, self.zoom], axis=1)

    def kinds(self) -> dict[str, ChangeCandidate]:
        """The possible changes of a camera, by kind."""
        turn = ChangeCandidate(self.turn, np.full(3, USUAL_SIZES.turn_rad))
        move = ChangeCandidate(self.move, np.full(3, USUAL_SIZES.move_m))
        zoom = ChangeCandidate(self.zoom, np.full(1, USUAL_SIZES.zoom))
        return {
            TURNED: turn,
            ZOOMED: zoom,
            TURNED_ZOOMED: turn.combined_with(zoom),
            MOVED: turn.combined_with(move),
            ALL_CHANGED: turn.combined_with(move).combined_with(zoom),
        }


def camera_columns(points_camera: Array, d_point: Array, d_pinhole: Array, focal: Array) -> CameraColumns:
    """The columns of a camera from its derivatives at n points; m = 2 n.

    points_camera (n, 3), m, in the camera frame; d_point (n, 2, 3), px/m, and d_pinhole (n, 2, 4): derivatives of the
    pixel by the point and by fx, fy, cx, cy; focal (2,), px.
    """
    n = len(points_camera)
    turn = d_point @ -skew(points_camera)  # a rotation by phi moves the point p by phi x p
    zoom = d_pinhole[..., 0] * focal[0] + d_pinhole[..., 1] * focal[1]
    return CameraColumns(turn.reshape(2 * n, 3), d_point.reshape(2 * n, 3), zoom.reshape(2 * n, 1))


@dataclass(frozen=True, slots=True)
class FoundChanges:
    """The changes that were found, and what they leave."""

    changes: tuple[Change, ...]  # in the order in which they were found
    left: ExcessResidual  # residual that they leave
    unexplained: bool  # whether `left` is still significant


def find_changes(
    misfit: ExcessResidual,
    cameras: Mapping[str, CameraColumns],
    others: Mapping[tuple[str, str], ChangeCandidate],
    p_false_alarm: float,
) -> FoundChanges:
    """The changes that explain a residual, added one by one, the most probable first.

    others: other possible changes, by kind and subject: one wrong point (WRONG_POINT, its name), one laser
    (LASER_MOVED, its name). p_false_alarm: probability that any change is found when nothing has changed. Half of it
    is divided evenly among the cameras, half goes to the residual that no camera explains. Changes are added only while
    a test is significant.
    """
    each = p_false_alarm / 2 / max(len(cameras), 1)

    def tests(left: ExcessResidual, names: list[str]) -> tuple[dict[str, float], float]:
        models = [cameras[n].model for n in names]
        rest = left.with_free(np.concatenate(models, axis=1)) if models else left
        return {n: left.p_value_of(cameras[n].model) for n in names}, rest.p_value

    # With more wrong points than a third of all, nothing can be concluded.
    max_changes = max(1, len(cameras) + len(misfit.white) // 6)
    changes: list[Change] = []
    while True:
        left = misfit.without(changes)
        taken = {c.subject for c in changes if c.kind in CAMERA_KINDS}
        of_cameras, of_rest = tests(left, [n for n in cameras if n not in taken])
        significant = min(of_cameras.values(), default=1.0) < each or of_rest < p_false_alarm / 2
        more = _best(misfit, changes, cameras, others) if significant and len(changes) < max_changes else None
        if more is None:
            return FoundChanges(tuple(changes), left, significant)
        changes = _reselected(misfit, [*changes, more], cameras, others)


def _reselected(
    misfit: ExcessResidual,
    changes: list[Change],
    cameras: Mapping[str, CameraColumns],
    others: Mapping[tuple[str, str], ChangeCandidate],
) -> list[Change]:
    """The changes, each selected and fitted again with the others free: the first was selected without the others.

    For instance, a camera that turned while one dot was wrong is mistaken for one that moved until the dot is free.
    """
    for _ in range(3):
        before = [(c.kind, c.subject) for c in changes]
        for i in range(len(changes)):
            best = _best(misfit, changes[:i] + changes[i + 1 :], cameras, others)
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
) -> Change | None:
    """The most probable change beside the known ones; None if no further change is more probable.

    All kinds have the same prior probability, divided evenly among their subjects: each of n points has 1 / n of it.
    """
    left = misfit.without(known)
    taken = {c.subject if c.kind in CAMERA_KINDS else (c.kind, c.subject) for c in known}
    scored: list[tuple[float, Change]] = []
    for name, columns in cameras.items():
        if name in taken:
            continue
        for kind, candidate in columns.kinds().items():
            change = left.fit(kind, name, candidate)
            scored.append((change.evidence - 2 * np.log(len(cameras)), change))
    for (kind, name), candidate in others.items():
        if (kind, name) in taken:
            continue
        subjects = sum(k == kind for k, _ in others)
        change = left.fit(kind, name, candidate)
        scored.append((change.evidence - 2 * np.log(subjects), change))
    score, best = max(scored, key=lambda s: s[0], default=(0.0, None))
    return best if score > 0 else None


def rms_length(displacement: Array) -> float:
    """Root mean square length, px, of n displacements (2 n,), ordered u, v, u, v ...; nan for none."""
    return (
        float(np.sqrt(np.mean(np.sum(displacement.reshape(-1, 2) ** 2, axis=1)))) if len(displacement) else float("nan")
    )


def expected_rms(columns: Array, covariance: Array) -> float:
    """The RMS length, px, of a displacement due to noise alone: columns (2n, k), covariance (k, k); nan for none."""

    spread = np.einsum("ij,jk,ik->i", columns, covariance, columns)
    return float(np.sqrt(2 * np.mean(spread))) if len(columns) else float("nan")
