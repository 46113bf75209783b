"""Skips tests where Open3D cannot be loaded: no wheel for the platform, or no graphics libraries in a container.

Its import takes a second, so it is loaded by the first such test and not while tests are collected.
"""

from __future__ import annotations

import pytest

needs_open3d = pytest.mark.usefixtures("loaded_open3d")  # of tests/conftest.py
