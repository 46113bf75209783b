"""Installed packages: the versions that are recorded with a result, and packages that only some options need."""

from __future__ import annotations

import contextlib
import importlib
import platform
from functools import cache
from importlib import metadata
from typing import Any

from lab.errors import InputError

_STATED = (  # the program, and the libraries that its numbers depend on
    "beampose", "numpy", "scipy", "opencv-python-headless", "numba", "llvmlite", "isal", "simplejpeg", "pandas",
)  # fmt: skip
_ONE_OF = ("open3d-cpu", "open3d")  # the name depends on the platform; some have neither
PACKAGES = {
    "c3d": ("ezc3d", "ezc3d"),
    "genicam": ("harvesters", "harvesters"),
    "hdf5": ("h5py", "h5py"),
    "lsl": ("pylsl", "pylsl"),
    "mcap": ("mcap", "mcap"),
    "parquet": ("pyarrow", "pyarrow"),
    "rosbag2": ("rosbags", "rosbags"),
    "zmq": ("zmq", "pyzmq"),
}  # optional, by extra of pyproject.toml: the module to import, and the name of its package


def versions() -> dict[str, str]:
    """Versions by name of package."""
    return dict(_versions())


@cache
def _versions() -> dict[str, str]:
    out = {"python": platform.python_version()}
    for name in _STATED:
        try:
            out[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            out[name] = "not installed as a package"
    for name in _ONE_OF:
        with contextlib.suppress(metadata.PackageNotFoundError):
            out[name] = metadata.version(name)
    return out


def needed(extra: str, option: str, module: str = "") -> Any:
    """A module of the package of an extra, or the package itself; to be called before long work.

    option: what the user asked for, for the message. Raises InputError where the package is not installed.
    """
    top, package = PACKAGES[extra]
    try:
        return importlib.import_module(f"{top}.{module}" if module else top)
    except (ImportError, OSError, RuntimeError):  # a library that the package loads is missing
        raise InputError(
            f"{option}: expected the package {package}, which is not installed or does not load: pip install"
            f" 'beampose[{extra}]'"
        ) from None
