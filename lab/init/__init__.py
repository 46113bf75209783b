"""`beampose init`: a first rig.yaml and run.yaml, with comments."""
