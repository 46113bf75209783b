"""How well each kind of measurement fits a joint adjustment, and how much of the result's uncertainty it makes.

For a group g of whitened residuals v with Jacobian J and the covariance C of all unknowns, A_g = J^T J is what the
group knows. v spreads as Q = I - J C J^T: its squared length is tr(Q) on average, the group's redundancy, with a
variance of 2 tr(Q^2). Of C itself the group makes C A_g C, and over all groups these sum up to C, the inverse of
the sum of all A_g. Source: Foerstner and Wrobel (2016), Photogrammetric Computer Vision, sections 4.2.4 and 4.6.2;
the test by a scaled chi-square of the same two moments is Satterthwaite's (1946), Biometrics Bulletin 2(6).
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
    """Where each unknown stands in one long vector of errors."""

    at: tuple[At, ...]
    start: Mapping[str, int]  # per stack that has something free
    dof: Mapping[str, int]
    size: int

    @staticmethod
    def of(values: Values, free: Free) -> Unknowns:
        """All unknowns of the stacks of which something is free, the fixed ones among them too."""
        at: list[At] = []
        start, dof, size = {}, {}, 0
        for name, stack in values.items():
            if name in free and np.any(free[name]) and len(stack):
                start[name], dof[name] = size, stack.dof
                size += len(stack) * stack.dof
                at += [(name, i) for i in range(len(stack))]
        return Unknowns(tuple(at), start, dof, size)

    def places(self, stack: str, element: int) -> Ints:
        """Where the numbers of one unknown stand."""
        return self.start[stack] + element * self.dof[stack] + np.arange(self.dof[stack])

    def of_several(self, at: Sequence[At]) -> Ints:
        """Where the numbers of several stand, in order."""
        return np.concatenate([self.places(*a) for a in at])


@dataclass(frozen=True, slots=True)
class GroupFit:
    """One kind of measurement in an adjustment."""

    name: str
    numbers: int  # residuals
    redundancy: float  # how many of them check the others: 0 where they fix what nothing else knows
    chi2: float  # of the whitened residuals
    p: float  # chance of a misfit as large if its sigmas are right; nan where there is next to no redundancy

    @property
    def scale(self) -> float:
        """What its sigmas would have to be multiplied with to fit the residuals; nan: nothing is known."""
        return float(np.sqrt(self.chi2 / self.redundancy)) if self.redundancy > LEAST_REDUNDANCY else float("nan")


LEAST_REDUNDANCY = 2.0  # below it, residuals say nothing about sigmas


def joint_covariance(adjusted: Adjusted, unknowns: Unknowns) -> Array:
    """(size, size); 0 for what was held fixed. AdjustmentError where something is not determined."""
    return adjusted.covariance(unknowns.at)


def jacobian(term: Term, values: Values, unknowns: Unknowns) -> tuple[Array, sparse.csr_array]:
    """Residuals (m,) of a term, and their derivatives (m, size) by the long vector."""
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
    """What some terms know (size, size), the squared length of their residuals, and how many these are."""
    A, chi2, count = np.zeros((unknowns.size, unknowns.size)), 0.0, 0
    for r, J in (jacobian(t, values, unknowns) for t in terms):
        A += (J.T @ J).toarray()
        chi2 += float(r @ r)
        count += int(np.count_nonzero(J.count_nonzero(axis=1)))
    return A, chi2, count


def group_fit(name: str, A: Array, chi2: float, count: int, C: Array) -> GroupFit:
    """How well a group fits, from what it knows and the covariance of all unknowns."""
    AC = A @ C
    redundancy = count - float(np.trace(AC))
    variance = 2 * (count - 2 * float(np.trace(AC)) + float(np.sum(AC * AC.T)))
    if redundancy <= LEAST_REDUNDANCY or variance <= 0:
        return GroupFit(name, count, max(redundancy, 0.0), chi2, float("nan"))
    unit, dof = variance / (2 * redundancy), 2 * redundancy**2 / variance
    return GroupFit(name, count, redundancy, chi2, float(chi2_distribution.sf(chi2 / unit, dof)))


def shares(informations: Mapping[str, Array], C: Array, effect: Array) -> dict[str, Array]:
    """What each group's errors make of the covariance of a result: (k, k) each, in sum effect C effect^T.

    effect (k, size): d(result) / d(unknowns).
    """
    spread = effect @ C
    return {name: spread @ A @ spread.T for name, A in informations.items()}
