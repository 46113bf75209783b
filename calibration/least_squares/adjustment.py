"""Sparse least squares over a calibration's unknowns: the one engine of all its steps, single and joint.

Terms of the cost give whitened residuals and their derivatives by the unknowns that they touch; the engine does
Levenberg-Marquardt steps on the normal equations, weighs outliers down where a term asks for it, and answers with
covariances of any of the unknowns. Ours; the normal equations are kept sparse as in Triggs et al. (2000), "Bundle
adjustment: a modern synthesis", section 6.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy import sparse
from scipy.linalg import block_diag
from scipy.sparse.linalg import SuperLU, splu

from calibration.least_squares.parameter_blocks import Stack
from geometry.arrays import Array, Bools, Ints

Values = Mapping[str, Stack]
Free = Mapping[str, bool | Bools]  # per stack: which numbers (k, dof) may move, True for all; not named: none
At = tuple[str, int]  # a stack's name and which of its unknowns
# Per stack: steps are taken in other coordinates, error = basis @ coordinates, (dof, dof). Numbers that nearly do the
# same (the k1 and k4 of a lens) make normal equations that rounding alone makes singular; a basis in which they do not
# keeps all digits. Fixed numbers are coordinates of their own.
Basis = Mapping[str, Array]


@dataclass(frozen=True, slots=True)
class Part:
    """What one stack's unknowns do to the residuals of a term."""

    stack: str
    index: Ints  # (N,): which unknown each of the N residuals depends on
    jacobian: Array  # (N, d, dof), whitened like the residuals


@dataclass(frozen=True, slots=True)
class Linearised:
    """N residuals of d numbers each, in sigmas, and their derivatives."""

    residuals: Array  # (N, d)
    parts: Sequence[Part]


class Loss(Protocol):
    """How much a residual counts, from its squared length s (N,) in sigmas."""

    def cost(self, s: Array) -> Array:
        """(N,), s itself for small ones."""

    def weight(self, s: Array) -> Array:
        """(N,): d(cost)/ds."""


@dataclass(frozen=True, slots=True)
class Cauchy:
    """log(1 + s / c^2) c^2: outliers fade and hardly pull."""

    scale: float = 3.0  # sigmas at which a residual counts half

    def cost(self, s: Array) -> Array:
        return np.log1p(s / self.scale**2) * self.scale**2

    def weight(self, s: Array) -> Array:
        return 1.0 / (1.0 + s / self.scale**2)


class Term(Protocol):
    """One kind of measurement or knowledge."""

    @property
    def loss(self) -> Loss | None:
        """None where no outliers are expected."""

    def linearise(self, values: Values) -> Linearised:
        """Residuals and derivatives at these values; nan residuals count as unusable and end the solve."""


@dataclass(frozen=True, slots=True)
class Limits:
    """When an adjustment ends."""

    steps: int = 60
    small_step_sigmas: float = 1e-3  # the last step moved all unknowns together by less than this many sigmas


class AdjustmentError(ValueError):
    """An adjustment that does not settle, or does not determine what it was asked for."""


