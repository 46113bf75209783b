"""Settings for all tests."""

from __future__ import annotations

from hypothesis import settings

# The same examples every time: a test that failed fails again, and a machine that is busy is no failure.
# `pytest --hypothesis-profile=explore` goes looking for new ones.
settings.register_profile("fixed", derandomize=True, deadline=None)
settings.register_profile("explore", deadline=None, max_examples=1000)
settings.load_profile("fixed")
