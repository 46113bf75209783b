"""Calibration commands: each reads files, calibrates, and writes the result with a report."""