@dataclass(frozen=True, slots=True)
class Adjusted:
    """Where an adjustment ended, and the normal equations there."""

    values: Values
    residuals: tuple[Array, ...]  # per term (N, d), in sigmas, not weighed down
    weights: tuple[Array, ...]  # per term (N,), 1 where the loss left the residual alone
    chi2: float  # sum of the squared residuals, weighed
    dof: int  # residual numbers less free unknowns
    _columns: _Columns
    _normal: sparse.csc_array

    def is_free(self, stack: str) -> Bools:
        """Which numbers (k, dof) of a stack could move."""
        free: Bools = self._columns.column[stack] >= 0
        return free

    def covariance(self, at: Sequence[At]) -> Array:
        """Joint covariance (p, p) of the errors of some unknowns, stacked in order; 0 for what was held fixed.

        Everything else that was free is accounted for. AdjustmentError where the data leave a direction undetermined.
        """
        columns = np.concatenate([self._columns.of(*a) for a in at])
        free = columns >= 0
        out = np.zeros((len(columns), len(columns)))
        if free.any():
            # Scaled to a unit diagonal, pivots tell how nearly singular the equations are, whatever the units.
            scale = 1.0 / np.sqrt(np.maximum(self._normal.diagonal(), 1e-300))
            factor = _factor(_scaled(self._normal, scale))
            if factor is None or np.min(np.abs(factor.U.diagonal())) < 1e-11:
                raise AdjustmentError("the data leave some direction of the unknowns undetermined")
            picked = columns[free]
            rhs = np.zeros((self._normal.shape[0], len(picked)))
            rhs[picked, np.arange(len(picked))] = scale[picked]
            block = (factor.solve(rhs) * scale[:, None])[picked]
            out[np.ix_(free, free)] = (block + block.T) / 2
        if any(stack in self._columns.basis for stack, _ in at):
            M = block_diag(*[self._columns.basis_of(a[0]) for a in at])
            out = M @ out @ M.T
        return out

    def reduced_normal(self, keep: Sequence[At]) -> Array:
        """The information (p, p) on some unknowns once all the other free ones are solved for (Schur complement).

        Rows of fixed numbers are 0. The others must be determined when the kept ones are known. Not for stacks that
        were solved in another basis: ValueError.
        """
        if any(stack in self._columns.basis for stack, _ in keep):
            raise ValueError("expected stacks solved in their own numbers, got one with another basis")
        columns = np.concatenate([self._columns.of(*a) for a in keep])
        free = columns >= 0
        kept = columns[free]
        rest = np.setdiff1d(np.arange(self._normal.shape[0]), kept)
        H = self._normal.tocsr()
        S = H[kept][:, kept].toarray()
        if len(rest):
            factor = _factor(H[rest][:, rest].tocsc())
            if factor is None:
                raise AdjustmentError("the other unknowns are not determined even when the kept ones are known")
            across = H[rest][:, kept].toarray()
            S = S - across.T @ factor.solve(across)
        out = np.zeros((len(columns), len(columns)))
        out[np.ix_(free, free)] = (S + S.T) / 2
        return out

    def undetermined(self, keep: Sequence[At], threshold: float = 1e-9) -> Array:
        """Directions (m, p) in the errors of the kept unknowns that the data do not determine; m = 0 where all are.

        threshold: of the information left along a direction, against that of its numbers one by one.
        """
        S = self.reduced_normal(keep)
        columns = np.concatenate([self._columns.of(*a) for a in keep])
        used = columns >= 0
        alone = np.sqrt(np.maximum(self._normal.diagonal()[columns[used]], 1e-300))
        scaled = S[np.ix_(used, used)] / np.outer(alone, alone)
        eigenvalues, vectors = np.linalg.eigh(scaled)
        out = np.zeros((int(np.sum(eigenvalues < threshold)), len(columns)))
        out[:, used] = (vectors[:, eigenvalues < threshold] / alone[:, None]).T
        return out


def solve(
    values: Values, terms: Sequence[Term], free: Free, limits: Limits = Limits(), basis: Basis | None = None
) -> Adjusted:
    """The values that make the terms' residuals smallest.

    Start values must be near enough for Newton steps. Raises AdjustmentError where the residuals are not finite at the
    start or the steps do not settle. Directions that nothing determines stay where they started.
    """
    columns = _Columns.of_free(values, free, basis or {})
    lines = [t.linearise(values) for t in terms]
    if not all(np.isfinite(line.residuals).all() for line in lines):
        raise AdjustmentError("some measurement cannot be predicted from the start values")
    cost = _cost(terms, lines)
    damping = 1e-4
    for _ in range(limits.steps):
        H, g = _normal_equations(terms, lines, columns)
        while True:
            delta = _damped_step(H, g, damping)
            moved = columns.moved(values, delta)
            new_lines = [t.linearise(moved) for t in terms]
            finite = all(np.isfinite(line.residuals).all() for line in new_lines)
            new_cost = _cost(terms, new_lines) if finite else np.inf
            # Rounding of the cost hides gains near the end, so a step this small is taken for one that is none.
            size = float(np.sqrt(max(delta @ (H @ delta), 0.0)))
            if new_cost <= cost or size < limits.small_step_sigmas:
                break
            damping *= 10
            if damping > 1e12:
                raise AdjustmentError("no step makes the residuals smaller")
        if new_cost <= cost:
            values, lines, cost = moved, new_lines, new_cost
        damping = max(damping * 0.1, 1e-12)
        if size < limits.small_step_sigmas:
            break
    else:
        raise AdjustmentError(f"not settled after {limits.steps} steps: the last one still moved {size:.2g} sigmas")
    H, _ = _normal_equations(terms, lines, columns)
    weights = tuple(_weights(t, line) for t, line in zip(terms, lines, strict=True))
    chi2 = sum(float(np.sum(w[:, None] * line.residuals**2)) for w, line in zip(weights, lines, strict=True))
    count = sum(line.residuals.size for line in lines)
    residuals = tuple(line.residuals for line in lines)
    return Adjusted(values, residuals, weights, chi2, count - columns.count, columns, H)


