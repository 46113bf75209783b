"""Marks of tests: those that need Open3D, and cases that the slow tests try as well."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest

# Skips tests where Open3D cannot be loaded: no wheel for the platform, or no graphics libraries in a container. Its
# import takes a second, so it is loaded by the first such test (tests/conftest.py) and not while tests are collected.
needs_open3d = pytest.mark.usefixtures("loaded_open3d")


def further_slow(cases: Iterable[Any], fast: int = 1) -> list[Any]:
    """The cases of a parametrized test; those after the first `fast` are marked as slow.

    cases: tuples of the test's parameters, or the only one.
    """
    every = [case if isinstance(case, tuple) else (case,) for case in cases]
    return [pytest.param(*case, marks=pytest.mark.slow if n >= fast else ()) for n, case in enumerate(every)]
