"""Fitting lens models to board corners, and choosing one."""
