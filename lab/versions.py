"""Versions recorded with a result: this program, Python, and the libraries that its numbers depend on."""

from __future__ import annotations

import platform
from importlib import metadata

PACKAGES = (
    "beampose", "numpy", "scipy", "opencv-python-headless", "numba", "llvmlite", "isal", "simplejpeg", "pandas",
)  # fmt: skip


def versions() -> dict[str, str]:
    """Versions by name of package."""
    out = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            out[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            out[name] = "not installed as a package"
    return out
