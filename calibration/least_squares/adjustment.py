"""Sparse nonlinear least squares for all calibrations: unknowns, linear systems, solver and priors.

The terms of the cost provide whitened residuals and their derivatives by the unknowns on which they depend. `solve`
takes Levenberg-Marquardt steps on the normal equations and reduces the weight of outliers where a term has a robust
loss; its result provides covariances of any unknowns. Source: ours; the normal equations are sparse as in Triggs et al.
(2000), "Bundle adjustment: a modern synthesis", section 6.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol, TypeVar

import numpy as np
from scipy import sparse
from scipy.linalg import LinAlgError, block_diag, cho_factor, cho_solve
from scipy.sparse.linalg import SuperLU, splu

from geometry import rotations
from geometry.arrays import Array, Bools, Ints, normalised, perpendicular
from geometry.pose import Pose

# The unknowns of a calibration: stacks of vectors, of transforms and of lines, with their small errors.

S = TypeVar("S", bound="Stack")


class Stack(Protocol):
    """k unknowns of one kind. The error of an unknown is a vector of `dof` numbers."""

    @property
    def dof(self) -> int:
        """Size of the error vector of one unknown."""

    def __len__(self) -> int: ...

    def plus(self: S, delta: Array) -> S:
        """The stack with its unknowns changed by delta (k, dof)."""

    def minus(self: S, other: S) -> Array:
        """The delta (k, dof) with other.plus(delta) = self; for lines to first order."""

    def pick(self: S, index: Ints) -> S:
        """Some of the unknowns."""


@dataclass(frozen=True, slots=True)
class Vectors:
    """Vectors: lens parameters, bows, points."""

    array: Array  # (k, d)

    @property
    def dof(self) -> int:
        return self.array.shape[1]

    def __len__(self) -> int:
        return len(self.array)

    def plus(self, delta: Array) -> Vectors:
        return Vectors(self.array + delta)

    def minus(self, other: Vectors) -> Array:
        return self.array - other.array

    def pick(self, index: Ints) -> Vectors:
        return Vectors(self.array[index])


@dataclass(frozen=True, slots=True)
class Poses:
    """Transforms a_from_b with the error [dt (m, in a), dtheta (rad, in b)] of section 1 of the file contract."""

    pose: Pose  # a stack of k

    @property
    def dof(self) -> int:
        return 6

    def __len__(self) -> int:
        return len(self.pose.translation)

    def plus(self, delta: Array) -> Poses:
        return Poses(self.pose.plus(delta))

    def minus(self, other: Poses) -> Array:
        return self.pose.minus(other.pose)

    def pick(self, index: Ints) -> Poses:
        return Poses(self.pose[index])

    @staticmethod
    def of(poses: list[Pose]) -> Poses:
        """A stack of single transforms."""
        return Poses(Pose.stack(poses))


@dataclass(frozen=True, slots=True)
class Lines:
    """Lines in space, each a point and a unit direction, with four degrees of freedom.

    The error is [change of the direction (2, rad), change of the point (2, m)], both perpendicular to the line, along
    the two axes of `basis`. A shift of the point along the line has no effect and is not an error.
    """

    points: Array  # (k, 3), m
    directions: Array  # (k, 3), unit

    @property
    def dof(self) -> int:
        return 4

    def __len__(self) -> int:
        return len(self.points)

    @property
    def basis(self) -> Array:
        """Two unit vectors perpendicular to each line, (k, 3, 2); a function of the direction alone."""
        return perpendicular(self.directions)

    def plus(self, delta: Array) -> Lines:
        B = self.basis
        turned = self.directions + (B @ delta[:, :2, None])[..., 0]
        return Lines(self.points + (B @ delta[:, 2:, None])[..., 0], normalised(turned))

    def minus(self, other: Lines) -> Array:
        # The points that represent the lines are arbitrary, so the point opposite the other line's point is compared.
        shift = self.points - other.points
        along = np.sum(shift * other.directions, axis=1) / np.sum(self.directions * other.directions, axis=1)
        shift = shift - along[:, None] * self.directions
        turn = self.directions / np.sum(self.directions * other.directions, axis=1)[:, None]
        return np.concatenate([(v[:, None, :] @ other.basis)[:, 0] for v in (turn, shift)], axis=1)

    def pick(self, index: Ints) -> Lines:
        return Lines(self.points[index], self.directions[index])


# Symmetric linear systems: scaling, factors, damped steps; small ones are solved as full matrices.

_UNDETERMINED = 1e-9  # ratio of the information along a direction to that on its numbers one by one
_AHEAD = 0.1  # share of a step over which its second derivatives are measured
_SMALL = 300  # unknowns up to which a full matrix takes less time: forty photographs of one camera (1 ms against 4 ms)


def scaled(H: sparse.csc_array, scale: Array) -> sparse.csc_array:
    """D H D with the diagonal matrix D of `scale` (n,)."""
    D = sparse.diags_array(scale)
    return (D @ H @ D).tocsc()


def factored(H: sparse.csc_array) -> SuperLU | None:
    """LU factors of a symmetric H, in an order that keeps the arrow shape of a bundle sparse; None if H is singular."""
    try:
        return splu(H, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    except RuntimeError:
        return None


def damped_step(H: sparse.csc_array | Array, g: Array, damping: float) -> Array:
    """Levenberg-Marquardt step (n,): (H + damping diag H)^-1 g, solved in units in which diag H is 1.

    A singular system is solved with more damping; the step is 0 if that does not help.
    """
    diagonal = H.diagonal()
    scale = 1.0 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    if isinstance(H, np.ndarray):
        full = H * np.outer(scale, scale)
        full[np.diag_indices_from(full)] += damping
        try:
            return np.asarray(cho_solve(cho_factor(full, check_finite=False), g * scale, check_finite=False) * scale)
        except LinAlgError:
            factor = None
    else:
        factor = factored((scaled(H, scale) + damping * sparse.eye_array(len(g))).tocsc())
    if factor is None:
        return np.zeros_like(g) if damping > 1e6 else damped_step(H, g, max(damping * 100, 1e-9))
    return np.asarray(factor.solve(g * scale) * scale)


# The adjustment.

Values = Mapping[str, Stack]
Free = Mapping[str, bool | Bools]  # per stack: which numbers (k, dof) are free, True: all; stacks not named are fixed
At = tuple[str, int]  # name of a stack and index of one of its unknowns
# Per stack, a matrix (dof, dof): steps are taken in coordinates with error = basis @ coordinates. Numbers with almost
# the same effect (k1 and k4 of a lens) give normal equations that are singular to rounding; in a suitable basis no
# digits are lost. Each fixed number must be a coordinate of its own.
Basis = Mapping[str, Array]


def places(at: Sequence[At], values: Values) -> dict[At, Ints]:
    """The positions of the numbers of each unknown in the vector of the errors of all."""
    ends = np.cumsum([values[stack].dof for stack, _ in at])
    return {a: np.arange(end - values[a[0]].dof, end) for a, end in zip(at, ends, strict=True)}


@dataclass(frozen=True, slots=True)
class Part:
    """Derivatives of a term's residuals by the unknowns of one stack."""

    stack: str
    index: Ints  # (N,): the unknown on which each of the N residuals depends
    jacobian: Array  # (N, d, dof), whitened like the residuals


