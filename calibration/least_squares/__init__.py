"""Sparse nonlinear least squares for all calibrations: unknowns, terms, priors, solver."""
