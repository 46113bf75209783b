"""Recordings drawn at random as pictures: `python -m bench.random_scenes --pictures`. The renderer is its own.

Nothing here uses the detector's model of a spot or lab/simulate.
"""
