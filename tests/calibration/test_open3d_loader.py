"""Open3D is loaded with the packaged libusb, or the message says what to install."""

from __future__ import annotations

import subprocess
import sys

import pytest

from calibration.screens.clouds import MissingOpen3DError, _explained, open3d
from tests.marks import needs_open3d
from tests.paths import ROOT


@needs_open3d
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="only Open3D for Linux needs libusb")
def test_the_packaged_libusb_is_loaded_and_not_the_systems():
    code = "from calibration.screens.clouds import open3d; open3d(); print(open('/proc/self/maps').read())"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT).stdout
    loaded = {line.split()[-1] for line in out.splitlines() if "libusb" in line}
    assert len(loaded) == 1
    assert "libusb_package" in loaded.pop()


def test_without_open3d_the_message_describes_its_installation(monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(MissingOpen3DError, match=r"not installed: `pip install open3d-cpu libusb-package`"):
        open3d()


@pytest.mark.parametrize(
    ("library", "package"),
    [("libEGL.so.1", "libegl1"), ("libusb-1.0.so.0", "libusb-1.0-0"), ("libnew.so.3", "the system package")],
)
def test_a_missing_system_library_is_named_with_its_package(library, package):
    text = _explained(ImportError(f"{library}: cannot open shared object file: No such file or directory"))
    assert library.split(".so")[0] in text
    assert package in text
    assert "not installed" not in text
