"""Consistency of each kind of measurement in a joint adjustment, and its share of the result's uncertainty.

For a group g of whitened residuals v with Jacobian J and the covariance C of all unknowns, A_g = J^T J is the group's
normal matrix. v has the covariance Q = I - J C J^T: its squared length is tr(Q) on average, the group's redundancy,
with a variance of 2 tr(Q^2). The group contributes C A_g C to C, and the sum of these over all groups is C, the inverse
of the sum of all A_g. Source: Foerstner and Wrobel (2016), Photogrammetric Computer Vision, sections 4.2.4 and 4.6.2;
the test by a scaled chi-square with the same two moments is Satterthwaite's (1946), Biometrics Bulletin 2(6).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.stats import chi2 as chi2_distribution

from calibration.least_squares.adjustment import Adjusted, At, Free, Term, Values
from geometry.arrays import Array, Ints


@dataclass(frozen=True, slots=True)
class Unknowns:
    """Positions of the unknowns in one long vector."""

    at: tuple[At, ...]
    start: Mapping[str, int]  # per block with free parameters
    dof: Mapping[str, int]
    size: int

    @staticmethod
    def of(values: Values, free: Free) -> Unknowns:
        """All unknowns of the blocks with free parameters, including their fixed ones."""
        at: list[At] = []
        start, dof, size = {}, {}, 0
        for name, stack in values.items():
            if name in free and np.any(free[name]) and len(stack):
                start[name], dof[name] = size, stack.dof
                size += len(stack) * stack.dof
                at += [(name, i) for i in range(len(stack))]
        return Unknowns(tuple(at), start, dof, size)

    def places(self, stack: str, element: int) -> Ints:
        """Positions of the parameters of one unknown."""
        return self.start[stack] + element * self.dof[stack] + np.arange(self.dof[stack])

    def of_several(self, at: Sequence[At]) -> Ints:
        """Positions of the parameters of several unknowns, in order."""
        return np.concatenate([self.places(*a) for a in at])


@dataclass(frozen=True, slots=True)
class GroupFit:
    """Consistency of one kind of measurement with an adjustment."""

    name: str
    numbers: int  # of residuals
    redundancy: float  # 0 if the kind alone determines some parameters and checks nothing else
    chi2: float  # of the whitened residuals
    p: float  # p-value of chi2 if its sigmas are right; nan without enough redundancy

    @property
    def scale(self) -> float:
        """Factor on its sigmas that explains the residuals; nan without enough redundancy."""
        return float(np.sqrt(self.chi2 / self.redundancy)) if self.redundancy > LEAST_REDUNDANCY else float("nan")


LEAST_REDUNDANCY = 2.0  # below it, residuals do not determine sigmas


def joint_covariance(adjusted: Adjusted, unknowns: Unknowns) -> Array:
    """(size, size); 0 for fixed parameters. Raises AdjustmentError if something is undetermined."""
    return adjusted.covariance(unknowns.at)


def jacobian(term: Term, values: Values, unknowns: Unknowns) -> tuple[Array, sparse.csr_array]:
    """Residuals (m,) of a term, and their derivatives (m, size) by all unknowns."""
    line = term.linearise(values)
    n, d = line.residuals.shape
    rows, columns, entries = [], [], []
    for part in line.parts:
        if part.stack not in unknowns.start:
            continue
        dof = part.jacobian.shape[2]
        row = (np.arange(n)[:, None] * d + np.arange(d))[:, :, None]
        column = unknowns.start[part.stack] + part.index[:, None, None] * dof + np.arange(dof)
        rows.append(np.broadcast_to(row, part.jacobian.shape).ravel())
        columns.append(np.broadcast_to(column, part.jacobian.shape).ravel())
        entries.append(part.jacobian.ravel())
    if not rows:
        return line.residuals.ravel(), sparse.csr_array((n * d, unknowns.size))
    index = (np.concatenate(rows), np.concatenate(columns))
    return line.residuals.ravel(), sparse.csr_array(
        sparse.coo_array((np.concatenate(entries), index), shape=(n * d, unknowns.size))
    )


def information(terms: Sequence[Term], values: Values, unknowns: Unknowns) -> tuple[Array, float, int]:
    """Normal matrix (size, size) of some terms, the squared length of their residuals, and the number of residuals."""
    A, chi2, count = np.zeros((unknowns.size, unknowns.size)), 0.0, 0
    for r, J in (jacobian(t, values, unknowns) for t in terms):
        A += (J.T @ J).toarray()
        chi2 += float(r @ r)
        count += int(np.count_nonzero(J.count_nonzero(axis=1)))
    return A, chi2, count


def group_fit(name: str, A: Array, chi2: float, count: int, C: Array) -> GroupFit:
    """Consistency of a group, from its normal matrix and the covariance of all unknowns."""
    AC = A @ C
    redundancy = count - float(np.trace(AC))
    variance = 2 * (count - 2 * float(np.trace(AC)) + float(np.sum(AC * AC.T)))
    if redundancy <= LEAST_REDUNDANCY or variance <= 0:
        return GroupFit(name, count, max(redundancy, 0.0), chi2, float("nan"))
    unit, dof = variance / (2 * redundancy), 2 * redundancy**2 / variance
    return GroupFit(name, count, redundancy, chi2, float(chi2_distribution.sf(chi2 / unit, dof)))


def shares(informations: Mapping[str, Array], C: Array, effect: Array) -> dict[str, Array]:
    """Share of each group in the covariance of a result: (k, k) each, with the sum effect C effect^T.

    effect (k, size): d(result) / d(unknowns).
    """
    spread = effect @ C
    return {name: spread @ A @ spread.T for name, A in informations.items()}
