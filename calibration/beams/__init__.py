"""Calibration of the lasers' lines in the vehicle."""
