"""Intrinsic calibration of a camera from photographs of a board."""
