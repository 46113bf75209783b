"""Errors of a run's results against truth."""
