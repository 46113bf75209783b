"""Packages that only some options need: optional extras of pyproject.toml, imported where they are used."""

from __future__ import annotations

import importlib
from typing import Any

from lab.errors import InputError

PACKAGES = {
    "c3d": ("ezc3d", "ezc3d"),
    "genicam": ("harvesters", "harvesters"),
    "hdf5": ("h5py", "h5py"),
    "lsl": ("pylsl", "pylsl"),
    "mcap": ("mcap", "mcap"),
    "parquet": ("pyarrow", "pyarrow"),
    "rosbag2": ("rosbags", "rosbags"),
    "zmq": ("zmq", "pyzmq"),
}  # by extra: the module to import, and the name of its package


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
