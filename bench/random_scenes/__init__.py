"""Random recordings as points with truth, and the errors of beampose on them: `python -m bench.random_scenes`."""
