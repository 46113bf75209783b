"""The versions that are recorded with each result."""

from __future__ import annotations

import subprocess
import sys
from importlib.metadata import packages_distributions

from lab.packages import versions
from tests.paths import ROOT
from tests.test_architecture import FLOORS, foreign_packages

# Libraries without influence on numbers: the command line, reports, and reading of settings.
WITHOUT_NUMBERS = {
    *("click", "contourpy", "filelock", "fpdf", "jinja2", "libusb_package", "markupsafe"),
    *("ezc3d", "h5py", "harvesters", "mcap", "pyarrow", "pylsl", "rosbags", "zmq"),
    *("pydantic", "pydantic_core", "rich", "torch", "yaml"),
}


def test_every_imported_library_that_numbers_depend_on_has_its_version_recorded():
    found = versions()
    distributions = packages_distributions()
    used = set().union(*(foreign_packages(ROOT, floor) for floor in FLOORS)) - WITHOUT_NUMBERS
    assert {"numpy", "numba", "cv2", "isal", "simplejpeg"} <= used
    if "open3d" not in distributions:  # no wheel for this platform
        used -= {"open3d"}
    missing = {package for package in used if not set(distributions[package]) & set(found)}
    assert missing == set()
    assert "llvmlite" in found  # numba's compiler: decides which machine code runs
    assert all(version[0].isdigit() for version in found.values())


def test_the_versions_are_found_without_importing_the_libraries():
    code = "import sys, lab.packages as v; v.versions(); print({'numba', 'cv2', 'scipy'} & set(sys.modules))"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT).stdout
    assert out.strip() == "set()"
