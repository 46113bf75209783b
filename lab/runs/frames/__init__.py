"""Frames of a run: read, searched for spots, tracked."""
