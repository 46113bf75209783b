"""Cases of a statement that the fast tests try, and those that the slow ones try as well."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest


def further_slow(cases: Iterable[Any], fast: int = 1) -> list[Any]:
    """The cases of a parametrized test; those after the first `fast` are marked as slow."""
    marked = []
    for number, case in enumerate(cases):
        values = case if isinstance(case, tuple) else (case,)
        marked.append(case if number < fast else pytest.param(*values, marks=pytest.mark.slow))
    return marked