@dataclass(frozen=True, slots=True)
class Linearised:
    """N residuals of d numbers each, in sigmas, and their derivatives."""

    residuals: Array  # (N, d)
    parts: Sequence[Part]  # one per stack


class Loss(Protocol):
    """A robust loss: a function of the squared lengths s (N,), in sigmas, of residuals."""

    def cost(self, s: Array) -> Array:
        """The cost (N,); approaches s for small s."""

    def weight(self, s: Array) -> Array:
        """The weight (N,): d(cost)/ds."""


@dataclass(frozen=True, slots=True)
class Cauchy:
    """The Cauchy loss c^2 log(1 + s / c^2), with which outliers have little influence."""

    scale: float = 3.0  # c: length in sigmas at which the weight is one half

    def cost(self, s: Array) -> Array:
        return np.log1p(s / self.scale**2) * self.scale**2

    def weight(self, s: Array) -> Array:
        return 1.0 / (1.0 + s / self.scale**2)


class Term(Protocol):
    """A term of the cost: one kind of measurement or of prior knowledge."""

    @property
    def loss(self) -> Loss | None:
        """The robust loss; None (squares) if no outliers are expected."""

    def linearise(self, values: Values) -> Linearised:
        """Residuals and derivatives at these values; nan where a residual cannot be computed: the step is refused."""


