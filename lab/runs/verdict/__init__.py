"""Checks of every frame before it is written, statistics of a run, and the verdict on it."""
