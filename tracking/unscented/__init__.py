"""Unscented Kalman filter on plain arrays: transform, filter, robust updates, observability, and Fu's (2016) form."""