@dataclass(frozen=True, slots=True)
class Limits:
    """Termination criteria of an adjustment."""

    steps: int = 60  # largest number of steps
    small_step_sigmas: float = 1e-3  # converged if a step is shorter than this, in sigmas of all unknowns together
    damping: float = 1e-4  # of the first step, relative to the diagonal of the normal matrix
    must_converge: bool = True  # False: the values after the largest number of steps will do


class AdjustmentError(ValueError):
    """The adjustment does not converge, or does not determine the requested unknowns."""


@dataclass(frozen=True, slots=True)
class Adjusted:
    """The result of an adjustment, with its normal equations."""

    values: Values
    residuals: tuple[Array, ...]  # per term (N, d), in sigmas, without the weights
    weights: tuple[Array, ...]  # per term (N,), of its loss; 1 without a loss
    chi2: float  # weighted sum of the squared residuals
    dof: int  # number of residuals minus number of free unknowns
    _columns: _Columns
    _normal: sparse.csc_array

    def is_free(self, stack: str) -> Bools:
        """Which numbers (k, dof) of a stack were free."""
        return np.asarray(self._columns.column[stack] >= 0)

    def covariance(self, at: Sequence[At]) -> Array:
        """Joint covariance (p, p) of the errors of some unknowns, in this order; 0 for fixed numbers.

        It is marginal: all other free unknowns are taken into account. Raises AdjustmentError: the data do not
        determine some direction of the unknowns.
        """
        columns = np.concatenate([self._columns.of(*a) for a in at])
        free = columns >= 0
        out = np.zeros((len(columns), len(columns)))
        if free.any():
            # With a unit diagonal, small pivots show that the equations are nearly singular, independent of the units.
            scale = 1.0 / np.sqrt(np.maximum(self._normal.diagonal(), 1e-300))
            factor = factored(scaled(self._normal, scale))
            if factor is None or np.min(np.abs(factor.U.diagonal())) < 1e-11:
                raise AdjustmentError("the data do not determine some direction of the unknowns")
            picked = columns[free]
            rhs = np.zeros((self._normal.shape[0], len(picked)))
            rhs[picked, np.arange(len(picked))] = scale[picked]
            block = (factor.solve(rhs) * scale[:, None])[picked]
            out[np.ix_(free, free)] = (block + block.T) / 2
        if any(stack in self._columns.basis for stack, _ in at):
            # The basis (dof, dof) in which each stack's steps are taken.
            basis, column = self._columns.basis, self._columns.column
            M = block_diag(*[basis.get(s, np.eye(column[s].shape[1])) for s, _ in at])
            out = M @ out @ M.T
        return out

    def reduced_normal(self, keep: Sequence[At]) -> Array:
        """Information matrix (p, p) of some unknowns after elimination of all other free ones (Schur complement).

        Rows of fixed numbers are 0. Raises ValueError: a stack was solved in another basis; AdjustmentError: the other
        unknowns are not determined even with the kept ones known.
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
            factor = factored(H[rest][:, rest].tocsc())
            if factor is None:
                raise AdjustmentError("the other unknowns are not determined even when the kept ones are known")
            across = H[rest][:, kept].toarray()
            S = S - across.T @ factor.solve(across)
        out = np.zeros((len(columns), len(columns)))
        out[np.ix_(free, free)] = (S + S.T) / 2
        return out

    def undetermined(self, keep: Sequence[At]) -> Array:
        """The m directions (m, p) in the errors of the kept unknowns that the data do not determine.

        Their information is below _UNDETERMINED times that on their numbers one by one.
        """
        S = self.reduced_normal(keep)
        columns = np.concatenate([self._columns.of(*a) for a in keep])
        used = columns >= 0
        alone = np.sqrt(np.maximum(self._normal.diagonal()[columns[used]], 1e-300))
        scaled = S[np.ix_(used, used)] / np.outer(alone, alone)
        eigenvalues, vectors = np.linalg.eigh(scaled)
        out = np.zeros((int(np.sum(eigenvalues < _UNDETERMINED)), len(columns)))
        out[:, used] = (vectors[:, eigenvalues < _UNDETERMINED] / alone[:, None]).T
        return out


def solve(
    values: Values, terms: Sequence[Term], free: Free, limits: Limits = Limits(), basis: Basis | None = None
) -> Adjusted:
    """The values that minimise the cost of the terms.

    A step that fails is bent once by the second derivatives along it, then shortened: valleys of parameters with nearly
    the same effect, as of a rational lens, are curved (geodesic acceleration, Transtrum, Sethna 2012, arXiv 1201.5885).
    It is only shortened where its residuals are not finite, or where the values decide how many residuals there are.
    The start values must lie within the convergence region of Newton's method. Directions that nothing determines keep
    their start values. Raises AdjustmentError: a residual is not finite at the start, or the steps do not converge;
    KeyError: `free` names a stack that `values` does not have.
    """
    columns = _Columns.of_free(values, free, basis or {})

    def reached(delta: Array) -> tuple[Values, list[Linearised], float]:
        moved = columns.moved(values, delta)
        lines = [t.linearise(moved) for t in terms]
        return moved, lines, _cost(terms, lines)

    values, lines, cost = reached(np.zeros(columns.count))
    if not np.isfinite(cost):
        raise AdjustmentError("some measurement cannot be predicted from the start values")
    damping = limits.damping
    for _ in range(limits.steps):
        H, g = _normal_equations(terms, lines, columns)
        first, bent, delta = damping, False, damped_step(H, g, damping)
        while True:
            moved, new_lines, new_cost = reached(delta)
            # Near the minimum, rounding hides a decrease of the cost, so a step this short is accepted in any case.
            size = float(np.sqrt(max(float(delta @ (H @ delta)), 0.0)))
            if new_cost <= cost or size < limits.small_step_sigmas:
                break
            if np.isfinite(new_cost) and not bent:
                bent, ahead = True, reached(_AHEAD * delta)[1]
                if all(a.residuals.shape == b.residuals.shape for a, b in zip(lines, ahead, strict=True)):
                    there = _normal_equations(terms, lines, columns, [line.residuals for line in ahead])[1]
                    second = np.nan_to_num(there - g + _AHEAD * (H @ delta)) / _AHEAD**2
                    delta += damped_step(H, second, damping)
                    continue
            damping *= 10
            if damping > 1e12:
                raise AdjustmentError("no step reduces the residuals")
            delta = damped_step(H, g, damping)
        if new_cost <= cost:
            values, lines, cost = moved, new_lines, new_cost
        if damping == first:  # else a tenth of it has just failed
            damping = max(damping * 0.1, 1e-12)
        if size < limits.small_step_sigmas:
            break
    else:
        if limits.must_converge:
            raise AdjustmentError(f"no convergence after {limits.steps} steps: the last one was {size:.2g} sigmas long")
    H, _ = _normal_equations(terms, lines, columns)
    weights = tuple(_weights(t, line) for t, line in zip(terms, lines, strict=True))
    chi2 = sum(float(np.sum(w[:, None] * line.residuals**2)) for w, line in zip(weights, lines, strict=True))
    count = sum(line.residuals.size for line in lines)
    residuals = tuple(line.residuals for line in lines)
    return Adjusted(values, residuals, weights, chi2, count - columns.count, columns, sparse.csc_array(H))


@dataclass(frozen=True, slots=True)
class _Columns:
    """The column of each number in the normal equations."""

    column: Mapping[str, Ints]  # per stack (k, dof); -1 for fixed numbers
    count: int  # number of free ones
    basis: Basis

    @staticmethod
    def of_free(values: Values, free: Free, basis: Basis) -> _Columns:
        unknown = set(free) - set(values)
        if unknown:
            raise KeyError(f"free: unknown stacks {', '.join(sorted(unknown))}")
        column, count = {}, 0
        for name, stack in values.items():
            mask = np.broadcast_to(np.asarray(free.get(name, False)), (len(stack), stack.dof))
            numbers = np.full(mask.shape, -1, dtype=np.int64)
            numbers[mask] = count + np.arange(int(mask.sum()))
            column[name] = numbers
            count += int(mask.sum())
        return _Columns(column, count, basis)

    def of(self, stack: str, element: int) -> Ints:
        """The columns (dof,) of one unknown."""
        return self.column[stack][element]

    def jacobian(self, part: Part) -> Array:
        """Derivatives (N, d, dof) by the coordinates in which steps are taken."""
        return part.jacobian @ self.basis[part.stack] if part.stack in self.basis else part.jacobian

    def step(self, stack: str, padded: Array) -> Array:
        """The change (k, dof) of a stack's numbers, from a step in coordinates with a 0 appended."""
        delta: Array = padded[self.column[stack]]
        return delta @ self.basis[stack].T if stack in self.basis else delta

    def moved(self, values: Values, delta: Array) -> Values:
        """The values after a step (count,)."""
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
    total = 0.0 if all(np.isfinite(line.residuals).all() for line in lines) else np.inf
    for term, line in zip(terms, lines, strict=True):
        s = np.sum(line.residuals**2, axis=1)
        total += float(np.sum(s if term.loss is None else term.loss.cost(s)))
    return total


