"""Compares two recorded motions: time offset, clock rate and frame alignment, differences, Allan deviation."""
