"""Checks of the results, and the verdict on a run."""