def _normal_equations(
    terms: Sequence[Term], lines: Sequence[Linearised], columns: _Columns, residuals: Sequence[Array] | None = None
) -> tuple[sparse.csc_array | Array, Array]:
    """The normal matrix H = J^T W J (n, n), full if it is small, and the right-hand side -J^T W r (n,).

    residuals: r, None: those of the lines. Residuals that depend on the same unknowns form one dense block. The board
    corners of a picture, for instance, are dozens of residuals in a block of some 27 columns; summing blocks takes a
    hundredth of the entries of summing residuals.
    """
    n = columns.count
    rows: list[Ints] = []
    cols: list[Ints] = []
    entries: list[Array] = []
    g = np.zeros(n)
    for term, line, r in zip(terms, lines, residuals or [line.residuals for line in lines], strict=True):
        parts = [p for p in line.parts if (columns.column[p.stack] >= 0).any()]
        if not parts or not len(line.residuals):
            continue
        root = np.sqrt(_weights(term, line))[:, None]
        r = r * root
        J = np.concatenate([columns.jacobian(p) for p in parts], axis=2) * root[..., None]
        keys = np.zeros(len(r), dtype=np.int64)
        if len(r) > 1:  # a single residual may depend on more unknowns than fit into one number
            shape = [len(columns.column[p.stack]) for p in parts]
            keys = np.ravel_multi_index([p.index for p in parts], shape)  # single numbers sort three times as fast
        _, group_of, sizes = np.unique(keys, return_inverse=True, return_counts=True)
        order = np.argsort(group_of.ravel(), kind="stable")
        starts = np.cumsum(sizes) - sizes
        first = order[starts]
        where = np.concatenate([columns.column[p.stack][p.index[first]] for p in parts], axis=1)
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
    if n <= _SMALL:
        return np.asarray(np.bincount(i[used] * n + j[used], h[used], n * n), dtype=float).reshape(n, n), g
    return sparse.coo_array((h[used], (i[used], j[used])), shape=(n, n)).tocsc(), g


