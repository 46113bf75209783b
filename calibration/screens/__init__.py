"""Calibration of screens and cameras from surveyed dots, boards and scans."""
