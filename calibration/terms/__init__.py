"""Measurements as terms of an adjustment: whitened residuals and analytic Jacobians."""
