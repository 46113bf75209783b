"""Each photograph's own equations for the unknowns that all photographs share, with the pose of its board eliminated.

From them follow, without another fit, the solution of any set of photographs, the error of each photograph when it is
held out, and how much the photographs scatter: in first order about the solution of all, which residuals far below the
picture's size justify. Source: ours, from the elimination of poses in a bundle adjustment (Triggs et al. 2000, "Bundle
adjustment: a modern synthesis", section 6.1).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solve_triangular
from scipy.special import chdtrc, chdtri

from calibration.least_squares.adjustment import AdjustmentError
from calibration.lens.fit.corner_table import CornerTable
from calibration.lens.fit.correlated_noise import correlations
from calibration.lens.fit.lens_adjustment import prior_terms, term_of
from calibration.lens.fit.lens_fit import LensFit, used_views
from calibration.lens.fit.lens_parameters import BoardFreedom
from geometry.arrays import Array, Bools, Ints

# Scatter between five photographs with a smaller p-value inflates the covariance: with 5 %, sets of five to seven real
# photographs often stated sigmas that were too small. With more photographs the limit falls as the odds of no scatter
# at it would rise (Perez and Pericchi 2014, Statistics & Probability Letters 85): at 10 % for all, 76 % of the errors
# of one parameter of 200 simulated sets of twelve were within 1 sigma.
_SCATTER_SIGNIFICANT = 0.1
# With a smaller p-value of a flat board, the effect of solving for its bend is part of the covariance.
BEND_PROBABLE = 0.05
_MOST_BY_ONE = 0.8  # share of the information on a direction that comes from one view, as the jackknife counts it
_FEWEST_DOF = 3.0  # of a scatter that is widened: with 2 the standard deviation of a t distribution is unlimited
_SPLITS = 3  # directions from which two groups are searched: mixed sets of two cameras were found from the first
_ROUNDS = 30  # of assigning views to groups: ten views settle within five
_UNDETERMINED = 1e-9  # relative size of a pivot below which a direction of the unknowns is not determined


@dataclass(frozen=True, slots=True)
class Scatter:
    """Whether photographs pull the shared unknowns apart by more than the noise of their corners explains."""

    factor: float  # on the sigmas of independent corners that explains it; about 1 for a good model
    p_value: float  # of at least as much scatter, if model and noise are right
    is_significant: bool  # whether it widens the sigmas beyond what the correlation of neighbours does
    correlated: float = 1.0  # factor on the sigmas of independent corners by the correlation of neighbours

    @property
    def raised(self) -> float:
        """Factor on the sigmas of independent corners that the photographs show."""
        return self.factor if self.is_significant else self.correlated


@dataclass(frozen=True, slots=True)
class ViewEquations:
    """Information and gradient of V views on q shared unknowns: p of the lens, then bend (3) and scale (2) if present.

    In coordinates in which all views together have the identity as information: unknowns = basis @ coordinates.
    """

    information: Array  # (V, q, q)
    gradient: Array  # (V, q): half of the derivative of chi-square; sums to 0 over all views and the prior
    chi2: Array  # (V,)
    count: Ints  # (V,): coordinates minus the six numbers of the pose
    views: Ints  # (V,): their numbers in the table
    basis: Array  # (q, q)
    lens: int  # p
    correlated: Array | None = None  # (V, q, q): covariance of the gradients; None: corners are independent

    @property
    def noise(self) -> Array:
        """(V, q, q): covariance of each view's gradient at the true unknowns, by the noise of its corners."""
        return self.information if self.correlated is None else self.correlated

    @property
    def noise_of_sum(self) -> Array:
        """(q, q): the same of the sum over all views and the prior."""
        return np.asarray(np.eye(len(self.basis)) + np.sum(self.noise - self.information, axis=0))

    @staticmethod
    def of(table: CornerTable, found: LensFit, board: BoardFreedom | None = None) -> ViewEquations:
        """At a solution; board: shape parameters among the unknowns, None: those that were free.

        Raises AdjustmentError: the views do not determine the unknowns.
        """
        board = found.board if board is None else board
        model, views = found.model, used_views(found, table)
        line = term_of(table, found.used, model.fisheye, found.sigma_px).linearise(found.values)
        parts = {p.stack: p.jacobian for p in line.parts}
        shared = _shared(parts, model.free, board, table.circles is not None)
        known = _prior_rows(table, found, shared.shape[-1])
        view = table.view[found.used]
        places = table.points[found.used] / table.spacing_m
        return ViewEquations.of_rows(
            shared, parts["boards"], line.residuals, view, views, known, int(model.free.sum()), places
        )  # fmt: skip

    @staticmethod
    def of_rows(
        shared: Array, boards: Array, residuals: Array, view: Ints, views: Ints, known: Array, lens: int, places: Array
    ) -> ViewEquations:
        """From derivatives by the shared unknowns (N, 2, q) and by the pose of each view's board (N, 2, 6).

        residuals (N, 2), in sigmas; view (N,): of each corner; known (n, q): rows of priors; lens: p; places
        (N, k): of the corners on the board, in spacings. Raises AdjustmentError: the views do not determine the
        unknowns.
        """
        rows, misses, poses = [], [], []
        for v in views:
            mine = view == v
            J, r = shared[mine].reshape(-1, shared.shape[-1]), residuals[mine].ravel()
            Q = np.linalg.qr(boards[mine].reshape(-1, 6))[0]
            rows.append(J - Q @ (Q.T @ J))
            misses.append(r - Q @ (Q.T @ r))
            poses.append(Q)
        J = np.concatenate([*rows, known])
        scale = np.linalg.norm(J, axis=0)
        if not np.all(scale > 0):
            raise AdjustmentError("the views do not determine every unknown")
        R = np.linalg.qr(J / scale, mode="r")
        if np.min(np.abs(np.diagonal(R))) < _UNDETERMINED:
            raise AdjustmentError("the views do not determine every unknown")
        basis = solve_triangular(R, np.eye(len(R))) / scale[:, None]
        own = [A @ basis for A in rows]
        alike = correlations(misses, poses, [places[view == v] for v in views])
        return ViewEquations(
            information=np.stack([A.T @ A for A in own]),
            gradient=np.stack([A.T @ r for A, r in zip(own, misses, strict=True)]),
            chi2=np.array([r @ r for r in misses]),
            count=np.array([max(len(r) - 6, 1) for r in misses]),
            views=views,
            basis=basis,
            lens=lens,
            correlated=None
            if alike is None
            else np.stack([_covariance(A, K) for A, K in zip(own, alike, strict=True)]),
        )

    def solution(self, which: Bools | None = None) -> tuple[Array, Array]:
        """Change (q,) of the unknowns against all views, and covariance (q, q), from some of the views (V,); None: all.

        The prior, which is weak, counts for each set in full. Raises AdjustmentError: they do not determine the
        unknowns.
        """
        every = np.eye(len(self.basis))
        left = np.ones(len(self.views), dtype=bool) if which is None else which
        H = every - np.sum(self.information[~left], axis=0)
        values, vectors = np.linalg.eigh(H)
        if values[0] < _UNDETERMINED:
            raise AdjustmentError("these views do not determine every unknown")
        half = self.basis @ (vectors / np.sqrt(values))
        C = half @ half.T
        inverse = (vectors / values) @ vectors.T
        return -self.basis @ (inverse @ np.sum(self.gradient[left], axis=0)), C

    def two_groups(self) -> Bools:
        """(V,): the split of the views that two sets of unknowns explain best; the sum of chi-squares is a minimum.

        Each view joins the set that explains it better, and each set is solved from its views, in turn (k-means, Lloyd
        1982), from splits along the directions in which the gradients of the views scatter most.
        """
        S, g = self.information, self.gradient
        best, least = np.zeros(len(S), dtype=bool), np.inf
        for direction in np.linalg.svd(g, full_matrices=False)[2][:_SPLITS]:
            score = g @ direction
            second = score > np.median(score)
            for _ in range(_ROUNDS):
                before = second
                y = [-np.linalg.pinv(np.sum(S[m], axis=0)) @ np.sum(g[m], axis=0) for m in (~second, second)]
                chi2 = np.array([self.chi2 + 2 * g @ own + (S @ own) @ own for own in y])
                second = chi2[1] < chi2[0]
                if np.array_equal(second, before):
                    break
            total = float(np.sum(np.min(chi2, axis=0)))
            if total < least:
                best, least = second, total
        return best

    def moved(self, change: Array) -> ViewEquations:
        """The equations at other values of the unknowns: changed by (q,)."""
        y = np.linalg.solve(self.basis, change)
        by = self.information @ y
        chi = self.chi2 + 2 * self.gradient @ y + by @ y
        return replace(self, gradient=self.gradient + by, chi2=chi)

    def held_out_px2(self) -> Array:
        """(V,): squared error per coordinate, in units of the noise, of each view when it is held out."""
        error = np.empty(len(self.views))
        for v, (S, g) in enumerate(zip(self.information, self.gradient, strict=True)):
            # A view that alone determines some direction would be predicted with an unlimited error there.
            y = np.linalg.solve((1 + _UNDETERMINED) * np.eye(len(g)) - S, g)
            error[v] = (self.chi2[v] + 2 * g @ y + y @ S @ y) / self.count[v]
        return error

    def predicted(self) -> tuple[float, float]:
        """Chi-square of all views, each as predicted by the others, and the log of the determinants that it lacks.

        The sum is minus twice the log of their probability density, but for a constant. The covariance of the
        residuals r of a view is I + J (I - S)^-1 J', with S = J'J, where the others predict it. At the solution of all,
        r is that of the prediction times the inverse of this covariance.
        """
        left = (1 + _UNDETERMINED) * np.eye(len(self.basis)) - self.information
        moved = np.linalg.solve(left, self.gradient[..., None])[..., 0]
        chi2 = float(np.sum(self.chi2) + np.sum(self.gradient * moved))
        return chi2, -float(np.sum(np.linalg.slogdet(left)[1]))

    def scattered_covariance(self, spread: Scatter) -> Array:
        """Covariance (q, q) of the unknowns from noise and, where it is significant, from the scatter of photographs.

        With scatter the weighted mean of two estimates. Noise times its factor, which is one for all directions of the
        unknowns, is too small for those to which errors common to a photograph are most alike, such as the focal
        length. The jackknife, from the changes by leaving out each photograph (MacKinnon and White 1985, J.
        Econometrics 29, HC3, with photographs in place of residuals), knows directions, but has only as many squares as
        there are photographs. So the first counts as many photographs as there are unknowns: the fewest of which a
        covariance is known. A direction that one photograph determines nearly alone counts as determined by it to 80 %:
        the others leave it open. The squares are divided by what they are expected to exceed the variance by, 1.3 to
        2.5 times for few photographs: without it, up to 89 % of the parameters of simulated sets were within 1 sigma.

        Each principal axis of the jackknife is widened to the standard deviation of a t distribution (JCGM 101:2008,
        6.4.9.4) with its degrees of freedom (Bell and McCaffrey 2002, Survey Methodology 28): some 3 of 5 photographs,
        where the widening is 1.7, and 10 of 25.
        """
        S, G = self.information, self.noise
        if not spread.is_significant:
            return self.basis @ self.noise_of_sum @ self.basis.T
        share, vectors = np.linalg.eigh(S)
        held_out = (vectors / (1 - np.minimum(share, _MOST_BY_ONE))[:, None]) @ np.swapaxes(vectors, 1, 2)
        changes = (held_out @ self.gradient[..., None])[..., 0]
        squares, axes = np.linalg.eigh(changes.T @ changes)
        along = held_out @ axes  # (V, q, q): the change along an axis is its column times the gradient
        # What is expected if every photograph has unknowns of its own, so much apart that they explain the factor.
        squared = S @ S
        noise, apart = np.trace(self._at_solution(), axis1=1, axis2=2).sum(), np.sum(squared, axis=0)
        own = np.trace(squared - 2 * squared @ S + S @ apart @ S, axis1=1, axis2=2).sum()
        beyond = (spread.factor / spread.correlated) ** 2
        gradients = G + (beyond - 1) * noise / own * squared  # their covariances; of their sum:
        error = np.sum(gradients, axis=0)
        by_own, by_sum = gradients @ along, S @ along
        # (q, V, V): covariances of these changes; at the solution of all a gradient lacks its view's share of the sum.
        C = np.einsum("uik,ij,vjk->kuv", by_sum, error, by_sum) - np.einsum("uik,vik->kuv", by_own, by_sum)
        C -= np.einsum("uik,vik->kuv", by_sum, by_own)
        np.einsum("kvv->kv", C)[:] += np.einsum("vik,vik->kv", along, by_own)
        expected = np.maximum(np.trace(C, axis1=1, axis2=2), _UNDETERMINED)  # less is what priors alone determine
        dof = np.maximum(expected**2 / np.sum(C**2, axis=(1, 2)), _FEWEST_DOF)
        ratio = np.einsum("ik,ij,jk->k", axes, error, axes) / expected
        jackknife = (axes * squares * ratio * dof / (dof - 2)) @ axes.T
        known = len(S) / (len(S) + len(axes))
        raised = (1 - known) * beyond * self.noise_of_sum + known * jackknife
        return self.basis @ raised @ self.basis.T

    def scatter(self) -> Scatter:
        """Compare the gradients of single views with the covariance that noise gives them at the solution of all.

        Errors that are correlated within a photograph (a board that bends differently each time, blur, a lens that the
        model cannot describe) increase them. Compared as sums over views and directions of equal information, and with
        the chi-square distribution of the same mean and variance (Satterthwaite 1946): the sandwich estimate of White
        (1980, Econometrica 48) for clusters, reduced to one factor.
        """
        S, G = self.information, self.noise
        C = self._at_solution()
        measured = float(np.sum(self.gradient**2))
        expected = float(np.trace(C, axis1=1, axis2=2).sum())
        # The gradients sum to zero: those of different views u, v have the covariance S_u F_v + F_u' S_v.
        F = 0.5 * self.noise_of_sum @ S - G
        Ft, FS = np.swapaxes(F, 1, 2), F @ S
        both = np.sum(S @ S, axis=0) @ np.sum(F @ Ft, axis=0) + np.linalg.matrix_power(np.sum(FS, axis=0), 2)
        squares = float(np.sum(C**2) + 2 * np.trace(both) - np.sum((np.swapaxes(FS, 1, 2) + FS) ** 2))
        dof = expected**2 / max(squares, 1e-300)
        ratio = measured / expected if expected > 0 else 1.0
        p = float(chdtrc(dof, ratio * dof))
        five, all_views = (n * (np.log(n) + chdtri(1, _SCATTER_SIGNIFICANT)) for n in (5, len(S)))
        limit = _SCATTER_SIGNIFICANT * float(np.sqrt(five / all_views))
        independent = float(np.trace(S - S @ S, axis1=1, axis2=2).sum())
        correlated = float(np.sqrt(expected / independent)) if independent > 0 else 1.0
        return Scatter(float(np.sqrt(ratio)) * correlated, p, ratio > 1 and p < limit, correlated)

    def _at_solution(self) -> Array:
        """(V, q, q): covariance of each view's gradient at the solution of all, which their sum has moved."""
        S, by_sum = self.information, self.information @ self.noise
        return self.noise - by_sum - np.swapaxes(by_sum, 1, 2) + S @ self.noise_of_sum @ S


