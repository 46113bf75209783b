"""A residual in sigmas, and what a possible change explains of it: evidence, size and significance.

The formulas of calibration/drift.py, which selects the changes. scipy is imported where it is used: the model check of
a run whitens its residuals itself, and the import takes 0.1 s.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from geometry.arrays import Array
from geometry.uncertainty.chi_square import chi2_limit, chi2_tail

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

    kind: str  # TURNED ... LASER_MOVED of calibration/drift.py
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

        Raises:
            ValueError: the covariance is not positive definite.
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
