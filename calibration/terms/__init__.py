"""Measurements as terms of an adjustment: whitened residuals with analytic Jacobians."""
