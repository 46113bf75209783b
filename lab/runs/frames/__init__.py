"""Frames of a run: reading, sensor noise, detection and tracking."""