# Prior knowledge of unknowns, from surveys, data sheets or earlier calibrations, as terms.


@dataclass(frozen=True, slots=True)
class Prior:
    """Prior values of any unknowns of any stacks, with the joint covariance of their errors.

    Numbers with an infinite variance (on the diagonal) are not known and give no residual; neither do directions of
    zero variance, which the caller holds fixed. Raises ValueError: the covariance does not have the size of the values.
    """

    at: tuple[At, ...]
    values: tuple[Stack, ...]  # stacks of one unknown each
    covariance: Array  # (p, p) of the errors, in that order
    loss: Loss | None = None
    _root: Array = field(init=False)  # (m, p): whitening matrix

    def __post_init__(self) -> None:
        sizes = sum(v.dof for v in self.values)
        if self.covariance.shape != (sizes, sizes):
            raise ValueError(f"prior: expected a covariance of {sizes} numbers, got shape {self.covariance.shape}")
        known = np.flatnonzero(np.isfinite(np.diagonal(self.covariance)))
        finite = self.covariance[np.ix_(known, known)]
        sigmas = np.sqrt(np.maximum(np.diagonal(finite), 0.0))
        unit = np.where(sigmas > 0, sigmas, 1.0)
        eigenvalues, vectors = np.linalg.eigh(finite / np.outer(unit, unit))
        real = eigenvalues > 1e-12
        root = np.zeros((int(real.sum()), sizes))
        root[:, known] = (vectors[:, real] / np.sqrt(eigenvalues[real])).T / unit
        object.__setattr__(self, "_root", root)

    def linearise(self, values: Values) -> Linearised:
        """One residual of m numbers."""
        deltas, parts, start = [], [], 0
        for (stack, element), known in zip(self.at, self.values, strict=True):
            one = np.array([element])
            delta = values[stack].pick(one).minus(known)[0]
            deltas.append(delta)
            J = self._root[:, start : start + known.dof] @ _minus_jacobian(known, delta)
            parts.append(Part(stack, one, J[None]))
            start += known.dof
        return Linearised((self._root @ np.concatenate(deltas))[None], parts)


