"""Refinement of a rig by recordings: `beampose refine`."""