@dataclass(frozen=True, slots=True)
class _Columns:
    """Which column of the normal equations each number has; -1 for the fixed ones."""

    column: Mapping[str, Ints]  # per stack (k, dof)
    count: int
    basis: Basis

    @staticmethod
    def of_free(values: Values, free: Free, basis: Basis) -> _Columns:
        unknown = set(free) - set(values)
        if unknown:
            raise KeyError(f"no such stacks: {', '.join(sorted(unknown))}")
        column, count = {}, 0
        for name, stack in values.items():
            mask = np.broadcast_to(np.asarray(free.get(name, False)), (len(stack), stack.dof))
            numbers = np.full(mask.shape, -1, dtype=np.int64)
            numbers[mask] = count + np.arange(int(mask.sum()))
            column[name] = numbers
            count += int(mask.sum())
        return _Columns(column, count, basis)

    def of(self, stack: str, element: int) -> Ints:
        return self.column[stack][element]

    def basis_of(self, stack: str) -> Array:
        """(dof, dof)."""
        return self.basis.get(stack, np.eye(self.column[stack].shape[1]))

    def jacobian(self, part: Part) -> Array:
        """By the coordinates in which steps are taken."""
        return part.jacobian @ self.basis[part.stack] if part.stack in self.basis else part.jacobian

    def step(self, stack: str, padded: Array) -> Array:
        """(k, dof): the errors of a stack's numbers from a step in coordinates, 0 at its end."""
        delta: Array = padded[self.column[stack]]
        return delta @ self.basis[stack].T if stack in self.basis else delta

    def moved(self, values: Values, delta: Array) -> Values:
        padded = np.append(delta, 0.0)  # column -1 reads the 0 at the end
        return {
            name: stack.plus(self.step(name, padded)) if (self.column[name] >= 0).any() else stack
            for name, stack in values.items()
        }


def _weights(term: Term, line: Linearised) -> Array:
    if term.loss is None:
        return np.ones(len(line.residuals))
    return term.loss.weight(np.sum(line.residuals**2, axis=1))


def _cost(terms: Sequence[Term], lines: Sequence[Linearised]) -> float:
    total = 0.0
    for term, line in zip(terms, lines, strict=True):
        s = np.sum(line.residuals**2, axis=1)
        total += float(np.sum(s if term.loss is None else term.loss.cost(s)))
    return total


def _normal_equations(
    terms: Sequence[Term], lines: Sequence[Linearised], columns: _Columns
) -> tuple[sparse.csc_array, Array]:
    """H = J^T W J and -J^T W r.

    Residuals that touch the same unknowns make one dense block: board corners of a picture are dozens of residuals in
    one block of some 27 columns, and the sum over blocks is then a hundred times smaller than one over residuals.
    """
    n = columns.count
    rows: list[Ints] = []
    cols: list[Ints] = []
    entries: list[Array] = []
    g = np.zeros(n)
    for term, line in zip(terms, lines, strict=True):
        parts = [p for p in line.parts if (columns.column[p.stack] >= 0).any()]
        if not parts or not len(line.residuals):
            continue
        root = np.sqrt(_weights(term, line))[:, None]
        r = line.residuals * root
        J = np.concatenate([columns.jacobian(p) for p in parts], axis=2) * root[..., None]
        shape = [len(columns.column[p.stack]) for p in parts]
        keys = np.ravel_multi_index([p.index for p in parts], shape)  # one number each: three times as fast to sort
        groups, group_of, sizes = np.unique(keys, return_inverse=True, return_counts=True)
        indices = np.unravel_index(groups, shape)
        where = np.concatenate([columns.column[p.stack][i] for p, i in zip(parts, indices, strict=True)], axis=1)
        order = np.argsort(group_of.ravel(), kind="stable")
        starts = np.cumsum(sizes) - sizes
        width = J.shape[2]
        for size in np.unique(sizes):
            same = np.flatnonzero(sizes == size)
            members = order[starts[same][:, None] + np.arange(size)]  # (groups, size)
            block = J[members].reshape(len(same), -1, width)
            block_t = np.swapaxes(block, 1, 2)
            w = where[same]
            rows.append(np.broadcast_to(w[:, :, None], (len(same), width, width)).ravel())
            cols.append(np.broadcast_to(w[:, None, :], (len(same), width, width)).ravel())
            entries.append((block_t @ block).ravel())
            gradient = (block_t @ r[members].reshape(len(same), -1, 1))[..., 0]
            np.subtract.at(g, w[w >= 0], gradient[w >= 0])
    if not rows:
        return sparse.csc_array((n, n)), g
    i, j, h = np.concatenate(rows), np.concatenate(cols), np.concatenate(entries)
    used = (i >= 0) & (j >= 0)
    return sparse.coo_array((h[used], (i[used], j[used])), shape=(n, n)).tocsc(), g


def _scaled(H: sparse.csc_array, scale: Array) -> sparse.csc_array:
    D = sparse.diags_array(scale)
    return (D @ H @ D).tocsc()


def _factor(H: sparse.csc_array) -> SuperLU | None:
    """LU factors in an order that keeps the arrow of a bundle sparse; None where it is singular."""
    try:
        return splu(H, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    except RuntimeError:
        return None


def _damped_step(H: sparse.csc_array, g: Array, damping: float) -> Array:
    """(H + damping diag H)^-1 g, in units where diag H is 1."""
    diagonal = H.diagonal()
    scale = 1.0 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    lifted = _scaled(H, scale) + damping * sparse.eye_array(len(g))
    factor = _factor(lifted.tocsc())
    if factor is None:
        return np.zeros_like(g) if damping > 1e6 else _damped_step(H, g, max(damping * 100, 1e-9))
    return np.asarray(factor.solve(g * scale) * scale)
