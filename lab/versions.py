"""Versions recorded with a result: this program, Python, and the libraries that its numbers depend on."""

from __future__ import annotations

import contextlib
import platform
from functools import cache
from importlib import metadata

PACKAGES = (
    "beampose", "numpy", "scipy", "opencv-python-headless", "numba", "llvmlite", "isal", "simplejpeg", "pandas",
)  # fmt: skip
ONE_OF = ("open3d-cpu", "open3d")  # the name depends on the platform; some have neither


def versions() -> dict[str, str]:
    """Versions by name of package."""
    return dict(_versions())


@cache
def _versions() -> dict[str, str]:
    out = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            out[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            out[name] = "not installed as a package"
    for name in ONE_OF:
        with contextlib.suppress(metadata.PackageNotFoundError):
            out[name] = metadata.version(name)
    return out
