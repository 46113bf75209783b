"""Recordings drawn at random, as points with truth, and how beampose does on them: `python -m bench.random_scenes`."""
