"""Calibration of a pair of cameras from photographs of a board that both see."""
