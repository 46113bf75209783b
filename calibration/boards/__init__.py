"""Calibration boards: what they are, and how they are drawn and found."""
