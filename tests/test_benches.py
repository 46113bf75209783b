"""The benches, which no other test runs, still fit the code that they measure."""

from __future__ import annotations

import importlib
import pkgutil

import pytest

import bench

# Other trackers and detectors, which `make peers` installs into environments of their own.
PEERS = {"motmetrics", "supervision", "laptrack", "norfair", "pyrecest", "stonesoup", "trackpy"}
MODULES = sorted(m.name for m in pkgutil.walk_packages(bench.__path__, "bench.") if not m.name.endswith("__main__"))


@pytest.mark.parametrize("name", MODULES)
def test_every_module_of_the_benches_can_be_imported(name):
    try:
        importlib.import_module(name)
    except ModuleNotFoundError as missing:
        if missing.name not in PEERS:
            raise
        pytest.skip(f"{missing.name} is not installed")
