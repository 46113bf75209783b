"""Random recordings as pictures: `python -m bench.random_scenes --pictures`, with an independent renderer.

It does not use the spot model of the detector or lab/simulate.
"""
