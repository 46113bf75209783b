"""`beampose check`: whether a rig file or a run folder can be processed, and what the rig can see."""
