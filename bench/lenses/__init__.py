"""Benches of lens calibration from photographs: real ones, and rendered ones with exact truth."""
