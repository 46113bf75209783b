"""Pose of a target with coloured markers from a calibrated pair of cameras (after Zhou 2020)."""
