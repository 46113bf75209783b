"""Compilation of numerical functions by numba: the decorator, and its cache on disk (geometry's only files)."""
