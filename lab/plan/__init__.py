"""`beampose plan`: visibility and expected uncertainty of a rig before it is built."""
