"""Fit of lens models to board corners, and model selection."""
