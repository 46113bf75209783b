"""Calibration of cameras, screens and beams from measurements."""
