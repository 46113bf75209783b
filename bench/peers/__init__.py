"""Comparison of trackers: those of other packages and ours on the same points."""
