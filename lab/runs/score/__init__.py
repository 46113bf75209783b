"""Errors of a result against truth."""