@dataclass(frozen=True, slots=True)
class Anchors:
    """Independent prior values of all unknowns of a stack of vectors, with one sigma."""

    stack: str
    known: Array  # (k, d)
    sigma: float  # of each number, in its unit
    loss: Loss | None = None

    def linearise(self, values: Values) -> Linearised:
        """k residuals of d numbers."""
        now = values[self.stack]
        assert isinstance(now, Vectors)
        k, d = self.known.shape
        residuals = now.minus(Vectors(self.known)) / self.sigma
        J = np.broadcast_to(np.eye(d) / self.sigma, (k, d, d))
        return Linearised(residuals, [Part(self.stack, np.arange(k), J)])


def _minus_jacobian(known: Stack, delta: Array) -> Array:
    """d(value.minus(known)) / d(error of value) (dof, dof), at the difference delta (dof,)."""
    J = np.eye(known.dof)
    if isinstance(known, Poses):
        J[3:, 3:] = np.linalg.inv(rotations.right_jacobian(delta[3:]))
    return J


def independent(stack: str, values: Stack, sigmas: Array, first: int = 0) -> Sequence[Prior]:
    """A prior for each of k successive unknowns of a stack, from the index `first`.

    values: the k unknowns; sigmas (k, dof): inf where nothing is known.
    """

    return [
        Prior(((stack, first + i),), (values.pick(np.array([i])),), np.diag(sigmas[i] ** 2))
        for i in range(len(values))
        if np.isfinite(sigmas[i]).any()
    ]
