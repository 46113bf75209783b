"""Joint adjustment of a whole rig: lenses, cameras, screens, control points, boards, beams and the stand.

The single steps (calibration/screens, calibration/beams) give the start values. Every parameter with an uncertainty is
free, so that each measurement contributes to all parameters, and the covariance is complete.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse
from scipy.special import chdtrc, chdtri

from calibration.beams.beams import StandModel
from calibration.least_squares.adjustment import Adjusted, At, Cauchy, Free, Limits, Poses, Prior, Term, Values, solve
from calibration.screens.network import (
    SURFACES,
    SURVEY,
    Network,
    NetworkFit,
    normalised_residuals,
    point_term,
    stated_terms,
)
from calibration.terms.rig_blocks import (
    BEAMS,
    BOWS,
    CAMERAS,
    INTRINSICS,
    POSES,
    SCREENS,
    STAND,
    SpotPixels,
    SpotTerm,
    named_covariance,
    rig_of,
)
from calibration.terms.surveyed import (
    RecordTerm,
    picked,
    pose_of,
    rows_of,
    widened,
)
from geometry.arrays import Array, Bools, Ints
from geometry.rig import Rig
from geometry.uncertainty.rig_uncertainty import RigCovariance

# Consistency of each kind of measurement in a joint adjustment, and its share of the result's uncertainty.
#
# For a group g of whitened residuals v with Jacobian J and the covariance C of all unknowns, A_g = J^T J is the group's
# normal matrix. v has the covariance Q = I - J C J^T: its squared length is tr(Q) on average, the group's redundancy,
# with a variance of 2 tr(Q^2). The group contributes C A_g C to C, and the sum of these over all groups is C, the
# inverse of the sum of all A_g. Source: Foerstner and Wrobel (2016), Photogrammetric Computer Vision, sections 4.2.4
# and 4.6.2; the test by a scaled chi-square with the same two moments is Satterthwaite's (1946), Biometrics Bulletin
# 2(6).


@dataclass(frozen=True, slots=True)
class Unknowns:
    """Positions of the unknowns in one long vector."""

    at: tuple[At, ...]
    column: Mapping[str, Ints]  # (k, dof) per block with free parameters
    size: int

    @staticmethod
    def of(values: Values, free: Free) -> Unknowns:
        """All unknowns of the blocks with free parameters, including their fixed ones."""
        at: list[At] = []
        column, size = {}, 0
        for name, stack in values.items():
            if name in free and np.any(free[name]) and len(stack):
                column[name] = size + np.arange(len(stack) * stack.dof).reshape(len(stack), stack.dof)
                size += column[name].size
                at += [(name, i) for i in range(len(stack))]
        return Unknowns(tuple(at), column, size)

    def of_several(self, at: Sequence[At]) -> Ints:
        """Positions of the parameters of several unknowns, in order."""
        return np.concatenate([self.column[stack][i] for stack, i in at])


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


def jacobian(term: Term, values: Values, unknowns: Unknowns) -> tuple[Array, sparse.csr_array]:
    """Residuals (m,) of a term, and their derivatives (m, size) by all unknowns."""
    line = term.linearise(values)
    n, d = line.residuals.shape
    rows, columns, entries = [], [], []
    for part in line.parts:
        if part.stack not in unknowns.column:
            continue
        row = (np.arange(n)[:, None] * d + np.arange(d))[:, :, None]
        column = unknowns.column[part.stack][part.index][:, None]
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
    return GroupFit(name, count, redundancy, chi2, float(chdtrc(dof, chi2 / unit)))


def shares(informations: Mapping[str, Array], C: Array, effect: Array) -> dict[str, Array]:
    """Share of each group in the covariance of a result: (k, k) each, with the sum effect C effect^T.

    effect (k, size): d(result) / d(unknowns).
    """
    spread = effect @ C
    return {name: spread @ A @ spread.T for name, A in informations.items()}


# The kinds of measurement beside those of network.py, named as in reports.
DOTS, CORNERS = "pixels of dots", "board corners"
SPOTS, RECORDS, PLACE = "spots", "stand positions", "place of the stand"
LOST = "positions without a record"
P_OUTLIER = 1e-4  # probability that a correct measurement is excluded
P_MISFIT = 1e-3  # p-value of chi-square below which a kind of measurement misfits
_ROUNDS = 8
# With changing weights the last digits converge slowly; for a start value less is sufficient.
_ROUGHLY = Limits(steps=120, small_step_sigmas=0.1)
_LOST_SIGMA = 0.1  # m, rad: sigma of a position whose record was excluded
_CONVERGED = 0.02  # relative change of a scale in one round below which it has converged
_MOST_SCALE = 10.0  # largest factor on the stated sigmas; measurements that scatter more are not of this rig
_RESCALED = (SPOTS, DOTS, CORNERS, SURVEY, RECORDS, SURFACES)  # kinds whose sigmas may be increased


@dataclass(frozen=True, slots=True)
class Measured:
    """All measurements, and the start values of the parameters."""

    network: Network  # cameras, screens, control points, boards; its rig holds the nominal or found beams and the spots
    screens: NetworkFit  # result of the single step, with the start values
    spots: SpotPixels
    stand: StandModel
    beams: Values  # of the single step: "beams", "stand", "poses"


@dataclass(frozen=True, slots=True)
class Joint:
    """Result of the joint adjustment of a rig."""

    rig: Rig
    covariance: RigCovariance  # of all free parameters of the rig
    values: Values
    adjusted: Adjusted
    unknowns: Unknowns
    all_covariance: Array  # (size, size) of all unknowns
    terms: Mapping[str, tuple[Term, ...]]  # of the final adjustment: inliers, with increased sigmas
    informations: Mapping[str, Array]  # (size, size) normal matrix of each kind
    groups: Mapping[str, GroupFit]  # fit of each kind with the stated sigmas
    settled: Mapping[str, GroupFit]  # the same with the increased ones
    scales: Mapping[str, float]  # factor on the sigmas of a kind; missing kinds: 1
    kept: Mapping[str, Bools]  # inliers of the kinds that may have outliers, row by row
    every: Mapping[str, Term]  # the same kinds with all rows and the stated sigmas

    def effect(self, at: Sequence[At], jacobian: Array) -> Array:
        """d(result)/d(all unknowns) (k, size), from the derivatives (k, p) by the unknowns `at`."""
        out = np.zeros((len(jacobian), self.unknowns.size))
        out[:, self.unknowns.of_several(at)] = jacobian
        return out

    @property
    def rig_at(self) -> tuple[At, ...]:
        """The unknowns that are parameters of the rig."""
        return tuple(a for a in self.unknowns.at if a[0] in (INTRINSICS, CAMERAS, SCREENS, BOWS, BEAMS))


def calibrate_jointly(measured: Measured, *, without: Bools | None = None, start: Joint | None = None) -> Joint:
    """The joint adjustment.

    without (spots): spots that are excluded, for a hold-out. start: an earlier result of the same measurements, whose
    outliers and sigmas are then kept. Raises AdjustmentError: the adjustment does not converge or leaves something
    undetermined.
    """
    values: Values = {**measured.screens.values, **measured.beams} if start is None else start.values
    free = free_parameters(measured)
    every, fixed = _terms_by_kind(measured)
    kept = {name: np.ones(rows_of(term), dtype=bool) for name, term in every.items()}
    if without is not None:
        kept[SPOTS] &= ~without
    unknowns = Unknowns.of(values, free)
    groups: dict[str, GroupFit] = {}
    if start is None:
        found, kept = _robust(measured, values, free, every, fixed, kept)
        stated = _inlier_terms(every, fixed, kept)
        groups = _group_fits(found, stated, {}, unknowns)
        scales = _scales(found, stated, unknowns, free)
    else:
        kept = {name: rows & start.kept[name] for name, rows in kept.items()}
        found, stated, scales = start.adjusted, _inlier_terms(every, fixed, kept), dict(start.scales)
    final = {n: tuple(widened(t, scales.get(n, 1.0)) for t in ts) for n, ts in stated.items()}
    if start is not None or scales:
        found = solve(found.values, [t for ts in final.values() for t in ts], free)
    C = found.covariance(unknowns.at)
    informations = {n: information(ts, found.values, unknowns)[0] for n, ts in final.items()}
    rig = rig_of(measured.network.rig, found.values)
    at = [a for a in unknowns.at if a[0] in (INTRINSICS, CAMERAS, SCREENS, BOWS, BEAMS)]
    rows = unknowns.of_several(at)
    return Joint(
        rig=rig,
        covariance=named_covariance(rig, found.values, at, C[np.ix_(rows, rows)]),
        values=found.values,
        adjusted=found,
        unknowns=unknowns,
        all_covariance=C,
        terms=final,
        informations=informations,
        groups=groups,
        settled=_group_fits(found, final, {}, unknowns) if scales and start is None else groups,
        scales=scales,
        kept=kept,
        every=every,
    )


def free_parameters(measured: Measured) -> dict[str, bool | Bools]:
    """The free parameters, by block."""
    stand = measured.stand
    count = len(stand.stand_from_body.translation)
    stand_free: bool | Bools = True
    if stand.stand_covariance is not None:
        stand_free = np.diagonal(stand.stand_covariance)[None] > 0
    # Parameters of cameras and screens are free as in their own step, which also fixes the frame without a survey.
    lab_blocks = {n: measured.screens.adjusted.is_free(n) for n in measured.screens.values if n != BEAMS}
    return {
        **lab_blocks,
        BEAMS: True,
        STAND: stand_free,
        POSES: np.broadcast_to(np.asarray(stand.pose_sigmas) > 0, (count, 6)),
    }


def _terms_by_kind(measured: Measured) -> tuple[dict[str, Term], dict[str, tuple[Term, ...]]]:
    """Terms by kind: those whose rows may be excluded, and the others."""
    network, stand = measured.network, measured.stand
    every: dict[str, Term] = {SPOTS: SpotTerm(network.rig, measured.spots)}
    if len(network.point_observations):
        every[DOTS] = point_term(network)
    if measured.screens.corners is not None:
        every[CORNERS] = measured.screens.corners
    fixed = stated_terms(network, pose_of(measured.screens.values, SCREENS), measured.screens.corners)
    count = len(stand.stand_from_body.translation)
    sigmas = np.broadcast_to(np.asarray(stand.pose_sigmas, dtype=float), (count, 6))
    if np.any((sigmas > 0) & np.isfinite(sigmas)):
        every[RECORDS] = RecordTerm(POSES, np.arange(count), stand.stand_from_body, sigmas)
    if stand.world_from_stand is not None and stand.stand_covariance is not None and np.any(stand.stand_covariance):
        fixed[PLACE] = (Prior(((STAND, 0),), (Poses.of([stand.world_from_stand]),), stand.stand_covariance),)
    return every, fixed


def _robust(
    measured: Measured,
    values: Values,
    free: Free,
    every: Mapping[str, Term],
    fixed: Mapping[str, tuple[Term, ...]],
    allowed: Mapping[str, Bools],
) -> tuple[Adjusted, dict[str, Bools]]:
    """Detect outliers with a Cauchy loss, then exclude them and adjust again until the inliers do not change."""
    rest = [t for ts in fixed.values() for t in ts]
    first = [picked(t, allowed[n], Cauchy()) for n, t in every.items()]
    found = solve(values, [*first, *rest], free, _ROUGHLY)
    kept = _inliers(measured, every, found.values, allowed)
    for _ in range(_ROUNDS):
        terms = [t for ts in _inlier_terms(every, fixed, kept).values() for t in ts]
        found = solve(found.values, terms, free)
        again = _inliers(measured, every, found.values, allowed)
        if all(np.array_equal(again[n], kept[n]) for n in kept):
            break
        kept = again
    return found, kept


def _inliers(
    measured: Measured, every: Mapping[str, Term], values: Values, allowed: Mapping[str, Bools]
) -> dict[str, Bools]:
    """Inliers of each kind, relative to the scatter of the better half."""
    out = {}
    for name, term in every.items():
        if name == DOTS:
            # Relative to the survey, not to the adjusted point, which follows a wrong pixel if one camera sees it only.
            s = normalised_residuals(measured.network, values) ** 2
            d = 2
        else:
            r = term.linearise(values).residuals
            s, d = np.sum(r**2, axis=1), r.shape[1]
        some = s[allowed[name] & np.isfinite(s)]
        median = float(np.median(some)) / chdtri(d, 0.5) if some.size else 1.0
        unit = float(np.clip(median, 1.0, _MOST_SCALE**2))
        out[name] = allowed[name] & (s < unit * chdtri(d, P_OUTLIER))
    return out


def _inlier_terms(
    every: Mapping[str, Term], fixed: Mapping[str, tuple[Term, ...]], kept: Mapping[str, Bools]
) -> dict[str, tuple[Term, ...]]:
    out = {n: (picked(t, kept[n]),) for n, t in every.items()} | dict(fixed)
    if RECORDS in every and not kept[RECORDS].all():
        # A weak prior keeps a position without its record finite where its spots do not determine it.
        lost = picked(every[RECORDS], ~kept[RECORDS])
        assert isinstance(lost, RecordTerm)
        out[LOST] = (replace(lost, sigmas=np.where(lost.sigmas > 0, _LOST_SIGMA, 0.0)),)
    return out


def _group_fits(
    found: Adjusted, stated: Mapping[str, tuple[Term, ...]], scales: Mapping[str, float], unknowns: Unknowns
) -> dict[str, GroupFit]:
    """Fit of each kind, with its sigmas multiplied by `scales`."""
    C = found.covariance(unknowns.at)
    out = {}
    for name, terms in stated.items():
        these = [widened(t, scales.get(name, 1.0)) for t in terms]
        out[name] = group_fit(name, *information(these, found.values, unknowns), C)
    return out


def _scales(
    found: Adjusted, stated: Mapping[str, tuple[Term, ...]], unknowns: Unknowns, free: Free
) -> dict[str, float]:
    """Factors by which the stated sigmas of each kind are too small (variance components, Foerstner 1979).

    Only where the residuals are significantly too large, and never below 1: larger sigmas are a safety margin of the
    user. Because a misfit of one kind affects others, the worst one is scaled first, and the fit is then repeated.
    """
    scales: dict[str, float] = {}
    for _ in range(3 * len(_RESCALED)):
        fits = _group_fits(found, stated, scales, unknowns)
        loose = {
            n: f
            for n, f in fits.items()
            if n in _RESCALED and (f.p < P_MISFIT or (n in scales and abs(f.scale - 1) > _CONVERGED))
        }
        if not loose:
            break
        worst = max(loose, key=lambda n: abs(np.log(loose[n].scale)))
        scales[worst] = max(scales.get(worst, 1.0) * loose[worst].scale, 1.0)
        terms = [widened(t, scales.get(n, 1.0)) for n, ts in stated.items() for t in ts]
        found = solve(found.values, terms, free)
    return {n: s for n, s in scales.items() if s > 1.0}
