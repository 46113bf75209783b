"""Skips tests where Open3D cannot be loaded: no wheel for the platform, or no graphics libraries in a container."""

from __future__ import annotations

import pytest

from calibration.open3d_loader import MissingOpen3DError, open3d

try:
    open3d()
    MISSING = ""
except MissingOpen3DError as error:
    MISSING = str(error)
needs_open3d = pytest.mark.skipif(bool(MISSING), reason=MISSING)
