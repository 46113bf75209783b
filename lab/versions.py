"""What made a result: this program, Python, and the libraries that numbers depend on."""

from __future__ import annotations

import platform
from importlib import metadata


def versions() -> dict[str, str]:
    """Versions by name."""
    out = {"python": platform.python_version()}
    for name in ("beampose", "numpy", "scipy", "opencv-python-headless", "pandas"):
        try:
            out[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            out[name] = "not installed as a package"
    return out
