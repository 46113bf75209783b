"""The calibration workflow: files in, calibrations and their reports out."""
