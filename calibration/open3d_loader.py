"""Loads Open3D, which reads and processes point clouds.

Only the commands that use it load it, because the import takes most of a second. On Linux its library needs libusb-1.0,
which comes with the PyPI package libusb-package, and libraries of the graphics system, which a desktop has.
"""

from __future__ import annotations

import ctypes
import re
import sys
from typing import Any

INSTALL = (
    "this needs Open3D, which is not installed: `pip install open3d-cpu libusb-package` on Linux with x86-64,"
    " `pip install open3d` elsewhere"
)
_PACKAGES_OF_DEBIAN = {
    "libEGL.so": "libegl1",
    "libGL.so": "libgl1",
    "libX11.so": "libx11-6",
    "libgomp.so": "libgomp1",
    "libidn2.so": "libidn2-0",
    "libudev.so": "libudev1",
    "libusb-1.0.so": "libusb-1.0-0",
}


class MissingOpen3DError(RuntimeError):
    """Open3D is not installed, or a system library that it needs is missing. The message says what to install."""


def open3d() -> Any:
    """The module. Raises MissingOpen3DError: it cannot be loaded."""
    _load_libusb()
    try:
        import open3d as module
    except (ImportError, OSError) as error:  # OSError: a system library that it needs is missing
        raise MissingOpen3DError(_explained(error)) from None
    return module


def _load_libusb() -> None:
    """Load the packaged libusb for all that is loaded later; without the package, the system's is used, if any."""
    if not sys.platform.startswith("linux") or "open3d" in sys.modules:
        return
    try:
        import libusb_package

        path = libusb_package.get_library_path()
        if path is not None:
            ctypes.CDLL(str(path), mode=ctypes.RTLD_GLOBAL)
    except (ImportError, OSError):
        return  # `import open3d` then says whether anything is missing


def _explained(error: Exception) -> str:
    """What to install, for an error of `import open3d`."""
    library = re.match(r"(lib[\w.+-]+?\.so)[.\d]*: cannot open shared object file", str(error))
    if library is None:
        return f"{INSTALL} ({error})"
    package = _PACKAGES_OF_DEBIAN.get(library[1])
    hint = f"`apt-get install {package}`" if package else "the system package that has it"
    return f"this needs Open3D, whose system library {library[1]} is missing; on Debian or Ubuntu install {hint}"