def _covariance(by_unknowns: Array, correlation: Array) -> Array:
    """(q, q) of a view's gradient from derivatives (2 n, q), u and v in turn, and the correlation (n, n) of corners."""
    return np.asarray(sum(A.T @ correlation @ A for A in (by_unknowns[::2], by_unknowns[1::2])))


def scattered(found: LensFit, equations: ViewEquations, spread: Scatter) -> Array:
    """Covariance (p, p) of the lens where photographs scatter; see `scattered_covariance`.

    What scatter adds is added to the covariance of the fit, which alone contains that of displaced points.
    """
    raised = equations.scattered_covariance(spread) - equations.basis @ equations.basis.T
    return found.covariance + raised[: equations.lens, : equations.lens]


def _shared(parts: dict[str, Array], free: Bools, board: BoardFreedom, circles: bool) -> Array:
    """Derivatives (N, 2, q) by the lens, the shape of the board and, last, the radius of its circles."""
    names = [n for n, is_free in (("warp", board.warp), ("stretch", board.stretch), ("radius", circles)) if is_free]
    return np.concatenate([parts["intrinsics"][..., free], *(parts[n] for n in names)], axis=2)


def _prior_rows(table: CornerTable, found: LensFit, q: int) -> Array:
    """Derivatives (n, q) of the priors on the lens and on the radius of circles."""
    rows = []
    for term in prior_terms(table, found.used, found.model, found.values):
        for part in term.linearise(found.values).parts:
            J = part.jacobian.reshape(-1, part.jacobian.shape[-1])
            whole = np.zeros((len(J), q))
            if part.stack == "intrinsics":
                whole[:, : int(found.model.free.sum())] = J[:, found.model.free]
            elif part.stack == "radius":
                whole[:, -1:] = J
            rows.append(whole)
    return np.concatenate(rows) if rows else np.zeros((0, q))
