"""Terms of measurements that can be reduced to some of their rows, or given wider sigmas."""

from __future__ import annotations

from typing import Protocol, Self, cast

from calibration.least_squares.adjustment import Loss, Term
from geometry.arrays import Bools


class ScalableTerm(Term, Protocol):
    """A term whose sigmas may be too small."""

    def widened(self, scale: float) -> Self:
        """The same term with all its sigmas multiplied."""


class MeasurementTerm(ScalableTerm, Protocol):
    """A term with one row per measurement, of which outliers can be left out."""

    def __len__(self) -> int:
        """Number of measurements."""

    def pick(self, rows: Bools, loss: Loss | None = None) -> Self:
        """Some of the measurements, with this loss."""


def rows_of(term: Term) -> int:
    """Number of measurements of a term."""
    return len(cast(MeasurementTerm, term))


def picked(term: Term, rows: Bools, loss: Loss | None = None) -> Term:
    """Some rows of a term, with this loss."""
    return cast(MeasurementTerm, term).pick(rows, loss)


def widened(term: Term, scale: float) -> Term:
    """A term with all its sigmas multiplied; with a scale of 1 any term."""
    return term if scale == 1.0 else cast(ScalableTerm, term).widened(scale)
