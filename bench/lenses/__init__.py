"""Benches of lens calibration from photographs: real ones, and rendered ones with exact truth."""

import lab.commands  # noqa: F401  one thread for linear algebra, as the commands have it: before numpy is loaded
