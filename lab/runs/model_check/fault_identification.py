"""Which possible fault explains what the poses cannot follow, and how sure that is.

The recording is summed into normal equations over all numbers that may be off, every frame's pose projected out. They
say the same as a few uncorrelated pixels y = X theta + noise, one for each direction in which the numbers show at all;
of these a daily check's Misfit tells evidence, size and significance (calibration/drift.py). The calibration's own
covariance is part of the noise there: what it allows is no fault.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibration.drift import Change, ChangeCandidate, ExcessResidual
from geometry.arrays import Array
from lab.runs.model_check.faults import BESIDE, VIEW, PossibleFault
from lab.runs.model_check.linear import LinearisedFrames
from lab.runs.model_check.statistics import correlation_time

P_FALSE_ALARM = 1e-6  # of naming anything in a right recording, all candidates together
AHEAD = 12.0  # of 2 ln(evidence): so far behind the best (1 : 400) another fault is ruled out
# Linearised, a large fault explains its residuals no better than to about this share of their chi-square: less than it
# tells no two faults apart, and is no second fault. Measured: a camera 10 ms late (46 sigma) leaves 0.02 % of 2.6e6.
LINEAR_SHARE = 0.005
MOST_FAULTS = 3  # named at once: where more seem wrong, the whole rig wants calibrating
MOST_RIVALS = 2  # named beside the best
_LEAST_OWN = 10.0  # degrees of freedom of a view: of fewer its noise is unknown
LASTING_FRAMES = 2.0  # frames that count as one: white noise gives 1.0 to 1.2 in 300 frames
_SEEN = 1e-10  # of the largest eigenvalue: combinations of numbers that show less show by rounding only


@dataclass(frozen=True, slots=True)
class Explained:
    """A fault that was fitted to a recording."""

    fault: PossibleFault
    change: Change
    weight: float  # 2 ln of how much more probable it makes the recording, less the number of its like


@dataclass(frozen=True, slots=True)
class SuspectedFault:
    """The best explanation of a misfit, and those that the recording cannot tell from it, the best of each thing."""

    best: Explained
    rivals: tuple[Explained, ...]
    more_rivals: int  # beyond those listed

    @property
    def explanations(self) -> tuple[Explained, ...]:
        """The best and its rivals."""
        return (self.best, *self.rivals)


@dataclass(frozen=True, slots=True)
class FaultDiagnosis:
    """What was found."""

    culprits: tuple[SuspectedFault, ...]
    p_before: float  # how probable so large a misfit is where nothing is wrong
    p_after: float  # the same of what the culprits leave
    tests: int  # candidates tried
    misfit: float  # root of chi-square over its degrees of freedom, everything included: 1 if all is right
    noise: float  # the same of what no constant fault could explain: how far the sigmas are from true
    correlation_frames: float  # how many of the frames used count as one
    unexplained: bool  # whether something is significant beyond what was named
    noise_of_views: Array  # (n,) as `noise`, of each view; nan where it was not seen, or the poses follow it

    @property
    def excess_noise(self) -> float:
        """How much larger than claimed the errors are that no fault of the rig makes; 1 where the claims hold."""
        return max(self.noise, 1.0) if np.isfinite(self.noise) else 1.0

    @property
    def lasts(self) -> bool:
        """Whether what no constant fault explains stays the same over several frames, as noise does not."""
        return self.correlation_frames > LASTING_FRAMES


def diagnose(
    lin: LinearisedFrames, columns: Array, covariance: Array, faults: Sequence[PossibleFault]
) -> FaultDiagnosis:
    """The inquest on K frames. columns (K, n, 2, p), whitened; covariance (p, p) of these numbers as claimed."""
    free = lin.pose_free(columns)
    flat = free.reshape(-1, free.shape[-1])
    left = lin.pose_free(lin.residual)
    r = left.ravel()
    X, V = _compressed(flat.T @ flat)
    y = V @ (flat.T @ r)
    fitted = (flat @ (V.T @ y)).reshape(left.shape)
    dof = lin.dof
    rest_dof = dof - len(y)
    chi2 = float(r @ r)
    noise2 = float(np.sum((left - fitted) ** 2)) / rest_dof if rest_dof > 0 else 1.0
    series = np.where(lin.used[..., None], left - fitted, np.nan).reshape(len(left), -1)
    together = correlation_time(series)
    own = np.einsum("knii->n", lin.own_share()) * rest_dof / dof if rest_dof > 0 else np.zeros(lin.used.shape[1])
    squares = np.sum((left - fitted) ** 2, axis=(0, 2))
    noise_of_views = np.where(own > _LEAST_OWN, np.sqrt(squares / np.where(own > _LEAST_OWN, own, 1.0)), np.nan)
    # Sigmas claimed too small, or errors that last, make chance larger than it is told; smaller it is not believed.
    chance = max(noise2, 1.0) * together
    root = np.linalg.cholesky(chance * np.eye(len(y)) + X @ covariance @ X.T)
    # Whitened once for all faults: the many small solves cost more than all the rest where BLAS runs in threads.
    start = ExcessResidual.of_white(np.linalg.solve(root, y))
    culprits, after = _search(start, np.linalg.solve(root, X), faults)
    return FaultDiagnosis(
        culprits=culprits,
        p_before=start.p_value,
        p_after=after.p_value,
        tests=len(faults),
        misfit=float(np.sqrt(chi2 / dof)) if dof > 0 else float("nan"),
        noise=float(np.sqrt(noise2)),
        correlation_frames=together,
        noise_of_views=noise_of_views,
        unexplained=after.p_value < P_FALSE_ALARM and after.chi2 - after.dof > LINEAR_SHARE * start.chi2,
    )


def _compressed(N: Array) -> tuple[Array, Array]:
    """X (q, p) with X^T X = N (p, p), and V (q, p) with V N = X: q the number of directions that show."""
    scale = np.sqrt(np.maximum(np.diagonal(N), 0.0))
    safe = np.where(scale > 0, scale, 1.0)
    values, vectors = np.linalg.eigh(N / np.outer(safe, safe))
    seen = values > _SEEN * max(float(values[-1]), 1e-300)
    root = np.sqrt(values[seen])[:, None]
    return root * vectors[:, seen].T * scale, vectors[:, seen].T / root / safe


def _search(
    start: ExcessResidual, X: Array, faults: Sequence[PossibleFault]
) -> tuple[tuple[SuspectedFault, ...], ExcessResidual]:
    """Culprits, one after another, and what they leave."""
    found: list[SuspectedFault] = []
    left = start
    while len(found) < MOST_FAULTS:
        more = _best(left, X, faults, found)
        if more is None or more.best.change.explained < LINEAR_SHARE * start.chi2:
            break
        found = [*found, more]
        if len(found) > 1:  # each anew with the others free: it was chosen while they were not known
            for i in range(len(found)):
                others = found[:i] + found[i + 1 :]
                again = _best(start.without(c.best.change for c in others), X, faults, others)
                found[i] = found[i] if again is None else again
        left = start.without(c.best.change for c in found)
    found.sort(key=lambda c: -c.best.weight)
    return tuple(found), left


def _best(
    left: ExcessResidual, X: Array, faults: Sequence[PossibleFault], known: Sequence[SuspectedFault]
) -> SuspectedFault | None:
    """The best explanation that is significant, with its rivals; None where there is none."""
    taken = {_thing(c.best.fault) for c in known}
    fitted = []
    for fault in faults:
        if _thing(fault) in taken:
            continue
        change = left.fit(fault.kind, fault.name, ChangeCandidate(X @ fault.numbers, fault.size))
        alike = len({f.name for f in faults if f.thing == fault.thing})
        fitted.append(Explained(fault, change, change.evidence - 2 * float(np.log(alike))))
    significant = [e for e in fitted if e.weight > 0 and e.change.p_value < P_FALSE_ALARM / len(faults)]
    if not significant:
        return None
    significant.sort(key=lambda e: -e.weight)
    margin = max(AHEAD, LINEAR_SHARE * significant[0].weight)
    close = [e for e in significant if e.weight > significant[0].weight - margin]
    # A spot beside its place is what is seen; a thing that explains it as well is the cause.
    close.sort(key=lambda e: e.fault.kind == BESIDE)
    best_of_thing: dict[tuple[str, str], Explained] = {}
    for e in close:
        best_of_thing.setdefault(_thing(e.fault), e)
    best, *rivals = best_of_thing.values()
    rivals = [e for e in rivals if e.fault.thing != VIEW or best.fault.thing == VIEW]
    return SuspectedFault(best, tuple(rivals[:MOST_RIVALS]), max(len(rivals) - MOST_RIVALS, 0))


def _thing(fault: PossibleFault) -> tuple[str, str]:
    return fault.thing, fault.name
