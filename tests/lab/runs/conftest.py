"""Settings for the tests of runs."""

from __future__ import annotations

import pytest


@pytest.fixture(autouse=True)
def undrawn(no_page: None) -> None:
    """Tests of runs go without a report, except those with `with_page`."""
